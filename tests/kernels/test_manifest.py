"""Machine code that was installed is used where it fits, and nothing else of it is."""

import json
import os
import re
import subprocess
import sys
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
import pytest
from often import few

import optloc
from optloc.cli import wheel
from optloc.cli.compile import make
from optloc.kernels import manifest
from optloc.kernels.code_cache import folder
from optloc.kernels.jit import enabled
from optloc.tracking.updates import ekf

pytestmark = pytest.mark.skipif(not enabled(), reason="without numba there is no machine code")

PLACES = 1e3 * np.array([[0.0, 0, 0], [10, 0, 1], [0, 10, 2], [-9, 1, 0.5]])
MEAN = np.array([2e3, 3e3, 4e3])
# An update by machine code: where it comes from, what was compiled for it, and what came out.
ASK = """
import numpy as np
from numba.core import event

import optloc
from optloc.kernels.manifest import installed
from optloc.tracking.updates import ekf

places, mean = np.array({places}), np.array({mean})
problem = optloc.assemble(places, optloc.measured("range", {z}, a=np.arange(4), sigma=1.0))
with event.install_recorder("numba:compile") as made:
    done = ekf(problem, mean, np.eye(3))
print(installed() is not None, len(made.buffer) // 2, done.mean.tolist())
"""


# The digest of a kernel in a version before.
BEFORE = 16 * "0"


def scan():
    template = optloc.assemble(PLACES, optloc.measured("range", a=np.arange(4), sigma=1.0))
    return optloc.simulate(template, MEAN, 1)


def asked(site: Path, cache: Path) -> tuple[bool, int, list[float]]:
    """Return what a process says that finds numba, and what lies beside it, in a folder of its own."""
    code = ASK.format(places=PLACES.tolist(), mean=MEAN.tolist(), z=scan().z.tolist())
    paths = os.pathsep.join([str(site), str(Path(optloc.__file__).parents[1])])
    given = {**os.environ, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(cache), "OPTLOC_COMPILE": "never"}
    done = subprocess.run([sys.executable, "-c", code], env=given, capture_output=True, text=True, check=True)
    fits, compiled, mean = done.stdout.split(maxsplit=2)
    return fits == "True", int(compiled), json.loads(mean)


@pytest.fixture
def site(tmp_path):
    """Return a folder like that of installed packages: the wheel of a few kernels, unpacked beside numba's metadata."""
    assert make() == []
    few = tmp_path / "few"
    few.mkdir()
    for file in folder().glob("optloc.kernels.*.nb[ic]"):
        if file.name.startswith(("optloc.kernels.filter.", "optloc.kernels.batched_rows.", "optloc.kernels.systems.")):
            (few / file.name).write_bytes(file.read_bytes())
            (few / re.sub(r"-[0-9a-f]{16}\.", f"-{BEFORE}.", file.name)).write_bytes(b"of a version before")
    packed = wheel.pack(few, tmp_path / "dist")
    place = tmp_path / "site"
    with zipfile.ZipFile(packed) as file:
        file.extractall(place)
    # where numba is found first: its own folder is found behind
    numba = distribution("numba")
    info = place / f"numba-{numba.version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(numba.read_text("METADATA"), encoding="utf-8")
    return place


def changed(site: Path, **values: str) -> None:
    file = site / manifest.INSTALLED / manifest.FILE
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def test_installed_machine_code_is_used_where_it_fits(site, tmp_path):
    fits, compiled, mean = asked(site, tmp_path / "cache")
    assert (fits, compiled) == (True, 0)
    assert mean == ekf(scan(), MEAN, np.eye(3)).mean.tolist()


@pytest.mark.parametrize(
    "wrong",
    few([{"compiler": "0" * 64}, {"numba": "0.1"}, {"features": "+nothing-has-this"}, {"more": "1"}], 1),
    ids=list,
)
def test_installed_machine_code_that_does_not_fit_is_not_loaded(site, tmp_path, wrong):
    """Numpy's way, which agrees to rounding, and nothing is compiled."""
    changed(site, **wrong)
    fits, compiled, mean = asked(site, tmp_path / "cache")
    assert (fits, compiled) == (False, 0)
    np.testing.assert_allclose(mean, ekf(scan(), MEAN, np.eye(3)).mean, rtol=1e-9)


def test_a_wheel_holds_the_kernels_of_this_version_alone(site, tmp_path):
    code = {file.name for file in (site / manifest.INSTALLED).glob("*.nb[ic]")}
    assert code == {file.name for file in (tmp_path / "few").iterdir() if BEFORE not in file.name}


def test_a_wheel_says_what_it_is_for(site):
    found = manifest.Manifest(**json.loads((site / manifest.INSTALLED / manifest.FILE).read_text()))
    assert found == manifest.of_this_process()
    assert not found.misfit(found)
    assert found._replace(features=f"{found.features},+nothing-has-this").misfit(found) == (
        "a processor with nothing-has-this"
    )
    about = next(site.glob("optloc_kernels-*.dist-info/METADATA")).read_text()
    assert f"Requires-Dist: optloc=={optloc.__version__}" in about
    assert f"Requires-Dist: numba=={found.numba}" in about

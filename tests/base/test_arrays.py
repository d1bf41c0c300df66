"""The same seed draws the same data, bit for bit, whatever the BLAS and the width of the processor's registers."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from optloc import assemble, measured, simulate
from optloc.base import arrays, linalg

# Digests of what is drawn: every kind of the tables of cases, loops, dense covariances, station errors, each shipped
# study, stations on Earth; and of what a BLAS and numpy make of sums and sines, to see that the settings do something.
DIGESTS = """
import hashlib
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np

sys.path.insert(0, sys.argv[1])
from cases import CASES

from optloc import Stations, assemble, measured, simulate
from optloc.files import read
from optloc.lab.study.simulation import draw
from optloc.lab.study.networks import NetworkCase
from optloc.lab.study.design import design_of, design_of_text, shipped


def note(name, *data):
    made = hashlib.blake2b(digest_size=8)
    for array in data:
        made.update(np.ascontiguousarray(array).tobytes())
    print(name, made.hexdigest())


for name, case in CASES.items():
    note(f"case {name}", case.problem.z, simulate(case.problem, case.truth, 7, 3).z)
place = np.random.default_rng(1).uniform(-5e3, 5e3, (7, 3))
a, b = np.triu_indices(7, 1)
note("loops", simulate(assemble(place, measured("tdoa", a=a, b=b, arrival_sigma=5.0)), [1e3, 2e3, 3e3], 7, 50).z)
half = np.random.default_rng(2).uniform(-1.0, 1.0, (7, 7))
dense = sum(half[:, k, None] * half[None, :, k] for k in range(7))
note("dense", simulate(assemble(place, measured("range", a=np.arange(7), covariance=dense)), [1e3, 2e3, 3e3], 7, 50).z)
spread = Stations(place[None], tuple("ABCDEFG"), covariance=np.tile(np.eye(3) + 0.5, (7, 1, 1)), span="noise")
note("station errors", simulate(assemble(spread, measured("range", a=np.arange(7), sigma=1.0)), place[0] + 1, 7, 50).z)
for name in shipped():
    for cell in {cell.case.key: cell for cell in design_of(Path(name), trials=20).cells}.values():
        drawn = cell.case.draw(0, 20)
        if isinstance(cell.case, NetworkCase):
            truth = drawn.truth.stations, drawn.truth.pulses, drawn.truth.emission
            note(f"study {name} {cell.case.key}", *(one.z for one in drawn.networks), *truth)
            continue
        note(f"study {name} {cell.case.key}", drawn.problem.z, drawn.truth, drawn.problem.stations.position)
EARTH = '''
format = 1
name = "x"
trials = 20
[[scenario]]
name = "s"
problem = "demo"
noise = [1.0]
truth = { kind = "shell", distance = ["1 km", "20 km"] }
[[method]]
method = "gtrs+lsr"
'''
for kind in ('"shell", distance = ["1 km", "20 km"]', '"box", box = ["9 km", "9 km", "1 km"]'):
    case = design_of_text(EARTH.replace('"shell", distance = ["1 km", "20 km"]', kind), "x", Path()).cells[0].case
    drawn = draw(case, 0, 20)
    note(f"on Earth {kind[:5]}", drawn.problem.z, drawn.truth, drawn.problem.stations.position)
matrix = np.random.default_rng(3).standard_normal((200, 6, 6))
note("BLAS", matrix @ matrix, np.linalg.eigh(matrix + matrix.mT)[1])
note("numpy", np.sin(matrix), np.arctan2(matrix, 0.5), np.log(np.abs(matrix)))
"""
# Kernels of processors of 2013, 2011 and 2015; then one of 2008 with a numpy and a C library that use nothing younger.
# A processor of another architecture keeps what it has; one that lacks what a kernel asks for (that of 2015 wants wider
# registers than many younger ones have) ends in an illegal instruction, and there is nothing to compare.
SETTINGS = (
    {"OPENBLAS_CORETYPE": "Haswell"},
    {"OPENBLAS_CORETYPE": "Sandybridge"},
    {"OPENBLAS_CORETYPE": "SkylakeX"},
    {
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": "AVX512_ICL AVX512_SKX X86_V4 X86_V3",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F",
    },
)
CHOSEN = {name for setting in SETTINGS for name in setting}


def begun(setting):
    here = {name: value for name, value in os.environ.items() if name not in CHOSEN}
    command = [sys.executable, "-W", "ignore", "-c", DIGESTS, str(Path(__file__).parents[1])]
    return subprocess.Popen(command, env=here | setting, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [(SETTINGS[0], SETTINGS[-1]), pytest.param(SETTINGS, marks=pytest.mark.full)], ids=["ends", "all"]
)
def test_data_do_not_depend_on_the_blas_nor_on_the_registers(settings):
    runs = [begun(setting) for setting in settings]
    found = []
    for run in runs:
        out, error = run.communicate(timeout=120)
        if run.returncode == -signal.SIGILL:
            continue
        assert run.returncode == 0, error
        found.append(dict(line.rsplit(" ", 1) for line in out.splitlines()))
    assert len(found) > 1
    first = found[0]
    assert len(first) > 40
    for other in found[1:]:
        assert other.keys() == first.keys()
        assert [name for name in first if other[name] != first[name] and name not in ("BLAS", "numpy")] == []
    if len({one["BLAS"] for one in found}) == 1:
        pytest.skip("this BLAS does not take another kernel: nothing was compared")


def ulps(found, exact):
    """Return the largest error in units of the last place of a double."""
    return float(np.max(np.abs(found - exact) / np.spacing(np.abs(exact).astype(float))))


@pytest.mark.skipif(np.finfo(np.longdouble).eps == np.finfo(float).eps, reason="no wider number to compare with")
@pytest.mark.parametrize("size", [1e-6, 1.0, 30.0, 1e6])
def test_elementary_functions_are_right_to_three_units_in_the_last_place(size):
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-size, size, (2, 20_000))
    y *= 10.0 ** rng.uniform(-4.0, 4.0, y.shape)
    wide, tall = x.astype(np.longdouble), y.astype(np.longdouble)
    assert ulps(arrays.sin(x), np.sin(wide)) < 3.0
    assert ulps(arrays.cos(x), np.cos(wide)) < 3.0
    assert ulps(arrays.atan2(y, x), np.arctan2(tall, wide)) < 3.0
    assert ulps(arrays.hypot(y, x), np.hypot(tall, wide)) < 3.0
    assert ulps(arrays.log(np.abs(x)), np.log(np.abs(wide))) < 3.0
    assert ulps(arrays.log(1.0 + np.abs(x)), np.log((1.0 + np.abs(x)).astype(np.longdouble))) < 3.0
    bounded = np.clip(x, -700.0, 700.0)
    assert ulps(arrays.exp(bounded), np.exp(bounded.astype(np.longdouble))) < 3.0


def test_elementary_functions_at_the_ends():
    ends = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, 1e300, 1e-300, 5e-324])
    y, x = np.meshgrid(ends, ends)
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(arrays.atan2(y, x), np.arctan2(y, x), rtol=1e-15)
        known = ~np.isnan(x + y)
        assert np.array_equal(np.signbit(arrays.atan2(y, x))[known], np.signbit(np.arctan2(y, x))[known])
        for own, numpys in ((arrays.sin, np.sin), (arrays.cos, np.cos), (arrays.log, np.log), (arrays.exp, np.exp)):
            np.testing.assert_allclose(own(ends), numpys(ends), rtol=1e-15)
    assert arrays.hypot(np.array(3e300), np.array(4e300)) == 5e300
    assert arrays.hypot(np.array(0.0), np.array(0.0)) == 0.0


def test_portable_arrays_use_our_functions_wherever_they_go():
    x = np.random.default_rng(5).uniform(0.1, 2.0, 1000)
    here = x.view(arrays.Portable)
    for numpys, own in ((np.sin, arrays.sin), (np.log, arrays.log), (np.exp, arrays.exp)):
        found = numpys(2.0 * here - 0.1)
        assert isinstance(found, arrays.Portable)
        assert np.array_equal(np.asarray(found), own(2.0 * x - 0.1))
    assert np.array_equal(np.asarray(np.arctan2(here, 1.0)), arrays.atan2(x, np.ones(1000)))
    total = here.copy()
    total += x
    assert np.array_equal(np.asarray(total.sum()), (2.0 * x).sum())


def test_a_factor_of_a_singular_covariance_leaves_out_what_is_no_error():
    a, b = np.triu_indices(5, 1)
    design = np.eye(5)[a] - np.eye(5)[b]
    for scale in (1e-6, 1.0, 3e8):
        covariance = scale**2 * design @ design.T
        lower = linalg.factor_semidefinite(covariance)
        assert np.abs(lower @ lower.T - covariance).max() <= 1e-14 * covariance.max()
        assert np.array_equal(lower, np.tril(lower))
        assert (np.abs(lower).max(0) > 0.0).sum() == 4  # four differences, and what follows from them
    z = simulate(assemble(np.eye(5)[:, :3] * 1e3, measured("tdoa", a=a, b=b, arrival_sigma=5.0)), np.ones(3), 3, 9).z
    noise = z - simulate(assemble(np.eye(5)[:, :3] * 1e3, measured("tdoa", a=a, b=b, sigma=1e-9)), np.ones(3), 3, 9).z
    assert np.abs(noise[:, 0] + noise[:, 4] - noise[:, 1]).max() < 1e-6  # 01 + 12 - 02
    assert np.abs(noise).max() > 1.0


def test_a_factor_of_regular_covariances_is_choleskys_and_a_broken_item_stays_alone():
    half = np.random.default_rng(6).standard_normal((4, 6, 6))
    covariance = half @ half.mT
    assert np.allclose(linalg.factor_semidefinite(covariance), np.linalg.cholesky(covariance), rtol=1e-9, atol=1e-12)
    broken = covariance.copy()
    broken[1, 2, 2] = np.nan
    found = linalg.factor_semidefinite(broken)
    assert np.isnan(found[1]).any()
    assert np.array_equal(found[[0, 2, 3]], linalg.factor_semidefinite(covariance)[[0, 2, 3]])

"""Every starter problem is read, checked and fixed as it is written, near the truth that it names."""

import re
import tomllib

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import Status, solve
from optloc.cli import app
from optloc.cli.starters import starters
from optloc.files import read
from optloc.models import MODELS, Model
from optloc.models.primitives import distance
from optloc.problem import ECEF, by_epoch
from optloc.problem.epochs import separable

RUN = CliRunner()
EVERY = starters()
STARTERS = {name: one for name, one in EVERY.items() if "fix" in one.commands}


def truth_of(text, problem):
    """Return the true position (..., d) that a starter names in its second line."""
    line = text.splitlines()[1]
    if line.startswith("# truth of each epoch"):
        t = problem.times
        return np.stack([1500.0 + 20.0 * t, 900.0 - 12.0 * t], axis=-1)
    values = [float(v) for v in line.partition(":")[2].partition(";")[0].split(",")]
    if "geodetic" in line:
        return ECEF.from_geodetic(*np.radians(values[:2]), values[2])
    return np.array(values)


def test_every_kind_has_a_starter_that_uses_it():
    assert STARTERS.keys() >= MODELS.keys() | {"satellites", "registration", "moving"}
    for kind in MODELS:
        used = [table["kind"] for table in tomllib.loads(STARTERS[kind].text)["measurements"]]
        assert kind in used


def test_what_is_written_is_of_the_newest_format():
    assert {tomllib.loads(starter.text)["format"] for starter in STARTERS.values()} == {2}


@pytest.mark.parametrize("name", STARTERS)
def test_it_is_fixed_as_it_is(name, tmp_path):
    path = tmp_path / "site.toml"
    made = RUN.invoke(app, ["new", name, "--out", str(path)])
    assert made.exit_code == 0, made.output
    checked = RUN.invoke(app, ["check", str(path), "--no-solve"])
    assert checked.exit_code == 0, checked.output
    problem = read(path).problem
    truth = truth_of(STARTERS[name].text, problem)
    problem = by_epoch(problem) if problem.epochs > 1 and separable(problem) else problem
    fix = solve(problem)
    proven = name != "tdoa_fdoa"
    assert (np.asarray(fix.code) == (Status.OK if proven else Status.UNPROVEN)).all(), (fix.status, fix.reason)
    error = fix.position - truth
    d = error.shape[-1]
    own = np.einsum("...i,...ij,...j->...", error, np.linalg.pinv(fix.covariance()[..., :d, :d]), error)
    assert (own < 25.0).all(), own
    assert (fix.p_value > 1e-3).all()


def test_a_network_is_calibrated_as_it_is(tmp_path):
    path, out = tmp_path / "wood.toml", tmp_path / "surveyed.toml"
    made = RUN.invoke(app, ["new", "calibration", "--out", str(path)])
    assert f"optloc calibrate {path}" in made.stdout.replace("\n", "")
    done = RUN.invoke(app, ["calibrate", str(path), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "status ok" in done.output
    # the recorders that the calls were drawn from: R1 and R2 were 38.80 m apart
    stations = read(out).problem.stations.position.reshape(7, 2)
    assert np.linalg.norm(stations[0] - stations[1]) == pytest.approx(38.80, abs=0.2)


@pytest.mark.parametrize("name", EVERY)
def test_it_explains_itself(name):
    lines = EVERY[name].text.splitlines()
    assert EVERY[name].summary.endswith(".")
    assert max(map(len, lines)) <= 120
    assert sum("#" in line for line in lines) >= 4


def test_a_kind_from_elsewhere_has_one_too(monkeypatch, tmp_path):
    double = Model(lambda t, a, b: 2.0 * distance(t, a), "length", 1, "twice the range")
    monkeypatch.setitem(MODELS, "echo", double)
    text = starters()["echo"].text
    assert re.search(r'kind = "echo"\nunit = "m" +# one of m, km', text)
    path = tmp_path / "echo.toml"
    path.write_text(text)
    found = RUN.invoke(app, ["fix", str(path), "--allow", "unproven", "--json"])
    assert found.exit_code == 0, found.output


def test_files_are_not_written_over(tmp_path):
    path = tmp_path / "site.toml"
    path.write_text("mine")
    refused = RUN.invoke(app, ["new", "tdoa", "--out", str(path)])
    assert (refused.exit_code, path.read_text()) == (2, "mine")
    assert "--force" in refused.stderr
    assert RUN.invoke(app, ["new", "tdoa", "--out", str(path), "--force", "-q"]).output == ""
    assert "did you mean 'tdoa'" in RUN.invoke(app, ["new", "tdao"]).stderr
    assert RUN.invoke(app, ["new", "tdoa"]).stdout == STARTERS["tdoa"].text == path.read_text()

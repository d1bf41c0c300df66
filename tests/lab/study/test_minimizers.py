"""Minimizers of others: one file, and a run that computes them alone; pairs of methods; the public test set."""

import json
from importlib.resources import files
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from doc_pages import DOCS
from lab.study.texts import QUICK, design, run_here
from recipes import files_of_the_page
from scipy.optimize import minimize
from typer.testing import CliRunner

import optloc
from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.kernels.sums import equations_at
from optloc.lab.study.baselines import BASELINES, start_of, whiten_one
from optloc.lab.study.design import design_of_text
from optloc.lab.study.execute import executor, run_design
from optloc.lab.study.folder import part_files, progress, read_frame
from optloc.lab.study.methods import added
from optloc.lab.study.minimizers import Minimizer, baseline_of, cost_of
from optloc.lab.study.paired import paired
from optloc.lab.study.simulation import draw
from optloc.lab.study.summary import COLUMNS, judged

RUN, HERE = CliRunner(), executor("processes", 1)
MINE = """
from scipy.optimize import minimize


def bfgs(cost, start):
    '''BFGS with the gradient, as SciPy has it.'''
    return minimize(cost, start, jac=True, method="BFGS").x
"""
FEW = QUICK.replace("trials = 60", "trials = 10")


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    path = tmp_path_factory.mktemp("plugin") / "mine.py"
    path.write_text(MINE)
    assert len(MINE.splitlines()) <= 15
    return path


@pytest.fixture(scope="module")
def folder(mine, tmp_path_factory):
    """Return the folder of a study that was run by its own method, then with one more."""
    out = tmp_path_factory.mktemp("study") / "out"
    assert run_design(design(FEW), out, HERE).complete
    before = {path: path.stat().st_mtime_ns for path in part_files(out).values()}
    told = []
    more = design(FEW, more=added([f"{mine}:bfgs"]))
    assert run_design(more, out, HERE, lambda rows, _: told.append(rows)).complete
    # First what was there, then the new method alone.
    assert told[0] == sum(told[1:]) == 30
    assert {path: path.stat().st_mtime_ns for path in before} == before
    return out


def test_a_second_run_computes_the_new_method_alone(folder):
    frame = read_frame(folder)
    assert frame["method"].value_counts().to_dict() == {"gtrs+lsr": 30, "bfgs": 30}
    # On the same data, and mostly as right.
    assert frame.groupby(["data", "trial"], observed=True).size().eq(2).all()
    assert judged(read_frame(folder, COLUMNS)).query("method == 'bfgs'")["right"].mean() > 0.8


def test_what_is_there_stays_whatever_is_asked_for_next(folder, mine):
    told = []
    for more in ([], [f"{mine}:bfgs"]):
        run_design(design(FEW, more=added(more)), folder, HERE, lambda rows, _: told.append(rows))
    assert told == [60, 60]
    assert progress(folder).complete
    with pytest.raises(InvalidProblem, match="contains another study"):
        run_design(design(FEW.replace("seed = 5", "seed = 6")), folder, HERE)


def test_another_text_of_the_file_is_another_method(folder, mine):
    (old,) = added([f"{mine}:bfgs"])
    mine.write_text(MINE + "# another\n")
    (new,) = added([f"{mine}:bfgs"])
    mine.write_text(MINE)
    assert old.name == new.name
    assert old.identity != new.identity
    assert old.identity == added([f"{mine}:bfgs"])[0].identity


def test_no_file_names_code(mine, tmp_path):
    secret = tmp_path / "evil.py"
    secret.write_text("raise SystemExit(3)")
    for name in (f"{secret}:f", "antigravity:f", "os:system"):
        text = FEW.replace('method = "gtrs+lsr"', f"baseline = {json.dumps(name)}")
        with pytest.raises(InvalidProblem, match="unknown baseline"):
            design(text)


def test_what_cannot_be_loaded_is_a_sentence(mine, tmp_path):
    for name, words in ((f"{mine}:bfsg", "did you mean 'bfgs'"), (f"{tmp_path}/no.py:f", "cannot be loaded")):
        with pytest.raises(InvalidProblem, match=words):
            added([name])
    assert added(["gtrs+lsr", "taylor"])[1].baseline == "taylor"
    assert baseline_of(f"{mine}:bfgs").summary == "BFGS with the gradient, as SciPy has it."


def test_a_method_without_a_vector_has_a_sentence(monkeypatch):
    drawn = SimpleNamespace(problem=optloc.load(files("optloc") / "scenarios" / "demo.toml").flat())
    start = np.zeros((1, drawn.problem.layout.size))
    with pytest.raises(InvalidProblem, match=r"returned an array of shape \(2,\), not the vector \(3,\)"):
        Minimizer(lambda cost, x: x[:2])(drawn, start)


# What is known beforehand of a clock, of the place, and of the emission of each pulse: all of it is part of the cost.
KNOWN = """
[[biases]]
name = "clock"
members = ["Mill", "Tower"]
mean = "10 m"
sigma = "20 m"

[[priors]]
name = "position"
mean = [500.0, -300.0, 800.0]
sigma = [800.0, 500.0, 100.0]
unit = "m"
"""
# What is known exactly: a cost does not tell.
HEIGHT = """
[[constraints]]
kind = "height"
exactly = 1500.0
unit = "m"
"""
SITE = """
format = 1
name = "site"
trials = 4

[[scenario]]
name = "site"
problem = "site.toml"
truth = { kind = "area", lat_deg = [47.75, 47.86], lon_deg = [11.15, 11.3], height = "1500 m" }

[[method]]
method = "gtrs+lsr"
"""


BEARINGS = """
format = 1
name = "bearings"
trials = 4

[[scenario]]
name = "surveyed"
layout = { stations = 5, dimension = 2, box = ["10 km", "10 km"], kinds = ["azimuth"], survey = "100 m" }
truth = { kind = "hull" }
noise = ["1 deg"]

[[method]]
method = "gtrs+lsr"
"""


def site(folder, more, names=()):
    """Return the design of a study of the shipped site with more in its file."""
    text = (files("optloc") / "scenarios" / "demo.toml").read_text()
    (folder / "site.toml").write_text(text + more)
    return design_of_text(SITE, "site", folder, more=added(names))


def problems(folder):
    yield draw(design(FEW).cells[0].case, 0, 1)
    yield draw(design(FEW).cells[2].case, 0, 1)  # with an unknown emission
    yield draw(site(folder, KNOWN).cells[0].case, 0, 1)


def test_the_cost_of_a_minimizer_is_the_one_that_judges_it_and_has_its_gradient(tmp_path, monkeypatch):
    for drawn in problems(tmp_path):
        x = drawn.truth[0] + 10.0
        quick, judge = cost_of(drawn.problem)(x), float(equations_at(drawn.problem, x[None]).cost[0])
        monkeypatch.setattr("optloc.lab.study.minimizers.may_use_code", lambda *_: False)
        cost = cost_of(drawn.problem)
        value, slope = cost(x)
        monkeypatch.undo()
        assert quick[0] == pytest.approx(value, rel=1e-12)
        assert quick[1] == pytest.approx(slope, rel=1e-9)
        assert value == pytest.approx(judge, rel=1e-12)
        steps = 0.1 * np.eye(len(x))
        assert slope == pytest.approx([(cost(x + s)[0] - cost(x - s)[0]) / 0.2 for s in steps], rel=1e-5)
        residual, jacobian = whiten_one(drawn.problem, lambda _: None)
        assert residual(x) @ residual(x) == pytest.approx(judge, rel=1e-9)
        assert 2.0 * jacobian(x).T @ residual(x) == pytest.approx(slope, rel=1e-6)


def test_errors_of_stations_weigh_for_minimizers_as_for_the_others():
    drawn = draw(design(BEARINGS).cells[0].case, 0, 4)
    start = start_of("centre", 0.0, drawn)
    wanted = BASELINES["gauss-newton"].run(drawn, start)
    mine = Minimizer(lambda cost, x: minimize(cost, x, jac=True, method="BFGS").x)(drawn, start)
    for fix in (BASELINES["scipy"].run(drawn, start), mine):
        # Fixes are good to some hundred metres; with the noise of the rows alone they were 6 to 40 m off.
        assert fix.x == pytest.approx(wanted.x, abs=0.1)


def test_what_breaks_a_constraint_has_no_cost_and_wins_against_nobody(tmp_path):
    out = run_here(site(tmp_path, HEIGHT, ["scipy", "truth"]), tmp_path / "out")
    rows = judged(read_frame(out, COLUMNS))
    known = rows.groupby("method", observed=True)["cost"].count()
    assert known.to_dict() == {"gtrs+lsr": 4, "scipy from the centre": 0, "truth": 4}
    right = rows.groupby("method", observed=True)["right"].sum()
    assert right.to_dict() == {"gtrs+lsr": 4, "scipy from the centre": 0, "truth": 4}


NLOPT = files_of_the_page(DOCS / "details" / "studies.md")["others.py"]


@pytest.mark.full
@pytest.mark.skipif(find_spec("nlopt") is None, reason="needs nlopt: pip install nlopt")
def test_nlopt_and_a_method_of_ones_own_are_one_file(mine, tmp_path):
    path = tmp_path / "others.py"
    path.write_text(NLOPT)
    told, few = [], FEW.replace("trials = 10", "trials = 4")

    def run(*names):
        told.clear()
        return run_design(
            design(few, more=added(list(names))), tmp_path / "out", HERE, lambda rows, _: told.append(rows)
        )

    assert run(f"{path}:bobyqa", f"{path}:downhill").complete
    rows = judged(read_frame(tmp_path / "out", COLUMNS))
    assert (rows.groupby("method", observed=True)["right"].mean()[["bobyqa", "downhill"]] > 0.6).all()
    assert (rows[rows["method"] == "bobyqa"]["evaluations"] > 10.0).all()
    # One method more: it is all that is computed.
    assert run(f"{path}:bobyqa", f"{path}:downhill", f"{mine}:bfgs").complete
    assert (told[0], sum(told[1:])) == (36, 12)


def test_the_file_of_the_page_is_short():
    assert len(NLOPT.splitlines()) <= 15
    assert "nlopt" in NLOPT


def test_pairs_count_who_is_right_alone(folder):
    rows = judged(read_frame(folder, COLUMNS))
    found = paired(rows, "gtrs+lsr")
    assert len(found) == 3
    right = rows.pivot_table(index=["data", "trial"], columns="method", values="right", observed=True).astype(bool)
    assert sum(one.alone for one in found) == int((right["bfgs"] & ~right["gtrs+lsr"]).sum())
    assert sum(one.other_alone for one in found) == int((~right["bfgs"] & right["gtrs+lsr"]).sum())
    assert all(one.trials == 10 and one.time.low <= one.time.value <= one.time.high for one in found)
    back = paired(rows, "bfgs")
    assert [(one.alone, one.other_alone, one.p) for one in back] == [(o.other_alone, o.alone, o.p) for o in found]
    done = RUN.invoke(app, ["study", "pairs", str(folder), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)[0]["against"] == "gtrs+lsr"
    assert "against gtrs+lsr" in RUN.invoke(app, ["study", "pairs", str(folder)]).output
    assert "did you mean" in RUN.invoke(app, ["study", "pairs", str(folder), "--against", "bfsg"]).output


@pytest.mark.full
def test_the_public_test_set_has_a_leaderboard(mine, tmp_path):
    page = tmp_path / "board.md"
    words = ["study", "bench", "--trials", "2", "-j", "1", "--quiet", "--page", str(page)]
    done = RUN.invoke(app, [*words, "--out", str(tmp_path / "out"), "--method", f"{mine}:bfgs"])
    assert done.exit_code == 0, done.output
    text = page.read_text()
    assert "2 trials a scene" in text
    ranks = [line.split("|")[2].strip() for line in text.splitlines() if line.startswith("| ") and line[2:3].isdigit()]
    assert set(ranks) >= {"auto", "gtrs+lsr", "bfgs"}
    assert "truth" not in ranks
    scenes = text.split("by scene")[1]
    assert all(0.0 <= float(v) <= 100.0 for v in scenes.split("---:|\n")[1].split("|")[2:4])

"""Convergence histories: points of a way against steps made by hand, counts of who was counted, bands by hand."""

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from doc_pages import DOCS, blocks
from lab.study.texts import QUICK, design, run_here
from typer.testing import CliRunner

from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.lab.report.figures import history_picture, profile_picture
from optloc.lab.study.baselines import BASELINES, Baseline, start_of, whiten_one
from optloc.lab.study.design import design_of
from optloc.lab.study.folder import read_frame
from optloc.lab.study.histories import Histories, band, histories, reach, trace_of, trials_of
from optloc.lab.study.methods import added, run
from optloc.lab.study.minimizers import Minimizer
from optloc.lab.study.profiles import profiles
from optloc.lab.study.simulation import draw
from optloc.lab.study.summary import COLUMNS
from optloc.show.drawing import marks
from optloc.show.pictures.style import save
from optloc.solvers.methods import counting

RUN = CliRunner()
TEXT = QUICK.replace("trials = 60", "trials = 8")
CASE = design(TEXT).cells[0].case
DRAWN = draw(CASE, 0, 5)


def ways(name):
    (method,) = added([name])
    return trace_of(method, DRAWN)


def listened(function, monkeypatch):
    """Return the ways of a minimizer that is a function here."""
    monkeypatch.setitem(BASELINES, "mine", Baseline(Minimizer(function), "a function", slow=True))
    return ways("mine")


def test_the_points_of_a_plain_iteration_are_those_of_gauss_newton_by_hand():
    found, remark = ways("taylor")
    start = start_of("centre", 0.0, DRAWN)
    assert remark == ""
    for i, way in enumerate(found):
        residual, jacobian = whiten_one(DRAWN.problem.take(np.array([i])), lambda _: None)
        x, costs = start[i], []
        for _ in range(4):
            costs.append(residual(x) @ residual(x))
            x = x - np.linalg.lstsq(jacobian(x), residual(x), rcond=None)[0]
        assert way.cost[:4] == pytest.approx(costs, rel=1e-6)
        assert way.iterations[:4].tolist() == [0.0, 1.0, 2.0, 3.0]
        assert way.evaluations[:4].tolist() == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(("name", "counted"), [("gauss-newton", True), ("ipopt", False), ("gtrs+lsr", True)])
def test_a_way_ends_where_the_method_ends(name, counted):
    found, _ = ways(name)
    (method,) = added([name])
    fix = run(method, DRAWN).fix
    for way, cost in zip(found, fix.cost, strict=True):
        assert way.cost[-1] == pytest.approx(cost, abs=1e-6)
        assert (np.diff(way.iterations) == 1.0).all()
        assert np.isnan(way.evaluations).all() != counted
    if name == "gauss-newton":  # damped: no step is taken that costs more, beyond rounding
        assert all((np.diff(way.cost) <= 1e-6).all() for way in found)


def test_iterations_of_ipopt_are_those_that_it_counts():
    with counting() as tally:
        BASELINES["ipopt"].run(DRAWN, start_of("centre", 0.0, DRAWN))
    assert [int(way.iterations[-1]) for way in ways("ipopt")[0]] == [n for _, n in tally]


def test_every_evaluation_of_a_minimizer_is_kept(monkeypatch):
    seen = []

    def three(cost, start):
        seen.append([cost(start)[0], cost(start + 1e3)[0], cost(start - 1e3)[0]])
        return start

    found, remark = listened(three, monkeypatch)
    assert remark == ""
    assert [way.cost.tolist() for way in found] == seen
    assert all(way.evaluations.tolist() == [1.0, 2.0, 3.0] and np.isnan(way.iterations).all() for way in found)


def test_what_a_minimizer_asked_for_stays_when_it_breaks_and_no_number_is_above_all(monkeypatch):
    def breaks(cost, start):
        cost(start)
        cost(np.full_like(start, np.nan))
        raise ArithmeticError("no more")

    found, remark = listened(breaks, monkeypatch)
    assert "no more" in remark
    assert all(np.isfinite(way.cost[0]) and np.isinf(way.cost[1]) and len(way.cost) == 2 for way in found)


@pytest.mark.parametrize(
    ("name", "words"),
    [("suspects", "no history"), ("cauchy", "no history"), ("single-step", "no cost"), ("auto", "until certify")],
)
def test_who_does_not_tell_is_said_in_words(name, words):
    found, remark = ways(name)
    assert words in remark
    assert any(len(way.cost) for way in found) == (name == "auto")


HAND = Histories(
    "by hand",
    pd.concat(
        pd.DataFrame(
            {"method": "a", "trial": i, "evaluations": at, "iterations": np.nan, "cost": above, "best": above}
        ).assign(above=above)
        for i, (at, above) in enumerate(
            [([1.0, 2.0, 4.0], [9.0, 4.0, 0.0]), ([1.0, 3.0], [8.0, 0.0]), ([2.0], [7.0]), ([1.0, 2.0], [6.0, 1.0])]
        )
    ),
    ("a",),
    (),
)


def test_bands_are_quartiles_of_the_best_so_far():
    # at 0 nobody has begun; at 1: 9, 8, inf, 6; at 2: 4, 8, 7, 1; at 3: 4, 0, 7, 1; at 9: 0, 0, 7, 1
    found = band(HAND, "a", "evaluations", np.array([0.0, 1.0, 2.0, 3.0, 9.0]))
    assert found.tolist() == [[np.inf, 6.0, 1.0, 0.0, 0.0], [np.inf, 8.0, 4.0, 1.0, 0.0], [np.inf, 9.0, 7.0, 4.0, 1.0]]


def test_reach_counts_who_came_there_and_how_soon():
    (one,) = reach(HAND, 1.0)
    assert (one.trials, one.reached, one.evaluations, one.iterations) == (4, 3, (2.0, 3.0, 4.0), None)
    assert reach(HAND, 0.5)[0].evaluations == (3.0, 4.0, np.inf)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    text = TEXT + '\n[[method]]\nbaseline = ["gauss-newton", "truth"]\n'
    return run_here(design(text, more=added(["taylor"])), tmp_path_factory.mktemp("histories") / "out")


def test_a_study_knows_its_trials_and_the_least_cost_of_each(folder):
    asked = trials_of(folder, ["scipy"], 3)
    frame = read_frame(folder)
    own = frame[(frame["scenario"] == "differences") & (frame["noise_label"] == "1 m") & (frame["trial"] < 3)]
    assert asked.least == pytest.approx(own.groupby("trial")["cost"].min().to_numpy())
    assert asked.title == "differences, 1 m"
    # who knows the truth is not followed, and who was added to the folder must be named again
    assert [method.name for method in asked.methods] == [
        "gtrs+lsr",
        "gauss-newton from the centre",
        "scipy from the centre",
    ]
    assert len(asked.remarks) == 1
    assert "taylor" in asked.remarks[0]
    found = histories(asked)
    assert (found.frame["above"] >= 0.0).all()
    assert found.frame["above"].min() == 0.0
    assert {one.method: one.reached for one in reach(found, 1e-3)}["gtrs+lsr"] == 3
    assert (found.frame.groupby(["method", "trial"])["best"].diff().dropna() <= 0.0).all()
    assert trials_of(folder, [], 3, "arrivals", "3 m").title == "arrivals, 3 m"


def test_what_cannot_be_followed_is_a_sentence(folder, tmp_path):
    for options, words in (({"case": "arrival"}, "did you mean 'arrivals'"), ({"noise": "4 m"}, "no noise '4 m'")):
        with pytest.raises(InvalidProblem, match=words):
            trials_of(folder, [], 3, **options)
    flown = 'truth = { kind = "hull" }\nnoise = ["3 m"]\n\n[[method]]'
    held = TEXT.replace("layout = { stations = 6, kinds", 'layout = { survey = "20 m", stations = 6, kinds')
    held = held.replace('["toa"]', '["azimuth"]').replace(flown, flown.replace("3 m", "1 deg"))
    drawn = draw(design(held).cells[2].case, 0, 2)
    asked = trials_of(folder, [], 2)
    with pytest.raises(InvalidProblem, match="depend on the position"):
        histories(type(asked)("t", drawn, asked.methods, asked.least))
    with pytest.raises(InvalidProblem):
        trials_of(tmp_path, [], 3)
    with pytest.raises(InvalidProblem, match="no method has a history"):
        histories(type(asked)("t", DRAWN.part(0, 2), tuple(added(["suspects"])), asked.least))
    with pytest.raises(InvalidProblem, match="is not positive"):
        reach(HAND, float("nan"))


def test_the_command_follows_a_study_and_a_file(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["study", "histories", str(folder), "--trials", "2", "--method", "ipopt", "--json"]
    done = RUN.invoke(app, [*words, "--plot", "down.svg", "--out", "down.csv"])
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert record["title"] == "differences, 1 m"
    picture = (tmp_path / "down.svg").read_text()
    assert picture.count("method-") > 4
    table = pd.read_csv("down.csv")
    assert list(table.columns) == ["method", "trial", "evaluations", "iterations", "cost", "best", "above"]
    assert table[table["method"] == "ipopt from the centre"]["evaluations"].isna().all()
    assert {one["method"]: one["evaluations"] is None for one in record["methods"]} == {
        "gtrs+lsr": False,
        "gauss-newton from the centre": False,
        "ipopt from the centre": True,
    }
    file = str(files("optloc") / "scenarios" / "run.toml")
    done = RUN.invoke(app, ["study", "histories", file, "--trials", "2", "-m", "gauss-newton", "-m", "auto"])
    assert done.exit_code == 0, done.output
    assert "auto: shown until certify" in done.output
    assert next(line for line in done.output.splitlines() if "gauss-newton" in line).split("│")[2].strip() == "2"
    (tmp_path / "held.toml").write_text(
        (files("optloc") / "scenarios" / "demo.toml").read_text()
        + '\n[[constraints]]\nkind = "height"\nexactly = 1500.0\nunit = "m"\n'
    )
    done = RUN.invoke(app, ["study", "histories", str(tmp_path / "held.toml")])
    assert done.exit_code == 2
    assert "constraints" in done.output


@pytest.mark.full
def test_the_pictures_of_the_page_are_of_the_public_test_set(tmp_path):
    """Write docs/measured/profiles.png and histories.png: the public test set with few trials, and the page's file."""
    mine = next(b.text for b in blocks(DOCS / "studies.md") if b.mark == "file: mine.py")
    (tmp_path / "mine.py").write_text(mine)
    names = ["ipopt", f"{tmp_path}/mine.py:bfgs", f"{tmp_path}/mine.py:simplex"]
    out = run_here(design_of(Path("bench"), trials=40, more=added(names)), tmp_path / "out")
    found = profiles(read_frame(out, COLUMNS), out=["truth"])
    assert found.spent.shape == (8, 240)
    save(profile_picture(found, marks(list(found.methods))), DOCS / "measured" / "profiles.png")
    ways = histories(trials_of(out, names, 40, "differences, far"))
    assert len(ways.methods) == 8
    save(history_picture(ways, marks(list(ways.methods))), DOCS / "measured" / "histories.png")

"""Data and performance profiles: against tables computed by hand, and on a study whose work is known otherwise."""

import json

import numpy as np
import pandas as pd
import pytest
from lab.study.texts import QUICK, design, run_here
from typer.testing import CliRunner

from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.lab.study.folder import read_frame
from optloc.lab.study.methods import added
from optloc.lab.study.profiles import data_profile, profiles, shares
from optloc.lab.study.summary import COLUMNS

RUN = CliRunner()
COUNTING = """
from scipy.optimize import minimize


def bfgs(cost, start):
    '''BFGS with the gradient, as SciPy has it.'''
    return minimize(cost, start, jac=True, method="BFGS").x


def breaks(cost, start):
    '''Asks twice, and ends with an error in every trial.'''
    cost(start), cost(start)
    raise ArithmeticError("no more")
"""


def test_a_data_profile_is_that_of_its_definition():
    spent = np.array([[1.0, 4.0, 1.0, 7.0], [2.0, 2.0, 9.0, 7.0]])
    solved = np.array([[True, True, True, False], [True, True, False, False]])
    found = data_profile(spent, solved, np.array([0.5, 1.0, 2.0, 3.9, 4.0, 100.0]))
    assert found.tolist() == [[0.0, 0.5, 0.5, 0.5, 0.75, 0.75], [0.0, 0.0, 0.5, 0.5, 0.5, 0.5]]
    assert np.isnan(data_profile(np.zeros((2, 0)), np.zeros((2, 0), dtype=bool), np.ones(3))).all()


def frame_of(cost, spent, truth=9.0):
    """Return the rows of methods (by name) with costs and work of trials; NaN costs came to grief."""
    rows = [
        {"method": name, "data": "d", "trial": i, "cost": c, "cost_truth": truth, "processor": w, "evaluations": np.nan}
        for name, costs in cost.items()
        for i, (c, w) in enumerate(zip(costs, spent[name], strict=True))
    ]
    made = pd.DataFrame(rows)
    return made.assign(gap=made["cost"] - made.groupby("trial")["cost"].transform("min"))


HAND = frame_of(
    {"a": [3.0, 5.0, 9.5, np.nan], "b": [3.0005, 5.1, 9.0, 4.0]},
    {"a": [1.0, 2.0, 3.0, np.nan], "b": [10.0, 1.0, 2.0, 4.0]},
)


def test_solved_is_what_comes_within_tau_of_the_least_known():
    found = profiles(HAND)
    # a: trials 0 and 1, for the truth costs less in 2; b: 0 within a thousandth, 2 and 3.
    assert dict(zip(found.methods, found.solved.tolist(), strict=True)) == {
        "b": [True, False, True, True],
        "a": [True, True, False, False],
    }
    assert (found.spent.shape[1], found.total) == (4, 4)
    assert profiles(HAND, tau=1e-4).solved.sum(1).tolist() == [2, 2]
    assert profiles(HAND, tau=0.2).methods[0] == "b"
    assert profiles(HAND, tau=0.2).solved.sum() == 6
    # who knows the truth does not compete, but what it found counts
    assert profiles(HAND, out=["b"]).solved.tolist() == [[True, True, False, False]]


def test_shares_within_multiples_of_the_best_are_those_of_hand():
    b, a = shares(profiles(HAND))
    # least work: 1 (a), 2 (a), 2 (b), 4 (b); b needs 10 times the least on trial 0
    assert (a.method, a.solved, a.within, a.median) == ("a", 2, {1.0: 0.5, 2.0: 0.5, 10.0: 0.5}, 1.5)
    assert (b.method, b.solved, b.within, b.median) == ("b", 3, {1.0: 0.5, 2.0: 0.5, 10.0: 0.75}, 4.0)


def test_profiles_count_trials_that_nobody_solves_and_only_those_that_all_have_seen():
    worse = HAND.assign(gap=HAND["gap"] + 1.0)
    assert profiles(worse[worse["trial"] < 2]).solved.sum() == 0
    some = HAND[~((HAND["method"] == "a") & (HAND["trial"] == 0))]
    assert (profiles(some).spent.shape[1], profiles(some).total) == (3, 4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"tau": 0.0}, "is not positive"),
        ({"tau": float("nan")}, "is not positive"),
        ({"work": "procesor"}, "did you mean 'processor'"),
        ({"work": "evaluations"}, "no method of the study counts"),
        ({"out": ["a", "b"]}, "all methods know the truth"),
    ],
)
def test_what_has_no_profile_is_a_sentence(options, words):
    with pytest.raises(InvalidProblem, match=words):
        profiles(HAND, **options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of a study by own methods, by SciPy, by a minimizer and by one that breaks."""
    place = tmp_path_factory.mktemp("profiles")
    (place / "others.py").write_text(COUNTING)
    names = ["gauss-newton", "scipy", "truth", f"{place}/others.py:bfgs", f"{place}/others.py:breaks"]
    text = QUICK.replace("trials = 60", "trials = 6")
    return run_here(design(text, more=added(names)), place / "out")


def test_the_table_tells_the_work_of_every_method(folder):
    frame = read_frame(folder)
    alive = frame[frame["status"] != "died"]
    assert (alive["processor"] > 0.0).all()
    told = frame.groupby("method", observed=True)["evaluations"]
    assert told.count().loc[["gtrs+lsr", "truth", "gauss-newton from the centre", "breaks"]].sum() == 0
    assert told.count().loc[["scipy from the centre", "bfgs"]].tolist() == [18, 18]
    # SciPy counts its own evaluations: the mean of each call
    scipy = frame[frame["method"] == "scipy from the centre"]
    calls = scipy.groupby(["key", "chunk"], observed=True)[["evaluations", "iterations"]].mean()
    assert np.allclose(calls["evaluations"], calls["iterations"])
    assert (frame["method"] == "breaks").sum() == (frame["status"] == "died").sum() == 18


def test_a_method_that_breaks_solves_nothing_and_the_others_are_profiled(folder):
    frame = read_frame(folder, COLUMNS)
    found = profiles(frame, out=["truth"])
    assert set(found.methods) == {"gtrs+lsr", "gauss-newton from the centre", "scipy from the centre", "bfgs"}
    assert found.silent == ("breaks",)
    assert found.solved[found.methods.index("gtrs+lsr")].all()
    assert (np.diff(found.data(found.budgets)) >= 0.0).all()
    assert found.data(found.budgets)[:, -1] == pytest.approx(found.solved.mean(1))
    assert found.performance(np.ones(1)).sum() >= 1.0
    counted = profiles(frame, work="evaluations")
    assert set(counted.methods) == {"scipy from the centre", "bfgs"}
    assert "gtrs+lsr" in counted.silent


def test_the_command_prints_draws_and_speaks_json(folder, tmp_path):
    done = RUN.invoke(app, ["study", "profiles", str(folder), "--plot", str(tmp_path / "p.svg")])
    assert done.exit_code == 0, done.output
    assert "gtrs+lsr" in done.output
    assert "truth │" not in done.output
    assert "Performance profile" in (tmp_path / "p.svg").read_text()
    done = RUN.invoke(app, ["study", "profiles", str(folder), "--work", "evaluations", "--tau", "0.1", "--json"])
    record = json.loads(done.stdout)
    assert (record["tau"], record["work"], record["trials"]) == (0.1, "evaluations", 18)
    assert {len(one["data_profile"]) for one in record["methods"]} == {len(record["budgets"])}
    assert "gauss-newton from the centre" in record["not_told"]
    assert RUN.invoke(app, ["study", "profiles", str(folder), "--tau", "-1"]).exit_code == 2
    assert RUN.invoke(app, ["study", "profiles", str(tmp_path)]).exit_code == 2

"""Minimizers of others: one file, and a run that computes them alone; pairs of methods; the public test set."""

import json

import numpy as np
import pytest
from scipy.stats import quantile_test
from study.texts import QUICK, plan
from typer.testing import CliRunner

from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.study.execute import executor, run_plan
from optloc.study.folder import part_files, progress, read_frame
from optloc.study.methods import added
from optloc.study.minimizers import baseline_of, cost_of
from optloc.study.paired import median_of, paired
from optloc.study.summary import COLUMNS, judged

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
    assert run_plan(plan(FEW), out, HERE).complete
    before = {path: path.stat().st_mtime_ns for path in part_files(out).values()}
    told = []
    more = plan(FEW, more=added([f"{mine}:bfgs"]))
    assert run_plan(more, out, HERE, lambda rows, _: told.append(rows)).complete
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
        run_plan(plan(FEW, more=added(more)), folder, HERE, lambda rows, _: told.append(rows))
    assert told == [60, 60]
    assert progress(folder).complete
    with pytest.raises(InvalidProblem, match="holds another study"):
        run_plan(plan(FEW.replace("seed = 5", "seed = 6")), folder, HERE)


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
            plan(text)


def test_what_cannot_be_loaded_is_a_sentence(mine, tmp_path):
    for name, words in ((f"{mine}:bfsg", "did you mean 'bfgs'"), (f"{tmp_path}/no.py:f", "cannot be loaded")):
        with pytest.raises(InvalidProblem, match=words):
            added([name])
    assert added(["gtrs+lsr", "taylor"])[1].baseline == "taylor"
    assert baseline_of(f"{mine}:bfgs").summary == "BFGS with the gradient, as SciPy has it."


def test_the_gradient_is_that_of_the_cost():
    from optloc.study.draws import draw

    drawn = draw(plan(FEW).cells[0].case, 0, 1)
    cost, x = cost_of(drawn.problem), drawn.truth[0] + 10.0
    value, slope = cost(x)
    steps = 0.1 * np.eye(len(x))
    assert value > 0.0
    assert slope == pytest.approx([(cost(x + s)[0] - cost(x - s)[0]) / 0.2 for s in steps], rel=1e-5)


@pytest.mark.parametrize("count", [1, 5, 6, 25, 200])
def test_the_interval_of_a_median_is_that_of_order_statistics(count, seed):
    values = np.random.default_rng(seed).standard_normal(count) + 0.2
    found, test = median_of(values), quantile_test(values, q=0.0, p=0.5)
    low, high = test.confidence_interval(0.95)
    assert found.value == np.median(values)
    expected = [-np.inf if np.isnan(low) else low, np.inf if np.isnan(high) else high]
    assert [found.low, found.high] == pytest.approx(expected)
    assert found.p == pytest.approx(test.pvalue, abs=1e-12)


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

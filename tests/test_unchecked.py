"""Fixes without redundancy: the finding, what the first line of each output says, and who refuses them."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, NoSolution, Status, assemble, constraints, locate, measured, solve
from optloc.cli.application import app
from optloc.problem import Prior
from optloc.show import fix_page

SENTENCE = "no redundancy: a wrong measurement would not be noticed"
AT = np.array([400.0, 700.0])
# Two bearings cross at one place; a third one checks them.
STATIONS = np.array([[0.0, 0.0], [1000.0, 0.0], [500.0, -800.0]])


def bearings(count, sigma=1e-3, **more):
    apart = AT - STATIONS[:count]
    z = np.arctan2(apart[:, 1], apart[:, 0])
    return assemble(STATIONS[:count], measured("azimuth", z, a=np.arange(count), sigma=sigma), **more)


def first_line(text):
    return next(line for line in text.splitlines() if "status" in line)


@pytest.mark.parametrize(("count", "alone"), [(2, True), (3, False)])
def test_a_fix_without_redundancy_is_ok_and_unchecked(count, alone):
    fix = solve(bearings(count))
    assert fix.status is Status.OK
    assert fix.unchecked is alone
    assert fix.findings == ((Status.UNCHECKED,) if alone else ())
    assert bool(fix.has(Status.UNCHECKED)) is alone
    assert not fix.has(Status.OK) or alone is False
    assert (SENTENCE in first_line(str(fix))) is alone
    assert (SENTENCE in fix._repr_html_()) is alone
    told = fix.to_dict()
    assert told["unchecked"] is alone
    assert ("unchecked" in told["findings"]) is alone
    frame = fix.to_dataframe()
    assert frame["unchecked"].tolist() == [alone]
    assert frame["findings"].tolist() == ["unchecked" if alone else ""]


def test_four_receivers_and_an_echo_are_ok_but_refused_where_redundancy_is_required():
    """An echo moves the fix by hundreds of metres, and no residual shows it."""
    rng, wrong = np.random.default_rng(3), 0
    for _ in range(6):
        place = rng.uniform(-2e3, 2e3, (4, 3))
        x = rng.uniform(-1e3, 1e3, 3)
        r = np.linalg.norm(place - x, axis=1)
        r[3] += 300.0
        fix = solve(assemble(place, measured("tdoa", r[1:] - r[0], a=[1, 2, 3], b=0, arrival_sigma=3.0)))
        if not fix.answered:
            continue
        assert int(fix.dof) == 0
        assert Status.UNCHECKED in fix.findings
        if fix.status is Status.OK:
            wrong += np.linalg.norm(fix.position - x) > 30.0
            assert fix.require() is fix
            with pytest.raises(NoSolution, match="redundancy of 0, and 1 is required: a wrong measurement would not"):
                fix.require(redundancy=1)
    assert wrong > 0


def test_require_names_the_fix_of_a_batch_and_counts_the_others():
    z = np.stack([bearings(3).z] * 4)
    weight = np.ones((4, 3))
    weight[1:3, 2] = 0.0  # two of four fixes have no third bearing
    rows = measured("azimuth", z, a=np.arange(3), sigma=1e-3, weight=weight)
    fix = solve(assemble(STATIONS, rows))
    assert (fix.code == Status.OK).all()
    assert fix.unchecked.tolist() == [False, True, True, False]
    assert [one == (Status.UNCHECKED,) for one in fix.findings] == [False, True, True, False]
    assert fix.require() is fix
    with pytest.raises(NoSolution) as caught:
        fix.require(redundancy=1)
    assert "Fix 1 of 4 has a redundancy of 0, and 1 is required (2 fixes have less than 1)" in str(caught.value)
    assert caught.value.fix.unchecked is True
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    with pytest.raises(NoSolution, match="a wrong measurement could not be named"):
        fix[0].require(redundancy=2)
    assert f"4 fixes: all ok; 2 with {SENTENCE}" in " ".join(str(fix).split())
    assert fix.to_dataframe()["unchecked"].tolist() == [False, True, True, False]


def test_a_status_is_refused_before_a_redundancy():
    ambiguous = solve(assemble(STATIONS[:2], measured("range", [500.0, 700.0], a=[0, 1], sigma=1.0)))
    assert ambiguous.status is Status.AMBIGUOUS
    assert ambiguous.findings[-1] is Status.UNCHECKED
    assert SENTENCE in first_line(str(ambiguous))
    with pytest.raises(NoSolution, match="Several positions"):
        ambiguous.require(redundancy=1)
    with pytest.raises(NoSolution, match="redundancy of 0"):
        ambiguous.require(allow=["ambiguous"], redundancy=1)


@pytest.mark.parametrize("redundancy", [-1, 0.5, True, "1", None])
def test_a_redundancy_is_a_whole_number(redundancy):
    with pytest.raises(InvalidProblem, match="redundancy"):
        solve(bearings(3)).require(redundancy=redundancy)


def test_what_is_known_counts_as_redundancy():
    """A prior on the position is as many rows as coordinates; a known height is one unknown less."""
    known = solve(bearings(2, priors=[Prior("position", AT, 1e4 * np.eye(2))]))
    assert (int(known.dof), known.unchecked) == (2, False)
    place = np.array([[0.0, 0.0, 0.0], [4e3, 0.0, 50.0], [0.0, 4e3, 90.0]])
    x = np.array([1e3, 1.5e3, 800.0])
    rows = measured("range", np.linalg.norm(place - x, axis=1), a=[0, 1, 2], sigma=1.0)
    level = constraints.box([-np.inf, -np.inf, 800.0], [np.inf, np.inf, 800.0])
    assert solve(assemble(place, rows, constraints=level)).unchecked is False
    assert solve(assemble(place, rows)).findings[-1] is Status.UNCHECKED


def test_too_few_rows_have_no_answer_to_check():
    fix = solve(bearings(1))
    assert fix.status is Status.TOO_FEW_ROWS
    assert fix.unchecked is False
    assert Status.UNCHECKED not in fix.findings


def test_the_redundancy_of_a_robust_fix_is_that_of_the_rest():
    rng = np.random.default_rng(5)
    place = np.column_stack([1e3 * np.cos(np.arange(6.0)), 1e3 * np.sin(np.arange(6.0))])
    r = np.linalg.norm(place - AT, axis=1) + rng.standard_normal(6)
    r[2] += 400.0
    fix = solve(assemble(place, measured("range", r, a=np.arange(6), sigma=1.0)), method="robust")
    assert [suspect.name for suspect in fix.suspects] == ["station S2"]
    assert int(fix.dof) == 3
    assert fix.require(redundancy=3) is fix
    with pytest.raises(NoSolution, match="redundancy of 3, and 4 is required"):
        fix.require(redundancy=4)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(
        'format = 2\n[frame]\nkind = "enu"\norigin = { lat_deg = 48.0, lon_deg = 11.0, height = 500.0 }\n'
        '[stations]\nunit = "m"\nrows = [{ name = "A", x = 0.0, y = 0.0, z = 0.0 }, '
        '{ name = "B", x = 1000.0, y = 0.0, z = 0.0 }]\n'
        '[[measurements]]\nkind = "range"\nunit = "m"\nsigma = 1.0\n'
        'rows = [{ a = "A", z = 800.0 }, { a = "B", z = 900.0 }]\n'
        '[[constraints]]\nkind = "box"\nmin = [-5000.0, 0.0, 0.0]\nmax = [5000.0, 5000.0, 0.0]\n',
        encoding="utf-8",
    )
    return path


def test_the_command_line_says_it_first_and_ends_with_zero(file, tmp_path):
    shown = CliRunner().invoke(app, ["fix", str(file)], env={"COLUMNS": "140"})
    assert shown.exit_code == 0, shown.output
    assert SENTENCE in first_line(shown.output)
    told = CliRunner().invoke(app, ["fix", str(file), "--json"])
    fix = json.loads(told.stdout)["fixes"][0]
    assert (fix["status"], fix["unchecked"], fix["findings"]) == ("ok", True, ["unchecked"])
    page = tmp_path / "fix.html"
    assert CliRunner().invoke(app, ["fix", str(file), "--html", str(page), "--quiet"]).exit_code == 0
    assert SENTENCE in page.read_text("utf-8")


def test_locate_and_the_html_page_of_several_fixes(file):
    fix = locate({"A": (0.0, 0.0), "B": (800.0, 100.0)}, ranges={"A": 500.0, "B": 640.3}, sigma=1.0)
    assert fix.unchecked is True
    from optloc.files import load

    problem = load(file)
    fixes = [solve(problem) for _ in range(2)]
    assert fix_page(problem, fixes, "two").count(f"ok; {SENTENCE}") == 2

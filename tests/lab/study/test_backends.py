"""Back ends that studies may ask for are those that work; one that solves nothing is shown, and is not ranked first."""

import json

import numpy as np
import pandas as pd
import pytest
from lab.study.texts import run_here
from typer.testing import CliRunner

import optloc
from optloc import Status
from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.lab.study.design import design_of_text
from optloc.lab.study.folder import progress, read_frame
from optloc.lab.study.summary import COLUMNS, judged, methods
from optloc.solvers import back_ends as module
from optloc.solvers.back_ends import backend_kind, backends, faults_of, installed, try_in_process
from optloc.solvers.methods import Choice, using

RUN = CliRunner()
STATIONS = 1e4 * np.array([[0.0, 0.0], [1.0, 0.1], [0.2, 0.9], [-0.8, 0.5]])
TEMPLATE = optloc.assemble(STATIONS, optloc.measured("range", a=[0, 1, 2, 3], sigma=30.0))
PROBLEM = optloc.simulate(TEMPLATE, np.array([-30e3, 7e3]), seed=1)
NAMES = [name for name, entry in backends().items() if entry.kind in ("conic", "nonlinear")]
HEAD = """
format = 1
name = "failures"
trials = 6
[[scenario]]
name = "six"
layout = { stations = 6, kinds = ["range"] }
truth = { kind = "hull" }
noise = ["3 m"]
"""
STUDY = f"""{HEAD}
[[method]]
name = "good"
method = "sdp"
solver = "SCS"
[[method]]
name = "quick"
method = "sdp"
solver = "SCS"
settings = {{ max_iters = 1 }}
[[method]]
name = "no start"
method = "minimax"
"""


def test_those_that_raise_or_never_end_are_not_listed():
    listed = RUN.invoke(app, ["list", "solvers", "--json"]).stdout
    shown = {row["solver"] for row in json.loads(listed)}
    assert {"CLARABEL", "ipopt", "sqpmethod", "scipy"} <= shown
    assert {"HIGHS", "OSQP", "SCIPY"} <= shown
    assert not {"blocksqp", "sleqp"} & shown
    faults = faults_of({name: entry.kind for name, entry in installed().items() if entry.kind != "least squares"})
    for name in {"blocksqp", "sleqp"} & set(installed()):
        assert faults[name]
        with pytest.raises(InvalidProblem, match=f"the solver '{name}' does not work here: ") as error:
            backend_kind(name, "solver")
        assert "use one of CLARABEL" in str(error.value)


def test_what_was_tried_once_is_kept(monkeypatch):
    kinds = {name: entry.kind for name, entry in installed().items() if entry.kind != "least squares"}
    known = faults_of(kinds)
    module._faults.cache_clear()
    monkeypatch.setattr(module, "try_in_process", lambda names: pytest.fail("tried again"))
    if module.folder() is not None:
        assert faults_of(kinds) == known


@pytest.mark.slow
def test_who_ends_the_process_is_named_and_the_others_are_tried(monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE", 1e-3)  # the first that is tried has no time
    assert "does not end within" in try_in_process({"sqpmethod": "nonlinear"})["sqpmethod"]
    monkeypatch.undo()
    found = try_in_process({"nobody": "nonlinear", "nothing": "conic", "ipopt": "nonlinear"})
    assert found["nobody"]
    assert found["nothing"]
    assert found["ipopt"] == ""


@pytest.mark.parametrize("name", NAMES)
def test_each_that_is_listed_solves_and_says_where_it_cannot(name):
    kind = installed()[name].kind
    method = "socp+lsr" if kind == "conic" else "gtrs+nlp"
    with using(Choice(kind, name)):
        fix = optloc.solve(PROBLEM, method)
    assert fix.position == pytest.approx([-30e3, 7e3], abs=200.0)
    # a start on a station, where the cost has no gradient; a program with one iteration
    short = {"SCS": "max_iters", "CLARABEL": "max_iter", "CVXOPT": "max_iters", "QOCO": "max_iters"}
    if kind == "conic" and name not in short:
        return
    settings = {short[name]: 1} if kind == "conic" else {}
    start = None if kind == "conic" else STATIONS[0]
    with using(Choice(kind, name, settings)):
        lost = optloc.solve(PROBLEM, "socp+lsr" if kind == "conic" else "nlp", start=start)
    if kind == "conic":
        assert lost.status == Status.NUMERICAL
        assert np.isnan(lost.x).all()
        assert f"({name}: " in lost.reason[()]
        assert f"({name}: " in lost.stages[0].detail
    else:
        assert lost.status not in (Status.OK, Status.UNPROVEN)
        assert "without an answer" in lost.stages[-1].detail


@pytest.mark.parametrize(("word", "limit"), [("sdp", 60), ("socp", 60), ("sdp", 70)])
def test_of_a_batch_those_without_an_answer_have_none(word, limit):
    many = optloc.simulate(TEMPLATE, np.random.default_rng(3).uniform(-3e4, 3e4, (30, 2)), seed=2)
    expected = optloc.solve(many, word, refine=False)
    with using(Choice("conic", "SCS", {"max_iters": limit})):
        raw, fix = (optloc.solve(many, word, refine=refine) for refine in (False, True))
    assert (raw.code == fix.code).tolist() == (raw.code == Status.NUMERICAL).tolist()
    found = raw.code == Status.UNREFINED
    assert 0 < found.sum() < 30
    assert np.isin(raw.code, (Status.UNREFINED, Status.NUMERICAL)).all()
    assert np.linalg.norm(raw.x[found] - expected.x[found], axis=1).max(initial=0.0) < 3e3
    assert np.isnan(raw.x[~found]).all()
    assert np.isnan(fix.x[~found]).all()
    assert all("SCS: optimal_inaccurate" in reason for reason in raw.reason[~found])


def test_a_solver_that_solved_nothing_is_not_the_first(tmp_path):
    folder = run_here(design_of_text(STUDY, "s.toml", tmp_path), tmp_path / "out")
    frame = judged(read_frame(folder, [*COLUMNS]))
    assert methods(frame)[0] == "good"
    assert not frame.loc[frame["method"] != "good", "located"].any()
    state = progress(folder)
    assert state.methods == {("good", "unrefined"): 6, ("quick", "numerical"): 6, ("no start", "unavailable"): 6}
    assert "SCS: optimal_inaccurate" in state.failures["quick", "numerical"]
    assert "starts from azimuth" in state.failures["no start", "unavailable"]
    shown = RUN.invoke(app, ["study", "status", str(folder)], env={"COLUMNS": "200"}).stdout
    assert "SCS: optimal_inaccurate" in shown


@pytest.mark.parametrize("seconds", [(1.0, 1e-6), (1e-6, 1.0)])
def test_equally_right_methods_are_ranked_by_their_positions_before_their_times(seconds):
    rows = [
        {"method": name, "right": False, "located": located, "seconds": time}
        for name, located, time in zip(("slow", "empty"), (True, False), seconds, strict=True)
    ]
    assert methods(pd.DataFrame(rows)) == ["slow", "empty"]

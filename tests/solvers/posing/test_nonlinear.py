"""Nonlinear programs in the open: symbols, slots, relations, starts, and solves that fail."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from runs import run, truth
from solvers.posing.scenes import differences, pair_of_targets, ranged, registered

from optloc import InvalidProblem, Status, constraints, pose, simulate, solve


def test_the_program_can_be_given_to_casadi_as_it_is():
    problem = ranged(2)
    posed = pose(problem, "nls")
    posed.add(posed.position[0] >= 1e3, name="east")
    solver = ca.nlpsol("own", "ipopt", posed.problem, {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}})
    found = solver(x0=posed.start, p=posed.parameters, **posed.bounds)
    fix = posed.solve()
    assert posed.si(np.asarray(found["x"]).ravel()) == pytest.approx(fix.position, abs=1e-2)
    assert float(found["f"]) == pytest.approx(fix.posed.value, abs=1e-6)
    assert posed.residual.shape == (problem.count, 1)


def test_every_slot_has_an_expression():
    posed = pose(pair_of_targets(1), "nls")
    fix = posed.solve()
    at = ca.Function("at", [posed.problem["x"]], [posed.position, posed.of("position[1]"), posed.clock])
    first, second, clock = (one.full().ravel() for one in at(fix.posed.variables["x"]))
    assert first == pytest.approx(fix.take("position[0]"), abs=1e-3)
    assert second == pytest.approx(fix.take("position[1]"), abs=1e-3)
    assert clock == pytest.approx(fix.take("clock"), abs=1e-3)
    assert list(posed.bias) == ["clock"]
    with pytest.raises(InvalidProblem, match="no unknown range"):
        posed.range  # noqa: B018
    with pytest.raises(InvalidProblem, match="no unknown 'velocity'"):
        posed.velocity  # noqa: B018


def test_relations_are_taken_apart():
    problem = registered(1)
    free = solve(problem)
    posed = pose(problem, "nls")
    posed.add(posed.position[0] == free.position[0] + 1.0, name="line")
    posed.add(posed.clock[0] <= free.take("clock")[0] - 5.0, name="clock")
    assert posed.free == ["clock"]
    fix = posed.solve()
    assert fix.status == Status.UNREFINED
    assert fix.position[0] == pytest.approx(free.position[0] + 1.0, abs=1e-6)
    assert fix.take("clock")[0] == pytest.approx(free.take("clock")[0] - 5.0, abs=1e-6)
    assert fix.posed.duals["clock"] > 0.0
    assert fix.posed.values["clock"] == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(InvalidProblem, match="1 duals, not 2"):
        posed.solve(start=fix, duals={"line": np.zeros(2)})


def test_what_cannot_be_added_or_minimised():
    posed, other = pose(differences(1), "nls"), pose(differences(1), "nls")
    for relation, what in (
        (posed.position[0], "no relation"),
        (other.position[0] <= 1.0, "not of this problem"),
        (ca.SX(1.0) <= ca.SX.sym("a"), "not of this problem"),
        (3, "no relation"),
        (True, "no unknown"),
    ):
        with pytest.raises(InvalidProblem, match=what):
            posed.add(relation)
    for goal, what in ((posed.residual, "not a scalar"), (ca.SX(2.0), "no unknown"), ("cost", "no expression")):
        with pytest.raises(InvalidProblem, match=what):
            posed.minimise(goal)
    with pytest.raises(InvalidProblem, match="no nonlinear solver 'nosuch'"):
        posed.solve("nosuch")
    with pytest.raises(InvalidProblem, match="does not accept the settings"):
        posed.solve(settings={"nosuch": 1})
    with pytest.raises(InvalidProblem, match="no constraint 'other'"):
        posed.solve(duals={"other": 1.0})
    with pytest.raises(InvalidProblem, match="no vector of numbers"):
        posed.solve(start="here")
    with pytest.raises(InvalidProblem, match="start has 5 numbers"):
        posed.solve(start=np.zeros(5))
    with pytest.raises(InvalidProblem, match="union"):
        posed.add(constraints.keep_out_polygon(np.array([[0.0, 0.0], [9.0, 0.0], [1.0, 1.0], [0.0, 9.0]])))


def test_every_member_of_a_union_is_tried():
    problem = ranged(6)
    free = solve(problem).position
    square = free + 15.0 * np.array([[-1.0, -1.0], [1.2, -1.0], [1.2, 1.0], [-1.0, 1.0]])
    road = free + np.array([[-900.0, 30.0], [0.0, 20.0], [900.0, -500.0]])
    for one in (constraints.keep_out_polygon(square), constraints.polyline(road, 5.0)):
        posed = pose(problem, "nls")
        posed.add(one, name="it")
        fix, expected = posed.solve(), solve(replace(problem, constraints=one))
        assert fix.position == pytest.approx(expected.position, abs=1e-4)
        assert fix.posed.value == pytest.approx(float(expected.cost), rel=1e-6)
        assert np.max(fix.posed.duals["it"]) > 0.0


def test_failed_solves_are_statuses():
    problem = differences(1)
    posed = pose(problem, "nls")
    posed.add(ca.sumsqr(posed.position) <= -1e6, name="nowhere")
    fix = posed.solve()
    assert fix.status == Status.INFEASIBLE
    assert '"nowhere"' in str(fix.reason)
    posed = pose(problem, "nls")
    posed.minimise(posed.position[0])
    fix = posed.solve()
    assert fix.status in (Status.NUMERICAL, Status.MAX_ITERATIONS)
    own = pose(problem, "nls")
    own.minimise(ca.sum1(ca.sqrt(1.0 + own.residual**2)))
    fix = own.solve()
    assert fix.status == Status.UNREFINED
    assert "your objective" in str(fix.reason)


def test_an_objective_that_is_not_smooth_is_named():
    posed = pose(differences(1), "nls")
    posed.minimise(ca.norm_1(posed.residual))
    fix = posed.solve(settings={"max_iter": 20})
    assert fix.status == Status.NUMERICAL
    assert "your objective is not smooth, because it contains fabs" in str(fix.reason)


@pytest.mark.slow
def test_a_long_run_is_posed_by_block_averages():
    bare = run(120, prior=200.0)
    problem = simulate(bare, truth(bare), np.random.SeedSequence(3))
    posed = pose(problem, "nls")
    assert posed.residual.shape[0] < problem.count
    fix, expected = posed.solve(), solve(problem, "roots+nlp+lsr+certify")
    sigma = np.sqrt(np.diagonal(expected.cov))
    assert (np.abs(fix.x[: len(sigma)] - expected.x[: len(sigma)]) <= 1e-4 * sigma).all()

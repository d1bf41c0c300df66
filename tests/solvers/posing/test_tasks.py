"""Five tasks of the page on optimisation, each in at most three steps."""

from dataclasses import replace

import casadi as ca
import cvxpy as cp
import numpy as np
import pytest
from solvers.posing.scenes import differences, ranged

import optloc
from optloc import Status, constraints


def test_own_half_plane_in_the_semidefinite_relaxation():
    problem = differences(3)
    free = optloc.solve(problem).position
    posed = optloc.pose(problem, "squared_range_conic: shor")
    posed.add(posed.position[0] <= free[0] - 5.0, name="fence")
    fix = posed.solve()
    assert fix.position[0] == pytest.approx(free[0] - 5.0, abs=1e-6)
    assert fix.posed.duals["fence"] > 0.0
    assert fix.posed.backend.worst < 1e-6
    # the relation is a half-plane of the table, so the fix obeys it, and has the verdict of the problem with it
    expected = optloc.solve(replace(problem, constraints=constraints.half_plane([1.0, 0.0], free[0] - 5.0)))
    assert fix.position == pytest.approx(expected.position, abs=1e-6)
    assert fix.status == expected.status


def test_keep_out_disc_in_the_nonlinear_program():
    problem = ranged(5)
    free = optloc.solve(problem).position
    posed = optloc.pose(problem, "nls")
    posed.add(constraints.keep_out_disc(free, 20.0), name="tower")
    fix = posed.solve()
    assert np.linalg.norm(fix.position - free) == pytest.approx(20.0, rel=1e-6)
    assert fix.posed.duals["tower"] > 0.0
    # the same by a relation of CasADi, which holds in the posed problem only
    posed = optloc.pose(problem, "nls")
    posed.add(ca.norm_2(posed.position - free - 1.0) >= 20.0, name="tower")
    fix = posed.solve(start=free + 30.0)
    assert np.linalg.norm(fix.position - free - 1.0) == pytest.approx(20.0, rel=1e-6)
    assert fix.status == Status.UNREFINED
    assert '"tower"' in str(fix.reason)


@pytest.mark.parametrize("loss", ["l1", "huber"])
def test_own_objective(loss):
    problem = differences(1, count=8)
    posed = optloc.pose(problem, "squared_range_conic: hull")
    own = cp.norm1(posed.residual) if loss == "l1" else cp.sum(cp.huber(posed.residual, 1.0))
    posed.minimise(own)
    fix = posed.solve()
    assert fix.posed.backend.outcome == "solved"
    assert fix.posed.value == pytest.approx(float(own.value))
    assert fix.posed.value - 1e-6 * (1.0 + fix.posed.value) <= fix.posed.bound <= fix.posed.value + 1e-6
    assert fix.status != Status.OK
    assert np.isnan(fix.cov).all()


def test_warm_start_and_duals_back():
    problem = ranged(7)
    free = optloc.solve(problem).position
    posed = optloc.pose(problem, "nls")
    posed.add(ca.norm_2(posed.position - free) >= 20.0, name="tower")
    cold = posed.solve(start=free + 25.0)
    warm = posed.solve(start=cold, duals=cold.posed.duals)
    assert warm.posed.backend.iterations < cold.posed.backend.iterations
    assert warm.posed.duals["tower"] == pytest.approx(cold.posed.duals["tower"], rel=1e-5)
    again = posed.solve("sqpmethod", start=cold.posed, duals=cold.posed.duals)
    assert again.posed.backend.iterations <= 1
    # an interior-point solver of a relaxation does not use them, and says so
    convex = optloc.pose(problem, "squared_range_conic: hull")
    first = convex.solve()
    assert "does not use start" in convex.solve(start=first).posed.backend.message
    scs = convex.solve("SCS", {"eps_abs": 1e-9, "eps_rel": 1e-9})
    assert convex.solve("SCS", {"eps_abs": 1e-9, "eps_rel": 1e-9}, start=scs).posed.backend.iterations <= max(
        scs.posed.backend.iterations, 25
    )


def test_terrain_below_the_target():
    """A height grid as an equality: the position is on the ground."""
    rng = np.random.default_rng(4)
    axis = np.linspace(-3e4, 3e4, 13)
    height = 300.0 + 100.0 * np.sin(axis[:, None] / 9e3) * np.cos(axis / 7e3)
    place = np.append(rng.uniform(-5e3, 5e3, 2), 0.0)
    a = np.arange(1, 6)
    station = 1e4 * rng.uniform(-1, 1, (6, 3)) * [1, 1, 0.05]
    bare = optloc.assemble(station, optloc.measured("tdoa", a=a, b=0 * a, arrival_sigma=3.0))
    ground = constraints.terrain(axis, axis, height, exactly=0.0)
    problem = optloc.simulate(bare, place + np.array([0.0, 0.0, 300.0]), np.random.SeedSequence(4))
    posed = optloc.pose(problem, "nls")
    posed.add(ground, name="ground")
    fix = posed.solve()
    assert fix.posed.backend.outcome == "solved"
    assert fix.posed.values["ground"] == pytest.approx(0.0, abs=1e-6)

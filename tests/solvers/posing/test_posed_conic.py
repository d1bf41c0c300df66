"""Relations of cvxpy in SI units: named parts, units, tables and free relations, and solves that fail."""

import cvxpy as cp
import numpy as np
import pytest
from solvers.posing.scenes import differences, levelled, ranged, registered, shifted, sighted

from optloc import InvalidProblem, Status, constraints, pose, solve


def test_parts_are_in_si_units_and_missing_ones_are_named():
    problem = differences(1)
    posed = pose(problem, "hull")
    fix = posed.solve(refine=False)
    assert posed.position.value == pytest.approx(fix.position)
    assert posed.si(posed.scaled(fix.position)) == pytest.approx(fix.position)
    assert posed.scaled(posed.si(0.25)) == pytest.approx(0.25)
    assert posed.residual.shape[0] >= problem.count
    assert fix.posed.value == pytest.approx(float(np.sum(posed.residual.value**2)), rel=1e-6)
    assert float(posed.problem.objective.value) == pytest.approx(fix.posed.value)
    reference = np.linalg.norm(problem.stations.position[0] - fix.position, axis=-1)
    assert np.abs(reference - float(posed.range.value)).min() < 0.05 * float(posed.range.value)
    for name in ("velocity", "clock"):
        with pytest.raises(InvalidProblem, match=f"has no {name}"):
            getattr(posed, name)
    with pytest.raises(InvalidProblem, match="no range is an unknown"):
        pose(ranged(1), "hull").range  # noqa: B018


def test_biases_and_rates_have_names():
    run = pose(registered(1), "registration_sdp")
    assert run.bias["clock"].shape == (3,)
    assert run.clock.shape == (3,)
    assert run.solve(refine=False).posed.value > 0.0
    posed = pose(shifted(1), "doppler_sdp")
    assert posed.position.shape == (2,)
    posed = pose(levelled(1), "range_height_conic")
    assert np.linalg.norm(posed.solve(refine=False).position) == pytest.approx(6.37e6, rel=0.01)
    with pytest.raises(InvalidProblem, match="has no residual"):
        posed.residual  # noqa: B018


def test_directions_refuse_a_position_and_take_limits_of_elevations():
    posed = pose(sighted(2), "direction_sdp")
    for what in (lambda: posed.position, lambda: posed.add(constraints.half_plane([1.0, 0.0, 0.0], 5.0))):
        with pytest.raises(InvalidProblem, match="unit vectors"):
            what()
    free = posed.solve(refine=False)
    upward = posed.of("direction")[:, 2]
    limit = float(upward.value[0]) - 1e-3
    posed.add(upward[0] <= limit, name="elevation")
    fix = posed.solve()
    assert float(upward.value[0]) == pytest.approx(limit, abs=1e-6)
    assert fix.posed.duals["elevation"] > 0.0
    assert fix.posed.value > free.posed.value
    assert fix.status == Status.UNREFINED


def test_linear_relations_of_the_position_are_of_the_table():
    problem = ranged(3)
    free = solve(problem).position
    posed = pose(problem, "hull")
    posed.add(posed.position[1] >= free[1] + 4.0, name="north")
    posed.add(posed.position[0] - 2.0 * posed.position[1] == free[0] - 2.0 * free[1] - 9.0, name="line")
    assert posed.free == []
    assert [band.name for band in posed.stated.constraints] == ["north", "line"]
    fix = posed.solve()
    assert fix.posed.refined
    assert fix.position[0] - 2.0 * fix.position[1] == pytest.approx(free[0] - 2.0 * free[1] - 9.0, abs=1e-5)
    # a vector relation states one plane for each coordinate
    posed = pose(problem, "socp")
    posed.add(posed.position <= free - 3.0, name="corner")
    assert len(posed.solve().posed.duals["corner"]) == 2


def test_free_relations_hold_in_the_posed_problem_only():
    problem = differences(2)
    free = solve(problem).position
    posed = pose(problem, "hull")
    posed.add(cp.norm(posed.position - free - 30.0) <= 20.0, name="fence")
    posed.add(posed.range <= 1e9, name="reach")
    fix = posed.solve()
    assert fix.status == Status.UNREFINED
    assert np.isnan(fix.cov).all()
    assert 'with constraints "fence" and "reach"' in str(fix.reason)
    assert np.linalg.norm(fix.position - free - 30.0) == pytest.approx(20.0, rel=1e-6)
    again = posed.solve(refine=True)
    assert again.status == Status.UNPROVEN
    assert 'refined without the constraints "fence" and "reach"' in str(again.reason)
    assert again.position == pytest.approx(free, abs=1e-3)


def test_discs_polygons_and_constraints_of_the_problem_are_in_the_relaxation():
    from dataclasses import replace

    problem = ranged(4)
    free = solve(problem).position
    disc = constraints.disc(free + np.array([40.0, 0.0]), 20.0)
    fix = pose(replace(problem, constraints=disc), "hull").solve()
    assert np.linalg.norm(fix.position - free - [40.0, 0.0]) == pytest.approx(20.0, rel=1e-5)
    assert fix.posed.duals["disc"] > 0.0
    posed = pose(problem, "hull")
    posed.add(constraints.polygon(free + np.array([[5.0, -90.0], [90.0, -90.0], [90.0, 90.0], [5.0, 90.0]])))
    fix = posed.solve()
    assert fix.position[0] == pytest.approx(free[0] + 5.0, abs=1e-5)
    for one, what in (
        (constraints.keep_out_disc(free, 5.0), "not convex"),
        (constraints.keep_out_polygon(free + np.array([[-5.0, -5.0], [5.0, -5.0], [0.0, 5.0]])), "union"),
    ):
        with pytest.raises(InvalidProblem, match=what):
            pose(problem, "hull").add(one)


def test_what_cannot_be_added_or_minimised():
    posed, other = pose(differences(1), "hull"), pose(differences(1), "hull")
    for relation, what in (
        (cp.norm(posed.position) >= 1.0, "not convex"),
        (other.position[0] <= 1.0, "no unknown"),
        (True, "no unknown"),
        ("fence", "no relation"),
    ):
        with pytest.raises(InvalidProblem, match=what):
            posed.add(relation)
    posed.add(posed.position[0] <= 0.0, name="fence")
    with pytest.raises(InvalidProblem, match="already"):
        posed.add(posed.position[1] <= 0.0, name="fence")
    for goal, what in (
        (posed.residual, "not a scalar"),
        (-cp.norm(posed.residual), "not convex"),
        (cp.norm(other.residual), "no unknown"),
        (3.0, "not a scalar"),
    ):
        with pytest.raises(InvalidProblem, match=what):
            posed.minimise(goal)
    with pytest.raises(InvalidProblem, match="unknown solver"):
        posed.solve("NOSUCH")


def test_no_solver_denies_a_point_that_exists():
    """Clarabel takes the large duals far from the data for a proof that no point exists."""
    for seed in (1, 4, 7, 12):
        problem = ranged(seed, scale=600.0)
        rng = np.random.default_rng(seed)
        angle, far = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(2e3, 8e3)
        posed = pose(problem, "hull")
        away = posed.position + far * np.array([np.cos(angle), np.sin(angle)])
        posed.add(cp.norm(away) <= 300.0, name="far")
        fix = posed.solve()
        assert fix.status in (Status.NUMERICAL, Status.UNREFINED)
        if fix.status == Status.NUMERICAL:
            assert "but there is a point" in str(fix.reason)


def test_failed_solves_are_statuses():
    problem = differences(1)
    posed = pose(problem, "hull")
    posed.add(posed.range <= -1.0, name="behind")
    fix = posed.solve()
    assert fix.status == Status.INFEASIBLE
    assert '"behind"' in str(fix.reason)
    assert np.isnan(fix.posed.value)
    assert np.isnan(fix.posed.duals["behind"])
    posed = pose(problem, "hull")
    posed.minimise(posed.position[0])
    fix = posed.solve()
    assert fix.status == Status.NUMERICAL
    assert "no least value" in str(fix.reason)
    stopped = pose(problem, "hull").solve(settings={"max_iter": 1})
    assert stopped.status == Status.NUMERICAL


def test_an_unbounded_objective_of_a_relaxation_has_no_position():
    posed = pose(differences(3, scale=600.0), "shor")
    posed.minimise(posed.position[0])
    fix = posed.solve()
    assert fix.status == Status.NUMERICAL
    assert "least value" in str(fix.reason)
    assert np.isnan(fix.position).all()

"""Canonicalised-once conic problems: equal to cvxpy, honest bounds, and the relaxations of squared ranges."""

import cvxpy as cp
import numpy as np
import pytest

from formulations import conic
from formulations.conic import Relaxation
from formulations.squared_range import cone, minimiser, paraboloid
from formulations.squared_range_conic import hull, hull_problem, shor


def mixed_problem():
    """A quadratic objective over all the cones: zero, nonnegative, second-order, semidefinite."""
    target, limit = cp.Parameter((3, 3), name="target"), cp.Parameter(3, name="limit")
    slope = cp.Parameter(name="slope")
    matrix = cp.Variable((3, 3), PSD=True, name="matrix")
    x, size = cp.Variable(3, name="x"), cp.Variable(name="size", nonneg=True)
    return cp.Problem(
        cp.Minimize(cp.sum_squares(matrix - target) + slope * size + x[0] + 2.5),
        [cp.trace(matrix) == 1.0, cp.norm(x) <= size, x >= limit, matrix[0, 1] == x[1]],
    )


def mixed_data(rng):
    return {"target": rng.normal(size=(3, 3)), "limit": -rng.random(3), "slope": np.array(1.5 + rng.random())}


def random_rows(seed, quadric):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(quadric.size + 2, quadric.size)), 2.0 * rng.normal(size=quadric.size + 2)


def test_warm_solves_equal_fresh_cvxpy_solves():
    rng = np.random.default_rng(0)
    warm = Relaxation(mixed_problem(), settings={"tol_gap_rel": 1e-10, "tol_gap_abs": 1e-10, "tol_feas": 1e-10})
    for _ in range(8):
        data = mixed_data(rng)
        fresh = mixed_problem()
        for parameter in fresh.parameters():
            parameter.value = data[parameter.name()]
        fresh.solve(solver=cp.CLARABEL)
        answer = warm.solve(data)
        assert answer.solved, answer.status
        assert answer.primal == pytest.approx(fresh.value, abs=1e-6)
        for variable in fresh.variables():
            assert answer.values[variable.name()].shape == variable.shape
            np.testing.assert_allclose(answer.values[variable.name()], variable.value, atol=1e-4)
        assert answer.bound <= fresh.value + 1e-6
        assert answer.bound == pytest.approx(fresh.value, abs=1e-5)


def test_zero_parameters_keep_the_structure():
    warm = Relaxation(mixed_problem())
    rng = np.random.default_rng(1)
    full = mixed_data(rng)
    before = warm.solve(full).primal
    empty = {name: np.zeros_like(value) for name, value in full.items()} | {"slope": np.array(2.0)}
    assert warm.solve(empty).solved
    assert warm.solve(full).primal == pytest.approx(before, abs=1e-9)


def test_bound_is_honest_when_the_solver_stops_early():
    rng = np.random.default_rng(2)
    exact = Relaxation(mixed_problem())
    for steps in (1, 2, 4, 6):
        early = Relaxation(mixed_problem(), settings={"max_iter": steps}, radius=20.0)
        data = mixed_data(rng)
        answer = early.solve(data)
        assert not answer.solved
        assert answer.bound <= exact.solve(data).primal + 1e-6


def test_infeasible_is_reported():
    x, p = cp.Variable(2, name="x"), cp.Parameter(2, name="p")
    warm = Relaxation(cp.Problem(cp.Minimize(cp.norm(x)), [x >= p, x <= -p]))
    answer = warm.solve({"p": np.ones(2)})
    assert not answer.solved
    assert "Infeasible" in answer.status
    assert warm.solve({"p": -np.ones(2)}).solved


def test_wrong_names_and_forms_are_refused():
    warm = Relaxation(mixed_problem())
    with pytest.raises(ValueError, match="expected"):
        warm.solve({"target": np.eye(3)})
    with pytest.raises(ValueError, match="target has shape"):
        warm.solve({"target": np.eye(2), "limit": np.zeros(3), "slope": np.array(1.0)})
    x, p = cp.Variable(2, name="x"), cp.Parameter(name="p")
    with pytest.raises(ValueError, match="DPP"):
        Relaxation(cp.Problem(cp.Maximize(p * cp.sum(x)), [cp.norm(x) <= 1]))


def test_other_back_ends_go_through_cvxpy():
    quadric = cone(2)
    B, g = random_rows(3, quadric)
    usual, other = shor(B, g, quadric), shor(B, g, quadric, backend="SCS")
    assert other.value == pytest.approx(usual.value, abs=1e-2 * (1 + usual.value))
    assert other.bound == -np.inf


@pytest.mark.parametrize("quadric", [cone(2), cone(3), paraboloid(2), paraboloid(3)], ids=str)
def test_shor_is_exact_and_the_hull_is_a_lower_bound(quadric):
    tight = 0
    for seed in range(12):
        B, g = random_rows(seed, quadric)
        y, ok = minimiser(B, g, quadric)
        half, _ = minimiser(B, g, quadric, positive=True)
        best, best_half = ((B @ y - g) ** 2).sum(), ((B @ half - g) ** 2).sum()
        lifted, relaxed = shor(B, g, quadric), hull(B, g, quadric)
        assert ok
        assert lifted.value == pytest.approx(best, abs=1e-6 * (1 + best))
        assert best - 1e-4 * (1 + best) <= lifted.bound <= best + 1e-8 * (1 + best)
        assert lifted.rank_ratio < 1e-4
        # the point of the lift has half the digits of the value
        np.testing.assert_allclose(lifted.y, y, atol=2e-3 * (1 + np.abs(y).max()))
        assert relaxed.value <= best_half + 1e-6 * (1 + best_half)
        assert relaxed.bound <= relaxed.value + 1e-8 * (1 + relaxed.value)
        if relaxed.rank_ratio < 1e-6:
            tight += 1
            assert relaxed.value == pytest.approx(best_half, abs=1e-5 * (1 + best_half))
    assert tight > 0


def test_tiny_and_huge_rows_are_scaled():
    B, g = random_rows(4, cone(3))
    base = shor(B, g, cone(3)).value
    for unit in (1e-4, 1e4):
        assert shor(unit * B, unit * g, cone(3)).value == pytest.approx(unit**2 * base, rel=1e-6)


def test_cone_projections():
    rng = np.random.default_rng(5)
    for _ in range(50):
        z = rng.normal(size=6)
        for project in (conic._second_order, lambda v: conic._semidefinite(v, 3)):
            once = project(z)
            np.testing.assert_allclose(project(once), once, atol=1e-12)
            # Moreau: what is cut off is orthogonal to what is left
            assert abs(once @ (z - once)) < 1e-12


@pytest.mark.parametrize("quadric", [cone(2), cone(3), paraboloid(2), paraboloid(3)])
@pytest.mark.parametrize("relax", [shor, hull])
def test_as_few_rows_as_coordinates_give_both_points(relax, quadric):
    """A line that meets the quadric twice: the relaxation ends between, and its points are the two."""
    rng, found, n = np.random.default_rng(quadric.size), 0, quadric.size
    for _ in range(20):
        ends = rng.uniform(-1.0, 1.0, (2, n))
        square = (ends[:, :-1] ** 2).sum(-1)
        ends[:, -1] = np.sqrt(square) if quadric.shape == "cone" else square
        B = np.linalg.qr(np.stack([ends[1] - ends[0], *rng.standard_normal((n - 1, n))]).T)[0].T[1:]
        points = relax(B, B @ ends[0], quadric).points
        there = points[np.isfinite(points).all(-1)]
        np.testing.assert_allclose(quadric.value(there), 0.0, atol=1e-5)
        np.testing.assert_allclose(there @ B.T, np.broadcast_to(B @ ends[0], (len(there), n - 1)), atol=1e-4)
        apart = np.abs(there[:, None] - ends).max(-1).min(0, initial=np.inf)
        found += (apart < 1e-3).all()
    assert found >= 15


def test_a_tight_answer_has_no_other_points():
    rng = np.random.default_rng(5)
    B, g = rng.standard_normal((8, 4)), rng.standard_normal(8)
    found = shor(B, g, cone(3))
    assert found.rank_ratio < 1e-6
    assert np.isnan(found.points).all()


def test_an_answer_has_the_report_and_the_duals_of_its_solve():
    rng = np.random.default_rng(3)
    data, tight = mixed_data(rng), {"tol_gap_rel": 1e-10, "tol_gap_abs": 1e-10, "tol_feas": 1e-10}
    warm, fresh = Relaxation(mixed_problem(), settings=tight), mixed_problem()
    for parameter in fresh.parameters():
        parameter.value = data[parameter.name()]
    fresh.solve(solver=cp.CLARABEL, **tight)
    answer = warm.solve(data)
    warm.solve(mixed_data(rng))  # a later solve does not change the duals of an answer
    assert (answer.report.backend, answer.report.outcome) == ("CLARABEL", "solved")
    assert answer.report.iterations == answer.iterations
    assert answer.report.worst < 1e-7
    assert answer.report.seconds > 0.0
    assert len(answer.duals) == len(fresh.constraints)
    for own, constraint in zip(answer.duals, fresh.constraints, strict=True):
        theirs = constraint.dual_value
        theirs = np.concatenate([np.ravel(part) for part in theirs]) if isinstance(theirs, list) else theirs
        np.testing.assert_allclose(own, theirs, atol=1e-5)


def test_another_back_end_has_a_report_and_duals_too():
    x, p = cp.Variable(2, name="x"), cp.Parameter(2, name="p")
    build = [cp.norm(x) <= 2.0, x >= p]
    usual, other = (Relaxation(cp.Problem(cp.Minimize(cp.sum(x)), build), backend=name) for name in ("CLARABEL", "SCS"))
    one, two = usual.solve({"p": np.zeros(2)}), other.solve({"p": np.zeros(2)})
    assert (two.report.backend, two.report.outcome, two.status) == ("SCS", "solved", "optimal")
    for own, theirs in zip(one.duals, two.duals, strict=True):
        np.testing.assert_allclose(own, theirs, atol=1e-3)
    none = other.solve({"p": np.full(2, 5.0)})
    assert none.report.outcome == "infeasible"
    assert none.duals == ()


def test_a_multiplier_of_the_hull_is_cost_per_unit():
    """The hull is posed with the squared norm: the derivative of the value by the right side of the cone."""
    rng = np.random.default_rng(0)
    B, g = rng.normal(size=(5, 3)), 2.0 * rng.normal(size=5)
    problem, values = hull_problem(cone(2)), []
    (y,), (factor,) = problem.variables(), problem.parameters()
    factor.value = np.linalg.qr(np.column_stack([B, -g]), mode="r")
    for step in (-1e-3, 0.0, 1e-3):
        moved = cp.Problem(problem.objective, [cp.norm(y[:-1]) - y[-1] <= step])
        moved.solve(solver=cp.CLARABEL, tol_gap_rel=1e-12, tol_gap_abs=1e-12, tol_feas=1e-12)
        values.append((moved.value, float(moved.constraints[0].dual_value)))
    assert values[1][1] > 0.0
    assert (values[0][0] - values[2][0]) / 2e-3 == pytest.approx(values[1][1], rel=1e-4)

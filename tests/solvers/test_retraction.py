"""Descents along faces that never leave them, and projections."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, ranges_to

from optloc import Motion, Status, assemble, constraints, measured, simulate, solve
from optloc.linear.constraints import faces
from optloc.solvers.retraction import descend_along, is_on, projected


def held(*bounds):
    return replace(ranges_to(PLACE, 2.0), constraints=tuple(bounds))


def test_a_projection_is_on_the_face():
    problem = held(*constraints.disc([0.0, 0.0], 100.0))
    side = faces(problem)[1]
    x = projected(problem, side, np.array([[300.0, 400.0]]), np.eye(2)[None])
    np.testing.assert_allclose(x, [[60.0, 80.0]], atol=1e-6)
    assert is_on(problem, side, x).tolist() == [True]
    assert is_on(problem, side, x + 1.0).tolist() == [False]


def test_a_descent_ends_where_a_scan_of_the_circle_is_least():
    problem = held(*constraints.disc([0.0, 0.0], 100.0))
    x, cost, code = descend_along(problem, faces(problem)[1], np.array([[100.0, 30.0]]))
    assert code.tolist() == [Status.OK]
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    circle = 100.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pool = solve(problem)
    assert cost[0] == pytest.approx(float(pool.cost[0]), rel=1e-6)
    assert np.linalg.norm(circle - x, axis=1).min() < 0.05


def test_a_start_that_cannot_be_on_the_face_is_refused():
    problem = held(*constraints.disc([0.0, 0.0], 10.0), *constraints.disc([900.0, 0.0], 10.0))
    both = next(side for side in faces(problem) if len(side) == 2)
    assert descend_along(problem, both, PLACE[None])[2].tolist() == [Status.NUMERICAL]


def test_a_course_that_rests_and_returns_has_a_fix_under_a_turn_rate():
    """The turn rate has no limit where the course rests, and the data say that it rests during the run."""
    stations = np.array([[-400.0, -300.0], [500.0, -350.0], [450.0, 400.0], [-350.0, 450.0], [20.0, -60.0]])
    rows = measured("range", a=np.tile(np.arange(5), 6), sigma=10.0, epoch=np.repeat(np.arange(6), 5))
    template = assemble(
        stations, rows, times=2.0 * np.arange(6), motions=[Motion(2)], constraints=constraints.turn_rate(0.004)
    )
    truth = [-126.0, 187.0, 1.0, 2.0, -0.9, -1.4]
    fix = solve(simulate(template, truth=truth, seed=1))
    assert fix.status != Status.INFEASIBLE
    assert np.isfinite(fix.x).all()
    v, a = fix.x[2:4], fix.x[4:6]
    slowest = v + np.clip(-(v @ a) / (a @ a), 0.0, 10.0) * a
    assert abs(v[0] * a[1] - v[1] * a[0]) <= 0.004001 * (slowest @ slowest) + 1e-12

"""What machine code says of admitted positions: the same as arrays do, and as differences say of gradients."""

from dataclasses import replace

import numpy as np
import pytest
from cases import ENU

import optloc
from optloc import assemble, measured
from optloc.base.types import Band
from optloc.engine.admission import admission_of, levels_of
from optloc.engine.plan import plan_of
from optloc.kernels import jit
from optloc.linear.constraints import box, height, violation, visible
from optloc.models.primitives import WGS84_A
from optloc.solvers.horizon import is_hidden

pytestmark = pytest.mark.skipif(not jit.enabled(), reason="there are no plans without machine code")
STATIONS = np.array([[0.0, 0, 0], [10e3, 0, 600], [0, 10e3, 300], [10e3, 10e3, 0], [5e3, 5e3, 900], [2e3, 7e3, 100]])


def posed(constraints=(), **more):
    rows = measured("tdoa", np.zeros(5), a=np.arange(1, 6), b=0, arrival_sigma=5.0)
    return assemble(STATIONS, rows, constraints=constraints, frame=ENU, **more)


def run_at(problem, x):
    """Return what a plan says of starts from which it does not move: positions (N, 3) are refined to themselves."""
    r = np.sqrt(((STATIONS - x[:, None]) ** 2).sum(-1))
    flat = problem.with_rows(z=r[:, 1:] - r[:, :1]).flat()
    plan = plan_of(flat)
    return plan.run(plan.load(flat), flat.z, start=x)[0], flat


def places(count=60):
    rng = np.random.default_rng(3)
    return np.concatenate([rng.uniform(-2e4, 3e4, (count, 2)), rng.uniform(-2e3, 6e3, (count, 1))], axis=1)


@pytest.mark.parametrize(
    "constraints",
    [
        height(0.0),
        height(-100.0, 3000.0),
        box([-5e3, -1e4, 0.0], [2e4, np.inf, 4e3]),
        (*box([-5e3, -1e4, -1e4], [2e4, 2e4, 4e3]), *height(0.0)),
        visible(ENU.to_ecef(np.array([[1e4, 0.0, 3e4]])), elevation=0.9),
    ],
)
def test_bounds_are_those_of_arrays(constraints):
    problem, x = posed(constraints), places()
    found, flat = run_at(problem, x)
    apart = np.sqrt(((found.x - x) ** 2).sum(-1))
    assert (apart < 1e-3).mean() > 0.9  # the others are flat, and go elsewhere
    still = apart < 1e-3
    inside = violation(flat, x) <= 1e-6
    free, _ = run_at(posed(), x)
    assert inside[still].any()
    assert not inside[still].all()
    assert np.array_equal(found.settled[still], (free.settled & inside)[still])


def test_values_and_gradients_are_those_of_differences():
    problem, x = posed((*height(0.0), *box([-1e5, -1e5, -1e5], [1e5, 1e5, 1e5]))), places(20)
    found, _ = run_at(problem, x)
    there, step = found.x, 1.0
    up = ENU.to_geodetic(there)[2]
    np.testing.assert_allclose(found.quantity[:, 0], up, atol=1e-6)
    np.testing.assert_allclose(found.quantity[:, 1:], there, atol=1e-9)
    for j in range(3):
        more, less = (ENU.to_geodetic(there + side * step * np.eye(3)[j])[2] for side in (1.0, -1.0))
        np.testing.assert_allclose(found.normal[:, 0, j], (more - less) / (2.0 * step), atol=1e-6)


def test_the_earth_hides_what_arrays_say_it_does():
    """Satellites, and positions all around the Earth."""
    rng = np.random.default_rng(5)
    stations = np.array([0.0, 0.0, 1.0]) + 0.1 * rng.standard_normal((5, 3))
    stations *= (WGS84_A + 7e5) / np.sqrt((stations**2).sum(-1, keepdims=True))
    x = rng.standard_normal((80, 3))
    x *= WGS84_A / np.sqrt((x**2).sum(-1, keepdims=True))
    r = np.sqrt(((stations - x[:, None]) ** 2).sum(-1))
    problem = assemble(stations, measured("range", r, a=np.arange(5), sigma=10.0), frame=optloc.problem.ECEF).flat()
    plan = plan_of(problem)
    found, _ = plan.run(plan.load(problem), problem.z, start=x)
    hidden = is_hidden(problem, x)
    assert hidden.any()
    assert not hidden.all()
    assert np.array_equal(found.settled, ~hidden)


def test_exact_sides_come_first_and_levels_with_them():
    held = Band("plane", np.array([1.0, 2.0]), np.array([1.0, 2.0]), np.eye(3)[2], "z")
    problem = posed((*height(0.0), held))
    found = admission_of(problem)
    assert found.exact == 1
    assert np.array_equal(levels_of(problem)[:, 0], [[1.0, 1.0], [2.0, 2.0]])
    assert np.array_equal(levels_of(problem)[:, 1], [[0.0, np.inf]] * 2)


def test_a_band_that_is_exact_in_some_problems_only_holds_none():
    band = Band("plane", np.array([900.0, -1e5]), np.array([900.0, 1e5]), np.eye(3)[2], "z")
    truth = np.array([3e3, 4e3, 1500.0])
    r = np.sqrt(((STATIONS - truth) ** 2).sum(-1))
    problem = posed((band,)).with_rows(z=np.tile(r[1:] - r[:1], (2, 1)))
    assert plan_of(problem).model.admission.exact == 0
    fix = optloc.solve(problem, "gtrs+lsr")
    np.testing.assert_allclose(fix.position[1], truth, atol=1e-3)
    np.testing.assert_allclose(fix.position[0, 2], 900.0, atol=1e-6)


def test_what_has_no_tape_has_no_plan():
    from optloc.linear.constraints import polygon

    problem = posed(polygon([[0.0, 0.0], [1e4, 0.0], [0.0, 1e4]]))
    assert plan_of(problem) is None
    speed = Band("speed", np.array(0.0), np.array(3.0), np.zeros(0), "speed")
    assert admission_of(replace(posed(), constraints=(speed,))) is None

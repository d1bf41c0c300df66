"""Derivatives of a cost with an unknown factor, against differences of costs by formulas of their own."""

import numpy as np
import pytest
from proof.scaled.test_reduction import Look, profiled
from waves import plate

from optloc.proof.curvature import G0
from optloc.proof.scaled.joint_curvature import clip_stationary, factor_of, is_convex_scaled, slope_of, sum_scaled
from optloc.proof.scaled.reduction import bound_factors

pytestmark = pytest.mark.usefixtures("plainly")


@pytest.fixture
def look():
    return Look(plate(np.random.default_rng(3), 2, 6, 0.1))


def beside_the_best(look, off=0.05):
    """Return coordinates in the inside of the cube, off those of the best place."""
    best = look.scene.minima(np.random.default_rng(0), 8)[0][1][:2]
    return np.append((best - look.atlas.middle[:2]) / look.atlas.radius + off, 0.0)


def filled(look, at, half, rho):
    box = look.fill(4, at, half)  # the inside of the cube
    assert bound_factors(look.scaled, rho, box, look.tables.sheet)
    return box, look.tables.sheet


def test_the_gradient_is_that_of_the_cost_over_the_position(look):
    at = beside_the_best(look)
    rho = np.sqrt(profiled(look.scene, look.places(4, at, np.zeros((1, 3))))[0][0]) + 1.0
    box, sheet = filled(look, at, np.zeros(3), rho)
    assert sum_scaled(look.scaled, False, box, sheet) < np.inf
    steps = 1e-5 * np.eye(3)[:2]
    up, down = (profiled(look.scene, look.places(4, at, sign * steps))[0] for sign in (1.0, -1.0))
    slope = box.sums[G0 : G0 + 2].copy()
    np.testing.assert_allclose(2.0 * slope, (up - down) / 2e-5, rtol=1e-3)
    factor = profiled(look.scene, look.places(4, at, np.zeros((1, 3))))[1][0]
    assert factor_of(look.scaled, sheet, 0) == pytest.approx(factor, rel=1e-6)
    assert slope_of(box, 1e-3) >= 1e3 * (slope**2).sum()


def test_the_best_place_is_convex_and_never_clipped_away(look):
    at = beside_the_best(look, 0.0)
    half = np.array([1e-4, 1e-4, 0.0])
    box, sheet = filled(look, at, half, 5.0)
    assert is_convex_scaled(look.scaled, 0.0, box, sheet)
    assert clip_stationary(look.scaled, box, sheet)


def test_a_slope_has_no_stationary_point(look):
    at = beside_the_best(look)
    rho = np.sqrt(profiled(look.scene, look.places(4, at, np.zeros((1, 3))))[0][0]) + 1.0
    box, sheet = filled(look, at, np.array([1e-4, 1e-4, 0.0]), rho)
    assert not clip_stationary(look.scaled, box, sheet)

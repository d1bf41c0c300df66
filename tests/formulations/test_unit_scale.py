"""Origins and units: exact changes of variables, and bounds that hold in any unit of length."""

from dataclasses import replace

import numpy as np
import pytest
from often import few
from ranged import drawn, minimum

from formulations.doppler_sdp import doppler
from formulations.lifted import lifted_ranges
from formulations.minimax_cone import common, extent, minimax
from formulations.moment_sdp import moment_bound
from formulations.nuclear_norm import nuclear_offsets
from formulations.range_enclosure import enclosure
from formulations.range_height import Ellipsoid
from formulations.range_height_conic import lift
from formulations.sparse_errors import sparse_fit, square_cone
from formulations.squared_range import cone, minimiser, paraboloid
from formulations.squared_range_conic import hull, shor
from formulations.unit_scale import PointScale, RowScale, power_of_two

UNITS = (1e-3, 1e6, 1.0, 1e3)
# The error of a solver's value at its tolerance of 1e-10, relative to the squares of the rows.
ROUNDING = 1e-7


def squared_ranges(seed, unit, shape, shift=0.0):
    """Whitened rows of ranges (paraboloid) or range differences (cone) with errors of 2 % of the unit."""
    rng = np.random.default_rng(seed)
    d = 2 + seed % 2
    a, x = rng.uniform(-1, 1, (d + 3, d)), rng.uniform(-1, 1, d)
    r = unit * (np.linalg.norm(a - x, axis=1) + 0.02 * rng.normal(size=d + 3))
    a, sigma = unit * (a + shift), 0.02 * unit
    if shape == "paraboloid":
        B, g, spread = np.column_stack([-2 * a, np.ones(d + 3)]), r**2 - (a**2).sum(1), 2 * r * sigma
    else:
        away, c = a[1:] - a[0], r[1:] - r[0]
        B, g = np.column_stack([2 * away, 2 * c]), (away**2).sum(1) - c**2
        spread = 2 * np.maximum(r[1:], 0.05 * unit) * sigma
    return B / spread[:, None], g / spread, (paraboloid if shape == "paraboloid" else cone)(d)


@pytest.mark.parametrize("unit", few(UNITS, 2))
@pytest.mark.parametrize("shape", ["paraboloid", "cone"])
def test_no_dual_bound_is_above_the_optimum(shape, unit):
    """The optimum by the GTRS, which solves no cone program; outside unit scale all bounds were above it."""
    gaps = []
    for seed in range(50):
        B, g, quadric = squared_ranges(seed, unit, shape)
        y, _ = minimiser(B, g, quadric)
        half, _ = minimiser(B, g, quadric, positive=shape == "cone")
        best, best_half = ((B @ y - g) ** 2).sum(), ((B @ half - g) ** 2).sum()
        full, relaxed = shor(B, g, quadric), hull(B, g, quadric)
        assert full.bound <= best + ROUNDING * (1.0 + best)
        assert relaxed.bound <= best_half + ROUNDING * (1.0 + best_half)
        assert relaxed.bound <= relaxed.value + ROUNDING * (1.0 + relaxed.value)
        gaps.append((best - full.bound) / (1.0 + best))
    assert max(gaps) < 1e-3
    assert np.median(gaps) < 1e-5


@pytest.mark.parametrize("relax", [shor, hull])
@pytest.mark.parametrize("shape", ["paraboloid", "cone"])
def test_points_do_not_depend_on_the_unit_or_the_origin(shape, relax):
    for seed in range(6):
        base = relax(*squared_ranges(seed, 1.0, shape))
        for unit in UNITS:
            found = relax(*squared_ranges(seed, unit, shape))
            np.testing.assert_allclose(found.y[:-1] / unit, base.y[:-1], atol=2e-3)
            assert found.value == pytest.approx(base.value, rel=1e-4, abs=1e-5)
        if shape == "paraboloid":
            moved = relax(*squared_ranges(seed, 1e3, shape, shift=300.0))
            np.testing.assert_allclose(moved.y[:-1] / 1e3 - 300.0, base.y[:-1], atol=2e-3)
            assert moved.y[-1] == pytest.approx((moved.y[:-1] ** 2).sum(), rel=1e-3)


@pytest.mark.parametrize("shape", ["paraboloid", "cone"])
def test_rows_for_new_unknowns_are_the_same_rows(shape):
    rng = np.random.default_rng(0)
    for seed in range(10):
        B, g, quadric = squared_ranges(seed, 37.0, shape, shift=2.0)
        own = RowScale.of(B, g, quadric)
        left, right = own.rows(B, g)
        new = rng.normal(size=(4, quadric.size))
        old = own.back(new)
        np.testing.assert_allclose(old @ B.T - g, new @ left.T - right, rtol=1e-9, atol=1e-9 * np.abs(g).max())
        # the quadric is kept: its value is only multiplied by the square of the unit
        np.testing.assert_allclose(quadric.value(old), own.unit**2 * quadric.value(new), atol=1e-9 * own.unit**2 * 50)
        assert 0.1 < np.abs(left).max(0).max() / np.abs(right).max() < 30.0


def test_rows_without_a_size_have_the_unit_one():
    for quadric in (cone(2), paraboloid(2)):
        own = RowScale.of(np.zeros((3, 3)), np.zeros(3), quadric)
        assert own.unit == 1.0
        np.testing.assert_array_equal(own.back(np.ones(3)), np.ones(3))


def test_points_are_centred_and_have_extent_one():
    rng = np.random.default_rng(1)
    for unit in UNITS:
        points = unit * (rng.normal(size=(7, 3)) + 40.0)
        own = PointScale.of(points)
        new = own.scaled(points)
        assert 0.5 < np.sqrt((new**2).sum(1).mean()) < 2.0
        np.testing.assert_allclose(new.mean(0), 0.0, atol=1e-12)
        np.testing.assert_allclose(own.back(new), points, rtol=1e-12)
    assert PointScale.of(np.ones((2, 3))).unit == 1.0
    assert [power_of_two(length) for length in (0.0, np.nan, 1.1, 1000.0)] == [1.0, 1.0, 1.0, 1024.0]


@pytest.mark.parametrize("seed", few(range(50), 5, 1))
def test_other_formulations_do_not_depend_on_the_unit(seed):
    rng = np.random.default_rng(seed)
    S, P = rng.uniform(-1, 1, (6, 3)), rng.uniform(-1.5, 1.5, 3)
    z = np.linalg.norm(P - S, axis=1) + 0.03 * rng.normal(size=6)
    u = P - S + 0.02 * rng.normal(size=S.shape)
    u /= np.linalg.norm(u, axis=1)[:, None]
    theta, sides = np.full(6, 0.05), np.concatenate([np.eye(3), -np.eye(3)])
    pulses = rng.uniform(-1, 1, (8, 5))
    rows = np.column_stack([-2.0 * S, np.ones(6)]) / (2 * z * 0.03)[:, None]
    right = (z**2 - (S**2).sum(1)) / (2 * z * 0.03)

    def all_of_them(unit):
        shift = 5.0 * unit
        centre = S * unit + shift
        ball, fix = common(u, centre, theta), minimax(u, centre, theta)
        lift = lifted_ranges(np.eye(6) / (0.03 * unit), z / 0.03, centre)
        sparse = sparse_fit(
            rows * np.array([1 / unit] * 3 + [1 / unit**2]), right, cones=[square_cone(3, 4, 3)], bound=True
        )
        nuclear = nuclear_offsets(pulses * unit, 2, passes=1)
        assert lift.bound <= (((np.linalg.norm(P - S, axis=1) - z) / 0.03) ** 2).sum() + 1e-6
        assert sparse.bound <= sparse.value * (1.0 + 1e-6)
        assert nuclear.bound <= nuclear.value * (1.0 + 1e-6)
        assert fix.least <= fix.level
        exact = [
            [ball.margin / unit, ball.most / unit, sparse.value, sparse.bound],
            [nuclear.value / unit**2, nuclear.bound / unit**2],
            (extent(u, centre, theta, sides) - sides.sum(1) * shift) / unit,
        ]
        # a baseline near a cost of zero, and a bisection that ends where the solver cannot decide
        loose = [[lift.value, lift.bound, fix.level], (fix.point - shift) / unit]
        return np.concatenate(exact), np.concatenate(loose)

    exact, loose = all_of_them(1.0)
    for unit in (1e-3, 1e3, 1e6):
        found = all_of_them(unit)
        np.testing.assert_allclose(found[0], exact, rtol=2e-4, atol=2e-4)
        np.testing.assert_allclose(found[1], loose, rtol=3e-2, atol=1e-2)


@pytest.mark.parametrize("unit", few([1e-3, 1e6, 1e3], 2))
def test_formulations_that_scale_their_own_numbers(unit):
    """Moments in a box, Doppler shifts, a fix on an ellipsoid: the same answer, and no bound above a point's cost."""
    rng = np.random.default_rng(4)
    ranged, truth = drawn(rng, "difference", 5, 2, 1e-3)
    x, cost = minimum(ranged, truth, rng)
    larger = replace(
        ranged, station=ranged.station * unit, offset=ranged.offset * unit, covariance=ranged.covariance * unit**2
    )
    boxes = enclosure(ranged, x, cost + 0.1), enclosure(larger, x * unit, cost + 0.1)
    assert None not in boxes
    base, found = moment_bound(ranged, boxes[0], cost + 0.1), moment_bound(larger, boxes[1], cost + 0.1)
    assert found.bound <= cost + 1e-9 * (1.0 + cost)
    assert found.bound == pytest.approx(base.bound, abs=1e-5)

    place, speed, source = rng.uniform(-1, 1, (7, 2)), rng.normal(size=(7, 2)), rng.uniform(-3, 3, 2)
    away = source - place
    rate = -(away * speed).sum(1) / np.linalg.norm(away, axis=1)
    rates = np.eye(7)[1:] - np.eye(7)[0]
    z, white = rates @ rate + 1e-3 * rng.normal(size=6), np.eye(6) / 1e-3

    def start(scale):
        return doppler(place * scale, speed * scale, z * scale, white / scale, ranges=np.zeros((6, 7)), rates=rates)

    base, found = start(1.0), start(unit)
    np.testing.assert_allclose(found.point / unit, base.point, rtol=1e-3, atol=1e-3)
    assert found.bound == pytest.approx(base.bound, rel=1e-3, abs=1e-3)

    satellites = np.array([[1.2, 0.1, 0.1], [1.15, -0.3, 0.2], [1.1, 0.2, -0.4]])
    fix = np.array([0.98, 0.05, 0.0]) / np.linalg.norm([0.98, 0.05, 0.0])
    offset = np.linalg.norm(fix - satellites, axis=1)
    near = satellites.mean(0) / np.linalg.norm(satellites.mean(0))
    for scale in (1.0, unit):
        surface = Ellipsoid(np.eye(3) / scale**2, np.zeros(3))
        lifted = lift(satellites * scale, np.ones(3), (offset - offset[0]) * scale, surface, near * scale)
        np.testing.assert_allclose(lifted.x / scale, fix, atol=1e-5)
        cost = ((fix - near) ** 2).sum() + (offset[0] - np.linalg.norm(near - satellites[0])) ** 2
        assert lifted.bound / scale**2 <= cost + 1e-8

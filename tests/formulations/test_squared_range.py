"""Squared-range least squares: exactness, completeness of the stationary points, invariance and failure."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.optimize import minimize

from formulations.secular import Secular, everything, largest
from formulations.squared_range import _descend, _points, cone, minimiser, paraboloid, stationary


def tdoa(seed, count, stations, d, sigma, spread=2.0, flat=False):
    """Rows, right sides and true y of range-difference problems with the first station as reference."""
    rng = np.random.default_rng(seed)
    s, x = rng.uniform(-1, 1, (count, stations, d)), rng.uniform(-spread, spread, (count, d))
    if flat:
        s[..., -1] = 0.0
    r = np.linalg.norm(x[:, None] - s, axis=-1)
    z = r[:, 1:] - r[:, :1] + sigma * rng.normal(size=(count, stations - 1))
    a = s[:, 1:] - s[:, :1]
    B = np.concatenate([2 * a, 2 * z[..., None]], axis=-1)
    return B, (a**2).sum(-1) - z**2, np.concatenate([x - s[:, 0], r[:, :1]], axis=-1)


def ranges(seed, count, stations, d, sigma, flat=False):
    rng = np.random.default_rng(seed)
    s, x = rng.uniform(-1, 1, (count, stations, d)), rng.uniform(-2, 2, (count, d))
    if flat:
        s[..., -1] = 0.0
    z = np.linalg.norm(x[:, None] - s, axis=-1) + sigma * rng.normal(size=(count, stations))
    B = np.concatenate([-2 * s, np.ones((count, stations, 1))], axis=-1)
    return B, z**2 - (s**2).sum(-1), np.concatenate([x, (x**2).sum(-1, keepdims=True)], axis=-1)


def cost_of(B, g, y):
    return ((np.einsum("...qn,...n->...q", B, y) - g) ** 2).sum(-1)


def random_problem(rng, quadric, q):
    return rng.normal(size=(q, quadric.size)), 2.0 * rng.normal(size=q)


def gradient_left(B, g, y, quadric):
    """Norm of the part of the gradient along the quadric's surface."""
    slope = B.T @ (B @ y - g)
    normal = quadric.square * y + quadric.linear
    return np.linalg.norm(slope - normal * (normal @ slope) / (normal @ normal))


SHAPES = [cone(2), cone(3), paraboloid(2), paraboloid(3)]
NAMES = ["cone2", "cone3", "paraboloid2", "paraboloid3"]
quadrics = pytest.mark.parametrize("quadric", SHAPES, ids=NAMES)


@pytest.mark.parametrize("d", [2, 3])
def test_noise_free_tdoa_gives_the_truth(d):
    B, g, truth = tdoa(1, 400, d + 2, d, 0.0)
    y, ok = minimiser(B, g, cone(d))
    assert ok.all()
    np.testing.assert_allclose(y, truth, atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_noise_free_ranges_give_the_truth(d):
    B, g, truth = ranges(2, 400, d + 1, d, 0.0)
    y, ok = minimiser(B, g, paraboloid(d))
    assert ok.all()
    np.testing.assert_allclose(y, truth, atol=1e-9)


@pytest.mark.parametrize(("make", "quadric"), [(tdoa, cone), (ranges, paraboloid)], ids=["tdoa", "ranges"])
@pytest.mark.parametrize("d", [2, 3])
def test_minimal_problems_list_both_solutions(make, quadric, d):
    args = (d + 1, d, 0.0) if make is tdoa else (d, d, 0.0)
    B, g, truth = make(3, 500, *args)
    y, cost, valid = stationary(B, g, quadric(d))
    error = np.nanmin(np.linalg.norm(y - truth[:, None], axis=-1), axis=1)
    # a double root loses half of the digits
    assert (error < 1e-9).mean() > 0.99
    assert error.max() < 1e-5
    assert valid.any(1).all()
    exact = (valid & (cost < 1e-18)).sum(1)
    assert (exact == 2).mean() > 0.95
    assert (exact >= 1).mean() > 0.99


@pytest.mark.parametrize(("make", "quadric"), [(tdoa, cone), (ranges, paraboloid)], ids=["tdoa", "ranges"])
def test_flat_networks_list_the_mirror(make, quadric):
    B, g, truth = make(4, 200, 6, 3, 0.0, flat=True)
    y, _, _ = stationary(B, g, quadric(3))
    mirror = truth * np.array([1.0, 1.0, -1.0, 1.0])
    for point in (truth, mirror):
        error = np.nanmin(np.linalg.norm(y - point[:, None], axis=-1), axis=1)
        assert np.quantile(error, 0.98) < 1e-9
        assert error.max() < 1e-5


def test_solution_lines_almost_on_the_cone_are_met():
    B, g, truth = tdoa(1, 20000, 3, 2, 0.0)
    y, _, _ = stationary(B, g, cone(2))
    error = np.nanmin(np.linalg.norm(y - truth[:, None], axis=-1), axis=1)
    assert error.max() < 1e-5
    assert minimiser(B, g, cone(2))[1].mean() == 1.0


def test_nearly_flat_networks_are_graceful():
    B, _, truth = tdoa(5, 100, 6, 3, 0.0)
    for height in 10.0 ** -np.arange(2.0, 12.0):
        tilt = B.copy()
        tilt[..., 2] *= height
        right = np.einsum("nqi,ni->nq", tilt, truth)
        y, cost, valid = stationary(tilt, right, cone(3))
        error = np.nanmin(np.linalg.norm(y - truth[:, None], axis=-1), axis=1)
        assert valid.any(1).all()
        assert np.median(error) < 1e-6
        assert cost[:, 0].max() < 1e-12


@quadrics
def test_two_missing_ranks_give_nothing(quadric):
    rng = np.random.default_rng(6)
    n = quadric.size
    B = rng.normal(size=(20, 6, n - 2)) @ rng.normal(size=(20, n - 2, n))
    g = rng.normal(size=(20, 6))
    assert not minimiser(B, g, quadric)[1].any()
    assert not stationary(B, g, quadric)[2].any()
    y, ok = minimiser(np.zeros((4, n)), np.zeros(4), quadric)
    assert not ok
    assert np.isnan(y).all()


def test_minimum_in_the_plane_against_dense_search():
    rng = np.random.default_rng(7)
    angle = np.linspace(-np.pi, np.pi, 4001)
    direction = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)])
    for _ in range(60):
        B, g = random_problem(rng, cone(2), 5)
        column = B @ direction
        # the cost is a parabola in the range along each bearing
        r = column.T @ g / (column**2).sum(0)
        cost = ((column * r - g[:, None]) ** 2).sum(0)
        y, _ = minimiser(B, g, cone(2))
        assert cost_of(B, g, y) <= cost.min() + 1e-12
        assert cost_of(B, g, y) >= cost.min() - 1e-3 * (1 + cost.min())
        half, _ = minimiser(B, g, cone(2), positive=True)
        assert half[-1] >= 0.0
        cost = ((column * np.maximum(r, 0.0) - g[:, None]) ** 2).sum(0)
        np.testing.assert_allclose(cost_of(B, g, half), cost.min(), rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("quadric", [cone(3), paraboloid(3)], ids=["cone", "paraboloid"])
def test_minimum_in_space_against_scipy(quadric):
    rng = np.random.default_rng(8)
    for _ in range(12):
        B, g = random_problem(rng, quadric, 6)
        best = np.inf
        for _ in range(6):
            found = minimize(
                lambda y, B=B, g=g: ((B @ y - g) ** 2).sum(),
                rng.normal(size=4),
                jac=lambda y, B=B, g=g: 2 * B.T @ (B @ y - g),
                constraints={
                    "type": "eq",
                    "fun": quadric.value,
                    "jac": lambda y: 2 * (quadric.square * y + quadric.linear),
                },
                method="SLSQP",
                options={"maxiter": 300, "ftol": 1e-13},
            )
            if found.success and abs(quadric.value(found.x)) < 1e-8:
                best = min(best, found.fun)
        y, ok = minimiser(B, g, quadric)
        assert ok
        assert abs(quadric.value(y)) < 1e-9 * (1 + y @ y)
        np.testing.assert_allclose(cost_of(B, g, y), best, rtol=1e-6)


@quadrics
def test_every_stationary_point_is_one_and_sorted(quadric):
    rng = np.random.default_rng(9)
    B, g = rng.normal(size=(300, 6, quadric.size)), 2 * rng.normal(size=(300, 6))
    y, cost, valid = stationary(B, g, quadric)
    assert y.shape == (300, 2 * quadric.size - 1, quadric.size)
    with np.errstate(invalid="ignore"):
        assert not (np.diff(cost, axis=1) < 0).any()
    best, ok = minimiser(B, g, quadric)
    assert ok.all()
    np.testing.assert_allclose(cost[:, 0], cost_of(B, g, best), rtol=1e-10)
    for i, k in zip(*np.nonzero(valid), strict=True):
        point = y[i, k]
        assert cost[i, k] == pytest.approx(cost_of(B[i], g[i], point), rel=1e-12)
        assert abs(quadric.value(point)) < 1e-9 * (1 + point @ point)
        if np.any(point):
            assert gradient_left(B[i], g[i], point, quadric) < 1e-8 * (1 + np.linalg.norm(B[i]) ** 2)


@quadrics
def test_no_stationary_point_is_missed(quadric):
    """Many Newton starts on the optimality conditions find nothing that is not listed."""
    rng = np.random.default_rng(10)
    n, seen = quadric.size, 0
    for _ in range(12):
        B, g = random_problem(rng, quadric, n + 1)
        # a fit inside the quadric has many stationary points around it
        g = 0.3 * g + B[:, -1] * (4.0 if quadric.shape == "cone" else 8.0)
        y, _, valid = stationary(B, g, quadric)
        A, b = B.T @ B, B.T @ g
        point, factor = 3 * rng.normal(size=(400, n)), 3 * np.linalg.norm(A, 2) * rng.normal(size=400)
        for _ in range(40):
            normal = quadric.square * point + quadric.linear
            matrix = np.zeros((400, n + 1, n + 1))
            matrix[:, :n, :n] = A + factor[:, None, None] * np.diag(quadric.square)
            matrix[:, :n, n] = matrix[:, n, :n] = normal
            right = np.concatenate(
                [b - point @ A - factor[:, None] * normal, -0.5 * quadric.value(point)[:, None]], axis=1
            )
            step = np.linalg.solve(matrix + 1e-14 * np.eye(n + 1), right[..., None])[..., 0]
            point, factor = point + step[:, :n], factor + step[:, n]
        normal = quadric.square * point + quadric.linear
        slope = point @ A - b + factor[:, None] * normal
        good = (np.abs(slope).max(1) < 1e-9) & (np.abs(quadric.value(point)) < 1e-9) & (np.abs(normal).max(1) > 1e-3)
        assert good.any()
        apart = np.linalg.norm(point[good, None] - y[valid][None], axis=-1).min(1)
        assert (apart < 1e-6 * (1 + np.linalg.norm(point[good], axis=1))).all()
        seen += len(np.unique(point[good].round(5), axis=0))
    assert seen >= 24


@quadrics
def test_both_ways_to_the_multiplier_end_at_the_same_point(quadric):
    """Newton on the multiplier where it settles, and the root above the last pole: the global minimiser."""
    make = tdoa if quadric.shape == "cone" else ranges
    B, g, _ = make(8, 2000, 7, quadric.size - 1, 0.05)
    y, settled = _descend(np.moveaxis(B, 0, -1).copy(), g.T.copy(), quadric.square, quadric.linear)
    other, _, valid = _points(B, g, quadric, largest)
    assert settled.mean() > 0.6
    assert valid[settled].all()
    away = np.abs(y.T - other[:, 0]).max(1)[settled]
    assert (away <= 1e-9 * (1.0 + np.abs(other[settled, 0]).max(1))).all()


@pytest.mark.parametrize("d", [2, 3])
def test_secular_roots_are_those_of_the_polynomial(d):
    rng = np.random.default_rng(11)
    count = 200
    pole = np.sort(rng.uniform(-2, 0, (d, count)), axis=0)
    weight, level, slope = rng.exponential(size=(d, count)), rng.normal(size=count), rng.exponential(size=count)
    slope[::2], level[::2] = 0.0, np.abs(level[::2])
    gap = pole[None] - pole[:, None]
    roots = everything(Secular(gap, pole, weight, level, slope))
    for i in range(count):
        square = [np.poly1d([1.0, -p]) ** 2 for p in pole[:, i]]
        total = np.poly1d([slope[i], level[i]])
        for factor in square:
            total *= factor
        for j in range(d):
            part = np.poly1d([weight[j, i]])
            for k in range(d):
                part = part if k == j else part * square[k]
            total -= part
        listed = total.roots
        real = np.sort(listed[np.abs(listed.imag) < 1e-7].real)
        found = np.sort(roots.t[roots.found[:, i], i])
        np.testing.assert_allclose(found, real, rtol=1e-5, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    scale=st.floats(1e-3, 1e3),
    angle=st.floats(-3.0, 3.0),
    which=st.sampled_from(range(4)),
)
def test_rotation_and_scale_do_not_matter(seed, scale, angle, which):
    quadric = SHAPES[which]
    rng = np.random.default_rng(seed)
    B, g = random_problem(rng, quadric, quadric.size + 1)
    y, ok = minimiser(B, g, quadric)
    d = quadric.size - 1
    turn = np.eye(quadric.size)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    unit = np.diag([scale] * d + [scale if quadric.shape == "cone" else scale**2])
    mixed = np.linalg.qr(rng.normal(size=(len(g), len(g))))[0]
    other, fine = minimiser(mixed @ B @ turn.T @ np.linalg.inv(unit), mixed @ g, quadric)
    assert ok
    assert fine
    np.testing.assert_allclose(
        cost_of(mixed @ B @ turn.T @ np.linalg.inv(unit), mixed @ g, other), cost_of(B, g, y), rtol=1e-7, atol=1e-12
    )
    gap = np.diff(stationary(B, g, quadric)[1][:2])[0]
    if gap > 1e-3:
        np.testing.assert_allclose(other, unit @ turn @ y, rtol=1e-5, atol=1e-5 * np.abs(other).max())


@pytest.mark.parametrize("solve", [minimiser, stationary])
@quadrics
def test_bad_items_leave_the_others_bit_identical(quadric, solve):
    rng = np.random.default_rng(12)
    n = quadric.size
    B, g = rng.normal(size=(1500, n + 1, n)), rng.normal(size=(1500, n + 1))
    clean = solve(B, g, quadric)
    spoilt, right = B.copy(), g.copy()
    spoilt[3, 1, 1], right[700, 2], right[1400, 0] = np.nan, np.inf, np.nan
    spoilt[11] = 0.0
    spoilt[12, :, 0] = 0.0
    spoilt[13] = spoilt[13, :, :1]
    spoilt[14] *= 1e-12
    touched = np.isin(np.arange(1500), [3, 11, 12, 13, 14, 700, 1400])
    for before, after in zip(clean, solve(spoilt, right, quadric), strict=True):
        np.testing.assert_array_equal(before[~touched], after[~touched])
    ok = solve(spoilt, right, quadric)[-1].reshape(1500, -1).any(1)
    assert not ok[[3, 11, 13, 700, 1400]].any()
    assert ok[[12, 14]].all()
    alone = solve(B[5], g[5], quadric)
    for one, many in zip(alone, clean, strict=True):
        np.testing.assert_array_equal(one, many[5])


def test_leading_axes_and_absent_rows():
    B, g, truth = tdoa(13, 24, 6, 3, 1e-3)
    y, ok = minimiser(B.reshape(2, 3, 4, 5, 4), g.reshape(2, 3, 4, 5), cone(3))
    assert y.shape == (2, 3, 4, 4)
    assert ok.shape == (2, 3, 4)
    padded = np.concatenate([B, np.zeros((24, 2, 4))], axis=1)
    z, _ = minimiser(padded, np.concatenate([g, np.zeros((24, 2))], axis=1), cone(3))
    np.testing.assert_allclose(z, y.reshape(24, 4), rtol=1e-12)
    np.testing.assert_allclose(y.reshape(24, 4), truth, atol=0.2)
    empty = stationary(np.zeros((0, 5, 4)), np.zeros((0, 5)), cone(3))
    assert [part.shape for part in empty] == [(0, 7, 4), (0, 7), (0, 7)]
    with pytest.raises(ValueError, match="do not fit"):
        minimiser(B, g[:, :3], cone(3))


def test_apex_is_the_half_cone_optimum_when_every_ray_points_away():
    B = np.vstack([np.eye(3), [0.0, 0.0, 1.0]])
    g = np.array([0.1, -0.2, -3.0, -1.0])
    y, cost, valid = stationary(B, g, cone(2), positive=True)
    assert valid[0]
    np.testing.assert_array_equal(y[0], 0.0)
    assert cost[0] == pytest.approx(g @ g)
    np.testing.assert_array_equal(minimiser(B, g, cone(2), positive=True)[0], 0.0)
    assert minimiser(B, g, cone(2))[0][-1] < 0.0


def test_bearings_alone_fit_the_paraboloid():
    x = np.array([0.3, -0.8])
    s = np.array([[0.0, 0.0], [1.0, 0.2], [-0.4, 1.0]])
    m = np.arctan2(*(x - s).T[::-1])
    B = np.stack([-np.sin(m), np.cos(m), 0 * m], axis=1)
    g = -np.sin(m) * s[:, 0] + np.cos(m) * s[:, 1]
    y, ok = minimiser(B, g, paraboloid(2))
    assert ok
    np.testing.assert_allclose(y, [*x, x @ x], atol=1e-10)


def test_import_is_light():
    code = (
        "import sys, formulations.squared_range; print(*(m for m in ('cvxpy', 'casadi', 'scipy') if m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""

"""Chances of regions against closed forms and brute-force samples of the posterior."""

from dataclasses import replace

import numpy as np
import pytest
from often import few
from scipy.special import ndtr

from optloc import Frame, InvalidProblem, Motion, assemble, constraints, measured, solve, with_bias
from optloc.base.types import Band

EVERYWHERE = 1e9


def located(seed, *demands, d=2, size=(), **more):
    """Return the fix of a target at 10, 20 (, 30) from noisy ranges."""
    rng = np.random.default_rng(seed)
    place, truth = rng.uniform(-100.0, 100.0, (7, d)), np.array([10.0, 20.0, 30.0])[:d]
    z = np.linalg.norm(place - truth, axis=1) + 3.0 * rng.standard_normal((*size, 7))
    rows = measured("range", z, a=np.arange(7), sigma=3.0)
    return solve(assemble(place, rows, constraints=demands, **more))


def sampled(fix, inside, count=2_000_000):
    """Return the probability of a region and four times its standard error, from samples of the law of one fix."""
    chart, rng = fix.chart, np.random.default_rng(9)
    plain = chart.skew is None
    mean, covariance = (0.0, chart.covariance) if plain else (chart.skew.shift, chart.skew.covariance)
    points = mean + rng.standard_normal((count, fix.position.size)) @ np.linalg.cholesky(covariance).T
    weight = np.ones(count) if plain else chart.skew.probability(points)
    held = inside(points + fix.position)
    return float((weight * held).sum() / weight.sum()), 2.0 / np.sqrt(weight.sum() ** 2 / (weight**2).sum())


def region_of(fix, number):
    """Return a region near a fix and its mask of points: corner, box, triangle, slab and half-plane."""
    x, e = fix.position, np.eye(fix.position.size)[0]
    corners = x[:2] + np.array([[-3.0, -3.0], [3.0, -2.0], [0.0, 0.5]])

    def triangle(q):
        a, b = corners, np.roll(corners, -1, axis=0)
        return np.all([(v - u)[0] * (q[:, 1] - u[1]) > (v - u)[1] * (q[:, 0] - u[0]) for u, v in zip(a, b, strict=True)], axis=0)  # fmt: skip  # noqa: E501

    wide = np.full(x.size, EVERYWHERE)
    return (
        (constraints.box(x - 1.0, wide), lambda q: (q >= x - 1.0).all(1)),
        (constraints.box(x - 1.5, x + 2.5), lambda q: ((q >= x - 1.5) & (q <= x + 2.5)).all(1)),
        (constraints.polygon(corners), triangle),
        (half_plane(e, x[0] + 1.0, x[0] - 0.5), lambda q: (q[:, 0] >= x[0] - 0.5) & (q[:, 0] <= x[0] + 1.0)),
        (half_plane(e, x[0] - 0.7), lambda q: q[:, 0] <= x[0] - 0.7),
    )[number]


def half_plane(normal, upper, lower=-np.inf):
    return (Band("plane", np.asarray(lower), np.asarray(upper), np.asarray(normal, dtype=float), "half-plane"),)


@pytest.mark.parametrize("number", range(5))
@pytest.mark.parametrize("seed", few(range(12), 2))
def test_chances_agree_with_samples(seed, number):
    d = 2 + seed % 2
    fence = constraints.fence(np.eye(d)[0], 9.0 + seed % 3, 2.0) if seed // 2 % 2 or seed == 1 else ()
    fix = located(seed, fence, d=d)
    region, inside = region_of(fix, number)
    truth, error = sampled(fix, inside, 2_000_000 if seed > 1 else 200_000)
    assert constraints.chance(fix, region) == pytest.approx(truth, abs=0.001 + error)


def test_a_half_plane_and_a_slab_have_closed_forms():
    fix = located(3, size=(4,))
    normal = np.array([0.6, 0.8])
    sigma = np.sqrt(np.einsum("i,nij,j->n", normal, fix.covariance(), normal))
    at = fix.position @ normal
    assert constraints.chance(fix, half_plane(normal, 23.0)) == pytest.approx(ndtr((23.0 - at) / sigma), abs=1e-12)
    slab = ndtr((24.0 - at) / sigma) - ndtr((21.0 - at) / sigma)
    assert constraints.chance(fix, half_plane(normal, 24.0, 21.0)) == pytest.approx(slab, abs=1e-12)
    # one region for each fix, and complements
    upper = np.array([20.0, 22.0, 24.0, 26.0])
    found = constraints.chance(fix, half_plane(normal, upper))
    assert found == pytest.approx(ndtr((upper - at) / sigma), abs=1e-12)
    assert constraints.chance(fix[2], half_plane(normal, 24.0)) == pytest.approx(found[2], abs=1e-12)
    assert found + constraints.chance(fix, half_plane(normal, EVERYWHERE, upper)) == pytest.approx(1.0, abs=1e-12)


def test_a_law_at_a_bound_is_cut_off():
    free = located(4)
    bound = float(free.position[0]) - 1.0
    fix = located(4, constraints.box((-EVERYWHERE,) * 2, (bound, EVERYWHERE)))
    assert fix.chart.name == "truncated"
    assert constraints.chance(fix, half_plane((1.0, 0.0), bound + 1e-6)) == 1.0
    line = half_plane((1.0, 0.0), bound - 2.0)
    share = constraints.chance(free, line) / constraints.chance(free, half_plane((1.0, 0.0), bound))
    assert constraints.chance(fix, line) == pytest.approx(float(share), abs=0.02)


def test_a_sharp_fence_has_the_chances_of_a_bound():
    free = located(5)
    bound = float(free.position[0]) - 2.0
    fix = located(5, constraints.fence((1.0, 0.0), bound, 1e-3))
    line = half_plane((1.0, 0.0), bound - 1.0)
    share = constraints.chance(free, line) / constraints.chance(free, half_plane((1.0, 0.0), bound))
    assert constraints.chance(fix, line) == pytest.approx(float(share), abs=0.01)


def test_an_exact_height_leaves_a_surface():
    place = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 5.0], [0.0, 100.0, 10.0], [100.0, 100.0, 30.0]])
    z = np.linalg.norm(place - [30.0, 40.0, 20.0], axis=1)
    frame, height = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0), constraints.height(exactly=420.0)
    fix = solve(assemble(place, measured("range", z, a=np.arange(4), sigma=3.0), frame=frame, constraints=height))
    x = fix.position
    assert constraints.chance(fix, half_plane((1.0, 0.0, 0.0), x[0])) == pytest.approx(0.5)
    assert constraints.chance(fix, constraints.height(419.0, 421.0)) == 1.0
    assert constraints.chance(fix, constraints.height(421.0, 430.0)) == 0.0


def test_no_covariance_no_chance():
    fix = located(6, size=(3,))
    cov = np.array(fix.cov)
    cov[1] = np.nan
    chart = replace(fix.chart, kind=np.array([0, 0, 2], dtype=np.int8))
    found = constraints.chance(replace(fix, cov=cov, chart=chart), constraints.box((0.0, 0.0), (12.0, 20.0)))
    assert np.isnan(found).tolist() == [False, True, True]
    assert constraints.chance(fix[0], constraints.box((0.0, 0.0), (12.0, 20.0))) == found[0]


def test_a_far_fix_is_gaussian_in_inverse_range():
    rng = np.random.default_rng(7)
    place = rng.uniform(-100.0, 100.0, (6, 2))
    angle = np.arctan2(300.0 - place[:, 1], 3000.0 - place[:, 0]) + 1e-3 * rng.standard_normal(6)
    fix = solve(assemble(place, measured("azimuth", angle, a=np.arange(6), sigma=4e-3)))
    assert fix.chart.name == "inverse range"
    low, high = fix.interval("range")
    radius, direction = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False), fix.chart.centre
    ring = direction + float(high) * np.stack([np.cos(radius), np.sin(radius)], axis=-1)
    inner = direction + float(low) * np.stack([np.cos(radius), np.sin(radius)], axis=-1)
    share = constraints.chance(fix, constraints.polygon(ring)) - constraints.chance(fix, constraints.polygon(inner))
    assert share == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize(
    ("region", "sentence"),
    [
        ((), "the region is empty"),
        (constraints.speed(5.0), "depends on the velocity"),
        (constraints.box((0.0, 0.0), (0.0, 5.0)), "is an equality"),
        (constraints.box((0.0, 0.0), (1.0, 5.0), target=1), "no position of target 1"),
        (
            (*constraints.box((0.0, 0.0), (1.0, 5.0)), *constraints.polygon(np.eye(3)[:, :2], target=1)),
            "several targets",
        ),
        ("a box", "is not a constraint"),
        (half_plane((1.0, 0.0), np.zeros(3)), "batch axes"),
    ],
)
def test_regions_that_have_no_chance_are_refused(region, sentence):
    with pytest.raises(InvalidProblem, match=sentence):
        constraints.chance(located(8), region)


def test_a_free_target_has_a_chance_at_each_epoch():
    place = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [100.0, 100.0]])
    z = np.concatenate([np.linalg.norm(place - [x, 40.0], axis=1) for x in (30.0, 60.0)])
    rows = measured("range", z, a=np.tile(np.arange(4), 2), epoch=np.repeat([0, 1], 4), sigma=1.0)
    problem, square = assemble(place, rows, motions=(Motion(span="epoch"),)), constraints.box((0.0, 0.0), (50.0, 50.0))
    assert constraints.chance(solve(problem), square) == pytest.approx([1.0, 0.0])
    with pytest.raises(InvalidProblem, match="that all epochs share"):
        constraints.chance(solve(with_bias(problem, "offset", per="kind")), square)


def test_a_fence_and_a_region_of_another_dimension_have_no_chance():
    fix = located(1)
    with pytest.raises(InvalidProblem, match="uncertain fence"):
        constraints.chance(fix, constraints.fence((1.0, 0.0), 5.0, 2.0))
    with pytest.raises(InvalidProblem, match="give 2 numbers"):
        constraints.chance(fix, constraints.ball((0.0, 0.0, 0.0), 5.0))

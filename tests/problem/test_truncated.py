"""A fix at a bound: the normal law that the bounds cut off, against samples, and its coverage over many truths."""

import numpy as np
import pytest
from often import few

import optloc
from optloc import Status, assemble, constraints, measured, solve, station_array
from optloc.problem.chart import quantile
from optloc.problem.truncated import Truncated
from optloc.show.columns import fix_detail
from optloc.uncertainty import mixture, samples
from optloc.uncertainty.outline import outline_of

MANY = 200_000


def half_spaces(normal, slack, shift, covariance):
    """Return a law that half-spaces cut off."""
    h, d = normal.shape
    span = np.tile([-np.inf, np.inf], (h, 1))
    return Truncated(normal, slack, np.zeros((h, d)), span, np.zeros(h), shift, covariance)


def drawn_law(seed, d):
    """Return a law that one or two half-spaces cut off, and samples of it."""
    rng = np.random.default_rng(seed)
    root, count = rng.normal(size=(d, d)), 1 + seed % 2
    covariance, normal = root @ root.T, rng.normal(size=(count, d))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    sigma = np.sqrt(np.einsum("hi,ij,hj->h", normal, covariance, normal))
    slack, shift = rng.uniform(0.0, 1.5, count) * sigma, np.zeros(d)
    if seed % 3 == 0:  # the fix is on the first bound
        slack[0], shift = 0.0, 1.2 * covariance @ normal[0] / sigma[0]
    points = shift + rng.standard_normal((MANY, d)) @ np.linalg.cholesky(covariance).T
    return half_spaces(normal, slack, shift, covariance), points[(points @ normal.T <= slack).all(1)]


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_moments_regions_and_intervals_are_those_of_samples(seed, d):
    law, points = drawn_law(seed, d)
    mean, covariance = law.moments()
    size = np.sqrt(np.trace(law.covariance))
    assert np.abs(mean - points.mean(0)).max() < 0.03 * size
    assert np.abs(covariance - np.cov(points.T)).max() < 0.03 * size**2
    value = law.distance_squared(points[:20_000])
    for level in (0.5, 0.95, 0.99):
        assert (value <= quantile(level, d)).mean() == pytest.approx(level, abs=0.012)
    low, high = law.interval(lambda away: away[..., 0], 0.95)
    assert ((points[:, 0] >= low) & (points[:, 0] <= high)).mean() == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("seed", [0, 2, 4, 6])
def test_one_bound_in_closed_form_is_as_the_rays_have_it(seed):
    law, _ = drawn_law(seed, 2 + seed // 4)
    for one, other in zip(law.moments(), law.moments_by_rays(), strict=True):
        np.testing.assert_allclose(one, other, atol=5e-3 * np.trace(law.covariance))


def test_an_interval_reaches_the_bound_and_is_the_shortest():
    sigma, level = 2.0, 0.9
    law = half_spaces(np.array([[1.0, 0.0]]), np.zeros(1), np.array([1.0, 0.0]), np.diag([sigma**2, 1.0]))
    low, high = law.interval(lambda away: away[..., 0], level)
    assert high == 0.0
    from scipy.stats import norm

    inside = norm.cdf(0.0, 1.0, sigma)
    assert low == pytest.approx(norm.ppf((1.0 - level) * inside, 1.0, sigma), rel=0.02)


def test_points_beyond_a_bound_are_in_no_region():
    law, points = drawn_law(0, 2)
    beyond = points[:50] + (law.slack[0] - points[:50] @ law.normal[0] + 0.1)[:, None] * law.normal[0]
    assert np.isinf(law.distance_squared(beyond)).all()


def ranged(rng, limits, truth, sigma=2.0, count=6):
    """Return a problem of ranges in the plane whose target is in a box, or in none."""
    place = rng.uniform(-50.0, 50.0, (count, 2))
    z = np.linalg.norm(place - truth, axis=1) + sigma * rng.standard_normal(count)
    demands = () if limits is None else constraints.box(*limits)
    return assemble(station_array(place), measured("range", z, a=np.arange(count), sigma=sigma), constraints=demands)


@pytest.mark.parametrize("count", few([32, 64], 1))
def test_most_fixes_in_boxes_are_ok_and_cover_truths_inside_and_on_the_edge(count):
    rng, held, good, inside, edge, wrong = np.random.default_rng(11), 0, 0, [], [], 0
    for k in range(count):
        lower = rng.uniform(-25.0, 25.0, 2)
        upper = lower + 10 ** rng.uniform(0.0, 1.2, 2)
        truth = rng.uniform(lower, upper)
        if k % 4 == 0:
            truth[k % 8 // 4] = upper[k % 8 // 4]
        problem = ranged(rng, (lower, upper), truth)
        fix = solve(problem)
        active = fix.active[()]
        held += len(active) > 0
        good += len(active) > 0 and fix.status == Status.OK
        if fix.status == Status.OK:
            (edge if k % 4 == 0 else inside).append(bool(fix.covers(truth)))
            # an independent search: a grid of the box
            grid = np.stack(np.meshgrid(*np.linspace(lower, upper, 60).T), -1).reshape(-1, 2)
            away = np.linalg.norm(grid[:, None] - problem.stations.position[0, 0], axis=-1)
            least = (((problem.z - away) / 2.0) ** 2).sum(1).min()
            wrong += bool(fix.cost > least + 1e-6)
    assert held > count // 3
    assert good >= 0.8 * held
    assert wrong == 0
    # 95 % of some 45 and 15 of 64: fewer happen by chance once in ten thousand times, of 32 once in a hundred times
    assert np.mean(inside) > 0.8
    assert np.mean(edge) > 0.7


def held_fix():
    rng = np.random.default_rng(3)
    problem = ranged(rng, ((-20.0, -20.0), (9.0, 5.5)), np.array([10.0, 5.0]), 3.0)
    return problem, solve(problem)


def test_a_held_fix_tells_its_law_in_print_json_samples_and_pictures():
    problem, fix = held_fix()
    assert (fix.status, fix.chart.name) == (Status.OK, "truncated")
    assert fix.position[0] == pytest.approx(9.0)
    mean, covariance = fix.gaussian()
    assert mean[0] < 9.0 - 0.2 * np.sqrt(covariance[0, 0])
    assert "within the bounds" in repr(fix)
    told = fix.to_dict()["chart"]
    assert told["x95"][1] == pytest.approx(9.0)
    np.testing.assert_allclose(told["mean"], mean, rtol=1e-6)
    drawn = samples(problem, fix, 512)
    assert drawn.position[:, 0].max() <= 9.0 + 1e-6
    np.testing.assert_allclose(drawn.mean, mean, atol=0.15)
    np.testing.assert_allclose(mixture(problem, fix).mean[0], mean)
    line = outline_of(problem, fix, np.eye(2)).lines[0] + fix.position
    assert (line <= [9.0 + 1e-9, 5.5 + 1e-9]).all()
    assert fix.covers(line[:-1] * 0.99 + 0.01 * fix.position).all()


def test_a_batch_is_cut_off_as_each_of_its_fixes_is():
    problem, fix = held_fix()
    z = np.stack([problem.z, problem.z - 0.5, problem.z])
    many = solve(problem.with_rows(z=z))
    assert many.chart.name.tolist()[::2] == ["truncated"] * 2
    np.testing.assert_allclose(many.cov[0], fix.cov, rtol=1e-6)
    np.testing.assert_allclose(many.gaussian()[0][2], fix.gaussian()[0], rtol=1e-6)
    low, high = many.interval("x")
    np.testing.assert_allclose([low[0], high[0]], fix.interval("x"), rtol=1e-4)
    points = np.array([[8.0, 4.0], [9.5, 4.0]])
    np.testing.assert_array_equal(many[2].covers(points), fix.covers(points))


@pytest.mark.parametrize("count", [1, 2])
def test_a_box_without_any_bound_is_no_box(count):
    rng, nowhere = np.random.default_rng(2), np.full(2, np.inf)
    free, boxed = (ranged(np.random.default_rng(2), limits, np.zeros(2)) for limits in (None, (-nowhere, nowhere)))
    z = free.z + 0.1 * rng.standard_normal((count, 6))
    one, other = (solve(each.with_rows(z=z if count > 1 else z[0])) for each in (free, boxed))
    np.testing.assert_array_equal(one.code, other.code)
    np.testing.assert_allclose(one.cov, other.cov, rtol=1e-6)


def test_a_batch_near_the_ground_is_judged_as_its_fixes_are():
    """The short way of a few fixes at once leaves those near a bound to the long way."""
    rng = np.random.default_rng(8)
    place, truth = rng.uniform(-500.0, 500.0, (6, 3)) * [1.0, 1.0, 0.2], np.array([100.0, 50.0, 3.0])
    z = np.linalg.norm(place - truth, axis=1) + 2.0 * rng.standard_normal((3, 6))
    ground = constraints.box((-np.inf, -np.inf, 0.0), (np.inf, np.inf, np.inf))
    problem = assemble(station_array(place), measured("range", z, a=np.arange(6), sigma=2.0), constraints=ground)
    many = solve(problem)
    for i in range(3):
        alone = solve(problem.take(np.array([i])))
        assert alone.code[0] == many.code[i]
        np.testing.assert_allclose(alone.cov[0], many.cov[i], rtol=1e-6)
        np.testing.assert_array_equal(alone[0].covers(truth), many[i].covers(truth))


def test_a_fix_at_an_exact_height_covers_truths_of_its_surface():
    rng, count = np.random.default_rng(4), 80
    frame = optloc.Frame.enu(lat_deg=48.0, lon_deg=11.0)
    place = rng.uniform(-3e3, 3e3, (6, 3)) * [1.0, 1.0, 0.1]
    truth = frame.from_geodetic(*np.radians([48.01, 11.02]), 300.0)
    z = np.linalg.norm(place - truth, axis=1) + 10.0 * rng.standard_normal((count, 6))
    level = constraints.height(exactly=300.0)
    rows = measured("range", z, a=np.arange(6), sigma=10.0)
    fix = solve(assemble(station_array(place), rows, frame=frame, constraints=level))
    inside = fix.covers(truth).mean()
    assert 0.86 <= inside <= 1.0
    assert not fix.covers(truth + np.array([0.0, 0.0, 300.0])).any()


def test_the_law_of_a_region_without_planes_has_moments_for_one_fix_and_in_a_batch():
    anchors = np.array([[-400, -300], [500, -350], [450, 400], [-350, 450], [50, 600], [0, -550.0]])
    truth, corners = np.array([112.0, 90.0]), [[100, 80], [130, 80], [130, 100], [100, 100]]
    z = np.linalg.norm(anchors - truth, axis=1) + 5.0 * np.random.default_rng(2).normal(size=6)
    pond = constraints.keep_out_polygon(corners)
    fix = solve(assemble(anchors, measured("range", z, a=np.arange(6), sigma=5.0), constraints=pond))
    mean, covariance = fix.gaussian()
    assert np.isfinite(covariance).all()
    np.testing.assert_allclose(mean, fix.reshape((1,)).gaussian()[0][0])
    assert fix_detail(fix)["chart"]["mean"] == pytest.approx(mean, abs=1e-3)

"""Directions, ranges, places and curves that data determine, against costs and searches of another make."""

import dataclasses
import json
import pickle

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE as PLAIN, ranges_to
from often import few
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import chi2

import optloc
from optloc.base.frames import Frame
from optloc.base.types import Status
from optloc.model_checks.determine import _ellipse, _hyperbola, of_fix
from optloc.problem.determined import WITHOUT_PLACE
from optloc.show.columns import fix_columns
from optloc.show.formats.marks import Results
from optloc.show.formats.markup import kml

SQUARE = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0.0]])
SIX = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0.08, 0.08, 0.09], [0.02, 0.09, 0.06]])
TRIANGLE = np.array([[0.35, 0.36], [0.45, 0.36], [0.35, 0.26]])


def differences(places, target, sigma, rng, **more):
    """Return the problem of differences to the first station, with one standard deviation for each arrival."""
    measured = np.linalg.norm(places - target, axis=1) + sigma * rng.standard_normal(len(places))
    a = np.arange(1, len(places))
    rows = optloc.measured("tdoa", measured[1:] - measured[0], a=a, b=0 * a, arrival_sigma=sigma)
    return optloc.assemble(places, rows, **more)


def cost_of(places, z, sigma):
    """Return the cost of arrivals over u and w = 1 / distance from the mean, infinity included: own code."""
    c, n = places.mean(0), len(places)
    white = np.linalg.inv(np.linalg.cholesky(sigma**2 * (np.eye(n - 1) + 1.0)))

    def cost(u, w):
        away = places - c
        # range less distance of the middle, without cancellation: (|a|^2 - 2 r a.u) / (r_s + r)
        along, square = away @ u, (away**2).sum(1)
        excess = (w * square - 2.0 * along) / (1.0 + np.sqrt(np.maximum(1.0 - 2.0 * w * along + w * w * square, 0.0)))
        return float(((white @ (z - (excess[1:] - excess[0]))) ** 2).sum())

    return cost


def least_over_range(cost, u, size):
    """Return the least cost over w, by a grid and a bounded search between its neighbours."""
    grid = np.concatenate([[0.0], np.geomspace(1e-5, 10.0, 80)]) / size
    at = int(np.argmin([cost(u, w) for w in grid]))
    ends = grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]
    found = minimize_scalar(lambda w: cost(u, w), bounds=ends, method="bounded", options={"xatol": 1e-10 / size})
    return min(found.fun, cost(u, 0.0))


def far_target(rng, places):
    size = np.linalg.norm(places - places.mean(0), axis=1).max()
    u = rng.standard_normal(places.shape[1])
    u /= np.linalg.norm(u)
    distance = 2.0 * size * np.exp(rng.uniform(np.log(20.0), np.log(2000.0)))
    return u, distance, 2.0 * size * np.radians(np.exp(rng.uniform(np.log(0.3), np.log(5.0)))) / np.sqrt(2.0)


@pytest.mark.parametrize("count", few([18, 36], 1))
def test_far_sources_are_in_the_cones_and_beyond_the_least_range(count):
    rng, inside, beyond = np.random.default_rng(5), 0, 0
    for k in range(count):
        places = (SQUARE, SIX, TRIANGLE)[k % 3]
        u, distance, sigma = far_target(rng, places)
        problem = differences(places, places.mean(0) + distance * u, sigma, rng)
        found = optloc.model_checks.determined(problem, blank(problem))
        assert found.directions
        own = [one for one in found.directions if one.covers(u)]
        inside += bool(own)
        beyond += min(one.least_range for one in own or found.directions) <= distance
    # 95 % of 36: fewer than 30 happen once in 500 seeds; of 18, fewer than 15 happen once in 100
    assert inside >= count * 5 // 6
    assert beyond >= count * 8 // 9


def blank(problem):
    """Return the fix of a problem without a position, as a refinement that failed leaves it."""
    from optloc.solvers.verdict.judge import failed_fixes

    return failed_fixes(problem.flat(), "")[0]


@pytest.mark.parametrize(("places", "seed"), [(SIX, 1), (SIX, 4), (SQUARE, 2)])
def test_the_edge_of_a_cone_costs_what_it_should(places, seed):
    rng = np.random.default_rng(seed)
    u, distance, sigma = far_target(rng, places)
    problem = differences(places, places.mean(0) + distance * u, sigma, rng)
    found = optloc.model_checks.determined(problem, blank(problem)).directions
    size = np.linalg.norm(places - places.mean(0), axis=1).max()
    cost = cost_of(places, problem.z[0] if problem.z.ndim > 1 else problem.z, sigma)

    def at(angles):
        v = np.array([np.cos(angles[0]) * np.cos(angles[1]), np.sin(angles[0]) * np.cos(angles[1]), np.sin(angles[1])])
        return least_over_range(cost, v, size)

    start = [np.arctan2(u[1], u[0]), np.arcsin(u[2])]
    least = min(minimize(at, start, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9}).fun, at(start))
    assert found[0].gap == 0.0
    assert least_over_range(cost, found[0].vector, size) == pytest.approx(least, abs=2e-3)
    for edge in found[0].outline[::4]:
        assert least_over_range(cost, edge, size) - least == pytest.approx(chi2.ppf(0.95, 2), abs=0.1)


def test_a_flat_array_has_mirror_images():
    rng = np.random.default_rng(7)
    problem = differences(SQUARE, np.array([8.0, -6.0, -3.0]), 3e-4, rng)
    found = optloc.model_checks.determined(problem, blank(problem))
    assert len(found.directions) == 2
    one, two = (each.vector for each in found.directions)
    np.testing.assert_allclose(one * [1, 1, -1], two, atol=1e-4)
    assert any(each.covers(np.array([8.0, -6.0, -3.0]) - SQUARE.mean(0)) for each in found.directions)


@pytest.mark.parametrize("sigma", [3e-5, 2e-3, 7e-3])
def test_every_status_has_a_direction(sigma):
    rng, seen = np.random.default_rng(5), set()
    for _ in range(4):
        problem = differences(TRIANGLE, np.array([7.51, 6.57]), sigma, rng)
        fix = optloc.solve(problem)
        seen.add(fix.status)
        found = fix.determined
        assert found.directions
        assert found.directions[0].half_angles.shape == (1,)
        assert "95 % direction" in str(fix)
    assert seen <= set(WITHOUT_PLACE)


def test_it_does_not_depend_on_the_position_of_the_fix():
    problem = differences(SIX, np.array([40.0, 5.0, 9.0]), 2e-4, np.random.default_rng(3))
    fix = optloc.solve(problem)
    moved = dataclasses.replace(fix, x=fix.x + 3.0, cov=np.full_like(fix.cov, np.nan))
    one, two = (
        optloc.model_checks.determined(problem, fix).directions,
        optloc.model_checks.determined(problem, moved).directions,
    )
    np.testing.assert_array_equal(one[0].outline, two[0].outline)
    assert one[0].range == two[0].range


def test_a_bearing_is_a_ray():
    places = np.array([[3.0, 4.0], [90.0, 0.0]])
    problem = optloc.assemble(places, optloc.measured("azimuth", [0.7], a=[0], sigma=0.01))
    found = optloc.model_checks.determined(problem, optloc.solve(problem))
    (one,) = found.directions
    np.testing.assert_allclose(found.origin, [3.0, 4.0])
    np.testing.assert_allclose(one.azimuth, 0.7 + 0.01 * np.array([0.0, -1.95996, 1.95996]), atol=2e-4)
    assert one.range[1:] == (0.0, np.inf)
    rows = [optloc.measured(kind, [z], a=[0], sigma=0.01) for kind, z in (("azimuth", 0.7), ("elevation", 0.3))]
    problem = optloc.assemble(np.array([[3.0, 4.0, 5.0]]), *rows)
    (one,) = optloc.model_checks.determined(problem, optloc.solve(problem)).directions
    np.testing.assert_allclose(one.elevation, 0.3 + 0.01 * np.array([0.0, -1.95996, 1.95996]), atol=2e-4)
    np.testing.assert_allclose(
        one.half_angles, 0.01 * np.sqrt(chi2.ppf(0.95, 2)) * np.array([1, np.cos(0.3)]), rtol=0.02
    )


@pytest.mark.parametrize(
    ("kind", "z", "length"),
    [
        ("tdoa", 3.0, lambda a, b: a - b),
        ("tdoa", -8.0, lambda a, b: a - b),
        ("range", 4.0, lambda a, b: a),
        ("range_sum", 14.0, lambda a, b: a + b),
    ],
)
def test_one_measurement_in_the_plane_is_a_curve(kind, z, length):
    places = np.array([[1.0, 2.0], [9.0, 8.0]])
    b = {} if kind == "range" else {"b": [1]}
    problem = optloc.assemble(places, optloc.measured(kind, [z], a=[0], sigma=0.1, **b))
    fix = optloc.solve(problem)
    found = fix.determined
    ends = [np.linalg.norm(found.curve - place, axis=1) for place in places]
    np.testing.assert_allclose(length(*ends), z, atol=1e-9)
    (one,) = found.quantities
    np.testing.assert_allclose([one.low, one.high], [z - 0.195996, z + 0.195996], rtol=1e-6)
    assert found.curve_name in str(fix)


def test_a_difference_longer_than_its_baseline_is_a_ray():
    places = np.array([[0.0, 0.0], [10.0, 0.0]])
    problem = optloc.assemble(places, optloc.measured("tdoa", [10.05], a=[0], b=[1], sigma=0.1))
    curve = optloc.model_checks.determined(problem, optloc.solve(problem)).curve
    np.testing.assert_allclose(curve, [[10.0, 0.0], [110.0, 0.0]])


def test_stations_on_a_line_leave_a_circle():
    s, sigma = np.linspace(-40.0, 40.0, 6), 0.05
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    target = 25.0 * axis + 60.0 * np.array([2.0, 1.0, -2.0]) / 3.0
    measured = np.linalg.norm(s[:, None] * axis - target, axis=1) + sigma * np.random.default_rng(2).standard_normal(6)
    a = np.arange(1, 6)
    rows = optloc.measured("tdoa", measured[1:] - measured[0], a=a, b=0 * a, arrival_sigma=sigma)
    problem = optloc.assemble(s[:, None] * axis, rows)
    found = optloc.model_checks.determined(problem, optloc.solve(problem))
    angle, along, away = found.quantities
    # the same from a grid over place and distance
    white = np.linalg.inv(np.linalg.cholesky(sigma**2 * (np.eye(5) + 1.0)))
    x, y = np.meshgrid(np.linspace(10.0, 45.0, 701), np.linspace(30.0, 120.0, 1201), indexing="ij")
    ranges = np.hypot(x[..., None] - s, y[..., None])
    cost = ((((measured[1:] - measured[0]) - (ranges[..., 1:] - ranges[..., :1])) @ white.T) ** 2).sum(-1)
    allowed = cost <= cost.min() + chi2.ppf(0.95, 1)
    sign = np.sign(axis @ found.axis)
    assert sorted([sign * along.low, sign * along.high]) == pytest.approx(
        [x[allowed].min(), x[allowed].max()], abs=0.15
    )
    assert [away.low, away.high] == pytest.approx([y[allowed].min(), y[allowed].max()], abs=0.3)
    turn = np.arctan2(y, sign * x)[allowed]
    assert [angle.low, angle.high] == pytest.approx([turn.min(), turn.max()], abs=0.002)


def test_stations_in_a_plane_leave_a_place_and_a_distance():
    places = np.array([[0.0, 0, 1], [10, 0, 1], [10, 8, 1], [0, 8, 1], [5, 3, 1]])
    target = np.array([4.0, 5.0, 3.5])
    z = np.linalg.norm(places - target, axis=1) + 0.05 * np.random.default_rng(1).standard_normal(5)
    problem = optloc.assemble(places, optloc.measured("range", z, a=np.arange(5), sigma=0.05))
    fix = optloc.solve(problem)
    assert fix.status is Status.AMBIGUOUS
    numbers = {one.name: one for one in fix.determined.quantities}
    far = numbers["distance from plane"]
    np.testing.assert_allclose([far.low, far.high], optloc.model_checks.distance_from_plane(problem, fix), rtol=1e-2)
    assert numbers["x"].low < 4.0 < numbers["x"].high
    np.testing.assert_allclose([numbers["x"].value, numbers["y"].value], fix.position[:2], atol=1e-4)
    assert "95 % distance from plane" in str(fix)


@pytest.mark.parametrize("kind", ["enu", "ecef"])
def test_it_is_shown_in_text_json_geojson_kml_and_pictures(kind):
    local = Frame.enu(lat_deg=47.0, lon_deg=8.0)
    places = np.array([[0, 0, 0], [50, 0, 0], [50, 50, 5], [0, 50, 10.0], [20, 25, 30]])
    u = np.array([0.6, 0.7, 0.39])
    target = places.mean(0) + 6000.0 * u
    if kind == "ecef":
        places, target = local.to_ecef(places), local.to_ecef(target)
    frame = local if kind == "enu" else Frame("ecef")
    problem = differences(places, target, 0.5, np.random.default_rng(4), frame=frame)
    fix = optloc.solve(problem)
    assert fix.status in WITHOUT_PLACE
    (one,) = fix.determined.directions
    told = json.loads(json.dumps(fix.to_dict(), allow_nan=False))["determined"]
    assert told["directions"][0]["range_interval"][1] is None
    bearing = told["directions"][0]["bearing_interval_deg"]
    assert bearing[0] < np.degrees(np.arctan2(u[0], u[1])) < bearing[1]
    assert "bearing" in str(fix)
    features = fix.to_geojson(problem)["features"]
    (wedge,) = (each for each in features if each["properties"]["role"] == "direction95")
    corners = np.array(wedge["geometry"]["coordinates"][0])
    # seen from the origin of the frame, 30 m from the middle of the stations
    east, north = (corners[:, 0] - 8.0) * np.cos(np.radians(47.0)), corners[:, 1] - 47.0
    seen = np.degrees(np.arctan2(east, north))
    assert seen.min() == pytest.approx(bearing[0], abs=1.0)
    assert seen.max() == pytest.approx(bearing[1], abs=1.0)
    assert wedge["properties"]["least_range"] == one.least_range
    assert sum(each["properties"]["role"] == "ray" for each in features) == 1
    text = kml(Results(fix_columns(fix), fix.frame, (fix,), problem))
    assert "direction, 95 %, cut off" in text
    assert "<LineString>" in text
    labels = [each.get_label() for each in optloc.show.pictures.plot_fixes(problem, fix).axes[0].collections]
    assert "95 % direction" in labels


def test_a_batch_computes_nothing_and_keeps_few_problems():
    rng = np.random.default_rng(8)
    target = np.array([0.05, 0.03, 0.12])
    good = [differences(SIX, target, 1e-4, rng).z for _ in range(5)]
    far = [differences(SIX, 90.0 * target, 1e-3, rng).z for _ in range(2)]
    problem = differences(SIX, target, 1e-4, rng)
    fixes = optloc.solve(problem.with_rows(z=np.stack([*good, *far])))
    assert fixes.source is not None
    kept = [one is not None for one in fixes.source]
    assert kept == (fixes.code != Status.OK).tolist()
    assert fixes[5].determined.directions
    with pytest.raises(optloc.InvalidProblem, match="shape"):
        _ = fixes.determined
    with pytest.raises(optloc.InvalidProblem, match="several"):
        optloc.model_checks.determined(problem.with_rows(z=np.stack(good)), fixes)
    again = pickle.loads(pickle.dumps(fixes[6]))
    assert again.determined.directions[0].range == fixes[6].determined.directions[0].range
    many = optloc.solve(problem.with_rows(z=np.stack(far * 6)))
    assert many.source is None
    assert many[0].determined is None


def test_an_ok_fix_has_its_coordinates():
    anchors = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0), "D": (8.0, 6.0)}
    fix = optloc.locate(anchors, ranges={"A": 5.01, "B": 5.02, "C": 4.98, "D": 5.01}, sigma=0.05)
    assert fix.source[()].found is None
    x, y = fix.determined.quantities
    np.testing.assert_allclose([x.low, y.high], fix.position + np.array([-1, 1]) * 1.95996 * fix.sigma(), rtol=1e-4)
    assert fix.to_dict()["determined"] is None


def test_other_problems_have_words_alone():
    places = np.array([[0.0, 0.0], [8.0, 0.0], [0.0, 6.0]])
    problem = optloc.assemble(
        places,
        optloc.measured("range", [5.0, 5.0, 5.0], a=[0, 1, 2], sigma=0.05),
        motions=[optloc.Motion(order=1)],
    )
    fix = optloc.solve(problem)
    found = fix.determined
    assert not found
    assert found.words == str(fix.reason)


def test_a_fix_among_fixes_with_more_rows_has_its_own_rows():
    """Batches of fixes pad the weights of those with fewer rows."""
    problem = differences(SIX, 90.0 * np.array([1.0, 0.4, 0.2]), 1e-3, np.random.default_rng(3))
    fix = optloc.solve(problem)
    padded = dataclasses.replace(fix, weights=np.concatenate([fix.weights, np.zeros(2)]))
    one, other = (optloc.model_checks.determined(problem, each).directions for each in (fix, padded))
    assert len(one) == len(other) > 0
    np.testing.assert_array_equal(one[0].vector, other[0].vector)


def test_points_of_a_curve_have_its_difference_or_sum():
    a, b = np.array([0.0, 0.0]), np.array([1000.0, 300.0])
    ra, rb = (np.linalg.norm(_hyperbola(a, b, 400.0) - end, axis=1) for end in (a, b))
    np.testing.assert_allclose(ra - rb, 400.0, rtol=1e-9)
    ra, rb = (np.linalg.norm(_ellipse(a, b, 1500.0) - end, axis=1) for end in (a, b))
    np.testing.assert_allclose(ra + rb, 1500.0, rtol=1e-9)
    # longer than the distance of both: the ray behind the nearer one; shorter: the stretch between them
    ray = _hyperbola(a, b, 2000.0)
    np.testing.assert_allclose(ray[0], b)
    np.testing.assert_allclose(np.linalg.norm(ray[1] - a) - np.linalg.norm(ray[1] - b), np.linalg.norm(b - a))
    np.testing.assert_array_equal(_ellipse(a, b, 900.0), [a, b])


def test_an_ok_fix_determines_its_coordinates_to_their_sigma():
    fix = optloc.solve(ranges_to(PLACE, 2.0, np.array([0.5, -1.0, 2.0, -0.5, 1.0])))[0]
    found = of_fix(fix)
    for quantity, value, sigma in zip(found.quantities, fix.position, fix.sigma()[:2], strict=True):
        assert quantity.value == pytest.approx(value)
        assert quantity.high - quantity.value == pytest.approx(1.95996 * sigma, rel=1e-4)
    unproven = optloc.solve(ranges_to(PLACE, 2.0, stations=PLAIN[:2]))[0]
    assert of_fix(unproven) is None

"""Three satellites and a height as semidefinite and as nonlinear programs, against the quartic."""

from dataclasses import replace

import numpy as np
import pytest
from often import few
from verdicts import alone

from formulations.nls import Program
from formulations.range_height import ellipsoid, locate, three_stations, visible
from formulations.range_height_conic import _reach, lift
from optloc import solve
from optloc.base.frames import ECEF
from optloc.linear.constraints import height, visible as sight
from optloc.problem.build import assemble, measured, station_array

EARTH = 6378137.0
AXES = np.array([1.0, 1.0, 1 - 1 / 298.257223563])
WGS84 = ellipsoid(AXES)
SIGMA = 299792458 * 50e-9 / EARTH
# geodetic (24.44, 125.21), (25.09, 125.68), (24.44, 125.99) degrees, 800 km
SATELLITES = np.array([
    [-0.591050751440, 0.837557468248, 0.463100841786],
    [-0.594795583632, 0.828355661807, 0.474643267492],
    [-0.602397776292, 0.829433796342, 0.463100841786],
])  # fmt: skip
ALL = np.ones(3)


def on_surface(d):
    return d / np.sqrt(WGS84.polar(d, d))[..., None]


BELOW = on_surface(SATELLITES.mean(0))


def problems(count, sigma, seed):
    """Measured differences of targets within 20 degrees, and the one visible point that fits."""
    rng = np.random.default_rng(seed)
    x = on_surface(rng.normal(size=(80 * count, 3)))
    x = x[x @ BELOW > np.cos(np.radians(20)) * np.linalg.norm(BELOW) * np.linalg.norm(x, axis=-1)][:count]
    r = np.linalg.norm(x[:, None] - SATELLITES, axis=-1)
    z = r[:, :1] - r[:, 1:] + sigma * rng.normal(size=(len(x), 2))
    offset = np.pad(-z, ((0, 0), (1, 0)))
    found = locate(SATELLITES, ALL, offset, WGS84)
    seen = found.valid & visible(found.x[:, :, None], WGS84, SATELLITES).all(-1)
    assert len(x) == count
    assert (seen.sum(-1) == 1).all()
    return z, offset, found.x[seen]


@pytest.mark.parametrize("sigma", [0.0, SIGMA, 10 * SIGMA], ids=["0 ns", "50 ns", "500 ns"])
def test_reduced_lift_is_exact(sigma):
    _, offset, x = problems(200, sigma, 5)
    answers = [lift(SATELLITES, ALL, c, WGS84, BELOW) for c in offset]
    off = np.array([np.linalg.norm(a.x - y) for a, y in zip(answers, x, strict=True)]) * EARTH
    ratio = np.array([a.rank_ratio for a in answers])
    assert (off < 10).mean() >= 0.995
    assert (ratio < 1e-6).mean() >= 0.995
    # where the lift has rank one it is the fix
    assert off[ratio < 1e-6].max() < 1
    for a, y in list(zip(answers, x, strict=True))[:20]:
        value = ((y - BELOW) ** 2).sum()
        r = np.linalg.norm(y - SATELLITES, axis=-1)
        value += (r[0] - np.linalg.norm(BELOW - SATELLITES[0])) ** 2
        assert a.bound <= value + 1e-9
        assert a.bound == pytest.approx(value, abs=1e-6)
        np.testing.assert_allclose(a.ranges, r, atol=1e-6)


def test_reduced_lift_with_a_bad_guess_is_loose_or_another_root():
    _, offset, x = problems(40, 0.0, 6)
    every = locate(SATELLITES, ALL, offset, WGS84, positive=False)
    loose = 0
    for i, near in enumerate([-BELOW, 0.01 * BELOW] * 20):
        found = lift(SATELLITES, ALL, offset[i], WGS84, near)
        if np.linalg.norm(found.x - x[i]) * EARTH > 10:
            loose += found.rank_ratio > 1e-6
            # a lift of rank one is a point that fits, though not the one wanted
            roots = np.linalg.norm(found.x - every.x[i][every.valid[i]], axis=-1)
            assert found.rank_ratio > 1e-6 or roots.min() < 1e-4
    assert loose > 0


def test_reduced_lift_reports_what_it_cannot_pose():
    line = np.array([[1.2, 0, 0], [1.2, 0.1, 0], [1.2, 0.2, 0]])
    for s, offset in ((line, np.zeros(3)), (SATELLITES, np.array([0.0, np.nan, 0.0]))):
        a = lift(s, ALL, offset, WGS84, BELOW)
        assert np.isnan(a.x).all()
        assert a.bound == -np.inf
        assert not a.answer.solved


# Stations and a known height as a program: the polar planes are the horizons of the stations.


def polar(p, x, y):
    """``(x - c)'A(y - c)`` on CasADi symbols; the first nine parameters are A, the next three c."""
    left, right = [x[i] - p[9 + i] for i in range(3)], [y[i] - p[9 + i] for i in range(3)]
    return sum(p[3 * i + j] * left[i] * right[j] for i in range(3) for j in range(3))


def height_program(rows, count, *, diagonal=True):
    """Rows ``r_a - r_b``, or ``r_a`` where b is negative; parameters: the surface, then each station and its limit."""

    def station(p, i):
        return p[12 + 4 * i : 15 + 4 * i]

    def distance(x, p, i):
        away = x - station(p, i)
        return (away[0] ** 2 + away[1] ** 2 + away[2] ** 2) ** 0.5

    def h(x, p):
        return [distance(x, p, a) - (distance(x, p, b) if b >= 0 else 0.0) for a, b in rows]

    return Program(
        3,
        len(rows),
        12 + 4 * count,
        h,
        equalities=lambda x, p: [polar(p, x, x) - 1.0],
        inequalities=lambda x, p: [polar(p, x, station(p, i)) - p[15 + 4 * i] for i in range(count)],
        diagonal=diagonal,
        # IPOPT's own scaling looks at the gradient of the start, which vanishes where the start is the fix
        settings={"nlp_scaling_method": "none"},
    )


def on_height(program, start, z, stations, surface, weight, *, horizon=True):
    """Solve at three sizes of the weights in turn; a station inside the ellipsoid sees all of it and gets no plane."""
    planes = (surface.polar(stations, stations) > 1.0) & horizon
    limit = np.where(planes, 1.0, -10.0)  # the left side is at least -1 for points of the closed ellipsoid
    p = np.concatenate([surface.shape.ravel(), surface.centre, np.column_stack([stations, limit]).ravel()])
    for aim in (1e3, 1e2, 1e1):
        unit = aim / np.abs(weight).max()
        found = program.solve(start, z, unit * weight, p)
        if found.success or "Infeasible" in found.status:
            break
    return replace(
        found, cost=found.cost / unit**2, equalities=found.equalities / unit**2,
        inequalities=found.inequalities / unit**2,
    )  # fmt: skip


@pytest.fixture(scope="module")
def program():
    return height_program([(0, 1), (0, 2)], 3)


@pytest.mark.parametrize("start", ["below", "antipode", "centre", "random", "fix"])
def test_polar_planes_lead_from_anywhere(program, start):
    z, _, x = problems(30, SIGMA, 7)
    rng = np.random.default_rng(8)
    starts = {
        "below": np.tile(BELOW, (30, 1)),
        "antipode": np.tile(-BELOW, (30, 1)),
        "centre": np.tile([1e3 / EARTH, 0.0, 0.0], (30, 1)),
        # no gradient to scale by
        "fix": x,
        "random": on_surface(rng.normal(size=(30, 3))),
    }[start]
    for first, data, y in zip(starts, z, x, strict=True):
        found = on_height(program, first, data, SATELLITES, WGS84, np.full(2, 1 / SIGMA))
        assert found.success
        assert np.linalg.norm(found.x - y) * EARTH < 0.01
        assert np.abs(found.inequalities).max() < 1e-3


def test_without_polar_planes_most_starts_end_elsewhere(program):
    z, _, x = problems(20, SIGMA, 7)
    ends = [
        on_height(program, -BELOW, data, SATELLITES, WGS84, np.full(2, 1 / SIGMA), horizon=False).x for data in z
    ]  # fmt: skip
    assert np.mean(np.linalg.norm(np.array(ends) - x, axis=-1) * EARTH < 10) < 0.5


def test_multipliers_say_what_is_active(program):
    # no point has a difference as large as the baseline: the best one lies on a horizon
    z = np.array([1.0, 0.3]) * np.linalg.norm(SATELLITES[0] - SATELLITES[1])
    found = on_height(program, BELOW, z, SATELLITES, WGS84, np.full(2, 1e3))
    assert found.success
    assert found.inequalities.min() < -1e-3
    active = int(np.argmin(found.inequalities))
    assert WGS84.polar(found.x, SATELLITES[active]) == pytest.approx(1.0, abs=1e-7)
    weight, y = 1e6, found.x
    u = (y - SATELLITES) / np.linalg.norm(y - SATELLITES, axis=-1)[:, None]
    q = np.linalg.norm(y - SATELLITES, axis=-1)
    slope = -2 * weight * (z - (q[0] - q[1:])) @ (u[0] - u[1:])
    slope += found.equalities[0] * 2 * WGS84.shape @ y + found.inequalities @ (SATELLITES @ WGS84.shape)
    np.testing.assert_allclose(slope, 0, atol=1e-4)


def test_more_stations_ranges_and_a_station_below_the_surface():
    rng = np.random.default_rng(9)
    high = ellipsoid(AXES, 9e3 / EARTH)
    ground = on_surface(BELOW + np.array([[0.01, 0, 0], [0, 0.01, 0], [-0.01, 0, 0.01]]))
    x = (BELOW + 0.004) / np.sqrt(high.polar(BELOW + 0.004, BELOW + 0.004))
    s = np.concatenate([ground, SATELLITES[:1]])
    r = np.linalg.norm(x - s, axis=-1)
    program = height_program([(0, 1), (0, 2), (3, -1)], 4, diagonal=False)
    root = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    found = on_height(program, BELOW, [r[0] - r[1], r[0] - r[2], r[3]], s, high, root / SIGMA)
    assert found.success
    np.testing.assert_allclose(found.x, x, atol=1e-8)


def problem(z, *known):
    """The same data as a problem of optloc, with constraints."""
    stations = station_array(np.broadcast_to(SATELLITES * EARTH, (len(z), 1, 3, 3)))
    rows = measured("tdoa", z * EARTH, a=np.zeros(2, int), b=np.array([1, 2]), sigma=SIGMA * EARTH)
    return assemble(stations, rows, frame=ECEF, constraints=known)


@pytest.mark.parametrize("planes", few([True, False], 1))
def test_optloc_needs_no_planes_where_it_starts_from_the_quartic(planes):
    """The generic program with the height as a constraint finds the visible point from the stage `roots`."""
    z, _, x = problems(40, SIGMA, 7)
    horizon = sight(SATELLITES * EARTH) if planes else ()
    found = solve(problem(z, height(exactly=0.0) + horizon), method="roots+nlp")
    assert alone(found).all()
    assert (np.linalg.norm(found.position - x * EARTH, axis=-1) < 0.01).all()


def test_the_horizon_as_a_constraint_is_the_polar_plane():
    """On the surface: a station above the horizon of a point is one whose polar plane leaves that point."""
    rng = np.random.default_rng(10)
    x = on_surface(rng.normal(size=(500, 3)))
    lat, lon, _ = ECEF.to_geodetic(x * EARTH)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    above = np.einsum("ki,ksi->ks", up, SATELLITES - x[:, None]) > 0.0
    plane = np.stack([WGS84.polar(x, np.broadcast_to(s, x.shape)) > 1.0 for s in SATELLITES], axis=-1)
    assert np.array_equal(above, plane)
    assert 0 < above.sum() < above.size


def test_the_reach_holds_every_point_of_the_ellipsoid():
    """The bound counts on it: coordinates (t, mu) of points that fit, visible or not, in units of the guess."""
    _, offset, _ = problems(100, SIGMA, 6)
    guess = float(np.linalg.norm(BELOW - SATELLITES[0]))
    for c in offset:
        curve = three_stations(SATELLITES[None], ALL[None], c[None])
        found = locate(SATELLITES, ALL, c, WGS84)
        for x, r in zip(found.x[found.valid], found.ranges[found.valid], strict=True):
            lift = np.array([1.0, (r[0] - guess) / guess, curve.across[0] @ (x - curve.base[0]) / guess])
            assert lift @ lift <= _reach(curve, SATELLITES[0], WGS84, guess)

"""What the Earth hides is told with its cost, and a constraint is blamed only where there is one."""

import numpy as np
import pytest
from model_checks.small import PLACE, ranges_to

import optloc
from optloc.base.frames import ECEF
from optloc.base.types import Status
from optloc.files.convert import interpret_table
from optloc.files.table_import import ColumnHints
from optloc.solvers.certificates.branch_and_bound import BARRED, LOST
from optloc.solvers.horizon import is_hidden, lowest_sight

UP = np.array([[1.0, 0.2, 0.1], [0.9, -0.3, 0.3], [0.8, 0.5, -0.3], [0.7, -0.4, -0.5], [0.6, 0.1, 0.8]])
SATELLITES = 26.6e6 * UP / np.linalg.norm(UP, axis=1)[:, None]
# Half a kilometre above the ellipsoid, on the side that no satellite sees.
HIDDEN = np.array(ECEF.from_geodetic(np.radians(1.0), np.radians(178.0), 500.0))


def heard(constraints=()):
    rows = optloc.measured("range", a=np.arange(len(SATELLITES)), sigma=10.0)
    template = optloc.assemble(SATELLITES, rows, frame=ECEF, constraints=list(constraints))
    return optloc.simulate(template, truth=HIDDEN, seed=1)


@pytest.mark.parametrize("bounds", [(), optloc.constraints.height(0.0, 20e3)], ids=["free", "height"])
def test_a_hidden_minimum_is_told_with_cost_and_place(bounds):
    fix = optloc.solve(heard(bounds), "gtrs+lsr")
    reason = str(fix.reason)
    # without a bound the mirror image in the plane of the satellites is left, out in space, and fits nothing
    assert fix.status == (Status.INFEASIBLE if bounds else Status.MISFIT)
    assert "the only minimum found, with chi-square 0." in reason
    assert "has stations below its horizon: 1.00" in reason  # its latitude
    assert "178.00" in reason
    assert "(S0, S1, S2 and 2 more)" in reason
    assert "height" not in reason


def test_a_misfit_before_the_horizon_tells_what_lies_behind_it():
    fix = optloc.solve(heard())
    assert fix.status == Status.MISFIT
    assert "below its horizon" in str(fix.reason)
    assert fix.certificate.reason == BARRED.format("the Earth hides it from a station")


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
def test_the_earth_hides_from_a_batch_what_it_hides_from_one(method):
    """Machine code of many fixes knows nothing of the Earth: what it finds behind it is no answer."""
    one = heard()
    many = one.with_rows(z=np.tile(one.z, (20, 1)))
    alone = optloc.solve(one, method)
    for fix in (optloc.solve(many, method), optloc.prepare(one, method)(many.z)):
        assert (fix.code == alone.code).all()
        assert all("below its horizon" in reason for reason in fix.reason)


def test_without_earth_and_constraint_nothing_is_said_to_forbid():
    assert "constraint" not in LOST
    assert "Earth" not in LOST
    place = np.array([[0.0, 0.0], [9e3, 1e3], [8e3, 9e3], [1e3, 8e3], [5e3, 12e3]])
    template = optloc.assemble(place, optloc.measured("range", a=np.arange(5), sigma=5.0), constraints=[])
    for seed in range(5):
        fix = optloc.solve(optloc.simulate(template, truth=[4e3, 3e3], seed=seed))
        assert "forbids" not in fix.certificate.reason


def test_where_the_earth_hides_all_that_is_found_each_method_says_so():
    """Three satellites over the other side of the Earth, and a height: both places that fit are hidden."""
    over, height = np.radians([[-20.0, 0.0], [-10.0, 14.0], [-30.0, 9.0]]), 2e3
    places = np.array(ECEF.from_geodetic(*over.T, np.full(3, 8e5)))
    template = optloc.assemble(
        places,
        optloc.measured("range", a=np.arange(3), sigma=10.0),
        frame=ECEF,
        constraints=optloc.constraints.height(exactly=height),
    )
    far = np.array(ECEF.from_geodetic(*np.radians([30.0, -160.0]), height))
    one = optloc.simulate(template, truth=far, seed=1)
    for method in ("gtrs+lsr", "auto", "searched"):
        fix = optloc.solve(one, method)
        assert fix.status in (Status.INFEASIBLE, Status.MISFIT), method
        assert "below their horizon" in str(fix.reason) or "below its horizon" in str(fix.reason), method


def orbit(longitude, inclination, phase, times):
    """Return places (k, 3) of a satellite on an inclined geosynchronous circle; degrees, hours."""
    along, tilt = 2.0 * np.pi / 23.934 * times + np.radians(phase), np.radians(inclination)
    x, y, z = np.cos(along), np.sin(along) * np.cos(tilt), np.sin(along) * np.sin(tilt)
    turned = np.radians(longitude) - along
    return 42164.2e3 * np.stack(
        [np.cos(turned) * x - np.sin(turned) * y, np.sin(turned) * x + np.cos(turned) * y, z], -1
    )


def test_where_all_that_starts_lead_to_is_hidden_a_search_finds_what_is_in_sight():
    """Four time differences of two satellites and a height: the cheaper of two places lies behind the Earth."""
    hours, truth = 0.5 * np.arange(4), np.array(ECEF.from_geodetic(*np.radians([50.45, 30.52]), 180.0))
    place = np.stack([orbit(10.0, 0.08, 40.0, hours), orbit(13.0, 1.9, 250.0, hours)], axis=1)
    template = optloc.assemble(
        place,
        optloc.measured("tdoa", sigma=30.0, a=[0] * 4, b=[1] * 4, epoch=np.arange(4)),
        times=3600.0 * hours,
        motions=[optloc.Motion()],
        constraints=optloc.constraints.height(exactly=180.0),
        frame=ECEF,
    )
    for seed in range(4):
        one = optloc.simulate(template, truth=truth, seed=seed)
        fix, best = optloc.solve(one), optloc.solve(one, start=truth)
        assert fix.answered
        assert fix.cost <= best.cost + 1e-6


# Satellites below the horizon of the place that fits, and networks on the ground.


def problem_of(kind, places, sigma, **more):
    """Return rows of one kind from all stations to one target, in ECEF."""
    every = np.arange(len(places))
    if kind == "tdoa":
        rows = optloc.measured("tdoa", a=every[1:], b=0, arrival_sigma=sigma)
    else:
        rows = optloc.measured(kind, a=every, sigma=sigma)
    return optloc.assemble(np.asarray(places), rows, frame=ECEF, **more)


def drawn(problem, place, seed):
    truth = np.append(place, [2e4] * (problem.layout.size - 3))
    return optloc.simulate(problem, truth=truth, seed=seed)


def below(places, place):
    """Return the stations that are at least 5 degrees below the horizon of a place, and those above it."""
    up, line = place / np.linalg.norm(place), places - place
    sine = line @ up / np.linalg.norm(line, axis=1)
    return {f"S{i}" for i in np.flatnonzero(sine < -0.09)}, {f"S{i}" for i in np.flatnonzero(sine > 0.0)}


@pytest.mark.parametrize(
    ("kind", "radius", "sigma"), [("range", 26.56e6, 10.0), ("toa", 42.16e6, 30.0), ("tdoa", 7.2e6, 5.0)]
)
def test_satellites_below_the_horizon_are_named(kind, radius, sigma):
    """No refinement that broke off elsewhere takes the place of the reason."""
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(8, 3))
    places = radius * direction / np.linalg.norm(direction, axis=1)[:, None]
    template = problem_of(kind, places, sigma)
    where = ECEF.from_geodetic(np.arcsin(rng.uniform(-1, 1, 12)), rng.uniform(-np.pi, np.pi, 12), np.full(12, 300.0))
    z = np.stack([drawn(template, place, seed).z for seed, place in enumerate(where)])
    fix = optloc.solve(template.with_rows(z=z), "gtrs+lsr")
    for place, code, reason in zip(where, fix.code, fix.reason, strict=True):
        hidden, seen = below(places, place)
        assert hidden
        assert Status(code) in (Status.INFEASIBLE, Status.MISFIT)
        assert "below its horizon" in reason
        named = {word.strip("(),") for word in reason.split("deg at")[1].split() if word.strip("(,").startswith("S")}
        assert named
        assert not named & seen


@pytest.mark.parametrize("kind", ["range", "toa", "tdoa"])
def test_satellites_above_the_horizon_are_fixed(kind):
    place = np.array(ECEF.from_geodetic(np.radians(40.0), np.radians(-100.0), 800.0))
    rng = np.random.default_rng(2)
    side = rng.normal(size=(7, 3))
    direction = place / np.linalg.norm(place) + 0.45 * side / np.linalg.norm(side, axis=1)[:, None]
    fix = optloc.solve(drawn(problem_of(kind, 26.56e6 * direction, 5.0), place, 3))
    assert np.linalg.norm(fix.position - place) < 4.0 * np.sqrt(np.trace(fix.cov[:3, :3]))
    assert fix.status == Status.OK


# Two points of a height each, degrees apart, and whether the Earth hides one from the other.
@pytest.mark.parametrize(
    ("station", "target", "apart", "hidden"),
    [
        (0.0, 0.0, 90.0, False),  # waves of an earthquake
        (500.0, -30e3, 40.0, False),
        (0.0, 11e3, 25.0, False),  # radio beyond the horizon
        (0.0, 500e3, 60.0, True),  # a satellite over the other side
        (0.0, 500e3, 15.0, False),
        (20.2e6, 0.0, 60.0, False),
        (20.2e6, 0.0, 90.0, True),
        (20.2e6, 800e3, 175.0, True),
        (36e6, 36e6, 150.0, False),
    ],
)
def test_the_earth_hides_what_is_in_space_from_the_ground_and_the_ground_from_space(station, target, apart, hidden):
    at = np.array(ECEF.from_geodetic(0.0, 0.0, station))
    place = np.array(ECEF.from_geodetic(0.0, np.radians(apart), target))
    problem = optloc.assemble(at[None], optloc.measured("range", np.zeros(1), a=[0], sigma=1.0), frame=ECEF)
    assert is_hidden(problem.flat(), place[None]).tolist() == [hidden]


PICKS = [(38.1, 23.8), (52.4, 13.1), (64.1, -21.9), (28.3, -16.5), (36.8, 10.2), (59.3, 18.1), (35.1, 33.4)]


@pytest.mark.parametrize(
    ("lat", "lon", "frame"), [(38.3, -10.5, "ecef"), (55.0, 60.0, "geodetic"), (20.0, 20.0, "ecef")]
)
def test_times_from_p_to_s_of_thousands_of_kilometres_place_an_earthquake(lat, lon, frame, tmp_path):
    """Straight paths of 1 500 to 5 000 km pass up to 500 km below the ground."""
    epicentre, speed = np.array(ECEF.from_geodetic(np.radians(lat), np.radians(lon), 0.0)), 9e3
    places = np.array(ECEF.from_geodetic(*np.radians(np.array(PICKS)).T, np.zeros(len(PICKS))))
    far = np.linalg.norm(places - epicentre, axis=1)
    assert far.max() > 3e6
    lines = ["station,sp_s", *(f"Q{i},{value / speed:.4f}" for i, value in enumerate(far))]
    (tmp_path / "picks.csv").write_text("\n".join(lines))
    if frame == "ecef":
        rows = ["name,x,y,z", *(f"Q{i},{x:.2f},{y:.2f},{z:.2f}" for i, (x, y, z) in enumerate(places.tolist()))]
    else:
        rows = ["name,lat,lon,height", *(f"Q{i},{a},{b},0" for i, (a, b) in enumerate(PICKS))]
    (tmp_path / "net.csv").write_text("\n".join(rows))
    kind = "ecef" if frame == "ecef" else None
    told = ColumnHints(stations=tmp_path / "net.csv", sigma="0.2 s", vp="18 km/s", vs="6 km/s", what="sp", frame=kind)
    problem = interpret_table(tmp_path / "picks.csv", told).read().problem
    fix = optloc.solve(problem)
    assert fix.answered
    assert np.linalg.norm(problem.frame.to_ecef(fix.position) - epicentre) < 2e3
    assert "horizon" not in str(fix.reason)


def ground(count, span, seed):
    """Return stations on the ground within so many degrees."""
    rng = np.random.default_rng(seed)
    lat, lon = np.radians(45.0 + rng.uniform(-span, span, count)), np.radians(10.0 + rng.uniform(-span, span, count))
    return np.array(ECEF.from_geodetic(lat, lon, rng.uniform(0.0, 1500.0, count)))


@pytest.mark.parametrize(("span", "lon"), [(18.0, 45.0), (12.0, -20.0)])
def test_a_network_on_the_ground_reaches_beyond_its_horizon(span, lon):
    place = np.array(ECEF.from_geodetic(np.radians(30.0), np.radians(lon), 5e3))
    bounds = optloc.constraints.height(0.0, 20e3)
    fix = optloc.solve(drawn(problem_of("tdoa", ground(7, span, 1), 100.0, constraints=bounds), place, 1))
    assert np.linalg.norm(fix.position - place) < 20e3
    assert fix.answered


@pytest.mark.parametrize(
    ("kind", "lat", "lon", "row"),
    [("range", 44.0, 11.0, 2), ("tdoa", 44.0, 11.0, 2), ("tdoa", 30.0, 45.0, 2), ("range", 60.0, -20.0, 4)],
)
def test_a_network_on_the_ground_is_told_its_own_reason(kind, lat, lon, row):
    """A wrong row moves the best minimum into space, where the Earth hides it from some of the stations."""
    place = np.array(ECEF.from_geodetic(np.radians(lat), np.radians(lon), 5e3))
    problem = drawn(problem_of(kind, ground(7, 15.0, 3), 50.0), place, 2)
    z = problem.z.copy()
    z[row] += 400e3
    fix = optloc.solve(problem.with_rows(z=z))
    assert fix.status == Status.MISFIT
    assert "satellite" not in str(fix.reason)
    assert "horizon" not in str(fix.reason)


def test_what_ground_stations_measure_of_a_satellite_has_no_image_behind_the_earth():
    """A flat network of ranges has a mirror image: that of a satellite is behind the Earth."""
    places = ground(6, 0.4, 5)
    place = np.array(ECEF.from_geodetic(np.radians(46.0), np.radians(12.0), 20.2e6))
    problem = drawn(problem_of("range", places, 30.0), place, 1)
    fix = optloc.solve(problem)
    assert fix.status != Status.AMBIGUOUS
    found = fix.alternatives.x[np.isfinite(fix.alternatives.gap)]
    assert not is_hidden(problem.take(np.zeros(len(found), dtype=int)) if len(found) else problem.flat(), found).any()


RADIUS, HIGH = 6378137.0, 26.6e6
# satellites over the equator at these longitudes, degrees
ABOVE = np.radians([0.0, 60.0, 100.0])


def from_space():
    stations = HIGH * np.stack([np.cos(ABOVE), np.sin(ABOVE), 0.0 * ABOVE], axis=-1)
    rows = optloc.measured("range", np.full(3, 2.3e7), a=np.arange(3), sigma=5.0)
    return optloc.assemble(stations, rows, frame=ECEF).flat()


def test_a_satellite_below_the_horizon_is_hidden():
    problem, ground = from_space(), RADIUS * np.array([[1.0, 0.0, 0.0]])
    # from longitude 0 the satellite at 100 degrees is below the horizon, which is 76 degrees away
    assert is_hidden(problem, ground).tolist() == [True]
    assert is_hidden(problem.with_rows(weight=np.array([[1.0, 1.0, 0.0]])), ground).tolist() == [False]
    assert not is_hidden(ranges_to(PLACE, 1.0), PLACE[None]).any()


def test_the_lowest_sight_is_the_sine_of_the_elevation():
    problem, ground = from_space(), RADIUS * np.array([[1.0, 0.0, 0.0]])
    line = HIGH * np.stack([np.cos(ABOVE), np.sin(ABOVE)], axis=-1) - [RADIUS, 0.0]
    expected = (line[:, 0] / np.linalg.norm(line, axis=1)).min()
    assert lowest_sight(problem, ground)[0] == pytest.approx(expected, abs=1e-9)
    assert lowest_sight(ranges_to(PLACE, 1.0), PLACE[None]).tolist() == [0.0]

"""Speeds over depth, and air: rays are those of the textbook, and fixes along them are neither off nor too sure."""

from unittest import mock

import numpy as np
import pytest
from models.test_layers import CRUST, SEA, SLOPE, length
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import optloc
from optloc import Frame, InvalidProblem, Motion, Stations, assemble, crlb, measured, simulate, solve
from optloc.base.units import SPEED_OF_LIGHT
from optloc.models import Atmosphere, Layers, medium as media
from optloc.models.primitives import Point
from optloc.show.pictures import plot_fixes


@pytest.mark.parametrize("options", [{"refractivity": -1.0}, {"scale_height": 0.0}, {"refractivity": "much"}])
def test_air_that_is_none_is_told(options):
    with pytest.raises(InvalidProblem, match="of air"):
        Atmosphere(**options)


def test_sums_and_differences_are_those_of_paths(seed):
    stations = floor_and_surface(3, seed)
    rows = [measured(kind, a=[1, 2], b=[0, 1], sigma=1.0) for kind in ("tdoa", "range_sum")]
    x = np.array([300.0, 500.0, -700.0])
    one, two, three = (length(SEA, np.append(x, s)[None])[0] for s in stations)
    values = optloc.engine.predict(assemble(stations, *rows, medium=SEA), x)
    np.testing.assert_allclose(values, [two - one, three - two, two + one, three + two], rtol=1e-14)


# Rays through air: against an integration of the equation of rays in spherical shells.

RADIUS = 6371e3


def shot(low, high, angle, elevation):
    """Return height and optical path of a ray at an angle at the centre of the Earth."""

    def move(_, state):
        r, e, _ = state
        n = 1.0 + 315e-6 * np.exp((RADIUS - r) / 7350.0)
        return [r * np.tan(e), 1.0 - r / n * (n - 1.0) / 7350.0, n * r / np.cos(e)]

    run = solve_ivp(move, (0.0, angle), [RADIUS + low, elevation, 0.0], rtol=1e-12, atol=1e-9, method="DOP853")
    return run.y[0, -1] - RADIUS - high, run.y[2, -1]


@pytest.mark.parametrize(
    ("far", "low", "high", "path", "share"),
    [
        (10e3, 0.0, 300.0, 1e-3, 1e-3),
        (100e3, 100.0, 10e3, 0.03, 3e-3),
        (200e3, 100.0, 10e3, 0.25, 0.012),
        (100e3, 0.0, 300.0, 0.1, 6e-3),
        (400e3, 1000.0, 12e3, 2.0, 0.06),
    ],
)
def test_air_bends_rays_as_spherical_shells_do(far, low, high, path, share):
    angle = far / RADIUS
    away = (RADIUS + high) * np.array([np.cos(angle), np.sin(angle)]) - np.array([RADIUS + low, 0.0])
    straight, chord = np.arctan2(*away), np.hypot(*away)
    elevation = brentq(lambda e: shot(low, high, angle, e)[0], straight - 1e-3, straight + 2e-2, xtol=1e-13)
    exact = shot(low, high, angle, elevation)[1]

    def point(height, angle):
        up = np.array([np.cos(angle), np.sin(angle), 0.0])
        place = tuple((RADIUS + height) * up)
        return Point(place, ecef=place, up=tuple(up))

    with mock.patch.object(media, "geodetic_height", lambda ecef: np.sqrt(sum(v * v for v in ecef)) - RADIUS):
        t, a = point(high, angle), point(low, 0.0)
        assert Atmosphere().path(t, a) == pytest.approx(exact, abs=path)
        pull = Atmosphere().gradients(t, a)[1]
    assert exact - chord > 2.0
    assert np.arctan2(-pull[0], -pull[1]) - elevation == pytest.approx(0.0, abs=share * (elevation - straight))


# Fixes.


def floor_and_surface(count=6, seed=3):
    rng = np.random.default_rng(seed)
    return np.c_[rng.uniform(-2500, 2500, (count, 2)), -rng.uniform(5, 300, count)]


def rows_of(kind, count, sigma):
    if kind == "tdoa":
        return measured("tdoa", a=np.arange(1, count), b=0, arrival_sigma=sigma)
    return measured(kind, a=np.arange(count), sigma=sigma)


ENU = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
HILLS = np.c_[np.random.default_rng(4).uniform(-4e4, 4e4, (6, 2)), [10, 900, 100, 1500, 40, 2000]]
CASES = [
    ("sea, tdoa", SEA, floor_and_surface(), [300, 500, -700], {"tdoa": 0.5}, {}),
    ("sea, range", SEA, floor_and_surface(), [300, 500, -700], {"range": 0.5}, {}),
    ("sea, elevation", SEA, floor_and_surface(), [300, 500, -700], {"range": 3.0, "elevation": 2e-3}, {}),
    ("crust, toa", CRUST, floor_and_surface(8), [300, 500, -2500], {"toa": 5.0}, {}),
    ("slope, toa", SLOPE, floor_and_surface(8), [300, 500, -2500], {"toa": 5.0}, {}),
    (
        "air, elevation",
        Atmosphere(),
        HILLS,
        [6e4, 3e4, 9000],
        {"range": 20.0, "azimuth": 1e-3, "elevation": 5e-4},
        {"frame": ENU},
    ),
]
IDS = [case[0] for case in CASES]


def problem_of(medium, stations, truth, rows, options, trials=100, seed=1):
    parts = [rows_of(kind, len(stations), sigma) for kind, sigma in rows.items()]
    problem = assemble(stations, *parts, medium=medium, **options)
    x = np.zeros(problem.layout.size)
    x[:3] = truth
    return simulate(problem, x, seed, trials=trials), x


@pytest.mark.parametrize(
    ("name", "medium", "stations", "truth", "rows", "options"),
    # A sea of five layers takes a hundred times longer than a straight line.
    [pytest.param(*case, marks=[pytest.mark.full] * case[0].startswith("sea")) for case in CASES],
    ids=IDS,
)
def test_fixes_are_as_good_as_the_bound_and_say_so(name, medium, stations, truth, rows, options, seed):
    trials = 50 if medium is SEA else 25
    problem, x = problem_of(medium, stations, truth, rows, options, trials, seed + 1)
    fix = solve(problem)
    # Nothing proves that rays which bend have no other place: never ok, and never a false one.
    assert not fix.has(optloc.Status.OK).any()
    assert all(fix.answered)
    assert {c.proof for c in fix.certificate} <= {"unknown", "local"}
    error = fix.position - x[:3]
    bound = crlb(problem.take(np.array([0])), x)[..., :3, :3].reshape(3, 3)
    share = (error**2).sum(1).mean() / np.trace(bound)
    assert 0.05 < share < 3.0  # of few errors that are all but along a line: four standard deviations
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fix.covariance()), error)
    # Of a chi-square of 3: four standard deviations of the mean of so many.
    assert nees.mean() == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / trials))


def test_straight_lines_at_the_mean_speed_are_off():
    problem, x = problem_of(*CASES[1][1:], trials=4)
    straight = solve(problem.straightened(), "gtrs+lsr")
    assert np.linalg.norm(straight.position - x[:3], axis=1).min() > 10.0
    assert np.linalg.norm(solve(problem).position - x[:3], axis=1).max() < 5.0


def test_rates_along_rays_fix_what_moves(seed):
    rng = np.random.default_rng(seed)
    stations = Stations(
        np.c_[rng.uniform(-2500, 2500, (7, 2)), -rng.uniform(5, 400, 7)][None],
        tuple("ABCDEFG"),
        velocity=rng.normal(0.0, 3.0, (1, 7, 3)),
    )
    rows = [rows_of("tdoa", 7, 0.3), measured("range_rate", a=np.arange(7), sigma=0.01)]
    problem = assemble(stations, *rows, motions=(Motion(order=1),), medium=SEA)
    x = np.array([300, 500, -700, 1.0, -2.0, 0.1])
    drawn_ = simulate(problem, x, seed, trials=50)
    fix = solve(drawn_, start=np.broadcast_to(x + np.array([20, 20, 20, 0, 0, 0]), (50, 6)), method="lsr")
    error = fix.x - x
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fix.cov), error)
    assert nees.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / 50))


def test_pictures_are_drawn_of_rates_along_rays():
    stations = Stations(floor_and_surface()[None], tuple("ABCDEF"), velocity=np.ones((1, 6, 3)))
    rows = [rows_of("toa", 6, 0.3), measured("range_rate", a=np.arange(6), sigma=0.01)]
    problem = simulate(assemble(stations, *rows, medium=CRUST), np.array([300.0, 500.0, -700.0, 0.0]), 1)
    with mock.patch("optloc.show.pictures.position_lines._GRID", 63):
        figure = plot_fixes(problem, solve(problem))
    assert any("one toa" in text.get_text() for text in figure.legends[0].get_texts())


def test_a_place_that_no_ray_reaches_is_said():
    table = Layers((0, 1000), (1500, 1400))
    stations = np.array([[0, 0, -20.0], [9000, 0, -30], [0, 9000, -20], [9000, 9000, -25], [4500, 0, -40]])
    problem = assemble(stations, measured("range", np.full(5, 30e3), a=np.arange(5), sigma=1.0), medium=table)
    fix = solve(problem)
    assert not fix.answered
    assert fix.status is optloc.Status.INFEASIBLE
    assert "direct rays" in str(fix.reason)


def test_absent_rows_may_be_in_the_shadow():
    table = Layers((0, 1000), (1500, 1400))
    stations = np.array([[0, 0, -20.0], [3000, 0, -300], [0, 3000, -200], [3000, 3000, -250], [60e3, 0, -20]])
    problem = assemble(stations, measured("range", a=np.arange(4), sigma=1.0), medium=table)
    seen = simulate(problem, np.array([1000.0, 900.0, -500.0]), 1)
    z = np.append(seen.z, 0.0)
    both = assemble(stations, measured("range", z, a=np.arange(5), sigma=1.0, weight=[1, 1, 1, 1, 0]), medium=table)
    np.testing.assert_allclose(solve(both).position, solve(seen).position, atol=1e-6)


def test_locate_takes_layers():
    fix = optloc.locate(
        {"A": (0, 0, -5), "B": (900, 0, -5), "C": (0, 900, -5), "D": (900, 900, -60), "E": (400, 300, -150)},
        toa=dict(zip("ABCDE", [0.4, 0.45, 0.5, 0.55, 0.33], strict=True)),
        sigma=0.05,
        wave_speed=SEA,
    )
    assert fix.layout.find("emission")[0].unit == "m"
    with pytest.raises(InvalidProblem, match="no wave speed"):
        optloc.locate({"A": (0, 0, 0)}, ranges={"A": 1.0}, sigma=1.0, wave_speed="sound")


@pytest.mark.parametrize(
    ("stations", "row", "options", "words"),
    [
        (floor_and_surface()[:, :2], rows_of("range", 6, 1.0), {"medium": SEA}, "three dimensions"),
        (floor_and_surface() + np.array([0, 0, 400]), rows_of("range", 6, 1.0), {"medium": SEA}, "widen the table"),
        (HILLS, rows_of("range", 6, 1.0), {"medium": Atmosphere()}, "frame on Earth"),
        (
            HILLS - np.array([0, 0, 3000]),
            rows_of("range", 6, 1.0),
            {"medium": SEA, "frame": optloc.problem.ECEF},
            "third axis is up",
        ),
        (floor_and_surface(), measured("groa", a=[1, 2], b=0, sigma=0.1), {"medium": SEA}, "bent rays"),
        (floor_and_surface(), measured("ray_range", a=[1, 2], sigma=0.1), {}, "state a medium"),
    ],
)
def test_what_does_not_go_together_is_told(stations, row, options, words):
    with pytest.raises(InvalidProblem, match=words) as error:
        assemble(stations, row, **options)
    assert len(str(error.value)) < 200


def test_programs_of_ipopt_take_air_and_refuse_layers():
    problem, _ = problem_of(*CASES[-1][1:], trials=2)
    np.testing.assert_allclose(solve(problem, "roots+nlp").x, solve(problem).x, rtol=1e-5)
    problem, _ = problem_of(*CASES[0][1:], trials=2)
    with pytest.raises(InvalidProblem, match="replace the stage 'nlp'"):
        solve(problem, "roots+nlp")


# Files.

FILE = """
format = 2
{head}
[medium]
{medium}

[stations]
rows = [
  {{ name = "A", x = 0, y = 0, z = -10 }},
  {{ name = "B", x = 3000, y = 0, z = -120 }},
  {{ name = "C", x = 0, y = 3000, z = -60 }},
  {{ name = "D", x = 3000, y = 3000, z = -200 }},
  {{ name = "E", x = 1500, y = 4000, z = -20 }},
]

[[measurements]]
kind = "toa"
unit = "ms"
sigma = 0.1
rows = [{rows}]
"""
LAYERED = 'kind = "layers"\ndepths = [0, 0.03, 1]\nunit = "km"\nspeeds = [1530, 1528, 1490]'


def written(tmp_path, medium=LAYERED, head="", z=None):
    rows = ", ".join(f'{{ a = "{a}", z = {0.0 if z is None else z[i]!r} }}' for i, a in enumerate("ABCDE"))
    path = tmp_path / "sea.toml"
    path.write_text(FILE.format(medium=medium, head=head, rows=rows))
    return path


def test_a_file_says_what_its_waves_come_through(tmp_path):
    problem = optloc.load(written(tmp_path))
    assert problem.medium == Layers((0, 30, 1000), (1530, 1528, 1490))
    x = np.append([900.0, 1800.0, -400.0], 0.0)
    seen = simulate(problem, x, 3)
    z = (seen.z / problem.medium.unit_speed * 1e3).tolist()
    fix = solve(optloc.load(written(tmp_path, z=z)))
    np.testing.assert_allclose(fix.position, solve(seen).position, atol=1e-6)
    # Another reference is another unit of the same times.
    other = optloc.load(written(tmp_path, head="propagation_speed = 1400.0", z=z))
    assert other.medium.reference == 1400.0
    np.testing.assert_allclose(solve(other).position, fix.position, atol=1e-5)


@pytest.mark.parametrize(
    ("medium", "head", "words"),
    [
        ('kind = "layers"\ndepths = [0, 100]', "", "needs speeds"),
        ('kind = "layers"\ndepths = [100, 0]\nspeeds = [1500, 1400]', "", "sort the table"),
        ('kind = "layers"\ndepths = [0, 100]\nspeeds = [1500, -3]', "", "speed 2 is -3"),
        ('kind = "layers"\ndepths = [0, 100]\nspeeds = [1500, 1400]', "", "station 'B' is at depth 120 m"),
        ('kind = "layers"\ndepths = [0, 100]\nspeeds = [1500, 1400]\nrefractivity = 3.0', "", "has no 'refractivity'"),
        ('kind = "atmosphere"', "", "frame on Earth"),
        ('kind = "atmosphere"', "propagation_speed = 3e8", "remove propagation_speed"),
        ('kind = "mud"', "", "unknown"),
        (LAYERED.replace("km", "fathoms"), "", "fathoms"),
    ],
)
def test_a_file_that_says_it_wrongly_is_told(tmp_path, medium, head, words):
    with pytest.raises(InvalidProblem, match=words) as error:
        optloc.load(written(tmp_path, medium, head))
    assert len(str(error.value)) < 240


def test_refraction_needs_no_truth():
    # Aircraft on Earth: without air the ranges are off by some 30 m; with it the fix knows no more than the file.
    truth = np.array([9e4, 5e4, 10e3])
    problem, _ = problem_of(Atmosphere(), HILLS, truth, {"range": 1.0, "elevation": 2e-4}, {"frame": ENU}, trials=30)
    error = solve(problem).position - truth
    blind = solve(problem.straightened(), "gtrs+lsr").position - truth
    assert np.abs(error.mean(0)).max() < 0.5 * np.abs(blind.mean(0)).max()
    assert np.linalg.norm(blind.mean(0)) > 25.0
    assert problem.medium.unit_speed == SPEED_OF_LIGHT

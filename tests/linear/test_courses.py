"""Heights along a course: held at every epoch by LSR and NLP, exact, in bands and as reported; bounds; files."""

from dataclasses import replace

import numpy as np
import pytest
from bad_input import write
from files.test_constraint_files import ENU as HEAD, rows as inline
from often import few
from scipy.integrate import solve_ivp

from optloc import Frame, InvalidProblem, Motion, Status, assemble, constraints, measured, simulate, solve
from optloc.base.frames import ECEF, ecef_to_geodetic, geodetic_to_ecef
from optloc.base.types import Stations
from optloc.bounds.cramer_rao import crlb
from optloc.files import read
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import exact, restore, violation
from optloc.linear.courses import course_at, elapsed
from optloc.linear.evaluate import differentiate, predict
from optloc.models.course import carry
from optloc.models.primitives import WGS84_A, WGS84_F

PLACES = geodetic_to_ecef(
    np.radians([47.0, 47.4, 46.8, 47.2, 46.6]),
    np.radians([8.0, 8.9, 9.1, 7.4, 8.4]),
    np.array([400.0, 900.0, 1500.0, 600.0, 2000.0]),
)
LAT, LON = np.radians([46.9, 8.2])


def problem_of(motion, demands, *, epochs=70, step=5.0, sigma=10.0, kinds=("tdoa",), frame=ECEF):
    """Return a run of differences to the first of five stations, whose target moves."""
    pairs = {"a": np.tile([1, 2, 3, 4], epochs), "b": 0, "epoch": np.repeat(np.arange(epochs), 4)}
    rows = [measured(kind, **pairs, sigma=sigma if kind == "tdoa" else 0.05 * sigma) for kind in kinds]
    place = PLACES if frame is ECEF else frame.from_ecef(PLACES)
    stations = Stations(place[None], tuple("ABCDE"), velocity=np.zeros((1, 5, 3)))
    times = step * np.arange(epochs)
    return assemble(stations, *rows, times=times, frame=frame, motions=[motion], constraints=demands)


def state(level, order=1, frame=ECEF, speed=110.0):
    """Return a state at a height whose velocity, and turn, are level."""
    place = geodetic_to_ecef(LAT, LON, level)
    east, north, _ = ECEF.enu_axes(place)
    parts = [place, speed * (0.9 * east + 0.43 * north), 0.05 * (0.3 * east - north)][: order + 1]
    if frame is not ECEF:
        parts = [frame.from_ecef(parts[0]), *(v @ frame.rotation_to_ecef() for v in parts[1:])]
    return np.concatenate(parts)


def heights(problem, x):
    """Return the heights (k,) of a target at each epoch, by the formulas of the library of frames."""
    motion = problem.motions[0]
    parts = [tuple(x[3 * j : 3 * j + 3]) for j in range(motion.order + 1)]
    rise = 0.0 if motion.rise is None else motion.rise[..., 0]
    course = np.stack(course_at(problem, 0, parts, elapsed(problem, 0), rise), axis=-1)
    return ecef_to_geodetic(problem.frame.to_ecef(course))[2]


@pytest.mark.parametrize("turn", [0.0, 0.8, 1.57])
@pytest.mark.parametrize("lat", [0.0, 0.8, 1.4])
def test_a_course_is_the_geodesic_that_keeps_its_speed(lat, turn):
    """The geodesic is integrated on x'Ax = 1: its acceleration is along the gradient (an independent computation)."""
    square = np.array([1.0, 1.0, (1.0 - WGS84_F) ** -2]) / WGS84_A**2
    start = geodetic_to_ecef(lat, 0.3, 0.0)
    east, north, _ = ECEF.enu_axes(start)
    velocity = np.sin(turn) * east + np.cos(turn) * north

    def bend(_, y):
        x, v = y[:3], y[3:]
        return np.concatenate([v, -(square * v) @ v / ((square * x) @ (square * x)) * square * x])

    for way, limit in ((1e5, 0.015), (5e5, 1.8)):
        truth = solve_ivp(bend, (0.0, way), np.concatenate([start, velocity]), rtol=1e-13, atol=1e-6).y[:3, -1]
        found = np.array(carry(tuple(start), tuple(start + way * velocity), 0.0))
        assert np.linalg.norm(found - truth) < limit
        assert np.linalg.norm(start + way * velocity - truth) > 700.0


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("frame", [ECEF, Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)], ids=["ecef", "enu"])
def test_derivatives_and_rates_along_a_course(frame, order):
    times = 5.0 * np.arange(8)
    motion, held = constraints.reported(3e3 + 8.0 * times + 2e2 * np.sin(times / 9.0), times, order=order)
    problem = problem_of(motion, held, epochs=8, kinds=("tdoa", "fdoa"), frame=frame)
    x = state(3e3, order, frame)
    _, jacobian = differentiate(problem, x)
    for i, step in enumerate(np.repeat([1.0, 1e-2, 1e-4], 3)[: len(x)]):
        numeric = (predict(problem, x + step * np.eye(len(x))[i]) - predict(problem, x - step * np.eye(len(x))[i])) / (
            2.0 * step
        )
        np.testing.assert_allclose(jacobian[:, i], numeric, atol=1e-7 * np.abs(numeric).max())
    # rates are those of the differences of ranges along a course of constant climb
    plain = problem_of(Motion(order, over="ground"), (), epochs=8, kinds=("tdoa", "fdoa"), step=0.02, frame=frame)
    x = x + np.concatenate([np.zeros(3), 1e-2 * x[:3] / np.linalg.norm(x[:3]), np.zeros(3 * order - 3)])
    z = predict(plain, x)
    there, rate = z[:32].reshape(8, 4), z[32:].reshape(8, 4)
    np.testing.assert_allclose((there[2:] - there[:-2]) / 0.04, rate[1:-1], atol=1e-5)


CASES = {
    "level": lambda times: (Motion(1, over="ground"), constraints.height(exactly=1e4)),
    "level, referred later": lambda times: (
        Motion(1, over="ground", reference=float(times[len(times) // 2])),
        constraints.height(exactly=1e4),
    ),
    "level, turning": lambda times: (Motion(2, over="ground"), constraints.height(exactly=1e4)),
    "reported": lambda times: constraints.reported(1e4 - 6.0 * times + 50.0 * np.sin(times / 30.0), times),
}


@pytest.mark.parametrize("case", few(CASES, 2))
@pytest.mark.parametrize(
    "frame", few([Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0), ECEF], 1), ids=["enu", "ecef"]
)
def test_heights_hold_at_every_epoch(case, frame):
    # programs of long runs are for block averages, and least squares ends them
    for epochs, step, method in ((70, 5.0, "gtrs+lsr"), (8, 50.0, "gtrs+nlp")):
        times = step * np.arange(epochs)
        motion, held = CASES[case](times)
        problem = problem_of(motion, held, epochs=epochs, step=step, frame=frame)
        level = 1e4 if motion.rise is None else 1e4 + 50.0 * np.sin(times / 30.0) - 6.0 * times
        truth = restore(problem.flat(), exact(problem), state(1e4, motion.order, frame)[None])[0]
        fix = solve(simulate(problem, truth, 3), method)
        assert fix.status == Status.UNPROVEN, (method, fix.reason)
        assert np.abs(heights(problem, fix.x) - level).max() < 1e-6
        assert np.linalg.norm(fix.x[:3] - truth[:3]) < 4.0 * np.sqrt(np.trace(fix.cov[:3, :3]))
        assert {name.name.partition(" at ")[0] for name in fix.active[()]} == {"height equal"}


def test_frames_of_one_process_do_not_share_what_is_traced():
    """A batch in one local frame after one in another, and in that of the Earth: each as if it were the first."""
    times = 50.0 * np.arange(8)
    motion, held = CASES["level"](times)
    for frame in (ECEF, Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0), Frame.enu(lat_deg=-20.0, lon_deg=100.0)):
        problem = problem_of(motion, held, epochs=8, step=50.0, frame=frame)
        x = state(1e4, motion.order, frame)
        equations, linear = equations_at(problem.flat(), x[None]), differentiate(problem, x)[1]
        white = linear / 10.0  # the rows are independent, of one sigma
        np.testing.assert_allclose(equations.shared[0], white.T @ white, rtol=1e-6, atol=1e-9 * (white**2).sum())


def test_a_straight_course_leaves_the_height_that_it_has_at_the_reference_time():
    problem = problem_of(Motion(1), constraints.height(exactly=1e4, along=False))
    fix = solve(simulate(problem, state(1e4), 3), "gtrs+lsr")
    off = np.abs(heights(problem, fix.x) - 1e4)
    assert off[0] < 1e-6
    assert off[-1] > 50.0


def _scatter(trials, seed):
    problem = problem_of(Motion(1, over="ground"), constraints.height(exactly=1e4), epochs=20, step=15.0)
    truth = state(1e4)
    fix = solve(simulate(problem, truth, seed, trials), "gtrs+lsr")
    error, bound = fix.x - truth, crlb(problem, truth)
    # along the four directions that the heights leave free: the other two are known
    values, vectors = np.linalg.eigh(bound)
    free = vectors[:, 2:] / np.sqrt(values[2:])
    assert values[1] < 1e-9 * values[2]
    return ((error @ free) ** 2).mean(), fix, bound


def test_covariances_are_the_bound_and_agree_with_monte_carlo(seed):
    ratio, fix, bound = _scatter(200, seed)
    # 800 squared normal numbers: one standard deviation of their mean is 5 %
    assert abs(ratio - 1.0) < 0.2
    np.testing.assert_allclose(np.trace(fix.cov, axis1=-2, axis2=-1), np.trace(bound), rtol=0.02)


@pytest.mark.full
def test_covariances_agree_with_monte_carlo_within_five_per_cent(seed):
    assert abs(_scatter(4000, seed)[0] - 1.0) < 0.05


@pytest.mark.parametrize(
    ("low", "high", "climb", "names"),
    few(
        [
            (1.03e4, 1.1e4, 0.0, {"height lower at 0 s", "height lower at 350 s"}),
            (9e3, 1.2e4, 10.0, {"height upper at 350 s"}),
            (9.9e3, 1.01e4, 0.0, set()),
            (9e3, 9.7e3, 0.0, {"height upper at 0 s", "height upper at 350 s"}),
        ],
        2,
        4,
    ),
)
def test_bands_along_a_course(low, high, climb, names):
    held = constraints.height(low, high)
    problem = problem_of(Motion(1, over="ground"), held, epochs=15, step=25.0, sigma=30.0)
    truth = state(1e4)
    truth[3:] += climb * ECEF.enu_axes(truth[:3])[2]
    drawn = simulate(problem, truth, 2)
    fix, second = solve(drawn, "gtrs+lsr"), solve(drawn, "gtrs+nlp")
    found = heights(problem, fix.x)
    assert low - 1e-6 < found.min()
    assert found.max() < high + 1e-6
    assert {active.name for active in fix.active[()]} == names
    # an interior point method finds the same minimum, in all of space
    assert float(second.cost) == pytest.approx(float(fix.cost), rel=1e-6)
    assert violation(drawn.flat(), fix.x[None])[0] <= 1e-9
    # the multipliers push inwards: what the bound takes would lower the cost
    assert all((active.multiplier > 0.0) == ("upper" in active.name) for active in fix.active[()])


def test_free_targets_have_the_height_of_each_epoch():
    level = np.array([9e3, 1e4, 1.1e4])
    rise = np.stack([level - 9e3, 0.0 * level], axis=-1)
    problem = problem_of(Motion(span="epoch", rise=rise), constraints.height(exactly=9e3), epochs=3)
    truth = np.stack([geodetic_to_ecef(LAT + 0.01 * k, LON, h) for k, h in enumerate(level)])
    fix = solve(simulate(problem, truth.reshape(-1), 1))
    np.testing.assert_allclose(ecef_to_geodetic(fix.position)[2], level, atol=1e-6)
    assert all(one == "global" for one in np.ravel([c.proof for c in np.ravel(fix.certificate)]))


BAD = {
    "straight": (lambda: problem_of(Motion(1), constraints.height(exactly=1e4)), "no constant height.*over='ground'"),
    "box": (
        lambda: problem_of(Motion(1, over="ground"), [replace(constraints.box([0.0] * 3, [1e9] * 3)[0], along=True)]),
        "plane cannot apply along",
    ),
    "turning band": (lambda: problem_of(Motion(2, over="ground"), constraints.height(0.0)), "constant acceleration"),
    "plain frame": (lambda: assemble(PLACES, measured("range", [1.0], a=[0], sigma=1.0),
                                     motions=[Motion(1, over="ground")]), "needs a geodetic frame"),
    "over water": (lambda: problem_of(Motion(1, over="water"), ()), "over 'water'"),
    "free": (lambda: problem_of(Motion(1, span="epoch", over="ground"), ()), "only a state of the run"),
    "rise": (lambda: problem_of(Motion(1, over="ground", rise=np.zeros((3, 2))), ()), "rise of shape"),
    "rise in space": (lambda: problem_of(Motion(1, rise=np.zeros((70, 2))), ()), "does not fit this motion"),
    "rise nan": (lambda: problem_of(Motion(1, over="ground", rise=np.full((70, 2), np.nan)), ()), "a rise is"),
    "report": (lambda: constraints.reported([1.0, 2.0], [0.0]), "one height for each epoch"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_is_said(case):
    make, message = BAD[case]
    with pytest.raises(InvalidProblem, match=message):
        make()


# Files: a height of a target that moves is one along its course.


def moving(demand, motion="constant_velocity", epochs=5):
    table = [{"a": a, "z": 5e3, "time": 10.0 * k} for k in range(epochs) for a in "ABCD"]
    target = f'[target]\nmotion = "{motion}"\n'
    return f'{HEAD}[[measurements]]\nkind = "range"\nsigma = 5.0\n{inline(table)}{target}[[constraints]]\n{demand}'


@pytest.fixture
def loaded(tmp_path):
    return lambda demand, motion="constant_velocity": read(write(tmp_path, moving(demand, motion))).problem


def test_files_hold_heights_along_courses(loaded):
    problem = loaded('kind = "height"\nexactly = "900 m"\n')
    assert problem.motions[0].over == "ground"
    assert problem.constraints[0].along
    assert len(exact(problem)) == 2
    problem = loaded('kind = "height"\nexactly = "900 m"\nalong = false\n')
    assert (problem.motions[0].over, len(exact(problem))) == ("space", 1)
    levels = 'kind = "height"\nexactly = [0.9, 1.0, 1.0, 1.1, 1.2]\nunit = "km"\nwithin = "50 m"\n'
    problem = loaded(levels)
    band = problem.constraints[0]
    assert (float(band.lower), float(band.upper)) == (850.0, 950.0)
    np.testing.assert_allclose(problem.motions[0].rise[:, 0], [0.0, 100.0, 100.0, 200.0, 300.0])
    free = loaded('kind = "height"\nexactly = [900.0, 1000.0, 1000.0, 1100.0, 1200.0]\n', "free")
    assert (free.motions[0].span, float(free.constraints[0].lower)) == ("epoch", 900.0)
    # a height that may curve is bounded at one time
    turning = loaded('kind = "above-ground"\n', "constant_acceleration")
    assert (turning.constraints[0].along, turning.motions[0].over) == (False, "space")


@pytest.mark.parametrize(
    ("demand", "motion", "message"),
    [
        ('kind = "height"\nexactly = [1.0, 2.0]\n', "constant_velocity", "2 heights for 5 epochs"),
        ('kind = "height"\nexactly = [1.0, 2.0, 3.0, 4.0, 5.0]\n', "static", "one height"),
        (
            'kind = "height"\nexactly = [1.0, 2.0, 3.0, 4.0, 5.0]\nalong = false\n',
            "constant_velocity",
            "remove along",
        ),
        ('kind = "height"\nmin = 3.0\nwithin = "1 m"\n', "constant_velocity", "'within' needs"),
        ('kind = "height"\nexactly = 3.0\nwithin = "-1 m"\n', "constant_velocity", "negative width"),
        ('kind = "height"\nmin = 0.0\nalong = true\n', "constant_acceleration", "constant acceleration"),
    ],
)
def test_files_say_what_heights_cannot_be(loaded, demand, motion, message):
    with pytest.raises(InvalidProblem, match=message):
        loaded(demand, motion)

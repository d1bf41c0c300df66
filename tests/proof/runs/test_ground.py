"""Targets that keep a known height: bounds over boxes of states against the values there, and claims against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from descent import levenberg
from often import few
from proof.sampling import many

from optloc import Frame, Motion, Status, assemble, certify, constraints, measured, simulate, solve
from optloc.kernels.jit import enabled
from optloc.linear.constraints import exact, levels, restore
from optloc.models.course import carry
from optloc.problem import Prior
from optloc.proof.runs.ground import (
    Ground,
    axes_at,
    corners_on,
    curvature_bounds,
    errors_of,
    horizontal_vector,
    lift,
    place_over_ground,
    set_reached,
    set_second,
    set_starts,
    slope_of,
    state_off,
    state_on,
)
from optloc.proof.runs.rows import residual_at, rounding_of_residual
from optloc.proof.runs.run_costs import course_costs
from optloc.proof.runs.state_bounds import has_no_minimum, hessian_of_state, is_convex, least_length, set_lines, sum_up
from optloc.proof.runs.states import StateAxes, cost_of_state, put, set_bends, set_box, table_of
from optloc.proof.scope import why_unsupported
from optloc.solvers.certificates.position_cost import state_columns

Array = np.ndarray
pytestmark = pytest.mark.skipif(not enabled(), reason="runs are proven by machine code")

# Greatest coordinate and speed of what is sought.
REACH, FAST = 1.5e5, 400.0
SIZE = {"tdoa": 30.0, "range": 30.0, "azimuth": 0.01, "toa": 30.0}
KINDS = (("tdoa",), ("range",), ("azimuth",), ("tdoa", "azimuth"), ("toa",))
SPREAD = np.array([1e3, 1e3, 10.0, 10.0])


def frame_of(rng: np.random.Generator) -> Frame:
    return Frame.enu(lat_deg=rng.uniform(-88.0, 88.0), lon_deg=rng.uniform(-180.0, 180.0))


def drawn(rng: np.random.Generator, kinds: tuple[str, ...], **more):
    """Return a problem of five stations and a target at a known height, and its truth: position and velocity."""
    epochs, count, spread = int(rng.integers(5, 16)), 5, 10.0 ** rng.uniform(4.0, 5.0)
    times = np.sort(rng.uniform(0.0, rng.uniform(60.0, 300.0), epochs))
    place = np.column_stack([rng.uniform(-spread, spread, (count, 2)), rng.uniform(0.0, 500.0, count)])
    rows = []
    for kind in kinds:
        a = np.tile(np.arange(1 if kind == "tdoa" else 0, count), epochs)
        weight = (rng.uniform(size=len(a)) > 0.1) * 1.0
        epoch = np.repeat(np.arange(epochs), len(a) // epochs)
        rows.append(measured(kind, a=a, b=0 if kind == "tdoa" else None, epoch=epoch, sigma=SIZE[kind], weight=weight))
    height = rng.uniform(0.0, 12_000.0)
    if rng.uniform() < 0.5:  # as aircraft report it
        heights = height + np.cumsum(rng.normal(0.0, 50.0, epochs))
        motion, held = constraints.reported(heights, times, reference=float(times.mean()))
    else:
        motion = Motion(1, reference=float(times.mean()), over="ground")
        held = constraints.height(exactly=height)
    limits = (*constraints.box([-REACH, -REACH, -np.inf], [REACH, REACH, np.inf]), *constraints.speed(FAST), *held)
    made = assemble(place, *rows, times=times, frame=frame_of(rng), motions=(motion,), constraints=limits, **more)
    x = np.zeros(made.layout.size)
    x[:2], x[2], x[3:5] = rng.uniform(-spread, spread, 2), height, rng.normal(0.0, 100.0, 2)
    if kinds == ("toa",):
        x[6:] = 1e3 * rng.normal(size=len(x) - 6)
    return made, restore(made.flat(), exact(made.flat()), x[None])[0]


def surface(rng: np.random.Generator, span: float) -> Ground:
    """Return a surface somewhere on the Earth, and axes that lean."""
    frame, lean = frame_of(rng), np.linalg.qr(np.eye(3) + 0.2 * rng.normal(size=(3, 3)))[0]
    lean = lean * np.sign(np.diag(lean))
    data = np.concatenate([np.zeros(3), frame.origin_ecef(), frame.rotation_to_ecef().ravel()])
    return Ground(data, np.ascontiguousarray(lean.T), rng.uniform(0.0, 12_000.0), rng.normal(0.0, 200.0, 3), span)


# Places and their derivatives.


def place_of(ground: Ground, q: Array, way: Array, rise: float) -> Array:
    off, place, normal = lift(ground, q[0], q[1])
    assert abs(off) < 1e-6
    return np.array(place_over_ground(ground, place, horizontal_vector(ground, normal, way[0], way[1]), rise))


@pytest.mark.usefixtures("form")
def test_places_are_those_of_the_model(seed):
    rng = np.random.default_rng([1, seed])
    for _ in range(200):
        ground = surface(rng, 1.0)
        turn = ground.data[6:15].reshape(3, 3)
        start = np.array(lift(ground, *rng.uniform(-2e5, 2e5, 2))[1]) + rng.normal(0.0, 100.0, 3)
        way, rise = rng.normal(size=3) * 10.0 ** rng.uniform(0.0, 5.5), rng.normal(0.0, 100.0)
        own = np.array(place_over_ground(ground, tuple(start), tuple(way), rise))
        begun, led = turn @ start + ground.data[3:6], turn @ (start + way) + ground.data[3:6]
        model = np.array(carry(tuple(begun), tuple(led), rise))
        assert np.allclose(turn @ own + ground.data[3:6], model, rtol=0.0, atol=2e-8)


@pytest.mark.usefixtures("form")
def test_states_on_the_surface_keep_height_and_direction(seed):
    rng = np.random.default_rng([2, seed])
    for _ in range(30):
        problem, x = drawn(rng, ("range",))
        ground = course_costs(problem.flat()).courses[0][0].ground
        ground = ground._replace(axes=axes_at(ground.data, x[:3]))
        assert np.array_equal(ground.axes, np.eye(3))  # the frame's, as the region is in them
        back = state_off(ground, state_on(ground, x[:6]))
        assert np.allclose(back, x[:6], rtol=0.0, atol=1e-6)
        whole = x.copy()
        whole[:6] = state_off(ground, state_on(ground, x[:6]) + rng.uniform(-1.0, 1.0, 4) * [1e5, 1e5, 200.0, 200.0])
        values, _ = levels(problem.flat(), exact(problem.flat()), whole[None])
        assert np.abs(values).max() < 1e-6
        box = np.stack([x[:6] - 1.0, x[:6] + 1.0])
        box[:, [2, 5]] = [[-np.inf], [np.inf]]
        assert np.allclose(corners_on(ground, box), box[:, [0, 1, 3, 4]])


@pytest.mark.usefixtures("form")
def test_bounds_of_derivatives_hold_along_any_line(seed):
    """Against differences of fourth order along lines through random boxes, up to a twentieth of the Earth wide."""
    rng, tight = np.random.default_rng([3, seed]), []
    step = 2e4  # metres: rounding of 1e-9 m leaves 1e-22 of third derivatives, which are 1e-14
    for _ in range(300):
        ground = surface(rng, 1.0)
        state = np.concatenate([rng.uniform(-4e5, 4e5, 2), rng.uniform(-3e5, 3e5, 2)])
        half = 10.0 ** rng.uniform(0.0, 5.0) * rng.uniform(size=4)
        good, *bounds = curvature_bounds(ground, state, half + 2.0 * step)
        assert good
        at, way = state + rng.uniform(-1.0, 1.0, 4) * half, rng.normal(size=4)
        way /= np.linalg.norm(way)
        rise = ground.rise[0]
        f = [place_of(ground, (at + k * step * way)[:2], (at + k * step * way)[2:], rise) for k in (-2, -1, 0, 1, 2)]
        first = (f[0] - 8.0 * f[1] + 8.0 * f[3] - f[4]) / (12.0 * step)
        second = (-f[0] + 16.0 * f[1] - 30.0 * f[2] + 16.0 * f[3] - f[4]) / (12.0 * step**2)
        third = (f[4] - 2.0 * f[3] + 2.0 * f[1] - f[0]) / (2.0 * step**3)
        sizes = [np.linalg.norm(each) for each in (first, second, third)]
        assert all(size <= bound for size, bound in zip(sizes, bounds, strict=True)), (sizes, bounds)
        tight.append(sizes[1] / bounds[1])
    assert max(tight) > 0.05  # a bound that says something


@pytest.mark.usefixtures("form")
def test_differences_are_as_exact_as_they_say(seed):
    rng = np.random.default_rng([4, seed])
    for _ in range(100):
        ground = surface(rng, 300.0)._replace(rise=np.array([10.0]))
        state, time = np.concatenate([rng.uniform(-3e5, 3e5, 2), rng.uniform(-300.0, 300.0, 2)]), rng.uniform(-300, 300)
        starts, reached, own = np.zeros((21, 6)), np.zeros((21, 3)), np.zeros((4, 4))
        set_starts(ground, state, 0, 21, starts)
        set_reached(ground, state, time, 10.0, starts, 0, 21, reached)
        _, _, _, third = curvature_bounds(ground, state, np.zeros(4))
        first, second = errors_of(third)
        slope = np.array([[slope_of(reached, i, a) for a in range(4)] for i in range(3)])
        bent = np.empty((3, 4, 4))
        for i in range(3):
            set_second(reached, i, own)
            bent[i] = own
        step, way = 1e3, rng.normal(size=4)
        way /= np.linalg.norm(way)
        at = np.concatenate([state[:2], time * state[2:]])
        f = [place_of(ground, (at + k * step * way)[:2], (at + k * step * way)[2:], 10.0) for k in (-2, -1, 0, 1, 2)]
        along = (f[0] - 8.0 * f[1] + 8.0 * f[3] - f[4]) / (12.0 * step)
        twice = (-f[0] + 16.0 * f[1] - 30.0 * f[2] + 16.0 * f[3] - f[4]) / (12.0 * step**2)
        assert np.linalg.norm(slope @ way - along) <= first + 1e-11
        assert np.linalg.norm(way @ bent @ way - twice) <= second + 1e-13


# Bounds of costs.


def boxes(rng: np.random.Generator, count: int):
    """Yield courses with axes, tables and boxes that are set: around the truth and far off, tiny and huge."""
    for number in range(count):
        made, truth = drawn(rng, KINDS[number % len(KINDS)])
        problem = simulate(made, truth=truth, seed=number).flat()
        course = course_costs(problem).courses[0][0]
        off = 10.0 ** rng.uniform(0.0, 4.5)
        turn = np.diag([1.0, 1.0, 0.01, 0.01]) @ rng.normal(size=(4, 4))
        origin = state_on(course.ground, truth[:6]) + off * np.array([1.0, 1.0, 0.01, 0.01]) * rng.normal(size=4)
        axes = StateAxes(origin, np.ascontiguousarray(turn), np.linalg.inv(turn), np.zeros((2, 4)))
        table = table_of(course)
        put(table, np.zeros(4), 10.0 ** rng.uniform(-1.0, 4.0) * rng.uniform(0.1, 1.0, 4))
        set_box(course, axes, table)
        yield course, axes, table


def inside(rng: np.random.Generator, axes: StateAxes, table, count: int) -> Array:
    """Return states (count, 4) of a box, many of them at its faces and corners."""
    s = np.clip(rng.uniform(-1.5, 1.5, (count, 4)), -1.0, 1.0) * table.half
    return axes.origin + s @ axes.turn.T


@pytest.mark.usefixtures("form")
def test_no_point_costs_less_than_its_box(seed):
    rng, told = np.random.default_rng([5, seed]), 0
    for course, axes, table in boxes(rng, 25):
        here = residual_at(course.rows, table.nodes, table.sheet)
        noise = rounding_of_residual(course.rows, 1e7, table.nodes)
        set_lines(course, table)
        low = least_length(course, table, here, False)
        set_bends(course, axes, table)
        low = max(low, least_length(course, table, here, True)) - noise
        states = [state_off(course.ground, state) for state in inside(rng, axes, table, 25)]
        cost = min(cost_of_state(course, state)[0] for state in states)
        assert low <= np.sqrt(cost) * (1.0 + 1e-9) + 1e-6
        told += low > 0.0
    assert told > 5


@pytest.mark.usefixtures("form")
def test_no_state_of_a_box_has_a_hessian_beyond_its_bounds(seed):
    rng, convex, empty = np.random.default_rng([6, seed]), 0, 0
    for course, axes, table in boxes(rng, many(25, 10)):
        residual_at(course.rows, table.nodes, table.sheet)
        set_lines(course, table)
        set_bends(course, axes, table)
        ball, noise = sum_up(course, table, rounding_of_residual(course.rows, 1e7, table.nodes))
        states, good = inside(rng, axes, table, many(20, 6)), is_convex(table, ball, 0.0)
        convex += good
        for state in states if ball < np.inf else ():
            bent = axes.turn.T @ hessian_of_state(course, state) @ axes.turn * table.half * table.half[:, None]
            assert not good or np.linalg.eigvalsh(bent)[0] > 0.0
            beyond = np.maximum(np.abs(bent - table.hessian) - table.change, 0.0)
            assert np.linalg.norm(beyond, 2) <= ball * (1.0 + 1e-6) + 1e-6 * np.abs(table.hessian).max()
        empty += has_no_minimum(table, ball, noise)
    assert convex > many(3, 0)
    assert empty > many(3, 0)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("count", few([4, 10], 1))
def test_hessians_are_those_of_the_cost(seed, count):
    rng = np.random.default_rng([7, seed])
    for number in range(count):
        made, truth = drawn(rng, KINDS[number % 4])
        course = course_costs(simulate(made, truth=truth, seed=number).flat()).courses[0][0]
        state = state_on(course.ground, truth[:6]) + rng.normal(size=4) * [3e3, 3e3, 20.0, 20.0]
        scale = np.array([20.0, 20.0, 0.2, 0.2])
        moves = np.diag(scale)

        def cost(s: Array, course=course) -> float:
            return cost_of_state(course, state_off(course.ground, s))[0]

        bent = [[cost(state + a + b) - cost(state + a - b) for b in moves] for a in moves]
        bent = (bent - np.array([[cost(state - a + b) - cost(state - a - b) for b in moves] for a in moves])) / 8.0
        own = hessian_of_state(course, state) * scale * scale[:, None]
        assert np.abs(bent - own).max() < 1e-3 * np.abs(own).max()


# Claims against an independent search.


def residuals(problem, state: Array) -> Array:
    """Return the residuals of uncorrelated rows at a state (6,), written out but for the course."""
    since, stations = problem.times - problem.motions[0].reference, problem.stations.position[0]
    turn, origin = problem.frame.rotation_to_ecef(), problem.frame.origin_ecef()
    rise = 0.0 if problem.motions[0].rise is None else problem.motions[0].rise[..., 0].ravel()
    led = turn @ (state[:3, None] + since * state[3:, None]) + origin[:, None]
    begun = np.broadcast_to((turn @ state[:3] + origin)[:, None], led.shape)
    place = (np.array(carry(tuple(begun), tuple(led), rise)) - origin[:, None]).T @ turn
    out = []
    for rows in problem.rows:
        away = place[rows.epoch] - stations[rows.a]
        bearing = np.arctan2(away[:, 1], away[:, 0])
        value = bearing if rows.kind == "azimuth" else np.linalg.norm(away, axis=1)
        if rows.kind == "tdoa":
            value = value - np.linalg.norm(place[rows.epoch] - stations[rows.b], axis=1)
        off = rows.z - value
        off = np.arctan2(np.sin(off), np.cos(off)) if rows.kind == "azimuth" else off
        out.append(off * np.sqrt(rows.weight) / SIZE[rows.kind])
    return np.concatenate(out)


def minima(problem, rng: np.random.Generator, near: Array, starts: int) -> list[tuple[float, Array]]:
    """Return the minima within the limits that SciPy finds, costs and states (4,) on the surface."""
    ground, found = course_costs(problem.flat()).courses[0][0].ground, []
    most = np.array([REACH, REACH, FAST, FAST])
    draws = rng.uniform(-1.0, 1.0, (starts, 4)) * most * rng.choice([0.2, 1.0], (starts, 1))
    for state in [near, *draws]:
        with np.errstate(all="ignore"):
            done = levenberg(lambda s: residuals(problem, state_off(ground, s * SPREAD)), state / SPREAD, most=1500)
        x = done.x * SPREAD
        if np.isfinite(done.cost) and np.abs(done.fun @ done.jac).max() < 1e-3 and (np.abs(x) <= most).all():
            found.append((2.0 * done.cost, x))
    return found


def attacked(seed: int, count: int, starts: int) -> tuple[int, int]:
    """Return how many fixes were proven within their limits, and of how many; assert that SciPy refutes none."""
    proven = total = 0
    for number in range(count):
        rng = np.random.default_rng([20261124, seed, number])
        made, truth = drawn(rng, KINDS[number % 4])
        problem = simulate(made, truth=truth, seed=number)
        fix = solve(problem)
        if not fix.answered:
            continue
        total += 1
        claim = fix.certificate
        if claim.proof != "region":
            continue
        proven += claim.unique
        own = state_columns(problem)
        listed = [x[own][[0, 1, 3, 4]] for x in [fix.x, *fix.alternatives.x] if np.isfinite(x).all()]
        for cost, x in minima(problem, rng, truth[[0, 1, 3, 4]], starts):
            assert cost > fix.cost - 1e-4 * (1.0 + fix.cost), (seed, number, cost, fix.cost, x)
            if claim.unique and cost < fix.cost + claim.margin - 1e-2:
                near = [np.abs((x - other) / SPREAD).max() for other in listed]
                assert min(near) < 0.1, (seed, number, cost - fix.cost, x, listed)
    return proven, total


def test_claims_hold_against_other_searches(seed):
    proven, total = attacked(seed, 4, 4)
    assert proven >= 0.5 * total > 1


@pytest.mark.full
def test_claims_hold_against_other_searches_in_full(seed):
    proven, total = attacked(seed, 100, 25)
    assert proven >= 0.7 * total


def simple(**more):
    """Return an aircraft at a reported height, ranges from five stations, and its truth."""
    times, place = (
        10.0 * np.arange(8),
        np.array([[-3e4, 0, 0], [3e4, 1e3, 200], [0, 3e4, 0], [5e3, -2e4, 100], [0, 0, 0.0]]),
    )
    rows = measured("range", a=np.tile(np.arange(5), 8), epoch=np.repeat(np.arange(8), 5), sigma=20.0)
    limits = constraints.box([-REACH, -REACH, -np.inf], [REACH, REACH, np.inf])
    held = more.pop("held", constraints.height(exactly=1e4))
    settings = {"motions": (Motion(1, over="ground"),), "constraints": (*limits, *constraints.speed(FAST), *held)}
    made = assemble(place, rows, times=times, frame=Frame.enu(lat_deg=48.0, lon_deg=11.0), **settings | more)
    x = np.zeros(made.layout.size)
    x[:6] = [2e4, 1.5e4, 1e4, 150.0, -100.0, 0.0]
    return made, restore(made.flat(), exact(made.flat()), x[None])[0]


def test_who_states_a_box_and_a_speed_gets_ok():
    made, truth = simple()
    fix = solve(simulate(made, truth=truth, seed=1))
    assert fix.status == Status.OK
    assert fix.certificate.unique
    assert len(fix.certificate.region[0]) == 4  # a height that is known is not limited
    assert "at a velocity from (-400, -400) to (400, 400) m/s" in fix.certificate.reason


def test_a_region_may_be_asked_for():
    made, truth = simple(constraints=constraints.height(exactly=1e4))
    problem = simulate(made, truth=truth, seed=1)
    fix = solve(problem)
    assert fix.status == Status.UNPROVEN
    assert "add constraints: a box and a greatest speed" in fix.certificate.reason
    corners = [-1e5, -1e5, -1e5, -300.0, -300.0, -300.0], [1e5, 1e5, 1e5, 300.0, 300.0, 300.0]
    asked = certify(problem, fix, corners)
    assert asked.status == Status.OK
    assert asked.certificate.region == ((-1e5, -1e5, -300.0, -300.0), (1e5, 1e5, 300.0, 300.0))


def test_frames_of_the_earth_need_no_axes_upward():
    made, truth = simple()
    frame = made.frame
    turn, origin = frame.rotation_to_ecef(), frame.origin_ecef()
    place = made.stations.position[0] @ turn.T + origin
    rows = measured("range", a=np.tile(np.arange(5), 8), epoch=np.repeat(np.arange(8), 5), sigma=20.0)
    around = turn @ truth[:3] + origin
    limits = (*constraints.box(around - 3e4, around + 3e4), *constraints.speed(FAST), *constraints.height(exactly=1e4))
    ecef = assemble(
        place,
        rows,
        times=made.times,
        frame=Frame("ecef"),
        motions=(Motion(1, over="ground"),),
        constraints=limits,
    )
    fix = solve(simulate(ecef, truth=np.concatenate([around, turn @ truth[3:6]]), seed=1))
    assert fix.status == Status.OK
    assert fix.certificate.unique


def test_a_mirror_image_is_listed():
    line = np.column_stack([np.linspace(-3e4, 3e4, 5), np.zeros(5), np.zeros(5)])
    made, truth = simple()
    made = assemble(
        line,
        measured("range", a=np.tile(np.arange(5), 8), epoch=np.repeat(np.arange(8), 5), sigma=20.0),
        times=made.times,
        frame=Frame.enu(lat_deg=0.0, lon_deg=11.0),
        motions=made.motions,
        constraints=made.constraints,
    )
    truth = restore(made.flat(), exact(made.flat()), truth[None])[0]
    fix = solve(simulate(made, truth=truth, seed=4))
    assert fix.status == Status.AMBIGUOUS
    assert fix.certificate.unique
    other = fix.alternatives.x[0][:6]
    assert np.allclose(other * [1.0, -1.0, 1.0, 1.0, -1.0, 1.0], fix.x[:6], atol=[2.0, 2.0, 2.0, 0.1, 0.1, 0.1])


def test_covariances_of_heights_that_are_kept_are_covered():
    """A fix of metres is not curved: other unknowns keep to the height as well when its neighbourhood is looked at."""
    made, truth = simple()
    for number in range(2):
        assert solve(simulate(made, truth=truth, seed=number)).status != Status.CURVED


@pytest.mark.parametrize(
    ("what", "word"),
    [
        ({"motions": (Motion(2, over="ground"),)}, "accelerates"),
        ({"held": constraints.height(9e3, 1.1e4)}, "over ground"),
        ({"held": constraints.height(exactly=1e4, along=False)}, "over ground"),
        ({"priors": (Prior("velocity", np.zeros(3), np.eye(3)),)}, "prior on velocity"),
    ],
)
def test_what_is_not_covered_is_said(what, word):
    assert word in why_unsupported(simple(**what)[0].flat())


@pytest.mark.parametrize("number", few((1, 0, 2), 1))  # the first is proven in a second, the next in half a minute
def test_azimuths_alone_begin_in_the_plan(seed, number):
    """They say nothing of the height, which is known: no search is needed, and none finds a wrong minimum."""
    rng = np.random.default_rng([8, seed, number])
    made, truth = drawn(rng, ("azimuth",))
    fix = solve(simulate(made, truth=truth, seed=number))
    assert "search" not in [stage.name for stage in fix.stages]
    assert np.sum((fix.x[[0, 1]] - truth[[0, 1]]) ** 2) < 50.0 * np.trace(fix.cov[:2, :2])

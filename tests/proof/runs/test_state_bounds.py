"""Targets in uniform motion: bounds over boxes of states against the cost at their points, and claims against SciPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from descent import levenberg
from often import few
from proof.sampling import many

from optloc import Motion, Status, assemble, certify, constraints, measured, simulate, solve, with_bias
from optloc.kernels.jit import enabled
from optloc.problem import Prior
from optloc.proof.runs.rows import residual_at, rounding_of_residual
from optloc.proof.runs.run_costs import course_costs
from optloc.proof.runs.state_bounds import (
    has_no_minimum,
    hessian_of_state,
    is_convex,
    least_length,
    set_lines,
    sum_up,
)
from optloc.proof.runs.states import StateAxes, cost_of_state, put, set_bends, set_box, table_of
from optloc.proof.scope import why_unsupported
from optloc.solvers.certificates.position_cost import state_columns

Array = np.ndarray
pytestmark = pytest.mark.skipif(not enabled(), reason="runs are proven by machine code")

# Greatest coordinate and speed of what is sought.
REACH, FAST = 1e5, 400.0
SIZE = {"tdoa": 30.0, "range": 30.0, "toa": 30.0, "azimuth": 0.01, "groa": 0.02}
KINDS = (("tdoa",), ("range",), ("azimuth",), ("tdoa", "azimuth"), ("groa", "range"), ("toa",), ("tdoa", "groa"))


def drawn(rng: np.random.Generator, kinds: tuple[str, ...], out: float = 1.0, **more):
    """Return a problem of four stations over some epochs, and its truth: position and velocity."""
    epochs, count = int(rng.integers(6, 25)), 4
    times = np.sort(rng.uniform(0.0, rng.uniform(60.0, 300.0), epochs))
    place = rng.uniform(-2e4, 2e4, (count, 2))
    if rng.uniform() < 0.5:  # stations that move
        place = place + times[:, None, None] * rng.normal(0.0, 40.0, (count, 2))
    rows = []
    for kind in kinds:
        two = kind in ("tdoa", "groa")
        a = np.tile(np.arange(1 if two else 0, count), epochs)
        weight = (rng.uniform(size=len(a)) > 0.1) * 1.0
        epoch = np.repeat(np.arange(epochs), len(a) // epochs)
        rows.append(measured(kind, a=a, b=0 if two else None, epoch=epoch, sigma=SIZE[kind], weight=weight))
    truth = np.concatenate([out * rng.uniform(-2e4, 2e4, 2), rng.normal(0.0, 100.0, 2)])
    made = assemble(place, *rows, times=times, motions=(Motion(1, reference=float(times.mean())),), **more)
    emissions = [1e3 * rng.normal(size=epochs)] if kinds == ("toa",) else []
    return made, np.concatenate([truth, *emissions])


def limits() -> tuple:
    return (*constraints.box([-REACH, -REACH], [REACH, REACH]), *constraints.speed(FAST))


def spoiled(rng: np.random.Generator, made):
    """Return a problem with what else a proof takes: clocks, and what is known of the state."""
    if made.rows[0].kind in ("tdoa", "range"):
        made = with_bias(made, "late", kind=made.rows[0].kind, members=["S1"], sigma=[20.0, None][int(rng.integers(2))])
    priors = [Prior("position", rng.uniform(-2e4, 2e4, 2), 9e6 * np.eye(2))]
    priors += [Prior("velocity", rng.normal(0.0, 50.0, 2), 900.0 * np.eye(2) + 200.0)]
    return replace(made, priors=tuple(p for p in priors if rng.uniform() < 0.5))


def boxes(rng: np.random.Generator, count: int):
    """Yield courses with axes, tables and boxes that are set: around the truth and far off, tiny and huge."""
    for number in range(count):
        made, truth = drawn(rng, KINDS[number % len(KINDS)])
        made = spoiled(rng, made) if number % 2 else made
        x = np.zeros(made.layout.size)
        x[: len(truth)] = truth
        problem = simulate(made, truth=x, seed=number).flat()
        course = course_costs(problem).courses[0][0]
        off = 10.0 ** rng.uniform(0.0, 4.5)
        origin = truth[:4] + off * np.array([1.0, 1.0, 0.01, 0.01]) * rng.normal(size=4)
        turn = np.diag([1.0, 1.0, 0.01, 0.01]) @ rng.normal(size=(4, 4))
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
@pytest.mark.parametrize("count", few([42, 140], 1))
def test_no_point_costs_less_than_its_box(seed, count):
    rng, told = np.random.default_rng([1, seed]), 0
    for course, axes, table in boxes(rng, many(count, 14)):
        here = residual_at(course.rows, table.nodes, table.sheet)
        noise = rounding_of_residual(course.rows, 1.0, table.nodes)
        set_lines(course, table)
        low = least_length(course, table, here, False)
        set_bends(course, axes, table)
        low = max(low, least_length(course, table, here, True)) - noise
        cost = min(cost_of_state(course, state)[0] for state in inside(rng, axes, table, many(100, 20)))
        assert low <= np.sqrt(cost) * (1.0 + 1e-9) + 1e-9
        told += low > 0.0
    assert told > many(count // 4, 4)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("count", few([42, 140], 1))
def test_no_state_of_a_box_has_a_hessian_beyond_its_bounds(seed, count):
    rng, convex, empty = np.random.default_rng([2, seed]), 0, 0
    for course, axes, table in boxes(rng, many(count, 8)):
        residual_at(course.rows, table.nodes, table.sheet)
        set_lines(course, table)
        set_bends(course, axes, table)
        ball, noise = sum_up(course, table, rounding_of_residual(course.rows, 1.0, table.nodes))
        states, good = inside(rng, axes, table, many(20, 8)), is_convex(table, ball, 0.0)
        convex += good
        for state in states if ball < np.inf else ():
            bent = axes.turn.T @ hessian_of_state(course, state) @ axes.turn * table.half * table.half[:, None]
            assert not good or np.linalg.eigvalsh(bent)[0] > 0.0
            beyond = np.maximum(np.abs(bent - table.hessian) - table.change, 0.0)
            assert np.linalg.norm(beyond, 2) <= ball * (1.0 + 1e-6) + 1e-9 * np.abs(table.hessian).max()
        if has_no_minimum(table, ball, noise):
            empty += 1
            for state in states[:5]:
                assert not descends_inside(course, axes, table.half, state)
    assert convex > many(count // 7, 1)
    assert empty > many(count // 7, 1)


def descends_inside(course, axes: StateAxes, half: Array, state: Array) -> bool:
    """Return whether a descent from a state of a box finds a minimum well inside of it."""

    def slope(s: Array) -> Array:
        step = 1e-4
        ends = [cost_of_state(course, axes.origin + axes.turn @ ((s + move) * half))[0] for move in step * MOVES]
        return (np.array(ends[:4]) - ends[4:]) / (2.0 * step)

    s = axes.back @ (state - axes.origin) / half
    for _ in range(15):
        bent = axes.turn.T @ hessian_of_state(course, axes.origin + axes.turn @ (s * half)) @ axes.turn
        bent = bent * half * half[:, None]
        if not np.linalg.eigvalsh(bent)[0] > 0.0:
            return False
        step = -0.5 * np.linalg.solve(bent, slope(s))
        s = s + step
        if not np.abs(s).max() < 0.99:
            return False
        if np.abs(step).max() < 1e-6:
            return True
    return False


MOVES = np.concatenate([np.eye(4), -np.eye(4)])


# Claims against an independent search.


def residuals(problem, state: Array) -> Array:
    """Return the residuals of uncorrelated rows at a state (4,), written out."""
    out = []
    since = problem.times - problem.motions[0].reference
    place = state[:2] + since[:, None] * state[2:]
    for rows in problem.rows:
        stations = np.broadcast_to(problem.stations.position, (problem.epochs, *problem.stations.position.shape[1:]))
        away = place[rows.epoch] - stations[rows.epoch, rows.a]
        reach = np.hypot(*away.T)
        if rows.kind == "azimuth":
            value = np.arctan2(away[:, 1], away[:, 0])
        elif rows.kind == "range":
            value = reach
        else:
            other = np.hypot(*(place[rows.epoch] - stations[rows.epoch, rows.b]).T)
            value = reach - other if rows.kind == "tdoa" else reach / other
        off = rows.z - value
        off = np.arctan2(np.sin(off), np.cos(off)) if rows.kind == "azimuth" else off
        out.append(off * np.sqrt(rows.weight) / SIZE[rows.kind])
    return np.concatenate(out)


def slopes(problem, state: Array) -> Array:
    """Return the derivatives (m, 4) of the residuals."""
    out = []
    since = problem.times - problem.motions[0].reference
    place = state[:2] + since[:, None] * state[2:]
    stations = np.broadcast_to(problem.stations.position, (problem.epochs, *problem.stations.position.shape[1:]))
    for rows in problem.rows:
        away = place[rows.epoch] - stations[rows.epoch, rows.a]
        reach = np.hypot(*away.T)[:, None]
        line = away / reach
        if rows.kind == "azimuth":
            line = np.stack([-away[:, 1], away[:, 0]], axis=-1) / reach**2
        elif rows.kind != "range":
            across = place[rows.epoch] - stations[rows.epoch, rows.b]
            other = np.hypot(*across.T)[:, None]
            line = line - across / other if rows.kind == "tdoa" else (line - reach * across / other**2) / other
        line = -line * (np.sqrt(rows.weight) / SIZE[rows.kind])[:, None]
        out.append(np.concatenate([line, since[rows.epoch, None] * line], axis=1))
    return np.concatenate(out)


def minima(problem, rng: np.random.Generator, near: Array, starts: int) -> list[tuple[float, Array]]:
    """Return the minima within the limits that SciPy finds, costs and states."""
    scale, found = np.array([1e3, 1e3, 10.0, 10.0]), []
    draws = rng.uniform(-1.0, 1.0, (starts, 4)) * [REACH, REACH, FAST, FAST] * rng.choice([0.2, 1.0], (starts, 1))
    for state in [near, *draws]:
        start = state / scale
        done = levenberg(lambda s: residuals(problem, s * scale), start, lambda s: slopes(problem, s * scale) * scale)
        x = done.x * scale
        if (
            np.isfinite(done.cost)
            and np.abs(done.fun @ done.jac).max() < 1e-3
            and (np.abs(x) <= [REACH, REACH, FAST, FAST]).all()
        ):
            found.append((2.0 * done.cost, x))
    return found


PLAIN = (("tdoa",), ("range",), ("azimuth",), ("tdoa", "azimuth"), ("groa", "range"))


def attacked(seed: int, count: int, starts: int) -> tuple[int, int]:
    """Return how many fixes were proven within their limits, and of how many; assert that SciPy refutes none."""
    proven = total = 0
    for number in range(count):
        rng = np.random.default_rng([20261123, seed, number])
        made, truth = drawn(rng, PLAIN[number % len(PLAIN)], out=rng.choice([1.0, 2.0]), constraints=limits())
        problem = simulate(made, truth=truth, seed=number)
        fix = solve(problem)
        if not fix.answered:
            continue
        total += 1
        claim = fix.certificate
        if claim.proof != "region":
            continue
        proven += claim.unique
        state = fix.x[state_columns(problem)]
        listed = [x[state_columns(problem)] for x in fix.alternatives.x if np.isfinite(x).all()]
        scale = np.array([1e3, 1e3, 10.0, 10.0])
        for cost, x in minima(problem, rng, truth[:4], starts):
            assert cost > fix.cost - 1e-4 * (1.0 + fix.cost), (seed, number, cost, fix.cost, x)
            if claim.unique and cost < fix.cost + claim.margin - 1e-3:
                near = [np.abs((x - other) / scale).max() for other in (state, *listed)]
                assert min(near) < 0.1, (seed, number, cost - fix.cost, x, state)
    return proven, total


def test_claims_hold_against_other_searches(seed):
    proven, total = attacked(seed, 7, 8)
    assert proven >= 0.6 * total > 3


@pytest.mark.full
def test_claims_hold_against_other_searches_in_full(seed):
    proven, total = attacked(seed, 200, 60)
    assert proven >= 0.7 * total


def test_clocks_and_what_is_known_of_the_state_count(seed):
    claims = []
    for number in range(4):
        rng = np.random.default_rng([6, seed, number])
        made, truth = drawn(rng, KINDS[number % 2], constraints=limits())
        made = spoiled(rng, made)
        problem = simulate(made, truth=np.concatenate([truth, np.zeros(made.layout.size - 4)]), seed=number)
        fix = solve(problem)
        # a claim is made only where the cost is that of the fix
        claims.append(fix.certificate.proof == "region" if fix.answered else None)
    assert claims.count(True) >= 3


def test_a_mirror_image_is_listed():
    rows = measured("range", a=np.tile([0, 1, 2], 8), epoch=np.repeat(np.arange(8), 3), sigma=10.0)
    line = np.array([[-5e3, 0.0], [0.0, 0.0], [7e3, 0.0]])
    made = assemble(line, rows, times=10.0 * np.arange(8), motions=(Motion(1),), constraints=limits())
    fix = solve(simulate(made, truth=[2e3, 9e3, 30.0, 20.0], seed=4))
    assert fix.status == Status.AMBIGUOUS
    assert fix.certificate.unique
    other = fix.alternatives.x[0][:4]
    assert np.allclose(other * [1.0, -1.0, 1.0, -1.0], fix.x[:4], atol=[1.0, 1.0, 0.1, 0.1])


def test_what_is_admitted_is_what_is_claimed():
    rng = np.random.default_rng(5)
    made, truth = drawn(rng, ("range",))
    problem = simulate(made, truth=truth, seed=1)
    fix = solve(problem)
    assert fix.status == Status.UNPROVEN  # it might be faster, or farther away
    assert "add constraints: a box and a greatest speed" in fix.certificate.reason
    around = certify(problem, fix)
    assert "at a velocity from (-700, -700) to (700, 700) m/s" in around.certificate.reason
    assert around.status == Status.UNPROVEN
    corners = [-1e5, -1e5, -90.0, -300.0], [1e5, 1e5, 200.0, 300.0]
    asked = certify(problem, fix, corners)
    assert asked.certificate.asked
    assert asked.certificate.region == tuple(map(tuple, corners))
    assert asked.status == Status.OK


@pytest.mark.parametrize(
    ("what", "word"),
    [
        (lambda: {"motions": (Motion(2),)}, "accelerates"),
        (lambda: {"times": [0.0]}, "several epochs"),
    ],
)
def test_what_is_not_covered_is_said(what, word):
    rows = measured("range", a=[0, 1, 2, 0], epoch=[0, 0, 0, 0], sigma=1.0)
    settings = {"times": [0.0, 5.0], "motions": (Motion(1),)} | what()
    assert word in why_unsupported(assemble(np.eye(3)[:, :2] * 1e3, rows, **settings).flat())

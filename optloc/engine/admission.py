"""Which positions are admitted: surfaces on which fixes are held exactly, bounds, and lines of sight.

Every bounded quantity is a tape with its gradient. A refinement steps along the exact surfaces and is put back onto
them; bounds and sight are looked at once it has ended.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array, Band
from optloc.compute.jit import compiled
from optloc.compute.lanes import run
from optloc.compute.systems import LANES, factor_plain, solve_plain
from optloc.compute.tables import starts
from optloc.compute.trace import Recorder, Tape, tape
from optloc.engine.evaluator import equations
from optloc.engine.memory import (
    BLUR,
    H_TRIAL,
    INVERSE,
    LOWER,
    MOVE,
    ORIGIN,
    ROUNDING,
    SPARE,
    Admission,
    G,
    H,
    Model,
    Room,
    X,
)
from optloc.linear.constraints import TOLERANCE, bounded, is_exact
from optloc.models import MODELS
from optloc.models.primitives import WGS84_A, WGS84_F, Jet
from optloc.problem.problem import Problem

# Columns of `Admission.block`.
CODE, CONSTANT, INPUT = range(3)
# Steps that put a position back: Newton's squares a small relative distance, so that three are enough from 1 % off.
_BACK = 8
# Share of a level by which a position may miss it: rounding of coordinates of the Earth's size.
_ON = 1e-15


@compiled
def _measure(a: Admission, room: Room, shift: int, last: int) -> None:
    """Write the first quantities at row X, or at TRIAL with shift 1, and their gradients."""
    d, r, x, origin = room.d, room.registers, room.vector[X + shift], room.vector[ORIGIN]
    for k in range(last):
        begin, end = a.block[k, INPUT], a.block[k + 1, INPUT]
        for i in range(begin, end):
            to, j = a.input[i, 0], a.input[i, 1]
            for lane in range(LANES):
                r[to, lane] = x[j, lane] + origin[j, lane]
        for i in range(a.block[k, CONSTANT], a.block[k + 1, CONSTANT]):
            for lane in range(LANES):
                r[a.constant[i], lane] = a.value[i]
        run(a.code, a.block[k, CODE], a.block[k + 1, CODE], r, LANES)
        for lane in range(LANES):
            room.quantity[k, lane] = r[a.output[k, 0], lane]
        for j in range(d):
            to = a.output[k, 1 + j]
            for lane in range(LANES):
                room.face[shift, k, j, lane] = r[to, lane] if to >= 0 else 0.0


@compiled
def restore(model: Model, room: Room, shift: int) -> None:
    """Put row X, or TRIAL with shift 1, back onto the exact surfaces, along the shortest way."""
    a, d = model.admission, room.d
    if a.exact == 0:
        return
    for _ in range(_BACK):
        _measure(a, room, shift, a.exact)
        worst = 0.0
        for k in range(a.exact):
            for lane in range(LANES):
                room.part[k, lane] = room.quantity[k, lane] - room.level[k, 0, lane]
                size = _ON * (WGS84_A if a.earth else abs(room.level[k, 0, lane]))
                worst = max(worst, 1.0 if abs(room.part[k, lane]) > size else 0.0)
        if worst == 0.0:
            return
        _square(room.face[shift], room.face[shift], room, d)
        solve_plain(room.small[1], room.pivot, room.part)
        for k in range(a.exact):
            for j in range(d):
                for lane in range(LANES):
                    room.vector[X + shift, j, lane] -= room.part[k, lane] * room.face[shift, k, j, lane]
    _measure(a, room, shift, a.exact)


@compiled
def _square(left: Array, right: Array, room: Room, d: int) -> None:
    """Factor the products (c, c, W) of gradients (c, d, W) with vectors (c, d, W)."""
    small, pivot = room.small, room.pivot
    for k in range(len(small[0])):
        for m in range(k + 1):
            for lane in range(LANES):
                small[0, k, m, lane] = 0.0
            for j in range(d):
                for lane in range(LANES):
                    small[0, k, m, lane] += left[k, j, lane] * right[m, j, lane]
        for lane in range(LANES):
            room.diagonal[k, lane] = small[0, k, k, lane]
    factor_plain(small[0], room.diagonal, small[1], pivot)


@compiled
def evaluate(model: Model, rows: Any, room: Room, shift: int) -> None:
    """Write information, right side and cost at row X, or at TRIAL with shift 1.

    On exact surfaces the information across them is enlarged to the size of that along them: what is held to them
    (`hold`) does not depend on it, and the matrix is regular where the rows alone leave a direction open.
    """
    equations(rows, room, shift)
    a, d, matrix, spare = model.admission, room.d, room.matrix[H + shift], room.scalar[SPARE]
    for k in range(a.exact):
        face = room.face[shift, k]
        for lane in range(LANES):
            spare[lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                spare[lane] += face[j, lane] * face[j, lane]
        for lane in range(LANES):
            trace = matrix[0, 0, lane]
            for j in range(1, d):
                trace += matrix[j, j, lane]
            spare[lane] = trace / spare[lane]
        for i in range(d):
            for j in range(i + 1):
                for lane in range(LANES):
                    matrix[i, j, lane] += spare[lane] * face[i, lane] * face[j, lane]


@compiled
def coarsen(model: Model, room: Room) -> None:
    """Let the rounding of residuals be no less than what putting back onto a surface around the Earth does to them."""
    a, blur = model.admission, room.scalar[BLUR]
    if a.exact == 0 or not a.earth:
        return
    for lane in range(LANES):
        trace = 0.0
        for j in range(room.d):
            trace += room.matrix[H, j, j, lane]
        blur[lane] = max(blur[lane], ROUNDING * WGS84_A * np.sqrt(max(trace, 0.0)))


@compiled
def hold(model: Model, room: Room) -> None:
    """Take from the step in MOVE what leads off the exact surfaces; the information is factored in LOWER."""
    a, d, move = model.admission, room.d, room.vector[MOVE]
    if a.exact == 0:
        return
    p = room.vector.shape[1]
    for k in range(a.exact):
        for j in range(p):
            for lane in range(LANES):
                room.push[k, j, lane] = room.face[0, k, j, lane] if j < d else 0.0
        solve_plain(room.matrix[LOWER], room.vector[INVERSE], room.push[k])
    _keep_off(room, move, p)


@compiled
def _keep_off(room: Room, move: Array, p: int) -> None:
    """Take from a vector (p, W) the combination of `room.push` that makes it lie along the surfaces."""
    face, push, part, d = room.face[0], room.push, room.part, room.d
    _square(face, push, room, d)
    for k in range(len(push)):
        for lane in range(LANES):
            part[k, lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                part[k, lane] += face[k, j, lane] * move[j, lane]
    solve_plain(room.small[1], room.pivot, part)
    for k in range(len(push)):
        for j in range(p):
            for lane in range(LANES):
                move[j, lane] -= part[k, lane] * push[k, j, lane]


@compiled
def hold_covariance(model: Model, room: Room) -> None:
    """Make the covariance in the lower half of H_TRIAL that along the exact surfaces."""
    a, d, cov, column = model.admission, room.d, room.matrix[H_TRIAL], room.vector[MOVE]
    if a.exact == 0:
        return
    p = room.vector.shape[1]
    for k in range(a.exact):
        for i in range(p):
            for lane in range(LANES):
                room.push[k, i, lane] = 0.0
            for j in range(d):
                for lane in range(LANES):
                    room.push[k, i, lane] += cov[max(i, j), min(i, j), lane] * room.face[0, k, j, lane]
    whole = room.matrix[LOWER]
    for i in range(p):
        for j in range(i + 1):
            for lane in range(LANES):
                whole[i, j, lane] = cov[i, j, lane]
    for i in range(p):
        for j in range(p):
            for lane in range(LANES):
                column[j, lane] = whole[max(i, j), min(i, j), lane]
        _keep_off(room, column, p)
        for j in range(i, p):
            for lane in range(LANES):
                # what is held has no variance: rounding may leave it a little negative
                cov[j, i, lane] = column[j, lane] if j > i else max(column[j, lane], 0.0)


@compiled
def find_multipliers(model: Model, room: Room) -> None:
    """Write to `room.part` what balances the gradient of the cost at row X."""
    a, d, part, face = model.admission, room.d, room.part, room.face[0]
    if a.exact == 0:
        return
    _square(face, face, room, d)
    for k in range(a.exact):
        for lane in range(LANES):
            part[k, lane] = 0.0
        for j in range(d):
            # the normal equations have half the gradient
            for lane in range(LANES):
                part[k, lane] += 2.0 * face[k, j, lane] * room.vector[G, j, lane]
    solve_plain(room.small[1], room.pivot, part)


@compiled
def admit(model: Model, room: Room, out: Array) -> None:
    """Write 0.0 to `out` (W,) where row X breaks a constraint, or where the Earth hides it from a used station."""
    a = model.admission
    if len(a.output):
        _measure(a, room, 0, len(a.output))
        for k in range(len(a.output)):
            for lane in range(LANES):
                low, high, value = room.level[k, 0, lane], room.level[k, 1, lane], room.quantity[k, lane]
                above = value >= low - TOLERANCE * (1.0 + abs(low))
                out[lane] = out[lane] if above and value <= high + TOLERANCE * (1.0 + abs(high)) else 0.0
    if a.earth:
        for lane in range(LANES):
            out[lane] = 0.0 if _is_hidden(a, room, lane) else out[lane]


SATELLITE = 1.0 + 100e3 / WGS84_A
"""Height above which a station is a satellite, Earth radii: above all aircraft, below all orbits."""
GRAZE, GROUND = 1.0 - 5e3 / WGS84_A, 1.0 - 50e3 / WGS84_A
"""How deep a line of sight may dip: 5 km to a satellite, for refraction and for targets below the ellipsoid or badly
measured; 50 km from the ground to a target in space: only what is clearly on the other side of the Earth is hidden."""


@compiled
def _is_hidden(a: Admission, room: Room, lane: int) -> bool:
    """Return whether the Earth hides row X of a lane from a station with a row of it: `optloc.solvers.inequalities`."""
    point, line, origin = room.spot[0], room.spot[1], room.vector[ORIGIN]
    for i in range(3):
        point[i] = a.origin[i]
        for j in range(3):
            point[i] += a.turn[i, j] * (room.vector[X, j, lane] + origin[j, lane])
    high = 0.0
    for i in range(3):
        point[i] *= _STRETCH[i]
        high += point[i] * point[i]
    for s in range(len(room.place)):
        if a.heard[s] == 0.0:
            continue
        far, long, along = 0.0, 0.0, 0.0
        for i in range(3):
            at = a.origin[i]
            for j in range(3):
                at += a.turn[i, j] * (room.place[s, j, lane] + origin[j, lane])
            at *= _STRETCH[i]
            far += at * at
            line[i] = at - point[i]
            long += line[i] * line[i]
            along -= point[i] * line[i]
        satellite = far > SATELLITE * SATELLITE
        if not (satellite or a.seen[s] != 0.0 or high > SATELLITE * SATELLITE):
            continue
        # the point of the segment next to the centre; at its ends nothing is in between
        share = min(along / long, 1.0)
        nearest = 0.0
        for i in range(3):
            nearest += (point[i] + share * line[i]) ** 2
        limit = GRAZE if satellite else GROUND
        if share > 0.0 and nearest < limit * limit:
            return True
    return False


# Along the axis the ellipsoid is stretched to the unit sphere; lines stay lines.
_STRETCH = (1.0 / WGS84_A, 1.0 / WGS84_A, 1.0 / WGS84_A / (1.0 - WGS84_F))


# How it is made.


def admission_of(problem: Problem, node: Array) -> Admission | None:
    """Return the constraints of one problem as tapes, or None where a constraint has no tape.

    Parameters
    ----------
    problem : Problem
        Without batch axes but for the levels of its constraints, which are left out.
    node : int array (2, s)
        Epoch and station of each place.
    """
    d, bands = problem.dimension, list(problem.constraints)
    if not all(isinstance(band, Band) and band.coefficients.ndim == 1 for band in bands):
        return None
    bands.sort(key=lambda band: not is_exact(band))
    traced = [_trace(problem, band) for band in bands if isinstance(band, Band)]
    found = [one for one in traced if one is not None]
    if len(found) < len(bands):
        return None
    tapes = [one for one, _ in found]
    output = np.full((len(found), d + 1), -1, dtype=np.int64)
    for k, (one, seeds) in enumerate(found):
        output[k, 0] = one.outputs[0]
        output[k, [1 + seed for seed in seeds]] = one.outputs[1:]
    constant = [pair for one in tapes for pair in one.constants]
    parts = [[len(part) for part in one] for one in zip(*((t.code, t.constants, t.inputs) for t in tapes), strict=True)]
    parts = parts or [[], [], []]
    earth = problem.frame.geodetic and d == _SPACE
    heard, seen = _hearing(problem, node)
    return Admission(
        sum(is_exact(band) for band in bands),
        np.concatenate([np.zeros((0, 4), dtype=np.int64), *(one.code for one in tapes)]),
        np.stack([starts(part) for part in parts], axis=1),
        np.array([register for register, _ in constant], dtype=np.int64),
        np.array([value for _, value in constant], dtype=float),
        np.array([(register, seed) for one in tapes for seed, register in one.inputs], dtype=np.int64).reshape(-1, 2),
        output,
        np.zeros((1, len(bands), 2)),
        max((one.registers for one in tapes), default=1),
        earth,
        np.array(problem.frame.rotation_to_ecef() if earth else np.eye(_SPACE), order="C"),
        np.array(problem.frame.origin_ecef() if earth else np.zeros(_SPACE), order="C"),
        heard,
        seen,
    )


# Coordinates of space.
_SPACE = 3


def levels_of(problem: Problem) -> Array:
    """Return the bounds (N or 1, k, 2) of the constraints of problems, in the order of `admission_of`."""
    bands = [band for band in problem.constraints if isinstance(band, Band)]
    bands.sort(key=lambda band: not is_exact(band))
    if not bands:
        return np.zeros((1, 0, 2))
    both = [(np.atleast_1d(band.lower), np.atleast_1d(band.upper)) for band in bands]
    size = max(len(one) for pair in both for one in pair)
    return np.stack([np.stack([np.broadcast_to(one, (size,)) for one in pair], axis=-1) for pair in both], axis=1)


def _trace(problem: Problem, band: Band) -> tuple[Tape, tuple[int, ...]] | None:
    """Return the tape of a bounded quantity and its derivatives, and of which coordinates they are."""
    recorder, d = Recorder(), problem.dimension
    state = tuple(Jet(recorder.input(i), {i: 1.0}) for i in range(d))
    try:
        value = bounded(problem, band, [state], tuple(float(c) for c in band.coefficients), None)
        partials = {seed: p for seed, p in value.partials.items() if recorder.constant(recorder.node(p)) != 0.0}
        return tape(recorder, [value.value, *partials.values()]), tuple(partials)
    except (TypeError, AttributeError, ValueError, AssertionError, IndexError):  # of a velocity, or untraceable
        return None


def _hearing(problem: Problem, node: Array) -> tuple[Array, Array]:
    """Return 1.0 for the places (s,) that a row is of, and for those that an angle is of."""
    moving = problem.stations.position.shape[-3] > 1
    heard, seen = np.zeros(node.shape[1]), np.zeros(node.shape[1])
    for rows in problem.rows:
        for index in (rows.a, rows.b)[: MODELS[rows.kind].stations]:
            for i in np.flatnonzero(rows.weight > 0.0):
                own = (node[1] == index[i]) & (node[0] == (rows.epoch[i] if moving else 0))
                heard[own] = 1.0
                seen[own] = 1.0 if MODELS[rows.kind].quantity == "angle" else seen[own]
    return heard, seen

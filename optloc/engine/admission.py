"""The admitted positions: exact surfaces, bounds, and lines of sight that the Earth does not block.

Every constrained quantity is a tape: elementary operations that compute its value and its gradient. A refinement steps
along the exact surfaces, and its positions are projected back onto them. Bounds and lines of sight are checked after
the refinement.

A block has W problems, one in each lane; the lane is the last axis of the arrays. A problem has d coordinates, p
unknowns and c exact constraints. `room` is the workspace of the block. Names in capitals, such as X or MOVE, are rows
of the arrays of `optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array, Band
from optloc.engine.evaluator import equations
from optloc.engine.memory import (
    BASE,
    BLUR,
    BOUNDED,
    CENTRE,
    H_TRIAL,
    HEARD,
    INVERSE,
    LOWER,
    LOWER_BOUND,
    MOVE,
    ORIGIN,
    RADIUS,
    ROUNDING,
    SEEN,
    SPARE,
    UPPER_BOUND,
    Admission,
    EngineModel,
    EngineWorkspace,
    G,
    H,
    X,
)
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES, factor_plain, solve_plain
from optloc.kernels.tape_table import INPUT, OUTPUT, run_tape, tape_table
from optloc.kernels.trace import Recorder, Tape, tape
from optloc.linear.constraints import TOLERANCE, bounded, is_exact
from optloc.models.primitives import WGS84_A, WGS84_F, Jet
from optloc.problem.problem import Problem

# Newton steps that project a position: each step squares a small relative distance, so three are enough from 1 % off.
_BACK = 8
# Relative error of a level that counts as zero: rounding of coordinates as large as the Earth.
_ON = 1e-15


@compiled
def _measure(a: Admission, room: EngineWorkspace, shift: int, last: int) -> None:
    """Write the first `last` constrained quantities to `room.side`, and their gradients to `room.face`.

    They are computed at row X, or at row TRIAL if `shift` is 1.
    """
    d, r, x, origin, table = room.d, room.registers, room.vector[X + shift], room.vector[ORIGIN], a.tapes.table
    for k in range(last):
        for i in range(table[k, INPUT], table[k + 1, INPUT]):
            to, j = table[i, 0], table[i, 1]
            for lane in range(LANES):
                r[to, lane] = x[j, lane] + origin[j, lane]
        run_tape(a.tapes, k, r, LANES)
        first = table[k, OUTPUT]
        for lane in range(LANES):
            room.side[BOUNDED, k, lane] = r[table[first, 0], lane]
        for j in range(d):
            to = table[first + 1 + j, 0]
            for lane in range(LANES):
                room.face[shift, k, j, lane] = r[to, lane] if to >= 0 else 0.0


@compiled
def restore(model: EngineModel, room: EngineWorkspace, shift: int) -> None:
    """Project row X, or TRIAL if `shift` is 1, onto the exact surfaces, along the shortest way.

    If RADIUS is positive, the position is moved to the sphere of this radius about CENTRE instead.
    """
    a, d = model.admission, room.d
    if room.scalar[RADIUS, 0] > 0.0:
        _restore_radius(room, shift)
        return
    if a.exact == 0:
        return
    for _ in range(_BACK):
        _measure(a, room, shift, a.exact)
        worst = 0.0
        for k in range(a.exact):
            for lane in range(LANES):
                room.part[k, lane] = room.side[BOUNDED, k, lane] - room.side[LOWER_BOUND, k, lane]
                size = _ON * (WGS84_A if a.earth else abs(room.side[LOWER_BOUND, k, lane]))
                worst = max(worst, 1.0 if abs(room.part[k, lane]) > size else 0.0)
        if worst == 0.0:
            return
        _square(room.face[shift], room.face[shift], room, d)
        solve_plain(room.small[1], room.pivot[0], room.part)
        for k in range(a.exact):
            for j in range(d):
                for lane in range(LANES):
                    room.vector[X + shift, j, lane] -= room.part[k, lane] * room.face[shift, k, j, lane]
    _measure(a, room, shift, a.exact)


@compiled
def _restore_radius(room: EngineWorkspace, shift: int) -> None:
    """Move row X, or TRIAL if `shift` is 1, to the distance RADIUS from CENTRE."""
    x, centre, far = room.vector[X + shift], room.vector[CENTRE], room.scalar[SPARE]
    for lane in range(LANES):
        far[lane] = 0.0
    for j in range(room.d):
        for lane in range(LANES):
            far[lane] += (x[j, lane] - centre[j, lane]) ** 2
    for lane in range(LANES):
        far[lane] = room.scalar[RADIUS, lane] / np.sqrt(far[lane])
    for j in range(room.d):
        for lane in range(LANES):
            x[j, lane] = centre[j, lane] + far[lane] * (x[j, lane] - centre[j, lane])


@compiled
def _square(left: Array, right: Array, room: EngineWorkspace, d: int) -> None:
    """Write the Cholesky factor (c, c, W) of the matrix ``left right^T`` to `room.small`, its pivots to `room.pivot`.

    `left` and `right` have the shape (c, d, W): gradients of the exact constraints, and vectors. The matrix must be
    symmetric.
    """
    small, pivot, diagonal = room.small, room.pivot[0], room.pivot[1]
    for k in range(len(small[0])):
        for m in range(k + 1):
            for lane in range(LANES):
                small[0, k, m, lane] = 0.0
            for j in range(d):
                for lane in range(LANES):
                    small[0, k, m, lane] += left[k, j, lane] * right[m, j, lane]
        for lane in range(LANES):
            diagonal[k, lane] = small[0, k, k, lane]
    factor_plain(small[0], diagonal, small[1], pivot)


@compiled
def evaluate(model: EngineModel, rows: Any, room: EngineWorkspace, shift: int) -> None:
    """Write information, right side and cost at row X, or at TRIAL if `shift` is 1.

    On exact surfaces, the information across the surface is enlarged to the size of the information along it. The
    matrix then becomes regular if the rows leave a direction undetermined. The steps that `project_step` leaves do not
    depend on this term.
    """
    equations(rows, room, shift)
    a, d, matrix, spare = model.admission, room.d, room.matrix[H + shift], room.scalar[SPARE]
    wide = room.scalar[RADIUS, 0] > 0.0
    # number -1 is the sphere of the radius RADIUS about CENTRE; its gradient is the vector from the centre
    for k in range(-1 if wide else 0, a.exact):
        face = room.axes[BASE, 0] if k < 0 else room.face[shift, k]
        if k < 0:
            _point_out(room, shift, face)
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
def _point_out(room: EngineWorkspace, shift: int, out: Array) -> None:
    """Write the vector (d, W) from CENTRE to row X, or to TRIAL if `shift` is 1, to `out`, metres."""
    for j in range(room.d):
        for lane in range(LANES):
            out[j, lane] = room.vector[X + shift, j, lane] - room.vector[CENTRE, j, lane]


@compiled
def coarsen(model: EngineModel, room: EngineWorkspace) -> None:
    """Raise BLUR, the rounding error of the residuals, if a surface around the Earth constrains the position.

    The projection onto the surface then rounds coordinates as large as the Earth's radius. The unit of BLUR is one
    standard deviation.
    """
    a, blur = model.admission, room.scalar[BLUR]
    if a.exact == 0 or not a.earth:
        return
    for lane in range(LANES):
        trace = 0.0
        for j in range(room.d):
            trace += room.matrix[H, j, j, lane]
        blur[lane] = max(blur[lane], ROUNDING * WGS84_A * np.sqrt(max(trace, 0.0)))


@compiled
def project_step(model: EngineModel, room: EngineWorkspace) -> None:
    """Remove the part of the step MOVE that leaves the exact surfaces.

    LOWER and INVERSE must contain the factor of the information. The remaining step minimises the linearised cost along
    the surfaces.
    """
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
def _keep_off(room: EngineWorkspace, move: Array, p: int) -> None:
    """Subtract a combination of the vectors `room.push` from `move` (p, W): the result is tangent to the surfaces."""
    face, push, part, d = room.face[0], room.push, room.part, room.d
    _square(face, push, room, d)
    for k in range(len(push)):
        for lane in range(LANES):
            part[k, lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                part[k, lane] += face[k, j, lane] * move[j, lane]
    solve_plain(room.small[1], room.pivot[0], part)
    for k in range(len(push)):
        for j in range(p):
            for lane in range(LANES):
                move[j, lane] -= part[k, lane] * push[k, j, lane]


@compiled
def project_covariance(model: EngineModel, room: EngineWorkspace) -> None:
    """Replace the covariance in the lower half of H_TRIAL by the covariance along the exact surfaces.

    The variance across a surface becomes zero. LOWER, MOVE and `room.push` are overwritten.
    """
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
                # the variance of an exactly constrained coordinate is zero, which rounding may make slightly negative
                cov[j, i, lane] = column[j, lane] if j > i else max(column[j, lane], 0.0)


@compiled
def find_multipliers(model: EngineModel, room: EngineWorkspace) -> None:
    """Write the Lagrange multipliers (c, W) of the exact constraints at row X to `room.part`.

    The gradient of the cost plus the sum of multipliers times constraint gradients is zero.
    """
    a, d, part, face = model.admission, room.d, room.part, room.face[0]
    if a.exact == 0:
        return
    _square(face, face, room, d)
    for k in range(a.exact):
        for lane in range(LANES):
            part[k, lane] = 0.0
        for j in range(d):
            # the right side of the normal equations is half the negative gradient
            for lane in range(LANES):
                part[k, lane] += 2.0 * face[k, j, lane] * room.vector[G, j, lane]
    solve_plain(room.small[1], room.pivot[0], part)


@compiled
def check_constraints(model: EngineModel, room: EngineWorkspace, out: Array) -> None:
    """Write 0.0 to `out` (W,) for lanes whose row X is not admitted; the other lanes keep their values.

    A position is not admitted if it violates a constraint, or if the Earth hides it from a station with a row.
    """
    a = model.admission
    sides = room.side.shape[1]
    if sides:
        _measure(a, room, 0, sides)
        for k in range(sides):
            for lane in range(LANES):
                low, high = room.side[LOWER_BOUND, k, lane], room.side[UPPER_BOUND, k, lane]
                value = room.side[BOUNDED, k, lane]
                above = value >= low - TOLERANCE * (1.0 + abs(low))
                out[lane] = out[lane] if above and value <= high + TOLERANCE * (1.0 + abs(high)) else 0.0
    if a.earth:
        for lane in range(LANES):
            out[lane] = 0.0 if _is_hidden(model, room, lane) else out[lane]


SATELLITE = 1.0 + 100e3 / WGS84_A
"""Distance from the centre above which a station is a satellite, Earth radii: above all aircraft, below all orbits."""
GRAZE, GROUND = 1.0 - 5e3 / WGS84_A, 1.0 - 50e3 / WGS84_A
"""Least distance of a line of sight from the centre, Earth radii.

GRAZE allows 5 km of depth for a line to a satellite: for refraction, and for targets below the ellipsoid or with large
errors. GROUND allows 50 km for a line from the ground to a target in space: only targets that are clearly on the other
side of the Earth count as hidden."""


@compiled
def _is_hidden(model: EngineModel, room: EngineWorkspace, lane: int) -> bool:
    """Return whether the Earth hides row X of a lane from a station with a row (as `optloc.solvers.inequalities`).

    Stations on the ground with rows other than angles do not count while the target is below satellites.
    """
    a, origin, base = model.admission, room.vector[ORIGIN], room.axes[BASE]
    high = 0.0
    for i in range(3):
        at = a.globe[3, i]
        for j in range(3):
            at += a.globe[i, j] * (room.vector[X, j, lane] + origin[j, lane])
        base[0, i, lane] = at * _STRETCH[i]
        high += base[0, i, lane] * base[0, i, lane]
    for s in range(len(room.place)):
        if model.station[HEARD, s] == 0.0:
            continue
        far, long, along = 0.0, 0.0, 0.0
        for i in range(3):
            at = a.globe[3, i]
            for j in range(3):
                at += a.globe[i, j] * (room.place[s, j, lane] + origin[j, lane])
            at *= _STRETCH[i]
            far += at * at
            base[1, i, lane] = at - base[0, i, lane]
            long += base[1, i, lane] * base[1, i, lane]
            along -= base[0, i, lane] * base[1, i, lane]
        satellite = far > SATELLITE * SATELLITE
        if not (satellite or model.station[SEEN, s] != 0.0 or high > SATELLITE * SATELLITE):
            continue
        # the point of the segment nearest to the centre; at the ends of the segment the Earth is not in between
        share = min(along / long, 1.0)
        nearest = 0.0
        for i in range(3):
            nearest += (base[0, i, lane] + share * base[1, i, lane]) ** 2
        limit = GRAZE if satellite else GROUND
        if share > 0.0 and nearest < limit * limit:
            return True
    return False


# Stretching along the axis maps the ellipsoid to the unit sphere, and lines to lines.
_STRETCH = (1.0 / WGS84_A, 1.0 / WGS84_A, 1.0 / WGS84_A / (1.0 - WGS84_F))


# How the data are made.


def admission_of(problem: Problem) -> Admission | None:
    """Return the constraints of one problem as tapes, or None if a constraint has no tape.

    Parameters
    ----------
    problem : Problem
        Problem without batch axes. Only the levels of its constraints may have them; they are not used.
    """
    d, bands = problem.dimension, list(problem.constraints)
    if not all(isinstance(band, Band) and band.coefficients.ndim == 1 for band in bands):
        return None
    bands.sort(key=lambda band: not is_exact(band))  # kernels loop over the first `Admission.exact` constraints
    traced = [_trace(problem, band) for band in bands if isinstance(band, Band)]
    found = [one for one in traced if one is not None]
    if len(found) < len(bands):
        return None
    output = np.full((len(found), d + 1), -1, dtype=np.int64)
    for k, (one, seeds) in enumerate(found):
        output[k, 0] = one.outputs[0]
        output[k, [1 + seed for seed in seeds]] = one.outputs[1:]
    earth = problem.frame.geodetic and d == _SPACE
    globe = np.zeros((_SPACE + 1, _SPACE))
    if earth:
        globe[:_SPACE], globe[_SPACE] = problem.frame.rotation_to_ecef(), problem.frame.origin_ecef()
    return Admission(
        sum(is_exact(band) for band in bands),
        tape_table([one for one, _ in found], output.tolist()),
        np.zeros((1, len(bands), 2)),
        earth,
        globe,
    )


# Coordinates of space.
_SPACE = 3


def levels_of(problem: Problem) -> Array:
    """Return the lower and upper bounds (N or 1, k, 2) of the k constraints, in the order of `admission_of`.

    Exact constraints come first. The first axis is 1 if all problems share the bounds.
    """
    bands = [band for band in problem.constraints if isinstance(band, Band)]
    bands.sort(key=lambda band: not is_exact(band))
    if not bands:
        return np.zeros((1, 0, 2))
    both = [(np.atleast_1d(band.lower), np.atleast_1d(band.upper)) for band in bands]
    size = max(len(one) for pair in both for one in pair)
    return np.stack([np.stack([np.broadcast_to(one, (size,)) for one in pair], axis=-1) for pair in both], axis=1)


def _trace(problem: Problem, band: Band) -> tuple[Tape, tuple[int, ...]] | None:
    """Return the tape of a constrained quantity, and the coordinates that its derivatives refer to.

    The outputs of the tape are the value and the derivatives that are not zero. The result is None if the quantity has
    no tape, for instance because it depends on a velocity.
    """
    recorder, d = Recorder(), problem.dimension
    state = tuple(Jet(recorder.input(i), {i: 1.0}) for i in range(d))
    try:
        value = bounded(problem, band, [state], tuple(float(c) for c in band.coefficients), None)
        partials = {seed: p for seed, p in value.partials.items() if recorder.constant(recorder.node(p)) != 0.0}
        return tape(recorder, [value.value, *partials.values()]), tuple(partials)
    except (TypeError, AttributeError, ValueError, AssertionError, IndexError):  # a velocity, or untraceable
        return None

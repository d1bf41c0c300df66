"""Fixes of N problems in one compiled call: start, refinement, covariance, shape of the cost and rival minima.

The problems are computed in blocks of LANES problems; a lane is the place of one problem in a block. Only a few
problems need more work: more steps, a mirror image whose refinement goes on, or a second measurement of the shape.
These problems are collected and computed later in full blocks, so that no block waits for one of its lanes.

A *rival* is another minimum whose cost is at most `LISTED` above the cost of the fix. Arguments that many kernels
share:

- `room` is the workspace of the block. Names in capitals, such as X or GOOD, are rows of the arrays of
  `optloc.engine.memory.EngineWorkspace`.
- `size` is the number of different problems in the block; the last problem fills the other lanes.
- `look` (N,) marks fixes whose shape must be measured again.
- `hidden` (N,) are the numbers of the problems whose mirror image needs more steps; `images` is their count.
- `course` (3, N) contains damping, growth and steps of these mirror images.
- `given` is True if the starts come from elsewhere, see `fixes`.
- `z` (N, m) are the measurements, SI units or radians; `station` (N or 1, s, d) are the station positions, metres.
- `tolerance` ends a refinement, see `optloc.engine.refinement.refine`.
- `answer` receives the results.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.engine import ranges, tapes
from optloc.engine.admission import check_constraints, evaluate, find_multipliers, project_covariance, restore
from optloc.engine.evaluator import (
    count_lifted,
    count_unknowns,
    evaluated_by,
    finish,
    keep,
    load,
    measure_infinity,
    search_infinity,
)
from optloc.engine.images import LISTED, confirm_rivals, find_plane, keep_fix, refine_images, reflect
from optloc.engine.memory import (
    ALIVE,
    AT_INFINITY,
    BEYOND,
    BLUR,
    BOUNDED,
    CENTRE,
    COST,
    COST_OF_FIX,
    COST_OF_RIVAL,
    DAMPING,
    DIAGONAL,
    EIGEN,
    FIX,
    FIX_COST,
    FIX_GOOD,
    GOOD,
    GRADIENT,
    GROWTH,
    H_TRIAL,
    INVERSE,
    KAPPA,
    KAPPA_FAR,
    LOWER,
    LOWER_BOUND,
    MOVE,
    MULTIPLIER,
    NORMAL,
    ORIGIN,
    ROW,
    SECOND,
    SETTLED,
    SOLVABLE,
    SPARE,
    SPREAD,
    STEPS,
    UPPER_BOUND,
    VALUE,
    Answer,
    EngineModel,
    EngineWorkspace,
    H,
    X,
    make_room,
)
from optloc.engine.refinement import refine
from optloc.engine.shape import STRAIGHT, find_even, measure_shape
from optloc.engine.start import begin, load_measurements, load_stations
from optloc.kernels.damping import FIRST_DAMPING, FIRST_GROWTH
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES, factor_plain, solve_plain

# Steps of the first pass. Problems that need more steps are collected into full blocks. Fixes near their stations
# take two to five steps.
_FEW = 6
# Tenfold margin above the share (1e-12) at which a direction counts as undetermined. Problems between the two shares
# are left to the general solver.
_WEAK = 1e-11
# Distance in spreads of the stations above which a fix is left to the general solver: a fourfold margin to its limit.
_FAR = 2.5e3
# Relative difference of costs that rounding and the tolerance of a refinement explain
# (`optloc.solvers.policy.equal_cost`).
_TIED = 1e-6
# Difference of logarithms of distances that counts as rounding, as in `optloc.solvers.verdict.minima.likelihood_of`.
_SAME_DISTANCE = 1e-6
# Fewest active lanes for which a block continues: to collect the problems again costs a start and half a step.
_WORTH = LANES // 2


@compiled
def fixes(
    model: EngineModel, rows: Any, z: Array, station: Array, tolerance: float, most: int, given: bool, answer: Answer
) -> int:
    """Fix N positions, each from the measurements of one problem, and return the greatest number of steps.

    Parameters
    ----------
    model : EngineModel
        Maps from measurements to a start.
    rows : named tuple
        Rows of the evaluator (`RangeRows` or `TapeRows`).
    z : array (N, m)
        Measurements, SI units or radians.
    station : array (N or 1, s, d)
        Positions of the stations that have rows, metres. Their mean is the centre of the coordinates in inverse range.
    tolerance, most : float, int
        Tolerance and greatest number of steps of `optloc.engine.refinement.refine`.
    given : bool
        Whether the answer contains starts from elsewhere, mostly because another position fits the squared ranges as
        well. Then the mirror image of every fix is refined to its end.
    answer : Answer
        Written: fixes, rivals and their numbers.
    """
    count = len(z)
    s, d, size = station.shape[1], station.shape[2], answer.x.shape[1]
    block = keep(model, rows, s, d, size)
    room = make_room(model, s, d, count_unknowns(rows, d, size), count_lifted(rows))
    late, hidden, look = np.empty(count, np.int64), np.empty(count, np.int64), np.zeros(count, np.bool_)
    course = np.empty((3, count))
    waiting, images, steps = 0, 0, 0
    for first in range(0, count, LANES):
        size = _take(room.item, None, first, count)
        _see(model, block, z, station, room, first == 0)
        if given:
            _resume(model, answer.x, room)
        else:
            begin(model, block, room)
        # a block that is not full has no other block to wait for
        limit = min(_FEW, most) if size == LANES else most
        steps = max(steps, _refine(model, block, z, room, size, tolerance, limit, answer))
        for lane in range(size):
            if room.scalar[ALIVE, lane] != 0.0 and most > limit:
                late[waiting] = room.item[lane]
                waiting += 1
        images = _examine(model, block, z, room, size, tolerance, given, answer, look, hidden, images, course)
    for first in range(0, waiting, LANES):
        size = _take(room.item, late, first, waiting)
        _see(model, block, z, station, room, False)
        _resume(model, answer.x, room)
        steps = max(steps, _FEW + _refine(model, block, z, room, size, tolerance, most - _FEW, answer))
        images = _examine(model, block, z, room, size, tolerance, given, answer, look, hidden, images, course)
    _pursue(model, block, z, station, room, tolerance, given, answer, look, hidden, images, course)
    waiting = 0
    for i in range(count):
        late[waiting] = i
        waiting += 1 if look[i] else 0
    for first in range(0, waiting, LANES):
        size = _take(room.item, late, first, waiting)
        _see(model, block, z, station, room, False)
        _resume(model, answer.x, room)
        _look_again(model, block, z, room, size, answer, look)
    return steps


@compiled
def _take(item: Array, order: Array | None, first: int, count: int) -> int:
    """Write the number of the problem of each lane to `item` (W,), and return the number of problems in the block.

    The problems are those from `first` on, of `count`, in the given order or as stored. The last problem fills the
    other lanes.
    """
    size = min(LANES, count - first)
    for lane in range(LANES):
        at = first + min(lane, size - 1)
        item[lane] = at if order is None else order[at]
    return size


@compiled
def _see(model: EngineModel, rows: Any, z: Array, station: Array, room: EngineWorkspace, begins: bool) -> None:
    """Load measurements, bounds and stations of a block; shared stations are loaded only if `begins` is True.

    `begins` is True in the first block of a call. `station` (N or 1, s, d) are positions, metres.
    """
    scalar, vector, anew = room.scalar, room.vector, len(station) > 1 or begins
    level = model.admission.level
    for k in range(level.shape[1]):
        for lane in range(LANES):
            at = room.item[lane] if len(level) > 1 else 0
            room.side[LOWER_BOUND, k, lane], room.side[UPPER_BOUND, k, lane] = level[at, k, 0], level[at, k, 1]
    load_measurements(
        z, room.item, model.row, model.anchor, model.linear, room.seen, room.value, scalar[BLUR], scalar[GOOD]
    )
    if anew:
        load_stations(
            station,
            room.item,
            model.reference,
            room.place,
            vector[ORIGIN],
            vector[CENTRE],
            scalar[SPREAD],
            scalar[SPARE],
        )
        find_plane(room)
    load(rows, z, room, anew)


@compiled
def _refine(
    model: EngineModel,
    rows: Any,
    z: Array,
    room: EngineWorkspace,
    size: int,
    tolerance: float,
    limit: int,
    answer: Answer,
) -> int:
    """Refine the unknowns of a block, write them to the answer, and return the greatest number of steps.

    `limit` is the greatest number of steps tried.
    """
    refine(model, rows, room, tolerance, limit)
    _write_fixes(model, rows, z, room, size, answer)
    steps = 0
    for lane in range(size):
        steps = max(steps, int(room.scalar[STEPS, lane]))
    return steps


@compiled
def _write_fixes(model: EngineModel, rows: Any, z: Array, room: EngineWorkspace, size: int, answer: Answer) -> None:
    """Write unknowns, covariances and costs of the first `size` lanes, and to FIX_GOOD whether each fix is settled."""
    scalar = room.scalar
    _invert(room)
    project_covariance(model, room)
    find_multipliers(model, room)
    check_constraints(model, room, scalar[SOLVABLE])
    for lane in range(LANES):
        good = scalar[SOLVABLE, lane] * scalar[GOOD, lane] > scalar[ALIVE, lane]
        scalar[FIX_GOOD, lane] = 1.0 if good else 0.0
        scalar[FIX_COST, lane] = scalar[COST, lane]
    covariance, found, side = answer.covariance, room.matrix[H_TRIAL], answer.side
    for lane in range(size):
        i = room.item[lane]
        answer.number[i, SETTLED] = scalar[FIX_GOOD, lane]
        answer.number[i, COST_OF_FIX] = scalar[COST, lane]
        for k in range(side.shape[1]):
            side[i, k, MULTIPLIER] = room.part[k, lane] if k < len(room.part) else 0.0
            side[i, k, VALUE] = room.side[BOUNDED, k, lane]
            for j in range(room.d):
                side[i, k, GRADIENT + j] = room.face[0, k, j, lane]
        for j in range(covariance.shape[1]):
            for k in range(covariance.shape[1]):
                covariance[i, j, k] = found[max(j, k), min(j, k), lane]
    _place(room.vector, room.item, answer.x, scalar[ALIVE], False, size)
    finish(rows, z, room, size, scalar[ALIVE], False, answer.x)


@compiled
def _place(vector: Array, item: Array, x: Array, mark: Array, marked: bool, size: int) -> None:
    """Write the refined positions of the first `size` lanes to x (N, p), metres; `item` are the problems of the lanes.

    If `marked` is True, only the lanes with a nonzero `mark` are written.
    """
    d = vector.shape[1]
    for lane in range(size):
        if marked and mark[lane] == 0.0:
            continue
        i = item[lane]
        for j in range(d):
            x[i, j] = vector[X, j, lane] + vector[ORIGIN, j, lane]


@compiled
def _examine(
    model: EngineModel,
    rows: Any,
    z: Array,
    room: EngineWorkspace,
    size: int,
    tolerance: float,
    given: bool,
    answer: Answer,
    look: Array,
    hidden: Array,
    images: int,
    course: Array,
) -> int:
    """Measure shape and cost at infinity of the settled fixes of a block, and refine their mirror images.

    The shape is kappa: the deviation of the cost from a quadratic function. It is NaN for fixes that are not settled.
    Fixes whose shape needs a second measurement are marked in `look`: kappa exceeds STRAIGHT, or the principal axes are
    not unique. Mirror images that need more steps are added to `hidden`. Returns the number of mirror images in
    `hidden`.
    """
    scalar = room.scalar
    settled = scalar[FIX_GOOD]
    kappa, even, closer, turned = room.vector[ROW, 0], room.vector[ROW, 1], 0, False
    measure_shape(model, rows, room, False, False, kappa)
    find_even(room.axes[EIGEN], even)
    number, item = answer.number, room.item
    for lane in range(size):
        i, good = item[lane], settled[lane] != 0.0
        number[i, KAPPA], number[i, KAPPA_FAR] = (kappa[lane] if good else np.nan), np.nan
        number[i, COST_OF_RIVAL], number[i, AT_INFINITY] = np.inf, np.inf
        look[i] = good and (kappa[lane] > STRAIGHT or even[lane] != 0.0)
        closer += 1 if look[i] else 0
        turned = turned or even[lane] != 0.0
    if room.side.shape[1]:  # bounds may exclude the positions far away
        for lane in range(LANES):
            scalar[BEYOND, lane] = np.nan
    else:
        measure_infinity(rows, room)
    left = 0.0
    for lane in range(size):
        if settled[lane] != 0.0:
            number[item[lane], AT_INFINITY] = scalar[BEYOND, lane]
    if closer >= _WORTH or (closer and size < LANES):
        _measure_closely(model, rows, room, size, answer, look, turned)
    for lane in range(LANES):
        scalar[GOOD, lane] = settled[lane]
        left += settled[lane]
    if left == 0.0:
        return images
    keep_fix(room)
    reflect(model, room)
    refine_images(model, rows, room, tolerance, _WORTH if size == LANES else 1, given)
    return _end_images(model, rows, z, room, size, answer, look, hidden, images, course)


@compiled
def _measure_closely(
    model: EngineModel, rows: Any, room: EngineWorkspace, size: int, answer: Answer, look: Array, turned: bool
) -> None:
    """Measure the shape again for the fixes of a block.

    If `turned` is True, the shape in metres is measured also along turned axes. Where kappa in metres is above
    STRAIGHT, kappa in inverse range is measured as well.
    """
    kappa, item, number, far = room.vector[ROW, 0], room.item, answer.number, 0
    if turned:
        measure_shape(model, rows, room, False, True, kappa)
    for lane in range(size):
        i = item[lane]
        if number[i, SETTLED] != 0.0:
            look[i] = False
            number[i, KAPPA] = kappa[lane] if turned else number[i, KAPPA]
            far += 1 if number[i, KAPPA] > STRAIGHT else 0
    if far and model.admission.exact:  # coordinates in inverse range cannot follow a surface
        for lane in range(size):
            if number[item[lane], SETTLED] != 0.0:
                number[item[lane], KAPPA_FAR] = np.inf
    elif far:
        measure_shape(model, rows, room, True, True, kappa)
        for lane in range(size):
            i = item[lane]
            if number[i, SETTLED] != 0.0 and number[i, KAPPA] > STRAIGHT:
                number[i, KAPPA_FAR] = kappa[lane]
        if room.side.shape[1] == 0:
            _look_beyond(model, rows, room, size, answer)


@compiled
def _look_beyond(model: EngineModel, rows: Any, room: EngineWorkspace, size: int, answer: Answer) -> None:
    """Write the least cost at infinity of the fixes whose kappa exceeds STRAIGHT: far positions may fit as well."""
    number = answer.number
    search_infinity(model, rows, room)
    for lane in range(size):
        i = room.item[lane]
        if number[i, SETTLED] != 0.0 and number[i, KAPPA] > STRAIGHT:
            number[i, AT_INFINITY] = room.scalar[BEYOND, lane]


@compiled
def _pursue(
    model: EngineModel,
    rows: Any,
    z: Array,
    station: Array,
    room: EngineWorkspace,
    tolerance: float,
    given: bool,
    answer: Answer,
    look: Array,
    hidden: Array,
    images: int,
    course: Array,
) -> None:
    """Refine the mirror images listed in `hidden` in full blocks, until all refinements have ended."""
    scalar, item = room.scalar, room.item
    while images:
        waiting = images
        images = 0
        for first in range(0, waiting, LANES):
            size = _take(room.item, hidden, first, waiting)
            _see(model, rows, z, station, room, False)
            _resume(model, answer.x, room)
            evaluate(model, rows, room, 0)
            keep_fix(room)
            _resume(model, answer.rival, room)
            for lane in range(LANES):
                i = item[lane]
                scalar[FIX_COST, lane] = answer.number[i, COST_OF_FIX]
                scalar[GOOD, lane], scalar[ALIVE, lane] = 1.0, 1.0
                scalar[DAMPING, lane], scalar[GROWTH, lane] = course[0, i], course[1, i]
                scalar[STEPS, lane] = course[2, i]
            refine_images(model, rows, room, tolerance, _WORTH if size == LANES else 1, given)
            # Problems of this block are read before `hidden` is overwritten for the blocks that follow.
            images = _end_images(model, rows, z, room, size, answer, look, hidden, images, course)


@compiled
def _end_images(
    model: EngineModel,
    rows: Any,
    z: Array,
    room: EngineWorkspace,
    size: int,
    answer: Answer,
    look: Array,
    hidden: Array,
    images: int,
    course: Array,
) -> int:
    """Write the rivals that mirror images have reached, and return the new number of mirror images in `hidden`.

    If a rival is cheaper than the fix, the two are exchanged.
    """
    scalar, item = room.scalar, room.item
    before = images
    for lane in range(size):
        if scalar[ALIVE, lane] != 0.0:
            i = item[lane]
            hidden[images] = i
            images += 1
            course[0, i], course[1, i] = scalar[DAMPING, lane], scalar[GROWTH, lane]
            course[2, i] = scalar[STEPS, lane]
    if images > before:
        _place(room.vector, item, answer.rival, scalar[ALIVE], True, size)
    if confirm_rivals(model, rows, room) == 0.0:
        return images
    _place(room.vector, item, answer.rival, scalar[GOOD], True, size)
    finish(rows, z, room, size, scalar[GOOD], True, answer.rival)
    number = answer.number
    for lane in range(size):
        if scalar[GOOD, lane] != 0.0:
            i = item[lane]
            rival, cost = scalar[COST, lane], number[i, COST_OF_FIX]
            number[i, COST_OF_RIVAL] = rival
            # If both minima have the same cost, the position decides, so that rounding does not.
            tied = abs(rival - cost) <= _TIED * (1.0 + cost)
            if _is_likelier(room, lane) if tied else rival < cost:
                _exchange(answer, i)
                look[i] = True
                if number[i, COST_OF_RIVAL] == np.inf:
                    # the old fix is dropped, so the start was wrong; the mirror image of the new fix may be a rival
                    _reflect_lane(room.vector, lane, answer.rival[i])
                    course[0, i], course[1, i], course[2, i] = FIRST_DAMPING, FIRST_GROWTH, 0.0
                    hidden[images] = i
                    images += 1
    return images


@compiled
def _is_likelier(room: EngineWorkspace, lane: int) -> bool:
    """Return whether, of two minima of equal cost, row X is likelier than row FIX, in one lane.

    The minimum nearer to the centre of the stations is likelier. If the logarithms of both distances differ by rounding
    only, the minimum with the greater last coordinate is likelier.
    """
    vector, last = room.vector, room.d - 1
    near, far = 0.0, 0.0
    for j in range(room.d):
        near += (vector[X, j, lane] - vector[CENTRE, j, lane]) ** 2
        far += (vector[FIX, j, lane] - vector[CENTRE, j, lane]) ** 2
    ahead = 0.5 * np.log(far / near)
    if abs(ahead) > _SAME_DISTANCE:
        return bool(ahead > 0.0)
    return bool(vector[X, last, lane] > vector[FIX, last, lane])


@compiled
def _reflect_lane(vector: Array, lane: int, out: Array) -> None:
    """Write the mirror image of the position of a lane in the plane of the stations to `out` (d,), metres."""
    height = 0.0
    for j in range(vector.shape[1]):
        height += (vector[X, j, lane] - vector[CENTRE, j, lane]) * vector[NORMAL, j, lane]
    for j in range(vector.shape[1]):
        own = vector[X, j, lane] + vector[ORIGIN, j, lane]
        out[j] = own - 2.0 * height * vector[NORMAL, j, lane]


@compiled
def _exchange(answer: Answer, i: int) -> None:
    """Exchange fix and rival of problem i, because the rival is cheaper.

    If the cost of the old fix is more than `LISTED` above the cost of the new fix, it is no rival.
    """
    x, rival, number = answer.x, answer.rival, answer.number
    for j in range(x.shape[1]):
        x[i, j], rival[i, j] = rival[i, j], x[i, j]
    best, other = number[i, COST_OF_RIVAL], number[i, COST_OF_FIX]
    number[i, COST_OF_FIX], number[i, COST_OF_RIVAL] = best, other if other <= best + LISTED else np.inf


@compiled
def _look_again(
    model: EngineModel, rows: Any, z: Array, room: EngineWorkspace, size: int, answer: Answer, look: Array
) -> None:
    """Write covariance and shape again for the fixes in row X that are marked in `look`."""
    evaluate(model, rows, room, 0)
    for lane in range(LANES):
        room.scalar[ALIVE, lane] = 0.0
    _write_fixes(model, rows, z, room, size, answer)
    _measure_closely(model, rows, room, size, answer, look, True)


@compiled
def _resume(model: EngineModel, x: Array, room: EngineWorkspace) -> None:
    """Set row X to the unknowns x (N, p) reached so far, metres, projected onto the exact surfaces."""
    item, vector = room.item, room.vector
    for j in range(vector.shape[1]):
        for lane in range(LANES):
            vector[X, j, lane] = x[item[lane], j] - vector[ORIGIN, j, lane]
    for lane in range(LANES):
        room.scalar[SECOND, lane] = 0.0
    restore(model, room, 0)


@compiled
def _invert(room: EngineWorkspace) -> None:
    """Write the lower half of the covariance to H_TRIAL.

    SOLVABLE becomes 1.0 if the information matrix is regular and the fix is not far away, else 0.0.
    """
    vector, matrix, scalar = room.vector, room.matrix, room.scalar
    p = vector.shape[1]
    diagonal, inverse, move, fine, away = (
        vector[DIAGONAL],
        vector[INVERSE],
        vector[MOVE],
        scalar[SOLVABLE],
        scalar[SPARE],
    )
    for lane in range(LANES):
        away[lane] = 0.0
    for i in range(room.d):
        for lane in range(LANES):
            apart = (vector[X, i, lane] - vector[CENTRE, i, lane]) / scalar[SPREAD, lane]
            away[lane] += apart * apart
    for i in range(p):
        for lane in range(LANES):
            diagonal[i, lane] = matrix[H, i, i, lane]
    for lane in range(LANES):
        # Far away the cost hardly depends on the distance: these fixes are left to the general solver.
        fine[lane] = 1.0 if away[lane] <= _FAR * _FAR else 0.0
    factor_plain(matrix[H], diagonal, matrix[LOWER], inverse)
    for j in range(p):
        for i in range(p):
            for lane in range(LANES):
                move[i, lane] = 1.0 if i == j else 0.0
        solve_plain(matrix[LOWER], inverse, move)
        for lane in range(LANES):
            fine[lane] = fine[lane] if 0.0 < inverse[j, lane] * diagonal[j, lane] < 1.0 / _WEAK else 0.0
        for i in range(j, p):
            for lane in range(LANES):
                matrix[H_TRIAL, i, j, lane] = move[i, lane]


fix_ranges = evaluated_by(fixes, ranges, "ranges")
fix_tapes = evaluated_by(fixes, tapes, "tapes")
# A block computes all of its lanes, used or not: one problem takes twice as long in 64 lanes as in one lane.
# A block of one lane takes all steps in the first pass: 1000 steps are more than any refinement may take.
_ONE: dict[str, int] = {"LANES": 1, "_WORTH": 1, "_FEW": 1000}
fix_one_by_ranges = evaluated_by(fixes, ranges, "one_by_ranges", **_ONE)
fix_one_by_tapes = evaluated_by(fixes, tapes, "one_by_tapes", **_ONE)

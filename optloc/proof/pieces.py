"""Boxes on the pieces of an atlas: the stacks of a search, the ends at infinity, and the boxes of known minima.

The pieces and their numbers are in `optloc.proof.atlas`: 2 d faces, the inside, then one piece around each known
minimum, with d dimensions. A stack has one row for each box (`optloc.proof.box`: centre, half-widths, lower bound of
the residual, piece), and `size` is its number of boxes. `low` is a lower bound of the residual's length over a box. The
*convex box* of a minimum contains no second minimum; its *core* is a wider box that is searched along the axes of the
minimum.
"""

from __future__ import annotations

from math import inf

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined
from optloc.proof.atlas import Atlas, coordinates_on, infinity_coordinate, is_near_minimum
from optloc.proof.box import CENTRE, HALF, PIECE, cut_out, push, push_around, push_halves
from optloc.proof.search_space import Box

# Greatest number of boxes on the stack, and in the list of postponed boxes. The stack contains 2 D + 1 pieces, six
# slabs around each known minimum, and one box for each halving of the deepest box. SPARE: one box adds two boxes, and
# six slabs around a minimum that is found in it.
CAPACITY, SPARE = 2048, 8
# Greatest number of postponed boxes. Beyond it, boxes are searched at once, as if the search had no lower level. The
# rest of the stack leaves space for depth when postponed boxes return to it.
_WAITING = 3 * CAPACITY // 4
# A box at infinity below this size whose cost is below the level is not split: over such a box the cost is constant to
# many digits, so no part of it would be dropped either. Half-widths on a face, and around a minimum.
_TINY, _TINY_AROUND = 1e-5, 1e-3
# Points within this many standard deviations of a minimum count as this minimum: a descent ends so close to it.
_SAME = 1e-3
# If contraction leaves less than this share of a box, the box is bounded again before it is halved. Over 16 fixes by
# range differences, a half took 2 % fewer boxes than a quarter or four fifths. It took 5 % fewer than no second bound.
SHRUNK = 0.5
_WITHIN = 1e-9  # as in `optloc.proof.atlas.is_near_minimum`
_BEYOND = 1e-12  # a thousand times the rounding of a sum of two numbers


@inlined
def is_tiny(box: Box, piece: int, d: int) -> bool:
    """Return whether a box at infinity is so small that the cost at its centre represents the box."""
    return bool(max(box.half[0], box.half[1], box.half[2]) < (_TINY if piece < 2 * d else _TINY_AROUND))


@inlined
def push_or_defer(
    stack: Array, size: int, aside: Array, waiting: int, box: Box, side: int, low: float, piece: int, level: float
) -> tuple[int, int]:
    """Push the remaining part of a box, or postpone it if it costs more than a level; return both stack sizes.

    The stack `aside` with `waiting` boxes is for postponed boxes. `side` is the side to halve, and `piece` the number
    of the box's piece. If `aside` is nearly full, the box is pushed at once.
    """
    if low > 0.0 and low * low >= level and waiting + SPARE <= _WAITING:
        return size, push_rest(aside, waiting, box.cut, box.at, box.half, side, low, piece)
    return push_rest(stack, size, box.cut, box.at, box.half, side, low, piece), waiting


@compiled
def touches_infinity(box: Box, last: int, end: float) -> bool:
    """Return whether a box reaches infinity, where the last coordinate has the value `end` (-inf: it never does).

    `last` is the index of the last coordinate.
    """
    return bool(end > -inf and box.at[last] - end <= box.half[last])


@compiled
def contract_at_infinity(box: Box, last: int, end: float) -> None:
    """Cut off the part of a box that rounding has put beyond infinity, where the inverse range would be negative.

    `last` is the index of the last coordinate, and `end` its value at infinity, -inf if the piece does not end there.
    """
    if end > -inf and box.at[last] - end < box.half[last]:
        box.half[last] = 0.5 * (box.at[last] - end + box.half[last]) * (1.0 + _BEYOND)
        box.at[last] = end + box.half[last]


@inlined
def push_rest(stack: Array, size: int, cut: Array, at: Array, half: Array, side: int, low: float, piece: int) -> int:
    """Push the part of a box between the ends of `cut`, whole or halved across a side; return the size of the stack.

    `cut` (6,) has the lower and then the upper ends along the three coordinates, relative to the centre. `at` and
    `half` are overwritten by the part. `side` is the number of the coordinate to halve. The part is pushed whole if it
    is less than the share `SHRUNK` of the box, and not at all if it is empty.
    """
    share = cut_out(cut, at, half)
    if 0.0 < share < SHRUNK:
        return push(stack, size, at, half, low, piece)
    return push_halves(stack, size, side, at, half, low, piece, False) if share > 0.0 else size


@compiled
def is_left(atlas: Atlas, box: Box, piece: int) -> bool:
    """Return whether a search leaves a box out: it is inside the convex box of a known minimum, or inside another core.

    Such a core is searched as a piece with another number. The centre of the box is the current centre of the atlas.
    """
    d, minima = atlas.dimension, atlas.minima
    for i in range(minima.home.shape[0]):
        # A box around one minimum is left only to minima with lower numbers, never to its own core.
        if piece == 2 * d + 1 + i:
            inside = True
            for k in range(d):
                inside = inside and abs(box.at[k]) + box.half[k] <= minima.sides[i, k] * (1.0 - _WITHIN)
            if inside:
                return True
        else:
            convex, searched = is_near_minimum(atlas, box.half, i)
            if convex or (searched and (piece <= 2 * d or piece > 2 * d + 1 + i)):
                return True
    return False


@compiled
def is_listed(atlas: Atlas, x: Array) -> bool:
    """Return whether a position x (D,), metres, is inside the convex box of a known minimum, or next to the minimum.

    If so, the end of a descent is no new minimum.
    """
    d, minima, u = atlas.dimension, atlas.minima, np.zeros(3)
    for i in range(minima.home.shape[0]):
        inside = coordinates_on(atlas, minima.home[i], x, u)
        for k in range(d):
            away = 0.0
            for m in range(d):
                away += minima.back[i, k, m] * (u[m] - minima.start[i, m])
            inside = inside and abs(away) <= max(minima.sides[i, k], _SAME)
        if inside:
            return True
    return False


@compiled
def push_pieces(stack: Array, atlas: Atlas) -> int:
    """Push all faces of the cube, its inside, and on top the boxes around known minima; return the stack size.

    The box around the fix is pushed last, so that it is searched first.
    """
    size = push_faces(stack, atlas.dimension)
    for i in range(atlas.minima.home.shape[0] - 1, -1, -1):
        size = push_core(stack, size, atlas, i)
    return size


@compiled
def push_faces(stack: Array, d: int) -> int:
    """Push all faces of the cube, and its inside, as whole pieces onto an empty stack; return the number of boxes."""
    for piece in range(2 * d + 1):
        stack[piece] = 0.0
        for k in range(d):
            stack[piece, HALF + k] = 1.0
        if piece < 2 * d:
            stack[piece, CENTRE + d - 1] = stack[piece, HALF + d - 1] = 0.5
        stack[piece, PIECE] = piece
    return 2 * d + 1


@compiled
def push_core(stack: Array, size: int, atlas: Atlas, i: int) -> int:
    """Push the core of minimum i without its convex box, cut into slabs; return the size of the stack."""
    low, last, piece = atlas.minima.core[i, 0].copy(), atlas.dimension - 1, 2 * atlas.dimension + 1 + i
    if low[last] == -inf:
        low[last] = infinity_coordinate(atlas, piece)
    return push_around(stack, size, low, atlas.minima.core[i, 1], atlas.minima.sides[i], piece)

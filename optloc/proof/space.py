"""The space of a branch and bound: search coordinates around a fix, or an atlas of all positions.

Searches for starts and subpavings use the same loop for both spaces. A box has a centre ``box.at`` and half-widths
``box.half`` (3,), and `piece` is the number of the piece of the atlas that contains it, 0 around a fix. The nodes of a
cost are the scalar functions, such as ranges, whose values the cost combines (`optloc.proof.nodes.node`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined
from optloc.proof.atlas import Atlas, set_centre, widen_around, write_position
from optloc.proof.box import bound_nodes
from optloc.proof.convex_boxes import accuracy_floor_far, is_known
from optloc.proof.local_search import lay_or_halve
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces
from optloc.proof.pieces import is_left
from optloc.proof.search_space import (
    LINES,
    Box,
    Cost,
    LocalAxes,
    accuracy_floor,
    curve_at,
    is_bounded,
    widen_by_rounding,
    write_centre,
)


class Space(NamedTuple):
    """The space of a search: an atlas of all positions, or search coordinates around a fix.

    Parameters
    ----------
    far : bool
        Whether the space is the atlas.
    atlas : Atlas
        The pieces, with known minima.
    chart : LocalAxes
        The search coordinates, along planes or on a piece of a surface.
    minima, sides : array (P, 3)
        P known minima in search coordinates, and half-widths of boxes around them in which the cost is convex. A search
        leaves these boxes out.
    """

    far: bool
    atlas: Atlas
    chart: LocalAxes
    minima: Array
    sides: Array


@compiled
def in_atlas(atlas: Atlas, chart: LocalAxes) -> Space:
    """Return an atlas as the space of a search; `chart` fills the unused field."""
    none = np.empty((0, 3))
    return Space(True, atlas, chart, none, none)


@compiled
def floor_of(space: Space, cost: Cost) -> float:
    """Return the part of the rounding of residuals that is the same for all boxes, as a size in whitened units.

    It is the length of w plus the sizes of coordinates, each times the weight of its node. The values of nodes are
    added for each box (`optloc.proof.box.rounding_error`), which multiplies the sum by a relative rounding.
    """
    if space.far:
        return accuracy_floor_far(cost, space.atlas)
    if space.chart.differs:  # lines to stations come from anywhere on a surface
        return space.chart.floor
    return accuracy_floor(cost.kinds, cost.data, cost.weight, cost.w, space.chart.origin, LINES)


@inlined
def set_place(space: Space, box: Box, piece: int) -> None:
    """Compute the position of the centre of a box: ``box.centre`` (m), or in the atlas p, v and their derivatives."""
    if space.far:
        set_centre(space.atlas, piece, box.at)
    else:
        write_centre(space.chart.origin, space.chart.sense, box.at, box.centre)


@inlined
def set_box(space: Space, box: Box, piece: int) -> None:
    """Compute the position of the centre of a box like `set_place`, and widen the box by the rounding of the centre."""
    set_place(space, box, piece)
    if not space.far:
        widen_by_rounding(space.chart, box.centre, box.half)
    elif piece > 2 * space.atlas.dimension:
        widen_around(space.atlas, piece - 2 * space.atlas.dimension - 1, box.half)


@compiled
def set_nodes(space: Space, cost: Cost, box: Box) -> bool:
    """Bound the nodes of a cost over a box whose centre is set; return False if a surface is no graph over the box.

    The bounds are written into ``box.nodes``.
    """
    if space.far:
        bound_pieces(space.atlas, cost.kinds, cost.data, box.half, box.nodes)
        return True
    return is_bounded(cost, space.chart, box)


@inlined
def bound_or_halve(space: Space, cost: Cost, box: Box, piece: int, stack: Array, size: int) -> int:
    """Bound the nodes of a cost over a box from the stack; return -1, or the stack's size if it is dropped or halved.

    A box around a known minimum is dropped, and so is a box that belongs to another piece of a surface. A box over
    which the surface is no graph is halved: its halves are pushed onto the stack (rows of centre, half-widths, bound
    and piece). `size` is the number of boxes on the stack before.
    """
    set_box(space, box, piece)
    chart, half, line = space.chart, box.half, box.line
    if space.far:
        if is_left(space.atlas, box, piece):
            return size
        bound_pieces(space.atlas, cost.kinds, cost.data, half, box.nodes)
    elif is_known(box.at, half, space.minima, space.sides):
        return size
    elif chart.surface.shape[0] > 0:
        return lay_or_halve(cost, chart, box, stack, size)
    else:
        bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, half, line, box.nodes)
    return -1


@compiled
def set_curves(space: Space, cost: Cost, box: Box) -> None:
    """Bound second derivatives of the nodes over a box whose nodes are bounded, and write them into ``box.curves``."""
    if space.far:
        curve_pieces(space.atlas, cost.kinds, cost.data, box.half, box.nodes, box.curves)
    else:
        curve_at(cost, space.chart, box)


@compiled
def place_of(space: Space, box: Box, x: Array) -> None:
    """Write the position x (D,), metres, of the centre of a box; `set_place` must have run."""
    if space.far:
        write_position(space.atlas, x)
    else:
        for k in range(x.shape[0]):
            x[k] = box.centre[k]

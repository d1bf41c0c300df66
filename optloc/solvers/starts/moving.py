"""Starts of a target with unknown velocity from range rates of one epoch: a best-first search over boxes of all space.

Given the position, rates are linear in the velocity, which is eliminated at the centre of each box. Over the box the
lines of sight turn. For a velocity of limited size, the search bounds the change of the residuals by this turn.
It takes boxes in the order of these bounds.

An *atlas* covers all space by 2 d + 1 *pieces*: a cube around the stations, and one piece for each direction to
infinity. A box is a piece, a centre and half-widths in the coordinates of the piece. A node is one term of the rows: a
range, a rate or an angle as a function of the position.
"""

from __future__ import annotations

from dataclasses import replace
from heapq import heapify, heappop, heappush
from math import sqrt

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import plain
from optloc.linear.constraints import exact
from optloc.problem.problem import Problem
from optloc.proof.atlas import Atlas, atlas_of, set_centre, write_position
from optloc.proof.box import reaches_infinity, station_cube
from optloc.proof.nodes.dispatch import bound_pieces
from optloc.proof.nodes.node import HIGH, LOW, NODE_WIDTH, PHI, RATE, SLOPE0
from optloc.proof.position_costs import PositionCosts, position_costs
from optloc.proof.scope import is_run, is_scaled, why_unsupported

# Boxes for each problem, by its dimension, and the number of cheapest centres kept. In space 600 boxes missed the best
# position of 10 emitters of 100, and 2 400 boxes missed none.
_BUDGET, _MOST = {2: 900, 3: 2400}, 24
# Greatest assumed speed of a target, metres per second: above any aircraft. It only sets the order of boxes, so a
# faster target is usually found too.
_SPEED = 700.0
# Constant in the remainder of a turned direction: see `optloc.proof.nodes.rate`, and Legendre's polynomials, n = 2.
_TURN = 2.0 / sqrt(3.0)
# Centres nearer to each other than this share of their distance from the stations are one start.
_APART = 0.1


def moves_at_once(problem: Problem) -> bool:
    """Return whether only the position of one target needs a start, whose velocity is unknown, at one epoch."""
    if len(problem.motions) != 1 or problem.motions[0].order != 1 or problem.motions[0].known is not None:
        return False
    if problem.epochs > 1 or exact(problem) or not any(slot.name == "velocity" for slot in problem.layout.shared):
        return False
    still = problem_at_rest(problem)
    return not (why_unsupported(still) or is_run(still) or is_scaled(still))


def problem_at_rest(problem: Problem) -> Problem:
    """Return the problem with its target at rest, without priors on the velocity."""
    motions = tuple(replace(motion, order=0) for motion in problem.motions)
    priors = tuple(prior for prior in problem.priors if prior.name != "velocity")
    return replace(problem, motions=motions, priors=priors)


def moving_starts(problem: Problem) -> Array:
    """Return the cheapest positions (N, q, d), metres, that a search over boxes of all space finds; NaN after the last.

    Each problem has at most q = 24 positions, far from each other, in ascending order of cost. The cost of a position
    is the cost with the best velocity. The refinement starts from all of them.

    Parameters
    ----------
    problem : Problem
        N problems for which `moves_at_once` is true.
    """
    costs, d = position_costs(problem_at_rest(problem)), problem.dimension
    out = np.full((problem.batch_shape[0], _MOST, d), np.nan)
    for i in range(len(out)):
        found = _search(costs.take(slice(i, i + 1)), d)
        out[i, : len(found)] = found
    return out


def _search(costs: PositionCosts, d: int) -> Array:
    """Return the cheapest centres (q, d) of boxes that are far apart, metres; `costs` is the cost of one problem.

    q is 0 if the cost grows without limit towards infinity: the atlas of all positions does not apply.
    """
    kinds, data, K, w = costs.kinds, costs.data[0], costs.K[0], costs.w[0]
    with plain():
        if not reaches_infinity(kinds, K):
            return np.empty((0, d))
        middle, radius = station_cube(kinds, data, np.zeros(d))
        atlas = atlas_of(middle, radius, d, 0)
        rows, nodes, centre = _MovingRows(K, w, data, kinds == RATE), np.zeros((len(kinds), NODE_WIDTH)), np.empty(d)
        queue = [(0.0, piece, *_whole(piece, d)) for piece in range(2 * d + 1)]
        heapify(queue)
        met: list[tuple[float, tuple[float, ...]]] = []
        for _ in range(_BUDGET[d]):
            _, piece, at, half = heappop(queue)
            set_centre(atlas, piece, np.array(at))
            bound_pieces(atlas, kinds, data, np.array(half), nodes)
            cost, low, side = rows.bound(atlas, nodes, np.array(half), d)
            if atlas.scale[0] > 0.0:
                write_position(atlas, centre)
                met.append((cost, tuple(centre)))
            for sign in (-0.5, 0.5):
                moved = tuple(a + sign * half[k] * (k == side) for k, a in enumerate(at))
                heappush(queue, (low, piece, moved, tuple(h * (0.5 if k == side else 1.0) for k, h in enumerate(half))))
    return _apart(met, middle[:d])


def _whole(piece: int, d: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return centre and half-widths, three numbers each, of the box that covers a whole piece of an atlas.

    With d = 2 the third numbers are zero. The first 2 d pieces reach to infinity: their last coordinate in use is from
    0 to 1.
    """
    at, half = [0.0] * 3, [1.0] * d + [0.0] * (3 - d)
    if piece < 2 * d:
        at[d - 1] = half[d - 1] = 0.5
    return tuple(at), tuple(half)


def _apart(met: list[tuple[float, tuple[float, ...]]], middle: Array) -> Array:
    """Return the cheapest of the positions found (q, d), each far from all cheaper ones.

    `met` has pairs of cost and position. Far means a share `_APART` of the distance from the middle of the stations.
    """
    out: list[Array] = []
    for _, place in sorted(met):
        x = np.array(place)
        away = _APART * np.linalg.norm(x - middle)
        if all(np.linalg.norm(x - other) > away for other in out):
            out.append(x)
        if len(out) == _MOST:
            break
    return np.array(out).reshape(-1, len(middle))


class _MovingRows:
    """Whitened rows, and bounds of their residuals over a box of an atlas, for the best velocity at its centre.

    The rows are ``K phi = w``, in sigma: phi are the values of the nodes, K the coefficients, w the measurements.
    """

    def __init__(self, K: Array, w: Array, data: Array, rates: Array) -> None:
        """Store the whitened rows K (m, nodes), right sides w (m,), and the stations of the rates.

        `rates` flags the nodes that are rates. `data` has the numbers of the nodes; the first three are the station.
        """
        self.K, self.w, self.rates, self.stations = K, w, rates, data[rates, :3]

    def bound(self, atlas: Atlas, nodes: Array, half: Array, d: int) -> tuple[float, float, int]:
        """Return the cost at the centre, a lower bound of the residual norm over the box, and the side to halve.

        `atlas` is set to the centre of the box. `nodes` has values, slopes and remainder bounds of all nodes in the
        box. `half` are the half-widths of the box.
        """
        lines, slants = self._lines(atlas, d)
        length = np.linalg.norm(lines, axis=1)
        sight = lines / np.where(length > 0.0, length, 1.0)[:, None]
        basis, _ = np.linalg.qr(self.K[:, self.rates] @ sight)
        residual = self.K @ nodes[:, PHI] - self.w
        residual = residual - basis @ (basis.T @ residual)
        size = float(np.linalg.norm(residual))
        # the last term chooses the widest side if no node has a slope
        steep = np.linalg.norm(self.K @ nodes[:, SLOPE0 : SLOPE0 + 3], axis=0) * half + 1e-9 * half
        if not size > 0.0:
            return 0.0, 0.0, int(np.argmax(steep))
        # The norm of the residuals is at least their component along the residuals at the centre. `pull` has the
        # weights of the nodes in this component.
        pull = residual @ self.K / size
        low = size - np.abs(pull @ nodes[:, SLOPE0 : SLOPE0 + 3]) @ half
        low += np.minimum(pull * nodes[:, LOW], pull * nodes[:, HIGH]).sum()
        low -= _SPEED * self._turned(pull[self.rates], sight, slants, length, half)
        return size * size, max(low, 0.0), int(np.argmax(steep))

    def _lines(self, atlas: Atlas, d: int) -> tuple[Array, Array]:
        """Return scaled lines (n, d) from the stations of n rates to the centre, and derivatives (n, d, 3)."""
        a = ((self.stations - atlas.middle) / atlas.radius)[:, :d]
        slants = atlas.slant[:d] - a[:, :, None] * atlas.scale[1:4]
        return atlas.point[:d] - atlas.scale[0] * a, slants

    def _turned(self, pull: Array, sight: Array, slants: Array, length: Array, half: Array) -> float:
        """Return the largest change of a residual over the box per metre per second, as lines of sight turn.

        `pull` (n,) are the weights of the n rates in the residual. `sight` (n, d) are unit lines of sight at the
        centre, `length` (n,) their scaled lengths, and `slants` (n, d, 3) their derivatives.
        """
        reach = np.sqrt(((np.abs(slants) @ half) ** 2).sum(-1))
        share = np.where(length > 0.0, reach / np.where(length > 0.0, length, 1.0), np.inf)
        near = share < 1.0  # elsewhere the station may be in the box, so that the line may have any direction
        k = np.where(near, share, 0.0)
        slope = slants - sight[:, :, None] * np.einsum("ni,nik->nk", sight, slants)[:, None]
        first = np.einsum("n,nik->ik", np.where(near, pull / np.where(near, length, 1.0), 0.0), slope)
        rest = np.where(near, _TURN * (-np.log1p(-k) - k), 2.0)
        return float(np.sqrt(((np.abs(first) @ half) ** 2).sum()) + np.abs(pull) @ rest)

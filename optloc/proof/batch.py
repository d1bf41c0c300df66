"""Proofs of many fixes: a compiled loop over a stretch of a batch, called from plain threads."""

from __future__ import annotations

from math import inf, isnan, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.threads import map_on_threads
from optloc.base.types import Array
from optloc.kernels.jit import FEW, compiled, enabled, is_in_use, may_use_code, plain, worth_loading
from optloc.proof.box import bound_nodes, cost_at, rounding_error
from optloc.proof.global_search import prove_globally
from optloc.proof.groups import empty_groups
from optloc.proof.local_search import OPEN, prove_locally
from optloc.proof.position_costs import PositionCosts
from optloc.proof.search_space import LINES, Cost, KnownMinima, accuracy_floor, cost_of, empty_box, set_geometry

# Fixes that one call of machine code proves, fewest and most: a call costs as much as a fix or two, and threads share
# what is left of a batch by stretches, of which each should get several (`_PARTS` in all).
_STRETCH, _PARTS = (16, 512), 32
# Few proofs over so few nodes are begun in plain Python, with so many boxes in all: about half a second. Where there is
# no machine code that could go on, they get so many more: about three seconds.
SMALL, FIRST_BOXES, PLAIN_BOXES = 24, 400, 2000
# Other minima that a proof goes on beside when it meets them; with more it begins anew.
RIVALS = 4
# Fewest boxes that each of them gets: most proofs inside a network end with the first.
_AT_LEAST = 5


class ProofRequest(NamedTuple):
    """What is to be proven of each of n fixes.

    Parameters
    ----------
    x : array (n, d)
        Positions of the fixes.
    others : array (n, P, d)
        Other known minima, the finite ones first.
    known, hidden : int array (n,)
        How many of them are there, and how many of these, the last ones, do not count though they may cost less.
    gaps : array (n, G)
        Gaps to other minima that will do, falling to 0 for the value alone, which may stand there more than once.
    eps : array (n,)
        How far below the cost of the fix still counts as equal.
    region : array (n, 2, d)
        Corners of the regions; NaN for all positions.
    fallback : array (n, 2, d)
        Corners of the regions to take where all positions cannot be bounded; NaN for none.
    budget : int array (n,)
        How many boxes each may take.
    planes, surface : array (n, e, 3), (n, 0) or (n, SURFACE_WIDTH)
        Planes or a surface to which the claims are limited, see `optloc.proof.search_space.KnownMinima`.
    """

    x: Array
    others: Array
    known: Array
    hidden: Array
    gaps: Array
    eps: Array
    region: Array
    fallback: Array
    budget: Array
    planes: Array
    surface: Array

    def take(self, index: Array | slice) -> ProofRequest:
        """Return what is asked of some of the fixes."""
        return ProofRequest(*(array[index] for array in self))


class ProofResult(NamedTuple):
    """What became of each of n proofs.

    Parameters
    ----------
    verdict : int array (n,)
        As `optloc.proof.local_search.prove_locally` or `optloc.proof.global_search.prove_globally` returns it.
    boxes : int array (n,)
        Boxes looked at.
    bound : array (n,)
        Certified lower bounds of the cost.
    everywhere : bool array (n,)
        Whether the claim is for all positions, not for the region asked for or the fallback.
    gap : array (n,)
        The gap that is proven, or where none is the smallest that was tried.
    met : int array (n,)
        How many other minima were met on the way, beside which the claim holds.
    rivals : array (n, RIVALS, d)
        These, the first of them.
    found : array (n, d)
        Better or other points; NaN where there is none.
    """

    verdict: Array
    boxes: Array
    bound: Array
    everywhere: Array
    gap: Array
    met: Array
    rivals: Array
    found: Array

    def take(self, index: Array | slice) -> ProofResult:
        """Return what became of some of the proofs."""
        return ProofResult(*(array[index] for array in self))


def prove_all(costs: PositionCosts, asked: ProofRequest) -> ProofResult:
    """Return the outcome of the proofs of n fixes of n problems, by their costs.

    The first few proofs are begun in plain Python: most need few boxes, and machine code takes longer to load.
    """
    n = len(asked.x)
    if worth_loading(_loop, n) or (len(costs.kinds) > SMALL and may_use_code(_loop, n)):
        return _prove(costs, asked)
    parts = []
    for first in range(0, n, FEW):
        # Where machine code is made meanwhile, it goes on with the rest.
        last = n if first > 0 and may_use_code(_loop, n) else min(first + FEW, n)
        some = slice(first, last)
        parts.append((_prove if last - first > FEW else _prove_few)(costs.take(some), asked.take(some)))
        if last == n:
            break
    return parts[0] if len(parts) == 1 else ProofResult(*map(np.concatenate, zip(*parts, strict=True)))


def _prove_few(costs: PositionCosts, asked: ProofRequest) -> ProofResult:
    """Return the outcome of a few proofs, begun in plain Python; who needs more begins anew in machine code."""
    n = len(asked.x)
    few = max(_AT_LEAST, FIRST_BOXES // max(n, 1))
    out = _prove_plainly(costs, asked, few)
    # With more boxes a larger gap may be proven than with few, and minima may be met: only who has some left is done.
    short = np.flatnonzero((out.boxes >= few) & (asked.budget > few))
    if len(short) and enabled():
        costs, asked = costs.take(short), asked.take(short)
        plenty = max(_AT_LEAST, PLAIN_BOXES // len(short))
        more = _prove(costs, asked) if may_use_code(_loop, n) else _prove_plainly(costs, asked, plenty)
        for array, found in zip(out, more, strict=True):
            array[short] = found
    return out


def _prove_plainly(costs: PositionCosts, asked: ProofRequest, boxes: int) -> ProofResult:
    with plain():
        return _prove(costs, asked._replace(budget=np.minimum(asked.budget, boxes)))


def lacks_code(count: int) -> bool:
    """Return whether proofs of so many fixes ended early because there is no machine code of them yet."""
    return enabled() and not may_use_code(_loop, count)


def empty_answer(n: int, d: int) -> ProofResult:
    """Return what n proofs in d dimensions write into."""
    return ProofResult(
        verdict=np.zeros(n, dtype=np.int64),
        boxes=np.zeros(n, dtype=np.int64),
        bound=np.zeros(n),
        everywhere=np.zeros(n, dtype=np.bool_),
        gap=np.zeros(n),
        met=np.zeros(n, dtype=np.int64),
        rivals=np.full((n, RIVALS, d), np.nan),
        found=np.full((n, d), np.nan),
    )


def without_rivals(
    verdict: Array, boxes: Array, bound: Array, everywhere: Array, asked: ProofRequest, found: Array
) -> ProofResult:
    """Return the outcome of proofs that try the first gap alone, and begin anew beside every minimum that they meet."""
    n, d = found.shape
    none = np.zeros(n, dtype=np.int64)
    return ProofResult(verdict, boxes, bound, everywhere, asked.gaps[:, 0], none, np.full((n, 0, d), np.nan), found)


def _prove(costs: PositionCosts, asked: ProofRequest) -> ProofResult:
    n, d = asked.x.shape
    out = empty_answer(n, d)
    costs, asked = (
        PositionCosts(*(plainly(array) for array in costs)),
        ProofRequest(*(plainly(array) for array in asked)),
    )
    length = max(_STRETCH[0], min(_STRETCH[1], n // _PARTS))

    def stretch(first: int) -> None:
        part = slice(first, min(first + length, n))
        with np.errstate(all="ignore"):  # plain Python would warn of what has no bound
            _loop(costs.take(part), asked.take(part), out.take(part))

    if enabled():
        map_on_threads(stretch, range(0, n, length))
        return out
    for first in range(0, n, length):  # plain Python holds the interpreter: threads would wait for each other
        stretch(first)
    return out


def prove_here(costs: PositionCosts, asked: ProofRequest, out: ProofResult) -> None:
    """Write what becomes of proofs to arrays, by machine code in the calling thread; see `prove_all`.

    All arrays are writable and in C order: nothing is looked at, copied or shared out.
    """
    _loop(costs, asked, out)


def is_code_loaded() -> bool:
    """Return whether the machine code of proofs has been used in this process."""
    return is_in_use(_loop)


def costs_at(costs: PositionCosts, x: Array) -> tuple[Array, Array]:
    """Return costs (n, P) at positions x (n, P, d), and what rounding may have made of their residuals (n, P)."""
    out = np.zeros((2, *x.shape[:2]))
    if worth_loading(_evaluate, len(x)):
        _evaluate(PositionCosts(*(plainly(array) for array in costs)), plainly(x), out)
        return out[0], out[1]
    with plain(), np.errstate(all="ignore"):  # as few proofs are: machine code takes longer to load
        _evaluate(costs, x, out)
    return out[0], out[1]


def cost_here(costs: PositionCosts, x: Array, out: Array) -> None:
    """Write costs and their rounding at positions x (n, P, d) to (2, n, P), by machine code; see `prove_here`."""
    _evaluate(costs, x, out)


def plainly(array: Array) -> Array:
    """Return an array in one form for all calls: machine code is made anew for read-only or strided arrays."""
    return np.require(array, requirements=["C", "W"])


@compiled
def _loop(costs: PositionCosts, asked: ProofRequest, out: ProofResult) -> None:
    """Prove what is asked of each fix, and write what became of it."""
    # Taken out of the records once: every look into one counts the references of an array.
    kinds, data, K, w = costs.kinds, costs.data, costs.K, costs.w
    fixes, others, known, steps, tolerances = asked.x, asked.others, asked.known, asked.gaps, asked.eps
    regions, fallbacks, budgets = asked.region, asked.fallback, asked.budget
    hidden, planes, surfaces = asked.hidden, asked.planes, asked.surface
    verdicts, counts, bounds, wholes, points = out.verdict, out.boxes, out.bound, out.everywhere, out.found
    shown, numbers, rivals = out.gap, out.met, out.rivals
    J = K.shape[2]
    A, weight, groups, box = np.empty((J, J)), np.empty(J), empty_groups(J), empty_box(K.shape[1], J)
    for i in range(len(fixes)):
        rows = K[i if len(K) > 1 else 0]
        if i == 0 or len(K) > 1:
            set_geometry(kinds, rows, A, weight, groups)
        cost, own = Cost(kinds, data[i if len(data) > 1 else 0], rows, w[i], A, weight, groups), box
        # Rows that are absent in this problem alone: the tables of the batch are too wide for it.
        if (weight == 0.0).any():
            cost = without_unused_nodes(cost)
            own = empty_box(cost.K.shape[0], cost.K.shape[1])
        x, gaps, eps, found = fixes[i], steps[i], tolerances[i], points[i]
        beside, low, high = (
            KnownMinima(others[i, : known[i]], hidden[i], planes[i], surfaces[i]),
            regions[i, 0],
            regions[i, 1],
        )
        boxes = 0
        wholes[i] = isnan(low[0])
        if wholes[i]:
            verdict, boxes, bound, gap, met = prove_globally(
                cost, own, x, beside, gaps, eps, budgets[i], rivals[i], found
            )
            verdicts[i], counts[i], bounds[i], shown[i], numbers[i] = verdict, boxes, bound, gap, met
            if verdict != OPEN or isnan(fallbacks[i, 0, 0]):
                continue
            wholes[i] = False
            low, high = fallbacks[i, 0], fallbacks[i, 1]
        verdict, more, bound = prove_locally(
            cost, own, x, beside, gaps[0], eps, budgets[i], inf, low, high, False, found
        )
        verdicts[i], counts[i], bounds[i], shown[i], numbers[i] = verdict, boxes + more, bound, gaps[0], 0


@compiled
def without_unused_nodes(cost: Cost) -> Cost:
    """Return a cost without nodes that no row has: time goes with the square of the nodes."""
    K, w = cost.K, cost.w
    nodes, rows = np.empty(K.shape[1], dtype=np.int64), np.empty(K.shape[0], dtype=np.int64)
    J = q = 0
    for j in range(K.shape[1]):
        if np.any(K[:, j] != 0.0):
            nodes[J] = j
            J += 1
    for i in range(K.shape[0]):
        if w[i] != 0.0 or np.any(K[i] != 0.0):
            rows[q] = i
            q += 1
    own, values = np.empty((q, J)), np.empty(q)
    for i in range(q):
        values[i] = w[rows[i]]
        for j in range(J):
            own[i, j] = K[rows[i], nodes[j]]
    return cost_of(cost.kinds[nodes[:J]], cost.data[nodes[:J]], own, values)


@compiled
def _evaluate(costs: PositionCosts, x: Array, out: Array) -> None:
    """Write costs, and lengths of the rounding of their residuals."""
    J, q = costs.K.shape[2], costs.K.shape[1]
    box, weight, axes, origin = empty_box(q, J), np.empty(J), np.eye(3), np.zeros(3)
    for k in range(x.shape[2], 3):
        axes[k, k] = 0.0
    for i in range(len(x)):
        K, data, w = costs.K[i if len(costs.K) > 1 else 0], costs.data[i if len(costs.data) > 1 else 0], costs.w[i]
        for j in range(J):
            weight[j] = 0.0
            for row in range(q):
                weight[j] += K[row, j] * K[row, j]
            weight[j] = sqrt(weight[j])
        for p in range(x.shape[1]):
            for k in range(x.shape[2]):
                origin[k] = x[i, p, k]
            bound_nodes(costs.kinds, data, origin, axes, axes, box.half, box.line, box.nodes)
            out[0, i, p] = cost_at(K, w, box.nodes)
            floor = accuracy_floor(costs.kinds, data, weight, w, origin, LINES)
            out[1, i, p] = rounding_error(K, weight, floor, box.nodes)

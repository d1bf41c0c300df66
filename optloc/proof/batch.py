"""Proofs of many fixes: a compiled loop over a part of a batch, called from Python threads.

Loading compiled code takes longer than most proofs. So a few small proofs begin in plain Python with a small budget of
boxes.
"""

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

# Fewest and most fixes for one call of compiled code: a call takes as long as one or two fixes. Threads share a batch
# in such parts, and each thread should get several of them (about `_PARTS` in all).
_STRETCH, _PARTS = (16, 512), 32
# A few proofs with at most `SMALL` nodes begin in plain Python, with `FIRST_BOXES` boxes in all: about half a second.
# If no compiled code is available to continue, they get `PLAIN_BOXES` boxes: about three seconds.
SMALL, FIRST_BOXES, PLAIN_BOXES = 24, 400, 2000
# Number of other minima that a proof can add during its search; with more, the proof begins again.
RIVALS = 4
# Fewest boxes for each fix: most proofs inside a network need only the first box.
_AT_LEAST = 5


class ProofRequest(NamedTuple):
    """Requests for proofs of n fixes.

    Parameters
    ----------
    x : array (n, d)
        Positions of the fixes, metres.
    others : array (n, P, d)
        Other known minima, metres; finite minima first.
    known, hidden : int array (n,)
        Number of other known minima. Of these, the last `hidden` minima do not count, although they may cost less.
    gaps : array (n, G)
        Accepted gaps to other minima, in descending order. A gap of 0 proves the value alone, and may be repeated.
    eps : array (n,)
        A cost that is lower than the cost of the fix by at most eps counts as equal.
    region : array (n, 2, d)
        Corners of the regions, metres; NaN for all positions.
    fallback : array (n, 2, d)
        Corners of the regions to prove if not all positions can be bounded, metres; NaN for none.
    budget : int array (n,)
        Greatest number of boxes for each fix.
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
        """Return the requests of some of the fixes."""
        return ProofRequest(*(array[index] for array in self))


class ProofResult(NamedTuple):
    """Results of n proofs.

    Parameters
    ----------
    verdict : int array (n,)
        Code from `optloc.proof.local_search.prove_locally` or `optloc.proof.global_search.prove_globally`.
    boxes : int array (n,)
        Number of boxes searched.
    bound : array (n,)
        Certified lower bounds of the cost.
    everywhere : bool array (n,)
        Whether the claim is for all positions, rather than for the requested region or the fallback.
    gap : array (n,)
        The proven gap; if no gap is proven, the smallest gap that was tried.
    met : int array (n,)
        Number of other minima that the search found; the claim excepts them.
    rivals : array (n, RIVALS, d)
        The first of these minima, metres.
    found : array (n, d)
        Better or other points, metres; NaN for other verdicts.
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
        """Return the results of some of the proofs."""
        return ProofResult(*(array[index] for array in self))


def prove_all(costs: PositionCosts, asked: ProofRequest) -> ProofResult:
    """Return the results of the proofs of n fixes of n problems, from their costs.

    The first few proofs begin in plain Python: most proofs need few boxes, and loading compiled code takes longer.
    """
    n = len(asked.x)
    if worth_loading(_loop, n) or (len(costs.kinds) > SMALL and may_use_code(_loop, n)):
        return _prove(costs, asked)
    parts = []
    for first in range(0, n, FEW):
        # If compiled code becomes available meanwhile, it continues with the rest.
        last = n if first > 0 and may_use_code(_loop, n) else min(first + FEW, n)
        part = slice(first, last)
        parts.append((_prove if last - first > FEW else _prove_few)(costs.take(part), asked.take(part)))
        if last == n:
            break
    return parts[0] if len(parts) == 1 else ProofResult(*map(np.concatenate, zip(*parts, strict=True)))


def _prove_few(costs: PositionCosts, asked: ProofRequest) -> ProofResult:
    """Return the results of a few proofs that begin in plain Python; proofs that need more boxes begin again.

    They begin again with compiled code if it is available, otherwise in plain Python with more boxes.
    """
    n = len(asked.x)
    first_boxes = max(_AT_LEAST, FIRST_BOXES // max(n, 1))
    out = _prove_plainly(costs, asked, first_boxes)
    # More boxes may prove a larger gap and find minima. So a proof is complete only if it used less than its share.
    unfinished = np.flatnonzero((out.boxes >= first_boxes) & (asked.budget > first_boxes))
    if len(unfinished) and enabled():
        costs, asked = costs.take(unfinished), asked.take(unfinished)
        more_boxes = max(_AT_LEAST, PLAIN_BOXES // len(unfinished))
        second = _prove(costs, asked) if may_use_code(_loop, n) else _prove_plainly(costs, asked, more_boxes)
        for array, better in zip(out, second, strict=True):
            array[unfinished] = better
    return out


def _prove_plainly(costs: PositionCosts, asked: ProofRequest, boxes: int) -> ProofResult:
    """Return the results of proofs in plain Python, with at most `boxes` boxes for each fix."""
    with plain():
        return _prove(costs, asked._replace(budget=np.minimum(asked.budget, boxes)))


def lacks_code(count: int) -> bool:
    """Return whether proofs of `count` fixes ended early because their compiled code is not yet available."""
    return enabled() and not may_use_code(_loop, count)


def empty_answer(n: int, d: int) -> ProofResult:
    """Return result arrays for n proofs in d dimensions, filled with zeros and NaN, for the proofs to write."""
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
    """Return the results of proofs that try the first gap only, and begin again after each minimum that they find.

    The arrays (n,) and `found` (n, d) are as in `ProofResult`. The lists of rivals are empty.
    """
    n, d = found.shape
    none = np.zeros(n, dtype=np.int64)
    return ProofResult(verdict, boxes, bound, everywhere, asked.gaps[:, 0], none, np.full((n, 0, d), np.nan), found)


def _prove(costs: PositionCosts, asked: ProofRequest) -> ProofResult:
    """Return the results of all proofs, by compiled code in several threads or by plain Python."""
    n, d = asked.x.shape
    out = empty_answer(n, d)
    costs, asked = (
        PositionCosts(*(plainly(array) for array in costs)),
        ProofRequest(*(plainly(array) for array in asked)),
    )
    length = max(_STRETCH[0], min(_STRETCH[1], n // _PARTS))

    def prove_part(first: int) -> None:
        part = slice(first, min(first + length, n))
        with np.errstate(all="ignore"):  # plain Python would warn of values without a bound
            _loop(costs.take(part), asked.take(part), out.take(part))

    if enabled():
        map_on_threads(prove_part, range(0, n, length))
        return out
    for first in range(0, n, length):  # plain Python holds the interpreter lock, so threads would wait for each other
        prove_part(first)
    return out


def prove_here(costs: PositionCosts, asked: ProofRequest, out: ProofResult) -> None:
    """Write the results of proofs to arrays, by compiled code in the calling thread; see `prove_all`.

    All arrays must be writable and in C order: they are not checked, copied or distributed to threads.
    """
    _loop(costs, asked, out)


def is_code_loaded() -> bool:
    """Return whether the compiled code of proofs has been used in this process."""
    return is_in_use(_loop)


def costs_at(costs: PositionCosts, x: Array) -> tuple[Array, Array]:
    """Return costs (n, P) at positions x (n, P, d), metres, and bounds of the rounding of their residuals (n, P).

    The second result bounds the error of the length of a whitened residual.
    """
    out = np.zeros((2, *x.shape[:2]))
    if worth_loading(_evaluate, len(x)):
        _evaluate(PositionCosts(*(plainly(array) for array in costs)), plainly(x), out)
        return out[0], out[1]
    with plain(), np.errstate(all="ignore"):  # as for few proofs: loading compiled code takes longer
        _evaluate(costs, x, out)
    return out[0], out[1]


def cost_here(costs: PositionCosts, x: Array, out: Array) -> None:
    """Write costs and their rounding at positions x (n, P, d) to `out` (2, n, P), by compiled code.

    See `prove_here`.
    """
    _evaluate(costs, x, out)


def plainly(array: Array) -> Array:
    """Return a writable C-ordered array: read-only or strided arrays would need other compiled code."""
    return np.require(array, requirements=["C", "W"])


@compiled
def _loop(costs: PositionCosts, asked: ProofRequest, out: ProofResult) -> None:
    """Prove the request of each fix, and write its result into the arrays of `out`.

    The proof is first for all positions, unless a region is requested. If it is OPEN, the fallback region follows.
    """
    # Local variables for all arrays: each access to a field of a record counts references.
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
        # If rows are absent in this problem only, the tables of the batch are too wide for it.
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
    """Return a cost without the nodes that no row uses, and without empty rows.

    The time of a proof grows with the square of the nodes.
    """
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
    """Write costs (n, P) at positions x (n, P, d) to out[0], and bounds of the rounding of residuals to out[1]."""
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

"""Proofs of many fixes: a compiled loop over a stretch of a batch, called from plain threads."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isnan
from typing import Any

import numpy as np

from optloc.base.threads import mapped
from optloc.base.types import Array
from optloc.compute.jit import compiled, enabled, plain, ready
from optloc.proof.chart import Cost, cost_of, empty_box, set_geometry
from optloc.proof.everywhere import prove_everywhere
from optloc.proof.groups import empty_groups
from optloc.proof.near import BUDGET, OPEN, prove
from optloc.proof.pose import Posed, taken

# Fixes that one call of machine code proves, fewest and most.
_STRETCH = 16, 512
# So few proofs over so few nodes are begun in plain Python, with so many boxes in all: about half a second.
_FEW, _SMALL, _FIRST_BOXES = 16, 24, 400


@dataclass(frozen=True, slots=True)
class Asked:
    """What is to be proven of each of n fixes.

    Parameters
    ----------
    x : array (n, d)
        Positions of the fixes.
    others : array (n, P, d)
        Other known minima, the finite ones first.
    known : int array (n,)
        How many of them count.
    kappa, eps : array (n,)
        Gap to prove, and how far below the cost of the fix still counts as equal.
    region : array (n, 2, d)
        Corners of the regions; NaN for all positions.
    fallback : array (n, 2, d)
        Corners of the regions to take where all positions cannot be bounded.
    budget : int array (n,)
        How many boxes each may take.
    """

    x: Array
    others: Array
    known: Array
    kappa: Array
    eps: Array
    region: Array
    fallback: Array
    budget: Array

    def take(self, index: Array) -> Asked:
        """Return what is asked of some of the fixes."""
        return Asked(*(getattr(self, name)[index] for name in Asked.__slots__))


@dataclass(frozen=True, slots=True)
class Answered:
    """What became of each of n proofs.

    Parameters
    ----------
    verdict : int array (n,)
        As `optloc.proof.near.prove` or `optloc.proof.everywhere.prove_everywhere` returns it.
    boxes : int array (n,)
        Boxes looked at.
    bound : array (n,)
        Certified lower bounds of the posed cost.
    everywhere : bool array (n,)
        Whether the claim is for all positions, not for the region asked for or the fallback.
    found : array (n, d)
        Better or other points; NaN where there is none.
    """

    verdict: Array
    boxes: Array
    bound: Array
    everywhere: Array
    found: Array

    def take(self, index: Array) -> Answered:
        """Return what became of some of the proofs."""
        return Answered(*(getattr(self, name)[index] for name in Answered.__slots__))


def prove_all(pose: Posed, asked: Asked) -> Answered:
    """Return the outcome of the proofs of n fixes of n posed problems.

    A few proofs are begun in plain Python: most need few boxes, and machine code takes longer to load.
    """
    n = len(asked.x)
    if n > _FEW or len(pose.kinds) > _SMALL or ready(_loop):
        return _proven(pose, asked)
    with plain():
        out = _proven(pose, replace(asked, budget=np.minimum(asked.budget, max(5, _FIRST_BOXES // max(n, 1)))))
    short = np.flatnonzero((out.verdict == BUDGET) & (out.boxes < asked.budget))
    if len(short) and enabled():
        more = _proven(taken(pose, short), asked.take(short))
        for name in Answered.__slots__:
            getattr(out, name)[short] = getattr(more, name)
    return out


def _proven(pose: Posed, asked: Asked) -> Answered:
    n, d = asked.x.shape
    whole = np.zeros(n, dtype=np.int64)
    out = Answered(whole, whole.copy(), np.zeros(n), np.zeros(n, dtype=np.bool_), np.full((n, d), np.nan))
    own = [_plain(a) for a in (pose.w, *(getattr(asked, name) for name in Asked.__slots__))]
    geometry = [_plain(pose.data), _plain(pose.K)]

    length = max(_STRETCH[0], min(_STRETCH[1], n // 32))

    def stretch(first: int) -> None:
        part = slice(first, min(first + length, n))
        given: list[Any] = [array if len(array) == 1 else array[part] for array in geometry]
        given += [array[part] for array in own]
        given += [getattr(out, name)[part] for name in Answered.__slots__]
        with np.errstate(all="ignore"):  # plain Python would warn of what has no bound
            _loop(pose.kinds, *given)

    mapped(stretch, range(0, n, length), None if enabled() else 1)
    return out


def _plain(array: Array) -> Array:
    """Return an array in one form for all calls: machine code is made anew for read-only or strided arrays."""
    return np.require(array, requirements=["C", "W"])


@compiled
def _loop(
    kinds: Array,
    data: Array,
    K: Array,
    w: Array,
    x: Array,
    others: Array,
    known: Array,
    kappa: Array,
    eps: Array,
    region: Array,
    fallback: Array,
    budget: Array,
    verdict: Array,
    boxes: Array,
    bound: Array,
    everywhere: Array,
    found: Array,
) -> None:
    A, weight, groups = np.empty((K.shape[2], K.shape[2])), np.empty(K.shape[2]), empty_groups(K.shape[2])
    box = empty_box(K.shape[1], K.shape[2])
    for i in range(len(x)):
        rows = K[i if len(K) > 1 else 0]
        if i == 0 or len(K) > 1:
            set_geometry(kinds, rows, A, weight, groups)
        cost, own = Cost(kinds, data[i if len(data) > 1 else 0], rows, w[i], A, weight, groups), box
        if (weight == 0.0).any():
            cost = _present(cost)
            own = empty_box(cost.K.shape[0], cost.K.shape[1])
        minima, low, high = others[i, : known[i]], region[i, 0], region[i, 1]
        everywhere[i] = isnan(low[0])
        if everywhere[i]:
            verdict[i], boxes[i], bound[i] = prove_everywhere(
                cost, own, x[i], minima, kappa[i], eps[i], budget[i], found[i]
            )
            if verdict[i] != OPEN:
                continue
            everywhere[i] = False
            low, high = fallback[i, 0], fallback[i, 1]
        verdict[i], more, bound[i] = prove(
            cost, own, x[i], minima, kappa[i], eps[i], budget[i], low, high, False, found[i]
        )
        boxes[i] += more


@compiled
def _present(cost: Cost) -> Cost:
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

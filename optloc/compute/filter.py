"""The update of a predicted state by the rows of a scan, as machine code: one step, or as many as it takes.

In units of the prediction's own standard deviations, ``x = mean + L y`` with ``L L' = P``, the prior is ``|y|^2`` and
the update the least of the rows' cost and that: its equations are ``(I + L' A L) y = L' g``, A and g those of the rows.
A state that is known exactly in some direction is no exception: L has a column of zeros.
"""

from __future__ import annotations

from math import log, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, put
from optloc.compute.lanes import Cells, arrange, gather, load, memory
from optloc.compute.pack import Packed
from optloc.compute.systems import cholesky, solve_factored, substitute

# Halvings of a step that raises the cost, and the rise that is rounding: as in `optloc.track.updates`.
_HALVINGS, _RISE = 8, 1e-9
# Share of the largest variance below which what is left of one is rounding.
_NOTHING = 1e-15


class Absorbed(NamedTuple):
    """What becomes of a state, in arrays that are written.

    Parameters
    ----------
    mean, cov : array (n,), array (n, n)
        The state after the scan.
    said : array (2,)
        Normalised innovation squared at the prediction, and the logarithm of the determinant of the innovations'
        covariance in units of the rows' own noise.
    """

    mean: Array
    cov: Array
    said: Array


@compiled
def absorb(packed: Packed, mean: Array, cov: Array, limit: int, tolerance: float, out: Absorbed) -> int:
    """Update one state by one scan and return the steps taken, -1 where the covariance is none.

    Parameters
    ----------
    packed : Packed
        One scan, whose only unknown is the state.
    mean, cov : array (n,), array (n, n)
        The prediction.
    limit : int
        Steps at most; with one the covariance is that of the linearisation at the prediction, and steps are not halved.
    tolerance : float
        Length of a step, in standard deviations of the prediction, that ends them.
    out : Absorbed
        Written.
    """
    t, c = packed
    n = len(mean)
    room = arrange(t, c, n)
    m, r = memory(t, room, 1)
    load(m, 0, 0, c.source, c.white, c.prior, c.observed, c.present)
    root, half, factor = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    y, move, slope = np.zeros(n), np.zeros(n), np.zeros(n)
    if not _root(cov, root):
        return -1
    put(mean, out.mean)
    cost = _equations(packed, m, r, room, root, y, out.mean, half, factor, slope)
    put(slope, move)
    solve_factored(factor, move)
    # The innovations' own square is the least of the cost along straight rows: written so that an error of the step
    # enters squared, since the cost itself may be larger by many digits.
    out.said[0], out.said[1] = cost, 0.0
    for i in range(n):
        along = 0.0
        for k in range(i, n):
            along += factor[k, i] * move[k]
        out.said[0] += along * along - 2.0 * slope[i] * move[i]
        out.said[1] += 2.0 * log(factor[i, i])
    steps, share = 0, 1.0
    if limit == 1:
        _covariance(root, factor, out.cov)
        _place(mean, root, y, move, 1.0, out.mean)
        return 1
    place = np.empty(n)
    while steps < limit:
        steps, share, length = steps + 1, 1.0, 0.0
        for turn in range(_HALVINGS):
            for i in range(n):
                place[i] = y[i] + share * move[i]
            _place(mean, root, place, move, 0.0, out.mean)
            now = _equations(packed, m, r, room, root, place, out.mean, half, factor, slope)
            if now <= cost + _RISE * (1.0 + abs(cost)):
                break
            share = 0.5 * share if turn < _HALVINGS - 1 else share
        for i in range(n):
            length += (share * move[i]) ** 2
        put(place, y)
        cost = now
        if not sqrt(length) > tolerance:
            break
        put(slope, move)
        solve_factored(factor, move)
    _covariance(root, factor, out.cov)
    return steps


@compiled
def _root(cov: Array, root: Array) -> bool:
    """Write the lower triangular root of a covariance; return whether it is one."""
    n, most = len(cov), 0.0
    for i in range(n):
        most = max(most, cov[i, i])
    for j in range(n):
        left = cov[j, j]
        for k in range(j):
            left -= root[j, k] * root[j, k]
        # what is known exactly has no variance, nor a share in others'
        if not left > _NOTHING * cov[j, j]:
            if not left >= -1e-9 * most:
                return False
            continue
        root[j, j] = sqrt(left)
        for i in range(j + 1, n):
            value = cov[i, j]
            for k in range(j):
                value -= root[i, k] * root[j, k]
            root[i, j] = value / root[j, j]
    return True


@compiled
def _equations(
    packed: Packed,
    m: Array,
    r: Array,
    room: Cells,
    root: Array,
    y: Array,
    x: Array,
    half: Array,
    factor: Array,
    slope: Array,
) -> float:
    """Write the factor of ``I + L' A L`` and the slope ``L' g - y`` at a state; return its cost and the prior's."""
    t, c = packed
    n, width = len(x), t.shared + 1
    for i in range(n):
        m[room.trial + i, 0] = x[i]
    gather(t, c, m, r, room, False, 1)
    last = room.after + n * width
    cost = m[last + n, 0]
    for i in range(n):
        cost += y[i] * y[i]
        slope[i] = -y[i]
        for j in range(i, n):
            slope[i] += root[j, i] * m[last + j, 0]
        for j in range(n):
            half[i, j] = 0.0
            for k in range(j, n):
                a, b = max(i, k), min(i, k)
                half[i, j] += m[room.after + a * width + b, 0] * root[k, j]
    for i in range(n):
        for j in range(i + 1):
            value = 1.0 if i == j else 0.0
            for k in range(i, n):
                value += root[k, i] * half[k, j]
            factor[i, j] = value
    cholesky(factor, n, 0.0)  # no less than the unit matrix
    return float(cost)


@compiled
def _place(mean: Array, root: Array, y: Array, move: Array, share: float, out: Array) -> None:
    """Write the state at ``y + share move``."""
    for i in range(len(mean)):
        out[i] = mean[i]
        for k in range(i + 1):
            out[i] += root[i, k] * (y[k] + share * move[k])


@compiled
def _covariance(root: Array, factor: Array, out: Array) -> None:
    """Write ``L (C C')^-1 L'``: symmetric and positive, whatever rounding does."""
    n = len(root)
    rows = np.zeros((n, n))
    for i in range(n):  # rows of (C^-1 L')'
        for j in range(i + 1):
            rows[i, j] = root[i, j]
        substitute(factor, rows[i])
    for i in range(n):
        for j in range(i + 1):
            value = 0.0
            for k in range(n):
                value += rows[i, k] * rows[j, k]
            out[i, j] = out[j, i] = value

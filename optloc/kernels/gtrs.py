"""Squared-range least squares in lanes: Newton's method on the multiplier for many problems side by side.

Minimise ``|B y - g|^2`` over the cone ``y = (x, r)``, ``|x|^2 = r^2``, or the paraboloid ``y = (x, w)``, ``|x|^2 = w``.
Both constraints are ``y'Cy + 2h'y = 0``: C is the unit matrix except for its last entry, -1 (cone) or 0. h is zero
except for its last entry, 0 (cone) or -1/2.

The last axis of every array counts W = LANES problems, so that one instruction serves several of them. A lane is one
problem. Problems whose normal matrix is not definite, or whose iteration does not converge, are flagged. They need the
eigenvalues of a matrix pencil, which other code computes for a batch of a few hard problems. Letters: n unknowns y, q
rows, ``A = B'B``, ``b = B'g``.

Source: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), theorem 3.2.
"""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES, factor_plain, principal_axes, solve_plain

# Greatest number of Newton steps. With range differences and ranges of five and six stations all lanes converged in
# three or four. Problems that need more than three times this number are left to the eigenvalue method.
_STEPS = 12
# Least pivot as a share of the largest entry of B'B. Below it half of the digits are lost, and the eigenvalue method is
# better.
_WEAK = 1e-7
# Relative change of y below which the last Newton step squares the error to 1e-14.
_SETTLED = 1e-7

# Scalars of each lane in the scratch of `minimise`, after its matrices and vectors. BEND: minus the derivative of half
# the constraint by the multiplier. TODO: 1.0 until the iteration has converged. LEAST: least valid pivot. VALUE: half
# the constraint. LAST: last multiplier with a definite matrix. DEFINITE: 1.0 if the present matrix is definite.
MULTIPLIER, BEND, TODO, LEAST, VALUE, LAST, DEFINITE = range(7)
_NUMBERS = 7


@compiled
def scratch(n: int) -> int:
    """Return the number of rows of lanes that `minimise` needs as scratch for y of length n."""
    # Two matrices, five vectors and some scalars of each lane, as `minimise` splits them.
    return 2 * n * n + 5 * n + _NUMBERS


@compiled
def minimise(rows: Array, on_cone: bool, y: Array, settled: Array, work: Array) -> None:
    """Write the global minimisers of squared-range problems, one in each lane.

    Parameters
    ----------
    rows : array (q, n + 1, W)
        B and, in the last column, g: whitened rows, numbers of order one; absent rows are zero.
    on_cone : bool
        Whether the last entry of y is a range r; else it is ``|x|^2``.
    y : array (n, W)
        Written: the minimisers; without meaning if not settled.
    settled : float array (W,)
        Written: 1.0 if the iteration converged in the interval where ``B'B + multiplier C`` is positive definite, else
        0.0.
    work : array (at least ``scratch(n)``, W)
        Scratch.

    Notes
    -----
    More (1993), theorem 3.2: the function ``y'Cy + 2h'y`` of the multiplier decreases on this interval, and its only
    zero is the global minimiser.
    """
    n = len(y)
    A, lower = work[: n * n].reshape(n, n, LANES), work[n * n : 2 * n * n].reshape(n, n, LANES)
    rest = work[2 * n * n :]
    b, inverse, across, p = rest[:n], rest[n : 2 * n], rest[2 * n : 3 * n], rest[3 * n : 4 * n]
    slope, spare = rest[4 * n : 5 * n], rest[5 * n : 5 * n + _NUMBERS]
    multiplier, todo, least, value = spare[MULTIPLIER], spare[TODO], spare[LEAST], spare[VALUE]
    last, definite, bend = spare[LAST], spare[DEFINITE], spare[BEND]
    _normal(rows, A, b, least)
    for lane in range(LANES):
        # The iteration starts from unconstrained least squares: the multiplier zero is in the interval if B'B is
        # definite.
        multiplier[lane], last[lane], todo[lane] = 0.0, 0.0, 1.0
    for _ in range(_STEPS):
        _shift(A, b, multiplier, on_cone, slope, y)
        factor_plain(A, slope, lower, inverse)
        for lane in range(LANES):
            definite[lane] = 1.0
        for i in range(n):
            for lane in range(LANES):
                positive = 0.0 < inverse[i, lane] and inverse[i, lane] * least[lane] < 1.0
                definite[lane] = definite[lane] if positive else 0.0
        solve_plain(lower, inverse, y)
        _gradient(y, on_cone, across, p)
        solve_plain(lower, inverse, p)
        if not _advance(y, across, p, on_cone, spare, slope):
            break
    # One Newton step on the optimality conditions restores the digits that B'B has lost.
    _residual_slope(rows, y, across, multiplier, slope, value)
    solve_plain(lower, inverse, slope)
    _step(y, across, p, on_cone, slope, bend, value)
    for lane in range(LANES):
        settled[lane] = 1.0 if todo[lane] == 0.0 else 0.0
    for i in range(n):
        for lane in range(LANES):
            settled[lane] = settled[lane] if abs(y[i, lane]) < np.inf else 0.0


# Share of the largest eigenvalue of B'B below which a direction is undetermined, four digits above rounding; and
# curvature of the quadric along this direction below which the line meets the quadric only once.
_OPEN, _STRAIGHT = 1e-11, 1e-12


@compiled
def meet(rows: Array, on_cone: bool, y: Array, other: Array, settled: Array, two: Array, work: Array) -> None:
    """Write the two points where a line of minimisers meets the quadric, if the rows leave one direction undetermined.

    Stations in a plane leave the direction across the plane undetermined. If there are only as many rows as
    coordinates, one direction is always undetermined. All points along this direction have the same cost, so both
    points on the quadric are minimisers.

    Parameters
    ----------
    rows, on_cone : array (q, n + 1, W), bool
        As for `minimise`.
    y, other : array (n, W)
        Written if a lane is not settled: the first point and the second point.
    settled, two : float array (W,)
        In: lanes that are not settled are computed. Written: 1.0 if there is a point, and if there is a second one.
    work : array (at least ``scratch(n)``, W)
        Scratch.
    """
    n = len(y)
    A, axes = work[: n * n].reshape(n, n, LANES), work[n * n : 2 * n * n].reshape(n, n, LANES)
    rest = work[2 * n * n :]
    b, along, base, spare = rest[:n], rest[n : 2 * n], rest[2 * n : 3 * n], rest[3 * n]
    left = 0.0
    for lane in range(LANES):
        two[lane] = 0.0
        left += 1.0 - settled[lane]
    if left == 0.0:
        return
    _normal(rows, A, b, spare)
    principal_axes(A, axes, spare)
    for lane in range(LANES):
        if settled[lane] == 0.0:
            _meet_lane(A, axes, b, along, base, on_cone, y, other, settled, two, lane)


@compiled
def _open_axis(A: Array, lane: int) -> int:
    """Return the axis of the only eigenvalue on the diagonal of A that is zero up to rounding.

    The result is -1 if there is not exactly one such eigenvalue.
    """
    n, first, most, second = len(A), 0, 0.0, np.inf
    for k in range(n):
        most = max(most, A[k, k, lane])
        first = k if A[k, k, lane] < A[first, first, lane] else first
    for k in range(n):
        second = second if k == first else min(second, A[k, k, lane])
    return first if A[first, first, lane] < _OPEN * most < second else -1


@compiled
def _meet_lane(
    A: Array,
    axes: Array,
    b: Array,
    along: Array,
    base: Array,
    on_cone: bool,
    y: Array,
    other: Array,
    settled: Array,
    two: Array,
    lane: int,
) -> None:
    """Write the points of `meet` for one lane, as `y` and `other`.

    See `meet` for `on_cone`, `settled` and `two`. The eigenvalues of the normal matrix are on the diagonal of A, the
    eigenvectors in the columns of `axes`; b is the right side. `along` and `base` are scratch: direction and a point of
    the line of minimisers.
    """
    n, first = len(y), _open_axis(A, lane)
    if first < 0:
        return
    for i in range(n):
        along[i, lane], base[i, lane] = axes[i, first, lane], 0.0
    for k in range(n):
        if k != first:
            part = 0.0
            for i in range(n):
                part += axes[i, k, lane] * b[i, lane]
            for i in range(n):
                base[i, lane] += axes[i, k, lane] * part / A[k, k, lane]
    square, cross, value = 0.0, 0.0, 0.0
    for i in range(n - 1):
        square += along[i, lane] * along[i, lane]
        cross += along[i, lane] * base[i, lane]
        value += base[i, lane] * base[i, lane]
    u, v = along[n - 1, lane], base[n - 1, lane]
    if on_cone:
        square, cross, value = square - u * u, cross - u * v, value - v * v
    else:
        cross, value = cross - 0.5 * u, value - v
    inside = cross * cross - square * value
    if not inside >= 0.0:
        return
    # the larger root first, and the other one from their product, so that no digits cancel
    sum_of = -(cross + (np.sqrt(inside) if cross >= 0.0 else -np.sqrt(inside)))
    roots = (value / sum_of if sum_of != 0.0 else 0.0, sum_of / square if abs(square) > _STRAIGHT else np.nan)
    for t in roots:
        last = v + t * u
        # a negative last coordinate is behind the apex of the cone
        if not (last >= 0.0 and abs(t) < np.inf):
            continue
        for i in range(n):
            if settled[lane] == 0.0:
                y[i, lane] = base[i, lane] + t * along[i, lane]
            else:
                other[i, lane] = base[i, lane] + t * along[i, lane]
        two[lane] = settled[lane]
        settled[lane] = 1.0


@compiled
def _normal(rows: Array, A: Array, b: Array, least: Array) -> None:
    """Write the lower half of ``A = B'B``, ``b = B'g``, and the least valid pivot (W,), for `rows` [B | g]."""
    q, n = len(rows), len(b)
    for lane in range(LANES):
        least[lane] = 0.0
    for i in range(n):
        for lane in range(LANES):
            b[i, lane] = rows[0, i, lane] * rows[0, n, lane]
        for k in range(1, q):
            for lane in range(LANES):
                b[i, lane] += rows[k, i, lane] * rows[k, n, lane]
        for j in range(i + 1):
            for lane in range(LANES):
                A[i, j, lane] = rows[0, i, lane] * rows[0, j, lane]
            for k in range(1, q):
                for lane in range(LANES):
                    A[i, j, lane] += rows[k, i, lane] * rows[k, j, lane]
        for lane in range(LANES):
            least[lane] = max(least[lane], _WEAK * A[i, i, lane])


@compiled
def _shift(A: Array, b: Array, multiplier: Array, on_cone: bool, diagonal: Array, right: Array) -> None:
    """Write the diagonal (n, W) of ``A + multiplier C`` and the right side (n, W) ``b - multiplier h``."""
    n = len(b)
    sign, shift = (-1.0, 0.0) if on_cone else (0.0, 0.5)
    for i in range(n):
        turn, more = (1.0, 0.0) if i < n - 1 else (sign, shift)
        for lane in range(LANES):
            diagonal[i, lane] = A[i, i, lane] + turn * multiplier[lane]
            right[i, lane] = b[i, lane] + more * multiplier[lane]


@compiled
def _gradient(y: Array, on_cone: bool, across: Array, p: Array) -> None:
    """Write half the gradient of the constraint, ``C y + h`` (n, W), to `across` and to `p`."""
    n = len(y)
    for i in range(n - 1):
        for lane in range(LANES):
            across[i, lane] = p[i, lane] = y[i, lane]
    for lane in range(LANES):
        across[n - 1, lane] = p[n - 1, lane] = -y[n - 1, lane] if on_cone else -0.5


@compiled
def _value(y: Array, across: Array, on_cone: bool, out: Array) -> None:
    """Write half of the constraint, ``y'Cy + 2h'y``, to `out` (W,); `across` (n, W) is ``C y + h``."""
    n = len(y)
    for lane in range(LANES):
        # h is zero for the cone; for the paraboloid its last entry is minus a half.
        out[lane] = 0.0 if on_cone else -0.25 * y[n - 1, lane]
    for i in range(n):
        for lane in range(LANES):
            out[lane] += 0.5 * y[i, lane] * across[i, lane]


@compiled
def _advance(y: Array, across: Array, p: Array, on_cone: bool, spare: Array, free: Array) -> bool:
    """Update the multipliers of the lanes that have not converged, and return whether there are any.

    See `minimise` for `on_cone`. The update is Newton's step; a step out of the interval where the matrix is definite
    is halved. `across` is ``C y + h``, `p` is the solution for this right side. `spare` contains the scalars of each
    lane, named by the constants from MULTIPLIER on. `free` is scratch.
    """
    n = len(y)
    multiplier, todo, value = spare[MULTIPLIER], spare[TODO], spare[VALUE]
    last, definite, bend = spare[LAST], spare[DEFINITE], spare[BEND]
    big, far = free[0], free[1]
    _value(y, across, on_cone, value)
    for lane in range(LANES):
        bend[lane], big[lane], far[lane] = 0.0, 0.0, 0.0
    for i in range(n):
        for lane in range(LANES):
            bend[lane] += across[i, lane] * p[i, lane]
            big[lane], far[lane] = max(big[lane], abs(y[i, lane])), max(far[lane], abs(p[i, lane]))
    for lane in range(LANES):
        inside, now = definite[lane] != 0.0, multiplier[lane]
        step = value[lane] / bend[lane]
        # The criterion is the change of y, since the size of the multiplier has no meaning.
        moves = abs(step) * far[lane] > _SETTLED * big[lane]
        todo[lane] = todo[lane] if moves or not inside else 0.0
        # The last multiplier inside the interval is known to be definite, so repeated halving towards it succeeds.
        target = now + step if inside else 0.5 * (now + last[lane])
        last[lane] = now if inside else last[lane]
        multiplier[lane] = target if todo[lane] != 0.0 else now
    moving = 0.0
    for lane in range(LANES):
        moving += todo[lane]
    return moving > 0.0


@compiled
def _residual_slope(rows: Array, y: Array, across: Array, multiplier: Array, slope: Array, left: Array) -> None:
    """Write the gradient ``B'(B y - g) + multiplier (C y + h)`` to `slope`; `left` (W,) is scratch.

    `rows` are [B | g], `across` is ``C y + h``. Near the solution the result has the accuracy of B, not of B'B.
    """
    q, n = len(rows), len(y)
    for i in range(n):
        for lane in range(LANES):
            slope[i, lane] = multiplier[lane] * across[i, lane]
    for k in range(q):
        for lane in range(LANES):
            left[lane] = -rows[k, n, lane]
        for j in range(n):
            for lane in range(LANES):
                left[lane] += rows[k, j, lane] * y[j, lane]
        for i in range(n):
            for lane in range(LANES):
                slope[i, lane] += rows[k, i, lane] * left[lane]


@compiled
def _step(y: Array, across: Array, p: Array, on_cone: bool, slope: Array, bend: Array, value: Array) -> None:
    """Take one Newton step of y on the optimality conditions: slope and constraint become zero to first order.

    `slope` and `p` are solutions with the factored matrix, `across` is ``C y + h``. `bend` (W,) is minus the derivative
    of half the constraint by the multiplier; `value` is scratch.
    """
    n = len(y)
    _value(y, across, on_cone, value)
    for i in range(n):
        for lane in range(LANES):
            value[lane] -= across[i, lane] * slope[i, lane]
    for i in range(n):
        for lane in range(LANES):
            y[i, lane] -= slope[i, lane] + p[i, lane] * (value[lane] / bend[lane])

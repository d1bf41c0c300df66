"""One scan of a tracker as machine code: prediction, gate and update of states by rows of every kind.

States are ``x = mean + L y`` with ``L L' = P`` the predicted covariance, so that the prior is ``|y|^2``. The update is
the minimum of the prior and the cost of the rows: ``(I + B' B) y = B' e``. B contains the whitened derivatives of the
rows times L, and e the whitened residuals. For a state that is known exactly in some direction, L has a column of
zeros. `item` is the number of the scan in `rows`, s is the workspace of one state of n components. `how` are the
settings, `cov` are covariances, and `values` are the numbers of one state in `Filtered.values`. `memory` is the memory
of one track, see the constants from _PRODUCT on; empty for none.
"""

from __future__ import annotations

from math import isfinite, log, pi, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array, Status
from optloc.kernels.batched_rows import LaneCells, cell_layout, load, memory, write_derivatives
from optloc.kernels.jit import compiled, put
from optloc.kernels.pack import Numbers
from optloc.kernels.systems import cholesky, solve_factored, substitute
from optloc.kernels.tables import FIRST, GROUP_COLUMN, Tables

EKF, IEKF, MGEKF, MVEKF = range(4)
"""Forms of an update, see `optloc.tracking.updates`."""

NIS, LOGLIKELIHOOD, COUNT, CODE, REJECTED_ROWS, INNOVATION, PRESENT, SPREAD, REPEATS, EXCESS = range(10)
"""Columns of `Filtered.values`: three of `optloc.tracking.updates.Updated`, and the status.

REJECTED_ROWS counts the rows that did not pass the gate. INNOVATION is the sum of the squared innovations in their
standard deviations, each at most `Filtering.most`, and PRESENT the number of their rows. SPREAD is the trace of the
predicted covariance of the position. REPEATS and EXCESS are the scores of the tests in `_remember`; zero without a
memory.
"""
VALUES = 10

# Indices in the memory of a track: sum and variance of the products of the scores of two successive scans, and of NIS
# minus its expectation. The scores for the errors of the stations follow. The last ``m (n + 2)`` numbers are the rows
# of the scan: derivatives, residual and weight.
_PRODUCT, _PRODUCT_VARIANCE, _NIS, _NIS_VARIANCE, COLUMNS = range(5)
# Weight of earlier scans in a memory, as in `optloc.tracking.lasting`.
_KEEP = 0.98

GENERAL = -1.0
"""Value instead of a status, if the scan needs the general form of the filter."""
_OK, _SILENT, _NUMERICAL, _REJECTED = (
    float(one) for one in (Status.OK, Status.TOO_FEW_ROWS, Status.NUMERICAL, Status.REJECTED)
)

# Gauss-Legendre nodes along a step from 0 to 1: exact up to degree 9, and derivatives of ranges and angles are smooth.
NODES = tuple(0.5 + 0.5 * float(node) for node in np.polynomial.legendre.leggauss(5)[0])
SHARES = tuple(0.5 * float(weight) for weight in np.polynomial.legendre.leggauss(5)[1])
# Greatest number of halvings of a step that raises the cost: after the last (a 128th) the point counts as stationary;
# and the relative rise of a cost that counts as rounding.
HALVINGS, RISE = 8, 1e-9
# Share of a variance below which its remainder is rounding.
_NOTHING = 1e-15
# Share of a variance that must remain after the other rows, as in `optloc.base.linalg.whitening`.
_LOOP = 1e-12


class ScanRows(NamedTuple):
    """The rows of G scans of one structure; an array (G or 1, ...) has one row if the scans share it."""

    tables: Tables  # all rows are one group
    common: Array  # numbers that all scans share, see `Numbers`
    source: Array  # (G or 1, q): numbers that differ between scans
    covariance: Array  # (G or 1, m): variances; or (G or 1, m * m) if rows are correlated
    white: Array  # (G or 1, m * m): whitening matrix of all rows if they are correlated; else (1, 0)
    total: Array  # (G or 1, 2): rank of the covariance, logarithm of the determinant of 2 pi R
    z: Array  # (G or 1, N or 1, m): measurements less corrections
    weight: Array  # (G or 1, N or 1, m)
    station: Array  # (m, 2): indices of the errors of each row's stations in a memory, -1 for none
    sign: Array  # (m,): sign of the error of the second station


class Move(NamedTuple):
    """A prediction: transition F (n, n), process noise Q (N or 1, n, n) and drive (N or 1, n), a known change."""

    F: Array
    Q: Array
    drive: Array


class Filtering(NamedTuple):
    """Settings of the update of states.

    Parameters
    ----------
    form : int
        EKF, IEKF, MGEKF or MVEKF.
    limit : int
        Greatest number of steps of the iterated filter.
    tolerance : float
        Length of the last step, in standard deviations of the prediction.
    gate : float
        Rows with a larger innovation than this number of standard deviations are left out; infinite for no gate.
    most : float
        Greatest squared innovation with which a row is counted.
    d : int
        Number of coordinates of the position.
    """

    form: int
    limit: int = 1
    tolerance: float = 0.0
    gate: float = np.inf
    most: float = np.inf
    d: int = 0


class Filtered(NamedTuple):
    """States after a scan, written: `mean` (N, n), `cov` (N, n, n), and numbers `values` (N, VALUES) of each."""

    mean: Array
    cov: Array
    values: Array


class _Space(NamedTuple):
    """Workspace of one state.

    It contains the memory of one lane, matrices (n, n), rows (m, n + 1) with the residual last, and vectors.
    """

    m: Array  # (cells, 1): memory of the lane
    r: Array  # registers
    room: LaneCells  # addresses in the memory
    P: Array  # (n, n): predicted covariance
    root: Array  # (n, n): its root L
    factor: Array  # (n, n): factor of I + B' B
    rows: Array  # derivatives times root
    white: Array  # whitened `rows`
    W: Array  # (m, m): whitening matrix of the rows used
    used: Array  # (m,): weights, zero for rows that are left out
    x: Array  # predicted mean
    y: Array  # coordinates of the state, x = mean + L y
    move: Array  # step of y
    slope: Array  # right side of the step
    at: Array  # scratch for a state


@compiled
def filter_scan(
    rows: ScanRows, item: int, move: Move, mean: Array, cov: Array, how: Filtering, memory: Array, out: Filtered
) -> None:
    """Predict N states, leave out the rows outside the gate, and update the states with the other rows.

    Parameters
    ----------
    rows : ScanRows
        Rows of the scans.
    item : int
        Number of the scan.
    move : Move
        Prediction from the states to the time of the scan.
    mean, cov : array (N, n), array (N, n, n)
        States.
    how : Filtering
        Form of the filter, and its gate.
    memory : array
        Memory of a single track, which `_remember` updates; empty for none.
    out : Filtered
        Written. If no row is used or the update is not finite, the prediction is written.
    """
    n = mean.shape[1]
    s = _space(rows, item, n)
    for one in range(mean.shape[0]):
        values = out.values[one]
        for k in range(VALUES):
            values[k] = 0.0
        _predict(move, one, mean, cov, s)
        for i in range(how.d):
            values[SPREAD] += s.P[i, i]
        values[CODE] = _update(rows, item, one, how, s, memory, out)
        if values[CODE] != GENERAL and values[COUNT] > 0.0:  # else no update was written
            for i in range(n):
                if not isfinite(out.mean[one, i]) or not isfinite(out.cov[one, i, i]):
                    values[CODE] = _NUMERICAL
        if values[CODE] == _NUMERICAL or values[COUNT] == 0.0:
            values[NIS], values[LOGLIKELIHOOD] = np.nan, 0.0
            for i in range(n):
                out.mean[one, i] = s.x[i]
                for j in range(n):
                    out.cov[one, i, j] = s.P[i, j]


@compiled
def _space(rows: ScanRows, item: int, n: int) -> _Space:
    # Return the workspace for states of n components.
    t, m, none = rows.tables, rows.z.shape[2], np.zeros((1, 0))
    place, observed = np.zeros((0, 4), np.int64), np.zeros((1, m))
    c = Numbers(rows.common, place, rows.source, none, none, observed, none, none, none[0])
    room = cell_layout(t, c, n)
    cells, r = memory(t, room, 1)
    load(cells, 0, item, rows.source, none, none, observed, none)
    S, A, v = np.zeros((3, n, n)), np.zeros((2, m, n + 1)), np.zeros((5, n))
    W, used = np.zeros((m, m)), np.zeros(m)
    return _Space(cells, r, room, S[0], S[1], S[2], A[0], A[1], W, used, v[0], v[1], v[2], v[3], v[4])


@compiled
def _predict(move: Move, one: int, mean: Array, cov: Array, s: _Space) -> None:
    """Write the predicted state to x and P."""
    n, F = mean.shape[1], move.F
    own, half = _of(len(move.Q), one), s.factor
    for i in range(n):
        s.x[i] = move.drive[_of(len(move.drive), one), i]
        for j in range(n):
            half[i, j] = 0.0
        for k in range(n):
            if F[i, k] != 0.0:  # most entries are zero
                s.x[i] += F[i, k] * mean[one, k]
                for j in range(n):
                    half[i, j] += F[i, k] * cov[one, k, j]
    for i in range(n):
        for j in range(i + 1):
            value = 0.5 * (move.Q[own, i, j] + move.Q[own, j, i])
            for k in range(n):
                value += half[i, k] * F[j, k]
            s.P[i, j] = s.P[j, i] = value


@compiled
def _update(rows: ScanRows, item: int, one: int, how: Filtering, s: _Space, memory: Array, out: Filtered) -> float:
    """Write state number `one` after the scan to `out`, and return its status; GENERAL if nothing was written."""
    n, values, mean, cov = len(s.x), out.values[one], out.mean[one], out.cov[one]
    broken = _take(rows, item, one, s)
    if not _root(s.P, s.root):
        return GENERAL
    _evaluate(rows, s, s.x)
    _gate(rows, item, how, s, values)
    count, logdet = _whitener(rows, item, s)
    if count < 0.0:
        return GENERAL
    values[COUNT] = count
    if count == 0.0:
        for k in range(max(0, len(memory) - len(s.used) * (n + 2)), len(memory)):
            memory[k] = 0.0
        return _REJECTED if broken else _SILENT
    for i in range(n):
        s.y[i] = 0.0
    cost = _equations(s)
    put(s.slope, s.move)
    solve_factored(s.factor, s.move)
    values[NIS] = _least(s)
    if len(memory) > 0:
        _remember(rows, item, s, memory, values)
    values[LOGLIKELIHOOD] = -0.5 * (values[NIS] + logdet)
    for i in range(n):
        values[LOGLIKELIHOOD] -= log(s.factor[i, i])
    if how.form == IEKF:
        _iterate(rows, how, s, cost)
    else:
        put(s.move, s.y)
    _place(s, 1.0, mean)
    if how.form == MGEKF:
        _modify(rows, s, cov)
        return _REJECTED if broken else _OK
    if how.form == MVEKF:
        _evaluate(rows, s, mean)
        _equations(s)
    _covariance(s, cov)
    return _REJECTED if broken else _OK


@compiled
def _of(count: int, i: int) -> int:
    """Return the row of item i in an array with `count` rows; a single row is shared by all items."""
    return i if count > 1 else 0


@compiled
def _take(rows: ScanRows, item: int, one: int, s: _Space) -> bool:
    """Load the measurements and weights of state number `one`; return whether a present row is not finite."""
    broken = False
    for i in range(len(s.used)):
        z = rows.z[_of(rows.z.shape[0], item), _of(rows.z.shape[1], one), i]
        weight = rows.weight[_of(rows.weight.shape[0], item), _of(rows.weight.shape[1], one), i]
        broken = broken or (weight > 0.0 and not isfinite(z))
        s.used[i] = weight if isfinite(z) else 0.0
        s.m[s.room.observed + i, 0] = z
    return broken


@compiled
def _root(cov: Array, root: Array) -> bool:
    """Write the lower triangular root L of a covariance to `root`; return False if it is not semidefinite."""
    n, most = len(cov), 0.0
    for i in range(n):
        most = max(most, cov[i, i])
    for j in range(n):
        for i in range(j, n):
            root[i, j] = 0.0
        left = cov[j, j]
        for k in range(j):
            left -= root[j, k] * root[j, k]
        # an exactly known coordinate has no variance and no covariance
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
def _evaluate(rows: ScanRows, s: _Space, x: Array) -> None:
    """Write residuals, and derivatives times L, of the used rows at a state x (n,) to `s.rows`."""
    t, n = rows.tables, len(x)
    for i in range(n):
        s.m[s.room.trial + i, 0] = x[i]
    write_derivatives(t, rows.common, s.m, s.r, s.room, 0, s.room.trial, 1)
    begin = t.table[t.group, GROUP_COLUMN]
    columns = t.table[t.group + 1, GROUP_COLUMN] - begin
    for i in range(len(s.used)):
        cell = s.room.rows + i * t.width
        for k in range(n):
            s.rows[i, k] = 0.0
        s.rows[i, n] = s.m[cell + columns, 0] if s.used[i] > 0.0 else 0.0
        if s.used[i] > 0.0:
            for j in range(columns):
                column, slope = t.table[t.column + begin + j, FIRST], s.m[cell + j, 0]
                for k in range(column + 1):
                    s.rows[i, k] += slope * s.root[column, k]


@compiled
def _gate(rows: ScanRows, item: int, how: Filtering, s: _Space, values: Array) -> None:
    """Set the weights of rows whose innovation is outside the gate to zero, and count the rejected rows in `values`."""
    n, own = len(s.x), _of(len(rows.covariance), item)
    for i in range(len(s.used)):
        if s.used[i] > 0.0:
            total = _entry(rows, own, i, i)
            for k in range(n):
                total += s.rows[i, k] * s.rows[i, k]
            square = s.rows[i, n] * s.rows[i, n] / total
            values[PRESENT] += 1.0
            # innovations above the limit count as the limit, and NaN too
            values[INNOVATION] += min(how.most, square)
            if how.gate < np.inf and not sqrt(square) <= how.gate:
                values[REJECTED_ROWS] += 1.0
                s.used[i] = 0.0


@compiled
def _whitener(rows: ScanRows, item: int, s: _Space) -> tuple[float, float]:
    """Write the whitening matrix of the used rows; return their number and the log determinant of 2 pi R.

    The number is negative if the covariance of the used rows is singular because a row is left out.
    """
    m, W, own, correlated = len(s.used), s.W, _of(len(rows.covariance), item), rows.white.shape[1] > 0
    whole, count, logdet = correlated, 0.0, 0.0
    for i in range(m):
        whole = whole and s.used[i] == 1.0
        s.used[i] = s.used[i] if _entry(rows, own, i, i) > 0.0 else 0.0
    for j in range(m):  # row j minus its regression on the rows before, in units of the remaining standard deviation
        for i in range(m):
            W[j, i] = rows.white[_of(len(rows.white), item), j * m + i] if whole else 0.0
        if s.used[j] > 0.0 and not whole:
            variance = _entry(rows, own, j, j) / s.used[j]
            left = variance
            for k in range(0 if correlated else j, j):
                share = 0.0
                for i in range(k + 1):
                    share += W[k, i] * _entry(rows, own, j, i)
                left -= share * share
                for i in range(k + 1):
                    W[j, i] -= share * W[k, i]
            if not left > _LOOP * variance:
                return -1.0, 0.0
            W[j, j] = 1.0
            for i in range(j + 1):
                W[j, i] /= sqrt(left)
            count, logdet = count + 1.0, logdet + log(2.0 * pi * left)
    if whole:
        count, logdet = rows.total[_of(len(rows.total), item), 0], rows.total[_of(len(rows.total), item), 1]
    return count, logdet


@compiled
def _entry(rows: ScanRows, own: int, i: int, j: int) -> float:
    """Return entry (i, j) of the covariance of the rows; `own` is the row of the scan in `rows.covariance`."""
    m = rows.z.shape[2]
    if rows.covariance.shape[1] == m:
        return float(rows.covariance[own, i]) if i == j else 0.0
    return float(rows.covariance[own, i * m + j])


@compiled
def _equations(s: _Space) -> float:
    """Whiten the rows, write the factor of ``I + B' B`` and the slope ``B' e - y``; return the cost with the prior."""
    n, m, W, factor, slope = len(s.x), len(s.used), s.W, s.factor, s.slope
    for i in range(m):
        for k in range(n + 1):
            s.white[i, k] = 0.0
        for j in range(m):
            if W[i, j] != 0.0:
                for k in range(n + 1):
                    s.white[i, k] += W[i, j] * s.rows[j, k]
    cost = 0.0
    for i in range(n):
        cost += s.y[i] * s.y[i]
        slope[i] = -s.y[i]
        for j in range(i + 1):
            factor[i, j] = 1.0 if i == j else 0.0
    for r in range(m):
        cost += s.white[r, n] * s.white[r, n]
        for i in range(n):
            slope[i] += s.white[r, i] * s.white[r, n]
            for j in range(i + 1):
                factor[i, j] += s.white[r, i] * s.white[r, j]
    cholesky(factor, n, 0.0)  # at least the unit matrix, so it is regular
    return cost


@compiled
def _least(s: _Space) -> float:
    """Return the least cost of the linearised rows (NIS), from its definition as a minimum.

    An error of the step changes the result only in second order.
    """
    n, total = len(s.x), 0.0
    for i in range(n):
        total += s.move[i] * s.move[i]
    for r in range(len(s.used)):
        left = s.white[r, n]
        for i in range(n):
            left -= s.white[r, i] * s.move[i]
        total += left * left
    return total


@compiled
def _remember(rows: ScanRows, item: int, s: _Space, memory: Array, values: Array) -> None:
    """Test whether errors of the stations repeat from scan to scan, and whether the innovations are too large.

    Both results are numbers of standard deviations, over about the last fifty scans. The scores for the errors of the
    stations are ``a = D' S^-1 nu``: innovations nu, their covariance S, derivatives D. Let b be the scores of the scan
    before. The product of a and b has the mean zero and, for a given b, the variance ``(D b)' S^-1 (D b)``. `left` is
    the whitened nu after the update, `seen` is the whitened ``D b``.
    """
    n, m, own = len(s.x), len(s.used), _of(len(rows.covariance), item)
    left, seen, back = np.zeros(m), np.zeros(m), np.zeros(n)
    for k in range(COLUMNS):
        memory[k] *= _KEEP
    for j in range(m):
        left[j] = s.white[j, n]
        for i in range(n):
            left[j] -= s.white[j, i] * s.move[i]
    for i in range(m):
        size = _size(rows, own, i) if s.used[i] > 0.0 else 0.0
        expected = 0.0
        for k in range(2):
            if rows.station[i, k] >= 0:
                expected += size * (rows.sign[i] if k == 1 else 1.0) * memory[COLUMNS + rows.station[i, k]]
        for j in range(m):
            seen[j] += s.W[j, i] * expected
    variance = 0.0
    for j in range(m):
        memory[_PRODUCT] += seen[j] * left[j]
        variance += seen[j] * seen[j]
        for i in range(n):
            back[i] += s.white[j, i] * seen[j]
    substitute(s.factor, back)
    for i in range(n):
        variance -= back[i] * back[i]
    memory[_PRODUCT_VARIANCE] += max(variance, 0.0)
    memory[_NIS] += values[NIS] - values[COUNT]
    memory[_NIS_VARIANCE] += 2.0 * values[COUNT]
    for k in range(COLUMNS, len(memory)):
        memory[k] = 0.0
    _write_rows(rows.tables, s, memory[len(memory) - m * (n + 2) :])
    for i in range(m):
        size, score = _size(rows, own, i) if s.used[i] > 0.0 else 0.0, 0.0
        for j in range(m):
            score += s.W[j, i] * left[j]
        for k in range(2):
            if rows.station[i, k] >= 0:
                memory[COLUMNS + rows.station[i, k]] += size * (rows.sign[i] if k == 1 else 1.0) * score
    values[REPEATS] = memory[_PRODUCT] / sqrt(max(memory[_PRODUCT_VARIANCE], 1e-300))
    values[EXCESS] = memory[_NIS] / sqrt(max(memory[_NIS_VARIANCE], 1e-300))


@compiled
def _write_rows(t: Tables, s: _Space, out: Array) -> None:
    """Add derivatives, residual and weight of each used row to `out`, which has n + 2 zeros for each of the m rows."""
    n = len(s.x)
    begin = t.table[t.group, GROUP_COLUMN]
    columns = t.table[t.group + 1, GROUP_COLUMN] - begin
    for i in range(len(s.used)):
        if s.used[i] > 0.0:
            cell, first = s.room.rows + i * t.width, i * (n + 2)
            for j in range(columns):
                out[first + t.table[t.column + begin + j, FIRST]] += s.m[cell + j, 0]
            out[first + n], out[first + n + 1] = s.m[cell + columns, 0], s.used[i]


@compiled
def _size(rows: ScanRows, own: int, i: int) -> float:
    """Return the standard deviation of the error of each station of row i, from row `own` of the covariances."""
    return sqrt(_entry(rows, own, i, i) / (2.0 if rows.station[i, 1] >= 0 else 1.0))


@compiled
def _iterate(rows: ScanRows, how: Filtering, s: _Space, cost: float) -> None:
    """Take steps until one is short; halve steps that raise the cost. Write the minimiser to y with its equations."""
    n, place = len(s.x), np.empty(len(s.x))
    put(s.y, place)
    for _ in range(how.limit):
        share, length, now = 1.0, 0.0, 0.0
        for turn in range(HALVINGS):
            for i in range(n):
                s.y[i] = place[i] + share * s.move[i]
            _place(s, 1.0, s.at)
            _evaluate(rows, s, s.at)
            now = _equations(s)
            # NaN counts as worse: a step to where h is not defined is halved too
            if now <= cost + RISE * (1.0 + abs(cost)):
                break
            share = 0.5 * share if turn < HALVINGS - 1 else share
        for i in range(n):
            length += (share * s.move[i]) ** 2
        put(s.y, place)
        cost = now
        if not sqrt(length) > how.tolerance:
            break
        put(s.slope, s.move)
        solve_factored(s.factor, s.move)


@compiled
def _modify(rows: ScanRows, s: _Space, cov: Array) -> None:
    """Write the covariance of the modified gain, whose derivative is the mean along the way from the prediction.

    In units of the prediction it is ``(I - N G)(I - N G)' + N N'``: N = M^-1 B' is the gain, and G the mean derivative.
    """
    n, m = len(s.x), len(s.used)
    gain, mean = np.zeros((m, n)), np.zeros((m, n))
    for r in range(m):
        for i in range(n):
            gain[r, i] = s.white[r, i]
        solve_factored(s.factor, gain[r])
    for node in range(len(NODES)):
        _place(s, NODES[node], s.at)
        _evaluate(rows, s, s.at)
        _equations(s)
        for r in range(m):
            for i in range(n):
                mean[r, i] += SHARES[node] * s.white[r, i]
    parts, out = np.zeros((n, n + m)), np.zeros((n, n + m))  # [I - N G, N], and L times this matrix
    for i in range(n):
        parts[i, i] = 1.0
        for r in range(m):
            parts[i, n + r] = gain[r, i]
            for j in range(n):
                parts[i, j] -= gain[r, i] * mean[r, j]
    for i in range(n):
        for k in range(i + 1):
            for j in range(n + m):
                out[i, j] += s.root[i, k] * parts[k, j]
    _square(out, cov)


@compiled
def _place(s: _Space, share: float, out: Array) -> None:
    """Write the state ``mean + share * L y`` to `out`, with the predicted mean."""
    for i in range(len(s.x)):
        out[i] = s.x[i]
        for k in range(i + 1):
            out[i] += share * s.root[i, k] * s.y[k]


@compiled
def _covariance(s: _Space, out: Array) -> None:
    """Write ``L (C C')^-1 L'``, C the factor: the result is symmetric and positive despite rounding."""
    n, rows = len(s.x), np.zeros((len(s.x), len(s.x)))
    for i in range(n):  # rows of (C^-1 L')'
        for j in range(i + 1):
            rows[i, j] = s.root[i, j]
        substitute(s.factor, rows[i])
    _square(rows, out)


@compiled
def _square(A: Array, out: Array) -> None:
    """Write the matrix ``A A'`` to `out`."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            value = 0.0
            for k in range(A.shape[1]):
                value += A[i, k] * A[j, k]
            out[i, j] = out[j, i] = value

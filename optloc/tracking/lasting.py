"""Errors that last from scan to scan: their detection in the innovations of a track, and their part of its covariance.

A filter averages its rows as if their errors were independent. Delays of receivers, multipath and attitude last for
many scans, so the average keeps them. The true covariance of a filter with lasting errors follows from its gain K,
as in the consider analysis of Schmidt [1]_. Each station has an error b of s standard deviations of its rows, or
all angles share one error. The error is a Gauss-Markov process that keeps the share phi from scan to scan. The rows
measure h(x) + D b + v, with white noise v. The error e of the state has two steps:

    e <- F e + w,   e <- (I - K H) e - K (D b + v).

Its covariance is the covariance of the filter, plus (c^2 - 1) times the part from v, plus s^2 times the part from
b. c is the true standard deviation of v divided by the stated one. The filter and its estimates do not change. The
covariance of the innovations of a scan is linear in s^2 and c^2, and so is their covariance with the innovations
before. Weighted least squares estimates s^2 and c^2, and its score tests them [2]_.

Letters: m rows of a scan, n numbers of a state, q lasting errors (stations times kinds), j hypotheses about the
correlation time. F is the transition of the prediction, H (m, n) the derivative of the rows, R (m, m) their stated
covariance. D (m, q) is the derivative of the rows by the errors.

References
----------
.. [1] S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in Control
Systems 3 (1966).
.. [2] R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE Trans. Autom.
Control 15
   (1970): the autocovariances of innovations.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from optloc.base.errors import NUMERICAL
from optloc.base.types import Array
from optloc.kernels.filter import COLUMNS, ScanRows
from optloc.linear.normal import linearise, with_station_noise
from optloc.problem import noise as noises
from optloc.problem.problem import Problem
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.scan_rows import Scans, touched
from optloc.tracking.track import State, scan_at

# Correlation times in scans, a decade apart. On real tracks, the value of 100 scans alone finds most errors, and finer
# steps find no more.
_LASTS = np.array([1.0, 10.0, 100.0])
# Weight of all earlier scans at each new scan: errors are estimated over some fifty scans. With 0.95, more simulated
# scans are 5 sigma off (1.0 % instead of 0.5 %), and 0.99 follows changes of the surroundings later.
_KEEP = 0.98
# Standard deviations of the score above which errors last. Of 120 simulated tracks without lasting errors (60 scans
# each), 3 exceeded it for some scans, and NEES was between 1.01 and 1.08.
_SURE = 3.0
# Standard deviations that are subtracted from the score of one error for all angles. The reason is the long tail of a
# chi-square with one degree of freedom. Without it, 7 % of tracks without lasting errors have a common error for some
# scans.
_SKEWED = 1.5
# The same for larger errors that do not last: heavy tails of real rows must not trigger it.
_LARGE = 4.0
# Standard deviations of the compiled screen above which this test runs; it takes a hundred times longer. And standard
# deviations of the score below which the test ends.
_CALL, _END = 3.5, 1.0
# Standard deviations of the score of a start above which the next scans are tested, and the smallest number of these
# scans. On a UWB flight the first scan after a start was 7 sigma off, and the score of the start was 2.3.
_DOUBT, _FEW = 2.0, 5
# Limit of whitened innovations: gross errors within the gate are not lasting errors.
_WILD = 4.0
# Smallest share of the stated variance that stays white, and number of iterations of weights and estimate at a start.
_LEAST, _TURNS = 0.05, 3
# Largest number of tested rows of a start: the time grows with its third power, and 400 rows take a tenth of a second.
_MOST = 400
# Gate of the rows of a scan in standard deviations, as in `Rules`.
_GATE = 5.0
# Share of the mean variance of the rows that is added to each variance: if pairs form loops, the noise is singular.
_RIDGE = 1e-10


@dataclass(frozen=True, slots=True)
class _LastingRows:
    """Rows of one or several scans that pass the gate, linearised.

    - H (m, n): derivatives by the state.
    - residual (m,): measurements minus predictions, SI units.
    - scan (m,): numbers of the scans.
    - R (m, m): stated covariance.
    - D (j, m, q): derivatives by the lasting errors for each hypothesis; the unit of an error is one stated
    sigma.
    """

    H: Array
    residual: Array
    scan: Array
    R: Array
    D: Array

    @classmethod
    def of(cls, part: Problem, at: Array, cov: Array | None) -> _LastingRows:
        """Return the rows of the scans `part` at a state `at` (n,) that pass the gate.

        `cov` (n, n) is the covariance of the predicted state, which widens the gate. It is None for the residuals
        of a fit.
        """
        linear = linearise(part, at, ())
        R = noises.dense(with_station_noise(part, at).noise, np.arange(part.count))
        spread = np.diagonal(R) + (0.0 if cov is None else ((linear.shared @ cov) * linear.shared).sum(-1))
        used = (part.weight > 0.0) & (np.diagonal(R) > 0.0) & (np.abs(linear.residual) <= _GATE * np.sqrt(spread))
        D = _errors(R, *touched(part), part.stations.places.shape[-2])[:, used]
        return cls(linear.shared[used], linear.residual[used], part.epoch[used], R[np.ix_(used, used)], D)

    @classmethod
    def written(cls, rows: ScanRows, item: int, memory: Array, n: int, stations: int) -> _LastingRows:
        """Return the rows of a scan that the compiled filter wrote to `memory`, see `optloc.kernels.filter`.

        `item` is the number of the scan among the scans with these `rows`. `n` is the size of the state, and
        `stations` is the number of stations.
        """
        m = rows.z.shape[2]
        line = memory[len(memory) - m * (n + 2) :].reshape(m, n + 2)
        R = rows.covariance[item if len(rows.covariance) > 1 else 0]
        R = np.diag(R) if len(R) == m else R.reshape(m, m)
        used = line[:, n + 1] > 0.0
        # The last number of a line is the weight of its row: it divides the variance.
        scale = np.sqrt(line[used, n + 1])
        noise = R[np.ix_(used, used)] / (scale[:, None] * scale)
        errors = _errors(R, rows.station, rows.sign, stations)[:, used]
        return cls(line[used, :n], line[used, n], np.zeros(len(scale), dtype=np.int64), noise, errors)


def _errors(R: Array, columns: Array, sign: Array, stations: int) -> Array:
    """Return the derivatives D (j, m, q) of rows by lasting errors, scaled to the stated variance of each row.

    `columns` (m, 2) are the error numbers of the two stations of each row (-1: none), and `sign` (m,) is the
    sign of the second station (0 for angles); see `touched`. `stations` is the number of stations.

    `_Recursion` has the hypotheses j. Only angles share an error: an attitude. Ranges share none, because a common
    offset of ranges to stations in one direction is the same as an error of the position. When ranges shared an
    error, real tracks lost a fifth of their `ok` scans.
    """
    two = columns[:, 1] >= 0
    size = np.sqrt(np.diagonal(R) / np.where(two, 2.0, 1.0))
    # the first error of the kind is common to all stations
    shared = np.where(sign == 0.0, columns[:, 0] // stations * stations, columns[:, 0])
    D = np.zeros((2, len(R), 1 + int(columns.max(initial=0))))
    for one, first in zip(D, (columns[:, 0], shared), strict=True):
        for column, times in ((first, size), (columns[:, 1], sign * size)):
            index = np.flatnonzero(column >= 0)
            np.add.at(one, (index, column[index]), times[index])
    return np.repeat(D, len(_LASTS), axis=0)


class _Recursion:
    """The parts of a filter's covariance, and the accumulated score of lasting errors.

    The hypotheses j are the correlation times of `_LASTS`. The first half of the hypotheses has an error for
    each station, the other half one error for all angles of a kind.

    - phi (j, 1, 1): share of the error that stays from one scan to the next.
    - info (j, 2, 2), score (j, 2): normal equations for the excess of the white variance and for the lasting
    variance.
    - best: number of the best hypothesis; sure: its score in standard deviations.
    - scans: number of scans since the start.
    - white (n, n), lasting (j, n, n): parts of the covariance from white noise and from lasting errors of
    unit size.
    - cross (j, n, q): covariance of the state with the lasting errors.
    - before: whitened innovations of the last scan, and their covariances with the next scan; None without a
    last scan.
    - size, excess: estimates of s^2 and of c^2 - 1 of the module; 0 if they are not significant.
    """

    def __init__(self, n: int) -> None:
        """Start without information, for a state of n numbers."""
        J = 2 * len(_LASTS)
        self.phi = np.exp(-1.0 / np.tile(_LASTS, 2))[:, None, None]
        self.info, self.score = np.zeros((J, 2, 2)), np.zeros((J, 2))
        self.best, self.sure, self.scans = 0, 0.0, 0
        self.reset(np.zeros((n, n)))
        self.size, self.excess = 0.0, 0.0
        """Squared lasting error, and excess of the white variance over the stated variance, in stated variances."""

    @property
    def active(self) -> bool:
        """Return whether a lasting error, or an excess of white noise, is significant."""
        return self.size > 0.0 or self.excess > 0.0

    def reset(self, white: Array) -> None:
        """Start with a state without lasting errors; `info` and `score` do not change.

        `white` (n, n) is the part of its covariance from white noise.
        """
        J, n = len(self.phi), len(white)
        # Covariance from white noise, covariance from lasting errors, and covariance of the state with these errors.
        self.white, self.lasting, self.cross = white.copy(), np.zeros((J, n, n)), np.zeros((J, n, 0))
        # Whitened innovations of the scan before, and their covariances with the next innovations.
        self.before: tuple[Array, Array, Array, Array] | None = None

    def covariance(self, cov: Array) -> Array:
        """Return the covariance (n, n) of a filter with the errors; `cov` (n, n) is the covariance without them.

        A negative excess does not reduce it.
        """
        wide = cov + max(self.excess, 0.0) * self.white + self.size * self.lasting[self.best]
        return np.asarray(0.5 * (wide + wide.T))

    def begin(self, rows: _LastingRows, cov: Array) -> None:
        """Add the fix of a stretch of scans, and start the parts of the covariance from it.

        `rows` are the rows of the fix, and `cov` (n, n) is the covariance of its state. With more than `_MOST`
        rows, the start is not tested.
        """
        self.reset(cov)
        self.scans = 0
        if 0 < len(rows.residual) <= _MOST:
            try:
                self._test_start(rows, cov)
            except NUMERICAL:
                self.reset(cov)

    def _test_start(self, rows: _LastingRows, cov: Array) -> None:
        """Estimate lasting errors from the residuals of a start; later iterations weight by the estimate.

        `rows` are the rows of the fix, and `cov` (n, n) is its covariance.
        """
        H, R, D = rows.H, rows.R, rows.D
        # `gain` (n, m) maps the errors of the rows to the error of the fix, and `left` maps them to its residuals.
        gain = _solve_regularised(R, H @ cov).T
        left = np.eye(len(R)) - H @ gain
        apart = np.abs(rows.scan[:, None] - rows.scan)
        # `ties` (j, m, m) is the covariance of the rows from lasting errors of unit size.
        ties = self.phi**apart * (D @ np.swapaxes(D, -1, -2))
        self.cross = -gain @ (self.phi ** (rows.scan.max() - rows.scan)[:, None] * D)
        self.lasting = gain @ ties @ gain.T
        noise, errors = left @ R @ left.T, left @ ties @ left.T
        # Each iteration starts again from the sums before this start, so that the start counts once.
        info, score = self.info, self.score
        for turn in range(_TURNS):
            now = R if turn == 0 else R * (1.0 + max(self.excess, 0.0)) + self.size * ties[self.best]
            unit = _whitening(now)
            self.info, self.score = info.copy(), score.copy()
            self._add_size(unit, unit @ rows.residual, noise, noise, errors)
            self._estimate()

    def step(self, F: Array) -> None:
        """Propagate the parts of the covariance by a prediction with the transition F (n, n)."""
        self.white = F @ self.white @ F.T
        self.lasting = F @ self.lasting @ F.T
        self.cross = self.phi * (F @ self.cross)

    def take(self, rows: _LastingRows, F: Array, cov: Array) -> None:
        """Add a scan after its prediction, and update the parts of the covariance and the estimates.

        `F` (n, n) is the transition of the prediction, and `cov` (n, n) is the predicted covariance.
        """
        self.scans += 1
        self._widen(rows.D.shape[-1])
        H, R, D = rows.H, rows.R, np.pad(rows.D, [(0, 0), (0, 0), (0, self.cross.shape[-1] - rows.D.shape[-1])])
        back = np.swapaxes(D, -1, -2)
        # S is the stated covariance of the innovations. `noise` and `errors` are the derivatives of their true
        # covariance by c^2 and s^2.
        S, noise = H @ cov @ H.T + R, H @ self.white @ H.T + R
        tied = H @ self.cross @ back
        errors = H @ self.lasting @ H.T + tied + np.swapaxes(tied, -1, -2) + D @ back
        gain = _solve_regularised(S, H @ cov).T
        unit = _whitening(S + max(self.excess, _LEAST - 1.0) * noise + self.size * errors[self.best], S)
        w = unit @ rows.residual
        self.info, self.score = _KEEP * self.info, _KEEP * self.score
        self._add_size(unit, w, S, noise, errors)
        if self.before is not None:
            last, white, lasting, seen = self.before
            # `here` (j, m, r) is the covariance of these innovations with the last whitened ones, per s^2.
            here = unit @ (H @ F @ lasting + D @ (self.phi * seen))
            self._add_correlation(np.clip(w, -_WILD, _WILD), last, unit @ H @ F @ white, here)
        # `seen` (j, q, m) is the covariance of the lasting errors with the innovations. The stored tuple: clipped
        # whitened innovations, their covariances with the updated state per c^2 and per s^2, and with the errors.
        seen = np.swapaxes(self.cross, -1, -2) @ H.T + back
        self.before = (
            np.clip(w, -_WILD, _WILD),
            (self.white @ H.T - gain @ noise) @ unit.T,
            (self.lasting @ H.T + self.cross @ back - gain @ errors) @ unit.T,
            seen @ unit.T,
        )
        # The update of the module docstring: e <- (I - K H) e - K (D b + v).
        left, KD = np.eye(len(cov)) - gain @ H, gain @ D
        self.white = left @ self.white @ left.T + gain @ R @ gain.T
        part = left @ self.cross
        both = part @ np.swapaxes(KD, -1, -2)
        drawn = KD @ np.swapaxes(KD, -1, -2)
        self.lasting = left @ self.lasting @ left.T + drawn - both - np.swapaxes(both, -1, -2)
        self.cross = part - KD
        self._estimate()

    def _widen(self, columns: int) -> None:
        """Add columns for stations that were in no earlier scan; `columns` is the new number q of errors."""
        more = columns - self.cross.shape[-1]
        if more > 0:
            self.cross = np.pad(self.cross, [(0, 0), (0, 0), (0, more)])
            if self.before is not None:
                w, white, lasting, seen = self.before
                self.before = w, white, lasting, np.pad(seen, [(0, 0), (0, more), (0, 0)])

    def _add_size(self, unit: Array, w: Array, stated: Array, noise: Array, errors: Array) -> None:
        """Add the information from the size of a scan's innovations.

        `unit` (m, m) whitens them by the present estimate, and `w` (m,) are the whitened innovations. `stated`
        (m, m) is their stated covariance. `noise` (m, m) and `errors` (j, m, m) are its derivatives by c^2 and
        s^2.
        """
        # Half weight: the symmetric matrix has each pair of rows twice, and a squared innovation has variance 2.
        w = np.clip(w, -_WILD, _WILD)
        stated, noise, errors = (unit @ each @ unit.T for each in (stated, noise, errors))
        self._accumulate(0.5, np.outer(w, w) - stated, noise[None], errors)

    def _add_correlation(self, w: Array, last: Array, noise: Array, errors: Array) -> None:
        """Add the information from the correlation between the innovations of this scan and of the scan before.

        `w` (m,) and `last` (r,) are the whitened innovations. `noise` (m, r) and `errors` (j, m, r) are the
        derivatives of their covariance by c^2 and s^2.
        """
        self._accumulate(1.0, np.outer(w, last), noise[None], errors)

    def _accumulate(self, times: float, found: Array, noise: Array, errors: Array) -> None:
        """Add an observed matrix to `info` and `score`.

        `times` is its weight. `found` (m, r) is the matrix. `noise` (1, m, r) and `errors` (j, m, r) are its
        derivatives by the white and by the lasting variance.
        """
        one, mixed, two = ((a * b).sum((-1, -2)) for a, b in ((noise, noise), (noise, errors), (errors, errors)))
        self.info[:, 0, 0] += times * one
        self.info[:, 0, 1] += times * mixed
        self.info[:, 1, 0] += times * mixed
        self.info[:, 1, 1] += times * two
        self.score[:, 0] += times * (found * noise).sum((-1, -2))
        self.score[:, 1] += times * (found * errors).sum((-1, -2))

    def _estimate(self) -> None:
        """Choose the correlation time with the highest score, and set `best`, `sure`, `size` and `excess`.

        Errors count only if the score is significant; otherwise `size` and `excess` are 0.
        """
        info = self.info
        # `alone` (j,) is the information about s^2 after elimination of c^2. `value` is the estimate of s^2, and
        # `sure` is the estimate in its standard deviations. 1e-12 avoids a division by zero without rows.
        alone = np.maximum(info[:, 1, 1] - info[:, 0, 1] ** 2 / np.maximum(info[:, 0, 0], 1e-12), 1e-12)
        value = (self.score[:, 1] - info[:, 0, 1] * self.score[:, 0] / np.maximum(info[:, 0, 0], 1e-12)) / alone
        sure = value * np.sqrt(alone)
        sure[len(_LASTS) :] -= _SKEWED
        self.best = int(np.argmax(sure))
        self.sure = float(sure[self.best])
        one, mixed = info[self.best, 0]
        self.size = max(float(value[self.best]), 0.0) if self.sure > _SURE else 0.0
        excess = float(self.score[self.best, 0] - mixed * self.size) / max(float(one), 1e-12)
        large = self.size > 0.0 or excess * np.sqrt(float(one)) > _LARGE
        self.excess = max(excess, _LEAST - 1.0) if large else 0.0


def _solve_regularised(matrix: Array, right: Array) -> Array:
    """Return the inverse of a covariance (m, m), regularised by a small ridge, times the matrix `right`."""
    ridge = _RIDGE * float(np.trace(matrix)) / len(matrix)
    return np.asarray(np.linalg.solve(matrix + ridge * np.eye(len(matrix)), right))


def _whitening(cov: Array, other: Array | None = None) -> Array:
    """Return the inverse root (m, m) of the covariance `cov` (m, m); it whitens vectors with this covariance.

    If rounding makes the covariance indefinite, `other` replaces it (if given), and small eigenvalues are
    raised.
    """
    scale = _RIDGE * float(np.trace(cov)) / len(cov) * np.eye(len(cov))
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov + scale)))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(cov if other is None else other)
        return np.asarray(vectors.T / np.sqrt(np.maximum(values, 1e-9 * values.max()))[:, None])


@dataclass(frozen=True, slots=True)
class _Start:
    """A start of a track.

    - rows, cov (n, n): its rows and the covariance of its state.
    - info, score: the sums of `_Recursion` before the start.
    """

    rows: _LastingRows
    cov: Array
    info: Array
    score: Array


Taken = tuple[Scans, int, State]
"""A scan of a track: the scans of its run, its number, and the state before its prediction."""


class LastingErrors:
    """The lasting errors of a track, and its covariance with them.

    The compiled filter screens each scan, see `REPEATS` and `EXCESS` of `optloc.kernels.filter`. If the
    screen finds an error, `_Recursion` processes the last `window` scans again. From then on it processes
    each scan, until no error is left. It always processes scans that the compiled filter does not support.
    """

    def __init__(self, window: int) -> None:
        """Start without errors; `window` is the number of scans that are processed again."""
        self._recent: deque[Taken] = deque(maxlen=window)
        self._start: _Start | None = None
        self._found: _Recursion | None = None
        self._on = False
        self._memory = np.zeros(COLUMNS)

    def memory(self, size: int) -> Array:
        """Return the memory of the screen: an array of at least `size` numbers, see `filter_scan`."""
        if len(self._memory) < size:
            self._memory = np.zeros(size)
        return self._memory

    @property
    def size(self) -> float:
        """Return the lasting error of each station in standard deviations of its rows; 0 if no error was found."""
        found = self._found
        alone = self._on and found is not None and found.best < len(_LASTS)
        return float(np.sqrt(found.size)) if alone and found is not None else 0.0

    def begin(self, stretch: Problem, state: State) -> Array:
        """Return the covariance (n, n) of a new state, the fix of a stretch of scans, lasting errors included.

        `stretch` contains the scans, with a motion of the order of the state. `state` belongs to the last scan.
        """
        found = self._found or _Recursion(len(state.mean))
        rows = _LastingRows.of(stretch, state.mean, cov=None)
        self._start = _Start(rows, state.cov, found.info, found.score)
        self._recent.clear()
        self._memory[:] = 0.0
        found.begin(rows, state.cov)
        self._found, self._on = found, found.active or found.sure > _DOUBT
        return found.covariance(state.cov)

    def take(self, taken: Taken, dynamics: Dynamics, cov: Array, screen: tuple[float, float, float] | None) -> Array:
        """Return the covariance (n, n) of the state after a scan, lasting errors included.

        `taken` is the scan (see `Taken`), and `dynamics` is the model of motion. `cov` (n, n) is the covariance of
        the filter after the scan. `screen` contains REPEATS, EXCESS and SPREAD of the scan; it is None for a scan
        that the compiled filter does not support.
        """
        self._recent.append(taken)
        if not self._on:
            if screen is not None and screen[0] < _CALL and screen[1] < _CALL:
                return cov
            found = self._found = self._restored(len(cov))
            self._on = True
            for each in self._recent:
                _process_scan(found, each, dynamics, memory=None)
        else:
            assert self._found is not None
            found = self._found
            _process_scan(found, taken, dynamics, None if screen is None else self._memory)
            self._on = screen is None or found.active or found.sure > _END or found.scans < _FEW
        return found.covariance(cov)

    def _restored(self, n: int) -> _Recursion:
        """Return the recursion before the recent scans, which are processed again; `n` is the size of the state."""
        found, start = _Recursion(n), self._start
        if start is not None and len(self._recent) < (self._recent.maxlen or 0):
            found.info, found.score = start.info, start.score
            found.begin(start.rows, start.cov)
        else:
            # the parts of the covariance of an old state are not known: assume that it comes from white noise
            found.reset(self._recent[0][2].cov)
        return found


def _process_scan(found: _Recursion, taken: Taken, dynamics: Dynamics, memory: Array | None) -> None:
    """Process a scan (`taken`, see `Taken`) in the recursion `found`; `dynamics` is the model of motion.

    The rows of the scan are in `memory`, see `LastingErrors.memory`. Without `memory`, the rows are
    linearised again.
    """
    scans, k, before = taken
    problem, written = scans.problem, scans.rows[k]
    dt = float(problem.times[k]) - before.time
    F, Q, drive = (
        dynamics.step(dt, before.mean, problem.dimension) if dt > 0.0 else (np.eye(len(before.mean)), 0.0, 0.0)
    )
    mean, cov = F @ before.mean + drive, F @ before.cov @ F.T + Q
    found.step(F)
    if memory is not None and written is not None:
        rows: _LastingRows | None = _LastingRows.written(
            written, scans.item[k], memory, len(mean), problem.stations.places.shape[-2]
        )
    else:
        scan = scan_at(problem, k, dynamics.order)
        rows = _LastingRows.of(scan, mean, cov) if scan.rows else None
    if rows is None or not len(rows.residual):
        found.before = None
        return
    try:
        found.take(rows, F, cov)
    except NUMERICAL:  # the status of the filter reports the failure; the recursion starts again
        found.reset(np.zeros_like(before.cov))

r"""Registration in closed form: position, course and biases from range differences of moving stations, without a guess.

At times :math:`t_k` stations :math:`s_i(k)` measure range offsets to a reference station 0,

.. math:: r_i(k) = c_i(k) - E_i(k) \delta + \sigma_i r_0(k), \qquad r_i(k) = |x(t_k) - s_i(k)|,
          \qquad x(t) = \sum_j \theta_j t^j / j!,

with unknown biases :math:`\delta`. Squaring and subtracting :math:`r_0^2` leaves, with
:math:`m_i = c_i - E_i \hat\delta` and :math:`\delta = \hat\delta + \varepsilon`, rows that are linear in
:math:`(\theta, \varepsilon, r_0(k))` to first order in the small :math:`\varepsilon`:

.. math:: (s_i - s_0)' x + \sigma_i m_i r_0 - r_i E_i \varepsilon = \tfrac12 (|s_i|^2 - |s_0|^2 - m_i^2).

*Stage 0* takes every :math:`r_0(k)` as free and projects it out. *Stage 1* ties them to the course,

.. math:: r_0 \approx (\hat r_0^2 + r_0^2) / 2 \hat r_0, \qquad r_0^2 = \sum_j \lambda_j t^j - 2 s_0' x + |s_0|^2,

linear in :math:`\theta` and the lifts :math:`\lambda` of :math:`|x(t)|^2`. For a fixed target the one lift is
:math:`|x|^2`, and all stationary points of that problem with its quadratic constraint are found exactly. Stations in
one plane do not determine the distance from the plane; it follows from :math:`r_0` up to its sign, which gives two
branches.

Rows are divided by :math:`r_i`, so that their errors are range errors. All lengths are in one unit in which
stations and target are of order one to a hundred.

Sources: Y. T. Chan and K. C. Ho, "A simple and efficient estimator for hyperbolic location", IEEE Trans. Signal
Process. 42 (1994), for the lifted rows; A. Beck, P. Stoica, J. Li, IEEE Trans. Signal Process. 56 (2008), for the exact
constraint. Biases, free reference ranges over time and branches were derived for this package.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np

from formulations.algebra import Array
from formulations.squared_range import paraboloid, stationary

# Number of passes of stage 0, from random runs of 30 epochs, five stations and errors of 1e-3 of their spread. A fixed
# target two spreads away needs one pass. For a fixed target 30 spreads away, the 90 % error falls from 7.3 to 0.4 by
# the second pass. For a moving target it falls from 31 to 19 by the fourth pass.
_PASSES = 4
# Number of passes of stage 1 in the same runs: the second reduces the 90 % error of far fixed targets by a quarter;
# later passes change little.
_LIFTED_PASSES = 3
# Eigenvalues of the scaled normal matrix, relative to the largest, that count as zero. At 1e-6 the same runs lose weak
# directions of far courses (90 % error 35 instead of 19); below 1e-10 little changes.
_CUT = 1e-10
# Lower, because the lifts add columns that differ little from each other: values from 1e-8 to 1e-16 gave the same
# result.
_LIFTED_CUT = 1e-14

# Least reference range, in units of the stations' spread. Reference ranges start at one, and their squares may become
# negative. No station is so near to its target.
_NEAREST = 1e-3


@dataclass(frozen=True, slots=True)
class RegistrationCourse:
    """Range offsets of a batch of N problems at B times, with S stations and the reference station, and q biases.

    Parameters
    ----------
    time : Array, shape (B,)
        Times, numbers of order one.
    station : Array, shape (N or 1, B, S + 1, d)
        Stations, the reference first.
    offset : Array, shape (N, B, S)
        c, the range of each other station minus ``sign`` times the range of the reference.
    sign : Array, shape (S,)
        +1 for differences, -1 for sums of ranges.
    bias : Array, shape (N or 1, B, S, q)
        E, coefficients of the biases in the offsets.
    whiten : Array, shape (N or 1, B or 1, S, S)
        Whitening matrices of the offsets; zero rows for stations without a measurement.
    mean, sigma : Array, shape (q,)
        Prior of the biases; infinite `sigma` for none.
    """

    time: Array
    station: Array
    offset: Array
    sign: Array
    bias: Array
    whiten: Array
    mean: Array
    sigma: Array


@dataclass(slots=True)
class _Guess:
    """The result of a pass: `bias` (N, q), and the ranges `reference` (N, B) of the reference station."""

    bias: Array
    reference: Array


def candidates(course: RegistrationCourse, order: int = 0) -> tuple[Array, Array]:
    """Return starts of a registration: courses of the target and biases, without an initial guess.

    A local method refines all C candidates, because only their costs show which of them leads to the best minimum.

    Parameters
    ----------
    course : RegistrationCourse
        N problems.
    order : 0, 1 or 2
        Fixed target, constant velocity, constant acceleration.

    Returns
    -------
    state : Array, shape (N, C, order + 1, d)
        Candidates: position, velocity and acceleration at time zero. First the stationary points of stage 1 (one point
        for a moving target), then one course on each side of the plane of the stations; NaN for an empty place.
    bias : Array, shape (N, q)
        Biases for these candidates, the same for all C.
    """
    with np.errstate(all="ignore"):
        guess = _free_ranges(course, order)
        state = np.full((len(course.offset), 1, order + 1, course.station.shape[-1]), np.nan)
        for _ in range(_LIFTED_PASSES):
            state, guess = _tie_ranges(course, guess, order)
        branches = _plane_branches(course, state[:, 0], guess.reference)
    return np.concatenate([state, branches], axis=1), guess.bias


def _powers(course: RegistrationCourse, count: int) -> Array:
    """Return the factors t^j / j! (B, count) of position, velocity and higher derivatives, for j below `count`."""
    return np.stack([course.time**j / factorial(j) for j in range(count)], axis=-1)


def _rows(course: RegistrationCourse, guess: _Guess) -> tuple[Array, Array, Array, Array]:
    """Return ranges r, and the rows divided by r: columns of x, columns of r_0, right side; each (N, B, S, ...).

    The ranges follow from the biases and reference ranges of `guess`.
    """
    m = course.offset - (course.bias @ guess.bias[:, None, :, None])[..., 0]
    r = np.maximum(m + course.sign * guess.reference[..., None], _NEAREST)
    first, others = course.station[..., :1, :], course.station[..., 1:, :]
    right = ((others**2).sum(-1) - (first**2).sum(-1) - m**2) / (2.0 * r)
    return r, (others - first) / r[..., None], course.sign * m / r, right


def _course_columns(course: RegistrationCourse, columns: Array, order: int) -> Array:
    """Return columns (N, B, S, d) of a position as columns (N, B, S, (order + 1) d) of a course."""
    powers = _powers(course, order + 1)
    spread = powers[:, None, :, None] * columns[..., None, :]
    return spread.reshape(*spread.shape[:-2], -1)


def _free_ranges(course: RegistrationCourse, order: int) -> _Guess:
    """Return the biases and the smoothed reference ranges of stage 0."""
    size, q = len(course.offset), course.bias.shape[-1]
    guess = _Guess(np.zeros((size, q)) + course.mean, np.ones(course.offset.shape[:2]))
    for turn in range(_PASSES):
        r, place, gain, right = _rows(course, guess)
        if turn == 0:  # no ranges are known yet: all rows have equal weight, and biases keep their prior means
            place, gain, right = place * r[..., None], gain * r, right * r
        columns = [_course_columns(course, place, order)]
        if turn:
            columns.append(np.broadcast_to(-course.bias, (*right.shape, q)))
        seen = course.whiten @ np.concatenate([*columns, gain[..., None], right[..., None]], axis=-1)
        # The column of the free reference range (the last but one) is projected out of the whitened rows of every
        # epoch. Afterwards the best reference range follows from the remaining residuals `rest`.
        free = seen[..., -2]
        norm = (free**2).sum(-1, keepdims=True)
        unit = free / np.sqrt(np.where(norm > 0.0, norm, 1.0))
        bare = np.delete(seen, -2, axis=-1)
        bare = bare - unit[..., None] * (unit[..., None, :] @ bare)
        y = _least_squares(bare, course, guess.bias if turn else None, _CUT)
        rest = seen[..., -1] - (seen[..., :-2] @ y[:, None, :, None])[..., 0]
        reference = (free * rest).sum(-1) / np.where(norm > 0.0, norm, 1.0)[..., 0]
        bias = guess.bias + y[:, -q:] if turn and q else guess.bias
        guess = _Guess(bias, _smooth(course, reference, order))
    return guess


def _least_squares(rows: Array, course: RegistrationCourse, bias: Array | None, cut: float) -> Array:
    """Return the least-squares solution (N, n) of rows [A | b] (N, B, S, n + 1); undetermined directions stay zero.

    If `bias` (N, q) is given, the last q unknowns are changes of the biases, and get their prior. `cut` is the share of
    the largest eigenvalue that counts as zero.
    """
    flat = rows.reshape(len(rows), -1, rows.shape[-1])
    gram = np.swapaxes(flat, -1, -2) @ flat
    matrix, vector = gram[..., :-1, :-1].copy(), gram[..., :-1, -1].copy()
    if bias is not None and bias.shape[1]:
        index = np.arange(matrix.shape[-1])[-bias.shape[1] :]
        matrix[:, index, index] += course.sigma**-2.0
        vector[:, index] += (course.mean - bias) * course.sigma**-2.0
    return _solve(matrix, vector, cut)


def _solve(matrix: Array, vector: Array, cut: float) -> Array:
    """Return the solution (N, n) of normal equations scaled to a unit diagonal; NaN if the input is not finite.

    The equations are ``matrix y = vector``. The solution is zero along eigenvectors whose eigenvalue is at most `cut`
    times the largest: these directions have (almost) no information.
    """
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = matrix * scale[..., :, None] * scale[..., None, :]
    good = np.asarray(np.isfinite(scaled).all((-1, -2)))
    values, vectors = np.linalg.eigh(np.where(good[:, None, None], scaled, np.eye(matrix.shape[-1])))
    inverse = np.where(values > cut * values[..., -1:], 1.0 / np.where(values > 0.0, values, 1.0), 0.0)
    inner = (np.swapaxes(vectors, -1, -2) @ (scale * vector)[..., None])[..., 0] * inverse
    y = scale * (vectors @ inner[..., None])[..., 0]
    return np.where(good[:, None], y, np.nan)


def _smooth(course: RegistrationCourse, reference: Array, order: int) -> Array:
    """Return reference ranges (N, B) whose squares fit a course: r^2 - |s|^2 = lifts(t) - 2 s' x(t)."""
    first = course.station[..., 0, :]
    lifts = _powers(course, 2 * order + 1)
    along = _course_columns(course, first[..., None, :], order)[..., 0, :]
    basis = np.concatenate([np.broadcast_to(lifts, (*along.shape[:-1], lifts.shape[-1])), along], axis=-1)
    known = (first**2).sum(-1)
    square = (reference**2 - known)[..., None]
    # singular values, while the cut above is for their squares; many lifts and few times leave some undetermined
    fitted = basis @ (np.linalg.pinv(basis, rcond=1e-9) @ square)
    return np.asarray(np.sqrt(np.maximum(fitted[..., 0] + known, _NEAREST**2)))


def _tie_ranges(course: RegistrationCourse, guess: _Guess, order: int) -> tuple[Array, _Guess]:
    """Return the candidates of stage 1 (N, C, order + 1, d), and biases and reference ranges of the best candidate.

    The reference ranges are tied to the course: near `guess` they are linear in their squares.
    """
    q, d, n = course.bias.shape[-1], course.station.shape[-1], (order + 1) * course.station.shape[-1]
    _, place, gain, right = _rows(course, guess)
    # Rows in (bias, course, lifts). At the guess r, r_0 is replaced by (r^2 + r_0^2) / (2 r), which is linear in the
    # unknowns of r_0^2.
    first, r = course.station[..., :1, :], guess.reference[..., None]
    square = (first**2).sum(-1)
    lifts = (gain / (2.0 * r))[..., None] * _powers(course, 2 * order + 1)[:, None, :]
    columns = [
        np.broadcast_to(-course.bias, (*right.shape, q)),
        _course_columns(course, place - (gain / r)[..., None] * first, order),
        lifts,
        (right - gain * (r**2 + square) / (2.0 * r))[..., None],
    ]
    seen = course.whiten @ np.concatenate(columns, axis=-1)
    rows = _add_prior(seen.reshape(len(seen), -1, seen.shape[-1]), course, guess.bias)
    if order == 0:
        y, more = _solve_constrained(rows, q, d)
    else:
        matrix, vector = np.swapaxes(rows[..., :-1], -1, -2) @ rows[..., :-1], (rows[..., :-1] * rows[..., -1:]).sum(-2)
        y = _solve(matrix, vector, _LIFTED_CUT)
        more = y[:, None, q : q + n]
    state = more.reshape(len(more), -1, order + 1, d)
    distance = np.maximum(_reference(course, y[:, q : q + n], y[:, q + n :], order), _NEAREST**2)
    return state, _Guess(guess.bias + y[:, :q], np.sqrt(distance))


def _add_prior(rows: Array, course: RegistrationCourse, bias: Array) -> Array:
    """Return rows (N, R, q + n + 1), with the rows of the prior of the biases appended.

    The first q columns are changes of the biases from `bias` (N, q); the last column is the right side.
    """
    q = bias.shape[1]
    prior = np.zeros((len(rows), q, rows.shape[-1]))
    index = np.arange(q)
    prior[:, index, index] = 1.0 / course.sigma
    prior[:, index, -1] = (course.mean - bias) / course.sigma
    return np.concatenate([rows, prior], axis=1)


def _solve_constrained(rows: Array, q: int, d: int) -> tuple[Array, Array]:
    """Return biases, position and its square (N, q + d + 1), and all positions (N, C, d).

    The rows are [E | x | |x|^2 | right side]. The biases are free. A triangular factor eliminates them, and the
    remainder is a squared-range problem.
    """
    # biases in units in which their columns have length one: the triangular factor would neglect small columns
    usable = np.asarray(np.isfinite(rows).all((-1, -2)))
    scale = np.ones((len(rows), rows.shape[-1]))
    norm = np.sqrt((rows[..., :q] ** 2).sum(1))
    scale[:, :q] = np.where(usable[:, None] & (norm > 0.0), norm, 1.0)
    upper: Array = np.asarray(np.linalg.qr(np.where(usable[:, None, None], rows / scale[:, None], 0.0), mode="r"))
    points, _, valid = stationary(upper[:, q:, q:-1], upper[:, q:, -1], paraboloid(d))
    points = np.where((valid & usable[:, None])[..., None], points, np.nan)
    left = upper[:, :q, -1] - (upper[:, :q, q:-1] @ points[:, 0, :, None])[..., 0]
    inner = upper[:, :q, :q]
    bias = _solve(np.swapaxes(inner, -1, -2) @ inner, (inner * left[..., None]).sum(-2), 0.0) / scale[:, :q]
    return np.concatenate([bias, points[:, 0]], axis=-1), points[..., :d]


def _reference(course: RegistrationCourse, theta: Array, lifts: Array, order: int) -> Array:
    """Return the squared ranges (N, B) of the reference station to courses `theta` (N, (order + 1) d).

    `lifts` are the coefficients of |x(t)|^2. The results may be negative for solutions that violate the constraint.
    """
    first = course.station[..., 0, :]
    along = _course_columns(course, first[..., None, :], order)[..., 0, :]
    inner = (along @ theta[..., None])[..., 0]
    return np.asarray(lifts @ _powers(course, 2 * order + 1).T - 2.0 * inner + (first**2).sum(-1))


def _plane_branches(course: RegistrationCourse, state: Array, reference: Array) -> Array:
    """Return two courses (N, 2, order + 1, d), one on each side of the plane in which the stations spread most.

    The distance from the plane follows from the reference ranges (N, B). The part of the courses `state` (N, order + 1,
    d) along the plane does not change.
    """
    first = course.station[..., 0, :]
    # the normal is the direction in which the stations spread least; the reference range gives the distance from the
    # plane
    apart = course.station[..., 1:, :] - first[..., None, :]
    apart = apart.reshape(len(apart), -1, apart.shape[-1])
    _, vectors = np.linalg.eigh(np.swapaxes(apart, -1, -2) @ apart)
    normal = vectors[..., 0][:, None]
    powers = _powers(course, state.shape[1])
    away = powers @ state - first
    height = (away * normal).sum(-1)
    inside = (away**2).sum(-1) - height**2  # squared distance along the plane
    distance = np.sqrt(np.maximum(reference**2 - inside, 0.0))  # from the plane through the reference station
    level = (first * normal).sum(-1)
    # the distances at all times become a polynomial course along the normal by least squares
    fit = np.linalg.pinv(powers)
    flat = state - ((state * normal).sum(-1, keepdims=True)) * normal
    sides = [flat + ((level + side * distance) @ fit.T)[..., None] * normal for side in (1.0, -1.0)]
    return np.stack(sides, axis=1)

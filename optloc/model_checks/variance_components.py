"""Variance components by restricted maximum likelihood (REML), with data snooping for gross errors.

The problem, linearised at its fix, is v = J dx + B e + E b + n. Here v are the residuals. The errors e are independent;
they belong to groups, and their covariance is diag(theta). The offsets b are common to a group. The noise n has a given
covariance C.

With V = B diag(theta) B' + C, the matrix P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1 annihilates J. All functions here
need only T = F' P F and t = F' P v, with the columns F = [B, E]:

- t_j / T_jj estimates the size of an error along column j. For a row this is the leave-one-out residual.
- 1 / sqrt(T_jj) is the standard deviation of this estimate.
- t_j / sqrt(T_jj) is standard normal if column j has no error.

Arrays have N problems (fixes), q errors and g groups. A class is a set of groups with one common variance, and c is the
number of classes; in `Tested`, c is the number of offsets. Variances are factors of the stated variances, and a
log-factor is the logarithm of such a factor.

W. Baarda, "A testing procedure for use in geodetic networks" (1968), section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.model_checks.elements import Elements
from optloc.model_checks.groups import ROW_PRICE

CUT = 3.5
"""Limit of a test, in standard deviations: an error with a larger test counts as gross.

One normal error in 2000 exceeds this limit. Without it, the variance is 0.5 % too small, which needs no correction.
With a limit of 4, the tails of aircraft messages (7.7 % beyond 3 sigma) count as noise of single receivers."""

_CUT_SHARED = 10.0
"""The same limit for an error that several rows share.

A fix can absorb a shared error like a change of position, so the test is not reliable. An error that is excluded from
the estimate of the variance is in no covariance. One in fifteen headings of the robot data exceeds 3.5."""

# Margin between the squared test of a gross row and the squared test of a shared error: a likelihood ratio of ninety.
_MARGIN = 9.0

LOOSE = 0.5
"""Largest relative standard error of a standard deviation that the data determine."""

# Probability of the confidence intervals of the factors.
_LEVEL = 0.95
# If P keeps less than this share of a column's size, the remainder is rounding: the fix absorbs the whole column.
_ROUNDING = 1e-9
# Median of the square of a standard normal variable.
_MEDIAN = 0.45493642
# Lower limit of a variance factor. Without this limit, data without any error would give zero.
_MIN_VARIANCE = 1e-16
# Constant that is added to the scores of all log-factors. A factor of r squared errors then has its maximum at their
# sum divided by r - 4 instead of r. For large r the difference is negligible. For small r, the likelihood without this
# constant often has its maximum at zero: for a quarter of the stations with half the noise of the others (27 fixes by
# five ranges). Fixes with this estimate are wrong by hundreds of sigma. There, 95 % ellipses of fixes cover 89 % with
# the constant 1, 95 % with 2 and 97 % with 3.
_PENALTY = 2.0
# Largest share of the information of a factor that the penalty uses. The information is computed with one factor for
# all groups. With this limit the penalty at most doubles a variance.
_MAX_PENALTY_SHARE = 0.5
# Largest numbers of iterations: steps by medians, which only give rough factors; selections of gross errors; scoring
# steps after each selection.
_COARSE, _ROUNDS, _STEPS = 8, 5, 40
# Changes below which the iterations stop: of a step by medians in log-factors; of a scoring step and of a selection in
# standard errors.
_NEAR, _CLOSE, _SETTLED = 0.05, 1e-2, 0.05
# Smallest redundancy of an error whose test enters a median; value that replaces a median of zero.
_MIN_REDUNDANCY, _MIN_MEDIAN = 1e-3, 1e-2
# Limits of a step of a log-factor by medians: a median of few errors is rough.
_DOWN, _UP = -4.0, 8.0
# Smallest eigenvalue of an information matrix with unit diagonal. Below it, the eigenvector is a combination of factors
# that the data do not determine; the eigenvalue is rounding.
_RANK_TOLERANCE = 1e-9
# Smallest share of the axis of a factor inside the space that the data determine: below it the factor is not
# determined.
_DETERMINED = 0.9


@dataclass(frozen=True, slots=True)
class VarianceFit:
    """Estimated variance factors of g groups of errors.

    - variance (g,): factor of the stated variance; NaN for a group without errors.
    - error (g,): relative standard error of the square root of the factor; NaN or infinite if not determined.
    - low, high (g,): interval of 95 % of the factor; NaN if the data do not determine it. `low` is zero if the data are
      also consistent with no error.
    - shared (g,): True for a group whose factor the data do not determine; all these groups have one common factor.
    - stay: True if the data do not determine the common factor either; this factor is then 1.
    - gross (N, q): True for an error that was excluded as gross.
    - tests: tests of the residuals without the gross errors.
    """

    variance: Array
    error: Array
    low: Array
    high: Array
    shared: Array
    stay: bool
    gross: Array
    tests: Tested


@dataclass(frozen=True, slots=True)
class _MaximumLikelihood:
    """Result of the maximisation for c classes of errors.

    - variance (c,): variance factors.
    - error (c,): relative standard errors of the square roots of the factors; infinite if not determined.
    - gross (N, q): True for gross errors.
    - tests: tests without the gross errors.
    """

    variance: Array
    error: Array
    gross: Array
    tests: Tested


def fit(packed: Elements, left: Array, single: Array) -> VarianceFit:
    """Return the variance factors that maximise the penalised restricted likelihood.

    The penalty multiplies the likelihood by a power of each factor, at most its square (see `_PENALTY`). So a factor of
    few errors has no maximum at zero. `packed` holds N linearised problems with g groups. `left` (g,) marks groups
    without errors: their factor is zero. `single` (g,) marks groups that keep a separate factor, even if the data do
    not determine it.

    The check of which factors the data determine uses one factor for all groups. Otherwise a group with a small
    estimate would wrongly count as not determined.

    Raises
    ------
    InvalidProblem
        If no problem has redundancy.

    References
    ----------
    Y. Chung, S. Rabe-Hesketh, V. Dorie, A. Gelman, J. Liu, "A nondegenerate penalized likelihood estimator for variance
    parameters in multilevel models", Psychometrika 78 (2013), section 3.
    """
    packed, size = without_groups(packed, left), len(packed.names)
    with_errors = np.flatnonzero(total(packed.of_effect, size))
    count, number_of_group = len(with_errors), np.full(size + 1, -1)
    # Groups with errors get the numbers 0, 1, ...; all others get -1, also the last entry, for errors without a group.
    number_of_group[with_errors] = np.arange(count)
    group, nothing_fixed = number_of_group[packed.of_effect], np.zeros(count, dtype=bool)
    if not (tested(packed, np.ones(())).dof > 0).any():
        advice = "add rows, stations or known heights"
        raise InvalidProblem("no fix has more rows than unknowns, so the noise cannot be estimated", "noise", advice)
    # One factor for all groups. If the data do not determine it, they determine no factor.
    common = _maximise(packed, np.minimum(group, 0), np.zeros(1), nothing_fixed[:1], np.zeros(1))
    first_log_factor = np.full(count, np.log(common.variance[0]))
    shared = (
        ~(_relative_errors(common.tests, group, np.exp(first_log_factor), nothing_fixed) < LOOSE) & ~single[with_errors]
    )
    # Groups whose factors are not determined are merged. The merged class has the number of its first group.
    merge = np.where(shared, np.flatnonzero(shared)[0] if shared.any() else 0, np.arange(count))
    first_groups, class_of = np.unique(merge, return_inverse=True)
    classes = np.append(class_of, -1)[group]
    # If several groups are merged, the data may determine their common factor.
    undetermined = np.isin(first_groups, np.flatnonzero(shared))
    if shared.sum() > 1:
        undetermined &= ~(
            _relative_errors(
                common.tests, classes, np.exp(first_log_factor[: len(first_groups)]), nothing_fixed[: len(first_groups)]
            )
            < LOOSE
        )
    log_factor = np.where(undetermined, 0.0, first_log_factor[: len(first_groups)])
    information, _ = _score(common.tests, classes, np.exp(first_log_factor[: len(first_groups)]), undetermined)
    penalty = np.minimum(_PENALTY, _MAX_PENALTY_SHARE * np.diagonal(information))
    found = _maximise(packed, classes, log_factor, undetermined, penalty)
    low, high = (
        np.where(undetermined, np.nan, end)[class_of] for end in _confidence_interval(found, classes, undetermined)
    )

    def per_group(values: Array) -> Array:
        return np.asarray(np.append(values, np.nan)[number_of_group[:-1]])

    return VarianceFit(
        np.where(left, 0.0, per_group(found.variance[class_of])),
        per_group(np.where(shared, np.nan, found.error[class_of])),
        per_group(low),
        per_group(high),
        np.isin(np.arange(size), with_errors[shared]),
        bool(undetermined.any()),
        found.gross,
        found.tests,
    )


def without_groups(packed: Elements, left: Array) -> Elements:
    """Return the elements without the errors of the groups that `left` (g,) marks."""
    removed = np.append(left, False)[packed.of_effect]
    effect = np.where(removed[:, None], 0.0, packed.effect)
    return replace(packed, effect=effect, of_effect=np.where(removed, -1, packed.of_effect))


# Limit of a score, in standard deviations, above which an excluded group gets a factor. One in a hundred groups without
# errors exceeds it.
_SIGNIFICANT = 2.33


def visible(packed: Elements, found: VarianceFit, left: Array) -> Array:
    """Return a mask (g,) of the excluded groups whose errors are significant, by a score test of the factor zero.

    `found` is a fit of the N problems `packed` without the groups that `left` (g,) marks. The test uses the information
    I and the scores U of all factors. If group g has no errors, U_g divided by the square root of I_gg - I_gh I_hh^-1
    I_hg is standard normal (Verbeke and Molenberghs 2003, section 4). Here h are the groups that are not excluded.
    """
    size = len(packed.names)
    variance = np.append(np.nan_to_num(found.variance), 0.0)
    tests = without(tested(packed, variance[packed.of_effect]), found.gross)
    # An excluded group has the factor zero. Its score is the derivative by the factor, not by the logarithm.
    scale = np.where(left, 1.0, variance[:-1])
    information, per_fix = _score(tests, packed.of_effect, scale, np.zeros(size, dtype=bool))
    rest = np.flatnonzero(~left)
    coupling = information[:, rest]
    remaining = np.diagonal(information) - ((coupling @ _inverse(information[np.ix_(rest, rest)])) * coupling).sum(1)
    # If the other factors explain a group completely, the remaining information is rounding.
    determined = (
        left
        & (remaining > (1.0 - _DETERMINED) ** 2 * np.diagonal(information))
        & _determinable(tests, packed, found, left)
    )
    return np.asarray(determined & (per_fix.sum(0) > _SIGNIFICANT * np.sqrt(np.where(determined, remaining, 1.0))))


# If a shared error has three times the sigma of the rows, the estimate of its sigma must have at most this relative
# error. If all stations are on one side, a range fix absorbs most of a shared error, so the residuals allow any sigma:
# estimates of thirty times the sigma of the rows occurred.
_TIMES, _RELATIVE = 3.0, 0.25


def _determinable(tests: Tested, packed: Elements, found: VarianceFit, left: Array) -> Array:
    """Return a mask (g,) of groups whose sigma would be determined if it were a few times the sigma of the rows.

    `found` is a fit without the groups that `left` (g,) marks, and `tests` are the tests with its variances.
    """
    level = _TIMES**2 * float(np.nanmedian(found.variance[~left]))
    # An additional variance `level` of an error changes its T_jj to T_jj / (1 + T_jj level).
    share = tests.size[:, : tests.errors] * level
    # The standard error of a log-variance is the square root of the inverse information. It is twice the error of a
    # log-sigma.
    information = 0.5 * total(packed.of_effect, len(left), (share / (1.0 + share)) ** 2)
    return np.asarray(information * (2.0 * _RELATIVE) ** 2 > 1.0)


def _maximise(packed: Elements, classes: Array, log_factor: Array, fixed: Array, penalty: Array) -> _MaximumLikelihood:
    """Return the variance factors of c classes of errors, their standard errors and the gross errors.

    `classes` (N, q) is the class of each error, -1 for none, and `log_factor` (c,) the log-factors at the start.
    `fixed` (c,) marks factors that keep their value. `penalty` (c,) is added to the scores.
    """
    count, log_factor = len(log_factor), log_factor.copy()
    # Start with medians: medians tolerate up to half of the errors as gross, but scores of the likelihood do not.
    for _ in range(_COARSE):
        step = np.where(
            fixed, 0.0, _median_step(tested(packed, np.exp(log_factor)[classes]), classes, np.exp(log_factor))
        )
        log_factor += step
        if np.abs(step).max() < _NEAR:
            break
    for _ in range(_ROUNDS):
        before = log_factor.copy()
        # Gross errors are selected once per round, not in every step. Otherwise the steps would jump when the selection
        # changes.
        gross, tests = cleaned(packed, np.exp(log_factor)[classes])
        for _ in range(_STEPS):
            step, error = _scoring_step(tests, classes, np.exp(log_factor), fixed, penalty)
            last, log_factor = log_factor, np.maximum(log_factor + step, np.log(_MIN_VARIANCE))
            tests = without(tested(packed, np.exp(log_factor)[classes]), gross)
            if (np.abs(log_factor - last) <= _CLOSE * error).all():
                break
        if (np.abs(log_factor - before) <= _SETTLED * error).all():
            break
    variance = np.exp(log_factor)
    return _MaximumLikelihood(variance, _relative_errors(tests, classes, variance, fixed[:count]), gross, tests)


def _median_step(tests: Tested, classes: Array, variance: Array) -> Array:
    """Return steps of the log-factors (c,) that make the median of the squared tests the median of normal errors.

    `classes` (N, q) is the class of each error; -1 for none. `variance` (c,) are the factors before the step. A class
    without testable errors has the step zero.
    """
    q = classes.shape[1]
    squared, share = tests.sigmas[:, :q] ** 2, tests.size[:, :q] * variance[classes]
    step = np.zeros(len(variance))
    for g in range(len(variance)):
        values = squared[(classes == g) & (share > _MIN_REDUNDANCY)]
        if len(values):
            step[g] = np.log(max(float(np.median(values)) / _MEDIAN, _MIN_MEDIAN))
    return np.clip(step, _DOWN, _UP)


def _scoring_step(tests: Tested, classes: Array, variance: Array, fixed: Array, penalty: Array) -> tuple[Array, Array]:
    """Return the scoring step (c,) of the log-factors and the standard errors (c,) of the log-factors.

    The step has no component along a combination of factors that the data do not determine. `classes`, `fixed` and
    `penalty` are as in `_maximise`, and `variance` (c,) are the factors before the step.
    """
    information, per_fix = _score(tests, classes, variance, fixed)
    # The penalty has no curvature in the log-factors. Its size damps steps if the data hardly determine a factor.
    inverse = _inverse(information + np.diag(penalty))
    # A step changes a variance at most by the factor e: the quadratic model of the likelihood is not valid beyond.
    return np.clip(inverse @ (per_fix.sum(0) + penalty), -1.0, 1.0), np.sqrt(np.diagonal(inverse))


def _score(tests: Tested, classes: Array, variance: Array, fixed: Array) -> tuple[Array, Array]:
    """Return the information (c, c) of the log-factors and the scores of each problem (N, c).

    With T and t of `Tested`, the score of theta_g is the sum of (t_j^2 - T_jj) / 2 over the errors j of group g. The
    information of theta_g and theta_h is the sum of T_ij^2 / 2 (Harville 1977, section 5). Multiplication by theta
    converts both to log-factors. `variance` (c,) is theta, and `classes` (N, q) is the class of each error; -1 for
    none. A factor that `fixed` (c,) marks has no information and no score.
    """
    (n, q), count = classes.shape, len(variance)
    # Errors without a group get an additional last class, which is dropped.
    class_number, scale = np.where(classes >= 0, classes, count), np.where(fixed, 0.0, variance)
    error_score = 0.5 * (tests.vector[:, :q] ** 2 - tests.size[:, :q])
    position = (np.arange(n)[:, None] * (count + 1) + class_number).ravel()
    per_fix = np.bincount(position, error_score.ravel(), n * (count + 1)).reshape(n, -1)[:, :count] * scale
    pair = (class_number[:, :, None] * (count + 1) + class_number[:, None, :]).ravel()
    squared = 0.5 * tests.matrix[:, :q, :q].ravel() ** 2
    information = np.bincount(pair, squared, (count + 1) ** 2).reshape(count + 1, -1)[:count, :count]
    return information * np.outer(scale, scale), per_fix


def _inverse(information: Array) -> Array:
    """Return the pseudo-inverse of an information matrix (c, c); its rank is found after scaling to a unit diagonal."""
    half, _ = linalg.root(information, _RANK_TOLERANCE)
    return np.asarray(half @ half.T)


def _log_variances(tests: Tested, classes: Array, variance: Array, fixed: Array) -> tuple[Array, Array, Array]:
    """Return the variances of the log-factors, flags of determined factors, and the scoring step; all (c,).

    A variance is the larger one of two: the variance for normal errors, and the variance from the scatter of the
    problems' scores. The arguments are as in `_score`.
    """
    information, per_fix = _score(tests, classes, variance, fixed)
    inverse = _inverse(information)
    # Sandwich estimate from the problems' scores: errors that are not normal, for instance with tails, increase the
    # variance.
    scattered = inverse @ (per_fix.T @ per_fix) @ inverse
    determined = np.diagonal(inverse @ information) > _DETERMINED
    return np.maximum(np.diagonal(inverse), np.diagonal(scattered)), determined, inverse @ per_fix.sum(0)


def _relative_errors(tests: Tested, classes: Array, variance: Array, fixed: Array) -> Array:
    """Return the relative standard errors (c,) of the square roots of the factors; infinite if not determined.

    The arguments are as in `_score`.
    """
    spread, determined, _ = _log_variances(tests, classes, variance, fixed)
    # Convert the error of a log-variance to the error of its square root.
    return np.where(determined, np.sqrt(1.0 + np.sqrt(spread)) - 1.0, np.inf)


def _confidence_interval(found: _MaximumLikelihood, classes: Array, fixed: Array) -> tuple[Array, Array]:
    """Return the lower and upper ends (c,) of the 95 % confidence intervals of the variance factors.

    Both ends are NaN if the data do not determine the factor. `found` is the fit. `classes` (N, q) is the class of each
    error, -1 for none, and `fixed` (c,) marks factors that were not estimated.

    The residuals show an error plus the error of its prediction from the other rows. The variance of this sum is theta
    + tau with tau = theta (1 / r - 1) and the redundancy r of the error. Its likelihood is close to the likelihood of a
    chi-square variable (Satterthwaite 1946, equation 17), even if theta is near zero. The interval of theta is the
    interval of the sum minus tau.
    """
    from scipy.special import gammaincinv

    variance, q = found.variance, classes.shape[1]
    # T_jj theta is the redundancy of one error. In the mean over a class, errors with more redundancy count more.
    share = found.tests.size[:, :q] * variance[classes]
    redundancy = total(classes, len(variance), share**2) / np.maximum(total(classes, len(variance), share), _MIN_MEDIAN)
    redundancy = np.clip(redundancy, _MIN_REDUNDANCY, 1.0)
    predicted = variance * (1.0 / redundancy - 1.0)
    spread, determined, step = _log_variances(found.tests, classes, variance, fixed)
    # The step removes the effect of the penalty: the intervals belong to the likelihood alone.
    seen = np.maximum(variance * (1.0 + step) + predicted, _MIN_REDUNDANCY * predicted)
    # The logarithm of the sum has the variance spread r^2, because theta is the share r of the sum. With k degrees of
    # freedom this variance is about 2 / k, so its inverse is k / 2.
    half = 1.0 / np.maximum(spread * redundancy**2, _MIN_REDUNDANCY)
    ends = [gammaincinv(half, p) / half for p in (0.5 + 0.5 * _LEVEL, 0.5 - 0.5 * _LEVEL)]
    return tuple(np.where(determined, np.maximum(seen / end - predicted, 0.0), np.nan) for end in ends)  # type: ignore[return-value]


def total(group: Array, count: int, values: Array | None = None) -> Array:
    """Return the sum of `values` (N, q) over each of `count` groups; without values, the number of errors per group.

    `group` (N, q) is the group of each error; -1 for none.
    """
    number = np.where(group >= 0, group, count).ravel()
    return np.bincount(number, None if values is None else values.ravel(), count + 1)[:count].astype(float)


# Tests of single errors and offsets.


@dataclass(frozen=True, slots=True)
class Tested:
    """Test statistics T = F' P F and t = F' P v for the columns F = [B, E], and the chi-square of the residuals.

    - matrix (N, q + c, q + c): T.
    - vector (N, q + c): t.
    - errors: q, the number of columns of errors; the other c columns are offsets.
    - cost (N,): v' P v, chi-square distributed with `dof` degrees of freedom.
    - dof (N,): rank of P.
    """

    matrix: Array
    vector: Array
    errors: int
    cost: Array
    dof: Array

    @property
    def size(self) -> Array:
        """Return the diagonal of T, (N, q + c)."""
        return np.asarray(np.diagonal(self.matrix, axis1=-2, axis2=-1))

    @property
    def sigmas(self) -> Array:
        """Return the tests t / sqrt(T) of all columns (N, q + c), in standard deviations; 0 if no test is possible."""
        size = self.size
        return np.where(size > 0.0, self.vector / np.sqrt(np.where(size > 0.0, size, 1.0)), 0.0)

    def without(self, column: Array) -> Tested:
        """Return the tests with an unknown error along one column (N,) of each problem; -1 for no column."""
        items = np.flatnonzero(column >= 0)
        j = column[items]
        matrix, vector, cost, dof = self.matrix.copy(), self.vector.copy(), self.cost.copy(), self.dof.copy()
        # Eliminate the unknown of column j: a Schur complement of one row and column.
        along, own = matrix[items, :, j], matrix[items, j, j]
        vector[items] -= along * (self.vector[items, j] / own)[:, None]
        matrix[items] -= along[:, :, None] * along[:, None, :] / own[:, None, None]
        cost[items] -= self.vector[items, j] ** 2 / own
        dof[items] -= 1
        # Column j explains these columns completely, so they cannot be tested any more; rounding would make them
        # outliers.
        explained = np.diagonal(matrix[items], axis1=-2, axis2=-1) <= _ROUNDING * self.size[items]
        matrix[items] *= ~(explained[:, :, None] | explained[:, None, :])
        vector[items] *= ~explained
        return Tested(matrix, vector, self.errors, cost, dof)


def tested(packed: Elements, variance: Array) -> Tested:
    """Return the test statistics of every error and offset of N problems.

    `variance` is theta, the variance of each error (N, q), or one value for all errors.
    """
    q = packed.effect.shape[-1]
    scaled = packed.effect * np.sqrt(np.broadcast_to(variance, packed.of_effect.shape))[:, None]
    covariance = scaled @ np.swapaxes(scaled, 1, 2) + packed.fixed
    # P = W' (I - Q Q') W, where W whitens V and Q is an orthonormal basis of W J: no inverse of V is formed.
    whiten = linalg.whitening(covariance)
    columns = np.concatenate([packed.effect, packed.offset, packed.residual[..., None]], axis=-1)
    white, known = whiten @ columns, whiten @ packed.jacobian
    root, _ = linalg.root(np.swapaxes(known, 1, 2) @ known)
    basis = known @ root
    free = white - basis @ (np.swapaxes(basis, 1, 2) @ white)
    gram = np.swapaxes(free, 1, 2) @ free
    # Number of rows that whitening keeps, minus number of unknowns that the Jacobian determines.
    rank = (whiten != 0.0).any(-1).sum(-1) - (root != 0.0).any(-2).sum(-1)
    matrix = gram[:, :-1, :-1]
    size = np.diagonal(np.swapaxes(white, 1, 2) @ white, axis1=-2, axis2=-1)[:, :-1]
    seen = np.diagonal(matrix, axis1=-2, axis2=-1) > _ROUNDING * size
    both = seen[:, :, None] & seen[:, None, :]
    return Tested(np.where(both, matrix, 0.0), np.where(seen, gram[:, :-1, -1], 0.0), q, gram[:, -1, -1], rank)


def without(tests: Tested, gross: Array) -> Tested:
    """Return the test statistics after all errors that `gross` (N, q) marks are estimated as unknowns."""
    items = np.arange(len(gross))
    # One iteration per gross error of the problem with the most gross errors.
    order = np.argsort(~gross, axis=1, kind="stable")[:, : int(gross.sum(1).max(initial=0))]
    for column in order.T:
        tests = tests.without(np.where(gross[items, column] & (tests.size[items, column] > 0.0), column, -1))
    return tests


def deviance(packed: Elements, found: VarianceFit) -> float:
    """Return twice the negative logarithm of the restricted likelihood, with a penalty for each gross row.

    It is the likelihood of K' v, where K is an orthonormal basis of the complement of J. The basis does not depend on
    the variances, so the values for different sets of groups are comparable (Harville 1977, section 3). A gross row is
    an additional unknown. `found` holds the variances of the groups of `packed`; a NaN counts as zero.
    """
    variance = np.append(np.nan_to_num(found.variance), 0.0)[packed.of_effect]
    scaled = packed.effect * np.sqrt(variance)[:, None]
    covariance = scaled @ np.swapaxes(scaled, 1, 2) + packed.fixed
    # Rows without any variance are padding: a unit variance does not change the determinant.
    absent = np.diagonal(covariance, axis1=1, axis2=2) == 0.0
    covariance += absent[:, :, None] * np.eye(covariance.shape[1])
    basis, sizes, _ = np.linalg.svd(packed.jacobian)
    seen = np.zeros((len(basis), basis.shape[-1]), dtype=bool)
    seen[:, : sizes.shape[1]] = sizes > _ROUNDING * sizes[:, :1]
    # Directions of the Jacobian get a unit variance and no residual.
    free = np.swapaxes(basis, 1, 2) * ~seen[:, :, None]
    inside = free @ covariance @ np.swapaxes(free, 1, 2) + seen[:, :, None] * np.eye(basis.shape[-1])
    doubled = float(np.linalg.slogdet(inside)[1].sum())
    tests = tested(packed, variance)
    # With every noise structure the worst rows are excluded at the same penalty, so a single row does not favour a
    # structure.
    cut = np.where(packed.common[packed.of_effect], np.inf, np.sqrt(ROW_PRICE))
    gross = snooped(tests, slice(0, tests.errors), cut).gross
    items = np.arange(len(variance))
    order = np.argsort(~gross, axis=1, kind="stable")[:, : int(gross.sum(1).max(initial=0))]
    for column in order.T:
        out = gross[items, column] & (tests.size[items, column] > 0.0)
        # An additional unknown along column j multiplies the determinant by T_jj.
        doubled += float(np.log(tests.size[items, column][out]).sum()) + ROW_PRICE * int(out.sum())
        tests = tests.without(np.where(out, column, -1))
    return doubled + float(tests.cost.sum())


# Data snooping.


def cleaned(packed: Elements, variance: Array) -> tuple[Array, Tested]:
    """Return the gross errors (N, q) and the tests without them.

    `variance` is as in `tested`. A row is gross only if its error explains much more than a shared error. Without this
    rule, epochs with a large shared error would be excluded, and the variance of the shared error would be too small.
    """
    tests = tested(packed, variance)
    shared = packed.common[packed.of_effect] & (np.broadcast_to(variance, packed.of_effect.shape) > 0.0)
    cut = np.where(packed.common[packed.of_effect], _CUT_SHARED, CUT)
    found = snooped(tests, slice(0, tests.errors), cut, shared if shared.any() else None)
    return found.gross, found.tests


@dataclass(frozen=True, slots=True)
class Snooped:
    """Result of data snooping: gross errors, estimates of all errors, and the tests without the gross errors.

    - gross (N, p): True for a column whose test exceeds the limit.
    - shift, sigma (N, p): size of an error along each column, estimated from the other rows, and its standard
      deviation; NaN if the other rows do not determine it.
    - tests: tests without the gross errors.
    """

    gross: Array
    shift: Array
    sigma: Array
    tests: Tested


def snooped(tests: Tested, columns: slice, cut: float | Array, shared: Array | None = None) -> Snooped:
    """Return the gross errors along some columns of the tests, by data snooping (Baarda 1968, section 4).

    In each problem, the column with the largest ratio of its test to its limit `cut` is excluded, and the
    remaining columns are tested again. The procedure ends when no test exceeds its limit. `cut` is one limit for all
    columns or one limit per column. With `shared` (N, p), the squared test of a row must also exceed a limit: the
    squared tests of all shared columns of its problem plus a margin.
    """
    n, first = len(tests.vector), range(tests.vector.shape[1])[columns].start
    shift, sigma = error_sizes(tests, columns)
    gross = np.zeros(shift.shape, dtype=bool)
    while True:
        size = np.abs(tests.sigmas[:, columns])
        beyond = size / cut
        if shared is not None:
            most = np.where(shared, size, 0.0).max(1, keepdims=True)
            beyond = np.where(shared | (size**2 > most**2 + _MARGIN), beyond, 0.0)
        worst = beyond.argmax(1)
        hit = np.flatnonzero(beyond[np.arange(n), worst] > 1.0)
        # A gross column keeps the estimate from before its exclusion.
        now = error_sizes(tests, columns)
        shift, sigma = (np.where(gross, old, new) for old, new in zip((shift, sigma), now, strict=True))
        if not len(hit):
            return Snooped(gross, shift, sigma, tests)
        gross[hit, worst[hit]] = True
        # Exclude one column per problem and iteration: two tests above the limit may come from the same error.
        column = np.full(n, -1)
        column[hit] = first + worst[hit]
        tests = tests.without(column)


def error_sizes(tests: Tested, columns: slice) -> tuple[Array, Array]:
    """Return the size of an error along each column and its standard deviation (N, p), from the other rows.

    Both are NaN if the other rows do not determine the size. `columns` selects p columns of the tests.
    """
    size, vector = tests.size[:, columns], tests.vector[:, columns]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(size > 0.0, vector / size, np.nan), np.where(size > 0.0, size**-0.5, np.nan)

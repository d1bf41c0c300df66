"""Variance components by restricted maximum likelihood, with gross errors left out one by one.

A problem linearised at its fix is v = J dx + B e + E b + n: v residuals, e independent errors of the groups' noise with
covariance diag(theta), b offsets of the groups, n what has a covariance C of its own. With V = B diag(theta) B' + C and
P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1, which annihilates J, all that follows needs only T = F' P F and t = F' P v of
the columns F = [B, E]: t_j / T_jj is the size of an error along column j that the other rows show (for a row, its
leave-one-out residual), 1 / sqrt(T_jj) its standard deviation, and t_j / sqrt(T_jj) is standard normal without one.

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
"""Size of a test, in standard deviations, from which an error counts as gross.

One normal error in 2000 is beyond, so that the variance of the rest is 0.5 % too small and needs no correction; at 4
the tails of airliners' messages (7.7 % beyond 3 sigma) count as noise of single receivers."""

_WIDE = 10.0
"""The same of an error that rows have in common: a fix follows it as it follows another place, so that no test tells it
there, and what is left out of the level is in no covariance. One in fifteen headings of robots is beyond 3.5."""

# Margin of the squared test of a gross row over the test of an error in common: a likelihood ratio of ninety.
_MARGIN = 9.0

LOOSE = 0.5
"""Relative standard error of a standard deviation from which the data are said not to tell it."""

# Content of the intervals of factors.
_LEVEL = 0.95
# Share of a column's size below which what P leaves of it is rounding: the fix absorbs it whole.
_NOTHING = 1e-9
# Median of the square of a standard normal variable.
_MEDIAN = 0.45493642
# Factor of a variance below which none falls: data without any error would lead on to zero.
_LEAST = 1e-16
# What is added to the scores of all log-factors: a factor of r squares of errors is then most likely at their sum over
# r - 4 in the place of r; with many nobody sees the difference. With few the likelihood alone has its maximum at zero
# for a quarter of the stations that have half the noise of others (27 fixes by five ranges), and fixes that believe it
# are hundreds of sigma off. With 1 the 95 % ellipses of fixes hold 89 % there, with 2 they hold 95 %, with 3 97 %.
_PENALTY = 2.0
# Most of what it takes of the information of a factor where all groups have the same: no variance is more than doubled.
_SHARE = 0.5
# Steps of the medians, which only bring the factors near; turns of gross errors and steps; scoring steps of a turn.
_COARSE, _ROUNDS, _STEPS = 8, 5, 40
# Moves that end them: of a coarse step in log-factors; of a scoring step and of a turn in standard errors.
_NEAR, _CLOSE, _SETTLED = 0.05, 1e-2, 0.05
# Redundancy of an error from which its test counts for a median, and what stands for a median of zero.
_SHOWN, _SMALL = 1e-3, 1e-2
# Bounds of a coarse step of a log-factor: medians of few errors are rough.
_DOWN, _UP = -4.0, 8.0
# Eigenvalue of an information matrix of unit diagonal below which a combination of factors is not seen: rounding.
_UNSEEN = 1e-9
# Share of a factor's own direction that the data must see to tell it.
_OWN = 0.9


@dataclass(frozen=True, slots=True)
class VarianceFit:
    """Variance factors of g groups of errors.

    Parameters
    ----------
    variance : array (g,)
        What the stated variances are multiplied by; NaN of groups without errors.
    error : array (g,)
        Standard error of the root of each, as a share of it; NaN where the data do not tell it.
    low, high : array (g,)
        Interval of 95 % of each; NaN where the data do not tell it, `low` zero where they do not tell it from none.
    shared : bool array (g,)
        Groups that the data do not tell: they have one factor in common.
    stay : bool
        Whether that factor is not told either and stays at one.
    gross : bool array (N, q)
        Errors that were left out.
    tests : Tested
        What the residuals say, gross errors left out.
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
class _FoundLevels:
    """Variances (c,) of classes of errors, their standard errors (c,), gross errors, and the tests without them."""

    variance: Array
    error: Array
    gross: Array
    tests: Tested


def fit(made: Elements, left: Array, single: Array) -> VarianceFit:
    """Return the variance factors of greatest restricted likelihood, kept away from zero.

    The likelihood is multiplied by every factor (see `_PENALTY`): a factor of few errors then has no maximum at zero.
    Whether the data tell a factor is asked where all groups have the same: a level that turns out to be small is told.

    Parameters
    ----------
    made : Elements
        N linearised problems, of g groups.
    left : bool array (g,)
        Groups without errors: their factor is zero.
    single : bool array (g,)
        Groups that share no factor with others, whatever the data tell.

    Raises
    ------
    InvalidProblem
        Where no problem has redundancy.

    References
    ----------
    Y. Chung, S. Rabe-Hesketh, V. Dorie, A. Gelman, J. Liu, "A nondegenerate penalized likelihood estimator for variance
    parameters in multilevel models", Psychometrika 78 (2013), section 3.
    """
    made, size = without_groups(made, left), len(made.names)
    used = np.flatnonzero(total(made.of_effect, size))
    count, number = len(used), np.full(size + 1, -1)
    number[used] = np.arange(count)
    group, none = number[made.of_effect], np.zeros(count, dtype=bool)
    if not (tested(made, np.ones(())).dof > 0).any():
        advice = "add rows, stations or known heights"
        raise InvalidProblem("no fix has more rows than unknowns: nothing shows the noise", "noise", advice)
    # One factor for all: where even that is not told, nothing is.
    alike = _maximise(made, np.minimum(group, 0), np.zeros(1), none[:1], np.zeros(1))
    begin = np.full(count, np.log(alike.variance[0]))
    shared = ~(_errors(alike.tests, group, np.exp(begin), none) < LOOSE) & ~single[used]
    # Groups that are not told by themselves become one, in the place of the first of them.
    merge = np.where(shared, np.flatnonzero(shared)[0] if shared.any() else 0, np.arange(count))
    kinds, place = np.unique(merge, return_inverse=True)
    own = np.append(place, -1)[group]
    # Together they may be told, if there are several.
    alone = np.isin(kinds, np.flatnonzero(shared))
    if shared.sum() > 1:
        alone &= ~(_errors(alike.tests, own, np.exp(begin[: len(kinds)]), none[: len(kinds)]) < LOOSE)
    level = np.where(alone, 0.0, begin[: len(kinds)])
    information, _ = _score(alike.tests, own, np.exp(begin[: len(kinds)]), alone)
    penalty = np.minimum(_PENALTY, _SHARE * np.diagonal(information))
    found = _maximise(made, own, level, alone, penalty)
    low, high = (np.where(alone, np.nan, end)[place] for end in _interval(found, own, alone))

    def spread(values: Array) -> Array:
        return np.asarray(np.append(values, np.nan)[number[:-1]])

    return VarianceFit(
        np.where(left, 0.0, spread(found.variance[place])),
        spread(np.where(shared, np.nan, found.error[place])),
        spread(low),
        spread(high),
        np.isin(np.arange(size), used[shared]),
        bool(alone.any()),
        found.gross,
        found.tests,
    )


def without_groups(made: Elements, left: Array) -> Elements:
    """Return the elements without the errors of some groups (g,)."""
    gone = np.append(left, False)[made.of_effect]
    effect = np.where(gone[:, None], 0.0, made.effect)
    return replace(made, effect=effect, of_effect=np.where(gone, -1, made.of_effect))


# Standard deviations of a score from which a group that was left out is worth a factor: one in a hundred of those
# without errors is.
_SEEN = 2.33


def visible(made: Elements, found: VarianceFit, left: Array) -> Array:
    """Return which groups (g,) of those left out of a fit the data show: a score test of their factor being zero.

    With the information I and scores U of all factors at zero, U_g over the root of I_gg - I_gh I_hh^-1 I_hg is
    standard normal where there are no such errors (Verbeke and Molenberghs 2003, section 4).

    Parameters
    ----------
    made : Elements
        N linearised problems.
    found : VarianceFit
        Without these groups.
    left : bool array (g,)
        Which they are.
    """
    size = len(made.names)
    variance = np.append(np.nan_to_num(found.variance), 0.0)
    tests = without(tested(made, variance[made.of_effect]), found.gross)
    scale = np.where(left, 1.0, variance[:-1])
    information, per_fix = _score(tests, made.of_effect, scale, np.zeros(size, dtype=bool))
    rest = np.flatnonzero(~left)
    coupling = information[:, rest]
    own = np.diagonal(information) - ((coupling @ _inverse(information[np.ix_(rest, rest)])) * coupling).sum(1)
    # What the other factors can stand for altogether leaves rounding.
    told = left & (own > (1.0 - _OWN) ** 2 * np.diagonal(information)) & _determinable(tests, made, found, left)
    return np.asarray(told & (per_fix.sum(0) > _SEEN * np.sqrt(np.where(told, own, 1.0))))


# An error in common of three times the rows' sigma must have a level with at most this relative error. Fixes by ranges
# from one side follow it almost entirely, and residuals would give it any size: thirty times the rows' sigma occurred.
_TIMES, _RELATIVE = 3.0, 0.25


def _determinable(tests: Tested, made: Elements, found: VarianceFit, left: Array) -> Array:
    """Return the groups (g,) whose level the data would show if it were a few times the level of the rows."""
    level = _TIMES**2 * float(np.nanmedian(found.variance[~left]))
    share = tests.size[:, : tests.errors] * level
    # The standard error of a log-variance is the root of the inverse information, twice the error of a log-sigma.
    information = 0.5 * total(made.of_effect, len(left), (share / (1.0 + share)) ** 2)
    return np.asarray(information * (2.0 * _RELATIVE) ** 2 > 1.0)


def _maximise(made: Elements, own: Array, level: Array, held: Array, penalty: Array) -> _FoundLevels:
    """Return the factors of classes of errors `own` (N, q), from log-factors (c,) on; some are held there.

    The penalty (c,) is added to their scores.
    """
    count, level = len(level), level.copy()
    # Medians first: they stand half of the errors being gross, the scores of the likelihood do not.
    for _ in range(_COARSE):
        step = np.where(held, 0.0, _coarse(tested(made, np.exp(level)[own]), own, np.exp(level)))
        level += step
        if np.abs(step).max() < _NEAR:
            break
    for _ in range(_ROUNDS):
        before = level.copy()
        # Gross errors are chosen once a turn, not at every step: else steps would jump as errors come and go.
        gross, tests = cleaned(made, np.exp(level)[own])
        for _ in range(_STEPS):
            step, sure = _step(tests, own, np.exp(level), held, penalty)
            last, level = level, np.maximum(level + step, np.log(_LEAST))
            tests = without(tested(made, np.exp(level)[own]), gross)
            if (np.abs(level - last) <= _CLOSE * sure).all():
                break
        if (np.abs(level - before) <= _SETTLED * sure).all():
            break
    variance = np.exp(level)
    return _FoundLevels(variance, _errors(tests, own, variance, held[:count]), gross, tests)


def _coarse(tests: Tested, own: Array, variance: Array) -> Array:
    """Return steps of the log-factors (c,) to where the median of the squared tests is that of normal errors."""
    q = own.shape[1]
    squared, share = tests.sigmas[:, :q] ** 2, tests.size[:, :q] * variance[own]
    step = np.zeros(len(variance))
    for g in range(len(variance)):
        values = squared[(own == g) & (share > _SHOWN)]
        if len(values):
            step[g] = np.log(max(float(np.median(values)) / _MEDIAN, _SMALL))
    return np.clip(step, _DOWN, _UP)


def _step(tests: Tested, own: Array, variance: Array, held: Array, penalty: Array) -> tuple[Array, Array]:
    """Return the scoring step of the log-factors (c,), at most one, along what the data see, and their sigmas."""
    information, per_fix = _score(tests, own, variance, held)
    # The penalty has no curvature in the logarithm; its size damps steps where the data hardly see a factor.
    inverse = _inverse(information + np.diag(penalty))
    # A step of at most e: the quadratic model of the likelihood holds no further.
    return np.clip(inverse @ (per_fix.sum(0) + penalty), -1.0, 1.0), np.sqrt(np.diagonal(inverse))


def _score(tests: Tested, own: Array, variance: Array, held: Array) -> tuple[Array, Array]:
    """Return information (c, c) and scores of each problem (N, c) of log-factors.

    With T and t of `Tested`, d l / d theta_g is the sum of (t_j^2 - T_jj) / 2 over the errors j of group g, and the
    information of theta_g and theta_h that of T_ij^2 / 2 (Harville 1977, section 5).
    """
    (n, q), count = own.shape, len(variance)
    # Errors of no group are counted in a class of their own, behind the others, and dropped.
    number, scale = np.where(own >= 0, own, count), np.where(held, 0.0, variance)
    each = 0.5 * (tests.vector[:, :q] ** 2 - tests.size[:, :q])
    place = (np.arange(n)[:, None] * (count + 1) + number).ravel()
    per_fix = np.bincount(place, each.ravel(), n * (count + 1)).reshape(n, -1)[:, :count] * scale
    pair = (number[:, :, None] * (count + 1) + number[:, None, :]).ravel()
    squared = 0.5 * tests.matrix[:, :q, :q].ravel() ** 2
    information = np.bincount(pair, squared, (count + 1) ** 2).reshape(count + 1, -1)[:count, :count]
    return information * np.outer(scale, scale), per_fix


def _inverse(information: Array) -> Array:
    """Return the inverse along the directions that an information matrix, scaled to a unit diagonal, sees."""
    half, _ = linalg.root(information, _UNSEEN)
    return np.asarray(half @ half.T)


def _spread(tests: Tested, own: Array, variance: Array, held: Array) -> tuple[Array, Array, Array]:
    """Return variances (c,) of log-factors, whether the data tell them, and the step to where the likelihood is flat.

    Variances of normal errors, or what the scatter of the problems' scores says if that is more.
    """
    information, per_fix = _score(tests, own, variance, held)
    inverse = _inverse(information)
    # Sandwich of the problems' scores: what normal errors do not explain, such as tails, widens the error.
    scattered = inverse @ (per_fix.T @ per_fix) @ inverse
    told = np.diagonal(inverse @ information) > _OWN
    return np.maximum(np.diagonal(inverse), np.diagonal(scattered)), told, inverse @ per_fix.sum(0)


def _errors(tests: Tested, own: Array, variance: Array, held: Array) -> Array:
    """Return standard errors (c,) of the roots of factors, as shares of them; infinite where they are not told."""
    spread, told, _ = _spread(tests, own, variance, held)
    # From the error of a log-variance to that of its root.
    return np.where(told, np.sqrt(1.0 + np.sqrt(spread)) - 1.0, np.inf)


def _interval(found: _FoundLevels, own: Array, held: Array) -> tuple[Array, Array]:
    """Return the ends (c,) of the intervals of variance factors.

    What is seen of an error is its sum with the error of what the others predict: of variance theta + tau, tau =
    theta (1 / r - 1) with r its redundancy. The likelihood of that sum is near that of a chi-square variable
    (Satterthwaite 1946, equation 17), also where theta is near zero; its interval less tau is that of theta.
    """
    from scipy.special import gammaincinv

    variance, q = found.variance, own.shape[1]
    share = found.tests.size[:, :q] * variance[own]
    redundancy = total(own, len(variance), share**2) / np.maximum(total(own, len(variance), share), _SMALL)
    redundancy = np.clip(redundancy, _SHOWN, 1.0)
    predicted = variance * (1.0 / redundancy - 1.0)
    spread, told, step = _spread(found.tests, own, variance, held)
    # The penalty is taken out: intervals are those of the likelihood.
    seen = np.maximum(variance * (1.0 + step) + predicted, _SHOWN * predicted)
    half = 1.0 / np.maximum(spread * redundancy**2, _SHOWN)  # half of the degrees of freedom
    ends = [gammaincinv(half, p) / half for p in (0.5 + 0.5 * _LEVEL, 0.5 - 0.5 * _LEVEL)]
    return tuple(np.where(told, np.maximum(seen / end - predicted, 0.0), np.nan) for end in ends)  # type: ignore[return-value]


def total(group: Array, count: int, values: Array | None = None) -> Array:
    """Return the sum of values (N, q) over each group (g,); their number by default."""
    number = np.where(group >= 0, group, count).ravel()
    return np.bincount(number, None if values is None else values.ravel(), count + 1)[:count].astype(float)


# Tests of single errors and offsets.


@dataclass(frozen=True, slots=True)
class Tested:
    """T = F' P F and t = F' P v for the columns F = [B, E], and what is left of the residuals.

    Parameters
    ----------
    matrix : array (N, q + c, q + c)
        T.
    vector : array (N, q + c)
        t.
    errors : int
        q, the number of columns that are errors.
    cost : array (N,)
        v' P v, chi-square distributed with `dof` degrees of freedom.
    dof : array (N,)
        Rank of P.
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
        """Return the tests t / sqrt(T) of all columns (N, q + c); 0 where nothing can be tested."""
        size = self.size
        return np.where(size > 0.0, self.vector / np.sqrt(np.where(size > 0.0, size, 1.0)), 0.0)

    def without(self, column: Array) -> Tested:
        """Return the same with an error of unknown size along one column (N,) of each problem; -1 for none."""
        items = np.flatnonzero(column >= 0)
        j = column[items]
        matrix, vector, cost, dof = self.matrix.copy(), self.vector.copy(), self.cost.copy(), self.dof.copy()
        # An unknown along column j is eliminated: a Schur complement of one row and column.
        along, own = matrix[items, :, j], matrix[items, j, j]
        vector[items] -= along * (self.vector[items, j] / own)[:, None]
        matrix[items] -= along[:, :, None] * along[:, None, :] / own[:, None, None]
        cost[items] -= self.vector[items, j] ** 2 / own
        dof[items] -= 1
        # Columns that this one explains are not tested any more; rounding would make them outliers.
        gone = np.diagonal(matrix[items], axis1=-2, axis2=-1) <= _NOTHING * self.size[items]
        matrix[items] *= ~(gone[:, :, None] | gone[:, None, :])
        vector[items] *= ~gone
        return Tested(matrix, vector, self.errors, cost, dof)


def tested(made: Elements, variance: Array) -> Tested:
    """Return what the residuals say of every error and offset.

    Parameters
    ----------
    made : Elements
        N problems.
    variance : array (N, q) or ()
        Theta, the variance of each error.
    """
    q = made.effect.shape[-1]
    scaled = made.effect * np.sqrt(np.broadcast_to(variance, made.of_effect.shape))[:, None]
    covariance = scaled @ np.swapaxes(scaled, 1, 2) + made.fixed
    # P = W' (I - Q Q') W with W whitening V and Q an orthonormal basis of W J: no inverse of V is formed.
    whiten = linalg.whitening(covariance)
    columns = np.concatenate([made.effect, made.offset, made.residual[..., None]], axis=-1)
    white, known = whiten @ columns, whiten @ made.jacobian
    root, _ = linalg.root(np.swapaxes(known, 1, 2) @ known)
    basis = known @ root
    free = white - basis @ (np.swapaxes(basis, 1, 2) @ white)
    gram = np.swapaxes(free, 1, 2) @ free
    # Rows that whitening keeps less unknowns that the Jacobian sees.
    rank = (whiten != 0.0).any(-1).sum(-1) - (root != 0.0).any(-2).sum(-1)
    matrix = gram[:, :-1, :-1]
    size = np.diagonal(np.swapaxes(white, 1, 2) @ white, axis1=-2, axis2=-1)[:, :-1]
    seen = np.diagonal(matrix, axis1=-2, axis2=-1) > _NOTHING * size
    both = seen[:, :, None] & seen[:, None, :]
    return Tested(np.where(both, matrix, 0.0), np.where(seen, gram[:, :-1, -1], 0.0), q, gram[:, -1, -1], rank)


def without(tests: Tested, gross: Array) -> Tested:
    """Return tests without the errors (N, q) that are gross."""
    items = np.arange(len(gross))
    # As many turns as the problem with most gross errors has.
    order = np.argsort(~gross, axis=1, kind="stable")[:, : int(gross.sum(1).max(initial=0))]
    for column in order.T:
        tests = tests.without(np.where(gross[items, column] & (tests.size[items, column] > 0.0), column, -1))
    return tests


def deviance(made: Elements, found: VarianceFit) -> float:
    """Return twice the negative logarithm of the restricted likelihood; a gross row is a free unknown at a price.

    It is the likelihood of K' v, K an orthonormal basis of the complement of J. The basis does not depend on the
    variances, so that sets of groups can be compared (Harville 1977, section 3).
    """
    variance = np.append(np.nan_to_num(found.variance), 0.0)[made.of_effect]
    scaled = made.effect * np.sqrt(variance)[:, None]
    covariance = scaled @ np.swapaxes(scaled, 1, 2) + made.fixed
    absent = np.diagonal(covariance, axis1=1, axis2=2) == 0.0
    covariance += absent[:, :, None] * np.eye(covariance.shape[1])
    basis, sizes, _ = np.linalg.svd(made.jacobian)
    seen = np.zeros((len(basis), basis.shape[-1]), dtype=bool)
    seen[:, : sizes.shape[1]] = sizes > _NOTHING * sizes[:, :1]
    # Directions of the Jacobian become unit variances without residual.
    free = np.swapaxes(basis, 1, 2) * ~seen[:, :, None]
    inside = free @ covariance @ np.swapaxes(free, 1, 2) + seen[:, :, None] * np.eye(basis.shape[-1])
    doubled = float(np.linalg.slogdet(inside)[1].sum())
    tests = tested(made, variance)
    # Each structure may leave out the rows that it explains worst, at one price: a row is no reason for a structure.
    cut = np.where(made.common[made.of_effect], np.inf, np.sqrt(ROW_PRICE))
    gross = snooped(tests, slice(0, tests.errors), cut).gross
    items = np.arange(len(variance))
    order = np.argsort(~gross, axis=1, kind="stable")[:, : int(gross.sum(1).max(initial=0))]
    for column in order.T:
        out = gross[items, column] & (tests.size[items, column] > 0.0)
        doubled += float(np.log(tests.size[items, column][out]).sum()) + ROW_PRICE * int(out.sum())
        tests = tests.without(np.where(out, column, -1))
    return doubled + float(tests.cost.sum())


# Data snooping.


def cleaned(made: Elements, variance: Array) -> tuple[Array, Tested]:
    """Return which errors are gross (N, q), and the tests without them.

    A row is gross only where its error explains much more than an error in common. Without this rule epochs with a
    large common error would be left out, and its variance would be too small.
    """
    tests = tested(made, variance)
    shared = made.common[made.of_effect] & (np.broadcast_to(variance, made.of_effect.shape) > 0.0)
    cut = np.where(made.common[made.of_effect], _WIDE, CUT)
    found = snooped(tests, slice(0, tests.errors), cut, shared if shared.any() else None)
    return found.gross, found.tests


@dataclass(frozen=True, slots=True)
class Snooped:
    """Columns along which errors are gross, and what the tests say of all without them.

    Parameters
    ----------
    gross : bool array (N, p)
        Columns of the tests beyond the cut.
    shift, sigma : array (N, p)
        Size of an error along each column that the rest shows, and its standard deviation; NaN where nothing does.
    tests : Tested
        Without the gross ones.
    """

    gross: Array
    shift: Array
    sigma: Array
    tests: Tested


def snooped(tests: Tested, columns: slice, cut: float | Array, shared: Array | None = None) -> Snooped:
    """Return the gross errors along some columns of tests, each with its cut or all with one.

    Its squared test must exceed the tests of all `shared` columns (N, p) of its problem by a margin.

    Of each problem the column with the largest test beyond the cut is left out, and the rest are tested anew, until
    none is beyond it: data snooping (Baarda 1968, section 4).
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
        now = error_sizes(tests, columns)
        shift, sigma = (np.where(gross, old, new) for old, new in zip((shift, sigma), now, strict=True))
        if not len(hit):
            return Snooped(gross, shift, sigma, tests)
        gross[hit, worst[hit]] = True
        # One column a problem and turn: two that are beyond the cut may be one error, seen twice.
        column = np.full(n, -1)
        column[hit] = first + worst[hit]
        tests = tests.without(column)


def error_sizes(tests: Tested, columns: slice) -> tuple[Array, Array]:
    """Return the size of an error along each column that the rest shows, and its standard deviation; NaN for none."""
    size, vector = tests.size[:, columns], tests.vector[:, columns]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(size > 0.0, vector / size, np.nan), np.where(size > 0.0, size**-0.5, np.nan)

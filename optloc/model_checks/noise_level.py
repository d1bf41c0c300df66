"""Explanation of many rejected fixes: understated noise, one bad station or kind, late rows (NLOS), or a common offset.

The chi-square test of a single fix cannot separate these causes. The functions here compare the likelihoods of the
causes over all fixes together. Each cause may also exclude single rows, at a penalty per row.

Arrays have N fixes and q errors of each fix, mostly one error per row and station. `Elements` are the linearised fixes,
and `Tested` holds their test statistics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array
from optloc.model_checks.elements import Elements, elements, kinds_of
from optloc.model_checks.groups import ROW_PRICE
from optloc.model_checks.score import descend
from optloc.model_checks.variance_components import Tested, error_sizes, fit, snooped, tested, total, without
from optloc.problem.loss import LATE
from optloc.problem.noise import Noise
from optloc.problem.problem import Problem

SEVERAL = 3
"""Smallest number of fixes for which the level of the noise is estimated: with fewer, one gross error per fix is as
likely."""

ACCUSED = 0.01
"""Chi-square probability below which a fix is rejected. `robust` searches for suspects below the same probability."""

# Factors of sigma that are tried: a grid of 5 %, up to factors that only a wrong unit would explain better.
_FACTORS = np.exp(np.arange(-60, 100) * 0.05)
# Above this share, late rows are not exceptions: their common delay may be an offset.
_MINORITY = 0.5
# Above this share, hardly any row on time is left as a reference for the late rows. Noise of another level explains a
# few fixes with little redundancy equally well.
_NEARLY_ALL = 0.95
# Smallest change of sigma that is reported: a change of 20 % moves no fix by a tenth of its sigma.
_MIN_CHANGE = 1.2
# An eigenvalue of the tests of a group below this share of the largest eigenvalue is rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class CommonLevel:
    """The most likely explanation of the misfit of many fixes, penalties included.

    Parameters
    ----------
    kinds : tuple of str
        Kinds of rows.
    factor, low, high : array (k,)
        Factor of the stated standard deviation of each kind and its interval of 95 %. The factor is 1 if the noise is
        not the suspect, or if only other kinds are.
    suspect : bool
        Whether the noise is the suspect.
    alone : str
        Station or kind whose errors are larger than stated, if this explains more than one factor for all rows.
    size : float
        Factor of the errors of `alone`; NaN if `alone` is empty.
    gain : float
        Twice the gain of the log-likelihood over the noise as stated.
    fixes : int
        Number of fixes with redundancy.
    accused, left : int
        Number of fixes that a chi-square test at 1 % rejects, with the noise as stated and with the factors.
    """

    kinds: tuple[str, ...]
    factor: Array
    low: Array
    high: Array
    suspect: bool
    alone: str
    size: float
    gain: float
    fixes: int
    accused: int
    left: int

    @property
    def sentence(self) -> str:
        """Return the explanation as one sentence without its full stop; empty if no cause was found."""
        accused = f"{self.accused} of {self.fixes} fixes do not fit"
        if self.suspect:
            several = len(self.kinds) > 1
            parts = [
                f"{f:.2g} times the stated noise ({a:.2g} to {b:.2g}){f' in {kind} rows' if several else ''}"
                for kind, f, a, b in zip(self.kinds, self.factor, self.low, self.high, strict=True)
                if f != 1.0
            ]
            return f"the noise level is the suspect: {accused}, but only {self.left} with {' and '.join(parts)}"
        if self.alone:
            what = f"errors of {self.alone} are {self.size:.2g} times as large as stated"
            return f"{accused}, and the suspect is {self.alone}: {what}, or biased"
        return ""

    @property
    def refutes(self) -> bool:
        """Return whether the stated noise is too small: the claims about these fixes are then not valid."""
        return self.suspect and bool((self.factor > 1.0).any())

    def sizes(self, problem: Problem) -> Array:
        """Return the factor (m,) of the standard deviation of each row of a problem; 1 for a kind without a factor."""
        factor = dict(zip(self.kinds, self.factor.tolist(), strict=True))
        return np.array([factor.get(kind, 1.0) for kind in kinds_of(problem).tolist()])

    def scale(self, problem: Problem) -> Problem:
        """Return a problem with its noise multiplied by the factors.

        Parameters
        ----------
        problem : Problem
            With any epochs. Rows of a kind without a factor keep their noise.
        """
        size = self.sizes(problem)
        blocks = [
            replace(b, covariance=b.covariance * size[b.row][:, :, None] * size[b.row][:, None, :])
            for b in problem.noise.blocks
        ]
        return replace(problem, noise=Noise(tuple(blocks)))


def common_level_at(problem: Problem, x: Array) -> CommonLevel:
    """Return the most likely explanation of the misfit: the noise as stated, one factor of it, or one station or kind.

    With each explanation, a fix may exclude measurements at a penalty each (see `ROW_PRICE`), because a few gross
    errors are not a higher noise level. Let c_k be the cost of a fix without k measurements, r_k its redundancy, and f
    the factor of sigma. Twice the negative logarithm of the restricted likelihood is then ``c_k / f^2 + r_k ln f^2``
    plus the penalty of k measurements. The measurements with the largest tests are excluded one after another, to first
    order at the fix. A factor of one station or kind changes the cost and the determinant of V (see `_single_groups`).
    The result is the explanation with the lowest sum over all fixes, including the penalty of its factor.
    `variance_components.fit` computes the factors.

    Parameters
    ----------
    problem : Problem
        A flat batch of N problems, from `elements.batch_of`.
    x : array (N, size)
        Fixes of the problems, robust or not; NaN for a problem without a fix.
    """
    kept = np.flatnonzero(np.isfinite(x).all(-1))
    kinds = tuple(dict.fromkeys(rows.kind for rows in problem.rows))
    same = np.ones(len(kinds))
    unchanged = CommonLevel(kinds, same, same, same, False, "", np.nan, 0.0, 0, 0, 0)
    if not len(kept):
        return unchanged
    batch, x = problem.take(kept), x[kept]
    by_station, by_kind = elements(batch, x, "station"), elements(batch, x, "kind")
    tests = tested(by_station, np.ones(()))
    cost, dof = _exclusion_path(tests)
    count, accused = int((tests.dof > 0).sum()), _count_rejected(tests)
    unchanged = replace(unchanged, fixes=count, accused=accused, left=accused)
    if not count or not accused:
        return unchanged
    stated = _lowest_deviance(cost, dof, 1.0)
    common = np.array([_lowest_deviance(cost, dof, f).sum() for f in _FACTORS])
    # Instead of the factor of one group, every fix may also exclude measurements. With a single kind, the factor of the
    # kind is the common factor.
    single = [*_single_groups(by_station, tests, cost)]
    single += [*_single_groups(by_kind, tested(by_kind, np.ones(())), cost)] if len(kinds) > 1 else []
    name, size, least = min(single, key=lambda one: one[2], default=("", np.nan, np.inf))
    gain = float(stated.sum() - min(common.min(), least))
    if gain <= ROW_PRICE:
        return unchanged
    if least < common.min() and name not in kinds:
        return replace(unchanged, alone=name, size=size, gain=gain)
    # A minority of late rows widens the residuals like a larger noise. The late rows are then reported for each fix.
    if 0.0 < _late_rows(by_kind, _late_kinds(batch)).share < _MINORITY:
        return replace(unchanged, gain=gain)
    return _with_factors(replace(unchanged, gain=gain), by_kind)


def _with_factors(unchanged: CommonLevel, packed: Elements) -> CommonLevel:
    """Return the explanation with the factors of all kinds; a factor that is not significant is 1.

    `unchanged` is the explanation without factors, and it is returned if no factor is significant. The groups of
    `packed`, the N linearised fixes, are kinds.
    """
    none = np.zeros(len(packed.names), dtype=bool)
    found = fit(packed, none, none)
    # a kind without a group gets NaN, which is not significant
    place = [packed.names.index(kind) if kind in packed.names else -1 for kind in unchanged.kinds]
    factor, low, high = (np.append(np.sqrt(v), np.nan)[place] for v in (found.variance, found.low, found.high))
    with np.errstate(invalid="ignore"):
        significant = ((low > 1.0) | (high < 1.0)) & (np.abs(np.log(factor)) > np.log(_MIN_CHANGE))
    if not significant.any():
        return unchanged
    factor, low, high = (np.where(significant, v, 1.0) for v in (factor, low, high))
    # the factor of each group; the last entry, 1, is for errors without a group
    factor_of_group = np.append(factor, 1.0)[
        [unchanged.kinds.index(n) if n in unchanged.kinds else -1 for n in (*packed.names, "")]
    ]
    after = tested(packed, factor_of_group[packed.of_effect] ** 2)
    return replace(unchanged, factor=factor, low=low, high=high, suspect=True, left=_count_rejected(after))


def _count_rejected(tests: Tested) -> int:
    """Return the number of fixes that the chi-square test rejects."""
    from scipy.special import gammaincc

    return int(((tests.dof > 0) & (gammaincc(np.maximum(tests.dof, 1) / 2, tests.cost / 2) < ACCUSED)).sum())


def _exclusion_path(tests: Tested) -> tuple[Array, Array]:
    """Return the cost and the redundancy (N, 1 + k) of each fix without its 0, 1, ... k errors with the largest tests.

    Only errors whose squared test exceeds the penalty are excluded. A fix with fewer of these errors gets an infinite
    cost in the remaining columns.
    """
    costs, dofs = [tests.cost], [tests.dof]
    while True:
        sigmas = np.abs(tests.sigmas[:, : tests.errors])
        worst = sigmas.argmax(1)
        hit = (sigmas[np.arange(len(worst)), worst] > np.sqrt(ROW_PRICE)) & (tests.dof > 0)
        if not hit.any():
            return np.stack(costs, axis=1), np.stack(dofs, axis=1)
        tests = tests.without(np.where(hit, worst, -1))
        costs.append(np.where(hit, tests.cost, np.inf))
        dofs.append(tests.dof)


def priced_cost(tests: Tested) -> Array:
    """Return the lowest cost (N,) of each fix with any of its errors excluded, penalties included."""
    return _lowest_deviance(*_exclusion_path(tests), 1.0)


def _lowest_deviance(cost: Array, dof: Array, factor: float) -> Array:
    """Return the minimum (N,) of twice the negative log-likelihood of each fix, over the number of excluded errors.

    `cost` and `dof` (N, 1 + k) come from `_exclusion_path`: column j is the fix without j errors. Sigma is multiplied
    by `factor`; the penalties are included.
    """
    left = np.arange(cost.shape[1])
    return np.asarray((cost / factor**2 + dof * np.log(factor**2) + ROW_PRICE * left).min(1))


def _single_groups(packed: Elements, tests: Tested, cost: Array) -> Iterator[tuple[str, float, float]]:
    """Yield for each group its name, the most likely factor of sigma of its errors alone, and the likelihood with it.

    The likelihood is given as twice its negative logarithm. `packed` are the linearised fixes, and `tests` the tests
    with the noise as stated. `cost` (N, 1 + k) comes from `_exclusion_path`. Instead of the factor, a fix may also
    exclude measurements.

    A factor f adds (f^2 - 1) B B' to V, with the columns B of the group. Let l be the eigenvalues of T of `Tested` for
    these columns, and y the components of t along its eigenvectors. The cost decreases by the sum of
    (f^2 - 1) y^2 / (1 + (f^2 - 1) l), and the determinant of V is multiplied by 1 + (f^2 - 1) l for each l
    (A. J. Woodbury 1950).
    """
    # the lowest cost with excluded measurements; infinite if no measurement has a large test
    penalty = ROW_PRICE * np.arange(1, cost.shape[1])
    instead = (cost[:, 1:] + penalty).min(1, initial=np.inf)
    for g in np.flatnonzero(total(packed.of_effect, len(packed.names))):
        inside = packed.of_effect == g
        # The columns of the group come first; a fix with fewer columns is padded with zeros.
        order = np.argsort(~inside, axis=1, kind="stable")[:, : int(inside.sum(1).max())]
        here = np.take_along_axis(inside, order, 1)
        matrix = np.take_along_axis(np.take_along_axis(tests.matrix, order[:, :, None], 1), order[:, None], 2)
        values, vectors = np.linalg.eigh(np.where(here[:, :, None] & here[:, None, :], matrix, 0.0))
        seen = values > _ROUNDING * values[:, -1:]
        vector = np.where(here, np.take_along_axis(tests.vector, order, 1), 0.0)
        squared = np.where(seen, (np.swapaxes(vectors, 1, 2) @ vector[..., None])[..., 0] ** 2, 0.0)
        values = np.where(seen, values, 0.0)
        # only factors above 1 are tried: f^2 - 1 for each
        increase = _FACTORS[_FACTORS > 1.0, None, None] ** 2 - 1.0
        grown = 1.0 + increase * values
        determinant = np.log(grown).sum(-1)
        each = tests.cost - (increase * squared / grown).sum(-1)
        sums = (determinant + np.minimum(each, instead)).sum(-1)
        best = int(sums.argmin())
        yield packed.names[g], float(np.sqrt(1.0 + increase[best, 0, 0])), float(sums[best])


# Late rows (NLOS): their share, their mean delay, and the fixes that depend on them.


@dataclass(frozen=True, slots=True)
class LateSignals:
    """Share and delay of late ranges and arrival times, estimated from the residuals of many fixes.

    Parameters
    ----------
    share, delay : float
        Probability that a row is late, and the mean delay of late rows in sigmas of the rows; zero if none was found.
    gain : float
        Twice the gain of the log-likelihood over the model without late rows.
    count : int
        Number of rows that the other rows of their fix can check.
    late : int array (N,)
        Number of rows of each fix that are probably late.
    carried : bool array (N,)
        True for a fix that depends on late rows: without them it has no redundancy.
    alike : str
        Kind whose rows are all late by the same amount; these rows do not count as late. Empty if no kind
        has this error.
    offset, offset_error : float
        The common delay and its standard deviation, SI units.
    left : float
        Chi-square of all fixes without the late rows, plus the penalty of these rows.
    """

    share: float
    delay: float
    gain: float
    count: int
    late: Array
    carried: Array
    alike: str = ""
    offset: float = 0.0
    offset_error: float = 0.0
    left: float = 0.0

    @property
    def method(self) -> str:
        """Return the name of the method for `solve` that fits these late rows; "late" if no row is late."""
        return f"late({self.share:.3g},{self.delay:.3g})" if self.share else "late"

    @property
    def sentence(self) -> str:
        """Return the result as one sentence without its full stop; empty if no row is late."""
        if self.alike:
            size = f"{self.offset:.4g} ± {self.offset_error:.2g} m"
            return f"all {self.alike} rows are late by the same {size}: model a bias, an offset per kind"
        if not self.share:
            return ""
        text = f"{100.0 * self.share:.2g} % of {self.count} rows are late, by {self.delay:.2g} sigma on average"
        stand = int(self.carried.sum())
        return text + (f"; {stand} of {len(self.late)} fixes depend on late rows" if stand else "")


def late_signals_at(problem: Problem, kept: Array, x: Array) -> LateSignals:
    """Return the late rows of given fixes.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems, from `batch_of`.
    kept : int array (n,)
        Numbers of the problems that have a fix.
    x : array (n, size)
        Parameter vectors of these fixes.
    """
    late, carried = np.zeros(problem.batch_shape[0], dtype=int), np.zeros(problem.batch_shape[0], dtype=bool)
    able = _late_kinds(problem)
    if not able:
        return LateSignals(0.0, 0.0, 0.0, 0, late, carried)
    part = problem.take(kept)
    found = _late_rows(elements(part, x, "kind"), able)
    if found.share:
        # a common offset of all rows of one kind may explain the misfit better than single late rows
        kind, offset, error, left = min((_common_delay(part, x, one) for one in able), key=lambda one: one[3])
        if offset > 0.0 and left < found.left:
            found = replace(found, share=0.0, delay=0.0, alike=kind, offset=offset, offset_error=error)
            return replace(found, late=late, carried=carried)
        if found.share > _NEARLY_ALL:  # no rows on time are left as a reference
            return replace(found, share=0.0, delay=0.0, late=late, carried=carried)
    late[kept], carried[kept] = found.late, found.carried
    return replace(found, late=late, carried=carried)


# Largest number of selections of late rows; largest number of iterations of expectation and maximisation (EM); and the
# relative change of share and delay that ends EM.
_CHOICES, _TURNS, _ENDED = 10, 500, 1e-6
# Mean delay in sigmas below which no delay is reported: its effect on a fix is negligible.
_MIN_DELAY = 0.1
# Test, in standard deviations, above which a row is late in the first selection.
_FIRST_CUT = 3.0
# Late rows must explain at least this share of the misfit that gross errors of both signs explain. The share is 0.8 to
# 1 if a tenth or more of the rows are late by 5 sigma on average. It is 0.6 at most if the noise is three or five times
# the stated noise (50 fixes).
_ONE_SIDED = 0.7


def _late_kinds(problem: Problem) -> list[str]:
    """Return the kinds of a problem whose rows can be late."""
    return [rows.kind for rows in problem.rows if rows.kind in LATE]


def _late_rows(packed: Elements, able: list[str]) -> LateSignals:
    """Return the late rows of linearised fixes with the noise as stated; `able` are the kinds that can be late."""
    tests = tested(packed, np.ones(()))
    # errors without a group have the number -1, which selects the empty name
    fit_for = np.isin(np.array([*packed.names, ""], dtype=object)[packed.of_effect], able)
    share, delay, gain, late, seen = _select_late(tests, fit_for)
    none = np.zeros(len(late), dtype=int)
    # Compare the misfit that late rows explain with the misfit that excluded rows of both signs explain, penalties
    # included. The ratio is about one half if the errors have symmetric tails, and less if the noise is understated.
    left = float((without(tests, late).cost + ROW_PRICE * late.sum(1)).sum())
    explained = float(tests.cost.sum()) - left
    if min(gain, explained) <= ROW_PRICE or explained < _ONE_SIDED * float((tests.cost - priced_cost(tests)).sum()):
        return LateSignals(0.0, 0.0, max(gain, 0.0), seen, none, none > 0)
    count = late.sum(1)
    return LateSignals(share, delay, gain, seen, count, (count > 0) & (tests.dof - count <= 0), left=left)


# Largest number of Gauss-Newton steps of an offset, with new fixes in each step; a step below this share of the sigma
# of the offset ends them.
_STEPS, _CONVERGED = 8, 0.1


def _common_delay(problem: Problem, x: Array, kind: str) -> tuple[str, float, float, float]:
    """Return a kind, the common offset of all its rows, the standard deviation of the offset, and the remaining cost.

    Gauss-Newton estimates the offset over all fixes together and refines each fix after each step, because a large
    delay moves the fixes far. Offset and standard deviation are in SI units; the cost includes the penalty of the
    offset. If another unknown absorbs the offset, the offset is 0, and its standard deviation and cost are infinite.
    `problem` is a flat batch of n problems, and `x` (n, size) are their fixes.
    """
    of_kind = np.concatenate([np.full(rows.count, rows.kind == kind) for rows in problem.rows])
    offset, error = 0.0, np.inf
    tests = None
    for _ in range(_STEPS):
        moved = problem.with_rows(z=problem.z - offset * of_kind)
        x, _ = descend(moved, x)
        packed = elements(moved, x, "kind")
        tests = tested(packed, np.ones(()))
        here = packed.of_offset == packed.names.index(kind)
        size = float(tests.size[:, tests.errors :][here].sum())
        if size <= 0.0:  # the emission time absorbs a common delay
            return kind, 0.0, np.inf, np.inf
        step, error = float(tests.vector[:, tests.errors :][here].sum()) / size, size**-0.5
        if abs(step) <= _CONVERGED * error:
            break
        offset += step
    return kind, offset, error, np.inf if tests is None else float(priced_cost(tests).sum()) + ROW_PRICE


def _select_late(tests: Tested, able: Array) -> tuple[float, float, float, Array, int]:
    """Return share, mean delay in sigmas, gain, late rows (N, q) and the number of rows that other rows check.

    The share and the delay are estimated from rows of unknown state; then each row gets the more probable state. Both
    steps repeat until no state changes. `able` (N, q) marks errors of kinds whose rows can be late. The gain is twice
    the gain of the log-likelihood over the model without late rows.
    """
    found = snooped(tests, slice(0, tests.errors), _FIRST_CUT)
    late = found.gross & able & (found.shift > 0.0)
    share = delay = gain = 0.0
    seen = able & np.isfinite(found.shift)
    for _ in range(_CHOICES):
        shift, sigma = _leave_one_out(tests, late)
        seen = able & np.isfinite(shift)
        share, delay, gain, chance = _fit_mixture(shift[seen], sigma[seen], late[seen])
        now = np.zeros(late.shape, dtype=bool)
        now[seen] = chance > 0.5
        # Rows that no other row checks after the exclusions keep their state.
        now |= late & ~seen
        if (now == late).all():
            break
        late = now
    return share, delay, gain, late, int(seen.sum())


def _leave_one_out(tests: Tested, late: Array) -> tuple[Array, Array]:
    """Return the estimated error (N, q) of each row and its standard deviation, from the other rows that are not late.

    `late` (N, q) marks late rows. Both results are in sigmas of the row; NaN if the other rows do not determine the
    error. For a late row, all other late rows are excluded as well.
    """
    items, q = np.arange(len(late)), tests.errors
    shift, sigma = error_sizes(without(tests, late), slice(0, q))
    # one iteration for the first late row of each fix, one for the second, and so on
    order = np.argsort(~late, axis=1, kind="stable")[:, : int(late.sum(1).max(initial=0))]
    for column in order.T:
        own = late[items, column]
        others = late.copy()
        others[items, column] = False
        # for a late row, exclude all other late rows but keep this row
        one, error = error_sizes(without(tests, others), slice(0, q))
        shift[items[own], column[own]] = one[items[own], column[own]]
        sigma[items[own], column[own]] = error[items[own], column[own]]
    return shift, sigma


def _fit_mixture(error: Array, sigma: Array, late: Array) -> tuple[float, float, float, Array]:
    """Return share and mean delay of late rows, the gain, and the probability (r,) of each row to be late, by EM.

    `error` and `sigma` (r,) are from `_leave_one_out`, and `late` (r,) is the first selection. The errors are normal. A
    late row has an additional exponentially distributed delay. If the mean delay is negligible, all results are zero.
    The gain is as in `_select_late`.
    """
    from scipy.special import erfcx, log_ndtr

    # EM cannot leave a share of zero or one, so the first share is between them
    share = float(np.clip(late.mean(), 0.5 / max(len(late), 1), 0.9)) if len(late) else 0.0
    delay = float(np.mean(error[late])) if late.any() else 0.0
    if not share or delay <= 0.0:
        return 0.0, 0.0, 0.0, np.zeros(len(error))
    log_on_time = -0.5 * (error / sigma) ** 2 - np.log(sigma) - 0.5 * np.log(2.0 * np.pi)
    for _ in range(_TURNS):
        # Given the error, the delay is normal about error - sigma^2 / delay, truncated at zero.
        middle = error - sigma**2 / delay
        tail = log_ndtr(middle / sigma)
        log_late = np.log(share / delay) + 0.5 * (sigma / delay) ** 2 - error / delay + tail
        log_either = np.logaddexp(np.log1p(-share) + log_on_time, log_late)
        p_late = np.exp(log_late - log_either)
        # mean of the truncated normal distribution; erfcx computes the ratio of density and distribution without
        # cancellation
        mean = middle + sigma * np.sqrt(2.0 / np.pi) / erfcx(-middle / (np.sqrt(2.0) * sigma))
        new = float(np.clip(p_late.mean(), 1e-12, 1.0 - 1e-6))
        longer = float((p_late * mean).sum() / max(p_late.sum(), 1e-300))
        done = abs(new - share) <= _ENDED * share and abs(longer - delay) <= _ENDED * delay
        if longer < _MIN_DELAY:
            return 0.0, 0.0, 0.0, np.zeros(len(error))
        share, delay = new, longer
        if done:
            break
    return share, delay, float(2.0 * (log_either - log_on_time).sum()), p_late

"""Estimation of noise levels of stations, pairs or kinds from the residuals of many fixes.

The residuals of N fixes are sums of errors. Each error belongs to one of G groups, and each group has one level.
`Elements` are the linearised fixes with these errors. q is the number of errors of a fix, m of its rows, and c of its
offsets.

Arguments of functions: `linearised` are the `Elements`. `by` is the grouping of errors: "station", "pair" or "kind".
`shared_by` is the grouping of common errors, or None. `names` are the G groups. `fit_result` has the estimated variance
factors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.model_checks.elements import (
    By,
    Elements,
    batch_of,
    common_effects,
    common_name,
    elements,
    ends_of,
    split,
)
from optloc.model_checks.noise_level import CommonLevel, LateSignals, common_level_at, late_signals_at
from optloc.model_checks.overbound import tail_factors
from optloc.model_checks.variance_components import Tested, VarianceFit, fit, tested, total, visible, without
from optloc.problem.arrival_times import as_arrivals
from optloc.problem.epochs import has_correlated_epochs
from optloc.problem.fix import Fix
from optloc.problem.noise import Block, Noise, gathered, group, group_members
from optloc.problem.problem import Problem

# Maximum number of groups that a sentence lists. The others are counted.
_NAMED = 8


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """Noise levels of groups of errors, estimated from the residuals of fixes.

    Parameters
    ----------
    by : "station", "pair" or "kind"
        Grouping of the errors.
    names : tuple of G str
        Names of the groups. If common errors were requested, they follow: the error that all rows of a group share in
        an epoch.
    stated : array (G,)
        Standard deviation that the problem states, root mean square, SI units. For common errors, which the problem
        does not state, it is the value of the rows.
    factor : array (G,)
        Factors of the stated standard deviations. 1 if the data do not determine a factor; 0 for a common error without
        evidence.
    error : array (G,)
        Standard error of the factor; NaN if the data do not determine the factor of this group separately.
    low, high : array (G,)
        95 % interval of the factor. `low` is zero if the data are compatible with no noise; both are NaN if the data do
        not determine the factor. The factor itself is never zero: it maximises the likelihood times a weight (see
        `noise_levels`).
    redundancy : array (G,)
        Share of the errors of each group that is visible in the residuals, from 0 to 1.
    count : int array (G,)
        Number of errors of each group.
    gross : int array (G,)
        Number of errors that were left out as gross.
    before, after : float
        Chi-square per degree of freedom with the stated and with the estimated noise, without gross errors.
    fixes : int
        Number of fixes with redundancy.
    sentences : tuple of str
        Statements about levels that the data do not determine.
    tails : array (G,)
        Additional factors, at least 1, with which a Gaussian bounds the tails of the errors.
    common : "station", "pair" or "kind", optional
        Grouping of the errors that rows share in an epoch; None without such errors.
    """

    by: By
    names: tuple[str, ...]
    stated: Array
    factor: Array
    error: Array
    low: Array
    high: Array
    redundancy: Array
    count: Array
    gross: Array
    before: float
    after: float
    fixes: int
    sentences: tuple[str, ...]
    tails: Array
    common: By | None = None

    @property
    def used(self) -> Array:
        """Return the final factors (G,) of the stated standard deviations, including the factors for tails."""
        return np.asarray(self.factor * self.tails)

    @property
    def sigma(self) -> Array:
        """Return the estimated standard deviations (G,), SI units; NaN if the data do not determine them."""
        return np.where(np.isnan(self.error), np.nan, self.used * self.stated)

    @property
    def sigma_error(self) -> Array:
        """Return the standard errors (G,) of `sigma`, SI units."""
        return np.asarray(self.error * self.tails * self.stated)


def noise_levels(
    problem: Problem,
    by: By = "station",
    *,
    common: By | bool | None = None,
    method: str = "auto",
    fix: Fix | None = None,
) -> NoiseLevels:
    """Return the noise levels of groups of rows, estimated from the residuals of many fixes.

    The method is restricted maximum likelihood of variance components. The covariance of the rows is a sum of parts of
    the stated covariance, each multiplied by an unknown factor. The factors maximise the likelihood of the part of the
    residuals that does not depend on the fixes, multiplied by each factor of a variance. This weight counts no more
    than two errors of a group. Without it, a level from few errors is often zero. Scoring steps on the logarithms are
    repeated until they vanish; each is Rao's minimum norm quadratic estimate at the previous factors. Errors that are
    gross compared with the rest of their fix are left out one by one, and the levels describe the other errors.

    Parameters
    ----------
    problem : Problem
        Problem whose fixes are its epochs if they share no unknown, or its batch; otherwise it is one fix of many rows.
        The size of its stated noise may be wrong. Ratios of the noise within a group are kept.
    by : "station", "pair" or "kind"
        Groups of errors with one level each: the errors of a station (of its arrivals, if rows combine arrivals), of a
        pair of stations, or of a kind.
    common : "station", "pair" or "kind", optional
        Grouping of rows that share an additional error in every epoch. Examples are errors of an attitude, of a
        position taken as known, or of refraction. True: the same as `by`. The data determine it if a group has several
        rows in an epoch.
    method : str
        Method of the fixes; see `solve`.
    fix : Fix, optional
        Existing fixes of `batch_of(problem)`.

    Returns
    -------
    NoiseLevels
        Groups that the data do not separate share one factor or keep the stated noise; `sentences` lists them.

    Raises
    ------
    InvalidProblem
        If no fix has redundancy.

    References
    ----------
    H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal" (1971).
    C. R. Rao, "Estimation of variance and covariance components - MINQUE theory" (1971), section 4.
    D. A. Harville, "Maximum likelihood approaches to variance component estimation" (1977), section 5.
    K. R. Koch, "Maximum likelihood estimate of variance components" (1986), equation 4.
    Y. Chung et al., "A nondegenerate penalized likelihood estimator for variance parameters" (2013), section 3.
    """
    from optloc.solvers.solution import solve

    batch = batch_of(problem)
    if fix is None and batch.layout.size:
        fix = solve(batch, method)
    fixed, x = usable(batch, fix)
    shared_by = shared_grouping(by, common)
    return levels_of(elements(batch.take(fixed), x, by, shared_by), by, shared_by)


def shared_grouping(by: By, common: By | bool | None) -> By | None:
    """Return the grouping of common errors: `by` if `common` is True, None without common errors.

    A common error is an error that all rows of a group share in an epoch.
    """
    return by if common is True else common or None


def with_noise_levels(problem: Problem, levels: NoiseLevels) -> Problem:
    """Return the problem with its noise scaled by the factors of the levels.

    Parameters
    ----------
    problem : Problem
        The problem from which the levels were estimated, or another problem with the same stations and kinds.
    levels : NoiseLevels
        Result of `noise_levels`. Groups that it does not contain keep their noise.

    Raises
    ------
    InvalidProblem
        If there are common errors of epochs, and the noise is also correlated between epochs.
    """
    factor = dict(zip(levels.names, levels.used.tolist(), strict=True))
    present = problem.weight > 0.0
    noise = Noise(tuple(_scale_block(problem, block, levels.by, factor, present) for block in problem.noise.blocks))
    if levels.common is None:
        return replace(problem, noise=noise)
    sigma = dict(zip(levels.names, (levels.used * levels.stated).tolist(), strict=True))
    names = {*ends_of(problem, levels.common).name.ravel().tolist()} - {""}
    common = {name: sigma[common_name(name)] for name in sorted(names) if sigma.get(common_name(name), 0.0) > 0.0}
    return replace(problem, noise=_with_common(problem, noise, levels.common, common) if common else noise)


def _scale_block(problem: Problem, block: Block, by: By, factor: dict[str, float], present: Array) -> Block:
    """Return a noise block in which each error is multiplied by the factor of its group; absent rows keep their noise.

    `factor` maps names of groups to factors; other groups have the factor 1. `present` (..., m) marks the rows that are
    present.
    """
    # The noise of the block is effect effect': each column is one error, with its group in `names`.
    effect, names, _ = split(problem, block, by, present)
    factors = np.array([[factor.get(name, 1.0) for name in row] for row in names.tolist()])
    scaled = effect * factors[:, None, :]
    is_present = present[..., block.row]
    # Absent rows keep the stated noise, because the levels were not estimated from them.
    both_present = is_present[..., :, None] & is_present[..., None, :]
    return Block(block.row, np.where(both_present, scaled @ np.swapaxes(scaled, -1, -2), block.covariance))


def _with_common(problem: Problem, noise: Noise, by: By, sigma: dict[str, float]) -> Noise:
    """Return the noise plus an error that the rows of a group share in an epoch.

    `sigma` maps the names of groups to the standard deviations of this error, SI units.
    """
    if has_correlated_epochs(problem):
        what = "errors of rows of several epochs are correlated"
        raise InvalidProblem(what, "noise", "leave out the errors in common of an epoch")
    effect, _, _ = common_effects(problem, by, sigma)
    blocks = []
    for members in group_members(problem.epoch):
        effect_of_epoch = effect[members]
        blocks.append(Block(members, gathered(noise, members) + effect_of_epoch @ np.swapaxes(effect_of_epoch, -1, -2)))
    return group(blocks)


def common_level(problem: Problem, *, method: str = "cauchy", fix: Fix | None = None) -> CommonLevel:
    """Return whether many fixes together indicate gross errors, one bad station or a wrong noise level.

    Parameters
    ----------
    problem : Problem
        As for `noise_levels`.
    method : str
        Method of the fixes; see `solve`. A method that few gross errors do not affect is best.
    fix : Fix, optional
        Existing fixes of `batch_of(problem)`.

    Returns
    -------
    CommonLevel
        ``scale(problem)`` returns the problem with the estimated noise. If the data fit the stated noise, it stays.

    Raises
    ------
    InvalidProblem
        If no epoch has a fix.
    """
    from optloc.solvers.solution import solve

    batch = batch_of(problem)
    if fix is None and batch.layout.size:
        fix = solve(batch, method)
    fixed, x = usable(batch, fix)
    return common_level_at(batch.take(fixed), x)


def usable(batch: Problem, fix: Fix | None) -> tuple[Array, Array]:
    """Return the numbers (n,) of the problems of a flat batch that have a fix, and their parameter vectors (n, size).

    Raises
    ------
    InvalidProblem
        If there is no fix.
    """
    if fix is None:
        size = batch.batch_shape[0]
        return np.arange(size), np.zeros((size, 0))
    flat = fix.flat()
    fixed = np.flatnonzero(np.isfinite(flat.x).all(-1) & flat.answered)
    if not len(fixed):
        raise InvalidProblem("no epoch has a fix", "noise", "see `optloc fix` for the reasons")
    return fixed, flat.x[fixed]


def levels_of(linearised: Elements, by: By, common: By | None = None, *, tails: bool = True) -> NoiseLevels:
    """Return the noise levels of linearised fixes.

    `by` is the grouping of errors, and `common` the grouping of shared errors of an epoch, if any. `tails` adds factors
    that bound the tails; see `noise_levels`.
    """
    return replace(_report(linearised, by, *fitted(linearised, common), tails=tails), common=common)


def fitted(linearised: Elements, shared_by: By | None) -> tuple[VarianceFit, Array]:
    """Return the fit of the variance factors, and a mask (G,) of the common errors without evidence.

    Common errors without evidence are zero. The fit is repeated without common errors whose interval includes zero; see
    `_all_or_none`.
    """
    from threadpoolctl import threadpool_limits

    common = linearised.common[:-1]
    # Threads do not speed up products of small matrices. On a busy machine, waiting for them takes ten times as long.
    with threadpool_limits(1):
        # Second argument of `fit`: groups whose factor is zero. Third: groups that keep a separate factor.
        without_common = fit(linearised, common, common)
        # The problem states no noise for common errors, so without evidence they are zero.
        evident = _all_or_none(visible(linearised, without_common, common), common, shared_by)
        result = fit(linearised, common & ~evident, common) if evident.any() else without_common
        while (still_evident := _all_or_none(evident & (result.low > 0.0), common, shared_by)).sum() < evident.sum():
            evident = still_evident
            result = fit(linearised, common & ~evident, common) if evident.any() else without_common
    return result, common & ~evident


def _all_or_none(shown: Array, common: Array, by: By | None) -> Array:
    """Return a mask (G,) of the common errors to keep.

    `shown` (G,) marks the common errors with evidence, and `common` (G,) all common errors. If `by` is "kind", the
    errors with evidence are kept. If `by` is "station" or "pair", all are kept as soon as one has evidence. The reason:
    a fix with p unknowns can follow p common errors, which then leave no evidence. If only the others had a level, the
    common errors that the fix follows would count as exact, and the fix too.
    """
    return shown if by == "kind" else common & shown.any()


def _report(linearised: Elements, by: By, fit_result: VarianceFit, no_evidence: Array, *, tails: bool) -> NoiseLevels:
    """Return the levels of all groups that have errors.

    `linearised` are the fixes, and `by` is the grouping of their errors. `fit_result` and `no_evidence` are the results
    of `fitted`: variance factors, and a mask (G,) of common errors without evidence. `tails` is whether to add factors
    for long tails; without them these factors are 1.
    """
    size = len(linearised.names)
    count, gross = total(linearised.of_effect, size), total(linearised.of_effect, size, fit_result.gross)
    with_errors = np.flatnonzero(count)
    # T_jj times the variance is the share of an error that the residuals show.
    share = (
        fit_result.tests.size[:, : fit_result.gross.shape[1]] * np.nan_to_num(fit_result.variance)[linearised.of_effect]
    )
    redundancy, factor = total(linearised.of_effect, size, share), np.sqrt(fit_result.variance)
    # Errors that are gross for the fitted noise are left out of both ratios, so that the ratios are comparable.
    is_zero = np.append(no_evidence, False)[linearised.of_effect]
    stated = without(tested(linearised, np.where(is_zero, 0.0, 1.0)), fit_result.gross)
    # The fit gives factors of variances. Levels are factors of standard deviations, hence the square roots.
    low, high = (np.where(no_evidence, np.nan, np.sqrt(end)) for end in (fit_result.low, fit_result.high))
    names = np.array(linearised.names, dtype=object)
    tail_factor = np.where(np.isnan(fit_result.low), 1.0, tail_factors(linearised, fit_result) if tails else 1.0)
    return NoiseLevels(
        by,
        tuple(linearised.names[i] for i in with_errors),
        np.sqrt(total(linearised.of_effect, size, linearised.sigma**2)[with_errors] / count[with_errors]),
        factor[with_errors],
        (factor * fit_result.error)[with_errors],
        low[with_errors],
        high[with_errors],
        (redundancy / np.maximum(count - gross, 1))[with_errors],
        count[with_errors].astype(np.int64),
        gross[with_errors].astype(np.int64),
        _ratio(stated),
        _ratio(fit_result.tests),
        int((stated.dof > 0).sum()),
        (*_sentences(names, fit_result, redundancy, no_evidence), *_tail_sentences(names, tail_factor)),
        tail_factor[with_errors],
    )


# Factor for tails above which a sentence reports it.
_LONG = 1.1


def _tail_sentences(names: Array, factors: Array) -> list[str]:
    """Return a sentence for each group whose errors have longer tails than normal errors.

    `names` (G,) are the groups, and `factors` (G,) the additional factors for tails.
    """
    return [
        f"errors of {name} have long tails: the sigma used is {size:.2g} times the most likely sigma"
        for name, size in zip(names.tolist(), factors.tolist(), strict=True)
        if size > _LONG
    ]


def _ratio(tests: Tested) -> float:
    """Return chi-square per degree of freedom over all fixes."""
    return float(tests.cost.sum() / max(int(tests.dof.sum()), 1))


# Total redundancy of the errors of a group below which its level is unreliable. Two errors determine a standard
# deviation to a factor of two, and its weight in a fix is nearly arbitrary.
_SCARCE = 2.0


def _sentences(names: Array, fit_result: VarianceFit, redundancy: Array, no_evidence: Array) -> tuple[str, ...]:
    """Return sentences about the levels that the data do not determine.

    `redundancy` (G,) is the number of errors of each group that the residuals show, as a sum of shares. `no_evidence`
    (G,) marks common errors without evidence.
    """
    sentences = []
    if fit_result.shared.any():
        what = "it keeps the stated noise" if fit_result.stay else "all of them share one factor"
        apart = "" if fit_result.stay else " separately"
        sentences.append(f"the data do not determine the noise of {_list(names[fit_result.shared])}{apart}: {what}")
    if (maybe_zero := ~fit_result.shared & (fit_result.low == 0.0)).any():
        sentences.append(f"the noise of {_list(names[maybe_zero])} may be zero: the level used is a lower limit")
    if (scarce := np.isfinite(fit_result.low) & (redundancy < _SCARCE)).any():
        sentences.append(f"the redundancy of {_list(names[scarce])} is below two: its level is unreliable")
    if no_evidence.any():
        sentences.append(f"the data do not show that rows have an error in common: {_list(names[no_evidence])}")
    return tuple(sentences)


def _list(names: Array) -> str:
    """Return names as a list in words; at most `_NAMED` are written, the others counted."""
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")


# Late rows.

# Maximum number of iterations of fixes and shares, and the relative change of the share of late rows that ends them. It
# is well below the standard error of the share from a thousand rows.
_ROUNDS, _SAME = 4, 0.02


def late_signals(problem: Problem, *, method: str = "cauchy", fix: Fix | None = None) -> LateSignals:
    """Return the share of late ranges and arrivals in many fixes, and their mean delay.

    A row is late with an unknown probability, the same for all rows, and its delay is exponential. The other rows of
    its fix, without late rows, predict it; its residual is normal plus the delay. Probability and mean delay maximise
    the product of these densities over all rows (expectation maximisation). Then rows that are probably late are
    selected again, and the fixes are repeated with the resulting loss, until both agree.

    Parameters
    ----------
    problem : Problem
        As for `noise_levels`. Differences of arrivals are converted to arrivals. The stated noise applies to rows
        that are not late.
    method : str
        Method of the first fixes; see `solve`. It must treat both signs alike, because its fixes show whether errors
        are delays.
    fix : Fix, optional
        Existing fixes of `batch_of(problem)`, which are used without changes.

    Returns
    -------
    LateSignals
        The share is zero in three cases. Late rows explain the residuals hardly better. Errors of the other sign
        explain them as well. All rows of a kind are late by the same amount, which is an offset.

    Raises
    ------
    InvalidProblem
        If no epoch has a fix.

    References
    ----------
    A. P. Dempster, N. M. Laird, D. B. Rubin, "Maximum likelihood from incomplete data via the EM algorithm" (1977).
    """
    from optloc.solvers.solution import solve

    batch = batch_of(problem)
    if fix is not None or not batch.layout.size:
        return late_signals_at(batch, *usable(batch, fix))
    arrivals = as_arrivals(batch)
    batch, share = batch if arrivals is None else arrivals.problem, 1.0
    for _ in range(_ROUNDS):
        late = late_signals_at(batch, *usable(batch, solve(batch, method)))
        if not late.share or abs(np.log(late.share / share)) < _SAME:
            break
        method, share = late.method, late.share
    return late

"""Noise from data: how large the errors of each station, pair or kind are, estimated over many fixes."""

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

# Groups that a sentence names; the others are counted.
_NAMED = 8


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """Noise of groups of errors as the residuals of fixes show it.

    Parameters
    ----------
    by : "station", "pair" or "kind"
        What makes a group.
    names : tuple of G str
        Groups; behind them, where asked for, what the rows of each have in common in an epoch.
    stated : array (G,)
        Standard deviation that the problem states, root mean square, SI units; of what rows have in common, of which it
        states nothing, that of the rows.
    factor : array (G,)
        What the stated standard deviations are multiplied by; 1 where the data do not tell, 0 of what rows have in
        common where the data do not show it.
    error : array (G,)
        Standard error of the factor; NaN where the data do not tell it for this group alone.
    low, high : array (G,)
        Interval of 95 % of the factor: from zero where the data do not tell the noise from none, NaN where they tell
        nothing. The factor stays off zero all the same: it is the most likely one times a weight (see `noise_levels`).
    redundancy : array (G,)
        Share of each group's errors that shows in the residuals, from 0 to 1.
    count : int array (G,)
        Errors of each group.
    gross : int array (G,)
        Those that were left out as gross.
    before, after : float
        Chi-square per degree of freedom with the noise as stated and as found, gross errors left out.
    fixes : int
        Number of fixes that were used.
    sentences : tuple of str
        What the data do not tell.
    tails : array (G,)
        Further factor, at least 1, with which a Gaussian bounds the tails of the errors.
    common : "station", "pair" or "kind", optional
        Whose rows have an error in common in an epoch.
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
        """Return the factors (G,) of the stated standard deviations, tails included."""
        return np.asarray(self.factor * self.tails)

    @property
    def sigma(self) -> Array:
        """Return the standard deviations (G,) that were found, SI units; NaN where the data do not tell."""
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
    """Return how large the errors of groups of rows are, from the residuals of many fixes.

    Restricted maximum likelihood of variance components: the covariance of the rows is a sum of the stated one's parts,
    each times an unknown factor, and the factors maximise the likelihood of what the residuals say that does not depend
    on the fixes, times each factor of a variance: without that weight, which counts no more than two errors of a group,
    a level of few errors is often zero. Scoring steps on the logarithms are taken until they vanish; each is Rao's
    minimum norm quadratic estimate at the factors before. Errors that the rest of their fix shows to be gross are left
    out one by one, and the scale is that of the others.

    Parameters
    ----------
    problem : Problem
        Its epochs, where they share no unknown, or its batch are the fixes; otherwise it is one fix of many rows.
        Its noise may be wrong; its ratios within a group are kept.
    by : "station", "pair" or "kind"
        Whether each station has a level (the error of an arrival where rows combine arrivals), each pair or each kind.
    common : "station", "pair" or "kind", optional
        Whose rows have an error in common in every epoch besides: of an attitude, a place that is taken as known, or
        refraction; True: as `by`. It is told where a group has several rows in an epoch.
    method : str
        How to fix; see `solve`.
    fix : Fix, optional
        Fixes of `batch_of(problem)` made before.

    Returns
    -------
    NoiseLevels
        Groups that the data cannot tell apart share one factor or stay as stated, and a sentence says so.

    Raises
    ------
    InvalidProblem
        Where no fix has redundancy.

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
    kept, x = usable(batch, fix)
    shared_by = shared_grouping(by, common)
    return levels_of(elements(batch.take(kept), x, by, shared_by), by, shared_by)


def shared_grouping(by: By, common: By | bool | None) -> By | None:
    """Return the grouping of errors in common: `by` itself for True."""
    return by if common is True else common or None


def with_noise_levels(problem: Problem, levels: NoiseLevels) -> Problem:
    """Return the problem with its noise scaled as the levels say.

    Parameters
    ----------
    problem : Problem
        The problem that the levels were estimated from, or another one of the same stations and kinds.
    levels : NoiseLevels
        Of `noise_levels`; groups that it does not have stay as they are.

    Raises
    ------
    InvalidProblem
        Where rows have an error in common in an epoch and others that last longer.
    """
    factor = dict(zip(levels.names, levels.used.tolist(), strict=True))
    present = problem.weight > 0.0
    noise = Noise(tuple(_scale(problem, block, levels.by, factor, present) for block in problem.noise.blocks))
    if levels.common is None:
        return replace(problem, noise=noise)
    sigma = dict(zip(levels.names, (levels.used * levels.stated).tolist(), strict=True))
    names = {*ends_of(problem, levels.common).name.ravel().tolist()} - {""}
    common = {name: sigma[common_name(name)] for name in sorted(names) if sigma.get(common_name(name), 0.0) > 0.0}
    return replace(problem, noise=_with_common(problem, noise, levels.common, common) if common else noise)


def _scale(problem: Problem, block: Block, by: By, factor: dict[str, float], present: Array) -> Block:
    effect, names, _ = split(problem, block, by, present)
    own = np.array([[factor.get(name, 1.0) for name in row] for row in names.tolist()])
    scaled = effect * own[:, None, :]
    here = present[..., block.row]
    # Rows that are absent keep what was stated of them: nothing was learnt there.
    both = here[..., :, None] & here[..., None, :]
    return Block(block.row, np.where(both, scaled @ np.swapaxes(scaled, -1, -2), block.covariance))


def _with_common(problem: Problem, noise: Noise, by: By, sigma: dict[str, float]) -> Noise:
    """Return noise with an error of each of some groups that lasts an epoch, of these standard deviations."""
    if has_correlated_epochs(problem):
        what = "errors of rows of several epochs are correlated"
        raise InvalidProblem(what, "noise", "leave out what rows of an epoch have in common")
    effect, _, _ = common_effects(problem, by, sigma)
    blocks = []
    for members in group_members(problem.epoch):
        own = effect[members]
        blocks.append(Block(members, gathered(noise, members) + own @ np.swapaxes(own, -1, -2)))
    return group(blocks)


def common_level(problem: Problem, *, method: str = "cauchy", fix: Fix | None = None) -> CommonLevel:
    """Return whether many fixes accuse measurements, one station, or the noise as it is stated, and its factor.

    Parameters
    ----------
    problem : Problem
        As in `noise_levels`.
    method : str
        How to fix; see `solve`. One that a few liars do not move is best.
    fix : Fix, optional
        Fixes of `batch_of(problem)` made before.

    Returns
    -------
    CommonLevel
        `scale(problem)` is the problem with the noise that was found; that of data that fit it stays as stated.

    Raises
    ------
    InvalidProblem
        Where no epoch has a fix.
    """
    from optloc.solvers.solution import solve

    batch = batch_of(problem)
    if fix is None and batch.layout.size:
        fix = solve(batch, method)
    kept, x = usable(batch, fix)
    return common_level_at(batch.take(kept), x)


def usable(batch: Problem, fix: Fix | None) -> tuple[Array, Array]:
    """Return which problems of a flat batch have a fix (n,), and their parameter vectors (n, size).

    Raises
    ------
    InvalidProblem
        Where there is none.
    """
    if fix is None:
        size = batch.batch_shape[0]
        return np.arange(size), np.zeros((size, 0))
    flat = fix.flat()
    kept = np.flatnonzero(np.isfinite(flat.x).all(-1) & flat.answered)
    if not len(kept):
        raise InvalidProblem("no epoch has a fix", "noise", "see `optloc fix` for the reasons")
    return kept, flat.x[kept]


def levels_of(made: Elements, by: By, common: By | None = None, *, tails: bool = True) -> NoiseLevels:
    """Return the noise levels of linearised fixes, with or without a bound of their tails; see `noise_levels`."""
    return replace(_report(made, by, *fitted(made, common), tails=tails), common=common)


def fitted(made: Elements, shared_by: By | None) -> tuple[VarianceFit, Array]:
    """Return the variance factors of groups, and the errors in common (g,) without evidence."""
    from threadpoolctl import threadpool_limits

    common = made.common[:-1]
    # Products of small matrices gain nothing from threads, and wait for them on a busy machine: ten times as long.
    with threadpool_limits(1):
        plain = fit(made, common, common)
        # No noise is stated for errors in common: without evidence they are zero.
        seen = _with_their_like(visible(made, plain, common), common, shared_by)
        found = fit(made, common & ~seen, common) if seen.any() else plain
        while (fewer := _with_their_like(seen & (found.low > 0.0), common, shared_by)).sum() < seen.sum():
            seen = fewer
            found = fit(made, common & ~seen, common) if seen.any() else plain
    return found, common & ~seen


def _with_their_like(shown: Array, common: Array, by: By | None) -> Array:
    """Return which errors in common (G,) are kept: those of one station or pair show that the others have them too.

    A fix follows as many of these as it has unknowns. Levels of a few that explain the rest say that the others are
    exact, and so is the fix.
    """
    return shown if by == "kind" else common & shown.any()


def _report(made: Elements, by: By, found: VarianceFit, none: Array, *, tails: bool) -> NoiseLevels:
    """Return the levels of all groups with errors, from a fit and the groups (g,) without evidence."""
    size = len(made.names)
    count, gross = total(made.of_effect, size), total(made.of_effect, size, found.gross)
    used = np.flatnonzero(count)
    # T_jj times the variance: what share of an error the residuals show.
    share = found.tests.size[:, : found.gross.shape[1]] * np.nan_to_num(found.variance)[made.of_effect]
    redundancy, factor = total(made.of_effect, size, share), np.sqrt(found.variance)
    # Gross errors of the fitted noise are left out of both ratios: else they would differ by these alone.
    own = np.append(none, False)[made.of_effect]
    stated = without(tested(made, np.where(own, 0.0, 1.0)), found.gross)
    low, high = (np.where(none, np.nan, np.sqrt(end)) for end in (found.low, found.high))
    names = np.array(made.names, dtype=object)
    wider = np.where(np.isnan(found.low), 1.0, tail_factors(made, found) if tails else 1.0)
    return NoiseLevels(
        by,
        tuple(made.names[i] for i in used),
        np.sqrt(total(made.of_effect, size, made.sigma**2)[used] / count[used]),
        factor[used],
        (factor * found.error)[used],
        low[used],
        high[used],
        (redundancy / np.maximum(count - gross, 1))[used],
        count[used].astype(np.int64),
        gross[used].astype(np.int64),
        _ratio(stated),
        _ratio(found.tests),
        int((stated.dof > 0).sum()),
        (*_sentences(names, found, redundancy, none), *_tails_in_words(names, wider)),
        wider[used],
    )


# Factor of a sigma for its tails that is worth a sentence.
_LONG = 1.1


def _tails_in_words(names: Array, wider: Array) -> list[str]:
    """Return a sentence for each group with longer tails than normal errors."""
    return [
        f"errors of {name} have long tails: the sigma used is {size:.2g} times the most likely one"
        for name, size in zip(names.tolist(), wider.tolist(), strict=True)
        if size > _LONG
    ]


def _ratio(tests: Tested) -> float:
    return float(tests.cost.sum() / max(int(tests.dof.sum()), 1))


# Redundancy of all errors of a group together below which its level is a guess: the sigma of two errors is known to a
# factor of two, and its weight in a fix is nearly free.
_SCARCE = 2.0


def _sentences(names: Array, found: VarianceFit, redundancy: Array, none: Array) -> tuple[str, ...]:
    """Return what the data do not tell."""
    said = []
    if found.shared.any():
        what = "it stays as stated" if found.stay else "one factor for all of them"
        apart = "" if found.stay else " apart"
        said.append(f"the data do not tell the noise of {_list(names[found.shared])}{apart}: {what}")
    if (open_ := ~found.shared & (found.low == 0.0)).any():
        said.append(f"the data do not tell the noise of {_list(names[open_])} from none: what is used is a floor")
    if (scarce := np.isfinite(found.low) & (redundancy < _SCARCE)).any():
        said.append(f"the redundancy of {_list(names[scarce])} is below two: its level is hardly more than a guess")
    if none.any():
        said.append(f"the data do not show that rows have an error in common: {_list(names[none])}")
    return tuple(said)


def _list(names: Array) -> str:
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")


# Late rows.

# Turns of fixes and shares, and the change of the share of late rows that ends them, well below its error from a
# thousand rows.
_ROUNDS, _SAME = 4, 0.02


def late_signals(problem: Problem, *, method: str = "cauchy", fix: Fix | None = None) -> LateSignals:
    """Return how many ranges and arrivals of many fixes are late, and by how much on average.

    A row is late with an unknown probability, the same for all, by a delay that is exponential. What the other rows of
    its fix say of it, those that are late left out, is normal plus that delay; probability and mean delay maximise the
    product of these densities over all rows (expectation and maximisation), rows that are late rather than not are
    left out anew, and fixes are made anew with the loss that follows, until they agree.

    Parameters
    ----------
    problem : Problem
        As in `noise_levels`; differences made of arrivals are taken apart. Its noise is that of rows that are not late.
    method : str
        How to fix first; see `solve`. One that doubts either side: whether errors are delays is asked of its fixes.
    fix : Fix, optional
        Fixes of `batch_of(problem)` made before: they are taken as they are.

    Returns
    -------
    LateSignals
        None late where that explains hardly more than none, where errors of the other sign do as well, or where all
        rows of a kind are late by one amount: an offset.

    Raises
    ------
    InvalidProblem
        Where no epoch has a fix.

    References
    ----------
    A. P. Dempster, N. M. Laird, D. B. Rubin, "Maximum likelihood from incomplete data via the EM algorithm" (1977).
    """
    from optloc.solvers.solution import solve

    batch = batch_of(problem)
    if fix is not None or not batch.layout.size:
        return late_signals_at(batch, *usable(batch, fix))
    taken = as_arrivals(batch)
    batch, share = batch if taken is None else taken.problem, 1.0
    for _ in range(_ROUNDS):
        found = late_signals_at(batch, *usable(batch, solve(batch, method)))
        if not found.share or abs(np.log(found.share / share)) < _SAME:
            break
        method, share = found.method, found.share
    return found

"""Structure of the noise: independent errors of rows, stations or kinds, common errors of epochs, lasting errors.

A common error is shared by the rows of a group in one epoch. A lasting error is correlated between successive epochs.
Letters: N fixes, G groups, q errors of a fix.

Arguments of functions: `batch` are the N problems of the fixes, and `x` (N, size) their parameter vectors. `method` is
the method of the fixes. `tried` are the fitted structures, the best first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.linear.constraints import is_exact
from optloc.model_checks.elements import By, Elements, batch_of, common_name, elements, ends_of, kinds_of
from optloc.model_checks.score import descend
from optloc.model_checks.variance_components import Tested, VarianceFit, cleaned, deviance, tested
from optloc.problem.epochs import has_correlated_epochs, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.station_health.levels import (
    NoiseLevels,
    fitted,
    levels_of,
    shared_grouping,
    usable,
    with_noise_levels,
)

# Number of standard errors above which a correlation is significant, and the least correlation that matters: 0.2 widens
# the interval of a level by 4 %.
_SURE, _WORTH = 4.0, 0.2
# Visible share of a common error below which a sentence reports that fixes absorb it.
_ABSORBED = 0.5
# Minimum number of pairs of successive epochs for a correlation, and pairs per part: its matrices take a few megabytes.
_PAIRS, _PART = 30, 500
# Upper limit of the correlation, because with 1 the interval of a level would be infinite.
_LASTS = 0.99


@dataclass(frozen=True, slots=True)
class Tried:
    """One structure of the noise, and its likelihood.

    Parameters
    ----------
    by : "station", "pair" or "kind"
        Groups with one level each.
    common : "station", "pair" or "kind", optional
        Grouping of rows that share an error in an epoch; None without such errors.
    levels : int
        Number of levels that the residuals determine.
    deviance : float
        Twice the negative logarithm of the restricted likelihood.
    price : float
        Penalty for the levels: the logarithm of the redundancy for each (Schwarz 1978).
    """

    by: By
    common: By | None
    levels: int
    deviance: float
    price: float

    @property
    def total(self) -> float:
        """Return the sum of deviance and penalty; the structure with the least sum is the best."""
        return self.deviance + self.price


@dataclass(frozen=True, slots=True)
class NoiseStructure:
    """The structure of the noise that explains the residuals of many fixes best.

    Parameters
    ----------
    tried : tuple of Tried
        All structures, the best first.
    lasting : dict
        Correlation of the errors of each kind from one epoch to the next, where it is significant.
    sentences : tuple of str
        Findings, and statements about errors that residuals cannot show.
    """

    tried: tuple[Tried, ...]
    lasting: dict[str, float]
    sentences: tuple[str, ...]

    @property
    def by(self) -> By:
        """Return the grouping: each group has one level."""
        return self.tried[0].by

    @property
    def common(self) -> By | None:
        """Return the grouping of the common errors of an epoch; None without them."""
        return self.tried[0].common

    @property
    def option(self) -> str:
        """Return the structure in the form of the option `--noise-from-data`."""
        return self.by + ("+epoch" if self.common else "")


def noise_structure(problem: Problem, *, method: str = "auto", fix: Fix | None = None) -> NoiseStructure:
    """Return the structure of the noise with the least sum of deviance and penalty, from the residuals of many fixes.

    The structures are levels by kind, with and without a common error in each epoch, and levels by station and by pair.
    Levels by station and by pair assume independent errors. If errors last, or if rows share an error in an epoch,
    these levels are too small for some stations. Fixes with them would be wrong, so levels are then by kind.

    Parameters
    ----------
    problem : Problem
        As for `noise_levels`.
    method : str
        Method of the fixes; see `solve`.
    fix : Fix, optional
        Existing fixes of `batch_of(problem)`.

    Raises
    ------
    InvalidProblem
        If no fix has redundancy.

    References
    ----------
    D. A. Harville, "Maximum likelihood approaches to variance component estimation" (1977), section 3.
    G. Schwarz, "Estimating the dimension of a model", Annals of Statistics 6 (1978).
    """
    from optloc.solvers.solution import solve

    batch = batch_of(problem)
    if fix is None and batch.layout.size:
        fix = solve(batch, method)
    kept, x = usable(batch, fix)
    return structure_at(batch.take(kept), x, kept, ordered=_in_order(problem))


def _in_order(problem: Problem) -> bool:
    """Return whether the fixes of a problem are its epochs. A batch has no order in time, and a run is one fix."""
    return separable(problem) and problem.epochs > 1 and not problem.batch_shape


def structure_at(batch: Problem, x: Array, number: Array, *, ordered: bool) -> NoiseStructure:
    """Return the structure of the noise at fixes (N, size) of a flat batch, which are the problems `number` (N,).

    `ordered` states whether the problems are in the order of time. If not, lasting errors are possible even if
    neighbours do not show them.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        # Prefer the common error only with evidence and a lower sum of deviance and penalty. If the noise is correlated
        # between epochs, the model has no separate error of each epoch.
        without_common = _fit_structure(batch, x, "kind", None)
        common = without_common if has_correlated_epochs(batch) else _fit_structure(batch, x, "kind", "kind")
        best = common if common.seen and common.tried.total < without_common.tried.total else without_common
        lasting = _lasting(batch, x, number, best)
        candidates = [without_common, common] if common.seen else [without_common]
        # Levels by station or pair assume independent errors. Only epochs in the order of time can show independence.
        if best is without_common and ordered and not lasting:
            finer = [_fit_structure(batch, x, by, None) for by in _groupings(batch)]
            candidates += [structure for structure in finer if structure.tried.levels > without_common.tried.levels]
    tried = tuple(sorted((candidate.tried for candidate in candidates), key=lambda structure: structure.total))
    return NoiseStructure(tried, lasting, tuple(_sentences(tried, lasting, common if best is common else None)))


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A structure that was fitted to the residuals.

    `tried` is the structure with its likelihood. `linearised` are the fixes with the errors of this structure, and
    `fit` are the factors of these errors. `absent` (G,) marks the common errors without evidence.
    """

    tried: Tried
    linearised: Elements
    fit: VarianceFit
    absent: Array

    @property
    def seen(self) -> bool:
        """Return whether there is evidence of a common error."""
        return bool((self.linearised.common[:-1] & ~self.absent).any())


def _fit_structure(batch: Problem, x: Array, by: By, common: By | None) -> _Candidate:
    """Return a structure fitted to the residuals of fixes x (N, size) of a flat batch."""
    linearised = elements(batch, x, by, common)
    fit, absent = fitted(linearised, common)
    # Groups with a level that the data determine. Groups that share one factor count as one level.
    known = np.isfinite(fit.low) & ~absent
    levels = int((known & ~fit.shared).sum()) + int((known & fit.shared).any())
    redundancy = max(int(tested(linearised, np.ones(())).dof.sum()), 1)
    price = levels * float(np.log(redundancy))
    return _Candidate(Tried(by, common, levels, deviance(linearised, fit), price), linearised, fit, absent)


def _groupings(batch: Problem) -> Iterator[By]:
    """Yield the groupings of rows that are finer than kinds."""
    kinds = len(set(kinds_of(batch).tolist()))
    stations, pairs = (
        {*ends.name.ravel().tolist()} - {""} for ends in (ends_of(batch, "station"), ends_of(batch, "pair"))
    )
    if len(stations) > kinds:
        yield "station"
    if pairs != stations and len(pairs) > kinds:
        yield "pair"


def _lasting(batch: Problem, x: Array, number: Array, best: _Candidate) -> dict[str, float]:
    """Return the correlation of the errors of each kind between successive epochs, by kind, if it is significant.

    `number` (N,) is the epoch of each fix. `best` is the best structure without lasting errors; its levels weight the
    errors.
    """
    linearised = elements(batch, x, "station", "kind" if best.tried.common else None)
    # Levels of the best structure are by kind. A group of stations takes the level of its kind; 1 if it has no level.
    level = dict(zip(best.linearised.names, np.nan_to_num(best.fit.variance, nan=1.0).tolist(), strict=True))
    kinds = _kind_of(batch)
    kind_of = np.array([kinds.get(name, name) for name in linearised.names], dtype=object)
    level_of_group = [
        level.get(name, level.get(str(kind), 1.0)) for name, kind in zip(linearised.names, kind_of, strict=True)
    ]
    # The last entry is for index -1, an unused error.
    variance = np.array([*level_of_group, 0.0])
    _, tests = cleaned(linearised, variance[linearised.of_effect])
    # Positions of the fixes whose next fix is of the next epoch, in parts that limit the memory.
    follows = np.flatnonzero(np.diff(number) == 1)
    parts = [follows[i : i + _PART] for i in range(0, len(follows), _PART)]
    correlations, known = (
        {},
        {name for name, low in zip(best.linearised.names, best.fit.low, strict=True) if np.isfinite(low)},
    )
    # Only kinds whose level the data determine. The correlation is the sum of products over its expectation at
    # correlation one. The standard error assumes that the products have mean zero.
    for kind in sorted(known & {*kind_of.tolist()}):
        groups = np.flatnonzero(kind_of == kind)
        sums = [_products(tests, linearised.of_effect, groups, variance, part) for part in parts]
        product, share = (np.concatenate([one[i] for one in sums] or [np.zeros(0)]) for i in range(2))
        if np.count_nonzero(share) < _PAIRS:
            continue
        size, error = (float(v / share.sum()) for v in (product.sum(), np.sqrt((product**2).sum())))
        if size > max(_SURE * error, _WORTH):
            correlations[kind] = min(size, _LASTS)
    return correlations


def _kind_of(batch: Problem) -> dict[str, str]:
    """Return the kind of the rows of each group of stations, by group name."""
    ends, kinds = ends_of(batch, "station").name, kinds_of(batch)
    return {name: str(kind) for row, kind in zip(ends.tolist(), kinds.tolist(), strict=True) for name in row if name}


def _products(tests: Tested, group_of: Array, groups: Array, variance: Array, first: Array) -> tuple[Array, Array]:
    """Return products (n,) of the errors of some groups in successive epochs, and their means (n,) at correlation one.

    `group_of` (N, q) is the group of each error. `groups` (g,) are the groups that count. `variance` (G + 1,) are the
    variance factors theta. `first` (n,) is the first epoch of each pair.

    An epoch has tests t = T e of its errors e, the next epoch t' = T' e'. The expectation of the sum of t_g t'_g over
    the groups g is the correlation times the sum of T_gh T'_gh theta_h.
    """
    is_in_group = group_of[:, :, None] == groups
    vector = np.einsum("nqg,nq->ng", is_in_group[first], tests.vector[first, : tests.errors])
    after = np.einsum("nqg,nq->ng", is_in_group[first + 1], tests.vector[first + 1, : tests.errors])
    matrix, next_matrix = (
        np.swapaxes(is_in_group[i], 1, 2) @ tests.matrix[i][:, : tests.errors, : tests.errors] @ is_in_group[i]
        for i in (first, first + 1)
    )
    scale = variance[groups]
    return (vector * after * scale).sum(1), (matrix * next_matrix * scale * scale[:, None]).sum((1, 2))


def _sentences(tried: tuple[Tried, ...], lasting: dict[str, float], common: _Candidate | None) -> Iterator[str]:
    """Yield sentences about the structure, and about errors that residuals cannot show.

    `common` is the fitted structure with common errors if it is the best, otherwise None.
    """
    best = tried[0]
    if len(tried) > 1:
        gain = tried[1].total - best.total
        yield f"{_words(best)} explain the residuals best: deviance {gain:.3g} lower than with {_words(tried[1])}"
    for kind, size in lasting.items():
        yield (
            f"errors of {kind} last: their correlation from one epoch to the next is {size:.2g}, and means of epochs "
            "are less certain than with independent errors"
        )
    if best.common and common is not None:
        absorbed = _absorbed(common)
        if absorbed:
            what = ", ".join(f"{100.0 * share:.0f} % of {name}" for name, share in absorbed.items())
            yield f"fixes absorb {what}: known positions or more stations would show the rest"
    yield "residuals cannot show an error that shifts all fixes alike: measure at a known position to find it"


def _words(structure: Tried) -> str:
    """Return a structure in words."""
    addition = f" and an error in common of each {structure.common} in an epoch" if structure.common else ""
    return f"levels of each {structure.by}{addition}"


def _absorbed(candidate: _Candidate) -> dict[str, float]:
    """Return the share of each common error that fixes absorb, by name, if it is more than half.

    `candidate` is a fitted structure with common errors.
    """
    q = candidate.linearised.of_effect.shape[1]
    shares = {}
    for g in np.flatnonzero(candidate.linearised.common[:-1] & (np.nan_to_num(candidate.fit.low) > 0.0)):
        in_group = candidate.linearised.of_effect == g
        share = float((candidate.fit.tests.size[:, :q][in_group] * candidate.fit.variance[g]).mean())
        if share < _ABSORBED:
            shares[candidate.linearised.names[g]] = 1.0 - share
    return shares


# Alternate fixes and levels until they agree.

# Maximum number of iterations, and the relative change of all levels that ends them. 2 % is below the standard error
# from a thousand errors (1 / sqrt(2 n)). Each iteration repeats the fixes of all epochs.
_ROUNDS, _CLOSE = 4, 0.02
# Number of fixes above which iterations use only some: 300 fixes determine a level to 4 %. Maximum number of fixes for
# the structure and the final levels, and the length of their stretches: a thousand determine a level to 2 % in constant
# time.
_SOME, _MANY, _STRETCH = 300, 1000, 50


def with_estimated_noise(
    problem: Problem, by: By | None = None, *, common: By | bool | None = None, method: str = "auto"
) -> tuple[Problem, NoiseLevels]:
    """Return the problem with estimated noise, and the levels. Fixes and levels alternate until they agree.

    Parameters
    ----------
    problem : Problem
        A problem whose stated noise is a starting value. Ratios within a group are kept, and so is the noise of groups
        that the data do not determine.
    by : "station", "pair" or "kind", optional
        As for `noise_levels`. None: the result of `noise_structure` at fixes with levels by kind.
    common, method
        As for `noise_levels`. `common` is used only if `by` is given.

    Raises
    ------
    InvalidProblem
        As for `noise_levels`, and if the data do not determine any level.
    """
    batch = batch_of(problem)
    noise_fixes = _alternate(problem, batch, by or "kind", shared_grouping(by, common) if by else None, method)
    if by is not None:
        levels = noise_fixes.levels(batch)
        return with_noise_levels(problem, levels), levels
    part = _stretches(len(noise_fixes.kept))
    ordered = _in_order(problem)
    structure = structure_at(
        batch.take(noise_fixes.kept[part]), noise_fixes.x[part], noise_fixes.kept[part], ordered=ordered
    )
    _check_lasting(structure.lasting, {*map(str, kinds_of(batch))})
    levels = noise_fixes.levels(batch)
    if (structure.by, structure.common) != ("kind", None):
        # `plain` are the levels by kind without common errors. Common errors that last must not reduce them.
        plain, noise_fixes = levels, _alternate(problem, batch, structure.by, structure.common, method, noise_fixes)
        levels = _at_least(noise_fixes.levels(batch), plain, structure.lasting if ordered else None)
    levels = _widened(levels, structure.lasting)
    levels = replace(levels, sentences=(*structure.sentences, *levels.sentences))
    return with_noise_levels(problem, levels), levels


@dataclass(frozen=True, slots=True)
class _NoiseFixes:
    """Fixes of a batch, and the structure of the noise that was used for them.

    `kept` (n,) are the numbers of the problems with a fix, and `x` (n, size) their parameter vectors. `by` and `common`
    are the groupings as in `NoiseStructure`.
    """

    by: By
    common: By | None
    kept: Array
    x: Array

    def levels(self, batch: Problem) -> NoiseLevels:
        """Return the levels from stretches of the fixes, or from all fixes if the stretches lack some groups.

        A thousand fixes determine the levels well enough, in constant time; see `_stretches`.
        """
        all_fixes, part = batch.take(self.kept), _stretches(len(self.kept))
        chosen = all_fixes.take(part)
        if _present_groups(chosen, self.by) != _present_groups(all_fixes, self.by):
            chosen, part = all_fixes, np.arange(len(self.kept))
        return levels_of(elements(chosen, self.x[part], self.by, self.common), self.by, self.common)


def _present_groups(batch: Problem, by: By) -> set[str]:
    """Return the names of the groups that have present rows."""
    names, weight = ends_of(batch, by).name, np.broadcast_to(batch.weight, (batch.batch_shape[0], batch.count))
    return {*names[(weight > 0.0).any(0)].ravel().tolist()} - {""}


def _stretches(count: int) -> Array:
    """Return the numbers of the fixes that determine the structure: all, or evenly spaced stretches.

    Stretches contain successive epochs, which the correlation between epochs needs. `count` is the number of fixes.
    """
    if count <= _MANY:
        return np.arange(count)
    first = np.linspace(0, count - _STRETCH, _MANY // _STRETCH).astype(int)
    return np.unique(first[:, None] + np.arange(_STRETCH))


def _alternate(
    problem: Problem, batch: Problem, by: By, common: By | None, method: str, before: _NoiseFixes | None = None
) -> _NoiseFixes:
    """Return fixes whose noise agrees with their residuals; the iteration starts from the fixes `before`, if given.

    `batch` is ``batch_of(problem)``. `by` and `common` are the groupings of errors, and `method` is the method of the
    fixes.
    """
    from optloc.solvers.solution import solve

    if before is None:
        before_kept, x = usable(batch, solve(batch, method) if batch.layout.size else None)
    else:
        before_kept, x = before.kept, before.x
    # Iterations use some of the fixes, evenly spaced. Their levels are accurate enough to weight the next fixes.
    kept, sample, factor = before_kept, slice(None, None, max(len(before_kept) // _SOME, 1)), np.ones(1)
    # Better weights change the fixes, and the fixes change the residuals, so iterate until the levels are stable.
    for iteration in range(1 + _ROUNDS):
        linearised = elements(batch.take(kept[sample]), x[sample], by, common)
        # Factors refer to the stated noise. A level that the data do not determine keeps the stated noise.
        levels = levels_of(linearised, by, common, tails=False)
        if np.isnan(levels.low).all():
            advice = "state a sigma, or add rows, stations or epochs"
            raise InvalidProblem("the data do not determine the noise", "noise", advice)
        same = factor.shape == levels.factor.shape
        if iteration == _ROUNDS or (same and np.abs(levels.factor - factor).max() <= _CLOSE * levels.factor.max()):
            break
        factor = levels.factor
        kept, x = _fix_again(batch_of(with_noise_levels(problem, levels)), method, kept, x)
    return _NoiseFixes(by, common, kept, x)


def _fix_again(batch: Problem, method: str, kept: Array, x: Array) -> tuple[Array, Array]:
    """Return the fixes with new noise: for least squares without bounds by descent from the earlier fixes.

    `batch` is the batch with the new noise. `kept` (n,) are the problems with an earlier fix, and `x` (n, size) these
    fixes. The result has the same form.
    """
    from optloc.solvers.solution import solve

    if not batch.layout.size:
        return kept, x
    if method != "auto" or any(not is_exact(constraint) for constraint in batch.constraints):
        return usable(batch, solve(batch, method))
    refined, cost = descend(batch.take(kept), x)
    finite = np.isfinite(cost) & np.isfinite(refined).all(-1)
    return kept[finite], refined[finite]


# Correlation of errors above which their level is not estimated: two hundred epochs then equal ten independent epochs.
_TOO_LONG = 0.9


def _check_lasting(lasting: dict[str, float], kinds: set[str]) -> None:
    """Raise InvalidProblem if errors hardly change, because fixes follow them and residuals do not show them.

    `lasting` is the correlation of the errors between epochs, by kind.
    """
    for kind in sorted(kinds):
        if lasting.get(kind, 0.0) > _TOO_LONG:
            what = f"errors of {kind} hardly change (correlation {lasting[kind]:.2g} between epochs): residuals do not"
            advice = "state a sigma, or measure at a known position or for longer"
            raise InvalidProblem(f"{what} show their size", "noise", advice)


def _at_least(levels: NoiseLevels, plain: NoiseLevels, lasting: dict[str, float] | None) -> NoiseLevels:
    """Return levels of rows that are at least the levels without a common error, if the common error lasts or may last.

    `plain` are the levels without a common error. `lasting` is the correlation of errors by kind, or None if the order
    of the fixes is unknown; every error may then last. A lasting common error consists of few independent errors, so
    residuals do not separate it from errors of rows. Without this limit, with ranges that are 7 % too long, 14 % of the
    fixes had errors beyond five sigma.
    """
    least = {name: i for i, name in enumerate(plain.names) if lasting is None or common_name(name) in lasting}
    low, factor, high = levels.low.copy(), levels.factor.copy(), levels.high.copy()
    for i, name in enumerate(levels.names):
        if name in least and plain.factor[least[name]] > factor[i]:
            low[i], factor[i], high[i] = (values[least[name]] for values in (plain.low, plain.factor, plain.high))
    return replace(levels, low=low, factor=factor, high=high)


def _widened(levels: NoiseLevels, lasting: dict[str, float]) -> NoiseLevels:
    """Return levels with wider intervals for lasting errors: the squares of neighbours are correlated by r^2.

    `lasting` is the correlation r of the errors between epochs, by kind. The variance of their mean is (1 + r^2) / (1 -
    r^2) times the variance of independent squares (Bartlett 1946).
    """
    r = np.array([lasting.get(name, 0.0) for name in levels.names])
    wider = np.sqrt((1.0 + r**2) / (1.0 - r**2))
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (levels.factor * (end / levels.factor) ** wider for end in (levels.low, levels.high))
    return replace(levels, error=levels.error * wider, low=low, high=high)

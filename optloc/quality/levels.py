"""Noise from data: how large the errors of each station, pair or kind are, estimated over many fixes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.problem.fix import Fix
from optloc.problem.noise import Block, Noise
from optloc.problem.problem import Problem
from optloc.quality.elements import By, Elements, batch_of, elements, split
from optloc.quality.variance_components import KEPT, Fitted, Tested, fit, tested, total, without

# Turns of fixes and levels, and the change of all levels that ends them: 2 % is below the standard error that a
# thousand errors leave (1 / sqrt(2 n)), and each turn fixes every epoch again.
_ROUNDS, _CLOSE = 4, 0.02
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
        Groups.
    stated : array (G,)
        Standard deviation that the problem states, root mean square, SI units.
    factor : array (G,)
        What the stated standard deviations are to be multiplied by; 1 where the data do not tell.
    error : array (G,)
        Standard error of the factor; NaN where the data do not tell it for this group alone.
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
    """

    by: By
    names: tuple[str, ...]
    stated: Array
    factor: Array
    error: Array
    redundancy: Array
    count: Array
    gross: Array
    before: float
    after: float
    fixes: int
    sentences: tuple[str, ...]

    @property
    def sigma(self) -> Array:
        """Return the standard deviations (G,) that were found, SI units; NaN where the data do not tell."""
        return np.where(np.isnan(self.error), np.nan, self.factor * self.stated)

    @property
    def sigma_error(self) -> Array:
        """Return the standard errors (G,) of `sigma`, SI units."""
        return np.asarray(self.error * self.stated)


def noise_levels(problem: Problem, by: By = "station", *, method: str = "auto", fix: Fix | None = None) -> NoiseLevels:
    """Return how large the errors of groups of rows are, from the residuals of many fixes.

    Restricted maximum likelihood of variance components: the covariance of the rows is a sum of the stated one's parts,
    each times an unknown factor, and the factors maximise the likelihood of what the residuals say that does not depend
    on the fixes. Scoring steps on the logarithms are taken until they vanish; each is Rao's minimum norm quadratic
    estimate at the factors before. Errors that the rest of their fix shows to be gross are left out one by one, and
    the scale is that of the others.

    Parameters
    ----------
    problem : Problem
        Its epochs, where they share no unknown, or its batch are the fixes; otherwise it is one fix of many rows.
        Its noise may be wrong; its ratios within a group are kept.
    by : "station", "pair" or "kind"
        Whether each station has a level (the error of an arrival where rows combine arrivals), each pair or each kind.
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
    """
    from optloc.solvers import solve

    batch = batch_of(problem)
    if fix is None and batch.layout.size:
        fix = solve(batch, method)
    kept, x = usable(batch, fix)
    made = elements(batch.take(kept), x, by)
    return levels_of(made, by)


def with_estimated_noise(problem: Problem, by: By = "kind", *, method: str = "auto") -> tuple[Problem, NoiseLevels]:
    """Return the problem with its noise from the data, and the levels: fixes and levels are made until they agree.

    Parameters
    ----------
    problem : Problem
        What its noise states is only where to begin; ratios within a group are kept.
    by, method
        As in `noise_levels`.

    Raises
    ------
    InvalidProblem
        As `noise_levels`, and where the data do not tell any level.
    """
    # Better weights move the fixes, and these the residuals: turns until nothing moves.
    first = levels = noise_levels(problem, by, method=method)
    factor = levels.factor
    for _ in range(_ROUNDS):
        problem = with_noise_levels(problem, levels)
        levels = noise_levels(problem, by, method=method)
        factor = factor * levels.factor
        if np.abs(levels.factor - 1.0).max() < _CLOSE:
            break
    if levels.names != first.names or np.isnan(levels.error).all():
        advice = "state a sigma, or add rows, stations or epochs"
        raise InvalidProblem("the data do not tell the noise", "noise", advice)
    whole = replace(levels, stated=first.stated, factor=factor, error=levels.error * factor, before=first.before)
    return with_noise_levels(problem, levels), whole


def with_noise_levels(problem: Problem, levels: NoiseLevels) -> Problem:
    """Return the problem with its noise scaled as the levels say.

    Parameters
    ----------
    problem : Problem
        The problem that the levels were estimated from, or another one of the same stations and kinds.
    levels : NoiseLevels
        Of `noise_levels`; groups that it does not have stay as they are.
    """
    factor = dict(zip(levels.names, levels.factor.tolist(), strict=True))
    present = problem.weight > 0.0
    blocks = [_scale(problem, block, levels.by, factor, present) for block in problem.noise.blocks]
    return replace(problem, noise=Noise(tuple(blocks)))


def _scale(problem: Problem, block: Block, by: By, factor: dict[str, float], present: Array) -> Block:
    effect, names, _ = split(problem, block, by, present)
    own = np.array([[factor.get(name, 1.0) for name in row] for row in names.tolist()])
    scaled = effect * own[:, None, :]
    here = present[..., block.row]
    # Rows that are absent keep what was stated of them: nothing was learnt there.
    both = here[..., :, None] & here[..., None, :]
    return Block(block.row, np.where(both, scaled @ np.swapaxes(scaled, -1, -2), block.covariance))


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


def levels_of(made: Elements, by: By) -> NoiseLevels:
    """Return the noise levels of linearised fixes; see `noise_levels`."""
    # Groups that have errors, numbered from 0; -1, no group, comes first where it occurs.
    used, inverse = np.unique(made.of_effect, return_inverse=True)
    none = int(used[0] == -1)
    group, used = inverse.reshape(made.of_effect.shape) - none, used[none:]
    fitted = fit(made, group, len(used))
    names = tuple(made.names[i] for i in used)
    count, gross = total(group, len(used)), total(group, len(used), fitted.gross)
    # T_jj times the variance: what share of an error the residuals show.
    redundancy = fitted.tests.size[:, : group.shape[1]] * fitted.variance[group]
    factor = np.sqrt(fitted.variance)
    # Gross errors of the fitted noise are left out of both ratios: else they would differ by these alone.
    stated = without(tested(made, np.ones(())), fitted.gross)
    return NoiseLevels(
        by,
        names,
        np.sqrt(total(group, len(used), made.sigma**2) / count),
        factor,
        factor * fitted.error,
        total(group, len(used), redundancy) / np.maximum(count - gross, 1),
        count.astype(np.int64),
        gross.astype(np.int64),
        _ratio(stated),
        _ratio(fitted.tests),
        int((stated.dof > 0).sum()),
        _sentences(fitted, names),
    )


def _ratio(tests: Tested) -> float:
    # Residuals were cut at three sigmas: their mean square is that much below one.
    return float(tests.cost.sum() / KEPT / max(int(tests.dof.sum()), 1))


def _sentences(fitted: Fitted, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return what the data do not tell."""
    open_ = [names[i] for i in np.flatnonzero(fitted.shared)]
    if not open_:
        return ()
    who = ", ".join(open_[:_NAMED]) + (f" and {len(open_) - _NAMED} more" if len(open_) > _NAMED else "")
    if fitted.stay:
        return (f"the data do not tell the noise of {who}: it stays as stated",)
    return (f"the data do not tell the noise of {who} apart: one factor for all of them",)

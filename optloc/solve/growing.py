"""How the estimate of a run grows: the answer after its first epochs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.epochs import tied
from optloc.errors import InvalidProblem
from optloc.fix import Fix
from optloc.layout import Layout
from optloc.normal import covariance
from optloc.problem import Problem
from optloc.solve.refine import refine
from optloc.status import Status
from optloc.types import Array
from optloc.windows import cut

_POINTS = 60


@dataclass(frozen=True, slots=True)
class Growing:
    """Estimates after the first epochs of a run.

    Parameters
    ----------
    counts : int array (q,)
        How many epochs count.
    times : array (q,)
        Seconds of the last of them.
    x : array (q, n)
        Estimates of the shared unknowns; NaN where the epochs do not determine them.
    cov : array (q, n, n)
        Their covariance; NaN likewise.
    layout : Layout
        What each entry means.
    """

    counts: Array
    times: Array
    x: Array
    cov: Array
    layout: Layout

    def take(self, name: str) -> tuple[Array, Array]:
        """Return estimates (q, size) and standard deviations (q, size) of a named unknown."""
        slot, _ = self.layout.find(name)
        part = slice(slot.start, slot.start + slot.size)
        return self.x[:, part], np.sqrt(np.diagonal(self.cov, axis1=-2, axis2=-1)[:, part])


def growing(problem: Problem, fix: Fix, counts: Sequence[int] | Array | None = None) -> Growing:
    """Return the maximum-likelihood estimate after the first epochs of a run, refined from that of the whole run.

    Parameters
    ----------
    problem : Problem
        A single run whose epochs share unknowns.
    fix : Fix
        Its fix.
    counts : sequence of int, optional
        Numbers of epochs, 1 to k; at most sixty of them, closer together at the start, by default.

    Raises
    ------
    InvalidProblem
        Where the epochs share nothing or noise ties them together, a count is out of range, or the fix has no answer.
    """
    k, n = problem.epochs, problem.layout.n_shared
    if k == 1 or not n or problem.batch_shape or tied(problem):
        advice = "give a single run of epochs that have biases or a motion in common"
        raise InvalidProblem("the estimate does not grow with the epochs", "problem", advice)
    if fix.shape or not np.isfinite(fix.x).all():
        raise InvalidProblem("the run has no answer to begin from", "fix", "see its status for the reason")
    chosen = _spread(k) if counts is None else np.asarray(counts, dtype=np.int64)
    if not len(chosen) or chosen.min() < 1 or chosen.max() > k:
        raise InvalidProblem(f"the counts are not among 1 to {k}", "counts", "give numbers of epochs")
    x, cov = np.full((len(chosen), n), np.nan), np.full((len(chosen), n, n), np.nan)
    for i, count in enumerate(chosen):
        part = cut(problem, 0, int(count)).flat()
        done = refine(part, fix.x[None, : part.layout.size])
        spread, ok = covariance(done.equations)
        if ok[0] and done.status[0] == Status.OK:
            x[i], cov[i] = done.x[0, :n], spread[0]
    return Growing(chosen, problem.times[chosen - 1], x, cov, problem.layout)


def _spread(epochs: int) -> Array:
    if epochs <= _POINTS:
        return np.arange(1, epochs + 1)
    return np.unique(np.geomspace(1, epochs, _POINTS).round().astype(np.int64))

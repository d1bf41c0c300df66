"""The normal equations of a run: sums over its epochs, window by window."""

from __future__ import annotations

from dataclasses import replace

from optloc.linear import linearise
from optloc.noise import Whitener
from optloc.normal import Normal, normal
from optloc.priors import with_priors
from optloc.problem import Problem
from optloc.types import Array
from optloc.weigh import whitener_at
from optloc.windows import windows


def equations_at(
    problem: Problem, x: Array, noise: tuple[Whitener, ...] | None = None, *, at: Array | None = None
) -> Normal:
    """Return the normal equations, priors included, of a batch of problems.

    Working memory beyond the measurements does not depend on the number of epochs: only sums are kept, and the local
    blocks of epochs that have unknowns of their own.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size)
        Parameter vectors.
    noise : tuple of Whitener, optional
        Whitening matrices of all rows, used where the run is one window; None: made from the problem.
    at : array (..., size), optional
        Where station errors of span "noise" are weighed; None: at `x`.
    """
    return with_priors(problem, x, summed(problem, x, noise, at=at))


def summed(problem: Problem, x: Array, noise: tuple[Whitener, ...] | None = None, *, at: Array | None = None) -> Normal:
    """Return the normal equations of the measurements alone; arguments as of `equations_at`."""
    total = None
    for first, last, part in windows(problem, x.size // x.shape[-1]):
        own = noise if last - first == problem.epochs else None
        if own is None and at is not None:
            own = whitener_at(part, at)
        linear = linearise(part, x, own)
        sums = normal(replace(linear, epoch=linear.epoch - first), last - first)
        total = sums if total is None else total + sums
    assert total is not None
    return total

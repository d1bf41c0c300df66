"""The normal equations of a run, summed over its epochs in windows."""

from __future__ import annotations

from dataclasses import replace
from math import prod

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.kernels.jit import enabled, may_use_code
from optloc.kernels.pack import Packed, PackedRuns, folding, pack, pack_runs
from optloc.linear.evaluate import checked_vectors
from optloc.linear.normal import Normal, depends_on_place, linearise, normal, total, whitener_at, with_priors
from optloc.linear.walks import walks
from optloc.problem.epochs import windows
from optloc.problem.noise import Whitener
from optloc.problem.problem import Problem

# Greatest number of rows of a problem for which machine code is used: the tables of longer problems would need memory
# that grows with the run. Runs of equal epochs have no limit.
_LONGEST = 2**13


def equations_at(
    problem: Problem, x: Array, noise: tuple[Whitener, ...] | None = None, *, at: Array | None = None
) -> Normal:
    """Return the normal equations of a batch of problems, including priors.

    Beyond the measurements, the working memory does not depend on the number of epochs: only sums are stored, and the
    blocks of epochs that have local unknowns.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size)
        Parameter vectors.
    noise : tuple of Whitener, optional
        Whitening matrices of all rows, used if the run is one window; by default computed from the problem.
    at : array (..., size), optional
        Vectors at which station errors of span "noise" are converted to noise; by default `x`.
    """
    return with_priors(problem, x, summed(problem, x, noise, at=at))


def summed(problem: Problem, x: Array, noise: tuple[Whitener, ...] | None = None, *, at: Array | None = None) -> Normal:
    """Return the normal equations of the measurements without priors; see `equations_at` for the arguments."""
    if x.shape[-1] == 0:
        raise InvalidProblem("nothing is unknown: the motion of every target is known", "motions", "give a bias")
    quick = _by_machine_code(problem, checked_vectors(problem, x), noise) if at is None else None
    if quick is not None:
        return quick
    parts = []
    for first, last, part in windows(problem, x.size // x.shape[-1]):
        own = noise if last - first == problem.epochs else None
        if own is None and at is not None:
            own = whitener_at(part, at)
        linear = linearise(part, x, own)
        parts.append(normal(replace(linear, epoch=linear.epoch - first), last - first))
    return total(parts)


def _by_machine_code(problem: Problem, x: Array, noise: tuple[Whitener, ...] | None) -> Normal | None:
    """Return the normal equations computed by machine code, or None if machine code does not support the problem.

    See `summed` for the arguments. The result is also None if the leading axes of x do not belong to the problems.
    """
    count, shape = x.size // x.shape[-1], x.shape[:-1]
    # one vector for each problem, or several vectors for each problem
    alike = problem.batch_shape in {(), (1,), (count,)} if x.ndim == 2 else problem.batch_shape == shape[-1:]
    if not alike or not serves(problem, count) or (noise is None and depends_on_place(problem)):
        return None
    found = packed(problem, whitener_at(problem, x) if noise is None else noise)
    if found is None:
        return None
    # the last leading axis of x counts the problems, so that successive vectors belong to successive problems
    sums = sums_at(found, x.reshape(count, x.shape[-1]), np.arange(count) % max(1, *problem.batch_shape, 1))
    if x.ndim == 2:
        return sums
    return Normal(*(part.reshape((*shape, *part.shape[1:])) for part in sums.parts))


def packed(problem: Problem, noise: tuple[Whitener, ...]) -> Packed | PackedRuns | None:
    """Return problems in the form for machine code, or None if machine code does not support them.

    See `pack` for the arguments.
    """
    runs = pack_runs(problem, noise) if is_run(problem) else None
    return pack(problem, noise) if runs is None and problem.count <= _LONGEST else runs


def sums_at(found: Packed | PackedRuns, x: Array, item: Array, *, priors: bool = False) -> Normal:
    """Return the normal equations at vectors x (M, size), computed by machine code from the problems `found`.

    `item` (M,) is the problem of each vector.
    """
    from optloc.kernels.equations import normal_at
    from optloc.kernels.runs import sums_of_runs

    if isinstance(found, PackedRuns):
        return sums_of_runs(found, x, item, priors=priors)
    return normal_at(found, x, item, priors=priors)


def is_run(problem: Problem) -> bool:
    """Return whether problems have several epochs with local unknowns."""
    return problem.epochs > 1 and problem.layout.n_local > 0


def serves(problem: Problem, starts: int) -> bool:
    """Return whether machine code supports a problem, and exists or may be compiled, for `starts` vectors."""
    # the kernels have no code for fences
    if not starts or not enabled() or walks(problem) or problem.fences:
        return False
    from optloc.kernels.equations import normal_block
    from optloc.kernels.refine import refine_block
    from optloc.kernels.runs import refine_runs, sum_runs

    count = prod(problem.batch_shape)
    if is_run(problem) and folding(problem) is not None:
        return all(may_use_code(kernel, count * problem.epochs) for kernel in (sum_runs, refine_runs))
    return problem.count <= _LONGEST and all(may_use_code(kernel, count) for kernel in (normal_block, refine_block))

"""Refinements of many starts spread over threads, by the kernel that serves the problem."""

from __future__ import annotations

import numpy as np

from optloc.kernels.equations import chunks, normal_at
from optloc.kernels.pack import Packed
from optloc.kernels.refine import Answers, Rules, answers, refine_block
from optloc.kernels.runs import LEFT_OPEN, refine_runs
from optloc.normal import Normal
from optloc.threads import mapped
from optloc.types import Array


def refined(packed: Packed, item: Array, start: Array, rules: Rules) -> tuple[Answers, Array]:
    """Return where the refinements of starts (M, size) of given problems end, and where numpy must take over, (M,).

    Parameters
    ----------
    packed : Packed
        N problems.
    item : int64 array (M,)
        Problem of each start.
    start : array (M, size)
        Starting vectors.
    rules : Rules
        When to stop.
    """
    of_epochs = packed.tables.local > 0 and packed.tables.epochs > 1
    out, kernel = answers(start, 0 if of_epochs else None), refine_runs if of_epochs else refine_block
    mapped(lambda part: kernel(packed, item, part[0], part[1], rules, out), chunks(len(start)))
    return out, np.asarray(out.status == LEFT_OPEN)


def equations(packed: Packed, item: Array, done: Answers) -> Normal:
    """Return the normal equations at the answers."""
    n, matrix, vector = packed.tables.shared, done.matrix, done.vector
    if matrix.shape[-1] == 0:
        return normal_at(packed, done.x, item, priors=True)
    return Normal(
        matrix[:, :n, :n],
        matrix[:, None, n:, n:],
        matrix[:, None, :n, n:],
        vector[:, :n],
        vector[:, None, n:],
        done.cost,
    )

"""An exact height as a row of every scan, so that updates hold it as starts do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.errors import InvalidProblem
from optloc.noise import Block, Noise
from optloc.problem import Problem
from optloc.types import Band, Rows

# Metres: below every other error; of ECEF coordinates a millimetre has too few digits to converge on.
_EXACT = 1e-2


def with_height_rows(problem: Problem) -> Problem:
    """Return a run whose exact height, if it has one, is measured at every epoch within a centimetre.

    Bounds stay: they tell starts apart. Epochs without rows stay without.

    Parameters
    ----------
    problem : Problem
        A run of one target.

    Raises
    ------
    InvalidProblem
        For an equality other than that of the height: updates would not hold it.
    """
    exact = [c for c in problem.constraints if isinstance(c, Band) and np.array_equal(c.lower, c.upper)]
    if not exact:
        return problem
    other = next((c for c in exact if c.kind != "height"), None)
    if other is not None:
        advice = "give bounds, or solve the run as one problem"
        raise InvalidProblem(f"the constraint {other.name!r} is an equality", "track", advice)
    heard = np.unique(problem.epoch[problem.weight > 0.0])
    m, none = len(heard), np.full(len(heard), -1)
    z = np.broadcast_to(exact[0].lower, (m,))
    rows = Rows("height", z, none, none, heard, np.zeros_like(heard), np.ones(m), np.zeros(m))
    block = Block(problem.count + np.arange(m)[:, None], np.full((1, 1, 1), _EXACT**2))
    kept = tuple(c for c in problem.constraints if not any(c is e for e in exact))
    return replace(problem, rows=(*problem.rows, rows), noise=Noise((*problem.noise.blocks, block)), constraints=kept)

"""Where iterations from many starts end: reached, at another minimum, or nowhere."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from optloc.errors import InvalidProblem
from optloc.fix import Fix
from optloc.problem import Problem
from optloc.solve.refine import refine
from optloc.solve.start import vectors
from optloc.status import Status
from optloc.types import Array

_SAME = 0.1
ITERATIONS = {"taylor": False, "lsr": True}
"""Iterations from a guess, and whether their steps are damped."""


class End(IntEnum):
    """How an iteration ended."""

    REACHED = 0
    ELSEWHERE = 1
    NOWHERE = 2


@dataclass(frozen=True, slots=True)
class Basins:
    """Where a method leads from many starts.

    Parameters
    ----------
    method : str
        A key of `ITERATIONS`.
    ends : int array (...)
        `End` of each start: the fix was reached, another stationary point was, or the iteration ran away, circled or
        stopped where the geometry is singular.
    """

    method: str
    ends: Array

    def share(self, end: End) -> float:
        """Return the share of starts that ended in one way."""
        return float((self.ends == end).mean())


def basins(problem: Problem, fix: Fix, places: Array, method: str = "taylor") -> Basins:
    """Return where iterations from given places end.

    A start is a position; emission times begin at what fits it, everything else at its prior mean or zero.

    Parameters
    ----------
    problem : Problem
        A single problem with one target that stands for the run.
    fix : Fix
        Its fix: what should be reached, to a tenth of a standard deviation.
    places : array (..., d)
        Starting positions, metres.
    method : str
        "taylor" for the plain undamped iteration, or "lsr" for damped least squares.

    Raises
    ------
    InvalidProblem
        For another method, or a fix without an answer.

    References
    ----------
    W. H. Foy, "Position-location solutions by Taylor-series estimation", IEEE Trans. Aerosp. Electron. Syst. 12
    (1976) 187-194.
    """
    if method not in ITERATIONS:
        raise InvalidProblem(f"unknown iteration {method!r}", "method", f"use one of {', '.join(ITERATIONS)}")
    if not np.isfinite(fix.x).all() or not np.isfinite(fix.cov).all():
        raise InvalidProblem("there is no fix that a start could reach", "fix", "see its status for the reason")
    flat = problem.flat()
    starts = vectors(flat, places.reshape(1, -1, places.shape[-1]))[0]
    done = refine(flat, starts, item=np.zeros(len(starts), dtype=int), damped=ITERATIONS[method])
    target, answer = flat.layout.find("position")[0], fix.flat()
    part = slice(target.start, target.start + target.size)
    precision = np.linalg.inv(answer.cov[0, part, part])
    with np.errstate(all="ignore"):
        apart = done.x[:, part] - answer.x[0, part]
        near = np.einsum("ni,ij,nj->n", apart, precision, apart) < _SAME**2
    ok = done.status == Status.OK
    ends = np.where(ok & near, End.REACHED, np.where(ok, End.ELSEWHERE, End.NOWHERE))
    return Basins(method, ends.reshape(places.shape[:-1]))

"""The cost of a problem over the place of its target, everything else at the values that fit best."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Band, Status
from optloc.kernels.least_squares import refine
from optloc.linear.constraints import exact
from optloc.linear.vectors import vectors
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem

# Steps at most: places far from any fit take their time, most others a dozen.
_STEPS = 100
# Length of the last step, standard deviations: it changes the cost by far less than a contour or colour shows.
_SETTLED = 1e-4
# Standard deviations within which an iteration has reached a fix.
_SAME = 0.1


def profile_cost(problem: Problem, x: Array, places: Array, held: Array) -> Array:
    """Return the profile of the maximum-likelihood cost over places.

    Coordinates of the position that are not held, velocities, biases and the unknowns of single epochs take, by damped
    Gauss-Newton steps from `x`, the values that fit best at each place.

    Parameters
    ----------
    problem : Problem
        A flat batch of one problem with one target that is sought.
    x : array (size,)
        Parameter vector that the search for the others begins at, for instance that of a fix.
    places : array (N, d)
        Positions, metres.
    held : array (c, d)
        Directions along which the position stays at its place, such as east and north.

    Returns
    -------
    array (N,)
        Weighted sum of squared residuals and prior penalties.

    References
    ----------
    S. A. Murphy and A. W. van der Vaart, "On profile likelihood", J. Am. Stat. Assoc. 95 (2000) 449-465.
    """
    layout = problem.layout
    slot, _ = layout.find("position")
    vectors = np.tile(np.asarray(x, dtype=float), (len(places), 1))
    vectors[:, slot.start : slot.start + slot.size] = places
    many = problem.take(np.zeros(len(places), dtype=int))
    planes = tuple(Band("plane", at, at, axis, "place") for axis, at in zip(held, held @ places.T, strict=True))
    many = replace(many, constraints=planes)
    return refine(many, vectors, tolerance=_SETTLED, limit=_STEPS, face=exact(many)).cost


# Where iterations from many starts end: reached, at another minimum, or nowhere.

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

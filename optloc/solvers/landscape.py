"""The cost of a problem as a function of the position, and the basins of attraction of iterations.

A basin is the set of starts from which an iteration reaches the fix. Pictures show both.
"""

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

# Most steps: positions far from every fix take many, most others a dozen.
_STEPS = 100
# Length of the last step, standard deviations: its effect on the cost is far below a contour or a colour.
_SETTLED = 1e-4
# Distance in standard deviations within which an iteration has reached a fix.
_SAME = 0.1


def profile_cost(problem: Problem, x: Array, places: Array, held: Array) -> Array:
    """Return the profile of the maximum-likelihood cost over positions.

    The other unknowns are velocities, biases, unknowns of single epochs, and coordinates that are not fixed. At each
    position they take their best values, by damped Gauss-Newton steps from `x`.

    Parameters
    ----------
    problem : Problem
        A flat batch of one problem with one unknown target.
    x : array (size,)
        Parameter vector that starts the search for the other unknowns, for instance a fix.
    places : array (N, d)
        Positions, metres.
    held : array (c, d)
        Directions along which the position is fixed, such as east and north.

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


# Ends of iterations from many starts: the fix, another minimum, or no minimum.

ITERATIONS = {"taylor": False, "lsr": True}
"""Iterations from a start, and whether their steps are damped."""


class End(IntEnum):
    """The way in which an iteration ended: at the fix, at another minimum, or at no minimum."""

    REACHED = 0
    ELSEWHERE = 1
    NOWHERE = 2


@dataclass(frozen=True, slots=True)
class Basins:
    """Results of an iteration from many starts: which starts reach the fix.

    Parameters
    ----------
    method : str
        A key of `ITERATIONS`.
    ends : int array (...)
        `End` of each start: at the fix, at another stationary point, or at no point. "No point" means that the
        iteration ran to infinity, circled, or stopped at a singular geometry.
    """

    method: str
    ends: Array

    def share(self, end: End) -> float:
        """Return the share of starts, 0 to 1, with a given end."""
        return float((self.ends == end).mean())


def basins(problem: Problem, fix: Fix, places: Array, method: str = "taylor") -> Basins:
    """Return the ends of iterations from given positions.

    A start is a position. Emission times start at the values that fit it, other unknowns at their prior mean or zero.

    Parameters
    ----------
    problem : Problem
        A single problem with one target whose state lasts the run.
    fix : Fix
        Its fix, which an iteration reaches if it ends within a tenth of a standard deviation.
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
        raise InvalidProblem("there is no fix for a start to reach", "fix", "see its status for the reason")
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

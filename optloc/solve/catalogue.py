"""What a method can be made of: one line for each solver stage and for each formulation behind it."""

from __future__ import annotations

from dataclasses import dataclass

from optloc.errors import InvalidProblem, nearest
from optloc.fix import Fix
from optloc.problem import Problem
from optloc.solve import stages
from optloc.solve.stages import Solver


def _nlp(problem: Problem, fix: Fix | None) -> Fix:
    from optloc.solve.nlp import nlp  # IPOPT is loaded when it is used

    return nlp(problem, fix)


@dataclass(frozen=True, slots=True)
class Entry:
    """A solver stage.

    Parameters
    ----------
    solver : callable
        ``(problem, fix or None) -> fix``.
    summary : str
        One line for listings.
    role : "start" or "refinement"
        Whether it needs no fix before it, or improves one.
    """

    solver: Solver
    summary: str
    role: str


@dataclass(frozen=True, slots=True)
class Formulation:
    """An optimisation problem of the package `formulations`.

    Parameters
    ----------
    summary : str
        What it minimises.
    kinds : str
        Measurement kinds it serves.
    tight : str
        How good its answer is.
    cost : str
        Typical time for one fix.
    source : str
        Publication.
    """

    summary: str
    kinds: str
    tight: str
    cost: str
    source: str


SOLVERS: dict[str, Entry] = {
    "gtrs": Entry(stages.gtrs, "minimiser of the weighted squared-range problem: the cheapest start", "start"),
    "roots": Entry(stages.roots, "every stationary point of the squared-range problem", "start"),
    "sdp": Entry(stages.sdp, "Shor's semidefinite relaxation of the squared-range problem (Clarabel)", "start"),
    "socp": Entry(stages.socp, "second-order cone relaxation of the squared-range problem (Clarabel)", "start"),
    "wiv": Entry(stages.wiv, "pseudo-linear angles with an instrumental-variable pass", "start"),
    "directions": Entry(stages.directions, "semidefinite relaxation over unit directions (Clarabel); angles", "start"),
    "minimax": Entry(stages.minimax, "least worst angle by second-order cones (Clarabel); bounded errors", "start"),
    "widen": Entry(stages.widen, "more candidates beside a fix: mirror image, sub-arrays", "refinement"),
    "search": Entry(
        stages.search, "a seeded search from many places for problems still without an answer", "refinement"
    ),
    "lsr": Entry(stages.lsr, "damped Taylor least squares (Gauss-Newton) from every candidate", "refinement"),
    "nlp": Entry(_nlp, "the maximum-likelihood cost by IPOPT from every candidate", "refinement"),
    "certify": Entry(stages.certify, "compares the cost of an angle fix with a bound over all positions", "refinement"),
    "taylor": Entry(stages.taylor, "plain undamped Taylor iteration; a baseline, it diverges", "refinement"),
}

METHODS = {"auto": "roots+lsr+widen+lsr+search", "proven": "roots+lsr+widen+lsr+search+certify"}

_RANGES = "range, toa, tdoa, range_sum; azimuth, elevation and groa rows linear in (x, r)"

FORMULATIONS: dict[str, Formulation] = {
    "squared_range": Formulation(
        "squared-range least squares with one quadratic constraint (GTRS), all stationary points",
        _RANGES,
        "exact for its own cost; second weighting close to maximum likelihood",
        "2 us the minimiser, 12 us all points",
        "More 1993; Beck, Stoica, Li 2008",
    ),
    "squared_range_conic: shor": Formulation(
        "semidefinite twin of the same problem", _RANGES, "rank one, equal to the GTRS", "0.5 ms", "Shor 1987"
    ),
    "squared_range_conic: hull": Formulation(
        "second-order cone relaxation |x| <= r of the same problem",
        _RANGES,
        "a lower bound; tight where the linear fit violates |x| <= r, about half of all TDOA cases",
        "0.2 ms",
        "convex hull of the cone",
    ),
    "nls": Formulation(
        "weighted nonlinear least squares with bounds, equalities and inequalities (IPOPT)",
        "all",
        "a local minimum",
        "2 ms",
        "Waechter, Biegler 2006",
    ),
}


def stages_of(method: str) -> list[Entry]:
    """Return the stages of a method such as "auto" or "gtrs+lsr"; raise InvalidProblem naming an unknown one."""
    names = METHODS.get(method, method).split("+")
    for name in names:
        if name not in SOLVERS:
            advice = nearest(name, [*METHODS, *SOLVERS])
            raise InvalidProblem(f"unknown method {name!r}", "method", advice)
    return [SOLVERS[name] for name in names]

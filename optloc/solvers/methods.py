"""What a method can be made of: one line for each solver stage and for each formulation behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from formulations.backend import Choice, Kind, counting, using
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.registry import Table
from optloc.base.status import Status
from optloc.base.types import Array
from optloc.problem.fix import Fix, Stage
from optloc.problem.problem import Problem
from optloc.proof.scope import unsupported
from optloc.solvers import stages
from optloc.solvers.certify.branch_and_bound import certified, value_certified
from optloc.solvers.certify.relaxations import by_reference
from optloc.solvers.policy import LISTED_GAP
from optloc.solvers.pool import merged, packed, pooled, unrefined
from optloc.solvers.range_fixes import shortened
from optloc.solvers.robust.stage import STAGES as ROBUST
from optloc.solvers.sparse import sparse
from optloc.solvers.stages import Solver
from optloc.solvers.suspects.stage import suspected

# Ways one after the other: the next is taken for the problems of which the one before leaves something to prove.

# More candidates change nothing about these.
_SETTLED = (Status.REJECTED, Status.TOO_FEW_ROWS)


def first_that_proves(branches: Sequence[Sequence[Solver]]) -> Solver:
    """Return the solver that takes the first branch, and each further one for what is not proven by then.

    What the earlier branches found competes in the later ones. Problems beyond the scope of the proof take the last
    branch alone.

    Parameters
    ----------
    branches : sequence of sequences of solvers
        Each ends with a proof.
    """

    def solver(problem: Problem, fix: Fix | None) -> Fix:
        taken = branches[-1:] if unsupported(problem) else branches
        for branch in taken:
            fix = _next(problem, fix, branch)
        assert fix is not None
        return fix

    return solver


def unproven(fix: Fix) -> Array:
    """Return which fixes (N,) could still change: no proof that all minima within the listed gap are known."""
    sure = [c.proof == "global" and c.margin >= LISTED_GAP for c in fix.certificate]
    return np.asarray(~np.array(sure, dtype=bool) & ~np.isin(fix.code, _SETTLED))


def _next(problem: Problem, fix: Fix | None, branch: Sequence[Solver]) -> Fix:
    if fix is None or not fix.stages or fix.stages[-1].name != "certify":
        for stage in branch:
            fix = stage(problem, fix)
        assert fix is not None
        return fix
    items = np.flatnonzero(unproven(fix))
    if not len(items):
        return fix
    part, own = problem.take(items), fix[items]
    new = _beside(part, branch[0](part, None), own)
    for stage in branch[1:]:
        new = stage(part, new)
    joint = merged(fix, items, new, Stage("", "", 0.0))
    return replace(joint, stages=(*fix.stages, *new.stages))


def _beside(problem: Problem, start: Fix, fix: Fix) -> Fix:
    """Return starts with what an earlier branch found beside them."""
    pool = packed(np.concatenate([pooled(start)[0], pooled(fix)[0]], axis=1))
    return replace(unrefined(problem, pool, None, "", perf_counter()), stages=start.stages)


def _nlp(problem: Problem, fix: Fix | None) -> Fix:
    from optloc.solvers.ipopt import nlp  # IPOPT is loaded when it is used

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


_STAGES: dict[str, Entry] = {
    "gtrs": Entry(stages.gtrs, "minimiser of the weighted squared-range problem: the cheapest start", "start"),
    "roots": Entry(stages.roots, "every stationary point of the squared-range problem", "start"),
    "sdp": Entry(stages.sdp, "Shor's semidefinite relaxation of the squared-range problem (Clarabel)", "start"),
    "socp": Entry(stages.socp, "second-order cone relaxation of the squared-range problem (Clarabel)", "start"),
    "sparse": Entry(
        sparse, "convex start in which a few rows are grossly wrong, and the fix without them (Clarabel)", "start"
    ),
    "wiv": Entry(stages.wiv, "pseudo-linear angles with an instrumental-variable pass", "start"),
    "directions": Entry(stages.directions, "semidefinite relaxation over unit directions (Clarabel); angles", "start"),
    "minimax": Entry(stages.minimax, "least worst angle by second-order cones (Clarabel); bounded errors", "start"),
    "widen": Entry(stages.widen, "more candidates beside a fix: mirror image, sub-arrays", "refinement"),
    "search": Entry(
        stages.search, "a seeded search from many places for problems still without an answer", "refinement"
    ),
    "lsr": Entry(stages.lsr, "damped Taylor least squares (Gauss-Newton) from every candidate", "refinement"),
    "nlp": Entry(_nlp, "the maximum-likelihood cost by IPOPT from every candidate", "refinement"),
    "certify": Entry(
        certified, "branch and bound: no position costs less, and no other minimum comes near", "refinement"
    ),
    "value": Entry(value_certified, "the same for the cost alone, without other minima: quicker", "refinement"),
    "bound": Entry(
        by_reference, "compares the cost with the bound of a relaxation (Clarabel): angles, ranges", "refinement"
    ),
    "suspects": Entry(
        suspected, "leaves out the stations, rows and priors that contradict the rest, and names them", "refinement"
    ),
    "taylor": Entry(stages.taylor, "plain undamped Taylor iteration; a baseline, it diverges", "refinement"),
    "huber": Entry(ROBUST["huber"], "Huber's convex loss: gross errors pull no harder than 1.3 sigma", "start"),
    "cauchy": Entry(ROBUST["cauchy"], "Cauchy's loss: the larger an error the less it pulls", "start"),
    "truncated": Entry(ROBUST["truncated"], "least squares without the rows that are 3.4 sigma off", "start"),
    "late": Entry(ROBUST["late"], "doubts ranges and arrivals that are too long: blocked paths", "start"),
}
SOLVERS: Table[Entry] = Table("optloc.solvers", lambda value: isinstance(value, Entry), _STAGES)

# Machine code takes time to load, more than the stages take for fewer problems.
WORTH = 16
# What stands behind "|" is for the problems of which not everything is proven by then.
METHODS = {
    "auto": "gtrs+lsr+certify|roots+lsr+widen+lsr+search+certify",
    "searched": "roots+lsr+widen+lsr+search",
    "proven": "roots+lsr+widen+lsr+search+bound",
    "robust": "roots+lsr+widen+lsr+search+suspects",
}

_RANGES = "range, toa, tdoa, range_sum; azimuth, elevation and groa rows linear in (x, r)"

_PROGRAMS: dict[str, Formulation] = {
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
    "sparse_errors": Formulation(
        "linear rows with gross errors of a few, priced by the sum of their sizes, on the cones of the ranges",
        _RANGES,
        "convex, not exact: a start and a guess of the wrong rows; from about 20 stations both are good",
        "1 ms",
        "Donoho, Johnstone 1994; Yuan, Lin 2006; She, Owen 2011",
    ),
    "range_height": Formulation(
        "ranges known up to one unknown meet an ellipsoid: a quartic, with horizon",
        "tdoa, toa, range_sum with a known height",
        "exact: all points that fit",
        "0.1 ms",
        "Ho, Chan 1997, exact for the ellipsoid",
    ),
    "range_height_conic": Formulation(
        "3 x 3 lift after elimination of the range differences, nearest to the point below the satellites",
        "two differences and a height",
        "rank one within 25 degrees of the point below",
        "1 ms",
        "Shor 1987",
    ),
    "bearing_ls": Formulation(
        "pseudo-linear least squares of angles, weighted, with an instrumental-variable pass",
        "azimuth, elevation",
        "asymptotically unbiased; as good as maximum likelihood to 0.1 %",
        "30 us",
        "Dogancay 2006, 2015",
    ),
    "bearing_course": Formulation(
        "the same for a target on a polynomial course, over all epochs at once; one station that turns may do",
        "azimuth, elevation of a moving target",
        "asymptotically unbiased; as good as maximum likelihood to 0.1 %",
        "0.5 ms for 100 angles",
        "Dogancay 2006, 2015",
    ),
    "direction_sdp": Formulation(
        "unknown unit directions that meet in a point, lifted; with a minorant a bound of the angular cost",
        "azimuth and elevation",
        "100 % to 20 mrad, 98 % at 50 mrad",
        "2 ms two stations, 10 ms four",
        "epipolar equalities; Shor 1987",
    ),
    "moment_sdp": Formulation(
        "order-2 moments of position and range errors in a box: a lower bound of the likelihood's cost",
        "range, toa, tdoa, range_sum",
        "89-100 % to 30 m",
        "50 ms five stations, 100 ms six",
        "Lasserre 2001",
    ),
    "minimax_cone": Formulation(
        "least worst angle by bisection over second-order cones; proves that bounds contradict each other",
        "azimuth, elevation with bounded errors",
        "exact for its own cost",
        "10 ms",
        "Kahl, Hartley 2008",
    ),
    "bistatic": Formulation(
        "closed-form range of one receiver and one illuminator; polynomial course of several epochs",
        "range_sum with azimuth and elevation",
        "exact without noise",
        "50 us",
        "Skolnik 1961",
    ),
    "registration": Formulation(
        "place, course and biases of a run: reference ranges projected out, then tied to the lifted course",
        "tdoa, toa, range_sum of moving stations or a moving target",
        "exact without noise; with noise a start near the bound",
        "0.3 ms",
        "Chan, Ho 1994; Beck, Stoica, Li 2008",
    ),
    "registration_sdp": Formulation(
        "the same lifted with its reference ranges; price on the trace, prior on the biases",
        "tdoa, toa of moving stations",
        "never tight: a start",
        "1 s",
        "Shor 1987",
    ),
    "lifted": Formulation(
        "order-1 lift [1, x, r]: a baseline for studies, never a default",
        "tdoa, range",
        "never for tdoa: its optimum is zero for any data",
        "2 ms",
        "Shor 1987",
    ),
    "nls": Formulation(
        "weighted nonlinear least squares with bounds, equalities and inequalities (IPOPT)",
        "all",
        "a local minimum",
        "2 ms",
        "Waechter, Biegler 2006",
    ),
}

FORMULATIONS: Table[Formulation] = Table("optloc.formulations", lambda value: isinstance(value, Formulation), _PROGRAMS)


def stages_of(method: str) -> list[Entry]:
    """Return the stages of a method such as "auto" or "gtrs+lsr"; raise InvalidProblem naming an unknown one.

    Branches joined by "|" become one stage, which takes the second where the first leaves something to prove.
    """
    branches = branches_of(method)
    if len(branches) == 1:
        return branches[0]
    solver = first_that_proves([shortened([entry.solver for entry in branch], WORTH) for branch in branches])
    return [Entry(solver, METHODS.get(method, method), branches[0][0].role)]


def branches_of(method: str) -> list[list[Entry]]:
    """Return the stages of each branch of a method; raise InvalidProblem naming an unknown one."""
    return [[_named(name) for name in branch.split("+")] for branch in METHODS.get(method, method).split("|")]


def _named(name: str) -> Entry:
    if name not in SOLVERS:
        raise InvalidProblem(f"unknown method {name!r}", "method", nearest(name, [*METHODS, *SOLVERS]))
    return SOLVERS[name]


# The back end that holds for a stretch of code, for floors above: see `formulations.backend`.

__all__ = ["Choice", "Kind", "counting", "using"]

"""What stands against a finished answer: the definition of `ok`, for every method."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from optloc.adequacy.shape import BENT, cost_at_infinity, departure
from optloc.base.linalg import centre_and_spread, centre_of_points
from optloc.base.records import present, take
from optloc.base.types import Array, Certificate, Status
from optloc.linear.constraints import faces
from optloc.linear.redundancy import largest
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE, Chart, quantile
from optloc.problem.claims import GLOBAL, Claims, claim
from optloc.problem.fix import tail_probability
from optloc.problem.problem import Problem
from optloc.solvers.policy import AMBIGUOUS_GAP, COVERED, DOUBT, NOTICED, REFUTED
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.starts.position import one_position, rows_of_stations

NO_PROOF = claim(
    Certificate(
        "local",
        "a stationary point with a positive definite normal matrix; the best of all candidates refined",
        "refinement",
    )
)
"""The claim of a refined answer of which nobody has tried to prove more."""
NO_ANSWER = claim(Certificate("unknown", "there is no refined answer to prove anything about", "none"))
"""The claim where there is none."""
NOT_TRIED = "no proof was tried"
BENT_SENTENCE = {
    INVERSE_RANGE: "Gaussian in inverse range, not in metres",
    CURVED: "Gaussian neither in metres nor in inverse range",
}
"""What is said of a fix that is `curved`, by the kind of its chart."""
_MISFIT, _UNBOUNDED, _AMBIGUOUS = Status.MISFIT.mark, Status.UNBOUNDED.mark, Status.AMBIGUOUS.mark
_UNPROVEN, _CURVED = Status.UNPROVEN.mark, Status.CURVED.mark
_ALIKE = 1e-3  # gaps below this are told as "fits as well": a reader gains nothing from more zeros
# Gaps to infinity below this come from rounding: the fix itself is as far away as counts.
_NONE = 1e-6


def mark(problem: Problem, pool: Pool, gap: Array) -> Array:
    """Return the marks (N,) of all that stands against settled answers that are finished; zero where nothing does.

    An answer is `ok` where the data do not reject the model, no other minimum within `AMBIGUOUS_GAP` is left (which is
    proven), infinity lies outside the likelihood region, and the covariance covers.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Settled; what has not been looked at stands against nothing, but for a proof of uniqueness.
    gap : array (N, r)
        Costs of the other minima less that of the best; infinite where there is none.
    """
    cost, kappa = pool.cost[:, 0], None if pool.curvature is None else pool.curvature.kappa
    with np.errstate(invalid="ignore"):
        marks: Array = marks_of(
            # a loss bears gross errors: their cost refutes nothing
            np.zeros(len(pool), dtype=bool) if pool.loss else is_improbable(cost, pool.dof, REFUTED),
            np.nan if pool.infinity is None else pool.infinity - cost,
            quantile(COVERED, problem.dimension),
            gap.min(1, initial=np.inf),
            np.nan if kappa is None else kappa[:, 0],
            _is_unique(pool),
        ).astype(np.int32)
    if pool.refuted:
        marks |= Status.MISFIT.mark
    if pool.searched is not None:
        # a proof makes up for the start that was not safe
        unsure = pool.searched & (marks & Status.UNPROVEN.mark != 0)
        marks[unsure] ^= Status.UNPROVEN.mark | Status.SEARCHED.mark
    if pool.asked:  # without redundancy a search for suspects sees nothing, and with one it cannot tell who it is
        blind = (pool.dof <= 0) | ((pool.dof == 1) & is_improbable(cost, pool.dof, NOTICED))
        marks[blind & (marks & Status.SEARCHED.mark == 0)] |= Status.UNPROVEN.mark
    return marks


def marks_of(improbable: Any, infinity: Any, region: float, gap: Any, kappa: Any, unique: Any) -> Any:
    """Return the marks of what numbers say against one finished answer, or against many (N,); NaN says nothing.

    Parameters
    ----------
    improbable : bool
        Whether noise so rarely makes such a cost that the model is refuted.
    infinity, region : float
        Least cost at infinity less that of the answer, and by how much costs in the likelihood region exceed it.
    gap : float
        Cost of the cheapest other minimum less that of the answer.
    kappa : float
        Departure from a Gaussian in metres, see `optloc.solvers.pool.Curvature`.
    unique : bool
        As of `is_proof_of_one`.
    """
    # operators alone, so that numbers and arrays take the same rules
    return (
        (improbable * _MISFIT)
        | ((infinity <= region) * _UNBOUNDED)
        | ((gap < AMBIGUOUS_GAP) * _AMBIGUOUS)
        | ((unique ^ True) * _UNPROVEN)
        | ((kappa > BENT) * _CURVED)
    )


def is_improbable(cost: Array, dof: Array, probability: float) -> Array:
    """Return where costs (N,) are so large that noise makes them with less than a probability, (N,)."""
    # often one number for all, as a view without strides
    if dof.strides == (0,):
        return np.asarray(cost > largest(int(dof[0]) if len(dof) else 0, probability))
    out = np.zeros(len(cost), dtype=bool)
    for level in np.unique(dof[dof > 0]):
        out |= (dof == level) & (cost > largest(int(level), probability))
    return out


def _is_unique(pool: Pool) -> Array:
    """Return where it is proven that no other minimum than those listed costs less than the gap more, (N,)."""
    if pool.proven is None or pool.loss:  # what is proven of squares is not of a loss
        return np.zeros(len(pool), dtype=bool)
    between = np.zeros(len(pool)) if pool.infinity is None else pool.infinity - pool.cost[:, 0]
    return is_proof_of_one(pool.proven, between)


def is_proof_of_one(told: Claims, infinity: Array) -> Array:
    """Return whether claims (...) say that no other minimum than those listed costs less than the gap more.

    Where infinity, which costs so much more, comes before the gap, up to there: what lies beyond is infinity's.
    """
    wide = (told.margin >= AMBIGUOUS_GAP) | ((infinity > 0.0) & (infinity < AMBIGUOUS_GAP))
    return np.asarray(told.unique & ((told.proof == GLOBAL) | told.asked) & wide)


def examine(problem: Problem, pool: Pool) -> Pool:
    """Return a settled pool with the shape of the likelihood about its best candidates, and what infinity costs.

    Parameters
    ----------
    problem : Problem
        N problems; those that share a position are looked at, and infinity for those of nothing but one.
    pool : Pool
        What was measured before is kept.
    """
    curvature = pool.curvature
    if curvature is None or not problem.layout.shares("position"):
        return pool
    good = (pool.code[:, 0] == Status.OK) & np.isfinite(pool.x[:, 0]).all(-1)
    good &= np.isfinite(curvature.covariance).all((-1, -2))
    if pool.conclusion is not None:
        good &= ~present(pool.conclusion)  # not all rows count there, and its fix was examined where it was made
    kappa = np.full((len(pool), 2), np.nan) if curvature.kappa is None else np.array(curvature.kappa)
    unseen = np.isnan(kappa[:, 0])
    new = np.flatnonzero(good & unseen)
    if len(new):
        kappa[new] = _departure(problem.take(new), take(pool, new))
    pool = replace(pool, curvature=replace(curvature, kappa=kappa))
    # far away a velocity may grow with the range: no least cost is left to compute
    if pool.loss or not one_position(problem) or problem.motions[0].order:
        return pool
    return replace(pool, infinity=_infinity(problem, pool, good & _is_bent(pool), unseen))


def _departure(problem: Problem, pool: Pool) -> Array:
    """Return by how much the cost departs from a Gaussian's, (N, 2)."""
    assert pool.curvature is not None
    if pool.loss:
        problem = problem.with_rows(weight=pool.weights)
    x, covariance, centre = pool.x[:, 0], pool.curvature.covariance, centre_of(problem)
    centre = np.broadcast_to(centre, (len(x), centre.shape[-1]))
    sides = faces(problem) if problem.constraints else [()]
    out = np.empty((len(x), 2))
    for number in np.unique(pool.face[:, 0]):
        items = np.flatnonzero(pool.face[:, 0] == number)
        out[items] = departure(problem.take(items), x[items], covariance[items], sides[number], centre[items])
    return out


def _is_bent(pool: Pool) -> Array:
    """Return where infinity has to be looked at, (N,): where the fix is not Gaussian in metres.

    Of 8 233 fixes that are Gaussian in metres none had infinity in its region; and where another direction has it, no
    proof of uniqueness comes to an end, so that the fix is not ok either way.
    """
    assert pool.curvature is not None
    assert pool.curvature.kappa is not None
    return np.asarray(~(pool.curvature.kappa[:, 0] <= BENT))


def _infinity(problem: Problem, pool: Pool, wanted: Array, unseen: Array) -> Array:
    """Return the least costs (N,) of infinity: those known from runs there, and where wanted all directions tried."""
    known = np.full(len(pool), np.nan) if pool.infinity is None else np.array(pool.infinity)
    # one run there is none of the least; who has seen the shape before has looked in all directions
    new = np.flatnonzero(wanted & (unseen | np.isnan(known)))
    if len(new):
        known[new] = np.fmin(known[new], cost_at_infinity(problem.take(new), pool.x[new, 0]))
    return known


def centre_of(problem: Problem) -> Array:
    """Return the mean (N or 1, d) of the stations that rows are present of, metres."""
    places = problem.stations.places
    heard = (problem.weight > 0.0).astype(float) @ rows_of_stations(problem).T.astype(float) > 0.0
    # a station that moves counts wherever it is in the course of the run
    return centre_of_points(places, np.tile(heard, places.shape[-2] // problem.stations.count))


def reach_of(problem: Problem, x: Array) -> Array:
    """Return the greatest distance (N,) of a station, and of a target without a chart, from the stations' middle.

    Parameters
    ----------
    problem : Problem
        N problems.
    x : array (N, size)
        Fixes.
    """
    centre, spread = centre_and_spread(problem.stations.places)
    reach = np.broadcast_to(spread, (len(x),))
    if problem.layout.shares("position"):  # its chart knows how far away it is
        return reach
    slots = (*problem.layout.shared, *problem.layout.local)
    for name in (slot.name for slot in slots if slot.name.partition("[")[0] == "position"):
        places = problem.layout.take(x, name).reshape(len(x), -1, problem.dimension)
        away = np.sqrt(((places - centre.reshape(-1, 1, problem.dimension)) ** 2).sum(-1))
        reach = np.fmax(reach, np.fmax.reduce(away, axis=-1, initial=0.0))
    return np.asarray(reach)


def chart_of(problem: Problem, x: Array, covariance: Array, curvature: Curvature) -> Chart | None:
    """Return in which coordinates positions are Gaussian, or None for problems that do not share one.

    Parameters
    ----------
    problem : Problem
        N problems.
    x : array (N, size)
        Fixes.
    covariance : array (N, n, n)
        Of their shared unknowns.
    curvature : Curvature
        Examined; what was not is taken for curved.
    """
    if not problem.layout.shares("position"):
        return None
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    kind = np.full(len(x), CURVED, dtype=np.int8)
    if curvature.kappa is not None:
        with np.errstate(invalid="ignore"):
            kind = chart_kind(curvature.kappa[:, 0], curvature.kappa[:, 1]).astype(np.int8)
    centre = centre_of(problem)
    centre = np.broadcast_to(centre, (len(x), centre.shape[-1]))
    return Chart(kind, x[:, part], covariance[:, part, part], centre)


def chart_kind(metres: Any, inverse: Any) -> Any:
    """Return the kind of chart of one fix, or of many (N,), from the two numbers of `Curvature.kappa`.

    The first of the kinds whose number is small: NaN is not.
    """
    assert (CARTESIAN, INVERSE_RANGE, CURVED) == (0, 1, 2)  # so each number that is not small counts as one kind more
    bent = (metres <= BENT) ^ True
    return bent * 1 + (bent & ((inverse <= BENT) ^ True)) * 1


# What applies, in sentences.


def explain(problem: Problem, pool: Pool, code: Array, gap: Array, proven: Claims, reason: Array) -> None:
    """Write the reasons (N,) that belong to the statuses of finished answers, where there is none yet.

    Parameters
    ----------
    problem, pool : Problem, Pool
        N problems and their settled pools.
    code : int array (N,)
        `Status` numbers.
    gap : array (N, r)
        Costs of the other minima less that of the best.
    proven : Claims
        What is proven.
    reason : object array (N,)
        Written where it is empty.
    """
    empty = reason == ""
    bulk = empty & (code == Status.UNPROVEN)
    told = proven.reason[bulk]
    reason[bulk] = NOT_TRIED if pool.proven is None else np.where(told == NO_PROOF.reason, NOT_TRIED, told)
    if pool.refuted:
        reason[empty & (code == Status.MISFIT)] = pool.refuted
    cost = pool.cost[:, 0]
    doubtful = (reason == "") & ((code == Status.OK) | (code == Status.MISFIT)) & is_improbable(cost, pool.dof, DOUBT)
    for i in np.flatnonzero(doubtful):
        p_value = tail_probability(cost[i : i + 1], np.array(pool.dof[i : i + 1]))[0]
        reason[i] = f"the residuals are larger than the noise allows (p = {p_value:.1g})"
    for i in np.flatnonzero(empty & (code == Status.AMBIGUOUS)):
        reason[i] = ambiguity(problem, float(gap[i].min()))
    for i in np.flatnonzero(empty & (code == Status.UNBOUNDED) & np.isfinite(cost)):
        assert pool.infinity is not None
        more = float(pool.infinity[i] - cost[i])
        reason[i] = f"infinity costs {f'only {more:.2g}' if more > _NONE else 'no'} more"
    curved = empty & (code == Status.CURVED)
    if curved.any():
        assert pool.curvature is not None
        assert pool.curvature.kappa is not None
        kind = chart_kind(pool.curvature.kappa[:, 0], pool.curvature.kappa[:, 1])
        for each in (INVERSE_RANGE, CURVED):
            reason[curved & (kind == each)] = BENT_SENTENCE[each]
    if pool.searched is not None and pool.remark is not None:
        told = pool.searched & (code == Status.SEARCHED)
        reason[told] = pool.remark[told]


def ambiguity(problem: Problem, gap: float) -> str:
    """Return the sentence about a second minimum with a gap."""
    text = "another position " + ("fits as well" if gap < _ALIKE else f"costs only {gap:.2g} more")
    moving = problem.epochs > 1 and any(motion.order > 0 for motion in problem.motions)
    return text + (": a bound on height, speed or place would decide" if moving else "")

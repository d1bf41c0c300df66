"""Findings against finished answers: the definition of `ok`, for every method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optloc.base.linalg import centre_and_spread, centre_of_points
from optloc.base.records import present, take
from optloc.base.types import PRECEDENCE, Array, Certificate, Status
from optloc.linear.constraints import faces
from optloc.linear.mirror import one_position, rows_of_stations
from optloc.linear.redundancy import largest
from optloc.model_checks.shape import BENT, cost_at_infinity, departure
from optloc.model_checks.truncation import Law, departure_inwards, has_law, law_of
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE, Chart, quantile, tail_probability
from optloc.problem.claims import GLOBAL, Claims, claim
from optloc.problem.problem import Problem
from optloc.problem.truncated import Truncated
from optloc.solvers.policy import AMBIGUOUS_GAP, P_MISFIT, P_OUTLIER, P_SUSPECT, REGION_LEVEL
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.verdict.repeats import holds, is_repeatable, repeat

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
"""Sentences on a fix that is `curved`, by the kind of its chart."""
BOTH_SIDES = (
    "the stations lie in a plane, and the target is on either side or in it: "
    "`optloc.model_checks.distance_from_plane` says how far"
)
"""Sentence on a fix whose two mirror images are one region."""
_ALIKE = 1e-3  # gaps below this are told as "fits as well": a reader gains nothing from more zeros
# Share of the distance of two mirror images by which a minimum may be off one of them and be the same.
_SAME_END = 1e-3
# Gaps to infinity below this come from rounding: the fix itself is as far away as counts.
_NONE = 1e-6


class Evidence(NamedTuple):
    """The numbers that decide about one finished answer, or about many (N,); NaN decides nothing.

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
    searched : bool
        Whether the start was not safe.
    blind : bool
        Whether a search for suspects was asked for, and could not see one or tell which.
    held : bool
        Whether the 95 % ellipses of repeated measurements hold.
    robust : bool
        Whether the minima of a loss were searched, and the rows that count prove the place.
    """

    improbable: Any
    infinity: Any
    region: float
    gap: Any
    kappa: Any
    unique: Any
    searched: Any = False
    blind: Any = False
    held: Any = False
    robust: Any = False


@dataclass(frozen=True, slots=True)
class Finished:
    """N finished answers, and what is known of them.

    Parameters
    ----------
    problem, pool : Problem, Pool
        N problems and their settled pools.
    gap : array (N, r)
        Costs of the other minima less the cost of the best; infinite in empty slots.
    proven : Claims
        Claims of the proofs.
    """

    problem: Problem
    pool: Pool
    gap: Array
    proven: Claims


@dataclass(frozen=True, slots=True)
class Finding:
    """An objection to answers: fixes, networks, or starts of tracks.

    Parameters
    ----------
    status : Status
        The status of an answer without other findings that precede it; its sentence is the advice.
    test : callable
        Maps evidence to where it applies. Of fixes by operators alone, so that numbers and arrays take the same rules.
    sentence : callable
        Maps the evidence of a network or start to sentences. Of fixes it maps `Finished` and the indices of some to one
        sentence for all of these, or to one for each.
    """

    status: Status
    test: Callable[[Any], Any]
    sentence: Callable[..., Any]


def objections(table: Sequence[Finding], evidence: Any) -> list[tuple[Status, str]]:
    """Return status and sentence of all findings against one answer, in the order of `PRECEDENCE`."""
    found = [(one.status, words) for one in table if one.test(evidence) for words in one.sentence(evidence)]
    return sorted(found, key=lambda one: PRECEDENCE.index(one[0]))


def finding_marks(problem: Problem, pool: Pool, gap: Array) -> Array:
    """Return the marks (N,) of all findings against settled answers that are finished; zero without one.

    An answer is `ok` where the data do not reject the model, no other minimum within `AMBIGUOUS_GAP` is left (which is
    proven), infinity lies outside the likelihood region, and the covariance covers.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Settled. Numbers that were not computed decide nothing; a missing proof of uniqueness is a finding.
    gap : array (N, r)
        Costs of the other minima less that of the best; infinite where there is none.
    """
    cost, kappa = pool.cost[:, 0], None if pool.curvature is None else pool.curvature.kappa
    # a loss bears gross errors: their cost refutes nothing
    improbable = np.zeros(len(pool), dtype=bool) if pool.loss else is_improbable(cost, pool.dof, P_MISFIT)
    blind: Any = False
    if pool.asked:  # without redundancy a search for suspects sees nothing, and with one it cannot tell who it is
        blind = (pool.dof <= 0) | ((pool.dof == 1) & is_improbable(cost, pool.dof, P_OUTLIER))
    with np.errstate(invalid="ignore"):
        marks: Array = marks_of(
            improbable,
            np.nan if pool.infinity is None else pool.infinity - cost,
            quantile(REGION_LEVEL, problem.dimension),
            _apart(pool, gap).min(1, initial=np.inf),
            np.nan if kappa is None else kappa[:, 0],
            _is_unique(pool),
            False if pool.searched is None else pool.searched,
            blind,
            repeats_hold(pool.curvature),
            False if pool.robust is None else pool.robust,
        )
    return marks.astype(np.int32)


def marks_of(*numbers: Any) -> Any:
    """Return the marks of all findings against one answer, or against many (N,); the numbers are an `Evidence`."""
    evidence, marks = Evidence(*numbers), 0
    for status_mark, test in _TESTS:
        marks = marks | test(evidence) * status_mark
    return marks


def _apart(pool: Pool, gap: Array) -> Array:
    """Return the gaps (N, r) of the minima outside the region of the best; infinite for the others."""
    if pool.pair is None or not gap.shape[1]:
        return gap
    first, second = pool.pair[:, :1], pool.pair[:, 1:]
    best, others = pool.x[:, :1], pool.x[:, 1:]
    with np.errstate(invalid="ignore"):
        size = np.abs(first - second).max(-1)
        one, two = (np.abs(best - end).max(-1) <= _SAME_END * size for end in (first, second))
        other, another = (np.abs(others - end).max(-1) <= _SAME_END * size for end in (first, second))
    return np.where((one & another) | (two & other), np.inf, gap)


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
    if pool.loss:  # what is proven of squares is not of a loss
        return np.zeros(len(pool), dtype=bool) if pool.robust is None else pool.robust
    if pool.proven is None:
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
    pool = replace(pool, infinity=_infinity(problem, pool, good & _is_bent(pool), unseen))
    return _with_repeats(problem, pool, good) if is_repeatable(problem) else pool


def _with_repeats(problem: Problem, pool: Pool, good: Array) -> Pool:
    """Return a pool with the repeats of fixes against which only their shape speaks."""
    assert pool.curvature is not None
    cost = pool.cost[:, 0]
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(pool.cost[:, 1:]), pool.cost[:, 1:] - cost[:, None], np.inf)
    items = np.flatnonzero(good & (pool.face[:, 0] == 0) & (finding_marks(problem, pool, gap) == Status.CURVED.mark))
    if pool.pair is not None:  # no Gaussian describes both sides of a plane
        items = items[np.isnan(pool.pair[items, 0]).any(-1)]
    if not len(items):
        return pool
    found = np.full((len(pool), 3), np.nan)
    found[items] = repeat(problem.take(items), pool.x[items, 0], pool.curvature.covariance[items])
    return replace(pool, curvature=replace(pool.curvature, repeats=found))


def repeats_hold(curvature: Curvature | None) -> Any:
    """Return whether repeats were tried and their ellipses hold, (N,) or False."""
    if curvature is None or curvature.repeats is None:
        return False
    return holds(curvature.repeats)


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
        if len(sides[number]) > len(sides[0]):
            out[items] = np.fmax(out[items], _departure_inwards(problem.take(items), take(pool, items))[:, None])
    return out


def _departure_inwards(problem: Problem, pool: Pool) -> Array:
    """Return by how much the cost inwards of the bounds that hold fixes departs from a Gaussian's, (N,)."""
    law = law_at(problem, pool)
    if law is None:
        return np.full(len(pool), np.inf)
    assert pool.curvature is not None
    assert pool.curvature.free is not None
    held = np.isfinite(pool.curvature.free).all((-1, -2)) & law.sound & law.truncated.cuts
    items, out = np.flatnonzero(held), np.full(len(pool), np.inf)
    if len(items):
        free, one = pool.curvature.free[items], take(law.truncated, items)
        out[items] = departure_inwards(problem.take(items), pool.x[items, 0], free, one)
    return out


def law_at(problem: Problem, pool: Pool) -> Law | None:
    """Return the normal laws of the best candidates that bounds cut off; None where no bound is near any."""
    curvature = pool.curvature
    # the covariance of a loss is no quadratic model beyond a bound
    if curvature is None or pool.loss or not has_law(problem):
        return None
    covariance, shift = curvature.covariance, np.zeros((len(pool), problem.layout.n_shared))
    if curvature.free is not None and curvature.shift is not None:
        held = pool.face[:, 0] > 0
        covariance = np.where(held[:, None, None], curvature.free, covariance)
        shift = np.where(held[:, None], curvature.shift, shift)
    return law_of(problem, pool.x[:, 0], covariance, shift)


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


def chart_of(
    problem: Problem, x: Array, covariance: Array, curvature: Curvature, truncated: Truncated | None = None
) -> Chart | None:
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
    truncated : Truncated, optional
        Their laws where bounds cut these off.
    """
    if not problem.layout.shares("position"):
        return None
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    kind = np.full(len(x), CURVED, dtype=np.int8)
    if curvature.kappa is not None:
        with np.errstate(invalid="ignore"):
            kind = chart_kind(curvature.kappa[:, 0], curvature.kappa[:, 1]).astype(np.int8)
        # in metres the 95 % figures cover
        kind[repeats_hold(curvature) & (kind == CURVED)] = CARTESIAN
    inflation = None if curvature.repeats is None else np.where(holds(curvature.repeats), curvature.repeats[:, 2], 1.0)
    centre = centre_of(problem)
    centre = np.broadcast_to(centre, (len(x), centre.shape[-1]))
    return Chart(kind, x[:, part], covariance[:, part, part], centre, truncated, inflation)


def chart_kind(metres: Any, inverse: Any) -> Any:
    """Return the kind of chart of one fix, or of many (N,), from the two numbers of `Curvature.kappa`.

    The first of the kinds whose number is small: NaN is not.
    """
    assert (CARTESIAN, INVERSE_RANGE, CURVED) == (0, 1, 2)  # so each number that is not small counts as one kind more
    bent = (metres <= BENT) ^ True
    return bent * 1 + (bent & ((inverse <= BENT) ^ True)) * 1


# Findings in sentences.


def explain(finished: Finished, code: Array, reason: Array) -> None:
    """Write the reasons (N,) that belong to the statuses of finished answers, where there is none yet.

    Parameters
    ----------
    finished : Finished
        Finished, and others, whose costs are NaN.
    code : int array (N,)
        `Status` numbers.
    reason : object array (N,)
        Written where it is empty.
    """
    pool = finished.pool
    empty = (reason == "") & np.isfinite(pool.cost[:, 0])
    for finding in FINDINGS:
        items = np.flatnonzero(empty & (code == finding.status))
        if len(items):
            reason[items] = finding.sentence(finished, items)
    doubtful = np.flatnonzero(empty & (code == Status.OK) & is_improbable(pool.cost[:, 0], pool.dof, P_SUSPECT))
    if len(doubtful):
        reason[doubtful] = _name_residuals(finished, doubtful)


def _name_residuals(finished: Finished, items: Array) -> Any:
    """Return the sentences on residuals: one for all fixes of a problem, or one for each."""
    pool = finished.pool
    improbable = is_improbable(pool.cost[items, 0], pool.dof[items], P_SUSPECT)
    told = tail_probability(pool.cost[items, 0], pool.dof[items])
    said = [f"the residuals are larger than the noise allows (p = {p:.1g})" for p in told]
    return np.where(improbable, np.array(said, dtype=object), "")


def _name_infinity(finished: Finished, items: Array) -> Any:
    assert finished.pool.infinity is not None
    more = finished.pool.infinity[items] - finished.pool.cost[items, 0]
    told = [f"infinity costs {f'only {one:.2g}' if one > _NONE else 'no'} more" for one in more.tolist()]
    return np.array(told, dtype=object)


def _name_rivals(finished: Finished, items: Array) -> Any:
    gaps = _apart(finished.pool, finished.gap)[items].min(1).tolist()
    return np.array([ambiguity(finished.problem, gap) for gap in gaps], dtype=object)


def _name_search(finished: Finished, items: Array) -> Any:
    return "" if finished.pool.remark is None else finished.pool.remark[items]


def _name_proof(finished: Finished, items: Array) -> Any:
    pool = finished.pool
    if pool.loss and pool.robust is not None and pool.remark is not None:
        return np.where(pool.remark[items] == "", NOT_TRIED, pool.remark[items])
    told = finished.proven.reason[items]
    return NOT_TRIED if finished.pool.proven is None else np.where(told == NO_PROOF.reason, NOT_TRIED, told)


def _name_shape(finished: Finished, items: Array) -> Any:
    curvature = finished.pool.curvature
    assert curvature is not None
    assert curvature.kappa is not None
    inverse = chart_kind(*curvature.kappa[items].T) == INVERSE_RANGE
    told = np.where(inverse, np.array(BENT_SENTENCE[INVERSE_RANGE], dtype=object), BENT_SENTENCE[CURVED])
    pair = finished.pool.pair
    return told if pair is None else np.where(np.isfinite(pair[items, 0]).all(-1), BOTH_SIDES, told)


def _is_unsafe(evidence: Evidence) -> Any:
    """Return the answers whose start was not safe, without a proof that makes up for it."""
    return evidence.searched & (evidence.unique ^ True)


FINDINGS = (
    Finding(Status.MISFIT, lambda e: e.improbable, _name_residuals),
    Finding(Status.UNBOUNDED, lambda e: e.infinity <= e.region, _name_infinity),
    Finding(Status.AMBIGUOUS, lambda e: e.gap < AMBIGUOUS_GAP, _name_rivals),
    Finding(Status.SEARCHED, _is_unsafe, _name_search),
    Finding(Status.UNPROVEN, lambda e: (_is_unsafe(e) ^ True) & ((e.unique ^ True) | e.blind), _name_proof),
    Finding(Status.CURVED, lambda e: (e.kappa > BENT) & (e.held ^ True), _name_shape),
    Finding(Status.TAILS, lambda e: (e.kappa > BENT) & e.held, lambda finished, items: ""),
    Finding(Status.ROBUST, lambda e: e.robust, lambda finished, items: ""),
)
"""All findings against finished answers; the advice of each is `Status.sentence`."""
_TESTS = tuple((finding.status.mark, finding.test) for finding in FINDINGS)


def ambiguity(problem: Problem, gap: float) -> str:
    """Return the sentence about a second minimum with a gap."""
    text = "another position " + ("fits as well" if gap < _ALIKE else f"costs only {gap:.2g} more")
    moving = problem.epochs > 1 and any(motion.order > 0 for motion in problem.motions)
    return text + (": a bound on height, speed or place would decide" if moving else "")

"""Findings against finished answers. They define the status `ok` for every method.

A finding is a test and a sentence. `finding_marks` applies all tests to a batch of settled pools. `examine` computes
the numbers that the tests read, and `explain` writes the sentences.

Letters: N problems, n of them in a sentence, r other minima, d coordinates, `size` numbers of a parameter vector. A
*mark* is a bit mask with one bit for each status. Costs and gaps are chi-square values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optloc.base.linalg import centre_and_spread, centre_of_points
from optloc.base.records import present, take
from optloc.base.types import PRECEDENCE, Array, Certificate, Status
from optloc.linear.constraints import faces
from optloc.linear.fences import skew_of, unfenced
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
"""The claim of a refined answer without a proof."""
NO_ANSWER = claim(Certificate("unknown", "there is no refined answer to prove anything about", "none"))
"""The claim of a problem without a refined answer."""
NOT_TRIED = "no proof was tried"
BENT_SENTENCE = {
    INVERSE_RANGE: "Gaussian in inverse range, not in metres",
    CURVED: "Gaussian neither in metres nor in inverse range",
}
"""Sentences on a fix with the status `curved`, by the kind of its chart."""
BOTH_SIDES = (
    "the stations are in one plane, and the data allow both sides of the plane: "
    "`optloc.model_checks.distance_from_plane` returns the distance"
)
"""Sentence on a fix whose two mirror images share one likelihood region."""
_ALIKE = 1e-3  # for smaller gaps the sentence is "fits equally well": more zeros would not help a reader
# A minimum this near to a mirror image, as a share of the distance between the two images, is that image.
_SAME_END = 1e-3
# Smaller gaps to infinity come from rounding: the fix is already as far away as infinity for the rows.
_NONE = 1e-6


class Evidence(NamedTuple):
    """The numbers that the tests of all findings read, for one finished answer or for N. NaN passes every test.

    Parameters
    ----------
    improbable : bool
        Whether the chi-square test refutes the model: noise makes a cost this large too rarely.
    infinity, region : float
        Least cost at infinity minus the cost of the answer, and the largest excess of the cost in the likelihood
        region.
    gap : float
        Cost of the cheapest other minimum minus the cost of the answer.
    kappa : float
        Departure from a Gaussian in metres, see `optloc.solvers.pool.Curvature`.
    unique : bool
        Whether a proof excludes unlisted minima, see `is_proof_of_one`.
    searched : bool
        Whether the start was not safe.
    blind : bool
        Whether a search for suspects was requested, and the redundancy is too low to notice or to name one.
    held : bool
        Whether the 95 % ellipses of repeated measurements contain the truth often enough.
    robust : bool
        Whether the minima of a robust loss were searched, and the rows with weight prove the position.
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
    """N finished answers with their gaps and proofs.

    Parameters
    ----------
    problem, pool : Problem, Pool
        N problems and their settled pools.
    gap : array (N, r)
        Costs of the other minima minus the cost of the best; infinite in empty slots.
    proven : Claims
        Claims of the proofs.
    """

    problem: Problem
    pool: Pool
    gap: Array
    proven: Claims


@dataclass(frozen=True, slots=True)
class Finding:
    """An objection to an answer: to a fix, to a network, or to the start of a track.

    Parameters
    ----------
    status : Status
        The status of an answer, unless a finding with a higher precedence applies. Its sentence is the advice.
    test : callable
        Maps the evidence to a flag. For fixes it uses operators only, so that numbers and arrays follow the same rules:
        ``^ True`` means "not".
    sentence : callable
        For a network or a start: maps the evidence to sentences. For fixes: maps `Finished` and item numbers to one
        sentence for all items, or to one sentence for each item.
    """

    status: Status
    test: Callable[[Any], Any]
    sentence: Callable[..., Any]


def objections(table: Sequence[Finding], evidence: Any) -> list[tuple[Status, str]]:
    """Return status and sentence of all findings of a table against one answer, in the order of `PRECEDENCE`.

    `evidence` has the numbers that the tests of the table read.
    """
    found = [(one.status, words) for one in table if one.test(evidence) for words in one.sentence(evidence)]
    return sorted(found, key=lambda one: PRECEDENCE.index(one[0]))


def finding_marks(problem: Problem, pool: Pool, gap: Array) -> Array:
    """Return the marks (N,) of all findings against settled, finished answers; zero for an answer without a finding.

    An answer is `ok` under four conditions. The data do not reject the model. A proof excludes other minima within
    `AMBIGUOUS_GAP`. Infinity is outside the likelihood region. The covariance covers.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Settled. Numbers that were not computed raise no finding; a missing proof of uniqueness is a finding.
    gap : array (N, r)
        Costs of the other minima minus the cost of the best; infinite in empty slots.
    """
    cost, kappa = pool.cost[:, 0], None if pool.curvature is None else pool.curvature.kappa
    # a robust loss allows gross errors, so their cost does not refute the model
    improbable = np.zeros(len(pool), dtype=bool) if pool.loss else is_improbable(cost, pool.dof, P_MISFIT)
    blind: Any = False
    if pool.asked:  # redundancy 0 cannot show an error, and redundancy 1 cannot name the wrong row
        blind = (pool.dof <= 0) | ((pool.dof == 1) & is_improbable(cost, pool.dof, P_OUTLIER))
    with np.errstate(invalid="ignore"):
        marks: Array = marks_of(
            improbable,
            np.nan if pool.infinity is None else pool.infinity - cost,
            quantile(REGION_LEVEL, problem.dimension),
            _gaps_of_rivals(pool, gap).min(1, initial=np.inf),
            np.nan if kappa is None else kappa[:, 0],
            _is_unique(pool),
            False if pool.searched is None else pool.searched,
            blind,
            repeats_hold(pool.curvature),
            False if pool.robust is None else pool.robust,
        )
    return marks.astype(np.int32)


def marks_of(*numbers: Any) -> Any:
    """Return the marks of all findings against one answer, or against N: one bit for each status.

    `numbers` are the fields of `Evidence`, in their order.
    """
    evidence, marks = Evidence(*numbers), 0
    for status_mark, test in _TESTS:
        marks = marks | test(evidence) * status_mark
    return marks


def _gaps_of_rivals(pool: Pool, gap: Array) -> Array:
    """Return the gaps (N, r) of other minima; infinite for the mirror image of the best in one likelihood region."""
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
    """Return flags (N,) of costs (N,) that noise exceeds with less than the given probability.

    `dof` (N,) are the degrees of freedom. Without any, the flag is False.
    """
    # often all N share one number of degrees of freedom: a view without strides
    if dof.strides == (0,):
        return np.asarray(cost > largest(int(dof[0]) if len(dof) else 0, probability))
    out = np.zeros(len(cost), dtype=bool)
    for level in np.unique(dof[dof > 0]):
        out |= (dof == level) & (cost > largest(int(level), probability))
    return out


def _is_unique(pool: Pool) -> Array:
    """Return flags (N,) of answers with a proof that every unlisted minimum costs more than the gap."""
    if pool.loss:  # a proof for squares does not apply to a robust loss
        return np.zeros(len(pool), dtype=bool) if pool.robust is None else pool.robust
    if pool.proven is None:
        return np.zeros(len(pool), dtype=bool)
    between = np.zeros(len(pool)) if pool.infinity is None else pool.infinity - pool.cost[:, 0]
    return is_proof_of_one(pool.proven, between)


def is_proof_of_one(claims: Claims, infinity: Array) -> Array:
    """Return flags (...) of claims that every unlisted minimum costs more than `AMBIGUOUS_GAP` above the best.

    `infinity` is the cost at infinity minus the cost of the best. If it is positive and less than the gap, a proof up
    to infinity is enough: the finding `unbounded` covers the rest.
    """
    enough = (claims.margin >= AMBIGUOUS_GAP) | ((infinity > 0.0) & (infinity < AMBIGUOUS_GAP))
    return np.asarray(claims.unique & ((claims.proof == GLOBAL) | claims.asked) & enough)


def examine(problem: Problem, pool: Pool) -> Pool:
    """Return a settled pool with the departure from a Gaussian, the cost at infinity, and shares of repeats.

    Parameters
    ----------
    problem : Problem
        N problems. The departure needs a shared position; infinity and repeats need a problem of one position at rest.
    pool : Pool
        Numbers that it already has are kept.
    """
    curvature = pool.curvature
    if curvature is None or not problem.layout.shares("position"):
        return pool
    good = (pool.code[:, 0] == Status.OK) & np.isfinite(pool.x[:, 0]).all(-1)
    good &= np.isfinite(curvature.covariance).all((-1, -2))
    if pool.conclusion is not None:
        good &= ~present(pool.conclusion)  # a conclusion leaves rows out, and its fix was examined when it was computed
    kappa = np.full((len(pool), 2), np.nan) if curvature.kappa is None else np.array(curvature.kappa)
    unseen = np.isnan(kappa[:, 0])
    new = np.flatnonzero(good & unseen)
    if len(new):
        kappa[new] = _departure(problem.take(new), take(pool, new))
    pool = replace(pool, curvature=replace(curvature, kappa=kappa))
    # a velocity may grow with the range, so the least cost at infinity is not computed for moving targets
    if pool.loss or not one_position(problem) or problem.motions[0].order:
        return pool
    pool = replace(pool, infinity=_infinity(problem, pool, good & _is_bent(pool), unseen))
    return _with_repeats(problem, pool, good) if is_repeatable(problem) else pool


def _with_repeats(problem: Problem, pool: Pool, good: Array) -> Pool:
    """Return a pool with the results of simulated repeats of the fixes whose only finding is `curved`.

    `good` (N,) flags the fixes that may be repeated.
    """
    assert pool.curvature is not None
    cost = pool.cost[:, 0]
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(pool.cost[:, 1:]), pool.cost[:, 1:] - cost[:, None], np.inf)
    items = np.flatnonzero(good & (pool.face[:, 0] == 0) & (finding_marks(problem, pool, gap) == Status.CURVED.mark))
    if pool.pair is not None:  # one Gaussian cannot describe the positions on both sides of a plane
        items = items[np.isnan(pool.pair[items, 0]).any(-1)]
    if not len(items):
        return pool
    found = np.full((len(pool), 3), np.nan)
    found[items] = repeat(problem.take(items), pool.x[items, 0], pool.curvature.covariance[items])
    return replace(pool, curvature=replace(pool.curvature, repeats=found))


def repeats_hold(curvature: Curvature | None) -> Any:
    """Return flags (N,) of fixes whose simulated repeats cover the truth often enough; False without repeats."""
    if curvature is None or curvature.repeats is None:
        return False
    return holds(curvature.repeats)


def _departure(problem: Problem, pool: Pool) -> Array:
    """Return the departures (N, 2) of the cost from a Gaussian's at three sigma: in metres and in inverse range.

    The departures along the inner side of active bounds count too.
    """
    assert pool.curvature is not None
    if pool.loss:
        problem = problem.with_rows(weight=pool.weights)
    x, covariance, centre = pool.x[:, 0], pool.curvature.covariance, centre_of(problem)
    if problem.fences:  # their departure from a Gaussian is known exactly, so only the rows are tested
        free, x = unfenced(problem, x, covariance), np.array(x)
        x[:, : free.shift.shape[1]] += free.shift
        problem, covariance = replace(problem, fences=()), free.covariance
        if not problem.batch_shape:  # only the fences had the batch axis
            problem = problem.with_rows(z=np.broadcast_to(problem.z, (len(x), *problem.z.shape)))
    centre = np.broadcast_to(centre, (len(x), centre.shape[-1]))
    sides = faces(problem) if problem.constraints else [()]
    out = np.empty((len(x), 2))
    for number in np.unique(pool.face[:, 0]):
        items = np.flatnonzero(pool.face[:, 0] == number)
        out[items] = departure(problem.take(items), x[items], covariance[items], sides[number], centre[items])
        if len(sides[number]) > len(sides[0]):
            inwards, bent = _departure_inwards(problem.take(items), take(pool, items))
            # along a bent bound, the rise of the cost also depends on the curvature of the bound
            out[items] = np.where(bent[:, None], inwards[:, None], np.fmax(out[items], inwards[:, None]))
    return out


def _departure_inwards(problem: Problem, pool: Pool) -> tuple[Array, Array]:
    """Return the departure (N,) of the cost from a Gaussian's, on the inner side of active bounds.

    It is infinite if the truncated law of a fix is not valid. The second result (N,) flags laws with a function that
    tests whether points are admitted.
    """
    law, none = law_at(problem, pool), np.zeros(len(pool), dtype=bool)
    if law is None:
        return np.full(len(pool), np.inf), none
    assert pool.curvature is not None
    assert pool.curvature.free is not None
    usable = np.isfinite(pool.curvature.free).all((-1, -2)) & law.sound & law.truncated.cuts
    items, out = np.flatnonzero(usable), np.full(len(pool), np.inf)
    if len(items):
        free, one = pool.curvature.free[items], take(law.truncated, items)
        out[items] = departure_inwards(problem.take(items), pool.x[items, 0], free, one)
    return out, none if law.truncated.region is None else usable & present(law.truncated.region)


def law_at(problem: Problem, pool: Pool) -> Law | None:
    """Return the truncated normal laws of the best candidates, or None if no bound is near a candidate.

    If bounds cut off a law, its covariance and its regions differ from a Gaussian's.
    """
    curvature = pool.curvature
    # the covariance under a robust loss is no quadratic model beyond a bound
    if curvature is None or pool.loss or not has_law(problem):
        return None
    covariance, shift = curvature.covariance, np.zeros((len(pool), problem.layout.n_shared))
    if curvature.free is not None and curvature.shift is not None:
        on_bound = pool.face[:, 0] > 0
        covariance = np.where(on_bound[:, None, None], curvature.free, covariance)
        shift = np.where(on_bound[:, None], curvature.shift, shift)
    return law_of(problem, pool.x[:, 0], covariance, shift)


def _is_bent(pool: Pool) -> Array:
    """Return flags (N,) of fixes that are not Gaussian in metres: only for these the cost at infinity is computed.

    Of 8 233 fixes that are Gaussian in metres none had infinity in its region. If infinity is in the region in another
    direction, no proof of uniqueness ends, so the fix is not `ok` in either case.
    """
    assert pool.curvature is not None
    assert pool.curvature.kappa is not None
    return np.asarray(~(pool.curvature.kappa[:, 0] <= BENT))


def _infinity(problem: Problem, pool: Pool, wanted: Array, unseen: Array) -> Array:
    """Return the least known costs (N,) at infinity; NaN if unknown.

    Runs of the refinement to infinity give some of the costs. For fixes flagged in `wanted` (N,) all directions are
    tried, unless their shape was known before: `unseen` (N,) flags shapes that were not.
    """
    known = np.full(len(pool), np.nan) if pool.infinity is None else np.array(pool.infinity)
    # A run to infinity tries one direction, so its cost need not be the least. If the shape is already known, all
    # directions were tried before.
    new = np.flatnonzero(wanted & (unseen | np.isnan(known)))
    if len(new):
        known[new] = np.fmin(known[new], cost_at_infinity(problem.take(new), pool.x[new, 0]))
    return known


def centre_of(problem: Problem) -> Array:
    """Return the mean (N or 1, d) of the stations that have rows with weight, metres: the centre of the charts."""
    places = problem.stations.places
    measured = (problem.weight > 0.0).astype(float) @ rows_of_stations(problem).T.astype(float) > 0.0
    # a moving station counts with its positions at all epochs
    return centre_of_points(places, np.tile(measured, places.shape[-2] // problem.stations.count))


def reach_of(problem: Problem, x: Array) -> Array:
    """Return the greatest distance (N,) of a station from the middle of the stations, metres.

    If the problem has no chart, the distances of the targets count too.

    Parameters
    ----------
    problem : Problem
        N problems.
    x : array (N, size)
        Fixes.
    """
    centre, spread = centre_and_spread(problem.stations.places)
    reach = np.broadcast_to(spread, (len(x),))
    if problem.layout.shares("position"):  # a shared position has a chart, which contains its distance
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
    """Return the coordinates in which positions are Gaussian, or None for problems without a shared position.

    Parameters
    ----------
    problem : Problem
        N problems.
    x : array (N, size)
        Fixes.
    covariance : array (N, n, n)
        Covariance of their shared unknowns.
    curvature : Curvature
        Examined curvature; an unexamined fix counts as curved.
    truncated : Truncated, optional
        Laws of the fixes that bounds cut off.
    """
    if not problem.layout.shares("position"):
        return None
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    kind = np.full(len(x), CURVED, dtype=np.int8)
    if curvature.kappa is not None:
        with np.errstate(invalid="ignore"):
            kind = chart_kind(curvature.kappa[:, 0], curvature.kappa[:, 1]).astype(np.int8)
        # the 95 % ellipses in metres cover
        kind[repeats_hold(curvature) & (kind == CURVED)] = CARTESIAN
    inflation = None if curvature.repeats is None else np.where(holds(curvature.repeats), curvature.repeats[:, 2], 1.0)
    centre = centre_of(problem)
    centre = np.broadcast_to(centre, (len(x), centre.shape[-1]))
    skew = skew_of(problem, x, curvature.covariance, part)
    return Chart(kind, x[:, part], covariance[:, part, part], centre, truncated, inflation, skew)


def chart_kind(metres: Any, inverse: Any) -> Any:
    """Return the kind of chart of one fix, or of N fixes, from the two numbers of `Curvature.kappa`.

    `metres` and `inverse` are the departures from a Gaussian in metres and in inverse range. The result is the first
    kind whose number is at most `BENT`. NaN counts as larger.
    """
    assert (CARTESIAN, INVERSE_RANGE, CURVED) == (0, 1, 2)  # each number above the limit moves to the next kind
    bent = (metres <= BENT) ^ True
    return bent * 1 + (bent & ((inverse <= BENT) ^ True)) * 1


# Sentences of the findings.


def explain(finished: Finished, code: Array, reason: Array) -> None:
    """Write the reasons (N,) of finished answers by their statuses, where the reason is still empty.

    Parameters
    ----------
    finished : Finished
        Finished answers; others have the cost NaN and get no reason.
    code : int array (N,)
        `Status` numbers.
    reason : object array (N,)
        Written in place.
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
    """Return a sentence on the residuals for each item, with the p-value; "" if the residuals fit the noise."""
    pool = finished.pool
    improbable = is_improbable(pool.cost[items, 0], pool.dof[items], P_SUSPECT)
    p_values = tail_probability(pool.cost[items, 0], pool.dof[items])
    sentences = [f"the residuals are larger than the noise allows (p = {p:.1g})" for p in p_values]
    return np.where(improbable, np.array(sentences, dtype=object), "")


def _name_infinity(finished: Finished, items: Array) -> Any:
    """Return the sentences of `unbounded` for items (n,): the rise of chi-square at infinity."""
    assert finished.pool.infinity is not None
    more = finished.pool.infinity[items] - finished.pool.cost[items, 0]
    rises = [f"only {rise:.2g}" if rise > _NONE else "nothing" for rise in more.tolist()]
    return np.array([f"a target at infinity raises chi-square by {rise}" for rise in rises], dtype=object)


def _name_rivals(finished: Finished, items: Array) -> Any:
    """Return the sentences of `ambiguous` for items (n,): the gap of the nearest rival."""
    gaps = _gaps_of_rivals(finished.pool, finished.gap)[items].min(1).tolist()
    return np.array([ambiguity(finished.problem, gap) for gap in gaps], dtype=object)


def _name_search(finished: Finished, items: Array) -> Any:
    """Return the sentences of `searched` for items (n,): the remark of the search."""
    return "" if finished.pool.remark is None else finished.pool.remark[items]


def _name_proof(finished: Finished, items: Array) -> Any:
    """Return the sentences of `unproven` for items (n,): the reasons why there is no proof of uniqueness."""
    pool = finished.pool
    if pool.loss and pool.robust is not None and pool.remark is not None:
        return np.where(pool.remark[items] == "", NOT_TRIED, pool.remark[items])
    reason = finished.proven.reason[items]
    return NOT_TRIED if finished.pool.proven is None else np.where(reason == NO_PROOF.reason, NOT_TRIED, reason)


def _name_shape(finished: Finished, items: Array) -> Any:
    """Return the sentences of `curved` for items (n,): the coordinates in which a fix is Gaussian, if there are any."""
    curvature = finished.pool.curvature
    assert curvature is not None
    assert curvature.kappa is not None
    inverse = chart_kind(*curvature.kappa[items].T) == INVERSE_RANGE
    sentences = np.where(inverse, np.array(BENT_SENTENCE[INVERSE_RANGE], dtype=object), BENT_SENTENCE[CURVED])
    pair = finished.pool.pair
    return sentences if pair is None else np.where(np.isfinite(pair[items, 0]).all(-1), BOTH_SIDES, sentences)


def _is_unsafe(evidence: Evidence) -> Any:
    """Return flags of answers whose start was not safe and that have no proof of uniqueness; see `Evidence`."""
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
    """Return the sentence about a second minimum whose cost is larger by `gap`."""
    text = "another position " + ("fits equally well" if gap < _ALIKE else f"raises chi-square by only {gap:.2g}")
    moving = problem.epochs > 1 and any(motion.order > 0 for motion in problem.motions)
    return text + (": a bound on height, speed or position can decide" if moving else "")

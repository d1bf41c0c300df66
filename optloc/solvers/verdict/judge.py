"""The verdict: from a pool of candidates to a fix with a status.

Only this module sets the status of a fix, by one set of rules. So a status has the same meaning for every method.

Letters: N problems, q candidates, r other minima, n shared unknowns, `size` numbers of a parameter vector. Marks are
bit masks with one bit for each status.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import chdtrc

from optloc.base.records import join, overwrite, present, take
from optloc.base.types import Array, Certificate, Status, first_status
from optloc.bounds.rank import open_sentences
from optloc.linear.constraints import violation_names
from optloc.linear.fences import margins, posterior_spread, unfenced
from optloc.linear.least_squares_ranges import ranges
from optloc.model_checks.single_error import misfit_of
from optloc.model_checks.truncation import covariance_of
from optloc.models import MODELS
from optloc.models.layers import Layers
from optloc.problem.claims import Claims, claim, merged_claims, repeated_claims
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Alternatives
from optloc.problem.problem import Problem
from optloc.problem.truncated import Truncated
from optloc.solvers.policy import FAR, FLAT, P_SUSPECT, REJECTED, WEAK
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.starts.position import distance_of, spread_of
from optloc.solvers.verdict.conclusion import Conclusion, conclude
from optloc.solvers.verdict.findings import (
    NO_ANSWER,
    NO_PROOF,
    Finished,
    chart_of,
    examine,
    explain,
    finding_marks,
    is_improbable,
    law_at,
    reach_of,
)
from optloc.solvers.verdict.minima import is_measured, station_direction, unmeasured_direction, weak_direction

_UNFINISHED = (Status.UNBOUNDED, Status.MAX_ITERATIONS, Status.STALLED)
_SHOWN = 8  # names or numbers in a sentence: a longer list does not help


@dataclass(frozen=True, slots=True)
class Ruling:
    """The statuses of a flat batch of N problems.

    Parameters
    ----------
    marks : int array (N,)
        One bit for each `Status` that applies.
    reason : object array (N,)
        Sentences.
    proven : Claims
        Claims of the proofs.
    no_position : bool array (N,)
        True for fixes whose position is not shown.
    """

    marks: Array
    reason: Array
    proven: Claims
    no_position: Array


def decide_statuses(problem: Problem, pool: Pool, gap: Array) -> Ruling:
    """Return the statuses, reasons and claims of settled pools.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Settled.
    gap : array (N, r)
        Costs of the other minima minus the cost of the best; infinite in empty slots.
    """
    curvature = pool.curvature
    assert curvature is not None
    code, reason = np.array(pool.code[:, 0]), filled_objects(len(pool), "")
    cost = np.where(np.isfinite(pool.cost[:, 0]), pool.cost[:, 0], np.nan)
    broken = _is_broken(problem, len(pool))
    few = (pool.dof < 0) & ~broken
    missing = ~np.isfinite(cost) & ~broken & ~few
    answered = ~(broken | few | missing)
    # Missing data, missing rows and missing candidates are tested in this order. Other problems have an answer,
    # perhaps a bad answer.
    weak = answered & ~_is_determined(curvature)
    distance = distance_of(problem, _position(problem, pool))
    with np.errstate(invalid="ignore"):
        improbable = is_improbable(cost, pool.dof, P_SUSPECT)
    far = answered & _runs_away(problem, curvature, distance, (code != Status.OK) | weak | improbable)
    # If no visible minimum fits but a hidden one does, the hidden one explains more than an unfinished refinement.
    hidden_fits = answered & _has_hidden(pool) & ((code != Status.OK) | ((weak | far) & improbable))
    far &= ~hidden_fits
    # far away every direction is weak, so the distance is the better reason
    weak &= ~(far | hidden_fits)
    code[broken], code[few], code[far] = Status.REJECTED, Status.TOO_FEW_ROWS, Status.UNBOUNDED
    code[weak], code[hidden_fits] = Status.SINGULAR_GEOMETRY, Status.INFEASIBLE
    for i in np.flatnonzero(hidden_fits):
        reason[i] = _hidden_or(pool, int(i), "")
    for i in np.flatnonzero(few):
        reason[i] = _too_few_sentence(-int(pool.dof[i]))
    for i in np.flatnonzero(answered & np.isin(code, _UNFINISHED)):
        reason[i] = f"the target is too far away: {distance[i]:.3g} times the size of the station array from its middle"
        if code[i] != Status.UNBOUNDED and distance[i] < 1.0:  # inside the array, distance is no reason
            reason[i] = "the refinement did not end: the cost still falls, in shorter and shorter steps"
    for i in np.flatnonzero(weak):
        reason[i] = _undetermined_sentence(problem, _information(curvature)[i])
    _explain_missing(problem, pool, np.flatnonzero(missing), code, reason)
    finished = answered & (code == Status.OK)
    # the mark of an unfinished answer is the bit of its status
    marks = np.where(finished, finding_marks(problem, pool, gap), 1 << code.astype(np.int32)).astype(np.int32)
    proven = merged_claims(finished, _claims(pool), NO_ANSWER)
    if pool.free is not None:
        _mark_contradictions(pool, cost, finished, marks, reason)
    if problem.fences:
        _mark_fences(problem, pool, cost, finished, marks, reason)
    code = first_status(marks)
    explain(Finished(problem, pool, gap, proven), code, reason)
    if pool.hidden is not None:
        _name_hidden(pool.hidden, finished & (code == Status.MISFIT), reason)
    if pool.loss:
        _name_rejected(problem, pool, finished & is_improbable(cost, pool.dof, P_SUSPECT), reason)
    if pool.asked:
        _name_redundancy(pool, finished, reason)
    return Ruling(marks, reason, proven, broken | few | missing | hidden_fits | weak | far)


def _is_broken(problem: Problem, count: int) -> Array:
    """Return flags (N,) of problems that have a measurement which is not a finite number; `count` is N."""
    # an absent row may contain any value
    return ~np.broadcast_to((np.isfinite(problem.z) | (problem.weight == 0.0)).all(-1), (count,))


def filled_objects(count: int, value: object) -> Array:
    """Return an object array (count,) of one value."""
    out = np.empty(count, dtype=object)
    out.fill(value)
    return out


def _is_determined(curvature: Curvature) -> Array:
    """Return flags (N,) of fixes whose data determine every direction."""
    count = len(curvature.covariance)
    regular = np.ones(count, dtype=bool) if curvature.regular is None else curvature.regular
    weakest = np.full(count, np.inf) if curvature.weakest is None else curvature.weakest
    return np.asarray(regular & (weakest >= WEAK))


def _information(curvature: Curvature) -> Array:
    """Return the information (N, n, n) of a curvature; NaN if it was not computed."""
    return np.full(curvature.covariance.shape, np.nan) if curvature.information is None else curvature.information


def _runs_away(problem: Problem, curvature: Curvature, distance: Array, lost: Array) -> Array:
    """Return flags (N,) of positions so far away or so uncertain that the data determine a direction only.

    `curvature` has the covariances of the fixes. `distance` (N,) is in spreads of the stations. `lost` (N,) flags fixes
    with another fault.
    """
    covariance = np.where(_is_determined(curvature)[:, None, None], curvature.covariance, np.nan)
    with np.errstate(invalid="ignore"):
        # if the error exceeds the distance from the stations, only the direction is known
        loose = np.trace(covariance, axis1=-2, axis2=-1) > (distance * spread_of(problem)[1]) ** 2
        # Beyond FAR a fix must be good in all other respects. Beyond FLAT wave fronts are flat, so no fix is accepted.
        return np.asarray(((lost | loose) & (distance > FAR)) | (distance > FLAT))


def _too_few_sentence(count: int) -> str:
    """Return the sentence for `count` missing measurements, compared with the number of unknowns."""
    return f"there {'is 1 measurement' if count == 1 else f'are {count} measurements'} fewer than unknowns"


def _undetermined_sentence(problem: Problem, information: Array) -> str:
    """Return a sentence on undetermined unknowns: combinations of biases by name, or a direction.

    `information` (n, n) is the information of the shared unknowns of one problem.
    """
    # biases compensate each other, and the names of this combination help more than a direction
    named = open_sentences(problem.layout, information) if problem.biases and np.isfinite(information).all() else ()
    return "; ".join(named) or weak_direction(problem, information)


def _explain_missing(problem: Problem, pool: Pool, items: Array, code: Array, reason: Array) -> None:
    """Write status and reason of problems without a candidate: the cause that prevents every closed-form start.

    `items` are the numbers of these problems. `code` and `reason` (N,) are written.
    """
    if pool.missing is not None:
        known = items[pool.missing.reason[items] != ""]
        code[known], reason[known] = pool.missing.code[known], pool.missing.reason[known]
        items = np.setdiff1d(items, known)
    if not len(items):
        return
    forbidden = items[(code[items] == Status.INFEASIBLE) | _has_hidden(pool)[items]]
    code[forbidden] = Status.INFEASIBLE
    for i in forbidden:
        bounds = violation_names(problem)
        sentence = (
            f"no minimum satisfies all constraints: {bounds}" if bounds else "the Earth hides every minimum found"
        )
        reason[i] = _hidden_or(pool, int(i), sentence)
    items = np.setdiff1d(items, forbidden)
    single = problem.epochs == 1 or problem.stations.position.shape[-3] == 1
    # the graph of ranges belongs to one position: in a moving run stations are linked over time
    found = ranges(problem.take(items)) if single and len(items) else None
    straight = bool(len(items)) and not isinstance(problem.medium, Layers)
    measured = is_measured(problem.take(items)) if straight else np.zeros(len(items), dtype=bool)
    for place, i in enumerate(items):
        # groups of stations: ranges link the stations within a group, but no range links two groups
        groups = () if found is None else found.groups[int(found.pattern[place])]
        if len(groups) > 1:
            names = problem.stations.names
            code[i] = Status.DISCONNECTED
            reason[i] = "no measurement links " + " with ".join(
                "{" + ", ".join(names[s] for s in sorted(set(group))) + "}" for group in groups
            )
        elif isinstance(problem.medium, Layers):
            code[i] = Status.INFEASIBLE
            reason[i] = "no position was found from which direct rays through the layers reach all stations"
        elif not any(MODELS[rows.kind].ranges or MODELS[rows.kind].lifted for rows in problem.rows) or measured[place]:
            code[i] = Status.UNAVAILABLE
            tried = any(stage.name == "search" for stage in pool.stages)
            kinds = " and ".join(dict.fromkeys(rows.kind for rows in problem.rows))
            reason[i] = f"no closed form gives a start for measurements of {kinds}"
            reason[i] += ", and a search found no minimum" if tried else ": use 'auto', which searches"
        else:
            code[i] = Status.SINGULAR_GEOMETRY
            one = problem.take(np.array([i]))
            reason[i] = _targets_with_few_rows(one) or unmeasured_direction(one) or station_direction(one)


def _targets_with_few_rows(problem: Problem) -> str:
    """Return a sentence that names the targets of one problem with fewer rows than their states need; "" without one.

    The sentence is also "" for a problem of a single target.
    """
    lacking = []
    target = np.concatenate([rows.target for rows in problem.rows])
    for i, motion in enumerate(problem.motions):
        rows = int(((target == i) & (problem.weight[0] > 0.0)).sum())
        needed = (motion.order + 1) * problem.dimension
        if motion.known is None and motion.span == "run" and rows < needed:
            lacking.append(f"target {i} has {rows} measurement{'' if rows == 1 else 's'} for {needed} unknowns")
    return "; ".join(lacking[:_SHOWN]) if len(problem.motions) > 1 else ""


def _has_hidden(pool: Pool) -> Array:
    """Return flags (N,) of problems with a minimum behind the Earth."""
    return np.zeros(len(pool), dtype=bool) if pool.hidden is None else np.asarray(pool.hidden != "", dtype=bool)


def _hidden_or(pool: Pool, item: int, otherwise: str) -> str:
    """Return the sentence on a minimum behind the Earth of one problem, or the sentence `otherwise` if it has none."""
    return otherwise if pool.hidden is None else pool.hidden[item] or otherwise


def _name_hidden(hidden: Array, items: Array, reason: Array) -> None:
    """Append the sentence on a minimum behind the Earth to the reasons of items flagged in `items` (N,)."""
    for i in np.flatnonzero(items & (hidden != "")):
        reason[i] = f"{reason[i]}; {hidden[i]}" if reason[i] else hidden[i]


def _position(problem: Problem, pool: Pool) -> Array:
    """Return the position (N, d), metres, of the only target; NaN without a candidate.

    Without a shared position it is the centre of the stations.
    """
    if problem.layout.shares("position"):
        return problem.layout.take(np.where(np.isfinite(pool.cost[:, :1]), pool.x[:, 0], np.nan), "position")
    return np.broadcast_to(spread_of(problem)[0], (len(pool), problem.dimension))


def _name_rejected(problem: Problem, pool: Pool, items: Array, reason: Array) -> None:
    """Write to the reasons the rows that a robust loss rejected, for problems flagged in `items` (N,)."""
    base = np.broadcast_to(problem.weight, pool.weights.shape)
    is_rejected = (base > 0.0) & (pool.weights < REJECTED * base)
    for i in np.flatnonzero(items & is_rejected.any(1)):
        rows = np.flatnonzero(is_rejected[i])
        shown = ", ".join(map(str, rows[:_SHOWN])) + (" ..." if len(rows) > _SHOWN else "")
        reason[i] = f"{len(rows)} of {int((base[i] > 0.0).sum())} rows were rejected: {shown}; {reason[i]}"


def _mark_contradictions(pool: Pool, cost: Array, finished: Array, marks: Array, reason: Array) -> None:
    """Mark fixes whose data contradict their active constraints.

    Two conditions must be true. The data agree without the constraints. The k active constraints raise the cost by more
    than the chi-square of k degrees of freedom, which noise exceeds once in a thousand cases. Under a robust loss the
    first condition is dropped, since a robust loss allows gross errors. `marks` and `reason` (N,) are written for
    problems flagged in `finished` (N,).
    """
    assert pool.curvature is not None
    if pool.curvature.active is None:
        return
    free = pool.free
    assert free is not None
    active_count = np.array([len(active) for active in pool.curvature.active])
    with np.errstate(invalid="ignore"):
        # whether the data agree without constraints; always true without redundancy
        data_agree = bool(pool.loss) | (pool.dof <= 0) | (chdtrc(np.maximum(pool.dof, 1), free) >= P_SUSPECT)
        costly = chdtrc(np.maximum(active_count, 1), np.maximum(cost - free, 0.0)) < P_SUSPECT
    for i in np.flatnonzero((active_count > 0) & finished & np.isfinite(free) & data_agree & costly):
        names = " and ".join(active.name for active in pool.curvature.active[i])
        marks[i] |= Status.CONTRADICTORY.mark
        reason[i] = (
            f"the data and the constraint {names} disagree: chi-square {cost[i]:.3g} with it, {free[i]:.3g} without it"
        )


def _mark_fences(problem: Problem, pool: Pool, cost: Array, finished: Array, marks: Array, reason: Array) -> None:
    """Mark fixes whose data contradict uncertain fences, under the conditions of `_mark_contradictions`.

    For a target on the boundary, the cost of a fence is chi-square with two degrees of freedom; inside it is smaller.
    Fences far from the fix do not count.
    """
    assert pool.curvature is not None
    with np.errstate(all="ignore"):
        free = unfenced(problem, pool.x[:, 0], pool.curvature.covariance).cost + cost
        near = margins(problem, pool.x[:, 0]) < _NEAR_FENCE
        data_agree = bool(pool.loss) | (pool.dof <= 0) | (chdtrc(np.maximum(pool.dof, 1), free) >= P_SUSPECT)
        costly = chdtrc(np.maximum(2 * near.sum(1), 1), np.maximum(cost - free, 0.0)) < P_SUSPECT
    for i in np.flatnonzero(near.any(1) & finished & np.isfinite(free) & data_agree & costly):
        names = " and ".join(one.name for one, is_near in zip(problem.fences, near[i], strict=True) if is_near)
        marks[i] |= Status.CONTRADICTORY.mark
        reason[i] = f"the data and {names} disagree: chi-square {cost[i]:.3g} with it, {max(free[i], 0.0):.3g} without"


# Margin of a fence, in standard deviations, from which it has no part in a contradiction.
_NEAR_FENCE = 4.0


def _name_redundancy(pool: Pool, finished: Array, reason: Array) -> None:
    """Write to `reason` (N,) the limits that a redundancy of 0 or 1 sets to a search for suspects.

    Only the reasons of fixes flagged in `finished` (N,) change.
    """
    for dof, limit in (
        (0, "a wrong measurement would not be noticed"),
        (1, "a wrong measurement would be noticed, but not identified"),
    ):
        for i in np.flatnonzero(finished & (pool.dof == dof)):
            sentence = f"redundancy {dof}: {limit}"
            reason[i] = f"{reason[i]}; {sentence}" if reason[i] else sentence


_EPOCHS_SHOWN = 8  # epochs that a sentence names
_EXPLAINED = 4  # misfits of a batch that are explained: one explanation takes the time of many fixes


def verdict(problem: Problem, pool: Pool) -> Fix:
    """Return the fixes of a flat batch of problems, after all checks that the status `ok` requires.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Their candidates.
    """
    return _name_misfits(problem, judge(problem, examine(problem, pool)))


def _name_misfits(problem: Problem, fix: Fix) -> Fix:
    """Return fixes of runs with causes of their misfits in the reasons, if there are few misfits."""
    items = np.flatnonzero(fix.code == Status.MISFIT)
    if problem.epochs == 1 or not 0 < len(items) <= _EXPLAINED:
        return fix
    reason = fix.reason.copy()
    for i in items:
        causes = misfit_of(problem.take(np.array([i])), fix.x[i])
        reason[i] = f"{reason[i]}; {causes}" if reason[i] else causes
    return replace(fix, reason=reason)


def judge(problem: Problem, pool: Pool) -> Fix:
    """Return the fixes of a flat batch of problems from the numbers computed so far, for use between stages.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Their candidates; starts that are not refined get the status `unrefined`.
    """
    if pool.curvature is None:
        return _show_starts(problem, pool)
    fix = _as_finished(problem, pool, pool.curvature)
    # the rules take longer than a compiled fix, so they run only for fixes with a finding
    if pool.plain is None:
        fix = _apply_rules(problem, pool, fix)
    elif not pool.plain.all():
        items = np.flatnonzero(~pool.plain)
        fix = overwrite(fix, items, _apply_rules(problem.take(items), take(pool, items), fix[items]))
    if pool.conclusion is not None:
        items = np.flatnonzero(present(pool.conclusion))
        concluded = [_concluded(problem, int(i), pool.conclusion[i]) for i in items]
        # one overwrite for all items: a copy of the whole batch per item would take quadratic time
        fix = overwrite(fix, items, join(concluded, len(concluded))) if concluded else fix
    return fix


def _concluded(problem: Problem, item: int, conclusion: Conclusion | Fix) -> Fix:
    """Return the fix of one item with a conclusion, as a flat batch of one."""
    return (
        conclusion.reshape((1,))
        if isinstance(conclusion, Fix)
        else conclude(problem.take(np.array([item])), conclusion)
    )


def surviving_candidates(pool: Pool, fix: Fix) -> Array:
    """Return the candidates (N, q, size) of a pool; NaN for a best candidate whose verdict shows no position.

    The next stage starts from these candidates.
    """
    if pool.curvature is None:
        return pool.x
    best = np.where(np.isnan(fix.x).all(-1, keepdims=True), np.nan, pool.x[:, 0])
    return np.concatenate([best[:, None], pool.x[:, 1:]], axis=1)


def _as_finished(problem: Problem, pool: Pool, curvature: Curvature) -> Fix:
    """Return the fixes of settled pools as if all were finished and near the stations.

    If `pool.plain` is None, they have no status yet: `_apply_rules` decides it. A *law* is the normal
    distribution of the position, from which bounds near the fix cut off a part.
    """
    count, cost, proven = len(pool), pool.cost[:, 0], _claims(pool)
    law = law_at(problem, pool)
    covariance = curvature.covariance if law is None else _truncated_covariance(problem, pool, law.truncated)
    truncated = None if law is None else law.truncated
    if problem.fences:
        skewed = posterior_spread(problem, pool.x[:, 0], curvature.covariance)
        cut = np.zeros(count, dtype=bool) if truncated is None else truncated.cuts
        covariance = np.where(cut[:, None, None], covariance, skewed)
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(pool.cost[:, 1:]), pool.cost[:, 1:] - cost[:, None], np.inf)
    # if `pool.plain` is None, `_apply_rules` writes marks, reasons and charts
    marks, reason, chart = np.zeros(count, dtype=np.int32), filled_objects(count, ""), None
    if pool.plain is not None or truncated is not None:
        chart = chart_of(problem, pool.x[:, 0], covariance, curvature, truncated)
    if pool.plain is not None:
        marks = finding_marks(problem, pool, gap)
    code = first_status(marks)
    if pool.plain is not None:
        explain(Finished(problem, pool, gap, proven), code, reason)
    return Fix(
        pool.x[:, 0],
        covariance,
        problem.layout,
        problem.frame,
        code,
        reason,
        proven,
        Alternatives(pool.x[:, 1:], gap),
        cost,
        pool.dof,
        pool.weights,
        pool.stages,
        filled_objects(count, ()) if curvature.active is None else curvature.active,
        curvature.local,
        filled_objects(count, ()) if pool.asked else None,
        marks,
        chart,
        np.full(count, np.nan) if pool.infinity is None else pool.infinity - cost,
        reach_of(problem, pool.x[:, 0]),
    )


def _truncated_covariance(problem: Problem, pool: Pool, law: Truncated) -> Array:
    """Return the covariances (N, n, n) of the shared unknowns after the bounds have truncated their laws.

    `law` has the truncated laws of the positions.
    """
    curvature = pool.curvature
    assert curvature is not None
    out = np.array(curvature.covariance)
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    items = np.flatnonzero(law.cuts)
    free = out[items]
    if curvature.free is not None:
        free = np.where((pool.face[items, 0] > 0)[:, None, None], curvature.free[items], free)
    out[items] = covariance_of(take(law, items), free, part)
    return out


def _claims(pool: Pool) -> Claims:
    """Return the claims (N,) of refined answers: the result of their proof, or `NO_PROOF` if no proof was tried."""
    if pool.proven is None:
        return _without_proof(len(pool))
    return merged_claims(pool.proven.tried, pool.proven, NO_PROOF)


@lru_cache(maxsize=64)  # read-only views
def _without_proof(count: int) -> Claims:
    """Return `NO_PROOF` for `count` fixes."""
    return repeated_claims(NO_PROOF, count)


def _apply_rules(problem: Problem, pool: Pool, fix: Fix) -> Fix:
    """Return the fixes with the statuses of the rules; NaN for positions and covariances that are not shown."""
    ruling = decide_statuses(problem, pool, fix.alternatives.gap)
    assert pool.curvature is not None
    regular = pool.curvature.regular
    unknown = ruling.no_position if regular is None else ruling.no_position | ~regular
    x = np.where(ruling.no_position[:, None], np.nan, fix.x)
    covariance = np.where(unknown[:, None, None], np.nan, fix.cov)
    return replace(
        fix,
        x=x,
        cov=covariance,
        code=first_status(ruling.marks),
        marks=ruling.marks,
        reason=ruling.reason,
        claims=ruling.proven,
        cost=np.where(np.isfinite(fix.cost), fix.cost, np.nan),
        chart=chart_of(problem, x, covariance, pool.curvature, None if fix.chart is None else fix.chart.truncated),
    )


def _show_starts(problem: Problem, pool: Pool) -> Fix:
    """Return starts as fixes with the status `unrefined`, or with the reason why a problem has no start."""
    count, n = len(pool), problem.layout.n_shared
    name = pool.stages[-1].name if pool.stages else "start"
    code, reason = np.full(count, int(Status.UNREFINED), dtype=np.int8), filled_objects(count, "not refined")
    empty, broken = pool.empty, _is_broken(problem, count)
    few = (pool.dof < 0) & empty & ~broken
    code[broken & empty], code[few], reason[broken & empty] = Status.REJECTED, Status.TOO_FEW_ROWS, ""
    for i in np.flatnonzero(few):
        reason[i] = _too_few_sentence(-int(pool.dof[i]))
    _explain_missing(problem, pool, np.flatnonzero(empty & ~broken & ~few), code, reason)
    return Fix(
        pool.x[:, 0],
        np.full((count, n, n), np.nan),
        problem.layout,
        problem.frame,
        code,
        reason,
        repeated_claims(claim(Certificate("unknown", "a start, not refined", name)), count),
        Alternatives(pool.x[:, 1:], np.full((count, pool.x.shape[1] - 1), np.nan)),
        np.full(count, np.nan),
        pool.dof,
        pool.weights,
        pool.stages,
    )


def failed_fixes(problem: Problem, cause: str) -> Fix:
    """Return fixes (N,) without an answer, whose status is `numerical` and whose reason is the given cause."""
    count, size, n = problem.batch_shape[0], problem.layout.size, problem.layout.n_shared
    code = np.full(count, int(Status.NUMERICAL), dtype=np.int8)
    return Fix(
        np.full((count, size), np.nan),
        np.full((count, n, n), np.nan),
        problem.layout,
        problem.frame,
        code,
        filled_objects(count, cause),
        repeated_claims(NO_ANSWER, count),
        Alternatives(np.full((count, 0, size), np.nan), np.full((count, 0), np.inf)),
        np.full(count, np.nan),
        # nothing is computed here because it might fail again; a fix without a cost does not need its redundancy
        np.zeros(count, dtype=np.int32),
        np.broadcast_to(problem.weight, (count, problem.count)),
        marks=np.full(count, Status.NUMERICAL.mark, dtype=np.int32),
    )


def hide_open_epochs(fix: Fix) -> Fix:
    """Return fixes of runs with NaN for the states of undetermined epochs; their reasons name these epochs."""
    if fix.local is None or not fix.answered.any():
        return fix
    size = fix.local.shape[-1]  # the states come first among the local unknowns
    undetermined = np.isnan(np.diagonal(fix.local, axis1=-2, axis2=-1)).any(-1) & fix.answered[..., None]
    if not undetermined.any():
        return fix
    x, reason = fix.x.copy(), fix.reason.copy()
    n, length = fix.layout.n_shared, fix.layout.n_local
    states = x[..., n:].reshape(*undetermined.shape, length)
    states[undetermined, :size] = np.nan
    for i in np.ndindex(reason.shape):
        epochs = np.flatnonzero(undetermined[i])
        if len(epochs):
            shown = ", ".join(map(str, epochs[:_EPOCHS_SHOWN])) + (" ..." if len(epochs) > _EPOCHS_SHOWN else "")
            sentence = f"{len(epochs)} of {undetermined.shape[-1]} epochs do not determine their positions: {shown}"
            reason[i] = f"{reason[i]}; {sentence}" if reason[i] else sentence
    x[..., n:] = states.reshape(*x.shape[:-1], -1)
    return replace(fix, x=x, reason=reason)

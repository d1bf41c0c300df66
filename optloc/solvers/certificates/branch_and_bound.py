"""Proofs by branch and bound, over all positions, that a fix is the best minimum.

A proof may find a better or another minimum. The minimum is then refined and added to the candidates.

Letters: N problems of a batch, n problems of a round, q gaps, P points of a problem. d is the number of coordinates of
the state: position, and velocity if the target moves. Costs, gaps and margins are chi-square values. `items` (n,) are
numbers of problems in the batch, and `work` is the state of all proofs, which functions change. `asked` and `answer`
are the requests and the results of the proofs of a round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from time import perf_counter

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.records import change, overwrite, present, take
from optloc.base.types import Array, Certificate
from optloc.kernels.jit import enabled
from optloc.kernels.least_squares import refine
from optloc.linear.constraints import TOLERANCE, exact, violation, violation_names
from optloc.linear.vectors import vectors
from optloc.problem.chart import quantile
from optloc.problem.claims import GLOBAL, PROOFS, REGION, UNKNOWN, Claims, claim, empty_claims
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Stage
from optloc.problem.problem import Problem
from optloc.proof.batch import ProofRequest, ProofResult
from optloc.proof.global_search import UNBOUNDED
from optloc.proof.local_search import BETTER, BUDGET, COARSE, OPEN, OTHER, UNIQUE, VALUE
from optloc.proof.scaled.scaled_proof import ScaledCosts
from optloc.proof.scope import has_one_epoch_velocity, why_unsupported
from optloc.proof.search_space import HIDDEN_REACH
from optloc.solvers.certificates.position_cost import (
    Costs,
    boxes_around,
    eliminate_nuisance,
    is_free,
    lacks,
    matches_problem_cost,
    prove,
    regions_of,
    state_columns,
    surfaces_of,
    why_unlimited,
)
from optloc.solvers.horizon import is_hidden
from optloc.solvers.policy import AMBIGUOUS_GAP, LISTED_GAP, equal_cost
from optloc.solvers.pool import Pool, TriedBefore, offer, pack
from optloc.solvers.stages import lsr
from optloc.solvers.verdict.judge import judge, surviving_candidates

# Sentences of certificates.

Corner = tuple[float, ...]

METHOD = "branch and bound"
# Reasons for a missing proof.
UNFINISHED = "the proof was not finished within its budget of boxes"
LACKS_CODE = "; compiled code allows more boxes: run `optloc compile` once, which takes minutes"
FINE = (
    "the stated noise is smaller than the rounding of ranges and coordinates, so that no proof is possible; "
    "state a larger noise, or a nearer origin"
)
AROUND = "the region reaches around the Earth, but a proof covers one side only; give a smaller region"
SCALED = "the position is not bounded at all scales that the rows and priors allow"
FAST = "the position is not bounded at all velocities that the rows and the prior allow"
UNSETTLED = "the fix is not a strict minimum: the data do not distinguish it from its neighbourhood"
BARRED = "a position with a lower cost exists, but {}"
LOST = "a position with a lower cost was found, but refinement from it gave no minimum"
HELD = "an inequality constraint is active at the fix, and the proof supports equalities only"
REMOTE = "positions at ever larger distances explain the data about equally well"
TURNS = "biases of angles may reach a whole turn at a cost that is not excluded"
RESTLESS = "the proof kept finding new minima"
MISMATCHED = "the cost in the proof differs from the cost of the fix"


def unknown_claim(reason: str) -> Claims:
    """Return the claim "unknown" for fixes without a proof, with the reason as a sentence; shape ()."""
    return claim(Certificate("unknown", reason, METHOD))


def state_claims(
    cost: Array, bound: Array, margin: Array, boxes: Array, listed: Array, everywhere: Array | bool = True
) -> Claims:
    """Return the claims (n,) about proven fixes. The caller adds the region to claims that do not cover all positions.

    Parameters
    ----------
    cost, bound : array (n,)
        Costs of the fixes, and certified lower bounds.
    margin : array (n,)
        Proven gaps to other minima; 0 for the value alone.
    boxes : int array (n,)
        Boxes used.
    listed : int array (n,)
        Number of listed alternatives, which a claim excepts.
    everywhere : bool array (n,)
        Whether a claim covers all positions.
    """
    out = replace(
        empty_claims(len(cost)), bound=bound, gap=cost - bound, unique=margin > 0.0, margin=margin, boxes=boxes
    )
    out.proof[:], out.method[:] = np.where(everywhere, GLOBAL, REGION), METHOD
    # a batch has many fixes but few different claims
    for gap in np.unique(margin):
        for count in np.unique(listed[margin == gap]):
            out.reason[(margin == gap) & (listed == count)] = claim_sentence(float(gap), int(count), None)
    return out


# coordinates of space
_SPACE = 3


@lru_cache(maxsize=256)  # the fixes of a call have few different margins, and formatting numbers is slow
def claim_sentence(margin: float, listed: int, region: tuple[Corner, Corner] | None) -> str:
    """Return the claim about a proven fix as a sentence: over all positions, or over a region.

    `margin` is the proven gap of cost and `listed` the number of alternatives that the claim excepts, as in
    `state_claims`. `region` has the corners of the region, metres and metres per second; None means all positions.
    A solution is a local minimum. Positions near the fix have almost the same chi-square and are no other solution.
    """
    where = "" if region is None else f" {_where(*region)}"
    if margin <= 0.0:
        return f"no position{where} has a lower chi-square; other minima were searched for, not excluded"
    except_listed = "" if not listed else f" except the {'one' if listed == 1 else listed} listed"
    there = " there" if where else ""
    return f"proven best{where}; any other solution{there}{except_listed} raises chi-square by at least {margin:g}"


def _where(lower: Corner, upper: Corner) -> str:
    """Return the part of a claim that names the region: lower and upper corner in m, and in m/s for velocities."""
    d = len(lower) // 2 if len(lower) > _SPACE else len(lower)
    words = f"from {_text(lower[:d])} to {_text(upper[:d])} m"
    return words if d == len(lower) else f"{words} at a velocity from {_text(lower[d:])} to {_text(upper[d:])} m/s"


def _text(corner: Corner) -> str:
    """Return the coordinates of a corner as text."""
    return "(" + ", ".join(f"{v:.6g}" for v in corner) + ")"


# Gaps to other minima that a proof tries in turn; the last gap is the value alone. If infinity costs too little for a
# gap, the cost of the 95 % region is tried before the last one.
_MARGINS, _LEVEL = (LISTED_GAP, AMBIGUOUS_GAP, 0.0), 0.95
# Rounds of proof and repair: every margin may be lowered and the region tried, with a few minima found in between.
_ROUNDS = 6
# Boxes for a proof, with up to `_NODES` residual terms. Four arrivals and a measured height take 9 000 over the whole
# Earth. Of 2 200 fixes of 55 mixtures, 39 were unproven after 3 000 boxes. After 8 000 boxes 20 were unproven, in 1.3
# times the total time; after 30 000 boxes 11, in 1.5 times. Plain Python takes a thousand times longer for each box, so
# all fixes together share its budget.
_BUDGET, _NODES, _SLOW_BUDGET, _AT_LEAST = 30_000, 12, 2000, 5
ALL_AROUND = 2
"""Factor of the budget on the surface of a height.

Three range differences took 20 000 to 40 000 boxes around the whole Earth, of two coordinates and 2 us each.
"""
# A minimum that a proof found is a listed one within this share of its distance from the fix: the accuracy of a
# descent.
_SAME = 1e-3
HIDDEN = 4
"""Most minima behind the Earth (mirror images) that a proof excepts. A fix with more has no proof."""


@dataclass(slots=True)
class BoundWorkspace:
    """State of the proofs of a flat batch of N pools; better candidates replace entries.

    Parameters
    ----------
    problem : Problem
        N problems within the scope of the proof.
    pool : Pool
        Their candidates.
    fix : Fix
        The verdict of the pool.
    proven : Claims
        Claims of the fixes.
    costs : PositionCosts, Runs or Courses
        Their costs over the position, without equalities.
    ignored : array (N, h, d)
        Minima that the Earth hides; NaN in empty slots.
    region : array (N, 2, d)
        Corners of the regions of the claims; NaN for all positions.
    fallback : array (N, 2, d)
        Corners of the regions that replace them if the search cannot be bounded.
    margins : array (q,)
        Gaps to prove in turn if proofs are not finished. The last but one is used only if infinity costs little.
    level : int array (N,)
        Index of the current margin.
    pending : bool array (N,)
        Fixes without a final claim.
    effort : float
        Factor of budgets and rounds.
    limited : bool
        Whether the claims are limited to a requested region.
    spent : int array (N,)
        Boxes of all proofs tried.
    replaced, listed, mismatched : int
        Numbers of replaced fixes, of minima added to the alternatives, and of proofs for another cost than the cost of
        their fix.
    """

    problem: Problem
    pool: Pool
    fix: Fix
    proven: Claims
    costs: Costs
    ignored: Array
    region: Array
    fallback: Array
    margins: Array
    level: Array
    pending: Array
    effort: float
    limited: bool
    spent: Array
    replaced: int = 0
    listed: int = 0
    mismatched: int = 0

    @classmethod
    def begin(
        cls, problem: Problem, pool: Pool, fix: Fix, answered: Array, region: Array | None, margin: float, effort: float
    ) -> BoundWorkspace:
        """Return the state of the proofs before the first round.

        `answered` (N,) flags the fixes to prove; `region` (2, d) has the requested corners; `margin` is the requested
        gap of cost; `effort` multiplies budgets and rounds.
        """
        size, state = len(fix.x), fix.x[:, state_columns(problem)]
        d = state.shape[-1]
        corners, limited = regions_of(problem, state, region)
        return cls(
            problem,
            pool,
            fix,
            claims_before(pool),
            eliminate_nuisance(problem),
            np.full((size, 0, d), np.nan),
            corners,
            boxes_around(problem, state),
            np.array(gaps_below(margin, d)),
            np.zeros(size, dtype=np.int64),
            np.array(answered),
            effort,
            limited,
            np.zeros(size, dtype=np.int64),
        )

    def summary(self) -> str:
        """Return a summary of the proofs, in a few words."""
        proof = np.where(self.proven.tried, self.proven.proof, self.fix.claims.proof)
        proofs = np.bincount(proof, minlength=len(PROOFS))
        counts = [f"{proofs[k]} {PROOFS[k]}" for k in (GLOBAL, REGION, UNKNOWN) if proofs[k]]
        more = [f"{self.replaced} fixes replaced by better ones"] if self.replaced else []
        more += [f"{self.listed} other minima found"] if self.listed else []
        if self.mismatched:
            more.append(f"{self.mismatched} position cost{'s' if self.mismatched > 1 else ''} did not match")
        return ", ".join(counts + more)


def gaps_below(margin: float, dimension: int) -> list[float]:
    """Return the gaps of cost to prove in turn, in descending order: from the requested gap down to 0, the value alone.

    `dimension` is the number of coordinates of the state. It determines the cost of the 95 % region.
    """
    below = [m for m in _MARGINS if m < margin]
    near = min(quantile(_LEVEL, dimension), margin)
    return [margin, *below[:-1], near, 0.0] if margin > 0.0 else [0.0]


def settle(work: BoundWorkspace) -> BoundWorkspace:
    """Run rounds of proofs and return the state with a final claim for every pending fix."""
    asked = np.flatnonzero(work.pending)
    for _ in range(int(_ROUNDS * max(work.effort, 1))):
        items = np.flatnonzero(work.pending)
        if not len(items):
            break
        _run_round(work, items)
    _give_up(work, np.flatnonzero(work.pending), RESTLESS)
    _compare(work, asked)
    return work


def _compare(work: BoundWorkspace, items: Array) -> None:
    """Withdraw proofs of a position cost that differs from the cost of the problem: they do not apply to the fix."""
    proven = items[np.isin(work.proven.proof[items], (GLOBAL, REGION))]
    if not len(proven):
        return
    off = proven[~matches_problem_cost(work.problem.take(proven), work.fix[proven], work.costs.take(proven))]
    _give_up(work, off, MISMATCHED)
    work.mismatched += len(off)


def _run_round(work: BoundWorkspace, items: Array) -> None:
    """Run one proof for each item (n,). Then write its claim, add the minima that it found, or lower its margin."""
    free = is_free(work.problem, work.fix, items)
    _give_up(work, items[~free], HELD)
    asked, costs = _requests(work, items), work.costs.take(items)
    # Above `costs.level`, wrapping may change a residual by a whole turn, and the bounds of the proof are not valid.
    turning = free & (costs.level < work.fix.cost[items] + asked.gaps[:, 0])
    _lower_margin(work, items[turning], TURNS)
    good = np.flatnonzero(free & ~turning)
    if not len(good):
        return
    if len(good) < len(items):
        items, asked, costs = items[good], asked.take(good), costs.take(good)
    answer = prove(costs, asked)
    work.spent[items] += answer.boxes
    done, has_rivals = np.isin(answer.verdict, (UNIQUE, VALUE)), answer.met > 0
    holds = done & ~has_rivals
    if (done & has_rivals).any():
        holds[done & has_rivals] = _list_rivals(work, items[done & has_rivals], answer.take(done & has_rivals))
    _claim(work, items, asked, answer, np.flatnonzero(holds))
    out_of_budget, last = answer.verdict == BUDGET, len(work.margins) - 1
    # The proof failed at smaller gaps too, so only the value alone is left: `_lower_margin` adds 1 to the level.
    below = out_of_budget & (answer.gap < asked.gaps[:, 0])
    work.level[items[below]] = last - 1
    _lower_margin(work, items[out_of_budget], _unfinished(work.costs, len(items)))
    remote = answer.verdict == UNBOUNDED
    work.level[items[remote & (answer.gap == 0.0)]] = last  # the value alone failed too, so a region is next
    _lower_margin(work, items[remote], REMOTE, remote=True)
    found = np.isin(answer.verdict, (BETTER, OTHER))
    if found.any():
        _add_candidates(work, items[found], answer.found[found], answer.verdict[found] == BETTER)
    fine, unclosed = answer.verdict == COARSE, answer.verdict == OPEN
    _give_up(work, items[fine], FINE)
    # on the surface of a height the boxes ran out before the proof tried a region
    scaled = isinstance(work.costs, ScaledCosts)
    unbounded = (
        (FAST if has_one_epoch_velocity(work.problem) else SCALED) if scaled else _unfinished(work.costs, len(items))
    )
    _give_up(work, items[unclosed], AROUND if work.limited and not scaled else unbounded)
    _give_up(work, items[~(done | out_of_budget | remote | found | fine | unclosed)], UNSETTLED)


def _requests(work: BoundWorkspace, items: Array) -> ProofRequest:
    """Return the proof requests of items (n,), with the margins, regions and known minima of this round."""
    fix, ignored, last = work.fix, work.ignored[items], len(work.margins) - 1
    gaps = work.margins[np.minimum(work.level[items, None] + np.arange(last + 1), last)]
    gap_now = gaps[:, 0]
    columns = state_columns(work.problem)
    planes, surface = surfaces_of(work.problem.take(items), fix.position[items])
    gap = fix.alternatives.gap[items]
    with np.errstate(invalid="ignore"):
        listed = np.isfinite(gap) & (gap < np.maximum(gap_now, AMBIGUOUS_GAP)[:, None])
    place = fix.alternatives.x[items][..., columns]
    others = pack(np.concatenate([np.where(listed[..., None], place, np.nan), ignored], axis=1))
    hidden = np.isfinite(ignored).all(-1).sum(1)
    return ProofRequest(
        x=fix.x[items, columns],
        others=np.where(np.isfinite(others), others, 0.0),
        known=np.isfinite(others).all(-1).sum(1),
        hidden=hidden,
        gaps=gaps,
        eps=equal_cost(fix.cost[items]),
        region=work.region[items],
        fallback=work.fallback[items],
        budget=budgets(len(gap_now), work.costs.dense, work.effort) * (ALL_AROUND if surface.shape[1] else 1),
        planes=planes,
        surface=surface,
    )


def budgets(n: int, nodes: float, effort: float) -> Array:
    """Return the numbers of boxes (n,) that n proofs may use.

    `nodes` is the number of residual terms of dense rows: the time of a box grows with its square. `effort` multiplies
    the budget of compiled code. Plain Python has a fixed budget, which the n proofs share.
    """
    if not enabled():
        return np.full(n, max(_AT_LEAST, _SLOW_BUDGET // max(n, 1)))
    # the budget limits the time, so the number of boxes falls with the number of terms
    share = max(1.0, (nodes / _NODES) ** 2) / effort
    return np.full(n, int(_BUDGET / share))


def _unfinished(costs: Costs, count: int) -> str:
    """Return the reason of an unfinished proof, with a hint if machine code for `count` fixes is missing."""
    return UNFINISHED + (LACKS_CODE if lacks(costs, count) else "")


def _lower_margin(work: BoundWorkspace, items: Array, why: str, *, remote: bool = False) -> None:
    """Lower the margin of failed proofs, then limit the claim to a region; give up if both were tried.

    `why` is the reason for giving up. `remote` allows the gap of the 95 % region, for fixes with a low cost at
    infinity.
    """
    last = len(work.margins) - 1
    work.level[items] += 1
    if not remote:  # skip the gap of the 95 % region, the last but one
        work.level[items] += work.level[items] == max(last - 1, 1)
    spent = items[work.level[items] > last]
    everywhere = np.isnan(work.region[spent, 0, 0])
    regional = spent[everywhere]
    work.region[regional] = work.fallback[regional]
    work.level[regional] = 1 if last > 2 else last  # the largest gap failed, so it is not tried in the region
    _give_up(work, spent[~everywhere], why)


def _give_up(work: BoundWorkspace, items: Array, why: str) -> None:
    """Write the final claim "unknown" with a reason for some fixes."""
    work.proven.write(items, unknown_claim(why))
    work.proven.boxes[items] = work.spent[items]
    work.pending[items] = False


def _claim(work: BoundWorkspace, items: Array, asked: ProofRequest, answer: ProofResult, done: Array) -> None:
    """Write the claims of finished proofs; `done` are their indices among the n items, requests and results."""
    proven, kappa = items[done], answer.gap[done]
    listed = (work.fix.alternatives.gap[proven] < kappa[:, None]).sum(1)
    claims = state_claims(
        work.fix.cost[proven], answer.bound[done], kappa, answer.boxes[done], listed, answer.everywhere[done]
    )
    claims.asked[:] = work.limited
    for k in np.flatnonzero(~answer.everywhere[done]).tolist():
        whole = np.isnan(asked.region[done[k], 0, 0])
        corners = (asked.fallback if whole else asked.region)[done[k]]
        low, high = corners[:, np.isfinite(corners).all(0)].tolist()  # a known height is no limit of the claim
        claims.region[k] = region = tuple(low), tuple(high)
        claims.reason[k] = claim_sentence(float(kappa[k]), int(listed[k]), region)
    work.proven.write(proven, claims)
    work.pending[proven] = False


def _add_candidates(work: BoundWorkspace, items: Array, points: Array, better: Array) -> None:
    """Refine points (n, d) that proofs found, and add them to the candidates; `better` (n,) flags cheaper points."""
    _, changed = _judge_with_points(work, items, points[:, None])
    _handle_unchanged(work, items[~changed], points[~changed], better[~changed])


def _list_rivals(work: BoundWorkspace, items: Array, answer: ProofResult) -> Array:
    """Refine the other minima of finished proofs, add them to the candidates, and return flags (n,) of valid claims.

    A claim is valid if the fix is still the best minimum and every other minimum is now a listed alternative.
    """
    rivals = answer.rivals[:, : answer.met.max()]
    rivals = np.where((np.arange(rivals.shape[1]) < answer.met[:, None])[..., None], rivals, np.nan)
    lower, changed = _judge_with_points(work, items, rivals)
    fix, columns = work.fix[items], state_columns(work.problem)
    known, place = fix.alternatives.x[..., columns], fix.x[:, None, columns]
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(known[:, None] - rivals[:, :, None], axis=-1)
        near = (apart <= _SAME * np.linalg.norm(rivals - place, axis=-1, keepdims=True)).any(-1)
    holds = ~lower & fix.answered & (near | np.isnan(rivals[..., 0])).all(1)
    stuck = ~changed & ~holds
    _handle_unchanged(work, items[stuck], rivals[stuck, 0], np.zeros(stuck.sum(), dtype=bool))
    return np.asarray(holds)


def _judge_with_points(work: BoundWorkspace, items: Array, points: Array) -> tuple[Array, Array]:
    """Refine points (n, P, d) and judge them with the candidates of some fixes.

    Return flags (n,) of fixes that cost less now, and flags (n,) of fixes that changed in any way.
    """
    began = perf_counter()
    part, old, before = work.problem.take(items), work.fix[items], take(work.pool, items)
    x = pack(np.concatenate([surviving_candidates(before, old), vectors(part, points)], axis=1))
    pool = keep_evidence(lsr(part, offer(part, x, before, "certify", began)), before)
    judged = judge(part, pool)
    with np.errstate(invalid="ignore"):
        lower = judged.cost < old.cost - equal_cost(old.cost)
        more = np.isfinite(judged.alternatives.gap).sum(1) > np.isfinite(old.alternatives.gap).sum(1)
    changed = lower | more | ~judged.answered
    work.replaced += int(lower.sum())
    work.listed += int(more.sum())
    keep = np.flatnonzero(changed)
    if len(keep):
        work.pool = work.pool.merge(items[keep], take(pool, keep))
        work.fix = overwrite(work.fix, items[keep], judged[keep])
        work.pending[items[keep]] = judged.answered[keep]
    return lower, changed


def _handle_unchanged(work: BoundWorkspace, items: Array, points: Array, better: Array) -> None:
    """Store hidden minima, give up fixes, or lower margins for points (n, d) that changed no candidate.

    If a point costs less than its fix, flagged in `better` (n,), and is not hidden, the fix is given up.
    """
    stuck = np.flatnonzero(~_ignore(work, items, points))
    _give_up_forbidden(work, items, points, stuck[better[stuck]])
    _lower_margin(work, items[stuck[~better[stuck]]], _unfinished(work.costs, len(items)))


def _give_up_forbidden(work: BoundWorkspace, items: Array, points: Array, barred: Array) -> None:
    """Give up the fixes whose cheaper point did not replace them, with the reason why the point is forbidden.

    `barred` are the indices of these fixes among `items` (n,) and `points` (n, d).
    """
    if not len(barred):
        return
    part = work.problem.take(items[barred])
    x = vectors(part, points[barred, None])[:, 0]
    broken, hidden = violation(part, x) > TOLERANCE, is_hidden(part, x)
    names = violation_names(work.problem)
    for item, breaks, behind in zip(items[barred], broken, hidden, strict=True):
        why = f"a constraint forbids it ({names})" if breaks else "the Earth hides it from a station"
        _give_up(work, np.array([item]), BARRED.format(why) if breaks or behind else LOST)


def _ignore(work: BoundWorkspace, items: Array, points: Array) -> Array:
    """Store the minima next to points (n, d) that the Earth hides; return flags (n,) of new ones."""
    problem = work.problem
    # only the Earth hides minima, and a fix with more than `HIDDEN` of them has no proof
    if not problem.frame.geodetic or problem.motions[0].order or not len(items) or work.ignored.shape[1] >= HIDDEN:
        return np.zeros(len(items), dtype=bool)
    part = problem.take(items)
    done = refine(part, vectors(part, points[:, None])[:, 0], face=exact(problem))
    place = problem.layout.take(done.x, "position")
    # tolerance for two refinements of the same minimum: metres in Earth-centred coordinates
    known = (np.abs(work.ignored[items] - place[:, None]) <= 1e-6 * np.abs(place[:, None])).all(-1).any(1)
    fresh = is_hidden(part, done.x, HIDDEN_REACH) & ~known
    more = np.full((len(work.ignored), 1, place.shape[-1]), np.nan)
    more[items[fresh], 0] = place[fresh]
    work.ignored = np.concatenate([work.ignored, more], axis=1)
    return np.asarray(fresh)


def keep_evidence(pool: Pool, before: Pool) -> Pool:
    """Return a pool with the lower cost at infinity of both pools, and with the remarks of the pool `before`."""
    infinity = pool.infinity if before.infinity is None else before.infinity
    if pool.infinity is not None and before.infinity is not None:
        infinity = np.fmin(pool.infinity, before.infinity)
    return replace(pool, infinity=infinity, searched=before.searched, remark=before.remark, asked=before.asked)


def certified_freely(
    problem: Problem, pool: Pool | None, region: Array | None = None, margin: float = LISTED_GAP, effort: float = 1
) -> Pool:
    """Return the pools of a flat batch with certificates over all positions; inequalities are ignored.

    `pool` has the refined candidates of N problems. `region` (2, d) is as of `admitted.certify`, `margin` the gap of
    cost to prove, and `effort` the factor of the boxes that a proof may use.
    """
    if pool is None:
        raise InvalidProblem("certify needs a fix", "method", "put it after a refinement, as in 'gtrs+lsr+certify'")
    began = perf_counter()
    fix = judge(problem, pool)
    answered, proven_before = fixes_to_prove(pool, fix)
    why = why_unsupported(problem)
    if not why and region is None and effort <= 1:  # an explicit call gets any proof
        why = why_unlimited(problem)
    if why or not answered.any():
        proven = claims_before(pool)
        proven.write(answered, unknown_claim(why))
        return replace(pool, proven=proven, stages=(*pool.stages, certify_stage(why or "nothing to prove", began)))

    work = BoundWorkspace.begin(problem, pool, fix, answered & ~proven_before, region, margin, effort)
    if pool.tried_before is not None:
        work.proven.write(proven_before, take(pool.tried_before.proven, proven_before))
    work = settle(work)
    stages = (*pool.stages, certify_stage(work.summary(), began))
    return replace(work.pool, proven=work.proven, stages=stages)


def tried_before(pool: Pool, fix: Fix, items: Array) -> TriedBefore | None:
    """Return the proofs tried for fixes `items` of a pool, for a later stage; None without tried proofs."""
    if pool.proven is None:
        return None
    return TriedBefore(fix.cost[items], count_listed(fix)[items], take(pool.proven, items))


def claims_before(pool: Pool) -> Claims:
    """Return a writable copy of the claims (N,) of a pool; empty claims if no proof was tried."""
    return empty_claims(len(pool)) if pool.proven is None else change(pool.proven, lambda array, core: np.array(array))


def count_listed(fix: Fix) -> Array:
    """Return the number of listed alternatives of each fix, (N,)."""
    return np.asarray(np.isfinite(fix.alternatives.gap).sum(1))


def fixes_to_prove(pool: Pool, fix: Fix) -> tuple[Array, Array]:
    """Return flags (N,) of fixes that can be proven, and flags (N,) of those whose earlier claim is still valid."""
    answered = fix.answered & np.isfinite(fix.cost)
    if pool.conclusion is not None:
        answered &= ~present(pool.conclusion)  # a conclusion leaves rows out
    return answered, answered & _is_still_valid(pool.tried_before, fix)


def _is_still_valid(before: TriedBefore | None, fix: Fix) -> Array:
    """Return flags (N,) of earlier claims, in `before`, about the same minima as the fixes: they are still valid.

    Known minima stay candidates. So an equal number of minima and an equal least cost mean the same minima.
    """
    if before is None:
        return np.zeros(len(fix.x), dtype=bool)
    alike = (before.listed == count_listed(fix)) & (np.abs(fix.cost - before.cost) <= equal_cost(fix.cost))
    return np.asarray(before.proven.tried & alike)


def certify_stage(detail: str, began: float) -> Stage:
    """Return the stage "certify" with its detail; it began at `began`, a time of `time.perf_counter`."""
    return Stage("certify", detail, perf_counter() - began)

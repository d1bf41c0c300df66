"""The short path: a few fixes of one problem from new measurements to the verdict, in compiled code, without batches.

Everything that does not depend on the measurements is stored: the linear maps of the fix, the terms of the proof, and
the constant columns of the verdict. For a fix with a complication, such as a rival minimum, a doubtful cost or an
unfinished proof, the result is None. The caller then runs the stages of the method: the long path.

Letters: n fixes, m rows, d coordinates, e planes of equalities, k constraints, `size` numbers of a parameter vector.
The parameter `answer` has the arrays that the compiled code of the plan writes.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import inf, isnan, prod
from threading import local
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from optloc.base.cache import Cache
from optloc.base.errors import NUMERICAL
from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array, Band, Certificate, Status, first_status
from optloc.engine.admission import levels_of
from optloc.engine.memory import Answer, EngineResult
from optloc.engine.plan import LIMIT, MOST, TOLERANCE, Load, Plan, blank_answer, is_planned, key_of, plan_of
from optloc.engine.shape import STRAIGHT
from optloc.kernels.jit import may_use_code
from optloc.linear.constraints import is_exact, violation_names
from optloc.linear.redundancy import largest
from optloc.model_checks.coplanar import normal_of
from optloc.model_checks.truncation import are_near, has_law
from optloc.problem.chart import CARTESIAN, CURVED, Chart, quantile
from optloc.problem.claims import Claims, claim, repeated_claims
from optloc.problem.epochs import separable
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Alternatives, Stage
from optloc.problem.problem import Problem
from optloc.proof.batch import ProofRequest, ProofResult, empty_answer, lacks_code, prove_here
from optloc.proof.local_search import OTHER, UNIQUE
from optloc.proof.position_costs import Affine, PositionCosts, affine_costs
from optloc.proof.scope import is_run, is_scaled, why_unsupported
from optloc.proof.search_space import HIDDEN_REACH
from optloc.proof.surface import UP
from optloc.solvers.certificates.branch_and_bound import (
    ALL_AROUND,
    HIDDEN,
    METHOD,
    budgets,
    certify_stage,
    claim_sentence,
    gaps_below,
)
from optloc.solvers.certificates.out_of_reach import Edges, ReachWorkspace, are_out_of_reach, edges_of, new_workspace
from optloc.solvers.certificates.position_cost import matches_problem_cost, surfaces_of
from optloc.solvers.coplanar import APART
from optloc.solvers.horizon import Sight, sights
from optloc.solvers.methods import Method
from optloc.solvers.planned import active_of, planned_stages
from optloc.solvers.policy import AMBIGUOUS_GAP, LISTED_GAP, P_MISFIT, P_SUSPECT, REGION_LEVEL, equal_cost
from optloc.solvers.verdict.findings import (
    BENT_SENTENCE,
    NO_PROOF,
    NOT_TRIED,
    ambiguity,
    centre_of,
    chart_kind,
    marks_of,
)
from optloc.solvers.verdict.repeats import holds, is_repeatable, repeat

# Stages of methods that can take the short path, and whether they include a proof.
_WORDS = {("gtrs", "lsr"): False, ("gtrs", "lsr", "certify"): True}


# Reasons of fixes by status, and of curved fixes also by the kind of their chart. Other reasons contain numbers: only
# the long path writes them.
_SENTENCES: dict[tuple[Status, int | None], str] = {
    (Status.OK, None): "",
    (Status.UNPROVEN, None): NOT_TRIED,
    **{(Status.CURVED, kind): claim_sentence for kind, claim_sentence in BENT_SENTENCE.items()},
}
# The claim of a complete proof, as `ok` requires it, without its bound.
_PROVEN = claim(Certificate("global", claim_sentence(LISTED_GAP, 0, None), METHOD, unique=True, margin=LISTED_GAP))
_NOTHING = np.empty((), dtype=object)
_NOTHING[()] = ()
# Largest difference between the bound of a proof and the cost, in units of `equal_cost`. The bound is one unit below.
_APART = 3.0


# Most problems on the short path: for more problems a batch takes no longer.
MANY = 64
# Batch shapes for which a thread stores arrays. A stream has one or two shapes, and each takes some kilobytes.
_WORKSPACES = 4


@dataclass(slots=True)
class _SingleWorkspace:
    """The arrays that one thread writes to for n problems, and the constant parts of their fixes.

    Parameters
    ----------
    z : array (n, m)
        Measurements.
    found : tuple of array
        Fields of `optloc.engine.memory.Answer`, without position and covariance.
    costs : PositionCosts
        With the whitened measurements; empty without a proof.
    asked, answered : ProofRequest, ProofResult
        Requests and results of the proofs.
    centre : array (..., d)
        Centre of the charts, metres.
    claims : Claims
        Claims of the fixes, without the bounds and boxes of proofs.
    no_active : object array (...)
        Empty tuples: no constraint is active at a fix.
    no_alternatives : Alternatives
        Empty: no other minimum.
    reach : ReachWorkspace, optional
        Workspace of the proofs that bounds are out of reach.
    constants : dict
        Fields of a fix that are the same for all measurements, as read-only arrays.
    checked : bool
        Whether the position cost of a first fix was compared with the cost of the problem.
    """

    z: Array
    found: tuple[Array, ...]
    costs: PositionCosts
    asked: ProofRequest
    answered: ProofResult
    centre: Array
    claims: Claims
    no_active: Array
    no_alternatives: Alternatives
    reach: ReachWorkspace | None
    constants: dict[str, Any]
    checked: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class PreparedFix:
    """One problem without batch axes, prepared to fix new measurements on the short path; see `prepare_fix`.

    Parameters
    ----------
    problem : Problem
        The problem; its measurements do not matter.
    plan : Plan
        Its plan.
    load : Load
        The numbers of the problem that the plan takes as arguments.
    map : Affine, optional
        Map from measurements to the position costs of the proof; None for methods without a proof.
    planes, surface : array (1, e, 3), array (1, 0) or (1, SURFACE_WIDTH)
        Planes and surface to which proofs are limited, see `optloc.proof.batch.ProofRequest`.
    upward : int, optional
        Number of the height constraint whose gradient is the upward axis of the surface.
    edges : Edges, optional
        Bounds that proofs show to be out of reach; None without bounds.
    sights : list of Sight
        Lines of sight that the Earth may block.
    normal : array (d,), optional
        Normal of the plane of all stations, if both sides of the plane fit equally well.
    absent : bool array (m,), optional
        Rows of weight zero, whose values are arbitrary; None if all rows count.
    centre : array (d,)
        Middle of the stations, metres.
    doubt, refuted, region : float
        Three limits of the cost. Above `doubt` a fix takes the long path, and `refuted` refutes the model. `region` is
        the largest excess in the likelihood region.
    often : bool
        Whether the problem is fixed often enough to load machine code for it.
    repeatable : bool
        Whether repeats of the measurement can be simulated for a curved fix.
    limits : array (k, 2), optional
        Bounds that may truncate the law of the position; None without bounds.
    thread : threading.local
        Workspaces of each thread.
    """

    problem: Problem
    plan: Plan
    load: Load
    map: Affine | None
    planes: Array
    surface: Array
    upward: int | None
    edges: Edges | None
    sights: list[Sight]
    normal: Array | None
    absent: Array | None
    centre: Array
    doubt: float
    refuted: float
    region: float
    often: bool
    repeatable: bool
    limits: Array | None
    thread: local = field(default_factory=local)

    def __call__(self, z: Array) -> Fix | None:
        """Return the fix of measurements (m,), or the fixes (n,) of measurements (n, m).

        None if one of the fixes needs the long path.
        """
        began, shape, plan = perf_counter(), z.shape[:-1], self.plan
        n = prod(shape)
        kernel = plan.kernel(n, often=self.often)
        if not may_use_code(kernel, n) or (self.map is not None and lacks_code(n)):
            return None
        workspace, size, shared = self._workspace(shape), plan.size, plan.shared
        workspace.z[:] = z
        if self.absent is not None:
            workspace.z[:, self.absent] = 0.0
        answer = Answer(np.empty((n, size)), np.empty((n, shared, shared)), *workspace.found)
        # False: the kernel computes the start from the measurements, instead of reading it from `answer`
        steps = kernel(*self.load[:2], workspace.z, self.load.place, TOLERANCE, LIMIT, False, answer)
        found = [EngineResult(*numbers) for numbers in answer.number.tolist()]
        for one in found:
            # on Earth, satellite visibility decides between two minima of equal cost, on the long path
            tied = self.plan.frame.geodetic and one.rival_cost - one.cost <= equal_cost(one.cost)
            if not one.settled or tied or not one.cost <= self.doubt:
                return None
        if self.limits is not None and self._is_near_bound(self.limits, answer):
            return None
        if self.normal is not None and self._is_near_plane(self.normal, answer):
            return None
        fixed = perf_counter()
        stages = planned_stages(n, steps, fixed - began)
        if self.map is not None:
            if not self._proves(self.map, answer, found, workspace):
                return None
            scope = "global" if self.edges is None else f"within {violation_names(self.problem)}"
            stages = (*stages, certify_stage(f"{n} {scope}", fixed))
        fix = self._judge(shape, answer, found, stages, workspace)
        if fix is not None and not workspace.checked:
            workspace.checked = self._agrees(fix, workspace)
            return fix if workspace.checked else None
        return fix

    def _is_near_bound(self, limits: Array, answer: Answer) -> bool:
        """Return whether a bound may truncate the law of a fix; `limits` (k, 2) are the bounds."""
        d = self.load.place.shape[-1]
        # equalities come first
        columns = slice(answer.quantity.shape[1] - len(limits), None)
        return are_near(limits, answer.quantity[:, columns], answer.normal[:, columns], answer.covariance[:, :d, :d])

    def _is_near_plane(self, normal: Array, answer: Answer) -> bool:
        """Return whether a fix may be so near to the plane of the stations that one region includes both sides.

        `normal` (d,) is the unit normal of the plane.
        """
        d = len(normal)
        w = np.abs((answer.x[:, :d] - self.centre) @ normal)
        variance = (answer.covariance[:, :d, :d] @ normal) @ normal
        return not bool((w * w > APART * APART * variance).all())

    def _proves(self, affine: Affine, answer: Answer, found: list[EngineResult], workspace: _SingleWorkspace) -> bool:
        """Return whether every fix is proven over all positions; bounds and boxes are written to the workspace.

        `affine` maps measurements to position costs. `found` are the scalar results of the n fixes.
        """
        asked, answered, d = workspace.asked, workspace.answered, self.load.place.shape[-1]
        asked.known.fill(0)
        for i, one in enumerate(found):
            if one.rival_cost < inf:
                asked.known[i], asked.others[i, 0] = 1, answer.rival[i, :d]
        if self.upward is not None:
            normal = answer.normal[:, self.upward]
            asked.surface[:, UP:] = normal / np.sqrt((normal * normal).sum(-1, keepdims=True))
        for i, one in enumerate(found):
            affine.write(workspace.z[i], workspace.costs, i)
            asked.eps[i] = equal_cost(one.cost)
        asked.x[:] = answer.x[:, :d]
        prove_here(workspace.costs, asked, answered)
        if self.sights:
            for i in range(len(found)):
                self._pass_hidden(workspace, answer.x[i], i)
        if self.edges is not None and not self._is_inside(self.edges, answer, workspace):
            return False
        # fields 2 to 5 of the results: bound, everywhere, gap, met
        results = zip(found, *(array.tolist() for array in (answered.verdict, *answered[2:6])), strict=True)
        for one, verdict, bound, everywhere, shown, met in results:
            if verdict != UNIQUE or not everywhere or shown != LISTED_GAP or met:
                return False
            # If the bound does not match this cost, one of the two is wrong: the long path finds out which.
            if not abs(one.cost - bound) <= _APART * equal_cost(one.cost):
                return False
        return True

    def _pass_hidden(self, workspace: _SingleWorkspace, x: Array, i: int) -> None:
        """Repeat the proof of fix number i at x (size,), without the minima behind the Earth that its proof found.

        The result is written to the workspace, with the boxes of all proofs.
        """
        one, d = slice(i, i + 1), workspace.asked.x.shape[-1]
        costs, asked, answered = workspace.costs.take(one), workspace.asked.take(one), workspace.answered.take(one)
        asked.hidden[0] = 0
        boxes = 0
        while answered.verdict[0] == OTHER and asked.hidden[0] < HIDDEN:
            met = x.copy()
            met[:d] = answered.found[0]
            if not any(sight.blocked(met[None], HIDDEN_REACH).any() for sight in self.sights):
                break
            asked.others[0, asked.known[0]] = met[:d]
            asked.known[0] += 1
            asked.hidden[0] += 1
            boxes += int(answered.boxes[0])
            prove_here(costs, asked, answered)
        answered.boxes[0] += boxes

    def _is_inside(self, edges: Edges, answer: Answer, workspace: _SingleWorkspace) -> bool:
        """Return whether every point on a bound costs more than the levels of the proofs; else bounds matter."""
        assert workspace.reach is not None
        if (answer.rival_cost < np.inf).any():  # low costs around a rival may reach a bound elsewhere
            return False
        d = self.load.place.shape[-1]
        x, cov = answer.x[:, :d], answer.covariance[:, :d, :d]
        numbers = (x, cov, answer.cost, answer.quantity, answer.normal)
        return are_out_of_reach(edges, workspace.reach, workspace.costs, *numbers)

    def _agrees(self, fix: Fix, workspace: _SingleWorkspace) -> bool:
        """Return whether the position costs equal the costs of the problem, at the fixes and near them."""
        many = self.problem.with_rows(z=workspace.z.copy())
        return self.map is None or bool(matches_problem_cost(many, fix.flat(), workspace.costs).all())

    def _judge(
        self,
        shape: tuple[int, ...],
        answer: Any,
        found: list[EngineResult],
        stages: tuple[Stage, ...],
        workspace: _SingleWorkspace,
    ) -> Fix | None:
        """Return the fixes with their verdicts, or None if the reason of one of them needs the long path.

        `shape` are the batch axes of the fixes, `answer` the arrays of the plan, and `found` the scalar results of each
        fix.
        """
        marks, kinds, gaps = [], [], []
        for one in found:
            excess, gap = one.infinity - one.cost, one.rival_cost - one.cost
            if one.kappa > STRAIGHT and isnan(excess):  # not Gaussian in metres, and no cost at infinity
                return None
            marks.append(marks_of(one.cost > self.refuted, excess, self.region, gap, one.kappa, self.map is not None))
            kinds.append(chart_kind(one.kappa, one.kappa_far))
            gaps.append(ambiguity(self.problem, gap) if gap < AMBIGUOUS_GAP else "")
        inflation = self._inflations(answer, marks, workspace)
        for i in inflation:
            marks[i], kinds[i] = Status.TAILS.mark, CARTESIAN if kinds[i] == CURVED else kinds[i]
        notes = _notes_of(tuple(marks), tuple(kinds), tuple(gaps), shape)
        if notes is None:
            return None
        x, covariance = (answer.x, answer.covariance) if shape else (answer.x[0], answer.covariance[0])
        inflations = np.array([inflation.get(i, 1.0) for i in range(len(found))]).reshape(shape) if inflation else None
        held, alone = active_of(self.plan, answer.multiplier), all(one.rival_cost == inf for one in found)
        cost, claims, d = answer.cost.reshape(shape).copy(), workspace.claims, self.load.place.shape[-1]
        if self.map is not None:
            bound, boxes = (
                workspace.answered.bound.reshape(shape).copy(),
                workspace.answered.boxes.reshape(shape).copy(),
            )
            reason = claims.reason if alone else _reasons(answer.rival_cost < np.inf, shape)
            claims = Claims(
                claims.proof, reason, claims.method, bound, cost - bound,
                claims.unique, claims.margin, boxes, claims.region, claims.asked,
            )  # fmt: skip
        return Fix(
            x,
            covariance,
            code=notes.code,
            reason=notes.reason,
            claims=claims,
            cost=cost,
            stages=stages,
            marks=notes.marks,
            chart=Chart(notes.kind, x[..., :d], covariance[..., :d, :d], workspace.centre, inflation=inflations),
            infinity=answer.infinity.reshape(shape) - cost,
            alternatives=workspace.no_alternatives if alone else _rivals(answer, shape),
            active=workspace.no_active if held is None else held.reshape(shape),
            **workspace.constants,
        )

    def _inflations(self, answer: Any, marks: list[int], workspace: _SingleWorkspace) -> dict[int, float]:
        """Return the inflations of curved fixes whose 95 % ellipses cover simulated repeats, by item number.

        `marks` are the bit masks of the findings. An inflation is a factor of the covariance.
        """
        items = [i for i, mark in enumerate(marks) if mark == Status.CURVED.mark]
        if not items or not self.repeatable:
            return {}
        many = self.problem.with_rows(z=workspace.z[items]).flat()
        found = repeat(many, answer.x[items], answer.covariance[items])
        return {i: float(one[2]) for i, one, good in zip(items, found, holds(found), strict=True) if good}

    def _workspace(self, shape: tuple[int, ...]) -> _SingleWorkspace:
        """Return the workspace of this thread for a batch shape; a few shapes are stored."""
        workspaces: dict[tuple[int, ...], _SingleWorkspace] | None = getattr(self.thread, "workspaces", None)
        if workspaces is None:
            workspaces = self.thread.workspaces = {}
        if shape not in workspaces:
            if len(workspaces) == _WORKSPACES:
                workspaces.clear()
            workspaces[shape] = self._make_workspace(shape)
        return workspaces[shape]

    def _make_workspace(self, shape: tuple[int, ...]) -> _SingleWorkspace:
        """Return a new workspace for a batch shape."""
        n, size, d, m = max(1, *shape, 1), self.plan.layout.size, self.load.place.shape[-1], self.problem.count
        found = tuple(blank_answer(n, *self.plan.widths))[2:]  # without position and covariance
        affine = self.map
        none = np.empty(0, dtype=np.int64), np.empty((1, 0, 0)), np.empty((1, 0, 0)), np.empty((n, 0)), np.empty(n)
        costs = PositionCosts(*none) if affine is None else affine.room(n)
        nowhere = np.full((n, 2, d), np.nan)
        asked = ProofRequest(
            x=np.empty((n, d)),
            others=np.zeros((n, 1 + HIDDEN, d)),  # the second image, and minima behind the Earth
            known=np.zeros(n, dtype=np.int64),
            hidden=np.zeros(n, dtype=np.int64),
            gaps=np.tile(gaps_below(LISTED_GAP, d), (n, 1)),
            eps=np.empty(n),
            region=nowhere,
            # no fallback: if the proof over all positions fails, the long path proves a smaller region
            fallback=nowhere,
            budget=budgets(n, len(costs.kinds), 1) * (1 if self.upward is None else ALL_AROUND),
            planes=np.repeat(self.planes, n, axis=0),
            surface=np.repeat(self.surface, n, axis=0),
        )
        centre = np.broadcast_to(self.centre, (*shape, d))
        kept = {
            "layout": self.plan.layout,
            "frame": self.plan.frame,
            # read-only views
            "dof": np.broadcast_to(np.int32(self.plan.dof), shape),
            "weights": np.broadcast_to(self.plan.weight, (*shape, m)),
            "reach": np.broadcast_to(centre_and_spread(self.problem.stations.places)[1].reshape(()), shape),
        }
        claims = repeated_claims(NO_PROOF if affine is None else _PROVEN, shape)
        alone = Alternatives(np.empty((*shape, 0, size)), np.empty((*shape, 0)))
        nothing = np.broadcast_to(_NOTHING, shape)
        z, answered = np.empty((n, m)), empty_answer(n, d)
        beside = None if affine is None or self.edges is None else new_workspace(affine, self.edges, n, d)
        return _SingleWorkspace(z, found, costs, asked, answered, centre, claims, nothing, alone, beside, kept)


def _reasons(listed: Array, shape: tuple[int, ...]) -> Array:
    """Return the claims (n,) of proven fixes as sentences; `listed` (n,) flags fixes with another listed minimum."""
    out = np.empty(len(listed), dtype=object)
    out[:] = [claim_sentence(LISTED_GAP, int(one), None) for one in listed]
    return out.reshape(shape)


def _rivals(answer: Answer, shape: tuple[int, ...]) -> Alternatives:
    """Return the other minima of fixes: one slot for each fix, which is empty for a fix without another minimum."""
    exists = answer.rival_cost < np.inf
    x = np.where(exists[:, None], answer.rival, np.nan)
    gap = np.where(exists, answer.rival_cost - answer.cost, np.inf)
    return Alternatives(x.reshape(*shape, 1, -1), gap.reshape(*shape, 1))


class _SingleNotes(NamedTuple):
    """Statuses, reasons, marks and kinds of chart of fixes (...), as read-only arrays."""

    code: Array
    reason: Array
    marks: Array
    kind: Array


@lru_cache(maxsize=256)  # fixes on the short path have few combinations of status and reason
def _notes_of(
    marks: tuple[int, ...], kinds: tuple[int, ...], gaps: tuple[str, ...], shape: tuple[int, ...]
) -> _SingleNotes | None:
    """Return statuses and reasons from marks, chart kinds and texts on rivals; None for the long path.

    `marks` are bit masks of findings, and `gaps` the reasons of ambiguous fixes, "" for others. `shape` are the batch
    axes of the fixes.
    """
    code = [Status(int(one)) for one in first_status(np.array(marks))]
    curved = [kind if status == Status.CURVED else None for status, kind in zip(code, kinds, strict=True)]
    reasons = [
        gap if status == Status.AMBIGUOUS else _SENTENCES.get((status, kind))
        for status, kind, gap in zip(code, curved, gaps, strict=True)
    ]
    if None in reasons:
        return None
    columns = zip((code, reasons, marks, kinds), (np.int8, object, np.int32, np.int8), strict=True)
    out = _SingleNotes(*(np.array(values, dtype=kind).reshape(shape) for values, kind in columns))
    for array in out:
        array.setflags(write=False)
    return out


def prepare_fix(problem: Problem, method: Method, *, often: bool = True) -> PreparedFix | None:
    """Return a prepared problem that fixes measurements on the short path, or None if the path is not available.

    The path has three conditions. Problems differ in their measurements only. The method begins with a direct solution.
    The numbers of the proof are affine functions of the measurements.

    Parameters
    ----------
    problem : Problem
        Its measurements do not matter. Only the measurements may have batch axes longer than one.
    method : Method
        The fixes equal those of this method.
    often : bool
        As of `PreparedFix`.
    """
    proves = _WORDS.get(method.words)
    if proves is None or (method.then is not None and not proves) or separable(problem):
        return None
    bare = _alone(problem)
    plan = None if bare.batch_shape else plan_of(bare)
    if plan is None or (proves and (why_unsupported(bare) or is_run(bare) or is_scaled(bare))):
        return None
    limited = proves and any(not is_exact(constraint) for constraint in bare.constraints)
    edges = edges_of(bare) if limited else None
    if limited and edges is None:  # the proofs would have to follow all bounds
        return None
    affine = affine_costs(bare) if proves else None
    if proves and affine is None:
        return None
    weight, d, load = bare.weight, problem.dimension, plan.load(bare)
    planes, surface = surfaces_of(bare.flat(), load.place[:1, 0])
    held = [constraint for constraint in bare.constraints if is_exact(constraint)]
    upward = [i for i, band in enumerate(held) if isinstance(band, Band) and band.kind == "height"]
    return PreparedFix(
        bare,
        plan,
        load._replace(place=np.require(load.place, dtype=float, requirements=["C", "W"])),
        affine,
        planes,
        surface,
        upward[0] if upward else None,
        edges,
        sights(bare.flat()),
        normal_of(bare.flat()),
        weight == 0.0 if (weight == 0.0).any() else None,
        centre_of(bare).reshape(d),
        largest(plan.dof, P_SUSPECT),
        largest(plan.dof, P_MISFIT),
        quantile(REGION_LEVEL, d),
        often,
        is_repeatable(bare.flat()),
        levels_of(bare)[0][len(held) :] if has_law(bare) else None,
    )


def _alone(problem: Problem) -> Problem:
    """Return a problem with zero measurements, and without batch axes of length one of its stations.

    If the batch axes are longer, the problem keeps them.
    """
    bare = problem.with_rows(z=np.zeros(problem.count))
    if not bare.batch_shape or prod(bare.batch_shape) > 1:
        return bare
    # in a problem with a plan only the stations have batch axes
    place, rates = bare.stations.position, bare.stations.velocity
    rates = None if rates is None else rates.reshape(rates.shape[-3:])
    return replace(bare, stations=replace(bare.stations, position=place.reshape(place.shape[-3:]), velocity=rates))


# A prepared problem takes two milliseconds to make and about 50 kB of memory.
_KEPT = Cache["PreparedFix | None"](64)


def at_once(problem: Problem, method: Method) -> Fix | None:
    """Return the fixes of one problem, or of a few that differ in measurements only; None if the stages have to run.

    A cache stores the prepared problem for later problems of the same structure, with the same method.
    """
    shape, place = problem.batch_shape, problem.stations.position
    # a problem without batch axes shares everything, and `prepare_fix` tests the other conditions once
    few = is_few(shape) and problem.count <= MOST and place.size == prod(place.shape[-3:])
    if not few or (shape and not is_planned(problem)):
        return None
    with suppress(*NUMERICAL):  # the stages report the item that fails
        ready = _KEPT.find((method, *_own_numbers(problem), *key_of(problem)), lambda: prepare_fix(problem, method))
        if ready is not None:
            z = problem.z
            return ready(z if z.shape[:-1] == shape else np.broadcast_to(z, (*shape, z.shape[-1])))
    return None


def _own_numbers(problem: Problem) -> tuple[Any, ...]:
    """Return the numbers that `PreparedFix` stores and the key of a plan omits.

    These are stations and levels, without measurements. They are bytes, as parts of a cache key.
    """
    rates, bands = problem.stations.velocity, problem.constraints
    levels = tuple((b.lower.tobytes(), b.upper.tobytes()) for b in bands if isinstance(b, Band))
    return (problem.stations.position.tobytes(), None if rates is None else rates.tobytes(), levels)


def is_few(shape: tuple[int, ...]) -> bool:
    """Return whether problems with these batch axes may take the short path: at most one axis, of at most `MANY`."""
    return len(shape) < 2 and 0 < max(shape, default=1) <= MANY

"""The pool: the candidates of a batch of problems, with costs, weights and proofs, which stages pass on.

Only the verdict turns a pool into fixes. Costs are chi-square values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from time import perf_counter
from typing import Annotated, TypeVar

import numpy as np

from optloc.base.errors import NUMERICAL
from optloc.base.records import Axes, join, overwrite
from optloc.base.threads import map_in_order
from optloc.base.types import Array, Status
from optloc.linear.redundancy import degrees_of_freedom
from optloc.models.layers import Layers
from optloc.problem.claims import Claims
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Stage
from optloc.problem.problem import Problem

PART = 2**15
"""Problems per part of a batch: for more the arrays of a part exceed the caches, and memory grows."""

# Rows per part if each problem has dozens of candidates: a row takes about 20 kB, so each thread takes 80 MB. Parts of
# twice the size are not faster.
_ROWS = 2**12

Answer = TypeVar("Answer", "Pool", Fix)


@dataclass(frozen=True, slots=True)
class Curvature:
    """Numbers from the normal equations at the best candidates of a flat batch of N problems.

    Parameters
    ----------
    covariance : array (N, n, n)
        Inverse of the information of the n shared unknowns, along the constraints that are satisfied with equality.
    information : array (N, n, n), optional
        Information of the shared unknowns; local unknowns are eliminated.
    regular : bool array (N,), optional
        Whether that inverse exists; None means that all exist.
    weakest : array (N,), optional
        Smallest squared pivot of the information scaled to a unit diagonal; near zero a direction is undetermined.
    active : object array (N,), optional
        Tuples of `Active` constraints.
    local : array (N, k, p, p), optional
        Covariance of the p numbers of the states of targets at each of the k epochs of a run.
    kappa : array (N, 2), optional
        Departure of the cost from a Gaussian's at three sigma, in metres and in inverse range
        (`optloc.model_checks.shape`); NaN if not computed.
    repeats : array (N, 3), optional
        Two shares of repeated measurements whose ellipses contain the truth, and the inflation for a share of 95 %
        (`optloc.solvers.verdict.repeats`); NaN if not tried.
    free : array (N, n, n), optional
        Covariance without the active inequalities; NaN if no inequality is active, or if it does not exist.
    shift : array (N, n), optional
        Mean without these inequalities in the quadratic model, minus the fix; NaN in the same cases.
    """

    covariance: Annotated[Array, Axes(2)]
    information: Annotated[Array, Axes(2)] | None = None
    regular: Annotated[Array, Axes(0, empty=True)] | None = None
    weakest: Annotated[Array, Axes(0, empty=np.inf)] | None = None
    active: Annotated[Array, Axes(0, empty=())] | None = None
    local: Annotated[Array, Axes(3)] | None = None
    kappa: Annotated[Array, Axes(1)] | None = None
    repeats: Annotated[Array, Axes(1)] | None = None
    free: Annotated[Array, Axes(2)] | None = None
    shift: Annotated[Array, Axes(1)] | None = None


@dataclass(frozen=True, slots=True)
class TriedBefore:
    """Proofs of N fixes that an earlier branch of a method tried.

    Parameters
    ----------
    cost : array (N,)
        Costs of the fixes.
    listed : int array (N,)
        Numbers of other known minima.
    proven : Claims
        Results of the proofs.
    """

    cost: Annotated[Array, Axes(0)]
    listed: Annotated[Array, Axes(0, empty=0)]
    proven: Claims


@dataclass(frozen=True, slots=True)
class NoStart:
    """The reason why N problems have no candidate, if a stage reports it.

    Parameters
    ----------
    reason : object array (N,)
        A sentence; "" without a report.
    code : int array (N,)
        `Status`: unavailable if the method does not start such rows, numerical if its back end failed.
    """

    reason: Annotated[Array, Axes(0, empty="")]
    code: Annotated[Array, Axes(0, empty=int(Status.UNAVAILABLE))]


@dataclass(frozen=True, slots=True)
class Pool:
    """Candidates of a flat batch of N problems, q slots each, with the evidence from the stages.

    In a settled pool (`optloc.solvers.verdict.minima.settle`) the first slot holds the best candidate. The other minima
    that the data allow follow, cheapest first.

    Parameters
    ----------
    x : array (N, q, size)
        Parameter vectors; NaN in empty slots.
    cost : array (N, q)
        Costs; NaN for a start, infinite in empty slots and for candidates that a constraint forbids.
    code : int array (N, q)
        `Status` of their refinement.
    face : int array (N, q)
        Number of the face of `optloc.linear.constraints.faces` on which each candidate was refined; 0 without
        inequalities.
    weights : array (N, m)
        Row weights that were used.
    dof : int array (N,)
        Degrees of freedom.
    stages : tuple of Stage
        Stages that ran.
    refined : bool
        Whether least squares has refined all candidates.
    curvature : Curvature, optional
        At the candidates in the first slots; None before the pool is settled.
    plain : bool array (N,), optional
        True if there is no finding against the best candidate: it is near, regular, finished and has no rival.
    infinity : array (N,), optional
        Least known cost of positions at ever larger distances; infinite if the cost keeps growing, NaN if not computed.
    free : array (N,), optional
        Least cost without the inequalities, if there are any.
    pair : array (N, 2, size), optional
        Two minima that are mirror images within one likelihood region, so that neither is a rival of the other; NaN
        without such a pair.
    loss : str
        Name of the robust loss that lowers weights of rows, or "" for least squares.
    robust : bool array (N,), optional
        True if the minima of a robust loss were searched, the rows with weight prove the position, and ellipses of
        repeats cover.
    searched : bool array (N,), optional
        True if the candidates come from a search instead of safe starts.
    remark : object array (N,), optional
        Remark of a stage that adds to the status.
    proven : Claims, optional
        Claims about the best candidates; None if no proof was tried.
    tried_before : TriedBefore, optional
        Proofs of an earlier branch of the method; they are valid if the minima are the same.
    hidden : object array (N,), optional
        Sentence on a minimum behind the Earth; "" without one.
    missing : NoStart, optional
        Reason why there is no candidate; used only for problems without a candidate.
    asked : bool
        Whether a search for suspects ran.
    conclusion : object array (N,), optional
        Explanation of contradictory data, an `optloc.solvers.verdict.conclusion.Conclusion`, or a `Fix` from outside
        that the verdict does not change.
    """

    x: Annotated[Array, Axes(2, slots=True)]
    cost: Annotated[Array, Axes(1, slots=True, empty=np.inf)]
    code: Annotated[Array, Axes(1, slots=True, empty=int(Status.UNAVAILABLE))]
    face: Annotated[Array, Axes(1, slots=True, empty=0)]
    weights: Annotated[Array, Axes(1)]
    dof: Annotated[Array, Axes(0)]
    stages: tuple[Stage, ...] = ()
    refined: bool = False
    curvature: Curvature | None = None
    plain: Annotated[Array, Axes(0, empty=False)] | None = None
    infinity: Annotated[Array, Axes(0)] | None = None
    free: Annotated[Array, Axes(0)] | None = None
    pair: Annotated[Array, Axes(2)] | None = None
    loss: str = ""
    robust: Annotated[Array, Axes(0, empty=False)] | None = None
    searched: Annotated[Array, Axes(0, empty=False)] | None = None
    remark: Annotated[Array, Axes(0, empty="")] | None = None
    proven: Claims | None = None
    tried_before: TriedBefore | None = None
    hidden: Annotated[Array, Axes(0, empty="")] | None = None
    missing: NoStart | None = None
    asked: bool = False
    conclusion: Annotated[Array, Axes(0, empty=None)] | None = None

    def __len__(self) -> int:
        """Return the number of problems."""
        return len(self.x)

    @property
    def occupied(self) -> tuple[Array, Array]:
        """Return the problem numbers and the slots of all candidates, two arrays of equal length."""
        item, slot = np.nonzero(np.isfinite(self.x).all(-1))
        return item, slot

    @property
    def unfinished(self) -> bool:
        """Return whether the refinement of a best candidate ended before it converged."""
        return bool(np.isin(self.code[:, 0], (Status.MAX_ITERATIONS, Status.STALLED)).any())

    @property
    def empty(self) -> Array:
        """Return flags (N,) of problems without a candidate: neither a start nor a point with a finite cost."""
        found = np.isfinite(self.x).all(-1) & (np.isnan(self.cost) | np.isfinite(self.cost))
        return np.asarray(~found.any(1))

    def without(self, items: Array, reason: str, status: Status) -> Pool:
        """Return the pool with a reason and a status for problems `items`; earlier reasons are kept."""
        blank = np.full(len(self), "", dtype=object)
        known = self.missing or NoStart(blank, np.full(len(self), int(Status.UNAVAILABLE), dtype=np.int8))
        reasons, code = known.reason.copy(), known.code.copy()
        new = items[reasons[items] == ""]
        reasons[new], code[new] = reason, int(status)
        return replace(self, missing=NoStart(reasons, code))

    def merge(self, items: Array, other: Pool, stage: Stage | None = None) -> Pool:
        """Return the pool with problems `items` replaced by the problems of another pool, and one more stage."""
        stages = self.stages if stage is None else (*self.stages, stage)
        return replace(overwrite(self, items, other), stages=stages)


def offer(problem: Problem, x: Array, before: Pool | None, name: str, began: float) -> Pool:
    """Return starts (N, q, size) as a pool, after the stages of the pool before.

    Parameters
    ----------
    problem : Problem
        N problems.
    x : array (N, q, size)
        Starts; NaN in empty slots.
    before : Pool, optional
        Earlier pool; its candidates are dropped.
    name : str
        Name of the stage that makes the starts.
    began : float
        Start time of the stage, by `time.perf_counter`.
    """
    shape, x = x.shape[:2], _within_layers(problem, x)
    stage = Stage(name, f"{x.shape[1]} candidates at most", perf_counter() - began)
    return Pool(
        x,
        np.full(shape, np.nan),
        np.full(shape, int(Status.UNAVAILABLE), dtype=np.int8),
        np.zeros(shape, dtype=int),
        np.broadcast_to(problem.weight, (len(x), problem.count)),
        degrees_of_freedom(problem) if before is None else before.dof,
        (*(before.stages if before else ()), stage),
        missing=None if before is None else before.missing,
        hidden=None if before is None else before.hidden,
    )


def _within_layers(problem: Problem, x: Array) -> Array:
    """Return starts (N, q, size) with positions inside the layers; positions beyond are mirrored into them."""
    if not isinstance(problem.medium, Layers):
        return x
    x, layout, (low, high) = x.copy(), problem.layout, problem.medium.reach
    for slots, base, runs in ((layout.shared, 0, 1), (layout.local, layout.n_shared, layout.epochs)):
        for slot in slots:
            if slot.name.partition("[")[0] == "position":
                # the third coordinate is up
                up = base + slot.start + 2 + layout.n_local * np.arange(runs)
                nearest = np.clip(x[..., up], low, high)
                x[..., up] = np.clip(2.0 * nearest - x[..., up], low, high)
    return x


def begin(problem: Problem, start: Array) -> Pool:
    """Return given starts (N, size) or (N, q, size) as a pool."""
    x = np.asarray(start, dtype=float)
    return offer(problem, x[:, None] if x.ndim == 2 else x, None, "start", perf_counter())


def pack(points: Array) -> Array:
    """Return points (N, q, n) with the finite points of each problem first, and without slots that no problem uses."""
    if points.shape[1] <= 1:
        return points
    finite = np.isfinite(points).all(-1)
    # a stable sort keeps the order of finite points, in which they are tried
    order = np.argsort(~finite, axis=1, kind="stable")
    keep = max(1, int(finite.sum(1).max(initial=0)))
    return np.take_along_axis(points, order[..., None], axis=1)[:, :keep]


def chunk_size(problem: Problem) -> int:
    """Return the number of problems per part, for problems with dozens of candidates each: it limits the memory."""
    return max(1, _ROWS // max(problem.count, 1))


def in_parts(
    problem: Problem,
    work: Callable[[Problem, slice], Answer],
    most: int = PART,
    failed: Callable[[Problem, str], Answer] | None = None,
) -> Answer:
    """Return the answers for a flat batch of problems, which is processed in parts of at most `most` problems.

    A part that fails numerically is halved until each failing problem is alone. Its answer reports the cause, and all
    other problems get their answers.

    Parameters
    ----------
    problem : Problem
        N problems.
    work : callable
        Maps some of the problems, and their slice of the batch, to a pool or fix.
    most : int
        Problems in one part.
    failed : callable, optional
        Maps failed problems and the cause to their answers; for an empty batch it gives the empty answer. Without it
        failures are raised.
    """
    count = problem.batch_shape[0]
    if failed is not None and not count:
        return failed(problem, "")
    if count <= most:
        answers = list(_contained(problem, slice(0, count), work, failed))
        return answers[0] if len(answers) == 1 else _joined(answers, count)

    def answer(part: slice) -> list[Answer]:
        return list(_contained(problem.take(np.arange(part.start, part.stop)), part, work, failed))

    # An even number of parts of equal size keeps an even number of threads busy to the end.
    size = -(-count // (2 * -(-count // (2 * most))))
    parts = [slice(first, min(first + size, count)) for first in range(0, count, size)]
    return _joined(chain.from_iterable(map_in_order(answer, parts)), count)


def _contained(
    problem: Problem,
    part: slice,
    work: Callable[[Problem, slice], Answer],
    failed: Callable[[Problem, str], Answer] | None,
) -> Iterator[Answer]:
    """Yield the answers of a part, or of its halves if it fails numerically; the arguments are as in `in_parts`.

    `part` is the slice of the problems in the batch. A single problem that fails gets the answer of `failed`.
    """
    try:
        answer = work(problem, part)
    except NUMERICAL as error:
        if failed is None:
            raise
        count = part.stop - part.start
        if count == 1:
            yield failed(problem, _cause(error))
            return
        half = count // 2
        for first, last in ((0, half), (half, count)):
            half_part = slice(part.start + first, part.start + last)
            yield from _contained(problem.take(np.arange(first, last)), half_part, work, failed)
    else:
        yield answer


@contextmanager
def noting_place(place: str) -> Iterator[None]:
    """Add the name of the place to a numerical failure inside this context, unless an inner context has added one."""
    try:
        yield
    except NUMERICAL as error:
        if not getattr(error, "__notes__", ()):
            error.add_note(place)
        raise


def _cause(error: Exception) -> str:
    """Return the message of a numerical failure, after the place that `noting_place` added."""
    return ": ".join([*getattr(error, "__notes__", ()), str(error) or type(error).__name__])


def _joined(answers: Iterable[Answer], count: int) -> Answer:
    """Return the joined answers of `count` problems, from the answers of their parts in order."""
    stages: list[tuple[Stage, ...]] = []

    def collected() -> Iterator[Answer]:
        for answer in answers:
            # parts may have different stages: one part may need a stage that others do not
            stages.append(answer.stages)
            yield answer

    whole: Answer = join(collected(), count)
    return replace(whole, stages=_sum_stages(stages))


def _sum_stages(parts: list[tuple[Stage, ...]]) -> tuple[Stage, ...]:
    """Return the stages of the part with the most stages, with the total seconds of all parts.

    `parts` are the stages of each part of a batch.
    """
    longest = max(parts, key=len)
    seconds = dict.fromkeys(range(len(longest)), 0.0)
    for stages in parts:
        for i, stage in enumerate(stages):
            seconds[i] += stage.seconds
    return tuple(
        Stage(stage.name, f"{stage.detail} (one of {len(parts)} parts)", seconds[i]) for i, stage in enumerate(longest)
    )


def least_finished(pool: Pool) -> Array:
    """Return the least cost (N,) of the finished candidates; infinite without one."""
    return np.asarray(np.where(pool.code == Status.OK, pool.cost, np.inf).min(1, initial=np.inf))

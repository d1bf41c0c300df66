"""The pool: the candidates that stages hand on, and what is known of them; only the verdict makes a fix of it."""

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
from optloc.problem.fix import Fix, Stage
from optloc.problem.problem import Problem

PART = 2**15
"""Problems that are worked on at a time: beyond it arrays of a part no longer fit the caches and memory grows."""

# Rows that are worked on at a time where each problem has dozens of candidates: a row takes some 20 kB, so that each
# thread takes 80 MB. Parts of twice the size are not faster.
_ROWS = 2**12

Answer = TypeVar("Answer", "Pool", Fix)


@dataclass(frozen=True, slots=True)
class Curvature:
    """What the normal equations say at the best candidates of a flat batch of N problems.

    Parameters
    ----------
    covariance : array (N, n, n)
        Inverse of the information on the tangent space of the constraints that hold with equality.
    information : array (N, n, n), optional
        Of the shared unknowns, local ones eliminated.
    regular : bool array (N,), optional
        Whether that inverse exists; it does where this is not said.
    weakest : array (N,), optional
        Smallest squared pivot of the information scaled to a unit diagonal: near zero means a direction is open.
    active : object array (N,), optional
        Tuples of `Active` constraints.
    local : array (N, k, p, p), optional
        Covariance of the states that targets have at each epoch of a run.
    kappa : array (N, 2), optional
        By how much the cost departs from that of a Gaussian three sigma away, in metres and in inverse range
        (`optloc.model_checks.shape`); NaN where nobody has looked.
    repeats : array (N, 3), optional
        Shares of repeated measurements whose ellipses hold, and the inflation with which 95 % would
        (`optloc.solvers.verdict.repeats`); NaN if not tried.
    free : array (N, n, n), optional
        Covariance without the inequalities that hold fixes; NaN where none does, or where it does not exist.
    shift : array (N, n), optional
        Mean without these inequalities by the quadratic model, less the fix; NaN likewise.
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
    """What a branch before has tried to prove of N fixes, and of what it was tried.

    Parameters
    ----------
    cost : array (N,)
        Of the fixes.
    listed : int array (N,)
        How many other minima were known.
    proven : Claims
        What came of it.
    """

    cost: Annotated[Array, Axes(0)]
    listed: Annotated[Array, Axes(0, empty=0)]
    proven: Claims


@dataclass(frozen=True, slots=True)
class NoStart:
    """Why N problems have no candidate, where a stage knows it.

    Parameters
    ----------
    reason : object array (N,)
        A sentence; "" where nothing is known.
    code : int array (N,)
        `Status`: unavailable where the method does not start such rows, numerical where its back end failed.
    """

    reason: Annotated[Array, Axes(0, empty="")]
    code: Annotated[Array, Axes(0, empty=int(Status.UNAVAILABLE))]


@dataclass(frozen=True, slots=True)
class Pool:
    """Candidates of a flat batch of N problems, q slots each, with the evidence that stages have gathered.

    Once it is settled (`optloc.solvers.verdict.minima.settle`) the best candidate is in the first slot, and the other
    minima that the data allow follow, cheapest first.

    Parameters
    ----------
    x : array (N, q, size)
        Parameter vectors; NaN in empty slots.
    cost : array (N, q)
        NaN of a start, infinite in empty slots and where a constraint forbids a candidate.
    code : int array (N, q)
        `Status` of their refinement.
    face : int array (N, q)
        Number of the face of `optloc.linear.constraints.faces` on which each was refined; 0 without inequalities.
    weights : array (N, m)
        Row weights that were used.
    dof : int array (N,)
        Degrees of freedom.
    stages : tuple of Stage
        What was done.
    refined : bool
        Whether least squares has refined all that is in it.
    curvature : Curvature, optional
        At the candidates in the first slots; None before anything is settled.
    plain : bool array (N,), optional
        Where nothing stands against the best candidate: near, regular, finished and without a rival.
    infinity : array (N,), optional
        Least cost known of positions ever farther away; infinite where they cost ever more, NaN where nobody has
        looked.
    free : array (N,), optional
        Least cost without the inequalities, where there are some.
    pair : array (N, 2, size), optional
        Two minima that are mirror images and belong to one likelihood region: neither is a rival of the other; NaN
        otherwise.
    loss : str
        Name of the loss that doubts rows, or "" where all are believed.
    robust : bool array (N,), optional
        Where the minima of a loss were searched, the rows that count prove the place, and ellipses of repeats hold.
    searched : bool array (N,), optional
        Where the candidates are the best of a search, not of starts that are known to be safe.
    remark : object array (N,), optional
        What a stage has to say beside the status.
    proven : Claims, optional
        What is proven of the best candidates; None where nobody has tried for any.
    tried_before : TriedBefore, optional
        What a branch before has tried to prove: it stands where nothing new was found.
    hidden : object array (N,), optional
        What lies behind the Earth, in words; "" where nothing does.
    missing : NoStart, optional
        Why there is no candidate, where there is none; it counts only there.
    asked : bool
        Whether contradictions were looked into.
    conclusion : object array (N,), optional
        What explains the data where they contradict each other, an `optloc.solvers.verdict.conclusion.Conclusion`; or
        a `Fix` from outside that stands as it is.
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
        """Return item and slot of every candidate."""
        item, slot = np.nonzero(np.isfinite(self.x).all(-1))
        return item, slot

    @property
    def unfinished(self) -> bool:
        """Return whether the refinement of a best candidate ended before it had converged."""
        return bool(np.isin(self.code[:, 0], (Status.MAX_ITERATIONS, Status.STALLED)).any())

    @property
    def empty(self) -> Array:
        """Return which problems have no candidate, (N,): neither a start nor a point with a cost."""
        found = np.isfinite(self.x).all(-1) & (np.isnan(self.cost) | np.isfinite(self.cost))
        return np.asarray(~found.any(1))

    def without(self, items: Array, reason: str, status: Status) -> Pool:
        """Return the pool with a reason why some of its problems have no candidate; reasons known before stay."""
        blank = np.full(len(self), "", dtype=object)
        known = self.missing or NoStart(blank, np.full(len(self), int(Status.UNAVAILABLE), dtype=np.int8))
        told, code = known.reason.copy(), known.code.copy()
        new = items[told[items] == ""]
        told[new], code[new] = reason, int(status)
        return replace(self, missing=NoStart(told, code))

    def merge(self, items: Array, other: Pool, stage: Stage | None = None) -> Pool:
        """Return the pool with those of other problems in the place of some, and one more stage."""
        stages = self.stages if stage is None else (*self.stages, stage)
        return replace(overwrite(self, items, other), stages=stages)


def offer(problem: Problem, x: Array, before: Pool | None, name: str, began: float) -> Pool:
    """Return starts (N, q, size) as a pool, behind the stages of the one before.

    Parameters
    ----------
    problem : Problem
        N problems.
    x : array (N, q, size)
        Starts; NaN in empty slots.
    before : Pool, optional
        What was known; its candidates are not kept.
    name : str
        Stage that makes the starts.
    began : float
        When it began, by `time.perf_counter`.
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
    """Return starts (N, q, size) whose positions have a speed: those beyond the layers are mirrored into them."""
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
    """Return points (N, q, n) with the finite ones of each problem first, and no more slots than needed."""
    if points.shape[1] <= 1:
        return points
    finite = np.isfinite(points).all(-1)
    # stable: finite ones keep their order, which says what is tried first
    order = np.argsort(~finite, axis=1, kind="stable")
    keep = max(1, int(finite.sum(1).max(initial=0)))
    return np.take_along_axis(points, order[..., None], axis=1)[:, :keep]


def chunk_size(problem: Problem) -> int:
    """Return the number of problems that are worked on at a time, where each has dozens of candidates."""
    return max(1, _ROWS // max(problem.count, 1))


def in_parts(
    problem: Problem,
    work: Callable[[Problem, slice], Answer],
    most: int = PART,
    failed: Callable[[Problem, str], Answer] | None = None,
) -> Answer:
    """Return the answers for a flat batch of problems, at most so many at a time.

    A part that fails numerically is halved until the problems are alone that cannot be worked on: of these the cause
    is told, and the answers of all others are theirs.

    Parameters
    ----------
    problem : Problem
        N problems.
    work : callable
        Maps some of the problems, and which they are, to their pool or fix.
    most : int
        Problems in one part.
    failed : callable, optional
        Maps problems and the cause to the answers of those that failed, and none to that of none; without it failures
        are raised.
    """
    count = problem.batch_shape[0]
    if failed is not None and not count:
        return failed(problem, "")
    if count <= most:
        found = list(_contained(problem, slice(0, count), work, failed))
        return found[0] if len(found) == 1 else _joined(found, count)

    def answer(part: slice) -> list[Answer]:
        return list(_contained(problem.take(np.arange(part.start, part.stop)), part, work, failed))

    # An even number of parts of one size: as many threads are done at a time.
    size = -(-count // (2 * -(-count // (2 * most))))
    parts = [slice(first, min(first + size, count)) for first in range(0, count, size)]
    return _joined(chain.from_iterable(map_in_order(answer, parts)), count)


def _contained(
    problem: Problem,
    part: slice,
    work: Callable[[Problem, slice], Answer],
    failed: Callable[[Problem, str], Answer] | None,
) -> Iterator[Answer]:
    """Yield the answers of a part, or of its halves one after the other where it fails numerically."""
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
            own = slice(part.start + first, part.start + last)
            yield from _contained(problem.take(np.arange(first, last)), own, work, failed)
    else:
        yield answer


@contextmanager
def noting_place(place: str) -> Iterator[None]:
    """Note the place on a numerical failure that passes, unless an inner one has: its cause is told with it."""
    try:
        yield
    except NUMERICAL as error:
        if not getattr(error, "__notes__", ()):
            error.add_note(place)
        raise


def _cause(error: Exception) -> str:
    """Return what a numerical failure says, behind the place that `where` has noted."""
    return ": ".join([*getattr(error, "__notes__", ()), str(error) or type(error).__name__])


def _joined(answers: Iterable[Answer], count: int) -> Answer:
    """Return answers of so many problems one behind the other as one."""
    stages: list[tuple[Stage, ...]] = []

    def told() -> Iterator[Answer]:
        for answer in answers:
            # parts differ in them: one may need what others do not
            stages.append(answer.stages)
            yield answer

    whole: Answer = join(told(), count)
    return replace(whole, stages=_sum_stages(stages))


def _sum_stages(parts: list[tuple[Stage, ...]]) -> tuple[Stage, ...]:
    """Return the stages of the part that took most of them, with the seconds of all."""
    longest = max(parts, key=len)
    seconds = dict.fromkeys(range(len(longest)), 0.0)
    for stages in parts:
        for i, stage in enumerate(stages):
            seconds[i] += stage.seconds
    return tuple(
        Stage(stage.name, f"{stage.detail} (one of {len(parts)} parts)", seconds[i]) for i, stage in enumerate(longest)
    )

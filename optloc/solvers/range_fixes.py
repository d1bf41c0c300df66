"""Positions from ranges in one compiled call; what is not plainly good takes the stages of the long way."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from optloc.base import linalg
from optloc.base.cache import Cache
from optloc.base.frames import Frame
from optloc.base.records import take
from optloc.base.threads import mapped
from optloc.base.types import Array, Status
from optloc.compute.damping import FIRST_DAMPING, FIRST_GROWTH, judge
from optloc.compute.jit import enabled, ready, usable
from optloc.compute.sums import equations_at
from optloc.linear.normal import depends_on_place, weighed
from optloc.linear.redundancy import degrees_of_freedom
from optloc.models import MODELS
from optloc.problem.fix import Stage
from optloc.problem.layout import Layout
from optloc.problem.noise import variances, whiten
from optloc.problem.problem import Problem
from optloc.proof.position_costs import project_out, whiten_rows
from optloc.solvers.inequalities import is_hidden
from optloc.solvers.policy import equal_cost
from optloc.solvers.pool import Curvature, Pool, in_parts
from optloc.solvers.stages import gtrs, lsr, lsr_with_mirror
from optloc.solvers.starts.least_squares_ranges import Ranges, ranges
from optloc.solvers.verdict.minima import likelihood_of, measure_curvature

if TYPE_CHECKING:
    from optloc.compute.range_start import Answer

# The linear maps from measurements to all that a fix from ranges needs, made once for a structure.

# Rows, and epochs with emission times, up to which dense maps pay: their cost grows with the square.
MOST = 64
# Share of the largest weight below which a combination of rows is rounding: four digits above it.
_NOTHING = 1e-12
# Share of a combination of ranges that their common part may have left by rounding: differences have none of it.
_LEVEL = 1e-9


@dataclass(frozen=True, slots=True)
class Direct:
    """What turns measurements of one structure into fixes: all but the measurements and the stations.

    Parameters
    ----------
    layout : Layout
        Position, and the emission time of each epoch where rows have one.
    frame : Frame
        Of the positions.
    weight : array (m,)
        Row weights.
    dof : int
        Degrees of freedom.
    station : int array (s,)
        Stations that take part.
    maps : tuple
        Fields of `optloc.compute.range_start.Model`.
    """

    layout: Layout
    frame: Frame
    weight: Array
    dof: int
    station: Array
    maps: tuple[Array | float, ...]


# The maps of 64 rows take 100 kB, those of six rows 2 kB.
_KEPT = Cache["Direct | None"](256)


def direct(problem: Problem) -> Direct | None:
    """Return what fixes problems of one structure directly, or None where they need the stages of the long way.

    One static position; rows that are sums of ranges, which link all stations that take part; stations that stay;
    weights, corrections and noise shared by the batch; nothing else unknown but emission times. Kept for problems that
    differ in measurements and station positions only.

    Parameters
    ----------
    problem : Problem
        Batch of problems; their measurements are not looked at.
    """
    if not (is_direct(problem) and enabled()):
        return None
    return _KEPT.find(key_of(problem), lambda: _direct(problem))


def key_of(problem: Problem) -> tuple[Hashable, ...]:
    """Return a key of all that the maps of a problem without batch axes of its own are made of."""
    # Not structure, yet what the maps are made of: they are part of the key by their bytes.
    numbers = [array for r in problem.rows for array in (r.weight, r.correction)]
    numbers += [block.covariance for block in problem.noise.blocks]
    numbers += [covariance for _, _, covariance in problem.stations.errors]
    return (problem.structure, *(array.tobytes() for array in numbers))


def _direct(problem: Problem) -> Direct | None:
    one = weighed(_probe(problem))
    found = ranges(one)
    # Stations that no row links would have ranges that nothing relates.
    if found is None or len(found.groups) != 1 or len(found.groups[0]) != 1:
        return None
    heard = np.flatnonzero(found.inside[0])
    white = linalg.whitening(found.covariance[0, heard[:, None], heard])
    dof = int(degrees_of_freedom(one)[0])
    # The compiled core takes triangular matrices only: a covariance that is singular has none.
    if dof < 0 or np.triu(white, 1).any():
        return None
    correction = np.concatenate([rows.correction for rows in problem.rows])
    maps = _maps(one, correction, found, heard, white)
    return Direct(problem.layout, problem.frame, one.weight, dof, found.station[heard], maps)


def is_direct(problem: Problem) -> bool:
    """Return whether the structure, and what the batch shares, are such that linear maps exist and pay."""
    stations, motion = problem.stations, problem.motions[0]
    shared = [r.weight for r in problem.rows] + [r.correction for r in problem.rows]
    return (
        not (problem.constraints or problem.biases or problem.priors)
        and len(problem.motions) == 1
        and (motion.order, motion.span) == (0, "run")
        and motion.known is None
        and all(MODELS[r.kind].ranges is not None and bool((r.target == 0).all()) for r in problem.rows)
        and stations.position.shape[-3] == 1
        and not stations.estimated
        and all(covariance.ndim == 3 for _, _, covariance in stations.errors)
        and not depends_on_place(problem)
        and 0 < problem.count <= MOST
        and problem.epochs <= MOST
        and all(array.ndim == 1 for array in shared)
        and all(block.covariance.ndim == 3 for block in problem.noise.blocks)
    )


def _probe(problem: Problem) -> Problem:
    """Return one problem for each row, whose measurement is one and all others zero."""
    # What is linear is known by its images of the unit vectors.
    parts = np.split(np.eye(problem.count), problem.starts[1:], axis=1)
    rows = tuple(replace(r, z=part, correction=np.zeros(r.count)) for r, part in zip(problem.rows, parts, strict=True))
    stations = problem.stations
    place = stations.position.reshape(-1, *stations.position.shape[-3:])[0]
    return replace(problem, rows=rows, stations=replace(stations, position=place, velocity=None, axes=None))


def _maps(one: Problem, correction: Array, found: Ranges, heard: Array, white: Array) -> tuple[Array | float, ...]:
    """Return the fields of the compiled model, in its order."""
    count = one.count
    design, emitted, anchor, start = _design(one, found.station[heard])
    alone = whiten_rows(whiten(one.noise, one.weight), np.eye(count))
    times = alone @ emitted
    # Emission times projected out: what is left of the rows depends on ranges alone.
    bare = project_out(times, alone)
    basis, upper = np.linalg.qr(bare @ design, mode="complete")
    inside = min(upper.shape)
    turned = basis.T @ bare
    loops = turned[inside:]
    # Combinations of rows that no range moves: their cost is the misfit of loops.
    loops = loops[np.abs(loops).max(-1, initial=0.0) > _NOTHING * np.abs(alone).max()]
    emission = np.linalg.pinv(times) @ alone
    share = upper[:inside]
    norm = float(np.linalg.norm(share, 2)) if share.size else 0.0
    present = one.weight > 0.0
    precision = np.where(present, 1.0 / np.where(present, variances(one.noise, count), 1.0), 0.0)
    return (
        np.stack([correction, precision]),
        anchor,
        np.concatenate([found.offset[:, heard].T, turned[:inside], emission, loops]),
        np.array(found.sign[0, heard], dtype=float),
        int(np.searchsorted(heard, found.reference[0])) if found.free.all() else -1,
        np.array(white, order="C"),
        np.array(share, order="C"),
        np.array(emission @ design, order="C"),
        start,
        norm,
        bool(np.abs(share.sum(-1)).max(initial=0.0) <= _LEVEL * norm),
    )


def _design(one: Problem, station: Array) -> tuple[Array, Array, Array, Array]:
    """Return the rows over ranges (m, s) and emission times (m, k), the anchor of each row and of each time."""
    epochs = one.epochs if one.layout.n_local else 0
    design, emitted = np.zeros((one.count, len(station))), np.zeros((one.count, epochs))
    anchor, start = np.full(one.count, -1), np.full(epochs, -1)
    place = {int(s): i for i, s in enumerate(station)}
    for rows, first in zip(one.rows, one.starts, strict=True):
        model = MODELS[rows.kind]
        for i in np.flatnonzero(rows.weight > 0.0):
            for coefficient, end in zip(model.ranges or (), (int(rows.a[i]), int(rows.b[i])), strict=False):
                if coefficient:
                    design[first + i, place[end]] += coefficient
            if model.emission:
                epoch = int(rows.epoch[i])
                emitted[first + i, epoch] = 1.0
                start[epoch] = first + i if start[epoch] < 0 else start[epoch]
                anchor[first + i] = start[epoch]
    return design, emitted, anchor, start


# Problems that a thread takes at a time: some milliseconds, against which handing them out is nothing. From 1 000 to
# 16 000 no difference was measured.
_CHUNK = 4096
# Of the refinement of the method "lsr".
TOLERANCE, LIMIT = 1e-7, 100


# Problems up to which narrow blocks are quicker: one of four lanes takes 25 us, two 45, four as long as one of 64.
_FEW = 8


def kernel_for(count: int, *, often: bool = False) -> Callable[..., int]:
    """Return the machine code for so many problems: narrow blocks for few, unless only the wide ones are loaded.

    Parameters
    ----------
    count : int
        Problems of one call.
    often : bool
        Whether such a call comes again and again, and is worth loading what serves it best.
    """
    from optloc.compute.range_fixes import few_fixes, fixes

    narrow = count <= _FEW and (ready(few_fixes) or ((often or not ready(fixes)) and usable(few_fixes, count)))
    return few_fixes if narrow else fixes


def at_hand(count: int) -> bool:
    """Return whether so many problems may take the direct way: its machine code is there, or they may wait for it."""
    return usable(kernel_for(count, often=True), count)


@dataclass(frozen=True, slots=True)
class Quick:
    """The stages "gtrs" and "lsr" as one, which takes the direct way where there is one, and where it is worth it.

    Parameters
    ----------
    alone : bool
        Whether nothing follows: then the mirror image of the start is refined on the way of the stages, too. What
        follows otherwise looks for other minima by itself.
    """

    alone: bool = False

    def __call__(self, problem: Problem, pool: Pool | None) -> Pool:
        """Return the settled pools of a flat batch of problems."""
        count = problem.batch_shape[0]
        quick = at_hand(count)
        ready = direct(problem) if pool is None and (self.alone or quick) else None
        refinement: Callable[[Problem, Pool], Pool] = lsr_with_mirror if self.alone else lsr
        if ready is None or not quick:
            start = pool
            if ready is not None:
                refinement = partial(lsr_with_mirror, descend=partial(_descend, ready))

            def work(some: Problem, part: slice) -> Pool:
                return refinement(some, gtrs(some, None if start is None else take(start, part)))

            return in_parts(problem, work)
        z = problem.z if len(problem.rows) > 1 else problem.rows[0].z
        place = problem.stations.position.reshape(-1, *problem.stations.position.shape[-2:])
        z = z if z.ndim == 2 and len(z) == count else np.broadcast_to(z, (count, problem.count))
        return settle_directly(ready, z, place, problem.take, refinement)


def settle_directly(
    direct: Direct,
    z: Array,
    position: Array,
    problems_at: Callable[[Array], Problem],
    refinement: Callable[[Problem, Pool], Pool] = lsr_with_mirror,
    threads: int | None = None,
) -> Pool:
    """Return the settled pools of measurements: directly where the answer is plain, else by other means.

    Parameters
    ----------
    direct : Direct
        From `direct` for problems of the same structure.
    z : array (N, m)
        Measurements.
    position : array (N or 1, stations, d)
        Of all stations.
    problems_at : callable
        Maps the numbers of problems whose answer is not plain to the problems.
    refinement : callable
        What takes the starts of those that are not plain by any means.
    threads : int, optional
        At most so many; as many as `optloc.base.threads.thread_count` says if absent.
    """
    began = perf_counter()
    answer, steps = fix_directly(direct, z, position, threads)
    left = np.flatnonzero(~_is_final(direct, answer, problems_at))
    if not len(left):
        return _pool(direct, _preferred(answer, problems_at), steps, began)
    # most of what is left lacks nothing but a start: the eigenvalues of its pencil give one
    some = problems_at(left)
    start = in_parts(some, lambda part, _: gtrs(part, None))
    place = position[left] if len(position) > 1 else position
    more, again = fix_directly(direct, z[left], place, threads, start.x[:, 0])
    for whole, part in zip(answer, more, strict=True):
        whole[left] = part
    pool = _pool(direct, _preferred(answer, problems_at), max(steps, again), began)
    lost = np.flatnonzero(~_is_final(direct, more, some.take))
    if not len(lost):
        return pool
    start = take(start, lost)
    return pool.merge(left[lost], in_parts(some.take(lost), lambda part, own: refinement(part, take(start, own))))


def _descend(direct: Direct, problem: Problem, x: Array) -> Array:
    """Return where the damped refinement of starts and images (N, 2 q, d) of few problems ends; NaN where it does not.

    A third of the time of one that knows all kinds: an image takes ten steps, or fifty. Images that are back at the
    minimum of their start are given up, as in `optloc.compute.range_mirror.watch`.
    """
    from optloc.compute.range_mirror import NEAR, RISEN
    from optloc.compute.range_start import ROUNDING, Model

    model, d, q = Model(*direct.maps), x.shape[-1], x.shape[1] // 2  # type: ignore[arg-type]
    position = problem.stations.position
    first, place = len(direct.station), position.reshape(-1, *position.shape[-2:])[:, None, direct.station]
    z = np.where(model.row[1] > 0.0, problem.z - model.row[0], 0.0)
    blur = ROUNDING * np.sqrt((model.row[1] * z * z).sum(-1))[:, None]
    z = z - np.where(model.anchor >= 0, z[:, model.anchor], 0.0)
    u = (z @ model.linear[first : first + len(model.K)].T)[:, None]

    def equations(at: Array) -> tuple[Array, Array, Array]:
        apart = at[..., None, :] - place
        r = np.sqrt((apart * apart).sum(-1))
        left, rows = u - r @ model.K.T, model.K @ (apart / r[..., None])
        return (left * left).sum(-1), np.swapaxes(rows, -1, -2) @ rows, (left[..., None, :] @ rows)[..., 0, :]

    with np.errstate(all="ignore"):
        cost, matrix, right = equations(x)
        alive, done = np.isfinite(cost), np.zeros(x.shape[:2], dtype=bool)
        damping, growth = np.full(cost.shape, FIRST_DAMPING), np.full(cost.shape, FIRST_GROWTH)
        for _ in range(LIMIT):
            if not alive.any():
                break
            move, solvable = linalg.solve(matrix * (1.0 + damping[..., None, None] * np.eye(d)), right[..., None])
            after, steeper, pull = equations(x + move[..., 0])
            gain = (move[..., 0] * right).sum(-1)
            found = judge(cost, after, gain, solvable & alive, blur, damping, growth, TOLERANCE, True)
            better = found.better
            x, cost = np.where(better[..., None], x + move[..., 0], x), np.where(better, after, cost)
            matrix = np.where(better[..., None, None], steeper, matrix)
            right, damping, growth = np.where(better[..., None], pull, right), found.damping, found.growth
            done |= found.small
            alive &= ~(found.small | found.stuck)
            apart = x[:, q:] - x[:, :q]
            squared = ((matrix[:, :q] @ apart[..., None])[..., 0] * apart).sum(-1)
            back = (squared < NEAR) & (cost[:, q:] - cost[:, :q] > RISEN * squared)
            alive[:, q:] &= ~(back & done[:, :q])
    return np.where(done[..., None], x, np.nan)


def fix_directly(
    direct: Direct, z: Array, position: Array, threads: int | None = None, start: Array | None = None
) -> tuple[Answer, int]:
    """Return what the compiled call finds, and the most steps that a fix took; see `settle_directly`.

    It finds starts by itself where none (N, size) are given.
    """
    from optloc.compute.range_start import Answer, Model

    kernel = kernel_for(len(z))
    model = Model(*direct.maps)  # type: ignore[arg-type]
    count, d, size = len(z), position.shape[-1], direct.layout.size
    answer = Answer(
        np.empty((count, size)) if start is None else np.array(start),
        np.empty((count, d, d)),
        np.empty(count),
        np.empty(count, dtype=np.bool_),
        np.empty((count, size)),
        np.empty(count),
        np.empty((count, 2)),
        np.empty(count),
    )
    # Usually all stations take part, and their positions need no copy.
    everyone = len(direct.station) == position.shape[1]
    given = start is not None

    def work(first: int) -> int:
        part = slice(first, min(first + _CHUNK, count))
        stations = position[part] if len(position) > 1 else position
        stations = _owned(stations if everyone else stations[:, direct.station])
        rows = _owned(z[part])
        return int(kernel(model, rows, stations, TOLERANCE, LIMIT, given, Answer(*(array[part] for array in answer))))

    return answer, max(mapped(work, range(0, count, _CHUNK), threads), default=0)


def _is_final(direct: Direct, answer: Answer, problems_at: Callable[[Array], Problem]) -> Array:
    """Return which fixes (N,) need no other means: settled ones.

    On Earth those which it hides from a station are not final: what lies before it competes, and is told.
    """
    if not direct.frame.geodetic:
        return answer.settled
    out, items = np.array(answer.settled), np.flatnonzero(answer.settled)
    out[items] = ~is_hidden(problems_at(items), answer.x[items])
    return out


def _preferred(answer: Answer, problems_at: Callable[[Array], Problem]) -> Answer:
    """Return the answer with the likelier by its place of two minima that cost the same, as the verdict has it."""
    tied = np.flatnonzero(answer.settled & (np.abs(answer.rival_cost - answer.cost) <= equal_cost(answer.cost)))
    if not len(tied):
        return answer
    some = problems_at(tied)
    (first, second), (other, another) = likelihood_of(some, answer.x[tied]), likelihood_of(some, answer.rival[tied])
    changed = (other > first) | ((other == first) & (another > second))
    items, some = tied[changed], some.take(np.flatnonzero(changed))
    if not len(items):
        return answer
    x, rival, cost, rival_cost, covariance, kappa = (
        np.array(values)
        for values in (answer.x, answer.rival, answer.cost, answer.rival_cost, answer.covariance, answer.kappa)
    )
    x[items], rival[items] = rival[items], x[items]
    cost[items], rival_cost[items] = rival_cost[items], cost[items]
    at = x[items]
    covariance[items] = measure_curvature(some, equations_at(some, at), at, np.zeros(len(at), dtype=int)).covariance
    kappa[items] = np.nan  # the verdict looks at its shape
    return answer._replace(x=x, rival=rival, cost=cost, rival_cost=rival_cost, covariance=covariance, kappa=kappa)


def _pool(direct: Direct, answer: Answer, steps: int, began: float) -> Pool:
    """Return the pool of fixes that were found directly, with a second slot where some have a rival."""
    count, seconds = len(answer.cost), perf_counter() - began
    rivalled = np.isfinite(answer.rival_cost) & answer.settled
    x, cost = answer.x[:, None], answer.cost[:, None]
    code = np.broadcast_to(np.int8(Status.OK), (count, 1))
    if rivalled.any():
        rival = np.where(rivalled[:, None], answer.rival, np.nan)
        x = np.concatenate([x, rival[:, None]], axis=1)
        cost = np.stack([answer.cost, np.where(rivalled, answer.rival_cost, np.inf)], axis=1)
        # an empty slot is one that nobody has refined
        second = np.where(rivalled, np.int8(Status.OK), np.int8(Status.UNAVAILABLE))
        code = np.concatenate([code, second[:, None]], axis=1)
    return Pool(
        x,
        cost,
        code,
        np.broadcast_to(0, cost.shape),
        np.broadcast_to(direct.weight, (count, len(direct.weight))),
        np.broadcast_to(np.int32(direct.dof), count),
        direct_stages(count, steps, seconds),
        refined=True,
        curvature=Curvature(answer.covariance, kappa=answer.kappa),
        plain=answer.settled & ~rivalled,
        infinity=answer.infinity,
    )


def direct_stages(count: int, steps: int, seconds: float) -> tuple[Stage, ...]:
    """Return the stages that so many fixes went through at once, and the most steps that one took."""
    detail = f"{count} candidates, {steps} steps at most"
    return Stage("gtrs", "1 candidates at most", 0.0), Stage("lsr", detail, seconds)


def _owned(values: Array) -> Array:
    """Return values as the one type of array for which there is machine code: float, C order, writable."""
    return np.require(values, dtype=float, requirements=["C", "W"])

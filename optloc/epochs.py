"""Epochs that share nothing become one batch of problems with a single epoch each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.errors import InvalidProblem
from optloc.noise import Block, Noise, group
from optloc.problem import Problem
from optloc.types import Array, Band, Polygon, Rows


def separable(problem: Problem) -> bool:
    """Return whether no unknown is shared between the epochs of a problem."""
    run_long_errors = problem.stations.covariance is not None and problem.stations.span == "run"
    free = all(motion.span == "epoch" for motion in problem.motions)
    return problem.epochs > 1 and free and not problem.biases and not run_long_errors and not tied(problem)


def tied(problem: Problem) -> bool:
    """Return whether the noise of rows of different epochs is correlated."""
    epoch = problem.epoch
    for block in problem.noise.blocks:
        when = epoch[block.row]
        apart = when[:, :, None] != when[:, None, :]
        if apart.any() and np.any(np.where(apart, block.covariance, 0.0)):
            return True
    return False


def by_epoch(problem: Problem) -> Problem:
    """Return the epochs of a problem as a batch of independent problems.

    Rows of the same kind, stations and target meet in one row of the batch; a row that an epoch lacks has weight zero.

    Parameters
    ----------
    problem : Problem
        Leading axes (...), k epochs. Biases must not be shared; the targets' states become those of their epoch.

    Returns
    -------
    Problem
        Leading axes (..., k), one epoch.

    Raises
    ------
    InvalidProblem
        Where biases or the noise tie the epochs together.
    """
    if problem.biases or tied(problem):
        tie = f"the bias {problem.biases[0].name!r} is" if problem.biases else "correlated noise is"
        raise InvalidProblem(f"{tie} shared by several epochs", "by_epoch", "solve them as one problem")
    places = [_places(rows) for rows in problem.rows]
    sizes = [len(keys) for keys, _ in places]
    starts = np.cumsum([0, *sizes])
    where = np.concatenate([start + place for (_, place), start in zip(places, starts, strict=False)])
    batch, k = problem.batch_shape, problem.epochs
    rows = []
    for old, (keys, place) in zip(problem.rows, places, strict=True):
        a, b, target, _ = np.array(keys, dtype=np.int64).reshape(-1, 4).T

        def spread(values: Array, old: Rows = old, place: Array = place, size: int = len(keys)) -> Array:
            out = np.zeros((*batch, k, size))
            out[..., old.epoch, place] = values
            return out

        rows.append(
            Rows(old.kind, spread(old.z), a, b, np.zeros_like(a), target, spread(old.weight), spread(old.correction))
        )
    motions = tuple(
        replace(m, span="run", known=None if m.known is None else _split(m.known, 3)) for m in problem.motions
    )
    s = problem.stations
    stations = replace(
        s,
        position=_split(s.position, 3),
        velocity=None if s.velocity is None else _split(s.velocity, 3),
        axes=None if s.axes is None else _split(s.axes, 4),
        covariance=None if s.covariance is None else _same(s.covariance, 3),
    )
    priors = tuple(replace(p, mean=_same(p.mean, 1), covariance=_same(p.covariance, 2)) for p in problem.priors)
    constraints = tuple(_spread(c) for c in problem.constraints)
    noise = _noise(problem, where, int(starts[-1]))
    return replace(
        problem,
        stations=stations,
        rows=tuple(rows),
        noise=noise,
        times=np.zeros(1),
        motions=motions,
        priors=priors,
        constraints=constraints,
    )


def _spread(c: Band | Polygon) -> Band | Polygon:
    if isinstance(c, Polygon):
        return c
    return replace(c, lower=_same(c.lower, 0), upper=_same(c.upper, 0), coefficients=_same(c.coefficients, 1))


def untied(problem: Problem) -> Problem:
    """Return the problem with noise blocks of one epoch each; correlation between epochs is dropped."""
    epoch = problem.epoch
    if all((epoch[block.row] == epoch[block.row[:, :1]]).all() for block in problem.noise.blocks):
        return problem
    parts = [part for block in problem.noise.blocks for part in _cut(block, epoch)]
    return replace(problem, noise=group(parts))


def _places(rows: Rows) -> tuple[list[tuple[int, int, int, int]], Array]:
    """Return the distinct rows (a, b, target, occurrence) of all epochs and the place of each row among them."""
    seen: dict[tuple[int, int, int, int], int] = {}
    keys: dict[tuple[int, int, int, int], int] = {}
    place = np.empty(rows.count, dtype=np.int64)
    for i, key in enumerate(
        zip(rows.a.tolist(), rows.b.tolist(), rows.target.tolist(), rows.epoch.tolist(), strict=True)
    ):
        occurrence = seen.get(key, 0)
        seen[key] = occurrence + 1
        place[i] = keys.setdefault((*key[:3], occurrence), len(keys))
    return list(keys), place


def _split(array: Array, core: int) -> Array:
    """Return a per-epoch quantity (..., k or 1, s, ...) as (..., k, 1, s, ...); unchanged where it is one for all."""
    if array.ndim == core and array.shape[0] == 1:
        return array
    return np.expand_dims(array, array.ndim - core + 1)


def _same(array: Array, core: int) -> Array:
    """Return a quantity of the run (..., ...) as (..., 1, ...), or unchanged where it is one for the whole batch."""
    return array if array.ndim == core else np.expand_dims(array, array.ndim - core)


def _cut(block: Block, epoch: Array) -> list[Block]:
    """Return a block as blocks whose groups hold rows of one epoch each."""
    when = epoch[block.row]
    if (when == when[:, :1]).all():
        return [block]
    blocks = []
    for g, (rows, times) in enumerate(zip(block.row, when, strict=True)):
        own = block.covariance[..., g if block.covariance.shape[-3] > 1 else 0, :, :]
        for k in np.unique(times):
            inside = np.flatnonzero(times == k)
            blocks.append(Block(rows[None, inside], own[..., None, inside[:, None], inside]))
    return blocks


def _noise(problem: Problem, where: Array, size: int) -> Noise:
    """Return the noise of the batch: groups of rows that are correlated in some epoch stay together."""
    epoch, k = problem.epoch, problem.epochs
    label = np.arange(size)
    cut = group([part for block in problem.noise.blocks for part in _cut(block, epoch)]).blocks
    for block in cut:
        for members in where[block.row]:
            joined = np.isin(label, label[members])
            label[joined] = label[members[0]]
    blocks = []
    for name in np.unique(label):
        members = np.flatnonzero(label == name)
        blocks.append(_gathered(cut, where, epoch, members, k))
    return _merge(blocks)


def _gathered(cut: tuple[Block, ...], where: Array, epoch: Array, members: Array, k: int) -> Block:
    slot = {int(row): i for i, row in enumerate(members)}
    shape = np.broadcast_shapes(*(block.covariance.shape[:-3] for block in cut))
    out = np.zeros((*shape, k, 1, len(members), len(members)))
    out[..., np.arange(len(members)), np.arange(len(members))] = 1.0
    for block in cut:
        inside = np.flatnonzero(np.isin(where[block.row[:, 0]], members))
        if not len(inside):
            continue
        place = np.vectorize(slot.__getitem__)(where[block.row[inside]])
        covariance = np.broadcast_to(
            block.covariance, (*block.covariance.shape[:-3], *block.row.shape, block.row.shape[1])
        )[..., inside, :, :]
        out[..., epoch[block.row[inside, 0]][:, None, None], 0, place[:, :, None], place[:, None, :]] = covariance
    return Block(members[None], out)


def _merge(blocks: list[Block]) -> Noise:
    by_size: dict[int, list[Block]] = {}
    for block in blocks:
        by_size.setdefault(block.row.shape[1], []).append(block)
    return Noise(
        tuple(
            Block(np.concatenate([b.row for b in same]), np.concatenate([b.covariance for b in same], axis=-3))
            for same in by_size.values()
        )
    )

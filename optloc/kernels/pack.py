"""The numbers of problems as plain arrays: what the compiled core computes with, next to its tables."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.kernels.tables import Sources, Tables, tables
from optloc.noise import Whitener, variances
from optloc.priors import prior_parts
from optloc.problem import Problem
from optloc.types import Array


class Numbers(NamedTuple):
    """The numbers of N problems; what all of them share is kept once.

    An array (N or 1, ...) has one row where the problems share it. Places in it are those of `Tables.source`: one that
    is >= 0 counts through the shared numbers, -1 - i through those of each problem.
    """

    common: Array  # stations, rates, axes, known targets; the first is zero
    own: Array  # (N, ...)
    observed: Array  # (N or 1, m): measurements less corrections
    present: Array  # (N or 1, m): 1 for a row that counts; (1, 0) where all do
    sigma: Array  # (N or 1, m): standard deviations of the rows
    white_common: Array  # whitening matrices
    white_own: Array
    group_white: Array  # place of the matrix of each group
    group_full: Array  # 0 where it is lower triangular
    prior_start: Array  # first unknown of each prior, among shared ones or those of an epoch
    prior_size: Array
    prior_local: Array  # 1 for unknowns of an epoch
    prior_at: Array  # place of its mean, and behind it of its precision
    prior_common: Array
    prior_own: Array


class Packed(NamedTuple):
    """Problems as the compiled core takes them.

    Parameters
    ----------
    tables : Tables
        Indices, one set for all.
    numbers : Numbers
        Arrays.
    """

    tables: Tables
    numbers: Numbers


def packed(problem: Problem, noise: tuple[Whitener, ...]) -> Packed | None:
    """Return a flat batch of problems for the compiled core, or None where it does not serve them.

    Parameters
    ----------
    problem : Problem
        N problems, or one without a batch axis.
    noise : tuple of Whitener
        Whitening matrices of their rows.
    """
    index = tables(problem, tuple(w.row for w in noise))
    if index is None:
        return None
    common, own = _sources(problem)
    weight = problem.weight
    present = np.zeros((1, 0)) if np.all(weight > 0.0) else _plain(weight > 0.0, 1)
    white, full = _whiteners(noise)
    return Packed(
        index,
        Numbers(
            common,
            own,
            observed(problem),
            present,
            _plain(np.sqrt(variances(problem.noise, problem.count)), 1),
            white[0],
            white[1],
            white[2][index.group_number],
            full[index.group_number],
            *_priors(problem),
        ),
    )


def observed(problem: Problem) -> Array:
    """Return the measurements less corrections of a flat batch of problems, (N or 1, m), for `Numbers.observed`."""
    if len(problem.rows) == 1 and not problem.rows[0].correction.any():
        return _plain(problem.rows[0].z, 1)
    return _plain(problem.observed, 1)


def _plain(values: Array, core: int) -> Array:
    """Return an array (..., core axes) of a flat batch as contiguous doubles (N or 1, numbers)."""
    shape = values.shape
    flat = values.reshape(shape[0] if len(shape) > core else 1, int(np.prod(shape[len(shape) - core :])))
    return np.require(flat, np.float64, ["C", "W"])


def _divided(parts: list[Array]) -> tuple[Array, Array, Array]:
    """Return the parts (N or 1, numbers) that are shared, those that are not, and the place of each part."""
    place, lengths = np.zeros(len(parts), dtype=np.int64), [0, 0]
    for i, part in enumerate(parts):
        mine = int(len(part) > 1)
        place[i] = -1 - lengths[1] if mine else lengths[0]
        lengths[mine] += part.shape[1]
    shared, own = ([part for part in parts if (len(part) > 1) == mine] for mine in (False, True))
    flat = np.concatenate([part[0] for part in shared]) if shared else np.zeros(0)
    if len(own) > 1:
        own = [np.concatenate(own, axis=1)]
    return flat, own[0] if own else np.zeros((1, 0)), place


def _sources(problem: Problem) -> tuple[Array, Array]:
    parts = [_plain(array, core) for array, core in Sources.of(problem).arrays]
    common, own, _ = _divided([np.zeros((1, 1)), *parts])
    return common, own


def _whiteners(noise: tuple[Whitener, ...]) -> tuple[tuple[Array, Array, Array], Array]:
    """Return whitening matrices, shared and own, the place of that of each group, and which are not triangular."""
    common, own, place = _divided([_plain(w.matrix, 3) for w in noise])
    at, full = [], []
    for start, w in zip(place, noise, strict=True):
        count, size = w.row.shape
        step = size * size if w.matrix.shape[-3] > 1 else 0
        at.append(start + (step if start >= 0 else -step) * np.arange(count))
        upper = np.triu(w.matrix, 1).reshape(-1, w.matrix.shape[-3], size * size).any((0, 2))
        full.append(np.broadcast_to(upper, (count,)))
    return (common, own, np.concatenate(at)), np.concatenate(full).astype(np.int64)


def _priors(problem: Problem) -> tuple[Array, ...]:
    layout, parts, heads = problem.layout, [], []
    for name, mean, precision in prior_parts(problem):
        slot, shared = layout.find(name)
        arrays = (mean, precision) if shared else (_single(mean, 1), _single(precision, 2))
        both = (_plain(arrays[0], 1), _plain(arrays[1], 2))
        count = max(len(part) for part in both)
        parts.append(np.concatenate([np.broadcast_to(part, (count, part.shape[1])) for part in both], axis=1))
        heads.append((slot.start, slot.size, int(not shared)))
    common, own, place = _divided(parts)
    table = np.array(heads, dtype=np.int64).reshape(-1, 3)
    start, size, local = (np.ascontiguousarray(table[:, i]) for i in range(3))
    return start, size, local, place, common, own


def _single(values: Array, core: int) -> Array:
    """Return values of an epoch without their epoch axis of length one, where they have one."""
    return np.take(values, 0, axis=-1 - core) if values.ndim > core else values

"""The numbers of problems as plain arrays: what the compiled core computes with, next to its tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.tables import Sources, Tables, tables
from optloc.linear.courses import over_ground
from optloc.linear.normal import prior_parts
from optloc.models import MODELS
from optloc.models.primitives import WGS84_A
from optloc.problem.noise import Whitener, variances
from optloc.problem.problem import Problem

# Columns of `Numbers.place`. Of a group: place of its whitening matrix, and whether that is not lower triangular. Of a
# prior: place of its mean, with its precision behind; first unknown, how many, 1 for those of an epoch.
AT, FULL = range(2)
PRIOR_START, PRIOR_SIZE, PRIOR_LOCAL = range(1, 4)
_COLUMNS = 4


class Numbers(NamedTuple):
    """The numbers of N problems; what all of them share is kept once.

    An array (N or 1, ...) has one row where the problems share it. A place >= 0 counts through the shared numbers, one
    of -1 - i through those of each problem: sources, whitening matrices, priors.
    """

    common: Array  # zero; stations, rates, axes, known targets; whitening matrices; priors
    place: Array  # int64 (groups + priors, 4): columns as named above
    source: Array  # (N or 1, ...)
    white: Array  # (N or 1, ...)
    prior: Array  # (N or 1, ...)
    observed: Array  # (N or 1, m): measurements less corrections
    present: Array  # (N or 1, m): 1 for a row that counts; (1, 0) where all do
    sigma: Array  # (N or 1, m): standard deviations of the rows
    size: Array  # (m,): numbers of this size, beside the measurement, are rounded to get to the row's value


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


def pack(problem: Problem, noise: tuple[Whitener, ...]) -> Packed | None:
    """Return a flat batch of problems for the compiled core, or None where it does not serve them.

    Parameters
    ----------
    problem : Problem
        N problems, or one without a batch axis.
    noise : tuple of Whitener
        Whitening matrices of their rows.
    """
    kept = tables(problem, tuple(w.row for w in noise))
    if kept is None:
        return None
    source, white, prior = sources(problem), _whiteners(noise), _priors(problem)
    # Places count on from one kind of numbers to the next.
    for one, before in ((white, (source,)), (prior, (source, white))):
        shared, own = (sum(part.size(mine) for part in before) for mine in (False, True))
        one.place[:, AT] += np.where(one.place[:, AT] >= 0, shared, -own)
    # Presence is looked at where some row is absent only: an empty array says that all count.
    weight = problem.weight
    present = np.zeros((1, 0)) if np.all(weight > 0.0) else _plain(weight > 0.0, 1)
    return Packed(
        kept.tables,
        Numbers(
            np.concatenate([source.common, white.common, prior.common]),
            np.concatenate([white.place[kept.number], prior.place]),
            source.own,
            white.own,
            prior.own,
            observed(problem),
            present,
            _plain(np.sqrt(variances(problem.noise, problem.count)), 1),
            coarseness(problem),
        ),
    )


def coarseness(problem: Problem) -> Array:
    """Return the size (m,) of the numbers beside the measurement that are rounded to get to a row's value."""
    # courses over ground are worked out from the centre of the Earth
    far = [MODELS[rows.kind].ecef or over_ground(problem) for rows in problem.rows]
    return np.repeat(np.where(far, WGS84_A, 0.0), [rows.count for rows in problem.rows])


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


@dataclass(frozen=True, slots=True)
class Divided:
    """Numbers that are shared (numbers,), those that are not (N or 1, numbers), and where to find them."""

    common: Array
    own: Array
    place: Array

    def size(self, own: bool) -> int:
        """Return the count of the numbers of each problem, or of the shared ones."""
        return self.own.shape[1] if own else len(self.common)

    @classmethod
    def of(cls, parts: list[Array]) -> Divided:
        """Return parts (N or 1, numbers) divided; `place` (parts, 4) begins with the place of each."""
        place, lengths = np.zeros((len(parts), _COLUMNS), dtype=np.int64), [0, 0]
        for i, part in enumerate(parts):
            mine = int(len(part) > 1)
            place[i, AT] = -1 - lengths[1] if mine else lengths[0]
            lengths[mine] += part.shape[1]
        shared, own = ([part for part in parts if (len(part) > 1) == mine] for mine in (False, True))
        flat = np.concatenate([part[0] for part in shared]) if shared else np.zeros(0)
        if len(own) > 1:
            # A single array of the problems' own numbers, mostly that of the stations, is taken without a copy.
            own = [np.concatenate(own, axis=1)]
        return cls(flat, own[0] if own else np.zeros((1, 0)), place)


def sources(problem: Problem) -> Divided:
    """Return the data arrays of a flat batch of problems, see `optloc.compute.tables.Sources`."""
    parts = [_plain(array, core) for array, core in Sources.of(problem).arrays]
    return Divided.of([np.zeros((1, 1)), *parts])


def _whiteners(noise: tuple[Whitener, ...]) -> Divided:
    """Return whitening matrices; a line of `place` for each group."""
    divided, lines = Divided.of([_plain(w.matrix, 3) for w in noise]), []
    for start, w in zip(divided.place[:, AT], noise, strict=True):
        count, size = w.row.shape
        step = size * size if w.matrix.shape[-3] > 1 else 0
        line = np.zeros((count, _COLUMNS), dtype=np.int64)
        line[:, AT] = start + (step if start >= 0 else -step) * np.arange(count)
        line[:, FULL] = np.triu(w.matrix, 1).reshape(-1, w.matrix.shape[-3], size * size).any((0, 2))
        lines.append(line)
    return Divided(divided.common, divided.own, np.concatenate(lines))


def _priors(problem: Problem) -> Divided:
    layout, parts, heads = problem.layout, [], []
    for name, mean, precision in prior_parts(problem):
        slot, shared = layout.find(name)
        arrays = (mean, precision) if shared else (_single(mean, 1), _single(precision, 2))
        both = (_plain(arrays[0], 1), _plain(arrays[1], 2))
        count = max(len(part) for part in both)
        parts.append(np.concatenate([np.broadcast_to(part, (count, part.shape[1])) for part in both], axis=1))
        heads.append((slot.start, slot.size, int(not shared)))
    divided = Divided.of(parts)
    divided.place[:, 1:] = np.array(heads, dtype=np.int64).reshape(-1, 3)
    return divided


def _single(values: Array, core: int) -> Array:
    """Return values of an epoch without their epoch axis of length one, where they have one."""
    return np.take(values, 0, axis=-1 - core) if values.ndim > core else values

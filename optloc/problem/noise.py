"""Measurement noise: a covariance kept as blocks over rows, never as one full matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optloc.base import arrays, linalg
from optloc.base.types import Array


@dataclass(frozen=True)  # without slots: what follows from it is kept beside it
class Block:
    """Equal-sized groups of rows that are correlated within a group only.

    Parameters
    ----------
    row : int array (g, r)
        Global row numbers of each of the g groups.
    covariance : array (..., g or 1, r, r)
        Covariance of each group, in the rows' units squared.
    """

    row: Array
    covariance: Array

    @cached_property
    def whitening(self) -> Array:
        """Return whitening matrices (..., g or 1, r, r) of the covariance: a problem is evaluated many times."""
        return linalg.whitening(self.covariance)


@dataclass(frozen=True, slots=True)
class Noise:
    """The covariance of all rows as blocks; every row belongs to exactly one group.

    Parameters
    ----------
    blocks : tuple of Block
        Groups of equal size are kept together.
    """

    blocks: tuple[Block, ...]


@dataclass(frozen=True, slots=True)
class Whitener:
    """Maps residuals to unit covariance; rows of weight zero map to zero.

    Parameters
    ----------
    row : int array (g, r)
        Global row numbers.
    matrix : array (..., g or 1, r, r)
        ``matrix @ covariance @ matrix.T`` is the identity on the rows that are present.
    """

    row: Array
    matrix: Array

    def take(self, index: Array) -> Whitener:
        """Return the whitener of some problems of a flat batch."""
        shared = self.matrix.ndim == 3 or self.matrix.shape[0] == 1
        return self if shared else Whitener(self.row, self.matrix[index])

    def apply(self, values: Array) -> Array:
        """Return whitened values (..., g * r, p) of values (..., m, p) for this block's rows."""
        g, r = self.row.shape
        matrix, count = arrays.as_array_like(self.matrix, values), values.shape[-2]
        whole = self.row.size == count and np.array_equal(self.row.ravel(), np.arange(count))
        white: Array
        # Independent rows and one group of all rows are the usual cases: they need no gathering and no reshape.
        if r == 1:
            white = matrix[..., 0] * (values if whole else arrays.gather(values, self.row[:, 0], -2))
        elif g == 1:
            white = matrix[..., 0, :, :] @ (values if whole else arrays.gather(values, self.row[0], -2))
        else:
            white = matrix @ arrays.gather(values, self.row, -2)
            white = arrays.library(white).reshape(white, (*white.shape[:-3], g * r, white.shape[-1]))
        return white


def independent(variance: Array) -> Noise:
    """Return noise that is independent from row to row.

    Parameters
    ----------
    variance : array (..., m)
        Variance of each row.
    """
    rows = np.arange(variance.shape[-1])
    return Noise((Block(rows[:, None], variance[..., None, None]),))


def group_members(key: Array) -> list[Array]:
    """Return the members (g, r) of equal keys (m,), one array for each size of group r."""
    # Stable: members keep the order of the rows, on which the covariance is written down.
    order = np.argsort(key, kind="stable")
    _, first, sizes = np.unique(key[order], return_index=True, return_counts=True)
    return [order[first[sizes == r][:, None] + np.arange(r)] for r in np.unique(sizes)]


def arrivals(ends: Sequence[tuple[Array, int | Array]], variance: Array) -> Array:
    """Return the covariance of groups of rows that combine independent arrivals at stations.

    Parameters
    ----------
    ends : sequence of (int array (g, r), int or int array (g, r))
        Station of each row at one end, and the sign of its arrival: 0 for none.
    variance : array (..., s)
        Variance of each station's arrival.

    Returns
    -------
    array (..., g, r, r)
        Singular where the rows of a group close a loop; the whitener then uses the pseudo-inverse.
    """
    used = [(index, np.broadcast_to(sign, index.shape)) for index, sign in ends if np.any(sign)]
    shape = ends[0][0].shape
    covariance = np.zeros((*variance.shape[:-1], *shape, shape[-1]))
    # An end of a row meets an end of another where they name one station: + for the same end of differences, - for
    # opposite ones.
    for one, sign in used:
        for two, other in used:
            shared = (one[:, :, None] == two[:, None, :]) * (sign[:, :, None] * other[:, None, :])
            covariance += shared * variance[..., one][..., None]
    return covariance


def group(blocks: Sequence[Block]) -> Noise:
    """Return noise with groups of equal size and batch shape stacked, so that they are handled in one operation.

    Parameters
    ----------
    blocks : sequence of Block
        Any blocks.
    """
    stacks: dict[tuple[int, tuple[int, ...]], list[Block]] = {}
    for block in blocks:
        stacks.setdefault((block.row.shape[1], block.covariance.shape[:-3]), []).append(block)
    return Noise(tuple(_stack(same) for same in stacks.values()))


def _stack(blocks: list[Block]) -> Block:
    if len(blocks) == 1:
        return blocks[0]
    covariances = []
    for block in blocks:
        shape = block.covariance.shape
        covariances.append(np.broadcast_to(block.covariance, (*shape[:-3], len(block.row), *shape[-2:])))
    return Block(np.concatenate([block.row for block in blocks]), np.concatenate(covariances, axis=-3))


def whiten(noise: Noise, weight: Array) -> tuple[Whitener, ...]:
    """Return the whitening matrices of noise with row weights.

    A weight w adds ``(1/w - 1)`` times its own variance to a row, so that w -> 0 is exactly the row's absence.

    Parameters
    ----------
    noise : Noise
        Covariance blocks.
    weight : array (..., m)
        Row weights in [0, 1].
    """
    return tuple(_whitener(block, weight) for block in noise.blocks)


def _whitener(block: Block, weight: Array) -> Whitener:
    picked, xp = arrays.gather(weight, block.row), arrays.library(weight)
    # All rows as measured: the matrices of the covariance itself, shared by the batch where that is.
    if bool(xp.all(picked == 1.0)):
        # what other libraries trace belongs to one trace
        own = arrays.is_other_library(block.covariance)
        return Whitener(block.row, linalg.whitening(block.covariance) if own else block.whitening)
    present = picked > 0.0
    variance = xp.linalg.diagonal(block.covariance)
    extra = xp.where(present, (1.0 / xp.where(present, picked, 1.0) - 1.0) * variance, 0.0)
    # Rows and columns of zeros are absent for `linalg.whitening`, exactly and without a limit.
    both = present[..., :, None] & present[..., None, :]
    covariance = xp.where(both, block.covariance, 0.0) + extra[..., None] * arrays.eye(block.row.shape[1], weight)
    return Whitener(block.row, linalg.whitening(covariance))


def gathered(noise: Noise, members: Array) -> Array:
    """Return the covariance of groups of rows.

    Parameters
    ----------
    noise : Noise
        Covariance blocks.
    members : int array (g, r)
        Global row numbers; correlation with rows of other groups is left out.

    Returns
    -------
    array (..., g, r, r)
        In the given order.
    """
    count = 1 + max(int(members.max()), *(int(block.row.max()) for block in noise.blocks))
    # Row number to group and place in it, -1 for rows that nobody asked for.
    group_of, slot = np.full(count, -1), np.zeros(count, dtype=np.int64)
    group_of[members], slot[members] = np.arange(len(members))[:, None], np.arange(members.shape[1])
    shape = np.broadcast_shapes(*(block.covariance.shape[:-3] for block in noise.blocks))
    out = np.zeros((*shape, *members.shape, members.shape[1]))
    for block in noise.blocks:
        inner = (*block.covariance.shape[:-3], *block.row.shape, block.row.shape[1])
        one, two = np.broadcast_arrays(block.row[:, :, None], block.row[:, None, :])
        kept = (group_of[one] >= 0) & (group_of[one] == group_of[two])
        where = (group_of[one[kept]], slot[one[kept]], slot[two[kept]])
        out[..., where[0], where[1], where[2]] = np.broadcast_to(block.covariance, inner)[..., kept]
    return out


def dense(noise: Noise, rows: Array) -> Array:
    """Return the covariance (..., q, q) of a few rows (q,) as one matrix, in the given order."""
    return np.asarray(gathered(noise, rows[None])[..., 0, :, :])


def variances(noise: Noise, count: int) -> Array:
    """Return the variance of each of `count` rows, (..., m)."""
    shape = np.broadcast_shapes(*(block.covariance.shape[:-3] for block in noise.blocks))
    out = np.zeros((*shape, count))
    for block in noise.blocks:
        out[..., block.row] = np.diagonal(block.covariance, axis1=-2, axis2=-1)
    return out


def whiten_rows(noise: tuple[Whitener, ...], values: Array) -> Array:
    """Return whitened values (..., q, p) of values (..., m, p) of all rows, block under block."""
    parts = [whitener.apply(values) for whitener in noise]
    shape = np.broadcast_shapes(*(part.shape[:-2] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*shape, *part.shape[-2:])) for part in parts], axis=-2)

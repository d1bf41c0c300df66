"""Measurement noise: a covariance in blocks over rows, never one full matrix.

Letters: m rows of the problem, g groups of r rows in a block, s stations, q selected rows, p columns. A whitening
matrix W of a covariance C has W C W' = I.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.base import arrays, linalg
from optloc.base.cached import cached_property
from optloc.base.types import Array


@dataclass(frozen=True)  # without slots, because a cached property needs `__dict__`
class Block:
    """Groups of rows with equal size. Rows are correlated only within a group.

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
        """Return whitening matrices (..., g or 1, r, r) of the covariance, cached because they are used often."""
        return linalg.whitening(self.covariance)


@dataclass(frozen=True, slots=True)
class Noise:
    """The covariance of all rows as blocks. Each row belongs to exactly one group.

    Parameters
    ----------
    blocks : tuple of Block
        Blocks of groups. Groups of equal size are in one block.
    """

    blocks: tuple[Block, ...]


@dataclass(frozen=True, slots=True)
class Whitener:
    """Whitening matrices: they map residuals to unit covariance, and rows of weight zero to zero.

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
        """Return the whitener of the selected problems of a flat batch."""
        shared = self.matrix.ndim == 3 or self.matrix.shape[0] == 1
        return self if shared else Whitener(self.row, self.matrix[index])

    def apply(self, values: Array) -> Array:
        """Return whitened values (..., g r, p) of values (..., m, p), for the g r rows of this block.

        The columns are, for instance, a residual and a Jacobian.
        """
        g, r = self.row.shape
        matrix, count = arrays.as_array_like(self.matrix, values), values.shape[-2]
        all_rows = self.row.size == count and np.array_equal(self.row.ravel(), np.arange(count))
        whitened: Array
        # Independent rows, and one group of all rows, are the usual cases. They need no gathering and no reshape.
        if r == 1:
            whitened = matrix[..., 0] * (values if all_rows else arrays.gather(values, self.row[:, 0], -2))
        elif g == 1:
            whitened = matrix[..., 0, :, :] @ (values if all_rows else arrays.gather(values, self.row[0], -2))
        else:
            whitened = matrix @ arrays.gather(values, self.row, -2)
            whitened = arrays.library(whitened).reshape(whitened, (*whitened.shape[:-3], g * r, whitened.shape[-1]))
        return whitened


def independent(variance: Array) -> Noise:
    """Return noise with independent rows.

    Parameters
    ----------
    variance : array (..., m)
        Variance of each row.
    """
    rows = np.arange(variance.shape[-1])
    return Noise((Block(rows[:, None], variance[..., None, None]),))


def group_members(key: Array) -> list[Array]:
    """Return the indices of equal keys (m,): one array (g, r) for each group size r, with one group in each row.

    For example, the keys (5, 7, 5) give the arrays [[1]] and [[0, 2]].
    """
    # A stable sort keeps the order of the rows, in which the covariance is given.
    order = np.argsort(key, kind="stable")
    _, first, sizes = np.unique(key[order], return_index=True, return_counts=True)
    return [order[first[sizes == r][:, None] + np.arange(r)] for r in np.unique(sizes)]


def arrivals(ends: Sequence[tuple[Array, int | Array]], variance: Array) -> Array:
    """Return the covariance of groups of rows that are sums or differences of independent arrivals at stations.

    Parameters
    ----------
    ends : sequence of (int array (g, r), int or int array (g, r))
        For each end of a row: the station numbers, and the signs with which its arrival enters; 0 for no arrival.
    variance : array (..., s)
        Variance of each station's arrival.

    Returns
    -------
    array (..., g, r, r)
        Singular if the rows of a group form a loop. The whitener then uses the pseudo-inverse.
    """
    parts = [(index, np.broadcast_to(sign, index.shape)) for index, sign in ends if np.any(sign)]
    shape = ends[0][0].shape
    covariance = np.zeros((*variance.shape[:-1], *shape, shape[-1]))
    # Two rows with a common station are correlated: positive if it is at the same end of both differences, negative if
    # it is at opposite ends.
    for one, sign in parts:
        for two, other in parts:
            shared = (one[:, :, None] == two[:, None, :]) * (sign[:, :, None] * other[:, None, :])
            covariance += shared * variance[..., one][..., None]
    return covariance


def group(blocks: Sequence[Block]) -> Noise:
    """Return noise in which groups of equal size and batch shape are stacked, for fewer array operations.

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
    """Return one block with the groups of all blocks; the groups have equal size and batch shape."""
    if len(blocks) == 1:
        return blocks[0]
    covariances = []
    for block in blocks:
        shape = block.covariance.shape
        covariances.append(np.broadcast_to(block.covariance, (*shape[:-3], len(block.row), *shape[-2:])))
    return Block(np.concatenate([block.row for block in blocks]), np.concatenate(covariances, axis=-3))


def whiten(noise: Noise, weight: Array) -> tuple[Whitener, ...]:
    """Return the whitening matrices of noise with row weights.

    A weight w adds ``(1/w - 1)`` times the variance of the row to this variance. In the limit w -> 0 the row is absent.

    Parameters
    ----------
    noise : Noise
        Covariance blocks.
    weight : array (..., m)
        Row weights in [0, 1].
    """
    return tuple(_whitener(block, weight) for block in noise.blocks)


def _whitener(block: Block, weight: Array) -> Whitener:
    """Return the whitening matrices of one block; `weight` (..., m) are the weights of all rows, see `whiten`."""
    weights, xp = arrays.gather(weight, block.row), arrays.library(weight)
    # With unit weights the whitening matrices of the covariance apply; the batch shares them if it shares the
    # covariance.
    if bool(xp.all(weights == 1.0)):
        # Arrays of another library can belong to one trace, so they are not cached.
        other_library = arrays.is_other_library(block.covariance)
        return Whitener(block.row, linalg.whitening(block.covariance) if other_library else block.whitening)
    present = weights > 0.0
    variance = xp.linalg.diagonal(block.covariance)
    added_variance = xp.where(present, (1.0 / xp.where(present, weights, 1.0) - 1.0) * variance, 0.0)
    # `linalg.whitening` treats rows and columns of zeros as absent, exactly and without a limit.
    present_pairs = present[..., :, None] & present[..., None, :]
    covariance = xp.where(present_pairs, block.covariance, 0.0) + added_variance[..., None] * arrays.eye(
        block.row.shape[1], weight
    )
    return Whitener(block.row, linalg.whitening(covariance))


def gathered(noise: Noise, members: Array) -> Array:
    """Return the covariance of the given groups of rows.

    Groups can differ from the groups of the noise. Rows without a common noise group are uncorrelated.

    Parameters
    ----------
    noise : Noise
        Covariance blocks.
    members : int array (g, r)
        Global row numbers. The result omits correlation between groups.

    Returns
    -------
    array (..., g, r, r)
        Covariance of each group, in the given order of rows.
    """
    count = 1 + max(int(members.max()), *(int(block.row.max()) for block in noise.blocks))
    # Maps a row number to its group and its index in the group; -1 for rows that are not requested.
    group_of, slot = np.full(count, -1), np.zeros(count, dtype=np.int64)
    group_of[members], slot[members] = np.arange(len(members))[:, None], np.arange(members.shape[1])
    shape = np.broadcast_shapes(*(block.covariance.shape[:-3] for block in noise.blocks))
    out = np.zeros((*shape, *members.shape, members.shape[1]))
    for block in noise.blocks:
        inner = (*block.covariance.shape[:-3], *block.row.shape, block.row.shape[1])
        one, two = np.broadcast_arrays(block.row[:, :, None], block.row[:, None, :])
        inside_group = (group_of[one] >= 0) & (group_of[one] == group_of[two])
        entries = (group_of[one[inside_group]], slot[one[inside_group]], slot[two[inside_group]])
        out[..., entries[0], entries[1], entries[2]] = np.broadcast_to(block.covariance, inner)[..., inside_group]
    return out


def dense(noise: Noise, rows: Array) -> Array:
    """Return the covariance (..., q, q) of the given rows (q,) as one matrix, in the given order."""
    return np.asarray(gathered(noise, rows[None])[..., 0, :, :])


def variances(noise: Noise, count: int) -> Array:
    """Return the variances (..., m) of all m = `count` rows, in the squared units of the rows."""
    shape = np.broadcast_shapes(*(block.covariance.shape[:-3] for block in noise.blocks))
    out = np.zeros((*shape, count))
    for block in noise.blocks:
        out[..., block.row] = np.diagonal(block.covariance, axis1=-2, axis2=-1)
    return out


def whiten_rows(noise: tuple[Whitener, ...], values: Array) -> Array:
    """Return whitened values (..., q, p) of values (..., m, p) of all rows, one block after the other.

    The q rows of the result are sorted by block, not by row number.
    """
    parts = [whitener.apply(values) for whitener in noise]
    shape = np.broadcast_shapes(*(part.shape[:-2] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*shape, *part.shape[-2:])) for part in parts], axis=-2)

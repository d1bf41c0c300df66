"""Symmetric block tridiagonal systems of epochs that are coupled to the next epoch.

The time to solve them is linear in the number k of epochs. Every epoch has a block of l unknowns. Regular systems are
banded matrices, which LAPACK factors. Blocks of the inverse, and systems with singular blocks, use cyclic reduction: it
eliminates every other (odd) block. The even blocks are a chain of half the length. For positive definite matrices this
is Cholesky's method in another order.

B. L. Buzbee, G. H. Golub, C. W. Nielson, "On direct methods for solving Poisson's equations", SIAM J. Numer. Anal. 7
(1970) 627-656.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array

# Share of its information below which a block leaves a combination undetermined, as in `optloc.linear.normal`.
_OPEN = 1e-12
# Share of the largest block below which the remainder of the last block is rounding: sums of k blocks lose k eps.
_ROUNDING = 1e-13


def solve(block: Array, link: Array, right: Array) -> tuple[Array, Array]:
    """Return the solutions of a chain, and whether it is regular.

    Parameters
    ----------
    block : array (..., k, l, l)
        Blocks on the diagonal; the whole matrix is positive semidefinite.
    link : array (..., k - 1, l, l)
        Blocks above the diagonal: rows of a block, columns of the next block.
    right : array (..., k, l, p)
        Right sides. If a block is singular, the solution is the one of least norm.

    Returns
    -------
    solved : array (..., k, l, p)
        Solutions.
    ok : bool array (...)
        False if the whole chain is singular.
    """
    shape = np.broadcast_shapes(block.shape[:-3], right.shape[:-3])
    out, ok = np.empty((*shape, *right.shape[-3:])), np.ones(shape, dtype=bool)
    each = [np.broadcast_to(part, (*shape, *part.shape[-3:])) for part in (block, link, right)]
    for i in np.ndindex(shape):
        one, two, three = (part[i] for part in each)
        found = _banded(one, two, three)
        if found is None:
            found, _, ok[i] = _reduce(one, two, three, np.abs(one).max(), inverse=False)
        out[i] = found
    return out, ok


def _banded(block: Array, link: Array, right: Array) -> Array | None:
    """Return the solution (k, l, p) of one chain by a banded factor, or None if the chain is not safely regular.

    See `solve` for the arguments `block`, `link` and `right`, without batch axes.
    """
    from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

    k, length = block.shape[:2]
    # LAPACK's lower band format: entry (i + d, i) of the matrix is in line d, column i
    band = np.zeros((2 * length, k, length))
    for d in range(length):
        band[d, :, : length - d] = np.diagonal(block, -d, 1, 2)
        band[length + d, :-1, : length - d] = np.diagonal(link.mT, -d, 1, 2)
        if d:
            band[length - d, :-1, d:] = np.diagonal(link.mT, d, 1, 2)
    band = band.reshape(2 * length, -1)
    if not np.isfinite(band).all() or not (band[0] > 0.0).all():
        return None
    try:
        factor = cholesky_banded(band, lower=True, check_finite=False)
    except LinAlgError:
        return None
    if (factor[0] ** 2 <= _OPEN * band[0]).any():
        return None
    flat = right.reshape(k * length, -1)
    return np.asarray(cho_solve_banded((factor, True), flat, check_finite=False)).reshape(right.shape)


def inverse_blocks(block: Array, link: Array) -> tuple[Array, Array]:
    """Return the diagonal blocks of the inverse of a chain, and whether the chain is regular.

    Parameters
    ----------
    block : array (..., k, l, l)
        Blocks on the diagonal; the whole matrix is symmetric and positive semidefinite.
    link : array (..., k - 1, l, l)
        Blocks above the diagonal: rows of a block, columns of the next block.

    Returns
    -------
    inner : array (..., k, l, l)
        Diagonal blocks of the inverse; NaN if the chain is singular.
    ok : bool array (...)
        False if the chain is singular.
    """
    none = np.zeros((*block.shape[:-1], 0))  # no right sides
    _, (inner, _), ok = _reduce(block, link, none, np.abs(block).max((-1, -2, -3)), inverse=True)
    return inner, ok


class _ChainParts(NamedTuple):
    """Blocks of the inverse of a chain.

    `inner` (..., k, l, l) are the blocks on the diagonal. `beside` (..., k - 1, l, l) are the blocks above it: rows of
    an epoch, columns of the next.
    """

    inner: Array
    beside: Array


def _reduce(block: Array, link: Array, right: Array, size: Array, inverse: bool) -> tuple[Array, _ChainParts, Array]:
    """Return the solutions, blocks of the inverse, and whether the chain is regular, by cyclic reduction.

    `block`, `link` and `right` are as in `solve`. `size` (...) is the largest absolute entry of the blocks; a remainder
    that is rounding relative to it counts as zero. The blocks of the inverse are computed only if `inverse` is True;
    else they have no columns. The function calls itself for the even blocks. Blocks are counted from 0.
    """
    k, length = block.shape[-3:-1]
    eye = np.broadcast_to(np.eye(length) if inverse else np.zeros((length, 0)), (*block.shape[:-1], length * inverse))
    if k == 1:
        both, good = linalg.solve(block, np.concatenate([right, eye], axis=-1), _OPEN)
        left = np.diagonal(block, axis1=-2, axis2=-1).min((-1, -2))
        ok = good.all(-1) & (left > _ROUNDING * size)
        inner = np.where(ok[..., None, None, None], both[..., right.shape[-1] :], np.nan)
        return both[..., : right.shape[-1]], _ChainParts(inner, link), ok
    # An odd block is coupled to the blocks before and after it. If k is even, the last block is odd and has no block
    # after it: its entry of `after` stays zero.
    after = np.zeros((*block.shape[:-3], k // 2, length, length))
    after[..., : (k - 1) // 2, :, :] = link[..., 1::2, :, :]
    before = link[..., ::2, :, :].mT
    sides = np.concatenate([before, after, right[..., 1::2, :, :], eye[..., 1::2, :, :]], axis=-1)
    solved = _solve_blocks(block[..., 1::2, :, :], sides)
    gain_before, gain_after, solved_right, own_inverse = np.split(
        solved, np.cumsum([length, length, right.shape[-1]]), axis=-1
    )
    # The system of the even blocks after elimination of the odd blocks. There are m odd blocks; `follow` of them have
    # an even block after them.
    rest, vector = block[..., ::2, :, :].copy(), right[..., ::2, :, :].copy()
    m = k // 2
    rest[..., :m, :, :] -= before.mT @ gain_before
    vector[..., :m, :, :] -= before.mT @ solved_right
    follow = (k - 1) // 2
    rest[..., 1:, :, :] -= (after.mT @ gain_after)[..., :follow, :, :]
    vector[..., 1:, :, :] -= (after.mT @ solved_right)[..., :follow, :, :]
    between = -(before.mT @ gain_after)[..., :follow, :, :]
    even, parts, ok = _reduce(rest, between, vector, size, inverse)
    out = np.empty((*block.shape[:-3], k, length, right.shape[-1]))
    out[..., ::2, :, :] = even
    behind = _following_even(even, m)
    out[..., 1::2, :, :] = solved_right - gain_before @ even[..., :m, :, :] - gain_after @ behind
    return out, _inverse_blocks_of_chain(parts, gain_before, gain_after, own_inverse, k) if inverse else parts, ok


def _following_even(even: Array, count: int) -> Array:
    """Return, for each of `count` odd blocks, the value of the even block after it; zero if none follows."""
    out = np.zeros((*even.shape[:-3], count, *even.shape[-2:]))
    out[..., : even.shape[-3] - 1, :, :] = even[..., 1:, :, :]
    return out


def _inverse_blocks_of_chain(
    parts: _ChainParts, gain_before: Array, gain_after: Array, own_inverse: Array, k: int
) -> _ChainParts:
    """Return the blocks of the inverse of the whole chain of k epochs, from the blocks `parts` of the even epochs.

    An odd block A with right side b has the unknowns ``x = own_inverse b - gain_before x_before - gain_after x_after``.
    `own_inverse` is the inverse of A. The gains (..., k // 2, l, l) multiply the unknowns of the even blocks before and
    after.
    """
    m, first = k // 2, parts.inner[..., : k // 2, :, :]
    second, across = _following_even(parts.inner, m), np.zeros_like(gain_before)
    across[..., : parts.beside.shape[-3], :, :] = parts.beside
    # blocks of the inverse: rows of an odd block, columns of the even block before or after it
    with_before = -(gain_before @ first + gain_after @ across.mT)
    with_after = -(gain_before @ across + gain_after @ second)
    inner = np.empty((*gain_before.shape[:-3], k, *gain_before.shape[-2:]))
    inner[..., ::2, :, :] = parts.inner
    inner[..., 1::2, :, :] = own_inverse - with_before @ gain_before.mT - with_after @ gain_after.mT
    beside = np.empty((*gain_before.shape[:-3], k - 1, *gain_before.shape[-2:]))
    beside[..., ::2, :, :] = with_before.mT
    beside[..., 1::2, :, :] = with_after[..., : (k - 1) // 2, :, :]
    return _ChainParts(inner, beside)


def _solve_blocks(block: Array, right: Array) -> Array:
    """Return the solutions of separate systems ``block x = right``, of least norm if a matrix is singular."""
    solved, good = linalg.solve(block, right, _OPEN)
    if not good.all():
        root, _ = linalg.root(block[~good])
        solved[~good] = root @ (root.mT @ right[~good])
    return solved

"""Least squares over a position alone: what else is unknown, and enters linearly, takes its best value."""

from __future__ import annotations

import numpy as np

from optloc.noise import Whitener
from optloc.types import Array


def whitened(noise: tuple[Whitener, ...], values: Array) -> Array:
    """Return whitened values (..., q, p) of values (..., m, p) of all rows, block under block."""
    parts = [whitener.apply(values) for whitener in noise]
    shape = np.broadcast_shapes(*(part.shape[:-2] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*shape, *part.shape[-2:])) for part in parts], axis=-2)


def roots(precision: Array) -> Array:
    """Return L' (..., n, n) with L L' a symmetric positive semidefinite precision."""
    values, vectors = np.linalg.eigh(precision)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[..., :, None] * np.swapaxes(vectors, -1, -2))


def without(unknowns: Array, values: Array) -> Array:
    """Return values (..., q, p) less their projection onto the span of unknowns (..., q, n).

    Columns of unknowns are scaled to one length first; what then is shorter than 1e-12 counts as dependent.
    """
    if not unknowns.shape[-1]:
        return values
    length = np.sqrt((unknowns**2).sum(-2, keepdims=True))
    u, s, _ = np.linalg.svd(unknowns / np.where(length > 0.0, length, 1.0), full_matrices=False)
    basis = u * (s > 1e-12 * np.maximum(s[..., :1], 1e-300))[..., None, :]
    once = values - basis @ (np.swapaxes(basis, -1, -2) @ values)
    return np.asarray(once - basis @ (np.swapaxes(basis, -1, -2) @ once))


def compressed(K: Array, w: Array) -> tuple[Array, Array]:
    """Return rows that have the same sum of squares ``|K phi - w|^2`` for every phi, at most one more than nodes.

    Parameters
    ----------
    K : array (B, q, J)
        Whitened rows over the nodes, B = 1 or N.
    w : array (N, q)
        Whitened measurements.
    """
    q, nodes = K.shape[-2:]
    if q <= nodes + 1:
        return K, w
    basis, upper = np.linalg.qr(K)
    inside = (np.swapaxes(basis, -1, -2) @ w[..., None])[..., 0]
    rest = w - (basis @ inside[..., None])[..., 0]
    last = np.sqrt((rest**2).sum(-1, keepdims=True))
    upper = np.concatenate([upper, np.zeros((*upper.shape[:-2], 1, nodes))], axis=-2)
    return upper, np.concatenate([inside, last], axis=-1)

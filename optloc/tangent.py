"""Least squares on the tangent space of equality constraints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc import linalg
from optloc.types import Array


@dataclass(frozen=True, slots=True)
class Tangent:
    """Directions along which equalities hold to first order, and the directions across.

    Parameters
    ----------
    along : array (N, n, n - c)
        Basis of the tangent space.
    across : array (N, n, c)
        ``across @ g`` is the shortest step that restores the equalities.
    """

    along: Array
    across: Array


def tangent(gradients: Array, scale: Array) -> Tangent:
    """Return the tangent space of equalities.

    Parameters
    ----------
    gradients : array (N, c, n)
        Gradients of the equalities.
    scale : array (N, n)
        Typical size of each unknown: decides what "shortest" means.
    """
    c = gradients.shape[-2]
    scaled = np.swapaxes(gradients * scale[:, None], -1, -2)
    scaled = np.where(np.isfinite(scaled), scaled, 0.0)
    q, r = np.linalg.qr(scaled, mode="complete")
    size = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    regular = size > 1e-12 * np.maximum(size.max(-1, keepdims=True), 1e-300)
    lower = np.swapaxes(r[:, :c], -1, -2)
    restore = np.zeros_like(lower)
    for i in range(c):  # inverse of the small triangle, column by column; a dependent equality restores nothing
        for j in range(c):
            known = (lower[:, i, :i] * restore[:, :i, j]).sum(-1)
            value = (float(i == j) - known) / np.where(regular[:, i], lower[:, i, i], 1.0)
            restore[:, i, j] = np.where(regular[:, i], value, 0.0)
    return Tangent(scale[..., None] * q[..., c:], scale[..., None] * (q[..., :c] @ restore))


def solve(information: Array, vector: Array, space: Tangent) -> tuple[Array, Array]:
    """Return the step (N, n) within the tangent space that solves the normal equations, and where it exists (N,)."""
    z = space.along
    if z.shape[-1] == 0:
        return np.zeros_like(vector), np.ones(len(vector), dtype=bool)
    transposed = np.swapaxes(z, -1, -2)
    part, ok = linalg.solve(transposed @ information @ z, transposed @ vector[..., None])
    return (z @ part)[..., 0], ok


def inverse(information: Array, space: Tangent) -> tuple[Array, Array]:
    """Return the covariance (N, n, n) on the tangent space, zero across it, and where it exists (N,)."""
    z = space.along
    if z.shape[-1] == 0:
        return np.zeros_like(information), np.ones(len(information), dtype=bool)
    transposed = np.swapaxes(z, -1, -2)
    inner, ok = linalg.inverse(transposed @ information @ z)
    return z @ inner @ transposed, ok

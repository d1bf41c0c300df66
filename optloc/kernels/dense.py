"""Small symmetric positive definite systems in lanes: one singular lane never disturbs the others."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.kernels.jit import compiled
from optloc.types import Array

LEAST = 1e-15
"""Share of its diagonal that a pivot must exceed, as in `optloc.linalg`."""


class Systems(NamedTuple):
    """Working memory for normal equations of n shared and l local unknowns in B lanes."""

    shared: Array  # (n, n, B): lower triangle, then its factor
    shared_scale: Array  # (n, B)
    local: Array  # (l, l, B)
    local_scale: Array  # (l, B)
    half: Array  # (l, n + 1, B): the factor's inverse times coupling and vector
    step: Array  # (n + l, B)
    ok: Array  # (B,): 1.0 where the systems can be solved


@compiled
def systems(n: int, local: int, lanes: int) -> Systems:
    """Return working memory for a number of lanes."""
    return Systems(
        np.zeros((n, n, lanes)),
        np.zeros((n, lanes)),
        np.zeros((local, local, lanes)),
        np.zeros((local, lanes)),
        np.zeros((local, n + 1, lanes)),
        np.zeros((n + local, lanes)),
        np.zeros(lanes),
    )


@compiled
def factor(matrix: Array, scale: Array, ok: Array, lanes: int) -> None:
    """Replace lower triangles (n, n, B) by the factors of the matrices scaled to a unit diagonal.

    Parameters
    ----------
    matrix : array (n, n, B)
        Symmetric matrices.
    scale : array (n, B)
        Receives the scales.
    ok : array (B,)
        Becomes 0.0 where a matrix is not numerically positive definite.
    lanes : int
        How many lanes count.
    """
    n = matrix.shape[0]
    for i in range(n):
        diagonal, own = matrix[i, i], scale[i]
        for b in range(lanes):
            positive = diagonal[b] > 0.0
            own[b] = 1.0 / np.sqrt(diagonal[b] if positive else 1.0)
            ok[b] = ok[b] if positive else 0.0
        for j in range(i + 1):
            entry, other = matrix[i, j], scale[j]
            for b in range(lanes):
                entry[b] = entry[b] * own[b] * other[b]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            u = matrix[j, k]
            for b in range(lanes):
                pivot[b] -= u[b] * u[b]
        for b in range(lanes):
            positive = pivot[b] > LEAST  # of a diagonal that is one
            ok[b] = ok[b] if positive else 0.0
            pivot[b] = np.sqrt(pivot[b]) if positive else 1.0
        for i in range(j + 1, n):
            entry = matrix[i, j]
            for k in range(j):
                u, v = matrix[i, k], matrix[j, k]
                for b in range(lanes):
                    entry[b] -= u[b] * v[b]
            for b in range(lanes):
                entry[b] /= pivot[b]


@compiled
def forward(lower: Array, scale: Array, right: Array, lanes: int) -> None:
    """Replace vectors (n, B) by the factor's inverse times the scaled vectors."""
    for i in range(lower.shape[0]):
        own, by, pivot = right[i], scale[i], lower[i, i]
        for b in range(lanes):
            own[b] *= by[b]
        for k in range(i):
            u, v = lower[i, k], right[k]
            for b in range(lanes):
                own[b] -= u[b] * v[b]
        for b in range(lanes):
            own[b] /= pivot[b]


@compiled
def backward(lower: Array, scale: Array, right: Array, lanes: int) -> None:
    """Replace vectors (n, B) that `forward` returned by the solutions."""
    n = lower.shape[0]
    for i in range(n - 1, -1, -1):
        own, pivot = right[i], lower[i, i]
        for k in range(i + 1, n):
            u, v = lower[k, i], right[k]
            for b in range(lanes):
                own[b] -= u[b] * v[b]
        for b in range(lanes):
            own[b] /= pivot[b]
    for i in range(n):
        own, by = right[i], scale[i]
        for b in range(lanes):
            own[b] *= by[b]


@compiled
def step(now: Array, damping: Array, room: Systems, lanes: int) -> None:
    """Write the damped step of every lane into `room.step`, zero where `room.ok` becomes 0.0.

    Parameters
    ----------
    now : array (n + l + 1, n + l + 1, B)
        Normal equations as `optloc.kernels.gather.gather` writes them.
    damping : array (B,)
        Marquardt's factor: the diagonal of the information is multiplied by one more than it.
    room : Systems
        Working memory.
    lanes : int
        How many lanes count.
    """
    n, local = room.shared.shape[0], room.local.shape[0]
    size, move = n + local, room.step
    room.ok[:lanes] = 1.0
    for i in range(n):
        for j in range(i + 1):
            room.shared[i, j, :lanes] = now[i, j, :lanes]
        for b in range(lanes):
            room.shared[i, i, b] *= 1.0 + damping[b]
        move[i, :lanes] = now[size, i, :lanes]
    if local > 0:
        _eliminate(now, damping, room, lanes)
    factor(room.shared, room.shared_scale, room.ok, lanes)
    forward(room.shared, room.shared_scale, move[:n], lanes)
    backward(room.shared, room.shared_scale, move[:n], lanes)
    if local > 0:
        _complete(now, room, lanes)
    for i in range(size):
        for b in range(lanes):
            if room.ok[b] == 0.0:
                move[i, b] = 0.0


@compiled
def _eliminate(now: Array, damping: Array, room: Systems, lanes: int) -> None:
    """Take from the shared system what the local unknowns cost it."""
    n, local = room.shared.shape[0], room.local.shape[0]
    size = n + local
    for i in range(local):
        for j in range(i + 1):
            room.local[i, j, :lanes] = now[n + i, n + j, :lanes]
        for b in range(lanes):
            grown = room.local[i, i, b] * (1.0 + damping[b])
            room.local[i, i, b] = grown if grown != 0.0 else 1.0  # what no row touches stays where it is
        for j in range(n):
            room.half[i, j, :lanes] = now[n + i, j, :lanes]
        room.half[i, n, :lanes] = now[size, n + i, :lanes]
    factor(room.local, room.local_scale, room.ok, lanes)
    for j in range(n + 1):
        forward(room.local, room.local_scale, room.half[:, j], lanes)
    for a in range(local):
        for i in range(n):
            u = room.half[a, i]
            for b in range(lanes):
                room.step[i, b] -= u[b] * room.half[a, n, b]
            for j in range(i + 1):
                for b in range(lanes):
                    room.shared[i, j, b] -= u[b] * room.half[a, j, b]


@compiled
def _complete(now: Array, room: Systems, lanes: int) -> None:
    """Write the step of the local unknowns behind that of the shared ones."""
    n, local = room.shared.shape[0], room.local.shape[0]
    for a in range(local):
        own = room.step[n + a]
        own[:lanes] = now[n + local, n + a, :lanes]
        for i in range(n):
            for b in range(lanes):
                own[b] -= now[n + a, i, b] * room.step[i, b]
    forward(room.local, room.local_scale, room.step[n:], lanes)
    backward(room.local, room.local_scale, room.step[n:], lanes)

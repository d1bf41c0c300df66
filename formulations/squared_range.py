r"""Squared-range least squares: a linear fit with one quadratic constraint, solved exactly.

.. math:: \min_y \; |B y - g|^2 \quad\text{subject to}\quad y^\top C y + 2 h^\top y = 0

for two quadrics. The *cone*, :math:`y = (x, r)`, `C = diag(1, .., 1, -1)`, `h = 0`: `x` is measured from a reference
point and `r` is its distance (range differences, arrival times, range sums, bearings). The *paraboloid*, :math:`y =
(x, w)`, `C = diag(1, .., 1, 0)`, `h = (0, .., 0, -1/2)`: `w` is :math:`|x|^2` (ranges, ratios of ranges, bearings).

A multiplier :math:`\lambda` makes every stationary point but the apex of the cone a solution of
:math:`(B^\top B + \lambda C) y = B^\top g - \lambda h`. Both cases become :math:`\sum_j c_j^2/(t - p_j)^2 = \kappa +
\sigma t` (:mod:`formulations.secular`), with d poles:

- cone: :math:`C v_j = \gamma_j (A + \lambda_0 C) v_j`, one negative :math:`\gamma_0`, and :math:`t = 1/(1 + (\lambda
  - \lambda_0) \gamma_0)`. Adding :math:`\lambda_0 C` changes no value on the cone; it makes the pencil definite when
  :math:`A = B^\top B` is singular;
- paraboloid: `w` is eliminated by its own (linear) equation and :math:`t = \lambda`.

The global minimiser is the root above the last pole, where :math:`B^\top B + \lambda C` is positive semidefinite (no
gap). A singular `A` is the hard case: a root sits on a pole, and both intersections of the solution line with the
quadric appear.

Sources: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), section 3; A.
Beck, P. Stoica and J. Li, "Exact and approximate solutions of source localization problems", IEEE Trans. Signal
Process. 56 (2008), section II (ranges: the paraboloid) and section III (range differences: the cone).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formulations._batch import apply
from formulations._cone import Finder, solve_cone
from formulations._interior import descend
from formulations._line import intersections
from formulations._paraboloid import solve_paraboloid
from formulations.secular import everything, largest

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CHUNK = 2048


@dataclass(frozen=True, slots=True)
class Quadric:
    """The constraint ``y'Cy + 2h'y = 0`` on ``y`` of length ``size``.

    Parameters
    ----------
    shape : {"cone", "paraboloid"}
        ``|x| = |r|`` with ``y = (x, r)``, or ``|x|^2 = w`` with ``y = (x, w)``.
    size : int
        Length of ``y``: the dimension of ``x`` plus one.
    """

    shape: Literal["cone", "paraboloid"]
    size: int

    @property
    def square(self) -> Array:
        """Diagonal of C, shape (size,)."""
        out = np.ones(self.size)
        out[-1] = -1.0 if self.shape == "cone" else 0.0
        return out

    @property
    def linear(self) -> Array:
        """The vector h, shape (size,)."""
        out = np.zeros(self.size)
        out[-1] = 0.0 if self.shape == "cone" else -0.5
        return out

    def value(self, y: Array) -> Array:
        """``y'Cy + 2h'y``.

        Parameters
        ----------
        y : Array, shape (..., size)
            Points.

        Returns
        -------
        Array, shape (...)
            Zero on the quadric.
        """
        return np.asarray(np.sum(self.square * y * y + 2.0 * self.linear * y, axis=-1))


def cone(d: int) -> Quadric:
    """Quadric ``|x|^2 = r^2`` with ``x`` of dimension `d`.

    Parameters
    ----------
    d : int
        Dimension of ``x``.

    Returns
    -------
    Quadric
        The cone (Beck, Stoica and Li, 2008, section III).
    """
    return Quadric("cone", d + 1)


def paraboloid(d: int) -> Quadric:
    """Quadric ``|x|^2 = w`` with ``x`` of dimension `d`.

    Parameters
    ----------
    d : int
        Dimension of ``x``.

    Returns
    -------
    Quadric
        The paraboloid (Beck, Stoica and Li, 2008, section II).
    """
    return Quadric("paraboloid", d + 1)


def minimiser(B: Array, g: Array, quadric: Quadric, *, positive: bool = False) -> tuple[Array, Mask]:
    """Global minimiser of ``|By - g|^2`` on the quadric.

    Parameters
    ----------
    B : Array, shape (..., q, n)
        Whitened rows, numbers of order one; absent rows are zero.
    g : Array, shape (..., q)
        Right sides.
    quadric : Quadric
        The constraint, of size n.
    positive : bool
        Minimise over the half ``y[-1] >= 0``; matters for the cone only.

    Returns
    -------
    y : Array, shape (..., n)
        The minimiser, NaN where `ok` is False. Where ``B'B`` has rank n - 1 it may be one of two.
    ok : Mask, shape (...)
        False where the input is not finite or ``B'B`` lacks two or more ranks.

    Notes
    -----
    More (1993), theorem 3.2; Beck, Stoica and Li (2008), sections II and III.
    """
    rows, right, shape = _flat(B, g, quadric)
    y, ok = np.empty((len(rows), quadric.size)), np.empty(len(rows), dtype=np.bool_)
    with np.errstate(all="ignore"):
        for part, b, h, _ in _chunks(rows, right):
            points, ok[part] = descend(b, h, quadric.square, quadric.linear)
            y[part] = points.T
    # what does not settle is gathered over all chunks: small batches are dear
    hard = np.flatnonzero(~ok)
    if hard.size:
        points, _, valid = _solved(rows[hard], right[hard], quadric, largest)
        y[hard], ok[hard] = points[:, 0], valid[:, 0]
    if positive and quadric.shape == "cone":
        wrong = np.flatnonzero(ok & (y[:, -1] < 0.0))
        if wrong.size:
            y[wrong] = stationary(rows[wrong], right[wrong], quadric, positive=True)[0][:, 0]
    return y.reshape(*shape, quadric.size), ok.reshape(shape)


def stationary(B: Array, g: Array, quadric: Quadric, *, positive: bool = False) -> tuple[Array, Array, Mask]:
    """All real stationary points of ``|By - g|^2`` on the quadric, the cheapest first.

    Parameters
    ----------
    B : Array, shape (..., q, n)
        Whitened rows, numbers of order one; absent rows are zero.
    g : Array, shape (..., q)
        Right sides.
    quadric : Quadric
        The constraint, of size n.
    positive : bool
        Drop points with ``y[-1] < 0`` (a negative range).

    Returns
    -------
    y : Array, shape (..., K, n)
        Points, NaN where not valid; K = 2n - 1. The cone has at most 2(n - 1) with a multiplier, and its apex
        ``y = 0``, where the gradient of the constraint vanishes. The paraboloid has at most 2n - 1.
    cost : Array, shape (..., K)
        ``|By - g|^2``, ascending, infinite where not valid.
    valid : Mask, shape (..., K)
        Nothing is valid where the input is not finite or ``B'B`` lacks two or more ranks.

    Notes
    -----
    Real roots of the numerator of the secular equation, without forming it. Where ``B'B`` has rank n - 1, both
    intersections of the line of least-squares solutions with the quadric are among them.
    """
    rows, right, shape = _flat(B, g, quadric)
    y, cost, valid = _solved(rows, right, quadric, everything)
    if positive:
        valid &= y[..., -1] >= 0.0
    y[~valid], cost[~valid] = np.nan, np.inf
    order = np.argsort(cost, axis=-1, kind="stable")
    y = np.take_along_axis(y, order[..., None], axis=1)
    cost, valid = np.take_along_axis(cost, order, axis=1), np.take_along_axis(valid, order, axis=1)
    k, n = 2 * quadric.size - 1, quadric.size
    return y.reshape(*shape, k, n), cost.reshape(*shape, k), valid.reshape(*shape, k)


def _flat(B: Array, g: Array, quadric: Quadric) -> tuple[Array, Array, tuple[int, ...]]:
    """Give inputs one batch axis, and the leading axes they had."""
    B, g = np.asarray(B, dtype=np.float64), np.asarray(g, dtype=np.float64)
    if B.ndim < 2 or g.ndim < 1 or B.shape[-1] != quadric.size or B.shape[-2] != g.shape[-1]:
        raise ValueError(f"rows {B.shape} and right sides {g.shape} do not fit a quadric of size {quadric.size}")
    shape = np.broadcast_shapes(B.shape[:-2], g.shape[:-1])
    count = int(np.prod(shape))
    rows = np.broadcast_to(B, (*shape, *B.shape[-2:])).reshape(count, *B.shape[-2:])
    return rows, np.broadcast_to(g, (*shape, g.shape[-1])).reshape(count, g.shape[-1]), shape


def _chunks(rows: Array, right: Array) -> Iterator[tuple[slice, Array, Array, Mask]]:
    """Yield parts that fit the cache, the batch on the last axis; items that are not finite are zeroed and named."""
    for i in range(0, len(rows), _CHUNK):
        part = slice(i, i + _CHUNK)
        b, h = np.moveaxis(rows[part], 0, -1).copy(), right[part].T.copy()
        bad = ~(np.isfinite(b).all(axis=(0, 1)) & np.isfinite(h).all(axis=0))
        b[..., bad], h[..., bad] = 0.0, 0.0
        yield part, b, h, np.asarray(bad)


def _solved(rows: Array, right: Array, quadric: Quadric, find: Finder) -> tuple[Array, Array, Mask]:
    """Points, costs and validity of every slot by the secular equation."""
    slots = 1 if find is largest else 2 * quadric.size - 1
    count, n = len(rows), quadric.size
    y, cost = np.empty((count, slots, n)), np.empty((count, slots))
    valid, usable = np.empty((count, slots), dtype=np.bool_), np.empty(count, dtype=np.bool_)
    solve = solve_cone if quadric.shape == "cone" else solve_paraboloid
    with np.errstate(all="ignore"):
        for part, b, h, bad in _chunks(rows, right):
            points, found = solve(b, h, find)
            found &= np.isfinite(points).all(axis=0) & ~bad
            left = apply(b, points) - h[:, None]
            y[part], valid[part], cost[part] = points.transpose(2, 1, 0), found.T, (left * left).sum(axis=0).T
            usable[part] = ~bad
    roots = slots - 1 if quadric.shape == "cone" and slots > 1 else slots
    lost = np.flatnonzero(usable & ~valid[:, :roots].any(axis=1))
    if lost.size:
        points, met = intersections(rows[lost], right[lost], quadric.square, quadric.linear)
        few = min(roots, 2)
        y[lost, :few], valid[lost, :few] = points[:, :few], met[:, :few]
        left = np.einsum("Nqn,Nkn->Nkq", rows[lost], points[:, :few]) - right[lost, None]
        cost[lost, :few] = (left * left).sum(axis=-1)
    y[~valid], cost[~valid] = np.nan, np.inf
    return y, cost, valid

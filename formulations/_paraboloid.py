r"""Squared-range least squares on the paraboloid: every stationary point from one secular equation.

:math:`\min |B y - g|^2` over :math:`y = (x, w)`, :math:`|x|^2 = w`. With :math:`A = B^\top B`, :math:`b = B^\top g`
the stationary points solve :math:`(A + \lambda C) y = b + \tfrac12 \lambda e_w`. Let `(a, A_ww)` be the column of
`w`, :math:`S = A_{xx} - a a^\top / A_{ww} = V s V^\top`, :math:`\alpha = V^\top a / (2 A_{ww})`, :math:`\beta =
V^\top (b_x - a b_w / A_{ww})`. Eliminating `w` leaves :math:`x = V (u - \alpha)` with

.. math:: u_j = \frac{\beta_j + s_j \alpha_j}{\lambda + s_j}, \qquad
   |u|^2 = |\alpha|^2 + \frac{b_w}{A_{ww}} + \frac{\lambda}{2 A_{ww}} .

Sources: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), theorem 3.2; the
elimination is a direct computation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from formulations._batch import accept, across, across_many, apply, bordered, eigen, normal
from formulations.secular import Roots, Secular

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Finder = Callable[[Secular], Roots]

_FLAT = 1e-13  # eigenvalues below this share of the trace are zero
_TINY = 1e-15  # relative floor of the secular weights


def solve_paraboloid(B: Array, g: Array, find: Finder) -> tuple[Array, Mask]:
    """Stationary points on ``|x|^2 = w``.

    Parameters
    ----------
    B : Array, shape (q, n, N)
        Rows, finite.
    g : Array, shape (q, N)
        Right sides, finite.
    find : Finder
        `formulations.secular.largest` (one slot) or `everything` (K = 2n - 1 slots).

    Returns
    -------
    y : Array, shape (n, K, N)
        Points; meaningless where not found.
    found : Mask, shape (K, N)
        Slots that hold a point.

    Notes
    -----
    The direct computation of the module's first lines.
    """
    A, b = normal(B, g)
    d = A.shape[0] - 1
    trace = np.einsum("iiN->N", A[:d, :d])
    free = A[d, d] <= _TINY * trace
    corner = np.where(free, _TINY * trace, A[d, d])
    half = 0.5 * A[:d, d] / corner
    S = A[:d, :d] - 2.0 * half[:, None] * A[None, :d, d]
    s, V = eigen(S)
    # poles ascend as the eigenvalues descend
    s, V = np.maximum(s[::-1], 0.0), V[:, ::-1]
    missing = (s <= _FLAT * trace).sum(axis=0) + free
    alpha = across(V, half)
    c = across(V, b[:d] - 2.0 * half * b[d]) + s * alpha
    level, slope = (alpha * alpha).sum(axis=0) + b[d] / corner, 0.5 / corner
    floor = _TINY**2 * ((c * c).max(axis=0) + (s.max(axis=0)) ** 2 * np.abs(level)) + 1e-200
    weight = np.maximum(c * c, floor)
    roots = find(Secular(s[:, None] - s[None], -s, weight, level, slope))
    u = np.copysign(np.sqrt(weight), c)[:, None] / roots.apart
    x = apply(V, u - alpha[:, None])
    y = np.concatenate([x, (x * x).sum(axis=0)[None]])
    # polish: Newton's step of the cost in x, whose Hessian is V (D + 4 A_ww u u') V'
    slope_y = across_many(B, apply(B, y) - g[:, None])
    slope_x = slope_y[:d] + 2.0 * slope_y[d] * x
    move = bordered(roots.apart, u, -0.25 / corner, -across_many(V, slope_x), np.zeros(u.shape[1:]))
    x = accept(x, apply(V, move))
    return np.concatenate([x, (x * x).sum(axis=0)[None]]), roots.found & (missing < 2)

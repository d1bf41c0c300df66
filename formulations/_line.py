r"""A line of least-squares solutions met with a quadric.

Where `B` has rank n - 1 (or is so near that its weakest direction is noise) the minimisers of :math:`|B y - g|^2` are
the line :math:`y_0 + t v`, and :math:`y^\top C y + 2 h^\top y = 0` along it is :math:`(v^\top C v)\, t^2 + 2 (v^\top
C y_0 + h^\top v)\, t + y_0^\top C y_0 + 2 h^\top y_0 = 0`. This serves the few items whose direction `v` lies almost
on the cone: there no multiplier separates the two solutions from one at infinity.

Source: P. Stoica and J. Li, "Source localization from range-difference measurements", IEEE Signal Process. Mag. 23
(2006), where the minimal case is the quadratic in the reference range; the direction comes from the singular value
decomposition.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FLAT = 1e-7  # singular values below this share of the largest are missing ranks


def intersections(B: Array, g: Array, square: Array, linear: Array) -> tuple[Array, Mask]:
    """Both points of the solution line on the quadric.

    Parameters
    ----------
    B : Array, shape (N, q, n)
        Rows, finite.
    g : Array, shape (N, q)
        Right sides, finite.
    square, linear : Array, shape (n,)
        Diagonal of C and the vector h.

    Returns
    -------
    y : Array, shape (N, 2, n)
        Points.
    ok : Mask, shape (N, 2)
        False where the line misses the quadric or `B` lacks two ranks.

    Notes
    -----
    The stable form of the quadratic formula; a vanishing leading coefficient leaves one point.
    """
    n = B.shape[-1]
    with np.errstate(all="ignore"):
        u, s, vt = np.linalg.svd(np.concatenate([B, np.zeros((len(B), n, n))], axis=1), full_matrices=False)
        weak = vt[:, -1]
        share = np.einsum("Nqk,Nq->Nk", u[:, : B.shape[1], :-1], g) / s[:, :-1]
        base = np.einsum("Nk,Nkn->Nn", share, vt[:, :-1])
        lead = (square * weak * weak).sum(-1)
        half = (square * base * weak + linear * weak).sum(-1)
        rest = (square * base * base + 2.0 * linear * base).sum(-1)
        bent = half * half - lead * rest
        sharp = -half - np.copysign(np.sqrt(np.maximum(bent, 0.0)), half)
        t = np.stack([rest / sharp, sharp / lead], axis=1)
        y = base[:, None] + t[..., None] * weak[:, None]
        known = (bent >= 0.0) & (s[:, -2] > _FLAT * s[:, 0])
    return y, known[:, None] & np.isfinite(y).all(axis=-1)

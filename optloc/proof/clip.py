"""Parts of a box that may be left out: where residuals are too long."""

from __future__ import annotations

from math import sqrt

from optloc.kernels.jit import compiled, inlined
from optloc.proof.boxes import normal_of
from optloc.proof.linear3 import inverse
from optloc.types import Array


@inlined
def shrink(K: Array, rho: float, plane: bool, nodes: Array, rows: Array, cut: Array, solve: Array) -> None:
    """Clip a box to where the residual may be shorter than rho.

    With Y = (J'J)^-1 J' every point of the box obeys ``s = Y (residual) - Y (middle) - Y K dq``, dq the remainders
    from their middle: each coordinate is within ``rho |Y_k| + sum_j |Y_k K_j| (high_j - low_j)/2`` of that of Y middle.

    Parameters
    ----------
    K : array (q, J)
        Whitened rows.
    rho : float
        Longest residual of interest, rounding included.
    plane : bool
        Whether nothing depends on the third coordinate.
    nodes, rows : arrays
        Filled tables of the box.
    cut : array (6,)
        Lower and upper ends of the box about its centre; clipped.
    solve : array (3, 3)
        Working memory.
    """
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = normal_of(rows)
    if plane:
        a22 = a22 + 1.0
    if not inverse(a00, a01, a02, a11, a12, a22, solve):
        return
    c0 = solve[0, 0] * b0 + solve[0, 1] * b1 + solve[0, 2] * b2
    c1 = solve[1, 0] * b0 + solve[1, 1] * b1 + solve[1, 2] * b2
    c2 = solve[2, 0] * b0 + solve[2, 1] * b1 + solve[2, 2] * b2
    r0, r1 = rho * sqrt(max(solve[0, 0], 0.0)), rho * sqrt(max(solve[1, 1], 0.0))
    r2 = rho * sqrt(max(solve[2, 2], 0.0))
    for j in range(K.shape[1]):
        radius = 0.5 * (nodes[j, 5] - nodes[j, 4])
        if radius > 0.0:
            p0, p1, p2 = 0.0, 0.0, 0.0
            for i in range(K.shape[0]):
                p0 += K[i, j] * rows[i, 1]
                p1 += K[i, j] * rows[i, 2]
                p2 += K[i, j] * rows[i, 3]
            r0 += abs(solve[0, 0] * p0 + solve[0, 1] * p1 + solve[0, 2] * p2) * radius
            r1 += abs(solve[1, 0] * p0 + solve[1, 1] * p1 + solve[1, 2] * p2) * radius
            r2 += abs(solve[2, 0] * p0 + solve[2, 1] * p1 + solve[2, 2] * p2) * radius
    clip(cut, 0, -c0, r0)
    clip(cut, 1, -c1, r1)
    if not plane:
        clip(cut, 2, -c2, r2)


@inlined
def uncut(half: Array, cut: Array) -> None:
    """Write the ends of a whole box."""
    for k in range(3):
        cut[k], cut[3 + k] = -half[k], half[k]


@compiled
def clip(cut: Array, k: int, centre: float, reach: float) -> None:
    """Clip coordinate k of a box to ``|s - centre| <= reach``, with some slack for rounding."""
    reach += 1e-9 * (abs(centre) + reach)
    cut[k], cut[3 + k] = max(cut[k], centre - reach), min(cut[3 + k], centre + reach)


@inlined
def cut_out(cut: Array, at: Array, half: Array) -> float:
    """Replace a box by its part between the ends of a cut; return the share of its volume that this is."""
    share = 1.0
    for k in range(3):
        low, high, old = cut[k], cut[3 + k], half[k]
        if low > high:
            return 0.0
        if low > -old or high < old:
            middle = at[k] + 0.5 * (low + high)
            half[k] = min(0.5 * (high - low) * (1.0 + 1e-12) + 1e-15 * (abs(at[k]) + old), old)
            at[k] = middle
            share *= half[k] / old
    return share


@compiled
def is_empty(cut: Array) -> bool:
    """Return whether nothing is left of a box."""
    return bool(cut[0] > cut[3] or cut[1] > cut[4] or cut[2] > cut[5])

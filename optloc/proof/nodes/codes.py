"""The scalar functions ("nodes") that residuals are sums of: codes, data, and ranges and linear forms over a box.

Residuals are ``K phi(x) - w``, whitened, with one node phi_j a column. A node is a code and a row of numbers:

======== ============ =====================================================================================
code     node         numbers
======== ============ =====================================================================================
RANGE    ``|x - a|``  0:3 station a
LINEAR   ``n.(x-o)``  0:3 origin o, 3:6 coefficients n
AZIMUTH  angle        0:3 station, 6:15 its axes (rows), 15 measured angle m: the node is the azimuth minus m, wrapped
ELEVATION angle       0:3 station, 6:15 its axes (rows)
RATIO    ``r_a/r_b``  0:3 station a, 3:6 station b
HEIGHT   height       0:3 point o of the frame, 3:6 its ECEF position, 6:15 rows of the rotation from frame to ECEF
======== ============ =====================================================================================

All vectors here have three numbers. In the plane the third of a point, of a line and of every axis is 0, `sense` has a
column and a row of zeros, and the third half-width is 0: nothing depends on the third search coordinate then.

Over a box (centre c, half-widths h in search coordinates s, x = c + T s) a node is bounded by two functions of

    line (3,)      c minus the point 0:3 (in the inverse-range chart the scaled line p - varpi a)
    sense (3, 3)   derivative of the line with respect to s (T near; [e_j, e_k, -a] far)
    half (3,)      half-widths h

(RATIO has ``line_b, sense_b`` of its second station after ``line, sense``):

``bound_<node>(data, line, sense, half, slope) -> (value, low, high)``
    value at the centre; writes its gradient with respect to s into slope (3,); low and high enclose the remainder
    ``phi(s) - value - slope.s`` for all |s_k| <= half_k. What cannot be bounded sharply has slope 0 and a wide
    interval.
``curve_<node>(data, line, sense, half, curvature, turn) -> chi``
    writes the Hessian with respect to s at the centre into curvature (3, 3), a bound of the change of each component of
    the gradient over the box into turn (3,), and returns a bound of the spectral norm of the change of the Hessian;
    infinite turn or chi where there is none. Over t times the box, 0 < t < 1, these bounds and those of the remainder
    are at most t times as large wherever chi is finite.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from optloc.base.types import Array

RANGE, LINEAR, AZIMUTH, ELEVATION, RATIO, HEIGHT = range(6)
WIDTH = 17
"""How many numbers a node has at most."""


def width(kinds: Iterable[int]) -> int:
    """Return how many numbers are kept of each node of a problem: a million problems of ranges need no more."""
    return max((3 if kind == RANGE else 6 if kind == LINEAR else WIDTH for kind in kinds), default=3)


# Nodes that share no row with others: their part of the cost is a function of one number, which may be folded.

# Numbers of a node: its measured value, and what is not 0 where it is alone.
MEASURED, ALONE = 15, 16
# Cosine below which two columns of whitened rows count as orthogonal.
_ORTHOGONAL = 1e-9


def with_alone(kinds: Array, data: Array, K: Array, w: Array) -> Array:
    """Return the numbers of the nodes with a mark on azimuths and ratios whose rows are their own.

    The cost of an azimuth alone is even in it, so where it jumps from pi to -pi its absolute value does as well; that
    of a ratio alone grows beyond the measured value, so a ratio without an upper end may be cut there.

    Parameters
    ----------
    kinds : int array (J,)
        Codes of the nodes.
    data : array (B, J, width)
        Their numbers; B is N, or 1 where all share.
    K : array (B, q, J)
        Whitened rows.
    w : array (N, q)
        Whitened measurements.

    Returns
    -------
    array (B or N, J, width)
        N where there are ratios, whose measured values are written too.
    """
    angles, ratios = kinds == AZIMUTH, kinds == RATIO
    if not (angles | ratios).any():
        return data
    information = np.swapaxes(K, -1, -2) @ K
    size = np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    others = np.abs(information - size[..., None] ** 2 * np.eye(len(kinds))).max(-1)
    alone = others <= _ORTHOGONAL * size * size.max(-1, keepdims=True)
    force = (np.swapaxes(K, -1, -2) @ w[..., None])[..., 0]
    centred = (np.abs(force) <= _ORTHOGONAL * size * np.linalg.norm(w, axis=-1, keepdims=True)).all(0)
    out = np.array(np.broadcast_to(data, (len(w), *data.shape[1:])) if ratios.any() else data)
    out[:, angles, ALONE] = (alone & centred)[:, angles]
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = np.where(size > 0.0, force / size**2, 0.0)
    out[:, ratios, MEASURED] = measured[:, ratios]
    out[:, ratios, ALONE] = alone[:, ratios]
    return out

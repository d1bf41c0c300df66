"""Nodes that share no row with others: their part of the cost is a function of one number, which may be folded."""

from __future__ import annotations

import numpy as np

from optloc.proof.nodes import AZIMUTH, RATIO
from optloc.types import Array

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

"""Normal points: averages of rows of the same instruments that are adjacent in time, for programs of limited size.

Source: A. T. Sinclair, "Data screening and normal point formation" (1997), for satellite laser ranging.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array, Index

_BEND = 2  # degree of the polynomial of a normal point: within a block, rates of a satellite pass are nearly parabolas


def blocks(time: ArrayLike, length: int) -> list[Index]:
    """Return rows, sorted by time, in blocks of nearly equal size.

    Parameters
    ----------
    time : array_like, shape (m,)
        Time of each row.
    length : int
        Greatest number of rows of a block, at least one.

    Returns
    -------
    list of int arrays
        The rows of each block.
    """
    order = np.argsort(np.asarray(time, dtype=np.float64), kind="stable")
    return np.array_split(order, -(-len(order) // length)) if len(order) else []


def normal_points(time: ArrayLike, z: ArrayLike, sigma: ArrayLike, cut: Sequence[Index]) -> tuple[Index, Array, Array]:
    """Return averages of rows of the same instruments that are adjacent in time.

    The average of a block is the value of a least-squares parabola at the time of its middle row. With too few
    different times, it is the value of a line or a mean.

    Parameters
    ----------
    time, z, sigma : array_like, shape (m,)
        Times, values, and standard deviations of independent errors.
    cut : sequence of q int arrays
        The rows of each block, see `blocks`.

    Returns
    -------
    row : int array, shape (q,)
        The middle row of each block.
    z, sigma : Array, shape (q,)
        Averages and their standard deviations.

    Notes
    -----
    The normal points of satellite laser ranging: A. T. Sinclair, "Data screening and normal point formation" (1997).
    """
    t, values, spread = (np.asarray(part, dtype=np.float64) for part in (time, z, sigma))
    row = np.array([block[len(block) // 2] for block in cut], dtype=np.int64)
    out, error = np.zeros(len(row)), np.zeros(len(row))
    for k, (block, middle) in enumerate(zip(cut, row, strict=True)):
        since = t[block] - t[middle]
        # two rows more than coefficients, since a polynomial through all rows does not average
        degree = min(_BEND, len(np.unique(since)) - 1, max(len(block) - 3, 0))
        power = (since / (np.abs(since).max() or 1.0))[:, None] ** np.arange(degree + 1)
        left = np.linalg.pinv(power / spread[block, None])[0] / spread[block]
        out[k], error[k] = left @ values[block], np.sqrt(((left * spread[block]) ** 2).sum())
    return row, out, error

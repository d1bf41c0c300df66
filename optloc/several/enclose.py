"""How far measurements can be from their values at the centre of a box of positions."""

from __future__ import annotations

import numpy as np

from optloc.evaluate import differentiate
from optloc.problem import Problem
from optloc.types import Array, Rows

KINDS = ("tdoa", "azimuth", "elevation", "range", "range_sum")
"""Kinds whose curvature is bounded here."""

# Metres by which a combination of ranges changes at most when the target moves by one metre.
_STEEPEST = {"range": 1.0, "tdoa": 2.0, "range_sum": 2.0}


def around(scan: Problem, centre: Array, radius: Array) -> tuple[Array, Array, Array]:
    """Return values, derivatives and remainders of the rows of a scan in balls.

    Within the ball |h(x) - h - J (x - centre)| <= remainder: half the squared radius times a bound of the second
    derivatives there, which are 1/r for a range, 1/r_h^2 for an azimuth and 1/(r r_h) for an elevation, with r_h the
    distance from the station's vertical.

    Parameters
    ----------
    scan : Problem
        Kinds of `KINDS`; the position is all that is unknown.
    centre : array (q, d)
        Centres, metres.
    radius : array (q,)
        Radii, metres.

    Returns
    -------
    value : array (q, m)
        h at the centres.
    slope : array (q, m, d)
        J; not finite at a station.
    remainder : array (q, m)
        Infinite where the ball holds a station.
    """
    with np.errstate(all="ignore"):
        residual, slope = differentiate(scan.with_rows(z=np.zeros(scan.count)), centre)
        value, steep = -residual, np.sqrt((slope**2).sum(-1))
        parts = []
        for block, start in zip(scan.rows, scan.starts, strict=True):
            part = slice(start, start + block.count)
            parts.append(_curvature(scan, block.kind, block.a, block.b, centre, radius, value[:, part], steep[:, part]))
        bend = np.concatenate(parts, axis=-1)
        remainder = 0.5 * bend * radius[:, None] ** 2
    return value, slope, np.where(np.isnan(remainder), np.inf, remainder)


def changes(scan: Problem, slope: Array, remainder: Array, half: Array) -> Array:
    """Return how far the rows can be from their values at the centres of boxes, (q, m).

    Parameters
    ----------
    scan : Problem
        Of `around`.
    slope, remainder : array (q, m, d) and (q, m)
        From `around`, for the balls about the boxes.
    half : array (q, d)
        Half-widths of the boxes.
    """
    radius = np.sqrt((half**2).sum(-1))
    most = np.concatenate([_most(block, radius) for block in scan.rows], axis=-1)
    with np.errstate(invalid="ignore"):
        first = (np.abs(slope) * half[:, None, :]).sum(-1) + remainder
    return np.asarray(np.where(first < most, first, most))


def _most(block: Rows, radius: Array) -> Array:
    """Return how far the rows of one block can be from their values at the centres of balls in any case, (q, m)."""
    limit = _STEEPEST[block.kind] * radius if block.kind in _STEEPEST else np.full(len(radius), np.pi)
    return np.repeat(limit[:, None], block.count, axis=-1)


def _curvature(
    scan: Problem, kind: str, a: Array, b: Array, centre: Array, radius: Array, value: Array, steep: Array
) -> Array:
    """Return a bound (q, m) of the second derivatives of one block within balls."""
    station = scan.stations.position[0]

    def near(distance: Array) -> Array:
        return np.asarray(np.maximum(distance - radius[:, None], 0.0))

    def distance(index: Array) -> Array:
        return np.asarray(np.sqrt(((centre[:, None, :] - station[index]) ** 2).sum(-1)))

    if kind == "azimuth":
        return np.asarray(1.0 / near(1.0 / steep) ** 2)
    if kind == "elevation":
        return np.asarray(1.0 / (near(1.0 / steep) * near(np.cos(value) / steep)))
    bend = 1.0 / near(distance(a))
    return np.asarray(bend if kind == "range" else bend + 1.0 / near(distance(b)))

"""Offsets of stations that many fixes share, from what the rest of each fix says of every station, robustly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from optloc.quality.elements import Elements
from optloc.quality.redundancy import Tested
from optloc.types import Array

_HUBER = 1.345
_MAD = 0.6744897501960817
_STEPS = 60
_FEW = 10


@dataclass(frozen=True, slots=True)
class Offsets:
    """Offsets of G groups, and how much each grows with the length of the path.

    Parameters
    ----------
    value, error : array (G,)
        Offset and its standard error, SI units; NaN of groups without rows.
    slope, slope_error : array (G,)
        Growth in metres a metre and its standard error; NaN where it is not seen.
    open : array (r, G)
        Combinations of offsets that the data do not show, unit vectors: the offsets have none of them.
    """

    value: Array
    error: Array
    slope: Array
    slope_error: Array
    open: Array


def offsets_of(made: Elements, tests: Tested) -> Offsets:
    """Return the offsets that many problems share.

    The test of group g in one problem is w_g = (t_g - sum_h T_gh b_h) / sqrt(T_gg), standard normal at the true offsets
    b of all groups: its residual against what the others say, their offsets taken out. The b minimise the sum of
    Huber's function of all w, which is convex, by weighted least squares. Combinations that no w sees, such as a
    common delay where emission times are unknown, are zero on average over the rows. Standard errors are those of the
    sandwich form with the problems as clusters, or
    those of normal tests where these are larger.

    Parameters
    ----------
    made : Elements
        N linearised problems.
    tests : Tested
        Their tests.

    References
    ----------
    P. J. Huber, "Robust Statistics" (1981), sections 7.3 to 7.6.
    """
    count, q = len(made.names), tests.errors
    matrix, vector = tests.matrix[:, q:, q:], tests.vector[:, q:]
    size = np.diagonal(matrix, axis1=-2, axis2=-1)
    item, own = np.nonzero((size > 0.0) & (made.of_offset >= 0))
    scale = np.sqrt(size[item, own])
    y = vector[item, own] / scale
    other = made.of_offset[item]
    design = _sparse(matrix[item, own] / scale[:, None], other, count)
    group = made.of_offset[item, own]
    number = np.bincount(group, minlength=count).astype(float)
    value, error, lost = _regressed(design, y, item, number)
    away, spread = _centred(made, group, item, own, count)
    steep = np.isfinite(spread) & (spread > 0.0) & (number >= _FEW)
    slope, slope_error = np.full(count, np.nan), np.full(count, np.nan)
    if steep.any():
        units = np.where(steep, spread, 1.0)
        grown = matrix[item, own] / scale[:, None] * np.nan_to_num(away[item] / np.append(units, 1.0)[other])
        more = sparse.hstack([design, _sparse(grown, other, count)]).tocsr()
        both, errors, _ = _regressed(more, y, item, np.tile(number, 2))
        slope, slope_error = (np.where(steep, v[count:] / units, np.nan) for v in (both, errors))
    seen = number > 0.0
    return Offsets(np.where(seen, value, np.nan), np.where(seen, error, np.nan), slope, slope_error, lost)


def _sparse(values: Array, column: Array, count: int) -> sparse.csr_array:
    """Return rows with values (n, c) at columns (n, c), -1 for none, as a sparse matrix (n, count)."""
    kept = (column >= 0) & (values != 0.0)
    row = np.broadcast_to(np.arange(len(column))[:, None], column.shape)
    return sparse.csr_array((values[kept], (row[kept], column[kept])), shape=(len(column), count))


def _centred(made: Elements, group: Array, item: Array, own: Array, count: int) -> tuple[Array, Array]:
    """Return the paths (N, c) less their mean over each group, and the standard deviation (G,) of each."""
    path = made.path[item, own]
    number = np.maximum(np.bincount(group, minlength=count), 1)
    mean = np.bincount(group, path, count) / number
    spread = np.sqrt(np.bincount(group, (path - mean[group]) ** 2, count) / number)
    return made.path - np.append(mean, 0.0)[made.of_offset], spread


def _regressed(design: sparse.csr_array, y: Array, item: Array, number: Array) -> tuple[Array, Array, Array]:
    """Return coefficients (p,) of Huber's regression, standard errors, and the combinations (r, p) not seen."""
    value = np.zeros(design.shape[1])
    for _ in range(_STEPS):
        off = y - design @ value
        bound = _HUBER * max(float(np.median(np.abs(off))) / _MAD, 1e-12)
        weight = bound / np.maximum(np.abs(off), bound)
        inverse, lost = _pseudo_inverse((design.T @ (design * weight[:, None])), number)
        move = inverse @ (design.T @ (weight * off))
        value = value + move
        if np.abs(move / np.sqrt(np.maximum(np.diagonal(inverse), 1e-300))).max() < 1e-4:
            break
    off = y - design @ value
    inside = (np.abs(off) <= bound).astype(float)
    bread, lost = _pseudo_inverse(design.T @ (design * inside[:, None]), number)
    pull = design * np.clip(off, -bound, bound)[:, None]
    each = sparse.csr_array((np.ones(len(item)), (item, np.arange(len(item))))) @ pull
    covariance = bread @ (each.T @ each).toarray() @ bread
    stated = (bound / _HUBER) ** 2 * np.diagonal(bread)
    error = np.sqrt(np.maximum(np.diagonal(covariance), stated))
    return value, np.where(np.diagonal(bread) > 0.0, error, np.nan), lost


def _pseudo_inverse(matrix: sparse.csr_array, number: Array) -> tuple[Array, Array]:
    """Return the inverse along what the data see, least in the mean square over rows, and what they do not see."""
    weigh = 1.0 / np.sqrt(np.maximum(number, 1.0))
    scaled = matrix.toarray() * weigh[:, None] * weigh
    values, vectors = np.linalg.eigh(scaled)
    seen = values > 1e-9 * max(float(values[-1]), 1e-300)
    half = weigh[:, None] * vectors
    return (half[:, seen] / values[seen]) @ half[:, seen].T, _apart(vectors[:, ~seen], weigh, number > 0.0)


def _apart(basis: Array, weigh: Array, used: Array) -> Array:
    """Return unit vectors (r, p) that span what is not seen (p, r), as many as can be each of a group of its own."""
    projector = basis @ basis.T * np.outer(used, used)
    count, label = connected_components(np.abs(projector) > 1e-6, directed=False)
    found = []
    for part in range(count):
        inside = np.where(label == part, projector, 0.0) * (label == part)[:, None]
        values, vectors = np.linalg.eigh(inside)
        found += [weigh * vector for vector in vectors[:, values > 0.5].T]
    return np.array([vector / np.linalg.norm(vector) for vector in found]).reshape(-1, len(weigh))

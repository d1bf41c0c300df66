"""Which group of errors each row belongs to, and its noise as independent errors of such groups."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from optloc.errors import InvalidProblem, nearest
from optloc.models import MODELS
from optloc.noise import Block
from optloc.problem import Problem
from optloc.types import Array

By = Literal["station", "pair", "kind"]
GROUPINGS = ("station", "pair", "kind")

_FITS = 1e-6


@dataclass(frozen=True, slots=True)
class Ends:
    """The groups that each row belongs to: one, or one at either of its stations.

    Parameters
    ----------
    name : object array (m, 2)
        Names of the groups; empty where there is none.
    sign : array (m, 2)
        Sign with which an offset of the group enters the row; 0 where there is none.
    """

    name: Array
    sign: Array


def ends_of(problem: Problem, by: By) -> Ends:
    """Return the groups of the rows of a problem.

    Parameters
    ----------
    problem : Problem
        Rows and names of stations.
    by : "station", "pair" or "kind"
        A group is a station (with a kind where stations measure several), a pair of stations, or a kind of rows.

    Raises
    ------
    InvalidProblem
        For an unknown grouping.
    """
    if by not in GROUPINGS:
        raise InvalidProblem(f"unknown grouping {by!r}", "by", nearest(str(by), GROUPINGS))
    parts = [_ends(problem, rows.kind, rows.a, rows.b, by) for rows in problem.rows]
    return Ends(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _ends(problem: Problem, kind: str, a: Array, b: Array, by: By) -> tuple[Array, Array]:
    name, sign = np.full((len(a), 2), "", dtype=object), np.zeros((len(a), 2))
    model = MODELS[kind]
    if by == "kind" or model.stations == 0:
        name[:, 0], sign[:, 0] = kind, 1.0
    elif by == "pair" and model.stations == 2:
        turned = (a > b) if _both_ways(a, b) else np.zeros(len(a), dtype=bool)
        one, two = np.where(turned, b, a), np.where(turned, a, b)
        labels = np.array(problem.stations.names, dtype=object)
        name[:, 0] = labels[one] + "-" + labels[two] + _suffix(problem, kind)
        sign[:, 0] = np.where(turned & (sum(model.ranges or (1, -1)) == 0), -1.0, 1.0)
    else:
        labels = station_names(problem, kind)
        for end, (station, own) in enumerate(zip((a, b), model.ranges or (1, -1), strict=True)):
            if end < model.stations and own:
                name[:, end], sign[:, end] = labels[station], own
    return name, sign


def _both_ways(a: Array, b: Array) -> bool:
    """Return whether some pair of stations occurs in either order."""
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    return any((two, one) in pairs for one, two in pairs)


def station_names(problem: Problem, kind: str) -> Array:
    """Return the name (s,) of the group that each station makes with a kind."""
    return np.array(problem.stations.names, dtype=object) + _suffix(problem, kind)


def _suffix(problem: Problem, kind: str) -> str:
    several = sum(MODELS[rows.kind].stations > 0 for rows in problem.rows) > 1
    return f" {kind}" if several else ""


def kinds_of(problem: Problem) -> Array:
    """Return the kind of every row, object array (m,)."""
    return np.concatenate([np.full(rows.count, rows.kind, dtype=object) for rows in problem.rows])


def split(problem: Problem, block: Block, by: By, present: Array) -> tuple[Array, Array, Array]:
    """Return the noise of a block as independent errors of unit variance, each of one group.

    Independent rows are errors of their own; one that belongs to two stations is half of each. Rows that combine
    arrivals, R = D diag(v) D', are made of the arrivals at their stations, and of errors of the single rows if R has a
    multiple of the unit matrix besides. Other correlated rows are one group.

    Parameters
    ----------
    problem : Problem
        Batch (...).
    block : Block
        One of its blocks, g groups of r rows.
    by : "station", "pair" or "kind"
        As in `ends_of`.
    present : bool array (..., m)
        Rows that count.

    Returns
    -------
    effect : array (..., g, r, q)
        ``effect @ effect'`` is the covariance of the rows that are present; in the rows' units.
    name : object array (g, q)
        Group of each error.
    sigma : array (..., g, q)
        Its stated standard deviation, in the rows' units.
    """
    _g, r = block.row.shape
    if r == 1:
        name = ends_of(problem, by).name[block.row[:, 0]]
        share = np.where(name == "", 0.0, np.where((name != "").all(1)[:, None], np.sqrt(0.5), 1.0))
        effect = np.sqrt(block.covariance) * share[:, None]
        return effect, name, effect[..., 0, :]
    here = present[..., block.row]
    covariance = np.where(here[..., :, None] & here[..., None, :], block.covariance, 0.0)
    kinds = kinds_of(problem)[block.row]
    same = (kinds == kinds[:, :1]).all() and (kinds == kinds[0, 0]).all()
    if same and MODELS[kinds[0, 0]].ranges is not None and by != "pair":
        found = _arrivals(problem, block.row, covariance, here, by)
        if found is not None:
            return found
    whole = np.array([" + ".join(dict.fromkeys(row)) for row in kinds], dtype=object)
    values, vectors = np.linalg.eigh(covariance)
    mean = values.sum(-1, keepdims=True) / np.maximum(here.sum(-1, keepdims=True), 1)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return root, np.repeat(whole[:, None], r, axis=1), np.broadcast_to(np.sqrt(mean), values.shape)


def _arrivals(
    problem: Problem, row: Array, covariance: Array, here: Array, by: By
) -> tuple[Array, Array, Array] | None:
    """Return the noise of groups of rows (g, r) as arrivals, with errors of the rows if need be; None if it is not."""
    ends = ends_of(problem, "station")
    kind = str(kinds_of(problem)[row[0, 0]])
    labels = station_names(problem, kind)
    design = ((ends.name[row][..., None] == labels) * ends.sign[row][..., None]).sum(-2) * here[..., None]
    own = np.eye(row.shape[1]) * here[..., None]
    groups = labels if by == "station" else np.full(len(labels), kind, dtype=object)
    for parts, names in (
        ([design], groups),
        ([design, own], np.concatenate([groups, np.full(row.shape[1], f"{kind} rows", dtype=object)])),
    ):
        variance = _variances(parts, covariance)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        effect = np.concatenate(parts, axis=-1) * sigma[..., None, :]
        made = effect @ np.swapaxes(effect, -1, -2)
        size = np.abs(covariance).max()
        if np.allclose(made, covariance, rtol=0.0, atol=_FITS * size):
            return effect, np.broadcast_to(names, (len(row), len(names))), sigma
    return None


def _variances(parts: list[Array], covariance: Array) -> Array:
    """Return variances (..., q) of errors whose covariance is nearest to a given one; rows' own errors share theirs.

    With the columns d of the parts, sum v_i d_i d_i' = R in least squares: the normal matrix is (d_i' d_j)^2.
    """
    design = np.concatenate(parts, axis=-1)
    gram = (np.swapaxes(design, -1, -2) @ design) ** 2
    right = np.einsum("...rq,...rp,...pq->...q", design, covariance, design)
    widths = [parts[0].shape[-1], *(1 for _ in parts[1:])]
    merge = np.zeros((design.shape[-1], sum(widths)))
    merge[np.arange(widths[0]), np.arange(widths[0])] = 1.0
    merge[widths[0] :, widths[0] :] = 1.0
    found = np.linalg.pinv(merge.T @ gram @ merge, rcond=1e-10, hermitian=True) @ (right @ merge)[..., None]
    return np.asarray((merge @ found)[..., 0])

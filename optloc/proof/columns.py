"""From rows of measurements to nodes: which scalar functions the rows are sums of, and their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from optloc.models import MODELS
from optloc.problem import Problem
from optloc.proof.nodes import AZIMUTH, ELEVATION, HEIGHT, LINEAR, RANGE, RATIO, width
from optloc.types import Array, Rows

_CODES = {"azimuth": AZIMUTH, "elevation": ELEVATION, "groa": RATIO, "height": HEIGHT}


@dataclass(slots=True)
class Columns:
    """The nodes of a flat batch of problems as they are collected, and the design of the rows over them.

    Parameters
    ----------
    problem : Problem
        Whose rows they are.
    kinds : list of int
        Codes of the nodes.
    data : list of array (B, n)
        Their numbers, B = 1 where all problems share them.
    row, column, coefficient : list
        Sparse design: row of the problem, node, factor.
    station, epoch : list of int
        Of each node that is a range; -1 for the others.
    """

    problem: Problem
    kinds: list[int] = field(default_factory=list)
    data: list[Array] = field(default_factory=list)
    row: list[int] = field(default_factory=list)
    column: list[int] = field(default_factory=list)
    coefficient: list[float] = field(default_factory=list)
    station: list[int] = field(default_factory=list)
    epoch: list[int] = field(default_factory=list)

    def add(self, kind: int, data: Array, station: int = -1, epoch: int = -1) -> int:
        """Add a node and return its number."""
        self.kinds.append(kind)
        self.data.append(data)
        self.station.append(station)
        self.epoch.append(epoch)
        return len(self.kinds) - 1

    def touch(self, row: int, column: int, coefficient: float) -> None:
        """Let a row of the problem contain a node."""
        self.row.append(row)
        self.column.append(column)
        self.coefficient.append(coefficient)

    @property
    def design(self) -> Array:
        """Return the matrix (m, J) of the rows over the nodes."""
        out = np.zeros((self.problem.count, len(self.kinds)))
        np.add.at(out, (self.row, self.column), self.coefficient)
        return out

    @property
    def numbers(self) -> Array:
        """Return the numbers (B, J, width) of all nodes."""
        return stacked(self.kinds, self.data)


def stacked(kinds: Sequence[int] | Array, data: Sequence[Array]) -> Array:
    """Return the numbers (B, J, width) of nodes that have (B, n) or (1, n) each."""
    out = np.zeros((max((len(part) for part in data), default=1), len(data), width(kinds)))
    for j, part in enumerate(data):
        out[:, j, : part.shape[1]] = part
    return out


def columns_of(problem: Problem, observed: Array) -> Columns:
    """Return the nodes that the rows of a flat batch of problems are sums of.

    Parameters
    ----------
    problem : Problem
        N problems within the scope of the proof.
    observed : array (N, m)
        Measurements less everything that is known to be added to them; azimuths are counted from them.
    """
    made, ranges = Columns(problem), {}
    moving = problem.stations.position.shape[-3] > 1
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        signs = MODELS[rows.kind].ranges
        for i in range(rows.count):
            epoch = int(rows.epoch[i]) if moving else 0
            if signs is None:
                own = observed[:, start + i] if rows.kind == "azimuth" else None
                made.touch(start + i, _own(made, rows, i, own), 1.0)
                continue
            for sign, station in zip(signs, (int(rows.a[i]), int(rows.b[i])), strict=True):
                if not sign:
                    continue
                if (station, epoch) not in ranges:
                    place = _numbers({0: _at(problem, station, epoch)})
                    ranges[station, epoch] = made.add(RANGE, place, station, epoch)
                made.touch(start + i, ranges[station, epoch], float(sign))
    return made


def _own(made: Columns, rows: Rows, i: int, measured: Array | None) -> int:
    """Add the node that is the measured quantity of one row itself, and return its number."""
    problem, kind = made.problem, _CODES[rows.kind]
    if kind == HEIGHT:
        return made.add(HEIGHT, height_numbers(problem))
    a, epoch = int(rows.a[i]), int(rows.epoch[i])
    parts = {0: _at(problem, a, epoch)}
    if kind == RATIO:
        parts[3] = _at(problem, int(rows.b[i]), epoch)
    else:
        parts[6] = _axes(problem, a, epoch)
    if measured is not None:
        parts[15] = measured[:, None]
    return made.add(kind, _numbers(parts))


def height_numbers(problem: Problem) -> Array:
    """Return the numbers (1, n) of the node that is the geodetic height of a position in the problem's frame."""
    frame = problem.frame
    return _numbers({3: frame.origin_ecef()[None], 6: frame.rotation_to_ecef().reshape(1, 9)})


def linear_numbers(coefficients: Array, origin: Array | None = None) -> Array:
    """Return the numbers (B, n) of a linear node with coefficients (B, d), zero at an origin (B, d)."""
    parts = {3: coefficients}
    return _numbers(parts if origin is None else parts | {0: origin})


def _numbers(parts: dict[int, Array]) -> Array:
    last = max(start + part.shape[1] for start, part in parts.items())
    out = np.zeros((max(len(part) for part in parts.values()), last))
    for start, part in parts.items():
        out[:, start : start + part.shape[1]] = part
    return out


def _at(problem: Problem, station: int, epoch: int) -> Array:
    """Return the position (B, d) of a station at an epoch."""
    position = problem.stations.position
    picked = position[..., epoch if position.shape[-3] > 1 else 0, station, :]
    return picked if picked.ndim == 2 else picked[None]


def _axes(problem: Problem, station: int, epoch: int) -> Array:
    """Return the axes (B, 9) of a station at an epoch, rows of three."""
    axes, d = problem.stations.axes, problem.dimension
    if axes is None:
        return np.eye(3).reshape(1, 9)
    picked = axes[..., epoch if axes.shape[-4] > 1 else 0, station, :, :]
    picked = picked if picked.ndim == 3 else picked[None]
    out = np.zeros((len(picked), 3, 3))
    out[:, :d, :d] = picked
    return out.reshape(len(picked), 9)


def linear_nodes(made: Columns, rows: Array, origin: Array | None = None) -> list[int]:
    """Add linear nodes of coefficients (B, q, d), zero at an origin (B, d), and return their numbers."""
    return [made.add(LINEAR, linear_numbers(rows[:, i], origin)) for i in range(rows.shape[1])]

"""From a batch of problems to the costs ``f(x) = |K phi(x) - w|^2`` of the position, which proofs bound.

Each row of measurements is a sum of nodes phi: scalar functions of the position, such as ranges. Other unknowns, such
as clock offsets, are projected out or added to the covariance. Letters: N problems (B is N, or 1 if all share), m rows,
q whitened rows, J nodes, d coordinates, n unknowns; `width` numbers define a node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from optloc.base.linalg import project_out
from optloc.base.types import Array
from optloc.linear.evaluate import block_links, columns
from optloc.linear.normal import prior_parts, with_station_noise
from optloc.models import MODELS, Model
from optloc.problem.forms import form_of
from optloc.problem.noise import variances, whiten, whiten_rows
from optloc.problem.problem import Problem
from optloc.proof.nodes.dispatch import NODES, code_of, named, width
from optloc.proof.nodes.level import linear_numbers
from optloc.proof.nodes.node import LINEAR, RATE, Node, NodeRow
from optloc.proof.nodes.rate import RATE_WIDTH, STATION, VELOCITY

# Cosine below which two columns of whitened rows count as orthogonal: whitening loses some digits of a double.
_ORTHOGONAL = 1e-9
# Share of the length of a column below which an entry of its triangle is rounding: tens of units in the last place.
# The backward error of reflections is relative to columns (Higham 2002, theorem 19.4).
_DEPENDENT = 1e-14


@dataclass(slots=True)
class CostColumns:
    """The collected nodes of a flat batch of B or N problems, and the sparse design of the rows over them.

    Parameters
    ----------
    problem : Problem
        The problem with the rows.
    kinds : list of int
        Codes of the nodes.
    data : list of array (B, n)
        Numbers of the nodes; B = 1 if all problems share them.
    row, column, coefficient : list
        Sparse design: row of the problem, node, factor.
    station, epoch : list of int
        Station and epoch of each node that depends on one station only; -1 for other nodes.
    shared : dict
        Nodes that rows share, by code, station and epoch: ranges and range rates.
    """

    problem: Problem
    kinds: list[int] = field(default_factory=list)
    data: list[Array] = field(default_factory=list)
    row: list[int] = field(default_factory=list)
    column: list[int] = field(default_factory=list)
    coefficient: list[float] = field(default_factory=list)
    station: list[int] = field(default_factory=list)
    epoch: list[int] = field(default_factory=list)
    shared: dict[tuple[int, int, int], int] = field(default_factory=dict)

    def add(self, kind: int, data: Array, station: int = -1, epoch: int = -1) -> int:
        """Add a node with numbers `data` (B, n) and return its index.

        `station` and `epoch` are as in the fields of these names.
        """
        self.kinds.append(kind)
        self.data.append(data)
        self.station.append(station)
        self.epoch.append(epoch)
        return len(self.kinds) - 1

    def add_to_row(self, row: int, column: int, coefficient: float) -> None:
        """Add ``coefficient * node`` to a row of the problem; `column` is the index of the node."""
        self.row.append(row)
        self.column.append(column)
        self.coefficient.append(coefficient)

    def split(self, group: Array) -> tuple[CostColumns, Array]:
        """Return a copy in which only rows of one group share nodes, and the group of each node (J,).

        `group` (m,) has the group of each row.
        """
        out, new = CostColumns(self.problem), dict[tuple[int, int], int]()
        for row, column, coefficient in zip(self.row, self.column, self.coefficient, strict=True):
            key = (column, int(group[row]))
            if key not in new:
                new[key] = out.add(self.kinds[column], self.data[column], self.station[column], self.epoch[column])
            out.add_to_row(row, new[key], coefficient)
        return out, np.array([number for _, number in new])

    def with_velocity(self) -> Array:
        """Add the components of lines of sight that multiply the target's velocity; return the group of each node (J,).

        The range rate of a moving target is the range rate of a target at rest plus ``u.v``, u the unit vector from
        the station. The group is the axis of the velocity, or -1 for nodes without it.
        """
        group, new = [-1] * len(self.kinds), dict[tuple[int, int], int]()
        for row, column, coefficient in list(zip(self.row, self.column, self.coefficient, strict=True)):
            if self.kinds[column] != RATE:
                continue
            for k in range(self.problem.dimension):
                if (column, k) not in new:
                    new[column, k] = self.add(RATE, _along_axis(self.data[column], k))
                    group.append(k)
                self.add_to_row(row, new[column, k], coefficient)
        return np.array(group)

    @property
    def design(self) -> Array:
        """Return the matrix (m, J) of the rows over the nodes."""
        out = np.zeros((self.problem.count, len(self.kinds)))
        np.add.at(out, (self.row, self.column), self.coefficient)
        return out

    @property
    def numbers(self) -> Array:
        """Return the numbers (B, J, width) of all nodes."""
        return stack_numbers(self.kinds, self.data)


def _along_axis(rate: Array, k: int) -> Array:
    """Return the numbers (B, n) of one component of the unit vector from a station, from the numbers of a rate."""
    out = np.zeros((len(rate), RATE_WIDTH))
    out[:, STATION:VELOCITY] = rate[:, STATION:VELOCITY]
    out[:, VELOCITY + k] = 1.0
    return out


def stack_numbers(kinds: Sequence[int] | Array, data: Sequence[Array]) -> Array:
    """Return the numbers (B, J, width) of nodes with numbers (B, n) or (1, n) each."""
    out = np.zeros((max((len(part) for part in data), default=1), len(data), width(kinds)))
    for j, part in enumerate(data):
        out[:, j, : part.shape[1]] = part
    return out


def columns_of(problem: Problem, observed: Array) -> CostColumns:
    """Return the nodes that sum to the rows of a flat batch of N problems within the scope of the proof.

    `observed` (N, m) has the measurements minus all known additions; azimuth nodes are relative to them.
    """
    nodes = CostColumns(problem)
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        model = MODELS[rows.kind]
        for i in range(rows.count):
            row = NodeRow(problem, int(rows.a[i]), int(rows.b[i]), int(rows.epoch[i]), observed[:, start + i])
            for factor, node, station in _terms(model, row):
                nodes.add_to_row(start + i, _number_of(nodes, replace(row, a=station), node), factor)
    return nodes


def _terms(model: Model, row: NodeRow) -> Iterator[tuple[float, str | Node, int]]:
    """Yield the terms that sum to the prediction of a row: factor, node (or its name), and station."""
    nodes = ((1.0, "range"),) if model.ranges is not None else model.nodes
    # If each station measures separately, its terms have a sign. Other nodes belong to the row as a whole.
    for sign, station in zip(model.signs or (1,), (row.a, row.b), strict=False):
        if sign:
            yield from ((sign * factor, node, station) for factor, node in nodes)


def _number_of(nodes: CostColumns, row: NodeRow, node: str | Node) -> int:
    """Return the index of a node of one row in `nodes`; a node of one station and epoch is added once and shared."""
    code, entry = code_of(node), named(node)
    if not entry.of_station:
        return nodes.add(code, entry.numbers(row))
    epoch = row.epoch if own_epochs(nodes.problem) > 1 else 0
    key = (code, row.a, epoch)
    if key not in nodes.shared:
        nodes.shared[key] = nodes.add(code, entry.numbers(row), row.a, epoch)
    return nodes.shared[key]


def own_epochs(problem: Problem) -> int:
    """Return the number of epochs at which stations or the target have a separate position or velocity, at least 1."""
    stations = problem.stations
    if problem.motions[0].order > 0:
        return problem.epochs
    given = [array for array in (stations.position, stations.velocity) if array is not None]
    return max(int(array.shape[-3]) for array in given)


def add_linear(nodes: CostColumns, rows: Array, origin: Array | None = None) -> list[int]:
    """Add linear nodes with coefficients `rows` (B, q, d), zero at an origin (B, d), and return their indices."""
    return [nodes.add(LINEAR, linear_numbers(rows[:, i], origin)) for i in range(rows.shape[1])]


# Least squares over the position alone: other unknowns that enter linearly take their best values.


def roots(precision: Array) -> Array:
    """Return L' (..., n, n) with L L' equal to a symmetric positive semidefinite precision."""
    values, vectors = np.linalg.eigh(precision)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[..., :, None] * np.swapaxes(vectors, -1, -2))


def compress(K: Array, w: Array) -> tuple[Array, Array]:
    """Return at most J + 1 rows with the same sum of squares ``|K phi - w|^2`` for every phi.

    K (B, q, J) are whitened rows over the J nodes, with B = 1 or N, and w (N, q) are whitened measurements.
    """
    q, nodes = K.shape[-2:]
    if q <= nodes + 1:
        return K, w
    basis, upper = np.linalg.qr(K)
    # Differences of J ranges have rank J - 1, so the last row is rounding. If it stayed, it would be a range without
    # counterpart, and the cost would seem to grow towards infinity.
    length = np.sqrt((K**2).sum(-2, keepdims=True))
    upper = np.where(np.abs(upper) > _DEPENDENT * length, upper, 0.0)
    # A separate row contains the residual that no position can fit, so that the cost keeps its value.
    upper = np.concatenate([upper, np.zeros((*upper.shape[:-2], 1, nodes))], axis=-2)
    return upper, _along_and_rest(basis, w)


def _along_and_rest(basis: Array, w: Array) -> Array:
    """Return measurements along orthonormal columns `basis` (B, q, J), and the length of the rest: (N, J + 1).

    The measurements w are (N, q). The sum of squares stays the same.
    """
    inside = (np.swapaxes(basis, -1, -2) @ w[..., None])[..., 0]
    rest = w - (basis @ inside[..., None])[..., 0]
    return np.concatenate([inside, np.sqrt((rest**2).sum(-1, keepdims=True))], axis=-1)


def mark_alone(kinds: Array, data: Array, K: Array, w: Array) -> Array:
    """Return the numbers (B, J, width) of the nodes, with a mark on nodes that are alone in their rows.

    A node gets the mark if it shares no row with other nodes and its least cost is at zero. Its cost is then a
    function of one number, so that the absolute value of the node may replace it. `kinds` (J,) and `data` (B, J,
    width) are codes and numbers of the nodes, and K (B, q, J) and w (N, q) are whitened rows and measurements. B is N,
    or 1 if all problems share.
    """
    if not any(NODES[kind].mark for kind in kinds):
        return data
    information = np.swapaxes(K, -1, -2) @ K
    size = np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    # Relative to the lengths of both columns: relative to a long column alone, any coupling of a short column would
    # vanish.
    scale = size[..., :, None] * size[..., None, :]
    alone = (np.abs(information) <= _ORTHOGONAL * scale + scale * np.eye(len(kinds)) * 2.0).all(-1)
    return mark_nodes(kinds, data, alone, size, (np.swapaxes(K, -1, -2) @ w[..., None])[..., 0], w)


def mark_nodes(kinds: Array, data: Array, alone: Array, size: Array, force: Array, w: Array) -> Array:
    """Return the numbers (B, J, width) of nodes with a mark on nodes that are alone in their rows, see `mark_alone`.

    `alone` (B, J) is true for nodes that share no row with another node or unknown. `size` (B, J) has the lengths of
    the columns of K, and `force` (N, J) is ``K'w``.
    """
    centred = (np.abs(force) <= _ORTHOGONAL * size * np.linalg.norm(w, axis=-1, keepdims=True)).all(0)
    out = np.array(data)
    for kind in {int(kind) for kind in kinds}:
        mark, of_kind = NODES[kind].mark, kinds == kind
        if mark is not None:
            numbers = out[:, of_kind]
            mark(numbers, alone[:, of_kind] & centred[of_kind])
            out[:, of_kind] = numbers
    return out


class PositionCosts(NamedTuple):
    """The maximum-likelihood costs of a flat batch of N problems over the position; B is N, or 1 if all problems share.

    All other unknowns take their best values for the position.

    Parameters
    ----------
    kinds : int array (J,)
        Codes of the nodes.
    data : array (B, J, width)
        Numbers of the nodes.
    K : array (B, q, J)
        Whitened rows over the nodes.
    w : array (N, q)
        Whitened measurements.
    level : array (N,)
        Cost above which angles may be wrong by a full turn that the rows do not show; infinite without biases of
        angles.
    """

    kinds: Array
    data: Array
    K: Array
    w: Array
    level: Array

    @property
    def dense(self) -> float:
        """Return the weight of a box in the budget of boxes: the number of nodes.

        The time of a box grows with the square of this number.
        """
        return float(len(self.kinds))

    def take(self, items: Array | slice) -> PositionCosts:
        """Return the costs of some of the problems; the same object if `items` are all problems in order."""
        if not isinstance(items, slice) and np.array_equal(items, np.arange(len(self.w))):
            return self

        def chosen(array: Array) -> Array:
            return array if len(array) == 1 else array[items]

        return self._replace(data=chosen(self.data), K=chosen(self.K), w=self.w[items], level=self.level[items])


def position_costs(problem: Problem) -> PositionCosts:
    """Return the costs of a flat batch of problems over the position.

    Unknown emission times and offsets without a prior are projected out. Offsets, drifts and isotropic station errors
    with Gaussian priors enlarge the covariance. Both are exact, because these unknowns enter the rows linearly. Among
    all station positions with a given range, the nearest to the surveyed position is on the line to the target. So a
    station error enters linearly, too.

    Parameters
    ----------
    problem : Problem
        N problems within the scope of the proof, see `optloc.proof.scope.why_unsupported`.
    """
    kinds, numbers, K, w, level, _ = _rows_of(problem, np.zeros(problem.count, dtype=int))
    K, w = compress(K, w)
    return PositionCosts(kinds, data=mark_alone(kinds, numbers, K, w), K=K, w=w, level=level)


def costs_of_groups(problem: Problem, group: Array) -> tuple[PositionCosts, Array]:
    """Return costs like `position_costs` with separate nodes for each group of rows, and the groups (J,) of the nodes.

    The rows must be sums of ranges and of logarithms of ranges. `group` (m,) has the group of each row, and -1 for
    rows without a factor, such as priors.
    """
    kinds, numbers, K, w, level, group_of_node = _rows_of(problem, group)
    K, w = compress(K, w)
    return PositionCosts(kinds, numbers, K, w, level), group_of_node


def costs_of_velocity(problem: Problem) -> tuple[PositionCosts, Array]:
    """Return costs and groups like `costs_of_groups`; the factors are components of the target's velocity."""
    kinds, numbers, K, w, level, group_of_node = _rows_of(problem, None)
    K, w = compress(K, w)
    return PositionCosts(kinds, numbers, K, w, level), group_of_node


def factors_of_rows(problem: Problem) -> Array:
    """Return the number of the unknown factor (m,) of each row; -1 for none, -2 for several or another multiple."""
    out, first = np.full(problem.count, -1), 0
    for bias in problem.biases:
        if form_of(bias).enters == "scales":
            several = (np.bincount(bias.row, minlength=problem.count) > 1) | (out != -1)
            out[bias.row] = np.where(several[bias.row] | (bias.coefficient != 1.0), -2, first + bias.member)
            first += len(bias.members)
    return out


def _rows_of(problem: Problem, group: Array | None) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return kinds and numbers of the nodes, rows over them, measurements (N, q), levels (N,), and groups of nodes.

    The rows K are (B, q, J), and the levels are as in `PositionCosts`. `group` has the group of each row (m,). None
    makes groups of the components of the target's velocity. Nodes of priors on the position have the group -1.
    """
    problem = with_station_noise(problem)
    others = OtherRows.of(problem)
    known = problem.observed - (others.coefficients @ others.mean[..., None])[..., 0]
    # Absent rows have weight zero, so any finite value is valid.
    usable = (problem.weight > 0.0) & np.isfinite(known)
    known = np.where(usable, known, 0.0)
    nodes = columns_of(problem, known)
    if group is None:
        group_of_node = nodes.with_velocity()
    else:
        nodes, group_of_node = (
            nodes.split(group) if len(set(group.tolist())) > 1 else (nodes, np.full(len(nodes.kinds), group[0]))
        )
    others = others.with_stations(problem, nodes)
    value = np.where(counts_from_measured(problem), 0.0, known)
    K, w = _without_other_unknowns(problem, nodes, others, value)
    prior = position_prior(problem, nodes)
    K, w = _with_rows_of(prior, K, w)
    size, level = problem.batch_shape[0], turned_level(problem, others, known)
    w, level = np.broadcast_to(w, (size, w.shape[-1])), np.broadcast_to(level, (size,))
    return np.array(nodes.kinds), nodes.numbers, K, w, level, np.concatenate([group_of_node, np.full(len(prior), -1)])


class Affine(NamedTuple):
    """The costs of all problems that differ in their measurements z (m,) only, as an affine function of z.

    Parameters
    ----------
    kinds, data, K : int array (J,), array (1, J, width), array (1, q, J)
        As in `PositionCosts`; `data` is for z = 0.
    base, slope : array (p,), (p, m)
        The p whitened measurements for z = 0, and their derivative with respect to z.
    basis : array (p, J), optional
        Orthonormal columns onto which measurements are folded (`compress`); None if they are not folded.
    place, first, gain : int array (e,), array (e,), array (e, m)
        Indices of the e node numbers that change with z, their values for z = 0, and their slopes. Each angle or ratio
        has one such number; ranges and rates have none.
    """

    kinds: Array
    data: Array
    K: Array
    base: Array
    slope: Array
    basis: Array | None
    place: Array
    first: Array
    gain: Array

    def room(self, count: int) -> PositionCosts:
        """Return uninitialised arrays for the costs of `count` problems; `write` fills them."""
        data = np.repeat(self.data, count, axis=0) if len(self.place) else self.data
        return PositionCosts(self.kinds, data, self.K, np.empty((count, self.K.shape[1])), np.full(count, np.inf))

    def write(self, z: Array, costs: PositionCosts, item: int) -> None:
        """Write whitened measurements and node numbers of problem `item` for measurements z (m,)."""
        w = costs.w[item]
        if self.basis is None:
            np.dot(self.slope, z, out=w)
            w += self.base
        else:
            w[:] = _along_and_rest(self.basis, self.slope @ z + self.base)
        if len(self.place):
            costs.data[item].reshape(-1)[self.place] = self.gain @ z + self.first


def affine_costs(problem: Problem) -> Affine | None:
    """Return the cost of a problem as an affine function of its measurements, or None if it is not affine.

    The problem has no batch axes and is within the scope of the proof. Its measurements are ignored. The result is None
    if the cost has a finite level (see `PositionCosts`) or the rows K depend on measurements.
    """
    # an affine map is determined by its values at zero and at the unit vectors
    probes = np.concatenate([np.zeros((1, problem.count)), np.eye(problem.count)])
    kinds, numbers, K, w, level, _ = _rows_of(problem.with_rows(z=probes), np.zeros(problem.count, dtype=int))
    if np.isfinite(level).any() or len(K) > 1:
        return None
    base, slope = w[0].copy(), np.ascontiguousarray((w[1:] - w[0]).T)
    basis = None if K.shape[1] <= K.shape[2] + 1 else np.linalg.qr(K[0])[0]
    K, w = compress(K, w)
    data = mark_alone(kinds, numbers, K, w)
    change = (data[1:] - data[0]).reshape(len(data) - 1, data[0].size)
    place = np.flatnonzero(change.any(0))
    first, gain = data[0].reshape(-1)[place], np.ascontiguousarray(change[:, place].T)
    # writable C-ordered arrays, for which compiled code exists
    data, K = (np.require(array, requirements=["C", "W"]) for array in (data[:1].copy(), K))
    return Affine(kinds, data, K, base, slope, basis, place, first, gain)


@dataclass(frozen=True, slots=True)
class OtherRows:
    """Gaussian unknowns other than the target's state, such as clock offsets and biases.

    They enter the m rows linearly. `coefficients` (m, n) are the derivatives of the rows with respect to the n
    unknowns. `precision` (B, n, n) is the inverse covariance of their priors, zero without a prior, and `mean` (B, n)
    the mean.
    """

    coefficients: Array
    precision: Array
    mean: Array

    @classmethod
    def of(cls, problem: Problem) -> OtherRows:
        """Return coefficients and priors of the unknowns other than position and velocity, without station errors.

        The n columns are all unknowns of the problem's layout. The columns of unknowns that do not enter are zero.
        """
        size = problem.layout.size
        coefficients = np.zeros((problem.count, size))
        for links, start in zip(block_links(problem), problem.starts, strict=True):
            np.add.at(coefficients, (start + links.adds.row, links.adds.column), links.adds.coefficient)
        parts = [part for part in prior_parts(problem) if part[0] not in ("position", "velocity")]
        batch = max(
            (len(array) for _, m, p in parts for array, core in ((m, 1), (p, 2)) if array.ndim > core), default=1
        )
        precision, mean = np.zeros((batch, size, size)), np.zeros((batch, size))
        for name, centre, information in parts:
            shared = problem.layout.find(name)[1]
            for epoch in range(1 if shared else problem.epochs):
                place = columns(problem.layout, name, np.array([epoch]))[0]
                precision[:, place[:, None], place] += information if shared else information[..., 0, :, :]
                mean[:, place] = centre
        return cls(coefficients, precision, mean)

    def with_stations(self, problem: Problem, nodes: CostColumns) -> OtherRows:
        """Return the same unknowns with coefficients of the station errors; `nodes` are the nodes of the rows.

        An isotropic station error counts only along the line to the target.
        """
        if problem.stations.covariance is None:
            return self
        coefficients, d = self.coefficients.copy(), problem.dimension
        epoch = problem.epoch
        for row, node, coefficient in zip(nodes.row, nodes.column, nodes.coefficient, strict=True):
            place = columns(problem.layout, "stations", epoch[row : row + 1])[0]
            # Errors are isotropic, so any axis can represent the line to the target: the first of the station's d
            # axes.
            coefficients[row, place[nodes.station[node] * d]] += coefficient
        return OtherRows(coefficients, self.precision, self.mean)


def _of_rows(problem: Problem, of_model: Callable[[Model], Any]) -> Array:
    """Return an array (m,) with the value of a function of the measurement kind (its `Model`) of each row."""
    return np.concatenate([np.full(rows.count, of_model(MODELS[rows.kind])) for rows in problem.rows])


def counts_from_measured(problem: Problem) -> Array:
    """Return a bool array (m,): whether the row has a node that is relative to its measured value, as azimuths have."""
    return _of_rows(problem, lambda model: any(named(node).counts_from_measured for _, node in model.nodes))


def _without_other_unknowns(
    problem: Problem, nodes: CostColumns, others: OtherRows, value: Array
) -> tuple[Array, Array]:
    """Return whitened rows (B, q, J) over the nodes and measurements (N, q), with other unknowns projected out.

    `value` (N, m) contains the measurements minus known additions. The cost of the result is the least cost over the
    other unknowns, with their priors.
    """
    noise, J = whiten(problem.noise, problem.weight), len(nodes.kinds)
    used = others.coefficients.any(0) | others.precision.any((0, 1))
    coefficients, precision = others.coefficients[:, used], others.precision[:, used][:, :, used]
    geometry = whiten_rows(noise, np.concatenate([nodes.design, coefficients], axis=1))
    geometry = geometry if geometry.ndim == 3 else geometry[None]
    shared = len(geometry) == len(precision) == 1  # one template, many measurements: the usual batch
    # If all else is shared, the measurements of all problems are the columns of one matrix.
    measured = whiten_rows(noise, value.T if shared else value[..., None])
    measured = measured if measured.ndim == 3 else measured[None]
    if used.any():
        # A prior is a row for the unknown itself; an unknown without a prior has a row of zeros.
        size = max(len(geometry), len(precision))
        prior_rows = np.zeros((size, coefficients.shape[1], J + coefficients.shape[1]))
        prior_rows[..., J:] = roots(precision)
        geometry = np.concatenate([np.broadcast_to(geometry, (size, *geometry.shape[1:])), prior_rows], axis=1)
        zeros = np.zeros((len(measured), coefficients.shape[1], measured.shape[-1]))
        measured = np.concatenate([measured, zeros], axis=1)
        unknowns = geometry[..., J:]
        geometry, measured = project_out(unknowns, geometry[..., :J]), project_out(unknowns, measured)
    return geometry[..., :J], np.ascontiguousarray(measured[0].T) if shared else measured[..., 0]


def position_prior(problem: Problem, nodes: CostColumns) -> list[int]:
    """Add the nodes of a Gaussian prior on the position, one for each coordinate, and return their indices."""
    out: list[int] = []
    for name, mean, precision in prior_parts(problem):
        if name == "position":
            whole = precision if precision.ndim == 3 else precision[None]
            out += add_linear(nodes, roots(whole), mean if mean.ndim == 2 else mean[None])
    return out


def _with_rows_of(nodes: list[int], K: Array, w: Array) -> tuple[Array, Array]:
    """Return K (B, q + e, J + e) and w (N, q + e) with one more row for each of the last e nodes: its prior.

    Each new row contains its node (`nodes`) alone, and the measured value is zero.
    """
    if not nodes:
        return K, w
    new_rows = np.zeros((len(K), len(nodes), K.shape[2] + len(nodes)))
    new_rows[:, np.arange(len(nodes)), nodes] = 1.0
    wider = np.zeros((*K.shape[:2], len(nodes)))
    K = np.concatenate([np.concatenate([K, wider], axis=2), new_rows], axis=1)
    return K, np.concatenate([w, np.zeros((len(w), len(nodes)))], axis=1)


def turned_level(problem: Problem, others: OtherRows, known: Array) -> Array:
    """Return the cost (N,) above which the sum of an angle and its bias may be wrong by a full turn.

    `known` (N, m) contains the measurements minus known additions. Without angles of this kind the level is infinite.
    Residuals are wrapped together with their bias, but nodes without it. A row can differ only if noise and bias
    together are half a turn. The chi-square of the row is then at least that angle squared over their variance.
    """
    level = np.full(len(known), np.inf)
    period = _of_rows(problem, lambda model: model.period or np.nan)
    rows = np.flatnonzero(np.isfinite(period))
    if not len(rows):
        return level
    variance = variances(problem.noise, problem.count)[..., rows]
    coefficients = others.coefficients[rows]
    biased = coefficients.any(1)
    if biased.any():
        covariance = np.linalg.pinv(others.precision, hermitian=True)
        variance = variance + np.einsum("rn,bnm,rm->br", coefficients, covariance, coefficients)
    relative = counts_from_measured(problem)[rows]
    most, turn = _of_rows(problem, _greatest_size)[rows], period[rows]
    # Distance from the measured value to the farthest value of the node. Beyond half a turn the residual is the
    # shorter way.
    size = np.where(relative, 0.0, np.abs(known[:, rows]))
    distance = turn - most - size
    may_turn = biased | (~relative & (size >= 0.5 * turn - most))
    return np.asarray(np.where(may_turn, distance * np.abs(distance) / variance, np.inf).min(1))


def _greatest_size(model: Model) -> float:
    """Return the greatest size of the node of a kind with a period, radians."""
    return sum(abs(factor) * named(node).most for factor, node in model.nodes)

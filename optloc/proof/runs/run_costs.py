"""From long problems to costs of runs: sparse rows over the nodes, and dense rows of a few epochs.

The cost of the few rows is nowhere more than the cost of all rows, and takes a fraction of the time. Letters: m rows of
measurements, q whitened rows, J nodes (scalar functions of the position, such as ranges), N problems.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optloc.base.linalg import project_out, span_of
from optloc.base.types import Array
from optloc.kernels.jit import may_use_code, plain
from optloc.linear.normal import prior_parts, with_station_noise
from optloc.problem.noise import whiten
from optloc.problem.problem import Problem
from optloc.proof.batch import plainly
from optloc.proof.groups import empty_groups
from optloc.proof.nodes.level import height_numbers
from optloc.proof.position_costs import (
    CostColumns,
    OtherRows,
    PositionCosts,
    add_linear,
    columns_of,
    counts_from_measured,
    mark_nodes,
    position_prior,
    roots,
    turned_level,
)
from optloc.proof.runs.ground import STRAIGHT, Ground
from optloc.proof.runs.rows import RunRows
from optloc.proof.runs.states import ConstantVelocityCost
from optloc.proof.scope import held_height
from optloc.proof.search_space import (
    Cost,
    cost_of,
)

# From a problem to all its rows, and to the rows of a few epochs.

# Nodes of the few rows, tested in runs of five stations at 200 and 600 epochs. A tenth of all nodes took as much time
# for a box as the bounds with all rows that it saved. Three times this number did not save more of these bounds.
_LOOK = 60


# Nodes of dense rows that get the whole budget of boxes, and nodes of a run above which the budget is reduced: 500
# nodes take 50 us a box.
_DENSE, _LONG = 12, 500


class RunCost(NamedTuple):
    """A cost of many rows.

    Parameters
    ----------
    cost : Cost
        Nodes, weights and measurements of the cost; the dense rows are empty.
    rows : RunRows
        All rows, sparse.
    look : Cost
        The cost of a few of the rows, which is nowhere larger. A search evaluates it first.
    """

    cost: Cost
    rows: RunRows
    look: Cost


@dataclass(frozen=True, slots=True)
class Runs:
    """The costs of a flat batch of long problems; `PositionCosts` are the costs of short ones.

    Parameters
    ----------
    runs : tuple of RunCost
        One for each problem.
    level : array (N,)
        Cost above which angles may be wrong by a full turn that the rows do not show.
    """

    runs: tuple[RunCost, ...]
    level: Array

    @property
    def dense(self) -> float:
        """Return the weight of a box in the budget of boxes, as a number of dense nodes.

        A larger number gives a smaller budget. Long runs take fewer boxes than short runs, so the number grows only
        with a root of the time for a box.
        """
        return float(_DENSE * max(1.0, len(self.runs[0].cost.kinds) / _LONG) ** 0.25)

    def take(self, items: Array | slice) -> Runs:
        """Return the costs of some of the problems."""
        numbers = np.arange(len(self.runs))[items]
        return Runs(tuple(self.runs[i] for i in numbers), self.level[items])


def run_costs(problem: Problem) -> Runs:
    """Return the costs of a flat batch of N long problems over the position."""
    problem, count = with_station_noise(problem), problem.batch_shape[0]
    with _fastest_kernels(count):
        costs = [_run_cost(problem.take(np.array([i]))) for i in range(count)]
    return Runs(tuple(run for run, _ in costs), np.array([level for _, level in costs]))


def _fastest_kernels(count: int) -> AbstractContextManager[None]:
    """Return a context with plain Python kernels, unless compiled code is available or worth its compilation."""
    return nullcontext() if may_use_code(cost_of, count) else plain()


def few_costs(problem: Problem) -> PositionCosts:
    """Return the cost of a few rows of one long problem as the costs of a batch of one."""
    with _fastest_kernels(1):
        run, level = _run_cost(with_station_noise(problem))
    look = run.look
    return PositionCosts(look.kinds, look.data[None], look.K[None], look.w[None], np.array([level]))


def _nodes_and_measurements(problem: Problem) -> tuple[OtherRows, Array, Array, CostColumns]:
    """Return the other unknowns, measurements minus known additions (N, m), whether they are present, and the nodes."""
    others = OtherRows.of(problem)
    known = problem.observed - (others.coefficients @ others.mean[..., None])[..., 0]
    present = (problem.weight > 0.0) & np.isfinite(known)
    known = np.where(present, known, 0.0)
    nodes = columns_of(problem, known)
    return others.with_stations(problem, nodes), known, present, nodes


def _run_cost(problem: Problem) -> tuple[RunCost, float]:
    """Return one problem, a batch of one, as a run, and its level (see `Runs`).

    Dense rows of a few epochs, without other unknowns, become the field `look`.
    """
    others, known, usable, nodes = _nodes_and_measurements(problem)
    priors = position_prior(problem, nodes)
    kinds = np.array(nodes.kinds)
    value = np.where(counts_from_measured(problem), 0.0, known)[0]
    prior = _rows_of_single_nodes(priors, len(kinds))
    all_rows = _WhitenedRows.of(problem, usable[0], nodes, others, value, prior)
    data = all_rows.marked(kinds, nodes.numbers[:1])
    few_rows = _WhitenedRows.of(problem, usable[0] & _are_few(problem, len(kinds)), nodes, others, value, prior)
    used = np.bincount(few_rows.nodes.indices, minlength=len(kinds)) > 0
    dense = project_out(few_rows.unknowns, np.column_stack([few_rows.nodes[:, used].toarray(), few_rows.measured]))
    nonzero = (dense != 0.0).any(1)
    look = cost_of(kinds[used], plainly(data[used]), plainly(dense[nonzero, :-1]), plainly(dense[nonzero, -1]))
    rows = all_rows.rows()
    none = np.empty((0, len(kinds)))
    cost = Cost(kinds, plainly(data), none, rows.w, np.empty((0, 0)), rows.weight, empty_groups(0))
    return RunCost(cost, rows, look), float(turned_level(problem, others, known)[0])


# Problems of a moving target: nodes depend on the positions at their epochs.


@dataclass(frozen=True, slots=True)
class CourseCosts:
    """The costs of a flat batch of problems of a moving target, like `Runs` for a fixed target.

    Parameters
    ----------
    courses : tuple of (ConstantVelocityCost, ConstantVelocityCost)
        All rows of each problem, and the rows of a few epochs, whose cost is nowhere more.
    level : array (N,)
        As in `Runs`.
    """

    courses: tuple[tuple[ConstantVelocityCost, ConstantVelocityCost], ...]
    level: Array

    @property
    def dense(self) -> float:
        """Return the weight of a box in the budget of boxes, as a number of dense nodes (see `Runs.dense`)."""
        return float(_DENSE)

    def take(self, items: Array | slice) -> CourseCosts:
        """Return the costs of some of the problems."""
        numbers = np.arange(len(self.courses))[items]
        return CourseCosts(tuple(self.courses[i] for i in numbers), self.level[items])


def course_costs(problem: Problem) -> CourseCosts:
    """Return the costs of a flat batch of N problems over position and velocity, with other unknowns at their best."""
    problem = with_station_noise(problem)
    costs = [_course_cost(problem.take(np.array([i]))) for i in range(problem.batch_shape[0])]
    return CourseCosts(tuple(courses for courses, _ in costs), np.array([level for _, level in costs]))


def _course_cost(problem: Problem) -> tuple[tuple[ConstantVelocityCost, ConstantVelocityCost], float]:
    """Return one problem, a batch of one, as costs of all rows and of few rows, and its level (see `Runs`)."""
    others, known, usable, nodes = _nodes_and_measurements(problem)
    since = problem.times - problem.origin
    when = np.zeros(len(nodes.kinds))
    when[nodes.column] = since[problem.epoch[nodes.row]]  # rows that share a node are of one epoch
    value = np.where(counts_from_measured(problem), 0.0, known)[0]
    rise = np.zeros(len(nodes.kinds))
    rise[nodes.column] = _heights_above_state(problem)[problem.epoch[nodes.row]]
    prior, times = _state_prior(problem, nodes, max(float(np.ptp(since)), 1.0))
    # a prior applies to the state itself, at any reported height
    when = np.stack([np.concatenate([when, times]), np.concatenate([rise, np.zeros(len(times))])], axis=1)
    parts = [usable[0], usable[0] & _are_few(problem, len(when))]
    systems = [_WhitenedRows.of(problem, part, nodes, others, value, prior) for part in parts]
    courses = [_cost_over_states(problem, system, nodes, when) for system in systems]
    return (courses[0], courses[1]), float(turned_level(problem, others, known)[0])


def _heights_above_state(problem: Problem) -> Array:
    """Return the heights (k,) of a moving target at its k epochs above the height of its state, metres."""
    rise = problem.motions[0].rise
    return np.zeros(problem.epochs) if rise is None else np.reshape(rise[..., 0], (-1, problem.epochs))[0]


def _state_prior(problem: Problem, nodes: CostColumns, span: float) -> tuple[Any, list[float]]:
    """Add the nodes of priors on position and velocity; return their rows over all nodes, and their times, seconds.

    The rows are sparse (count, J). A velocity is the difference of two positions, divided by the time `span` between
    them, seconds.
    """
    from scipy import sparse

    row: list[int] = []
    node: list[int] = []
    factor: list[float] = []
    times: list[float] = []
    count = 0
    for name, mean, precision in prior_parts(problem):
        if name not in ("position", "velocity"):
            continue
        root, centre = roots(precision.reshape(problem.dimension, -1)), mean.reshape(1, -1)
        # A node is `root` times the position at a time minus an origin. With the origin time * mean, the difference of
        # two nodes divided by the span is `root` times the velocity minus its mean.
        for time, share in ((0.0, 1.0),) if name == "position" else ((span, 1.0 / span), (0.0, -1.0 / span)):
            node += add_linear(nodes, root[None], centre if name == "position" else time * centre)
            row += range(count, count + problem.dimension)
            factor += [share] * problem.dimension
            times += [time] * problem.dimension
        count += problem.dimension
    entries = (np.array(factor), (np.array(row, dtype=int), np.array(node, dtype=int)))
    return sparse.csr_array(entries, shape=(count, len(nodes.kinds))), times


def _cost_over_states(problem: Problem, system: _WhitenedRows, nodes: CostColumns, when: Array) -> ConstantVelocityCost:
    """Return whitened rows as a cost over the nodes that they use, in order of time.

    `when` (J, 2) has the time of each node after the time of the state, s, and its height above the state, m.
    """
    used = np.flatnonzero(np.bincount(system.nodes.indices, minlength=len(when)))
    order = used[np.lexsort((when[used, 1], when[used, 0]))]
    epochs, first = np.unique(when[order], axis=0, return_index=True)
    sorted_system = replace(system, nodes=system.nodes[:, order])
    kinds = np.array(nodes.kinds)[order]
    data = sorted_system.marked(kinds, nodes.numbers[:1, order])
    since, rise = (plainly(column) for column in epochs.T)
    ground = _ground(problem, since, rise)
    return ConstantVelocityCost(kinds, data, np.append(first, len(order)), since, sorted_system.rows(), ground)


def _ground(problem: Problem, since: Array, rise: Array) -> Ground:
    """Return the surface on which a target moves, or `STRAIGHT`; its axes are the frame's until a position is known.

    `since` and `rise` (k,) are the times of the epochs after the state, s, and their heights above it, m.
    """
    level = held_height(problem)
    if level is None:
        return STRAIGHT
    value = float(np.ravel(level.lower)[0])
    return Ground(plainly(height_numbers(problem)[0]), np.eye(3), value, rise, float(np.abs(since).max(initial=0.0)))


def _are_few(problem: Problem, nodes: int) -> Array:
    """Return a bool array (m,): whether the row is one of the few, of evenly spaced epochs, or evenly spaced rows.

    `nodes` is the number of nodes of all rows.
    """
    epochs = np.unique(problem.epoch)
    key = np.searchsorted(epochs, problem.epoch) if len(epochs) >= _LOOK // 3 else np.arange(problem.count)
    apart = max(1, round(nodes / _LOOK))
    return np.asarray(key % apart == apart // 2)


@dataclass(frozen=True, slots=True)
class _WhitenedRows:
    """Whitened rows with rows of priors.

    `nodes` (q, J), sparse, are the coefficients of the nodes, `unknowns` (q, p) the coefficients of other unknowns, and
    `measured` (q,) the whitened measurements.
    """

    nodes: Any
    unknowns: Array
    measured: Array

    @classmethod
    def of(
        cls, problem: Problem, present: Array, nodes: CostColumns, others: OtherRows, value: Array, prior: Any
    ) -> _WhitenedRows:
        """Return the whitened rows of one problem.

        `present` (m,) marks the rows to use, `value` (m,) are measurements minus known additions, and `prior` the
        sparse rows of priors on the state.
        """
        from scipy import sparse  # imported with the first long run: problems of one epoch do not need it

        size, white = len(nodes.kinds), _whitening(problem, present)
        design = sparse.csr_array((nodes.coefficient, (nodes.row, nodes.column)), shape=(problem.count, size))
        precision = others.precision[0]
        used = others.coefficients.any(0) | precision.any(0)
        root = roots(precision[used][:, used])
        none = sparse.csr_array((len(root), size))
        return cls(
            sparse.csr_array(sparse.vstack([white @ design, prior, none])),
            np.concatenate([white @ others.coefficients[:, used], np.zeros((prior.shape[0], len(root))), root]),
            np.concatenate([white @ value, np.zeros(prior.shape[0] + len(root))]),
        )

    def marked(self, kinds: Array, data: Array) -> Array:
        """Return the numbers (J, width) of the nodes, with a mark on nodes that share no row with others.

        `kinds` (J,) and `data` (1, J, width) are codes and numbers of the nodes; for the mark see `mark_nodes`.
        """
        shared = (np.diff(self.nodes.indptr) > 1) | self.unknowns.any(1)
        touched = self.nodes != 0.0
        size = np.sqrt(np.asarray(self.nodes.multiply(self.nodes).sum(0)))
        force = np.asarray(self.nodes.T @ self.measured)
        alone = np.asarray(touched.T @ shared.astype(float)) == 0.0
        return plainly(mark_nodes(kinds, data, alone[None], size[None], force[None], self.measured[None])[0])

    def rows(self) -> RunRows:
        """Return the rows as arrays for compiled code."""
        basis = span_of(self.unknowns) if self.unknowns.shape[1] else self.unknowns
        kept = basis.any(0)
        start, column = (np.asarray(index, dtype=np.int64) for index in (self.nodes.indptr, self.nodes.indices))
        weight = np.sqrt(np.asarray(self.nodes.multiply(self.nodes).sum(0)))
        arrays = (self.nodes.data, self.measured, basis[:, kept].T, weight)
        return RunRows(start, column, *map(plainly, arrays))


def _rows_of_single_nodes(nodes: list[int], size: int) -> Any:
    """Return sparse rows (n, size), each of which contains one of the n nodes with the factor 1."""
    from scipy import sparse

    return sparse.csr_array((np.ones(len(nodes)), (np.arange(len(nodes)), nodes)), shape=(len(nodes), size))


def _whitening(problem: Problem, present: Array) -> Any:
    """Return the sparse matrix (q, m) that whitens the rows; rows that are not `present` (m,) become zero."""
    from scipy import sparse

    blocks = []
    for whitener in whiten(problem.noise, np.where(present, problem.weight.reshape(-1), 0.0)):
        g, r = whitener.row.shape
        matrix = whitener.matrix[0] if whitener.matrix.ndim == 4 else whitener.matrix
        line = np.broadcast_to(np.arange(g * r).reshape(g, r, 1), (g, r, r))
        column = np.broadcast_to(whitener.row[:, None, :], (g, r, r))
        entries = (np.broadcast_to(matrix, (g, r, r)).ravel(), (line.ravel(), column.ravel()))
        blocks.append(sparse.csr_array(entries, shape=(g * r, problem.count)))
    out = sparse.csr_array(sparse.vstack(blocks))
    out.eliminate_zeros()
    return out

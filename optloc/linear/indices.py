"""Which unknown moves which input of which row: the indices of a problem, made once for each structure."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np

from optloc.base.arrays import gather, placed
from optloc.base.cache import Cache
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Rows
from optloc.models import MODELS, Model
from optloc.problem.layout import Layout, emission_name, state_names
from optloc.problem.problem import Problem

# Inputs of a measurement function: target, its rate, both stations, their rates, axes and the turn of the axes.
# Sixteen apart: the largest input, a set of axes, has nine components.
TARGET, TARGET_RATE, A, B, RATE_A, RATE_B, AXES_A, AXES_B, TURN = (16 * i for i in range(9))


@dataclass(frozen=True, slots=True)
class Feed:
    """How one unknown of each row moves a seed: ``seed += gain * x[column]``.

    Parameters
    ----------
    seed : int
        Which input of the measurement function.
    column : int array (m,)
        Column of the full parameter vector.
    gain : float or array (m,)
        Factor.
    rows : slice or int array
        Rows of the block it applies to.
    """

    seed: int
    column: Array
    gain: Any
    rows: Any

    def table(self, count: int) -> tuple[Array, Array]:
        """Return column and factor, each (count,), for all rows of the block: factor zero where it does not apply."""
        # Column zero with factor zero where it does not apply: a gather needs some column.
        column, gain = np.zeros(count, dtype=np.int64), np.zeros(count)
        column[self.rows], gain[self.rows] = self.column, self.gain
        return column, gain


@dataclass(frozen=True, slots=True)
class Terms:
    """Linear terms of rows in the unknowns: each entry adds ``coefficient * x[column]`` to its row.

    Parameters
    ----------
    row : int array (n,)
        Row within the block; may repeat.
    column : int array (n,)
        Column of the full parameter vector.
    coefficient : array (n,)
        Factor.
    """

    row: Array
    column: Array
    coefficient: Array

    def total(self, x: Array, count: int) -> Any:
        """Return the sums (..., count) of every row at vectors x (..., size)."""
        out: Any = placed(np.zeros(count), x)
        for column, coefficient in self.tables(count):
            out = out + gather(x, column) * placed(coefficient, x)
        return out

    def tables(self, count: int) -> list[tuple[Array, Array]]:
        """Return pairs of column and coefficient, each (count,), that add up to the terms of all rows of the block."""
        found, left = [], np.arange(len(self.row))
        while left.size:  # a row with several terms takes part in several tables
            rows, first = np.unique(self.row[left], return_index=True)
            column, coefficient = np.zeros(count, dtype=np.int64), np.zeros(count)
            column[rows], coefficient[rows] = self.column[left[first]], self.coefficient[left[first]]
            found.append((column, coefficient))
            left = np.delete(left, first)
        return found


@dataclass(frozen=True, slots=True)
class Plan:
    """The indices of one block of rows: measurement = h(fed inputs) * (1 + gains) + adds.

    Parameters
    ----------
    block : Rows
        The rows.
    model : Model
        Their kind.
    feeds : tuple of Feed
        Which unknowns move which inputs of h.
    gains, adds : Terms
        Scale factors, and offsets, drifts and emission times.
    """

    block: Rows
    model: Model
    feeds: tuple[Feed, ...]
    gains: Terms
    adds: Terms


def columns(layout: Layout, name: str, epoch: Array) -> Array:
    """Return the columns (m, size) of a slot in the full parameter vector for rows of given epochs."""
    slot, shared = layout.find(name)
    # Local unknowns of epoch k stand behind those of all epochs before it.
    base = slot.start + (0 if shared else layout.n_shared + epoch * layout.n_local)
    return np.broadcast_to(np.asarray(base)[..., None] + np.arange(slot.size), (len(epoch), slot.size))


# Plans of problems: made once for each structure.

# Rows of a problem whose plans are kept, half of what all kept ones may have: a longer problem is planned anew, which
# takes less time than its rows do, and no memory that lasts.
_KEPT_ROWS = 4096
_PLANS = Cache[tuple[Plan, ...]](2 * _KEPT_ROWS, lambda kept: sum(plan.block.count for plan in kept))


def plans(problem: Problem) -> tuple[Plan, ...]:
    """Return the plan of each block of rows; kept for problems of equal structure that are not long."""
    if problem.count > _KEPT_ROWS:
        return _plans(problem)
    return _PLANS.find(problem.structure, lambda: _plans(problem))


def _plans(problem: Problem) -> tuple[Plan, ...]:
    return tuple(_plan(problem, block, start) for block, start in zip(problem.rows, problem.starts, strict=True))


def _plan(problem: Problem, block: Rows, start: int) -> Plan:
    model = MODELS[block.kind]
    if (block.target < 0).any():
        where = f"{block.kind} row {int(np.argmax(block.target < 0))}"
        raise InvalidProblem("the row names no target", where, "give the index of its target")
    feeds = [*_motion_feeds(problem, block, model), *_station_feeds(problem, block, model)]
    feeds += _turn_feeds(problem, block, start)
    return Plan(block, model, tuple(feeds), _terms(problem, block, start, ("scale",)), _adds(problem, block, start))


def _adds(problem: Problem, block: Rows, start: int) -> Terms:
    parts = [_terms(problem, block, start, ("offset", "drift"))]
    for target in problem.emitting if MODELS[block.kind].emission else ():
        rows = np.flatnonzero(block.target == target)
        column = columns(problem.layout, emission_name(target, len(problem.motions)), block.epoch[rows])
        parts.append(Terms(rows, column[:, 0], np.ones(len(rows))))
    return _append(parts)


def _terms(problem: Problem, block: Rows, start: int, forms: tuple[str, ...]) -> Terms:
    parts = [Terms(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))]
    for bias in problem.biases:
        if bias.form not in forms:
            continue
        inside = (bias.row >= start) & (bias.row < start + block.count)
        rows, member, coefficient = bias.row[inside] - start, bias.member[inside], bias.coefficient[inside]
        if bias.form == "drift":
            # A drift is an offset that grows: here is where seconds enter, nowhere else.
            coefficient = coefficient * (problem.times - problem.origin)[block.epoch[rows]]
        column = columns(problem.layout, bias.name, rows)[np.arange(len(rows)), member]
        parts.append(Terms(rows, column, coefficient))
    return _append(parts)


def _append(parts: list[Terms]) -> Terms:
    return Terms(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("row", "column", "coefficient"))
    )


def _motion_feeds(problem: Problem, block: Rows, model: Model) -> list[Feed]:
    feeds, count = [], len(problem.motions)
    for i, motion in enumerate(problem.motions):
        if motion.known is not None or not np.any(block.target == i):
            continue
        rows = slice(None) if np.all(block.target == i) else np.flatnonzero(block.target == i)
        epoch = block.epoch[rows]
        since = elapsed(problem, i)[epoch]
        for j, name in enumerate(state_names(i, count, motion.order)):
            column = columns(problem.layout, name, epoch)
            for c in range(problem.dimension):
                # Taylor's polynomial of the course; its derivative feeds the rate.
                feeds.append(Feed(TARGET + c, column[:, c], since**j / factorial(j), rows))
                if model.velocity and j:
                    feeds.append(Feed(TARGET_RATE + c, column[:, c], since ** (j - 1) / factorial(j - 1), rows))
    return feeds


def elapsed(problem: Problem, target: int) -> Array:
    """Return the seconds (k,) since a target's state holds; zero where each epoch has its own state."""
    motion = problem.motions[target]
    if motion.span == "epoch":
        return np.zeros(problem.epochs)
    # The first epoch by default, so that adding later epochs does not move what a state means.
    reference = problem.times[0] if motion.reference is None else motion.reference
    return np.asarray(problem.times - reference)


def _station_feeds(problem: Problem, block: Rows, model: Model) -> list[Feed]:
    # Errors that are noise are no unknowns: `optloc.linear.station_noise` puts them into the covariance of rows.
    if problem.stations.covariance is None or problem.stations.span == "noise":
        return []
    d, feeds = problem.dimension, []
    column = columns(problem.layout, "stations", block.epoch)
    for seed, station in ((A, block.a), (B, block.b))[: model.stations]:
        for c in range(d):
            picked = column[np.arange(block.count), station * d + c]
            feeds.append(Feed(seed + c, picked, 1.0, slice(None)))
    return feeds


def _turn_feeds(problem: Problem, block: Rows, start: int) -> list[Feed]:
    feeds = []
    for bias in problem.biases:
        if bias.form != "rotation":
            continue
        left = np.flatnonzero((bias.row >= start) & (bias.row < start + block.count))
        turns = 1 if problem.dimension == 2 else 3
        while left.size:  # a row turned by several members takes one pass for each: a feed holds a row once
            rows, first = np.unique(bias.row[left] - start, return_index=True)
            touch, left = left[first], np.delete(left, first)
            column = columns(problem.layout, bias.name, rows)
            for c in range(turns):
                picked = column[np.arange(len(rows)), bias.member[touch] * turns + c]
                feeds.append(Feed(TURN + c, picked, bias.coefficient[touch], rows))
    return feeds

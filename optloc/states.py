"""How the points of a measurement come out of the parameter vector, as values or with derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np

from optloc.errors import InvalidProblem
from optloc.layout import Layout, emission_name, state_names
from optloc.models import MODELS, Model, Point
from optloc.models.jet import Jet
from optloc.models.primitives import rotate
from optloc.problem import Problem
from optloc.types import Array, Rows

_TARGET, _TARGET_RATE, _A, _B, _RATE_A, _RATE_B, _AXES_A, _AXES_B, _TURN = (16 * i for i in range(9))


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

    def total(self, x: Array, count: int) -> Array:
        """Return the sums (..., count) of every row at vectors x (..., size)."""
        out = np.zeros((*x.shape[:-1], count))
        np.add.at(out, (..., self.row), x[..., self.column] * self.coefficient)  # type: ignore[arg-type]
        return out


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
    base = slot.start + (0 if shared else layout.n_shared + epoch * layout.n_local)
    return np.broadcast_to(np.asarray(base)[..., None] + np.arange(slot.size), (len(epoch), slot.size))


_PLANS: dict[tuple[Any, ...], tuple[Plan, ...]] = {}


def plans(problem: Problem) -> tuple[Plan, ...]:
    """Return the plan of each block of rows; kept for problems of equal structure."""
    key = problem.structure
    if key not in _PLANS:
        if len(_PLANS) > 64:
            _PLANS.clear()
        _PLANS[key] = tuple(
            _plan(problem, block, start) for block, start in zip(problem.rows, problem.starts, strict=True)
        )
    return _PLANS[key]


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
    return _appended(parts)


def _terms(problem: Problem, block: Rows, start: int, forms: tuple[str, ...]) -> Terms:
    parts = [Terms(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))]
    for bias in problem.biases:
        if bias.form not in forms:
            continue
        inside = (bias.row >= start) & (bias.row < start + block.count)
        rows, member, coefficient = bias.row[inside] - start, bias.member[inside], bias.coefficient[inside]
        if bias.form == "drift":
            coefficient = coefficient * (problem.times - problem.times[0])[block.epoch[rows]]
        column = columns(problem.layout, bias.name, rows)[np.arange(len(rows)), member]
        parts.append(Terms(rows, column, coefficient))
    return _appended(parts)


def _appended(parts: list[Terms]) -> Terms:
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
                feeds.append(Feed(_TARGET + c, column[:, c], since**j / factorial(j), rows))
                if model.velocity and j:
                    feeds.append(Feed(_TARGET_RATE + c, column[:, c], since ** (j - 1) / factorial(j - 1), rows))
    return feeds


def elapsed(problem: Problem, target: int) -> Array:
    """Return the seconds (k,) since a target's state holds; zero where each epoch has its own state."""
    motion = problem.motions[target]
    if motion.span == "epoch":
        return np.zeros(problem.epochs)
    reference = problem.times[0] if motion.reference is None else motion.reference
    return np.asarray(problem.times - reference)


def _station_feeds(problem: Problem, block: Rows, model: Model) -> list[Feed]:
    if problem.stations.covariance is None:
        return []
    d, feeds = problem.dimension, []
    column = columns(problem.layout, "stations", block.epoch)
    for seed, station in ((_A, block.a), (_B, block.b))[: model.stations]:
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
                feeds.append(Feed(_TURN + c, picked, bias.coefficient[touch], rows))
    return feeds


def fitting(problem: Problem, x: Array) -> Array:
    """Return parameter vectors (..., size) of a problem; refuse those of another length."""
    size = problem.layout.size
    if x.shape[-1:] != (size,):
        raise InvalidProblem(f"a vector of shape {x.shape} for {size} unknowns", "vector", "order it by problem.layout")
    return x


def points(problem: Problem, plan: Plan, x: Array, differentiate: bool) -> tuple[Point, Point, Point]:
    """Return target, first and second station of every row of a block.

    Parameters
    ----------
    problem : Problem
        Its numbers.
    plan : Plan
        The block's indices.
    x : array (..., size)
        Parameter vector.
    differentiate : bool
        Whether fed inputs become `Jet` values seeded with one.
    """
    inputs = given(problem, plan)
    for feed in plan.feeds:
        inputs[feed.seed] = _fed(inputs.get(feed.seed, 0.0), feed, x, plan.block.count)
    if differentiate:
        for seed in {feed.seed for feed in plan.feeds}:
            inputs[seed] = Jet(inputs[seed], {seed: np.ones(1)})
    return joined(problem, plan.model, inputs)


def joined(problem: Problem, model: Model, inputs: dict[int, Any]) -> tuple[Point, Point, Point]:
    """Return target, first and second station made of inputs of any type: arrays, jets or symbols.

    Parameters
    ----------
    problem : Problem
        Gives dimension and frame.
    model : Model
        Says what the points must carry.
    inputs : dict of seed to number
        Components; an absent one is zero.
    """
    d = problem.dimension

    def vector(seed: int) -> tuple[Any, ...]:
        return tuple(inputs.get(seed + c, 0.0) for c in range(d))

    def station(place: int, rate: int, axes: int) -> Point:
        own = tuple(vector(axes + 3 * i) for i in range(d)) if axes in inputs else None
        if _TURN in inputs:
            identity = tuple(tuple(float(i == j) for j in range(d)) for i in range(d))
            own = rotate(own or identity, tuple(inputs[_TURN + c] for c in range(1 if d == 2 else 3)))
        return Point(vector(place), vector(rate) if model.velocity else None, own)

    place = vector(_TARGET)
    ecef = to_ecef(problem, place) if model.ecef else None
    target = Point(place, vector(_TARGET_RATE) if model.velocity else None, None, ecef)
    a = station(_A, _RATE_A, _AXES_A) if model.stations else target
    return target, a, station(_B, _RATE_B, _AXES_B) if model.stations > 1 else a


def given(problem: Problem, plan: Plan) -> dict[int, Any]:
    """Return the inputs that are data, each (..., m): surveyed stations, their rates and axes, known targets."""
    block, model, stations = plan.block, plan.model, problem.stations
    inputs: dict[int, Any] = {}
    for place, rate, axes, index in ((_A, _RATE_A, _AXES_A, block.a), (_B, _RATE_B, _AXES_B, block.b))[
        : model.stations
    ]:
        inputs |= _at_rows(stations.position, 1, block, index, place)
        if model.velocity and stations.velocity is not None:
            inputs |= _at_rows(stations.velocity, 1, block, index, rate)
        if model.axes and stations.axes is not None:
            inputs |= _at_rows(stations.axes, 2, block, index, axes)
    for i, motion in enumerate(problem.motions):
        rows = np.flatnonzero(block.target == i)
        if motion.known is None or not len(rows):
            continue
        epoch = block.epoch[rows] if motion.known.shape[-3] > 1 else np.zeros(len(rows), dtype=int)
        for seed, order in ((_TARGET, 0), (_TARGET_RATE, 1)):
            for c in range(problem.dimension if order < motion.known.shape[-2] else 0):
                values = np.zeros((*motion.known.shape[:-3], block.count))
                values[..., rows] = motion.known[..., epoch, order, c]
                inputs[seed + c] = inputs.get(seed + c, 0.0) + values
    return inputs


def _at_rows(array: Array, rank: int, block: Rows, index: Array, seed: int) -> dict[int, Any]:
    """Return the components of a per-station vector (rank 1) or set of axes (rank 2) at each row."""
    epoch = block.epoch if array.shape[-2 - rank] > 1 else np.zeros_like(block.epoch)
    if rank == 1:
        picked = array[..., epoch, index, :]
        return {seed + c: picked[..., c] for c in range(array.shape[-1])}
    picked = array[..., epoch, index, :, :]
    d = range(array.shape[-1])
    return {seed + 3 * i + c: picked[..., i, c] for i in d for c in d}


def _fed(value: Any, feed: Feed, x: Array, count: int) -> Any:
    part = x[..., feed.column] * feed.gain
    if isinstance(feed.rows, slice):
        return value + part
    full = np.zeros((*x.shape[:-1], count))
    full[..., feed.rows] = part
    return value + full


def to_ecef(problem: Problem, position: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return a position of the problem's frame as ECEF components of the same type."""
    turn, origin = problem.frame.rotation_to_ecef(), problem.frame.origin_ecef()
    if problem.frame.kind == "ecef":
        return position
    return tuple(
        sum((float(turn[i, c]) * position[c] for c in range(1, 3)), float(turn[i, 0]) * position[0]) + float(origin[i])
        for i in range(3)
    )

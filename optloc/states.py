"""How the points of a measurement come out of the parameter vector, as values or with derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np

from optloc.layout import Layout, emission_name, state_names
from optloc.models import MODELS, Model, Point
from optloc.models.jet import Jet
from optloc.models.primitives import rotate
from optloc.problem import Problem
from optloc.types import Array, Rows

_TARGET, _TARGET_RATE, _A, _B, _TURN = (16 * i for i in range(5))


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
class Plan:
    """The indices of one block of rows: which unknowns feed which inputs of its measurement function."""

    block: Rows
    model: Model
    feeds: tuple[Feed, ...]
    emission: tuple[tuple[Array, Array], ...]


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
        _PLANS[key] = tuple(_plan(problem, block, start) for block, start in zip(problem.rows, problem.starts, strict=True))
    return _PLANS[key]


def _plan(problem: Problem, block: Rows, start: int) -> Plan:
    layout, model = problem.layout, MODELS[block.kind]
    feeds = [*_motion_feeds(problem, block, model), *_station_feeds(problem, block, model)]
    feeds += _turn_feeds(problem, block, start)
    emission = []
    for target in problem.emitting if model.emission else ():
        rows = np.flatnonzero(block.target == target)
        name = emission_name(target, len(problem.motions))
        emission.append((rows, columns(layout, name, block.epoch[rows])[:, 0]))
    return Plan(block, model, tuple(feeds), tuple(emission))


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
        inside = (bias.row >= start) & (bias.row < start + block.count)
        rows, member = bias.row[inside] - start, bias.member[inside]
        turns = 1 if problem.dimension == 2 else 3
        column = columns(problem.layout, bias.name, rows)
        for c in range(turns):
            picked = column[np.arange(len(rows)), member * turns + c]
            feeds.append(Feed(_TURN + c, picked, bias.coefficient[inside], rows))
    return feeds


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
    model, block, stations = plan.model, plan.block, problem.stations
    inputs = {feed.seed: 0.0 for feed in plan.feeds} | _known(problem, plan)
    for feed in plan.feeds:
        inputs[feed.seed] = _fed(inputs[feed.seed], feed, x, block.count)
    if differentiate:
        for seed in {feed.seed for feed in plan.feeds}:
            inputs[seed] = Jet(inputs[seed], {seed: np.ones(1)})
    d = problem.dimension

    def place(seed: int) -> tuple[Any, ...]:
        return tuple(inputs.get(seed + c, 0.0) for c in range(d))

    def station(index: Array, seed: int) -> Point:
        axes = _gather(stations.axes, block, index, 2) if model.axes and stations.axes is not None else None
        if _TURN in inputs:
            axes = _gather(np.broadcast_to(np.eye(d), (1, stations.count, d, d)), block, index, 2) if axes is None else axes
            axes = rotate(axes, tuple(inputs[_TURN + c] for c in range(1 if d == 2 else 3)))
        rate = _gather(stations.velocity, block, index, 1) if model.velocity and stations.velocity is not None else None
        return Point(place(seed), rate or ((0.0,) * d if model.velocity else None), axes)

    ecef = _ecef(problem, place(_TARGET)) if model.ecef else None
    target = Point(place(_TARGET), place(_TARGET_RATE) if model.velocity else None, None, ecef)
    a = station(block.a, _A) if model.stations else target
    return target, a, station(block.b, _B) if model.stations > 1 else a


def _known(problem: Problem, plan: Plan) -> dict[int, Any]:
    """Return the parts of the inputs that are data: surveyed stations and known targets."""
    block, d, inputs = plan.block, problem.dimension, {}
    for seed, index in ((_A, block.a), (_B, block.b))[: plan.model.stations]:
        for c, values in enumerate(_gather(problem.stations.position, block, index, 1)):
            inputs[seed + c] = values
    for i, motion in enumerate(problem.motions):
        rows = np.flatnonzero(block.target == i)
        if motion.known is None or not len(rows):
            continue
        epoch = block.epoch[rows] if motion.known.shape[-3] > 1 else np.zeros(len(rows), dtype=int)
        for seed, order in ((_TARGET, 0), (_TARGET_RATE, 1)):
            for c in range(d if order < motion.known.shape[-2] else 0):
                values = np.zeros((*motion.known.shape[:-3], block.count))
                values[..., rows] = motion.known[..., epoch, order, c]
                inputs[seed + c] = inputs.get(seed + c, 0.0) + values
    return inputs


def _fed(value: Any, feed: Feed, x: Array, count: int) -> Any:
    part = x[..., feed.column] * feed.gain
    if isinstance(feed.rows, slice):
        return value + part
    full = np.zeros((*x.shape[:-1], count))
    full[..., feed.rows] = part
    return value + full


def _gather(array: Array | None, block: Rows, index: Array, rank: int) -> tuple[Any, ...]:
    """Return components (or components of rows) of a per-station quantity at each row."""
    assert array is not None
    epochs = array.shape[-2 - rank]
    epoch = block.epoch if epochs > 1 else np.zeros_like(block.epoch)
    if rank == 1:
        picked = array[..., epoch, index, :]
        return tuple(picked[..., c] for c in range(array.shape[-1]))
    picked = array[..., epoch, index, :, :]
    return tuple(tuple(picked[..., i, c] for c in range(array.shape[-1])) for i in range(array.shape[-2]))


def _ecef(problem: Problem, position: tuple[Any, ...]) -> tuple[Any, ...]:
    turn, origin = problem.frame.rotation_to_ecef(), problem.frame.origin_ecef()
    if problem.frame.kind == "ecef":
        return position
    return tuple(
        sum((float(turn[i, c]) * position[c] for c in range(1, 3)), float(turn[i, 0]) * position[0]) + float(origin[i])
        for i in range(3)
    )

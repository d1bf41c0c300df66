"""How the points of a measurement come out of the parameter vector, as values or with derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.arrays import foreign, gather, library, placed
from optloc.errors import InvalidProblem
from optloc.models import Model, Point
from optloc.models.jet import Jet
from optloc.models.primitives import rotate
from optloc.plan import AXES_A, AXES_B, RATE_A, RATE_B, TARGET, TARGET_RATE, TURN, A, B, Feed, Plan
from optloc.problem import Problem
from optloc.types import Array, Rows


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
    inputs = {seed: placed(value, x) for seed, value in given(problem, plan).items()}
    for feed in plan.feeds:
        inputs[feed.seed] = _fed(inputs.get(feed.seed, 0.0), feed, x, plan.block.count)
    if differentiate:
        fed = {feed.seed for feed in plan.feeds}
        # Arrays of other libraries need not hand arithmetic with a Jet on the right to the Jet: there all are jets.
        for seed in inputs if foreign(x) else fed:
            inputs[seed] = Jet(inputs[seed], {seed: placed(np.ones(1), x)} if seed in fed else {})
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
        if TURN in inputs:
            identity = tuple(tuple(float(i == j) for j in range(d)) for i in range(d))
            own = rotate(own or identity, tuple(inputs[TURN + c] for c in range(1 if d == 2 else 3)))
        return Point(vector(place), vector(rate) if model.velocity else None, own)

    place = vector(TARGET)
    ecef = to_ecef(problem, place) if model.ecef else None
    target = Point(place, vector(TARGET_RATE) if model.velocity else None, None, ecef)
    a = station(A, RATE_A, AXES_A) if model.stations else target
    return target, a, station(B, RATE_B, AXES_B) if model.stations > 1 else a


def given(problem: Problem, plan: Plan) -> dict[int, Any]:
    """Return the inputs that are data, each (..., m): surveyed stations, their rates and axes, known targets."""
    block, model, stations = plan.block, plan.model, problem.stations
    inputs: dict[int, Any] = {}
    for place, rate, axes, index in ((A, RATE_A, AXES_A, block.a), (B, RATE_B, AXES_B, block.b))[: model.stations]:
        inputs |= _at_rows(stations.position, 1, block, index, place)
        if model.velocity and stations.velocity is not None:
            inputs |= _at_rows(stations.velocity, 1, block, index, rate)
        if model.axes and stations.axes is not None:
            inputs |= _at_rows(stations.axes, 2, block, index, axes)
    for i, motion in enumerate(problem.motions):
        rows = np.flatnonzero(block.target == i)
        if motion.known is None or not len(rows):
            continue
        epoch = block.epoch if motion.known.shape[-3] > 1 else np.zeros_like(block.epoch)
        mine = placed(1.0 * (block.target == i), motion.known)
        for seed, order in ((TARGET, 0), (TARGET_RATE, 1)):
            for c in range(problem.dimension if order < motion.known.shape[-2] else 0):
                values = mine * gather(motion.known[..., order, c], epoch)
                inputs[seed + c] = inputs.get(seed + c, 0.0) + values
    return inputs


def _at_rows(array: Array, rank: int, block: Rows, index: Array, seed: int) -> dict[int, Any]:
    """Return the components of a per-station vector (rank 1) or set of axes (rank 2) at each row."""
    epochs, count = array.shape[-2 - rank : -rank]
    joint = library(array).reshape(array, (*array.shape[: -2 - rank], epochs * count, *array.shape[-rank:]))
    picked = gather(joint, index + (count * block.epoch if epochs > 1 else 0), -1 - rank)
    if rank == 1:
        return {seed + c: picked[..., c] for c in range(array.shape[-1])}
    d = range(array.shape[-1])
    return {seed + 3 * i + c: picked[..., i, c] for i in d for c in d}


def _fed(value: Any, feed: Feed, x: Array, count: int) -> Any:
    column, gain = feed.table(count)
    part = gather(x, column)
    return value + (part if np.all(gain == 1.0) else part * placed(gain, x))


def to_ecef(problem: Problem, position: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return a position of the problem's frame as ECEF components of the same type."""
    turn, origin = problem.frame.rotation_to_ecef(), problem.frame.origin_ecef()
    if problem.frame.kind == "ecef":
        return position
    return tuple(
        sum((float(turn[i, c]) * position[c] for c in range(1, 3)), float(turn[i, 0]) * position[0]) + float(origin[i])
        for i in range(3)
    )

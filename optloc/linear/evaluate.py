"""Predicted measurements and their derivatives at a point, for all rows at once.

The indices from unknowns to rows are computed once for each structure. A *block* contains the m rows of one kind. An
*input* is a component of a point of the measurement function h, for instance a coordinate of the target; its *seed* is
its number. Vectors x (..., size) contain all unknowns; a *column* is a position in x.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import factorial
from typing import Any

import numpy as np

from optloc.base.arrays import Portable, as_array_like, gather, is_other_library, library
from optloc.base.cache import Cache
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Bias, Rows
from optloc.linear.courses import elapsed, from_ecef_axes, over_ground, place_and_rate, to_ecef
from optloc.models import MODELS, Model, Point
from optloc.models.medium import Atmosphere
from optloc.models.primitives import Jet, geodetic_normal, rotate, wrap
from optloc.problem.bias import course
from optloc.problem.forms import form_of
from optloc.problem.layout import Layout, emission_name, state_names
from optloc.problem.problem import Problem

# The unknowns that change each input of each row: indices of a problem, computed once for each structure.

# Inputs of a measurement function: target, its rate, both stations, their rates, axes and the rotation of the axes. For
# a course over ground also its start, and the shape of its height with its rate. The numbers are sixteen apart, because
# the largest input, a set of axes, has nine components.
TARGET, TARGET_RATE, A, B, RATE_A, RATE_B, AXES_A, AXES_B, TURN, START, RISE = (16 * i for i in range(11))


@dataclass(frozen=True, slots=True)
class Feed:
    """The contribution of one unknown of each row to an input: ``input += gain * x[column]``.

    Parameters
    ----------
    seed : int
        Number of the input of the measurement function, see TARGET to RISE.
    column : int array (m,)
        Column of the full parameter vector.
    gain : float or array (m,)
        Factor.
    rows : slice or int array
        Rows of the block that have this contribution.
    """

    seed: int
    column: Array
    gain: Any
    rows: Any

    def table(self, count: int) -> tuple[Array, Array]:
        """Return column and factor, each (count,), for all rows of the block.

        The factor is zero for rows without this contribution.
        """
        # Column zero with factor zero for the other rows: a gather needs a valid column.
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
        out: Any = as_array_like(np.zeros(count), x)
        for column, coefficient in self.tables(count):
            out = out + gather(x, column) * as_array_like(coefficient, x)
        return out

    def tables(self, count: int) -> list[tuple[Array, Array]]:
        """Return pairs of column and coefficient, each (count,), whose sum is the terms of all rows of the block."""
        found, left = [], np.arange(len(self.row))
        while left.size:  # a row with several terms has an entry in several tables
            rows, first = np.unique(self.row[left], return_index=True)
            column, coefficient = np.zeros(count, dtype=np.int64), np.zeros(count)
            column[rows], coefficient[rows] = self.column[left[first]], self.coefficient[left[first]]
            found.append((column, coefficient))
            left = np.delete(left, first)
        return found


@dataclass(frozen=True, slots=True)
class BlockLinks:
    """The dependence of one block of rows on the unknowns: measurement = h(inputs) * (1 + gains) + adds.

    Parameters
    ----------
    block : Rows
        The rows.
    model : Model
        Model of their kind.
    feeds : tuple of Feed
        Contributions of unknowns to the inputs of h.
    gains, adds : Terms
        Scale factors; and offsets, drifts and emission times.
    """

    block: Rows
    model: Model
    feeds: tuple[Feed, ...]
    gains: Terms
    adds: Terms


def columns(layout: Layout, name: str, epoch: Array) -> Array:
    """Return the columns (m, size) of the unknown `name` in the full parameter vector, for rows of epochs (m,)."""
    slot, shared = layout.find(name)
    # Local unknowns of epoch k follow those of all earlier epochs.
    base = slot.start + (0 if shared else layout.n_shared + epoch * layout.n_local)
    return np.broadcast_to(np.asarray(base)[..., None] + np.arange(slot.size), (len(epoch), slot.size))


# Links from unknowns to rows, computed once for each structure.

# Greatest number of rows of a problem whose links are cached; the cache has twice this number of rows. Longer problems
# compute their links each time: this takes less time than their rows, and no permanent memory.
_KEPT_ROWS = 4096
_LINKS = Cache[tuple[BlockLinks, ...]](2 * _KEPT_ROWS, lambda kept: sum(links.block.count for links in kept))


def block_links(problem: Problem) -> tuple[BlockLinks, ...]:
    """Return the links of each block of rows, cached by structure unless the problem is long."""
    if problem.count > _KEPT_ROWS:
        return _links_of_all(problem)
    return _LINKS.find(problem.structure, lambda: _links_of_all(problem))


def _links_of_all(problem: Problem) -> tuple[BlockLinks, ...]:
    """Return the links of each block of rows, without the cache."""
    return tuple(_links_of(problem, block, start) for block, start in zip(problem.rows, problem.starts, strict=True))


def _links_of(problem: Problem, block: Rows, start: int) -> BlockLinks:
    """Return the links of one block of rows, whose first row has the number `start`."""
    model = MODELS[block.kind]
    if (block.target < 0).any():
        where = f"{block.kind} row {int(np.argmax(block.target < 0))}"
        raise InvalidProblem("the row names no target", where, "give the index of its target")
    feeds = [*_motion_feeds(problem, block, model), *_station_feeds(problem, block, model)]
    feeds += [*_turn_feeds(problem, block, start), *_course_feeds(problem, block, model, start)]
    gains, adds = _terms(problem, block, start, "scales"), _adds(problem, block, start)
    return BlockLinks(block, model, tuple(feeds), gains, adds)


def _adds(problem: Problem, block: Rows, start: int) -> Terms:
    """Return the offsets, drifts and emission times of a block of rows, as linear terms.

    `start` is the number of the first row of the block.
    """
    parts = [_terms(problem, block, start, "adds")]
    for target in problem.emitting if MODELS[block.kind].emission else ():
        rows = np.flatnonzero(block.target == target)
        column = columns(problem.layout, emission_name(target, len(problem.motions)), block.epoch[rows])
        parts.append(Terms(rows, column[:, 0], np.ones(len(rows))))
    return _append(parts)


def _terms(problem: Problem, block: Rows, start: int, enters: str) -> Terms:
    """Return the linear terms of the biases that enter a block in the way `enters`: "adds" or "scales".

    `start` is the number of the first row of the block.
    """
    parts = [Terms(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))]
    for bias in _entering(problem, enters):
        inside = (bias.row >= start) & (bias.row < start + block.count)
        rows, epoch = bias.row[inside] - start, block.epoch[bias.row[inside] - start]
        own = replace(bias, member=bias.member[inside], coefficient=bias.coefficient[inside])
        entry, factor = form_of(bias).effects(own, problem.times, problem.origin, epoch)
        column = np.take_along_axis(columns(problem.layout, bias.name, epoch), entry, axis=1)
        parts.append(Terms(np.repeat(rows, entry.shape[1]), column.ravel(), factor.ravel()))
    return _append(parts)


def _entering(problem: Problem, enters: str) -> list[Bias]:
    """Return the biases that enter rows in the way `enters`, see `BiasForm`.

    "adds": the bias is added to the measurement. "scales": the measurement is multiplied by one plus the bias. "turns":
    the bias rotates the axes of a station. "moves": the bias is a clock error that shifts a station along its track.
    """
    return [bias for bias in problem.biases if form_of(bias).enters == enters]


def _append(parts: list[Terms]) -> Terms:
    """Return several lists of terms as one."""
    return Terms(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("row", "column", "coefficient"))
    )


def _motion_feeds(problem: Problem, block: Rows, model: Model) -> list[Feed]:
    """Return the contributions of the states of targets to the positions and rates of the targets."""
    feeds, count = [], len(problem.motions)
    for i, motion in enumerate(problem.motions):
        if motion.known is not None or not np.any(block.target == i):
            continue
        rows = slice(None) if np.all(block.target == i) else np.flatnonzero(block.target == i)
        epoch = block.epoch[rows]
        since, ground = elapsed(problem, i)[epoch], over_ground(problem)
        for j, name in enumerate(state_names(i, count, motion.order)):
            column = columns(problem.layout, name, epoch)
            for c in range(problem.dimension):
                # Taylor's polynomial of the course; its derivative contributes to the rate.
                feeds.append(Feed(TARGET + c, column[:, c], since**j / factorial(j), rows))
                if ground and not j:
                    feeds.append(Feed(START + c, column[:, c], 1.0, rows))
                if model.velocity and j:
                    feeds.append(Feed(TARGET_RATE + c, column[:, c], since ** (j - 1) / factorial(j - 1), rows))
    return feeds


def _station_feeds(problem: Problem, block: Rows, model: Model) -> list[Feed]:
    """Return the contributions of station errors to the positions and rates of stations."""
    # Errors of span "noise" are not unknowns: `optloc.linear.normal` adds them to the covariance of rows.
    d, feeds = problem.dimension, []
    for name, _, _ in problem.stations.errors if problem.stations.unknown_for else ():
        rates = name == "station velocities"
        if rates and not model.velocity:
            continue
        column = columns(problem.layout, name, block.epoch)
        places = ((RATE_A, block.a), (RATE_B, block.b)) if rates else ((A, block.a), (B, block.b))
        for seed, station in places[: model.stations]:
            for c in range(d):
                picked = column[np.arange(block.count), station * d + c]
                feeds.append(Feed(seed + c, picked, 1.0, slice(None)))
    return feeds


def _turn_feeds(problem: Problem, block: Rows, start: int) -> list[Feed]:
    """Return the contributions of mount errors (angles, radians) to the rotation of the axes of stations.

    `start` is the number of the first row of the block.
    """
    feeds = []
    for bias in _entering(problem, "turns"):
        left = np.flatnonzero((bias.row >= start) & (bias.row < start + block.count))
        angles = 1 if problem.dimension == 2 else 3
        # a row rotated by several members takes one pass for each, since a feed contains a row only once
        while left.size:
            rows, first = np.unique(bias.row[left] - start, return_index=True)
            entries, left = left[first], np.delete(left, first)
            column = columns(problem.layout, bias.name, rows)
            for c in range(angles):
                picked = column[np.arange(len(rows)), bias.member[entries] * angles + c]
                feeds.append(Feed(TURN + c, picked, bias.coefficient[entries], rows))
    return feeds


def _course_feeds(problem: Problem, block: Rows, model: Model, start: int) -> list[Feed]:
    """Return the contributions of clock errors of moving stations to their positions and rates, to first order.

    A clock error of t seconds shifts a station along its track: the position by velocity times t, and the velocity by
    acceleration times t. `start` is the number of the first row of the block. In a row, the coefficient of the bias is
    +1 for an error of the first station, and -1 for an error of the second.
    """
    feeds: list[Feed] = []
    for bias in _entering(problem, "moves"):
        rates = course(problem)  # velocities and accelerations of the stations, each (k or 1, s, d)
        inside = (bias.row >= start) & (bias.row < start + block.count)
        for sign, station, place, rate in ((1.0, block.a, A, RATE_A), (-1.0, block.b, B, RATE_B)):
            entries = np.flatnonzero(inside & (bias.coefficient == sign))
            rows = bias.row[entries] - start
            column = columns(problem.layout, bias.name, rows)[np.arange(len(rows)), bias.member[entries]]
            epoch = block.epoch[rows] if len(rates[0]) > 1 else np.zeros_like(rows)
            # only kinds that use velocities need the second pair
            for seed, grows in ((place, rates[0]), (rate, rates[1]))[: 1 + model.velocity if len(rows) else 0]:
                picked = grows[epoch, station[rows]]
                feeds += [Feed(seed + c, column, picked[:, c], rows) for c in range(problem.dimension)]
    return feeds


# The points of a measurement from the parameter vector, as values or with derivatives.


def checked_vectors(problem: Problem, x: Array) -> Array:
    """Return the parameter vectors (..., size) unchanged; raise `InvalidProblem` for vectors of another length."""
    size = problem.layout.size
    if x.shape[-1:] != (size,):
        raise InvalidProblem(f"a vector of shape {x.shape} for {size} unknowns", "vector", "order it by problem.layout")
    return x


def points(problem: Problem, links: BlockLinks, x: Array, differentiate: bool) -> tuple[Point, Point, Point]:
    """Return target, first and second station of every row of a block.

    Parameters
    ----------
    problem : Problem
        Problem with the data.
    links : BlockLinks
        Indices of the block.
    x : array (..., size)
        Parameter vectors.
    differentiate : bool
        Whether inputs that depend on unknowns become `Jet` values with derivative one.
    """
    # First data, then contributions of unknowns: an offset of a station is added to its surveyed position.
    inputs = {seed: as_array_like(value, x) for seed, value in given(problem, links).items()}
    for feed in links.feeds:
        inputs[feed.seed] = _add_feed(inputs.get(feed.seed, 0.0), feed, x, links.block.count)
    if isinstance(x, Portable):  # data are computed in the same way as inputs from the vector
        inputs = {seed: np.asarray(value).view(Portable) for seed, value in inputs.items()}
    if differentiate:
        fed = {feed.seed for feed in links.feeds}
        # Arrays of other libraries may not delegate arithmetic to a Jet on the right side; so all inputs become jets.
        for seed in inputs if is_other_library(x) else fed:
            inputs[seed] = Jet(inputs[seed], {seed: as_array_like(np.ones(1), x)} if seed in fed else {})
    return join(problem, links.model, inputs)


def join(problem: Problem, model: Model, inputs: dict[int, Any]) -> tuple[Point, Point, Point]:
    """Return target, first and second station from inputs of any type: arrays, jets or symbols.

    Parameters
    ----------
    problem : Problem
        Problem with dimension and frame.
    model : Model
        Model with the quantities that the points need.
    inputs : dict of seed to number
        Components; a missing one is zero.
    """
    d = problem.dimension

    def vector(seed: int) -> tuple[Any, ...]:
        """Return the d components from `seed` on."""
        return tuple(inputs.get(seed + c, 0.0) for c in range(d))

    def station(place: int, rate: int, axes: int) -> Point:
        """Return a station from the seeds of its position, rate and axes."""
        # Inputs are 16 numbers apart and axes 3: nine numbers of one set of axes fit before the next input.
        own = tuple(vector(axes + 3 * i) for i in range(d)) if axes in inputs else None
        if TURN in inputs:
            identity = tuple(tuple(float(i == j) for j in range(d)) for i in range(d))
            own = rotate(own or identity, tuple(inputs[TURN + c] for c in range(1 if d == 2 else 3)))
        return seen(vector(place), vector(rate) if model.velocity else None, own)

    def seen(place: tuple[Any, ...], rate: tuple[Any, ...] | None, axes: Any = None) -> Point:
        """Return a point with the quantities that the model needs: ECEF position, medium, vertical."""
        medium = problem.medium if model.straight else None
        if not isinstance(medium, Atmosphere):
            return Point(place, rate, axes, to_ecef(problem, place) if model.ecef else None, medium=medium)
        ecef = to_ecef(problem, place)
        return Point(place, rate, axes, ecef, from_ecef_axes(problem, geodetic_normal(ecef)), medium)

    place, rate = vector(TARGET), vector(TARGET_RATE) if model.velocity else None
    if START in inputs:
        place, rate = place_and_rate(
            problem, vector(START), place, rate, (inputs.get(RISE, 0.0), inputs.get(RISE + 1, 0.0))
        )
    target = seen(place, rate)
    # A kind without stations gets the target in place of the stations, which its h does not use.
    a = station(A, RATE_A, AXES_A) if model.stations else target
    return target, a, station(B, RATE_B, AXES_B) if model.stations > 1 else a


def given(problem: Problem, links: BlockLinks) -> dict[int, Any]:
    """Return the inputs that are data, each (..., m): surveyed stations, their rates and axes, known targets."""
    block, model, stations = links.block, links.model, problem.stations
    inputs: dict[int, Any] = {}
    for place, rate, axes, index in ((A, RATE_A, AXES_A, block.a), (B, RATE_B, AXES_B, block.b))[: model.stations]:
        inputs |= _at_rows(stations.position, 1, block, index, place)
        if model.velocity and stations.velocity is not None:
            inputs |= _at_rows(stations.velocity, 1, block, index, rate)
        if model.axes and stations.axes is not None:
            inputs |= _at_rows(stations.axes, 2, block, index, axes)
    for i, motion in enumerate(problem.motions):
        rows = np.flatnonzero(block.target == i)
        if motion.rise is not None and motion.over == "ground" and len(rows):
            for c in range(2 if model.velocity else 1):
                shape = as_array_like(1.0 * (block.target == i), motion.rise) * gather(motion.rise[..., c], block.epoch)
                inputs[RISE + c] = inputs.get(RISE + c, 0.0) + shape
        if motion.known is None or not len(rows):
            continue
        epoch = block.epoch if motion.known.shape[-3] > 1 else np.zeros_like(block.epoch)
        # Each row gets a sum over targets in which only its target has the weight one: some libraries have no scatter.
        mine = as_array_like(1.0 * (block.target == i), motion.known)
        for seed, order in ((TARGET, 0), (TARGET_RATE, 1)):
            for c in range(problem.dimension if order < motion.known.shape[-2] else 0):
                values = mine * gather(motion.known[..., order, c], epoch)
                for place in (seed, START) if over_ground(problem) and not order else (seed,):
                    inputs[place + c] = inputs.get(place + c, 0.0) + values
    return inputs


def _at_rows(array: Array, rank: int, block: Rows, index: Array, seed: int) -> dict[int, Any]:
    """Return the components of a vector (rank 1) or set of axes (rank 2) of the station of each row, by seed.

    `index` (m,) are the station numbers, `seed` is the number of the first component.
    """
    epochs, count = array.shape[-2 - rank : -rank]
    # Epoch and station as one index, so that one table gathers rows of moving stations.
    joint = library(array).reshape(array, (*array.shape[: -2 - rank], epochs * count, *array.shape[-rank:]))
    picked = gather(joint, index + (count * block.epoch if epochs > 1 else 0), -1 - rank)
    if rank == 1:
        return {seed + c: picked[..., c] for c in range(array.shape[-1])}
    d = range(array.shape[-1])
    return {seed + 3 * i + c: picked[..., i, c] for i in d for c in d}


def _add_feed(value: Any, feed: Feed, x: Array, count: int) -> Any:
    """Return the value (..., m) of an input plus the contribution of an unknown; `count` is the number of rows m."""
    column, gain = feed.table(count)
    part = gather(x, column)
    # Most unknowns have the factor one; a product with ones would cost as much as the rest.
    return value + (part if np.all(gain == 1.0) else part * as_array_like(gain, x))


# Values and derivatives of all rows: all rows of a kind together, then the effects of biases.


# At a station, an angle, a ratio or a rate is undefined: the value is NaN, which the callers handle.
_undefined = np.errstate(divide="ignore", invalid="ignore")


@_undefined
def predict(problem: Problem, x: Array) -> Array:
    """Return the predicted measurements h(x) (..., m) of a problem at vectors x (..., size)."""
    values, x, xp = [], checked_vectors(problem, x), library(x)
    for links in block_links(problem):
        value = as_array_like(links.model.h(*points(problem, links, x, differentiate=False)), x)
        value = xp.broadcast_to(value, np.broadcast_shapes(value.shape, (links.block.count,)))
        values.append(_bias(links, x, value)[0])
    return _joined(values)


@_undefined
def differentiate(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return residuals and derivatives of a problem at a point.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size)
        Parameter vectors, ordered by ``problem.layout``, of any array library; the results have the same library.

    Returns
    -------
    residual : array (..., m)
        z - h(x), angles wrapped; zero for absent rows.
    jacobian : array (..., m, n + l)
        Derivatives of h with respect to the shared unknowns and to the local ones of each row's epoch.
    """
    layout, x, xp = problem.layout, checked_vectors(problem, x), library(x)
    width = layout.n_shared + layout.n_local
    batch = np.broadcast_shapes(problem.batch_shape, x.shape[:-1])
    # numpy writes derivatives into one array; other libraries stack columns.
    place = None if is_other_library(x) else np.zeros((*batch, problem.count, width))
    residuals, jacobians = [], []
    for links, block, start in zip(block_links(problem), problem.rows, problem.starts, strict=True):
        m = block.count
        value, terms = _derive(problem, links, x)
        residual = _residual(block, value, links.model.period is not None)
        residuals.append(xp.broadcast_to(residual, (*batch, m)))
        if place is None:
            jacobians.append(_stack(terms, (*batch, m), width, x))
        else:
            _add(terms, place[..., start : start + m, :])
    return _joined(residuals), xp.concat(jacobians, axis=-2) if place is None else place


# Derivatives of a block of m rows: folded column (m,) and coefficient (m,) of each row, times a factor (..., m or 1).
_Terms = list[tuple[Array, Array, Any]]


def _derive(problem: Problem, links: BlockLinks, x: Array) -> tuple[Any, _Terms]:
    """Return the values (..., m) of one block, including biases, and their derivatives as terms."""
    jet, m, fold = (
        links.model.h(*points(problem, links, x, differentiate=True)),
        links.block.count,
        _fold(problem.layout),
    )
    # A kind without unknowns (known targets and stations) has a value without derivatives.
    if not isinstance(jet, Jet):
        jet = Jet(as_array_like(np.asarray(jet), x), {})
    value, gain = _bias(links, x, jet.value)
    terms: _Terms = []
    for feed in links.feeds:
        partial = jet.partials.get(feed.seed)
        if partial is not None:
            column, coefficient = feed.table(m)
            terms.append((fold(column), coefficient, partial if gain is None else partial * gain))
    unit = as_array_like(np.ones(1), x)
    for found, factor in ((links.gains, jet.value), (links.adds, unit)):
        terms += [(fold(column), coefficient, factor) for column, coefficient in found.tables(m)]
    return value, terms


def _fold(layout: Layout) -> Any:
    """Return a function that maps columns of the full vector to columns of the Jacobian.

    The Jacobian has the shared unknowns first, then the local unknowns of the row's epoch.
    """
    n, length = layout.n_shared, layout.n_local

    def fold(column: Array) -> Array:
        """Return the columns of the Jacobian for columns of the full vector."""
        return column if length == 0 else np.where(column < n, column, n + (column - n) % length)

    return fold


def _bias(links: BlockLinks, x: Array, value: Any) -> tuple[Any, Any]:
    """Return the values (..., m) with scales, offsets, drifts and emission times, and the factor that scales them.

    The factor is None if no scale applies.
    """
    m, gain = links.block.count, None
    if links.gains.row.size:
        gain = 1.0 + links.gains.total(x, m)
        value = value * gain
    return value + links.adds.total(x, m) if links.adds.row.size else value, gain


def _residual(block: Rows, value: Any, periodic: bool) -> Any:
    """Return measured minus predicted values of one block; absent rows have the residual zero."""
    residual = as_array_like(block.z - block.correction, value) - value
    residual = wrap(residual) if periodic else residual
    # Absent rows may contain NaN, and zero times NaN is NaN.
    if not is_other_library(block.weight) and np.all(block.weight > 0.0):
        return residual
    return library(residual).where(as_array_like(block.weight, residual) > 0.0, residual, 0.0)


def _add(terms: _Terms, jacobian: Array) -> None:
    """Add derivatives to the block's part of the Jacobian (..., m, n + l)."""
    for column, coefficient, factor in terms:
        # If all rows of the block have the same column (a shared position), a slice is enough; otherwise a scatter is
        # needed.
        if np.all(column == column[:1]):
            jacobian[..., column[0]] += factor if np.all(coefficient == 1.0) else factor * coefficient
            continue
        rows = np.flatnonzero(coefficient)
        picked = factor if factor.shape[-1:] in ((), (1,)) else factor[..., rows]
        jacobian[..., rows, column[rows]] += picked * coefficient[rows]


def _stack(terms: _Terms, shape: tuple[int, ...], width: int, x: Array) -> Any:
    """Return the Jacobian (*shape, width) of a block, column by column: in some libraries arrays cannot be written."""
    columns: dict[int, Any] = {}
    for column, coefficient, factor in terms:
        for j in np.unique(column[coefficient != 0.0]):
            part = factor * as_array_like(np.where(column == j, coefficient, 0.0), x)
            columns[int(j)] = columns[int(j)] + part if int(j) in columns else part
    zero, xp = as_array_like(np.zeros(1), x), library(x)
    return xp.stack([xp.broadcast_to(columns.get(j, zero), shape) for j in range(width)], axis=-1)


def _joined(parts: list[Any]) -> Array:
    """Return arrays (..., m) of blocks of rows as one array."""
    xp = library(parts[0])
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    joined: Array = xp.concat([xp.broadcast_to(part, (*shape, part.shape[-1])) for part in parts], axis=-1)
    return joined

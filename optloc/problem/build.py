"""Build a problem from arrays: `measured` makes rows of one kind, `assemble` joins rows, stations and noise.

Letters: m rows, s stations, k epochs, d coordinates. Leading axes `...` count the problems of a batch. Problems that
differ only in their measured values share checked noise and indices through a cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.arrays import as_deviations, as_integers, numbers
from optloc.base.cache import Cache, key_of
from optloc.base.errors import InvalidProblem
from optloc.base.frames import CARTESIAN, Frame
from optloc.base.types import (
    Amount,
    Amounts,
    AnyOf,
    Array,
    Band,
    Bias,
    Constraint,
    Fence,
    Motion,
    Polygon,
    Prior,
    Rows,
    Stations,
    Whole,
)
from optloc.base.units import Quantity, in_si
from optloc.models import BEARING, MODELS, kind_named
from optloc.models.medium import Medium
from optloc.problem import noise as noises
from optloc.problem.problem import Problem, at_rest
from optloc.problem.signal import Signal
from optloc.problem.validation import check_values, checked


@dataclass(frozen=True, slots=True)
class Measured:
    """Rows of one kind with their noise, as input of `assemble`.

    Parameters
    ----------
    rows : Rows
        The measurements.
    variance : array (..., m), optional
        Independent variance of each row.
    arrival : array (..., s) or (), optional
        Variance of the quantity that each station measures, such as its arrival time. Rows that share a station and an
        epoch are then correlated. It is added to `variance`.
    covariance : array (..., m, m), optional
        Full covariance of these rows.
    signal : Signal, optional
        Signal parameters from which the noise follows.
    """

    rows: Rows
    variance: Array | None = None
    arrival: Array | None = None
    covariance: Array | None = None
    signal: Signal | None = None


@overload
def measured(
    kind: str,
    z: Amounts | None = None,
    *,
    a: Whole | None = None,
    b: Whole | None = None,
    sigma: Amounts,
    arrival_sigma: Amounts | None = None,
    epoch: Whole = 0,
    target: Whole = 0,
    weight: ArrayLike = 1.0,
    correction: Amounts = 0.0,
) -> Measured: ...
@overload
def measured(
    kind: str,
    z: Amounts | None = None,
    *,
    a: Whole | None = None,
    b: Whole | None = None,
    arrival_sigma: Amounts,
    epoch: Whole = 0,
    target: Whole = 0,
    weight: ArrayLike = 1.0,
    correction: Amounts = 0.0,
) -> Measured: ...
@overload
def measured(
    kind: str,
    z: Amounts | None = None,
    *,
    a: Whole | None = None,
    b: Whole | None = None,
    covariance: ArrayLike,
    epoch: Whole = 0,
    target: Whole = 0,
    weight: ArrayLike = 1.0,
    correction: Amounts = 0.0,
) -> Measured: ...
@overload
def measured(
    kind: str,
    z: Amounts | None = None,
    *,
    a: Whole | None = None,
    b: Whole | None = None,
    signal: Signal,
    epoch: Whole = 0,
    target: Whole = 0,
    weight: ArrayLike = 1.0,
    correction: Amounts = 0.0,
) -> Measured: ...
def measured(
    kind: str,
    z: Any = None,
    *,
    a: Any = None,
    b: Any = None,
    sigma: Any = None,
    arrival_sigma: Any = None,
    covariance: Any = None,
    signal: Signal | None = None,
    epoch: Any = 0,
    target: Any = 0,
    weight: Any = 1.0,
    correction: Any = 0.0,
) -> Measured:
    """Return measurements of one kind.

    Parameters
    ----------
    kind : str
        A key of `optloc.models.MODELS`, for instance "tdoa", or one of its aliases.
    z : array (..., m), optional
        Measured values in metres, metres per second, radians or ratios, or texts with a unit such as "20 ns". A time is
        multiplied by the speed of light. None for rows that are simulated later.
    a, b : int array (m,) or int
        Stations of each row, as indices.
    sigma : float, str or array (..., m), optional
        Standard deviation of each row, in SI units or text such as "20 ns". Rows are independent.
    arrival_sigma : float, str or array (..., s), optional
        Standard deviation of the quantity that each station measures, in the unit of z: its arrival time (times c) or
        its range rate. Rows then have the covariance D diag(sigma^2) D'. With `sigma` as well, the two covariances add.
    covariance : array (..., m, m), optional
        Full covariance of these rows. It replaces `sigma` and `arrival_sigma`.
    signal : Signal, optional
        Signal-to-noise ratios, bandwidth and duration that determine the noise of time differences and gain ratios. It
        replaces `sigma`, `arrival_sigma` and `covariance`.
    epoch, target : int array (m,) or int
        Epoch and target of each row.
    weight : float or array (..., m)
        1 for a present row, 0 for an absent one.
    correction : float or array (..., m)
        Known error of the measurement: measured minus modelled.

    Returns
    -------
    Measured
        Input of `assemble`.

    Raises
    ------
    InvalidProblem
        For an unknown kind, for missing stations, or unless exactly one description of the noise is given.
    """
    if str(kind).strip().lower() == BEARING:
        advice = "use optloc.locate(bearings=...), or 'azimuth' in radians from the first axis towards the second"
        raise InvalidProblem("a bearing is in degrees from north, and arrays are in radians", "kind", advice)
    kind = kind_named(kind)
    model = MODELS[kind]
    quantity = cast("Quantity", model.quantity)
    correction = in_si(correction, quantity, "correction")
    z, sigma, arrival_sigma = (
        numbers(in_si(z, quantity, "z"), "z"),
        as_deviations(in_si(sigma, quantity, "sigma", deviation=True), "sigma", kind),
        as_deviations(in_si(arrival_sigma, quantity, "arrival_sigma", deviation=True), "arrival_sigma", kind),
    )
    covariance, weight, correction = (
        numbers(v, name) for v, name in ((covariance, "covariance"), (weight, "weight"), (correction, "correction"))
    )
    integers = ((a, "a"), (b, "b"), (epoch, "epoch"), (target, "target"))
    a, b, epoch, target = (as_integers(v, name) for v, name in integers)
    count = _count(kind, (z, sigma, covariance, a, b, epoch, target, weight, correction), covariance)

    def index(values: Array | None, needed: bool, name: str) -> Array:  # -1: the kind does not use the station
        if needed and values is None:
            raise InvalidProblem(f"{kind} needs station {name}", where=name, advice="give station indices")
        return _filled(values if needed and values is not None else -1, (count,), np.int64)

    def row(values: Array | None) -> Array:  # one value per row; NaN for rows that are simulated later
        return _filled(np.nan, (count,)) if values is None else _filled(values, (*values.shape[:-1], count))

    _check_noise(kind, covariance, signal, sigma is not None or arrival_sigma is not None)
    rows = Rows(
        kind,
        row(z),
        index(a, model.stations > 0, "a"),
        index(b, model.stations > 1, "b"),
        index(epoch, True, "epoch"),
        index(target, True, "target"),
        row(weight),
        row(correction),
    )
    return Measured(
        rows,
        None if sigma is None else row(sigma) ** 2,
        None if arrival_sigma is None else arrival_sigma**2,
        covariance,
        signal,
    )


def _filled(values: Any, shape: tuple[int, ...], dtype: Any = float) -> Array:
    """Return a new array of the given shape with these values: a copy, since callers may change their arrays.

    `values` broadcasts to the shape. `dtype` is the data type of the new array.
    """
    out = np.empty(shape, dtype)
    out[...] = values
    return out


def _check_noise(kind: str, covariance: Any, signal: Any, deviations: bool) -> None:
    """Raise unless the noise is given exactly once: by a covariance, a signal, or standard deviations.

    `deviations` is whether `sigma` or `arrival_sigma` was given.
    """
    if sum((covariance is not None, signal is not None, deviations)) != 1:
        advice = "give covariance, or signal, or sigma, or arrival_sigma, or the last two together"
        raise InvalidProblem(f"the noise of {kind} must be given once", where=kind, advice=advice)
    if signal is not None and not isinstance(signal, Signal):
        raise InvalidProblem(f"it is a {type(signal).__name__}", "signal", "give an optloc.problem.Signal")


def _count(kind: str, given: Sequence[Array | None], covariance: Array | None) -> int:
    """Return the number of rows m of one kind; raise if the arguments have different numbers of rows.

    `given` are all arguments with one value per row, including `covariance`, the covariance (..., m, m) of the rows. A
    scalar or None does not affect the number.
    """
    sizes = [v.shape[-1] for v in given if v is not None and v.ndim]
    # A single number applies to all rows. Without any array there is one row.
    count = max(sizes, default=1)
    if covariance is not None and covariance.shape[-2:] != (count, count):
        raise InvalidProblem(
            f"the covariance of {kind} has shape {covariance.shape}", "covariance", f"give one of {count} x {count}"
        )
    if any(size not in (1, count) for size in sizes):
        raise InvalidProblem(
            f"arguments of {kind} have {sorted(set(sizes))} rows", where=kind, advice="give arrays of equal length"
        )
    return count


def assemble(
    stations: Stations | ArrayLike,
    *measurements: Measured,
    times: Amounts | None = None,
    motions: Sequence[Motion] = (Motion(),),
    biases: Sequence[Bias] = (),
    priors: Sequence[Prior] = (),
    frame: Frame = CARTESIAN,
    covariance: ArrayLike | None = None,
    constraints: Sequence[Constraint | Fence | Sequence[Constraint | Fence]] = (),
    medium: Medium | None = None,
) -> Problem:
    """Return a problem, or a batch of problems if the arrays have leading axes.

    Parameters
    ----------
    stations : Stations, or array (s, d), or array (..., k, s, d)
        Positions in metres.
    *measurements : Measured
        One or more results of `measured`.
    times : array (k,), optional
        Seconds of each epoch; 0, 1, 2 ... by default.
    motions : sequence of Motion
        How each target moves; one static target by default.
    biases : sequence of Bias
        Unknown systematic errors.
    priors : sequence of Prior
        Prior knowledge of named unknowns.
    frame : Frame
        Coordinate frame.
    covariance : array (..., m, m), optional
        Joint covariance of all rows, across kinds. It replaces the noise of the measurements.
    constraints : sequence of Band, Polygon, AnyOf, Fence or tuples of them
        Conditions that the answer must meet, see `optloc.constraints`. A `Fence` is a term of the cost instead.
    medium : Layers or Atmosphere, optional
        Medium of the waves if their speed is not constant. Rows are then measured along rays of the medium.

    Raises
    ------
    InvalidProblem
        If the input is not a valid problem. The message names the argument, row or station.
    """
    if not measurements:
        raise InvalidProblem("there are no measurements", where="measurements", advice="give at least one")
    # Epochs without rows count if a later epoch has rows.
    epochs = 1 + max(int(m.rows.epoch.max(initial=0)) for m in measurements)
    result = Problem(
        stations if isinstance(stations, Stations) else station_array(stations),
        tuple(m.rows for m in measurements),
        noises.Noise(()),
        np.arange(float(epochs)) if times is None else np.asarray(numbers(in_si(times, "time", "times"), "times")),
        tuple(motions),
        tuple(biases),
        tuple(priors),
        frame,
        _listed_constraints(constraints),
    )
    joint = numbers(covariance, "covariance")
    key = _key(result, measurements, joint, medium)
    if key is None:
        return _complete(result, measurements, joint, medium)
    template = _TEMPLATES.find(key, lambda: _template(_complete(result, measurements, joint, medium)))
    for rows in result.rows:
        check_values(rows)
    result = replace(at_rest(result if medium is None else result.in_medium(medium)), noise=template.noise)
    vars(result).update(template.derived)
    return result


def _listed_constraints(given: Any) -> tuple[Any, ...]:
    """Return constraints and fences as one tuple, also of nested sequences; raise InvalidProblem for anything else."""
    if isinstance(given, tuple | list):
        return tuple(one for each in given for one in _listed_constraints(each))
    if not isinstance(given, Band | Polygon | AnyOf | Fence):
        what = f"{type(given).__name__} is no constraint"
        raise InvalidProblem(what, "constraints", "use the functions of optloc.constraints")
    return (given,)


class _Template(NamedTuple):
    """Checked noise and derived indices that problems share if they differ only in their measured values.

    `derived` has the cached properties that `_DERIVED` names, by name.
    """

    noise: noises.Noise
    derived: dict[str, Any]

    @property
    def size(self) -> int:
        """Return the approximate size in numbers, for the limit of the cache.

        The size is 500 for objects, plus the covariances, plus ten per row for the key.
        """
        return 500 + sum(10 * block.row.size + block.covariance.size for block in self.noise.blocks)


# 8 MB of numbers: about 2 000 structures with few rows.
_TEMPLATES = Cache[_Template](2**20, lambda template: template.size)
# Cached properties of a problem. None of them depends on the measured values.
_DERIVED = ("starts", "layout", "batch_shape", "structure")


def _key(problem: Problem, measurements: Sequence[Measured], joint: Array | None, medium: Medium | None) -> Any:
    """Return a cache key of all content of a problem except its measured values; None for large problems.

    `measurements` are the arguments of `assemble`, with the noise of each kind. `joint` is the joint covariance (...,
    m, m) of all rows, if the caller gave one. `medium` is the medium of the waves, or None.
    """
    rows = [(r.kind, r.z.shape, r.a, r.b, r.epoch, r.target, r.weight, r.correction) for r in problem.rows]
    noise = [(m.variance, m.arrival, m.covariance, m.signal) for m in measurements]
    stated = (problem.motions, problem.biases, problem.priors, problem.constraints, problem.fences)
    return key_of(problem.stations, rows, noise, joint, (problem.times, problem.frame, *stated), medium)


def _template(problem: Problem) -> _Template:
    """Return the part of a complete problem that the cache stores."""
    # Copied, because a covariance may be the caller's array.
    noise = noises.Noise(tuple(noises.Block(b.row, np.array(b.covariance)) for b in problem.noise.blocks))
    return _Template(noise, {name: getattr(problem, name) for name in _DERIVED})


def _complete(
    problem: Problem, measurements: Sequence[Measured], joint: Array | None, medium: Medium | None
) -> Problem:
    """Return the problem with its noise and medium; raise InvalidProblem if the input is invalid.

    `measurements` are the arguments of `assemble`. `joint` is the joint covariance (..., m, m) of all rows. If it is
    None, the noise of each kind applies.
    """
    if joint is None:
        parts = zip(measurements, problem.starts, strict=True)
        noise = noises.group([block for m, start in parts for block in _noise(m, start, problem.stations.count)])
    else:
        if joint.shape[-2:] != (problem.count, problem.count):
            raise InvalidProblem(
                f"the joint covariance has shape {joint.shape}",
                "covariance",
                f"give one of {problem.count} x {problem.count}",
            )
        noise = noises.Noise((noises.Block(np.arange(problem.count)[None], joint[..., None, :, :]),))
    problem = replace(problem, noise=noise)
    return checked(problem if medium is None else problem.in_medium(medium))


def station_array(
    position: ArrayLike | Sequence[Sequence[Amount]],
    names: Sequence[str] | None = None,
    *,
    velocity: ArrayLike | None = None,
    axes: ArrayLike | None = None,
) -> Stations:
    """Return stations from arrays of positions, velocities and axes.

    Parameters
    ----------
    position : array (s, d), or (..., k, s, d)
        Metres. The epoch axis k is needed if stations move, or if positions differ between problems.
    names : sequence of s str, optional
        Unique names; S0, S1, ... by default.
    velocity : array (s, d), or (..., k, s, d), optional
        Metres per second. Range rates need it if stations move.
    axes : array (s, d, d), or (..., k, s, d, d), optional
        Axes of each station: the rows of each matrix are unit vectors. Default: the axes of the frame.

    Raises
    ------
    InvalidProblem
        If the positions do not have such a shape, or if values are not numbers.
    """
    array = np.asarray(numbers(in_si(position, "length", "stations", place=True), "stations"))
    if array.ndim < 2 or array.shape[-1] not in (2, 3):
        raise InvalidProblem(
            f"stations have shape {array.shape}", where="stations", advice="give an array (stations, 2 or 3) in metres"
        )
    labels = tuple(names) if names is not None else tuple(f"S{i}" for i in range(array.shape[-2]))
    rates, axes_array = (None if v is None else np.asarray(numbers(v, "stations")) for v in (velocity, axes))
    # For stations at rest the epoch axis has length one.
    return Stations(_dated(array, 2), labels, _dated(rates, 2), _dated(axes_array, 3))


def _dated(array: Any, rank: int) -> Any:
    """Return the array with an epoch axis of length one in front if it has `rank` axes; other input unchanged."""
    return array[None] if array is not None and array.ndim == rank else array


def _noise(m: Measured, start: int, stations: int) -> list[noises.Block]:
    """Return the noise blocks of the rows of one kind.

    `start` is the global number of their first row. `stations` is the number of stations.
    """
    rows = np.arange(start, start + m.rows.count)
    if m.variance is not None and m.arrival is None:
        return [noises.Block(rows[:, None], m.variance[..., None, None])]
    if m.covariance is not None:
        return [noises.Block(rows[None], m.covariance[..., None, :, :])]
    if m.signal is not None:
        return _signal_blocks(m, start, stations, m.signal)
    assert m.arrival is not None
    variance = m.arrival if m.arrival.ndim else np.full(stations, float(m.arrival))
    if variance.shape[-1] != stations:
        raise InvalidProblem(
            f"there are {variance.shape[-1]} values for {stations} stations",
            "arrival_sigma",
            "give one for each station",
        )
    return _arrival_blocks(m, start, variance)


def _signal_blocks(m: Measured, start: int, stations: int, signal: Signal) -> list[noises.Block]:
    """Return one noise block for each epoch and target, from signal-to-noise ratios; arguments as for `_noise`."""
    if len(signal.snr) != stations:
        what = f"there are {len(signal.snr)} signal-to-noise ratios for {stations} stations"
        raise InvalidProblem(what, "signal", "give one for each station, NaN for stations that do not take part")
    rows = m.rows
    groups = noises.group_members(rows.epoch * (rows.target.max(initial=0) + 2) + rows.target)
    return [noises.Block(start + g, signal.covariance(rows.kind, rows.a[g], rows.b[g])) for g in groups]


def _arrival_blocks(m: Measured, start: int, variance: Array) -> list[noises.Block]:
    """Return one noise block for each epoch and target, because its rows combine the same arrivals.

    The block is the covariance of the arrivals plus the independent variance of each row. `start` is the global number
    of the first row. `variance` (..., s) is the variance of the arrival at each station.
    """
    rows, signs = m.rows, MODELS[m.rows.kind].signs
    if signs is None:
        what = f"{rows.kind} is not a sum of measurements of single stations"
        raise InvalidProblem(what, "arrival_sigma", "give sigma or covariance")
    blocks = []
    # Arrivals of different epochs or targets are independent. The key is unique for each pair, and -1 is no target.
    for members in noises.group_members(rows.epoch * (rows.target.max(initial=0) + 2) + rows.target):
        # D diag(sigma^2) D' of these rows: two rows that share a station are correlated, with the product of the two
        # signs.
        covariance = noises.arrivals([(rows.a[members], signs[0]), (rows.b[members], signs[1])], variance)
        if m.variance is not None:
            covariance = covariance + m.variance[..., members, None] * np.eye(members.shape[1])
        blocks.append(noises.Block(start + members, covariance))
    return blocks


problem = assemble

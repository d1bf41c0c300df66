"""One estimation problem: stations, rows, noise and unknowns. It can be a batch of problems with one structure.

Letters: N problems of a flat batch, m rows, s stations, k epochs, d coordinates. `core` is the rank of an array without
batch axes. An array without batch axes is shared by all problems of the batch.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.arrays import as_array_like, library
from optloc.base.cached import cached_property
from optloc.base.errors import InvalidProblem
from optloc.base.frames import CARTESIAN, Frame
from optloc.base.plots import plot_of
from optloc.base.short_form import HasShortForm
from optloc.base.types import (
    AnyOf,
    Array,
    Band,
    Bias,
    CompassRows,
    Constraint,
    Fence,
    Motion,
    Polygon,
    Prior,
    Rows,
    Stations,
)
from optloc.base.units import SI_UNIT
from optloc.models import MODELS, bent
from optloc.models.medium import Atmosphere, Medium, Wind
from optloc.models.phase_layers import S_TOA, PhaseLayers
from optloc.problem.forms import form_of
from optloc.problem.layout import Layout, layout
from optloc.problem.noise import Block, Noise
from optloc.problem.straight_phases import straight_s_rows
from optloc.problem.written import Written

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)  # without slots, because the cached properties need `__dict__`
class Problem(HasShortForm):
    """All data of an estimation problem. Leading axes of its arrays are a batch of independent problems.

    Parameters
    ----------
    stations : Stations
        Positions, velocities and errors of the stations.
    rows : tuple of Rows
        Measurements, one entry for each kind. Global row numbers count through the entries in this order.
    noise : Noise
        Covariance, indexed by global row numbers.
    times : array (k,)
        Seconds of each epoch.
    motions : tuple of Motion
        Motion models, one for each target.
    biases : tuple of Bias
        Unknown systematic errors.
    priors : tuple of Prior
        Gaussian prior knowledge of named unknowns.
    frame : Frame
        Coordinate frame.
    constraints : tuple of Band, Polygon or AnyOf
        Conditions that the answer must meet. A `Fence` among them becomes a member of `fences`.
    medium : Layers or Atmosphere, optional
        Medium of the waves, for rows whose kinds follow bent rays; see `in_medium`.
    fences : tuple of Fence
        Uncertain half-planes, which are terms of the cost.
    written : Written, optional
        Units of the file; None for a problem without a file. They change no number.
    dated : bool
        Whether the times are seconds since 1970, UTC, so that pictures show them as dates.
    """

    stations: Stations
    rows: tuple[Rows, ...]
    noise: Noise
    times: Array
    motions: tuple[Motion, ...] = (Motion(),)
    biases: tuple[Bias, ...] = ()
    priors: tuple[Prior, ...] = ()
    frame: Frame = CARTESIAN
    constraints: tuple[Constraint, ...] = ()
    medium: Medium | None = None
    fences: tuple[Fence, ...] = ()
    written: Written | None = field(default=None, compare=False)
    dated: bool = False

    def __post_init__(self) -> None:
        """Move fences from the constraints to `fences`: users state both in one list."""
        given: tuple[Any, ...] = self.constraints
        stated = tuple(c for c in given if isinstance(c, Fence))
        if stated:
            kept = tuple(c for c in given if not isinstance(c, Fence))
            object.__setattr__(self, "constraints", kept)
            object.__setattr__(self, "fences", (*self.fences, *stated))

    def plot(self, **options: Any) -> Axes:
        """Return a plan in matplotlib axes; see `optloc.show.problem_axes` for the options."""
        return plot_of(self, **options)

    @property
    def dimension(self) -> int:
        """Return the dimension, 2 or 3."""
        return self.stations.dimension

    @property
    def epochs(self) -> int:
        """Return the number of epochs."""
        return len(self.times)

    @property
    def origin(self) -> float:
        """Return the time of zero drift, seconds: the reference time of the first target, or else the first epoch."""
        reference = self.motions[0].reference
        return float(self.times[0] if reference is None else reference)

    @property
    def count(self) -> int:
        """Return the number of rows of all kinds."""
        return sum(block.count for block in self.rows)

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """Return the global number of the first row of each block of rows."""
        counts = [block.count for block in self.rows]
        return tuple(int(n) for n in np.cumsum([0, *counts])[:-1])

    @property
    def emitting(self) -> tuple[int, ...]:
        """Return the numbers of the targets whose emission times are unknown, ascending; -1 for unlabelled rows."""
        # An unlabelled row (-1) has the emission time of a target that is identified later.
        targets = {t for block in self.rows if MODELS[block.kind].emission for t in set(block.target.tolist())}
        return tuple(sorted(targets))

    @cached_property
    def layout(self) -> Layout:
        """Return the layout of the unknowns: the place of each unknown in the parameter vector."""
        # A bias has the unit of the rows that it affects. `layout` has no access to the rows.
        units = [self._unit(bias.row) for bias in self.biases]
        return layout(self.stations, self.motions, self.biases, self.emitting, self.epochs, units)

    def _unit(self, numbers: Array) -> str:
        """Return the SI unit of the rows with these global numbers (n,); empty if they have several units."""
        units = {
            SI_UNIT[MODELS[block.kind].quantity]  # type: ignore[index]  # the table has known quantities only
            for block, start in zip(self.rows, self.starts, strict=True)
            if np.any((numbers >= start) & (numbers < start + block.count))
        }
        return units.pop() if len(units) == 1 else ""

    @property
    def weight(self) -> Array:
        """Return the weights of all rows, (..., m)."""
        return _join([block.weight for block in self.rows])

    @property
    def z(self) -> Array:
        """Return the measured values of all rows, (..., m), without corrections."""
        return _join([block.z for block in self.rows])

    @property
    def correction(self) -> Array:
        """Return the known corrections of all rows, (..., m): measured minus modelled."""
        return _join([block.correction for block in self.rows])

    @property
    def observed(self) -> Array:
        """Return the measured values of all rows minus their known corrections, (..., m), for comparison with h(x)."""
        return _join([block.z - block.correction for block in self.rows])

    @property
    def epoch(self) -> Array:
        """Return the epoch of each row, (m,)."""
        return np.concatenate([block.epoch for block in self.rows] or [np.zeros(0, dtype=np.int64)])

    @cached_property
    def batch_shape(self) -> tuple[int, ...]:
        """Return the batch axes, to which the leading axes of all arrays broadcast."""
        # Most shapes are equal. `numpy.broadcast_shapes` is slow, so it runs only if several shapes differ.
        shapes = {array.shape[: array.ndim - core] for array, core in _arrays(self)} - {()}
        return np.broadcast_shapes(*shapes) if len(shapes) > 1 else next(iter(shapes), ())

    @cached_property
    def structure(self) -> tuple[Any, ...]:
        """Return a hashable key of everything except the numbers. Problems with equal keys share compiled programs.

        The key contains, for instance, the kinds, the stations of each row, the unknowns and the frame.
        """
        rows = tuple((r.kind, r.a.tobytes(), r.b.tobytes(), r.epoch.tobytes(), r.target.tobytes()) for r in self.rows)
        blocks = tuple((b.row.shape, b.row.tobytes()) for b in self.noise.blocks)
        motions = tuple((m.order, m.span, m.known is None, m.reference, *_motion_key(m)) for m in self.motions)
        biases = tuple(
            (b.name, b.members, b.form, b.row.tobytes(), b.member.tobytes(), b.coefficient.tobytes(), *_bias_key(b))
            for b in self.biases
        )
        # Positions, measurements, weights and covariances are not part of the key, because they change between solves.
        s = self.stations
        stations: tuple[Any, ...] = (s.count, self.dimension, s.covariance is None, s.span)
        stations += () if s.velocity_covariance is None else ("velocity errors",)
        # Exception: with a time bias of stations, the velocity of a station is a factor of an unknown.
        if any(form_of(b).enters == "moves" for b in self.biases) and s.velocity is not None:
            stations += (s.position.tobytes(), s.velocity.tobytes())
        # Polygons are not part of the key: cached programs depend on the bands of their edges, which their keys
        # contain.
        constraints = tuple(_constraint_key(c, self.motions) for c in self.constraints if not isinstance(c, Polygon))
        medium: tuple[Any, ...] = () if self.medium is None else (self.medium,)
        fences = (("fences", *(fence.target for fence in self.fences)),) if self.fences else ()
        found = (rows, blocks, motions, biases, stations, self.times.tobytes(), self.frame, constraints)
        return (*found, *medium, *fences)

    def in_medium(self, medium: Medium) -> Problem:
        """Return the problem with its rows measured along the rays of a medium. All positions stay.

        Raises
        ------
        InvalidProblem
            For kinds without a model for bent rays, for a frame that does not fit the medium, and for stations outside
            the medium.
        """
        problem = replace(self, rows=tuple(replace(r, kind=bent(r.kind)) for r in self.rows), medium=medium)
        check_medium(problem)
        return problem

    def straightened(self) -> Problem:
        """Return the problem with straight rays at one speed, as an approximation for the search for starts."""
        if self.medium is None:
            return self
        rows = []
        early = [block for block in self.rows if MODELS[block.kind].straight == "toa"]
        for block in self.rows:
            model = MODELS[block.kind]
            if model.straight == S_TOA and isinstance(self.medium, PhaseLayers):
                rows.append(straight_s_rows(block, early, self.medium))
                continue
            factor = self.medium.straight if model.quantity in ("length", "speed") else 1.0
            straight = replace(
                block, kind=model.straight or block.kind, z=factor * block.z, correction=factor * block.correction
            )
            rows.append(block if model.straight is None else straight)
        return replace(self, rows=tuple(rows), medium=None)

    def flat(self) -> Problem:
        """Return the same problems with exactly one batch axis."""
        shape = self.batch_shape
        if len(shape) == 1:
            return self
        size = int(np.prod(shape))

        def reshape(array: Array, core: int) -> Array:
            """Return the array with one batch axis; unchanged if all problems share it."""
            if array.ndim == core:
                return array
            inner = array.shape[array.ndim - core :]
            return np.broadcast_to(array, (*shape, *inner)).reshape(size, *inner)

        flat = map_numbers(self, reshape)
        return flat if shape else _map_z(flat, lambda z: z[None])

    def placed(self, like: Any) -> Problem:
        """Return the problem with its arrays converted to the library, device and float type of the array `like`."""
        return map_numbers(self, lambda array, core: as_array_like(array, like))

    def take(self, index: Array) -> Problem:
        """Return the problems of a flat batch at these indices or this mask. The structure stays."""
        all_problems = np.arange(self.batch_shape[0])
        numbers = all_problems[index]
        if np.array_equal(numbers, all_problems):
            return self

        def pick(array: Array, core: int) -> Array:
            # A batch axis of length one means that all problems share the values.
            return array if array.ndim == core or array.shape[0] == 1 else array[index]

        taken = map_numbers(self, pick)
        # If no other array has the batch axis, the measurements get it, so that the number of problems is right.
        if taken.batch_shape == (1,):
            taken = _map_z(taken, lambda z: np.broadcast_to(z, (numbers.size, z.shape[-1])))
        return taken

    def with_rows(self, z: Array | None = None, weight: Array | None = None) -> Problem:
        """Return the problem with new measurements or weights of all rows, each (..., m); None keeps the old ones."""
        rows, cut = [], np.cumsum([block.count for block in self.rows])[:-1]
        zs = [block.z for block in self.rows] if z is None else np.split(z, cut, axis=-1)
        weights = [block.weight for block in self.rows] if weight is None else np.split(weight, cut, axis=-1)
        for block, values, importance in zip(self.rows, zs, weights, strict=True):
            rows.append(replace(block, z=values, weight=importance))
        return replace(self, rows=tuple(rows))


def at_rest(problem: Problem) -> Problem:
    """Return the problem with zero station velocities if a row needs velocities and the stations have none.

    All steps from the start to the proof then use the same zeros.
    """
    stations = problem.stations
    if stations.velocity is not None or not any(MODELS[rows.kind].velocity for rows in problem.rows):
        return problem
    return replace(problem, stations=replace(stations, velocity=np.zeros((1, stations.count, problem.dimension))))


def check_medium(problem: Problem) -> None:
    """Raise if the frame does not fit the medium, or if a station is outside it."""
    medium, frame = problem.medium, problem.frame.kind
    if medium is None:
        return
    if isinstance(medium, Wind):
        _check_wind(problem, medium)
        return
    if problem.dimension != 3:
        raise InvalidProblem("a medium needs three dimensions, and the stations have two", "medium", "give z or height")
    if isinstance(medium, Atmosphere):
        if not problem.frame.geodetic:
            advice = "use the frame geodetic, ecef or enu with an origin"
            raise InvalidProblem("an atmosphere needs a frame on Earth", "frame", advice)
        return
    if frame == "ecef":
        advice = 'use the frame "enu" with an origin, or "cartesian"'
        raise InvalidProblem("layers need a frame whose third axis is up", "frame", advice)
    (low, high), height = medium.reach, problem.stations.position[..., 2]
    bad = np.argwhere((height < low) | (height > high))
    if len(bad):
        name, station_height = problem.stations.names[int(bad[0][-1])], height[tuple(bad[0])]
        depths = f"{medium.surface - high:g} to {medium.surface - low:g} m"
        what = f"station {name!r} is at depth {medium.surface - station_height:g} m, and the speeds are for {depths}"
        raise InvalidProblem(what, "stations", "widen the table of speeds, or check the sign of z")


def _check_wind(problem: Problem, wind: Wind) -> None:
    """Raise if the axes of a wind differ from the axes of the frame, or for rows in which the wave goes both ways."""
    if len(wind.velocity) > problem.dimension:
        raise InvalidProblem("the wind has three components, and the stations have two", "wind", "leave out the third")
    if problem.frame.kind == "ecef" and len(wind.velocity) < problem.dimension:
        advice = 'give three components, or use the frame "enu" with an origin'
        raise InvalidProblem("the axes of the frame are not east and north", "wind", advice)
    sums = next((rows.kind for rows in problem.rows if rows.kind.endswith("range_sum")), None)
    if sums is not None:
        raise InvalidProblem("a range sum has no single direction through the wind", "wind", "remove the wind")


# Parts of a structure that few problems have. Problems without them keep the keys of stored simulations.


def _motion_key(motion: Motion) -> tuple[Any, ...]:
    """Return the part of a key that describes a course over ground or a known change of height; () otherwise."""
    return () if motion.over == "space" and motion.rise is None else (motion.over, motion.rise is None)


def _constraint_key(constraint: Band | AnyOf, motions: tuple[Motion, ...]) -> tuple[Any, ...]:
    """Return the part of a key that describes a constraint without its numbers."""
    if isinstance(constraint, AnyOf):
        members = tuple(tuple(_constraint_key(band, motions) for band in member) for member in constraint.members)
        return ("any of", constraint.target, members)
    return (constraint.kind, constraint.target, *_band_key(constraint, motions))


def _band_key(band: Band, motions: tuple[Motion, ...]) -> tuple[Any, ...]:
    """Return the parts of a key for a band along an unknown course, of two targets, or with a table; () otherwise."""
    motion = motions[band.target]
    along = ("along",) if band.along and motion.order and motion.span == "run" else ()
    other = () if band.other is None else ("other", band.other)
    # programs contain the numbers of a table
    return (*along, *other, *(() if band.table is None else ("table", band.table.digest)))


def _bias_key(bias: Bias) -> tuple[Any, ...]:
    """Return the properties of a walk or spline that determine columns: the shape of its densities, and its knots."""
    if bias.density is None and bias.knots is None:
        return ()
    return () if bias.density is None else bias.density.shape, None if bias.knots is None else bias.knots.tobytes()


def _join(parts: list[Array]) -> Array:
    """Return the values of all blocks of rows (..., m) as a new array, in the order of the blocks."""
    if len(parts) == 1 and isinstance(parts[0], np.ndarray):
        return parts[0].copy()  # ten times faster than a concatenation, and also a new array
    xp = library(parts[0])
    if xp is np and all(part.ndim == 1 for part in parts):
        return np.concatenate(parts)  # without broadcasting
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    joined: Array = xp.concat([xp.broadcast_to(part, (*shape, part.shape[-1])) for part in parts], axis=-1)
    return joined


# Numeric arrays of each part of a problem, with their ranks without batch axes. The batch shares all index arrays.
_NUMBERS: dict[type, dict[str, int]] = {
    Stations: {"position": 3, "velocity": 3, "axes": 4, "covariance": 3, "velocity_covariance": 3},
    Rows: {"z": 1, "weight": 1, "correction": 1},
    CompassRows: {"z": 1, "weight": 1, "correction": 1},
    Block: {"covariance": 3},
    Motion: {"known": 3, "rise": 2},
    Prior: {"mean": 1, "covariance": 2},
    Band: {"lower": 0, "upper": 0, "coefficients": 1},
    Fence: {"normal": 1, "offset": 0, "sigma": 0},
    Polygon: {},
}


def _parts(constraint: Constraint) -> tuple[Band | Polygon, ...]:
    """Return the parts of a constraint that have numeric arrays: itself, or the bands of a union."""
    if isinstance(constraint, AnyOf):
        return tuple(band for member in constraint.members for band in member)
    return (constraint,)


def _numbers(part: Any) -> list[tuple[str, Array, int]]:
    """Return name, array and rank without batch axes of each numeric array of a part of a problem."""
    arrays = [(name, getattr(part, name), core) for name, core in _NUMBERS[type(part)].items()]
    return [entry for entry in arrays if entry[1] is not None]


def _arrays(problem: Problem) -> list[tuple[Array, int]]:
    """Return each numeric array of a problem, with its rank without batch axes."""
    blocks = problem.noise.blocks
    limits = tuple(part for constraint in problem.constraints for part in _parts(constraint))
    stated = (*problem.motions, *problem.priors, *limits, *problem.fences)
    parts = (problem.stations, *problem.rows, *blocks, *stated)
    return [(array, core) for part in parts for _, array, core in _numbers(part)]


def map_numbers(problem: Problem, change: Any) -> Problem:
    """Return the problem with every numeric array replaced by ``change(array, rank without batch axes)``.

    Batches are selected, reshaped and moved to other array libraries by this function.
    """

    def changed(part: Any) -> Any:
        if isinstance(part, AnyOf):
            return replace(part, members=tuple(each(member) for member in part.members))
        arrays = [(name, array, change(array, core)) for name, array, core in _numbers(part)]
        numbers = {name: new for name, old, new in arrays if new is not old}
        return replace(part, **numbers) if numbers else part

    def each(parts: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(changed(part) for part in parts)

    return replace(
        problem,
        stations=changed(problem.stations),
        rows=each(problem.rows),
        noise=Noise(each(problem.noise.blocks)),
        motions=each(problem.motions),
        priors=each(problem.priors),
        constraints=each(problem.constraints),
        fences=each(problem.fences),
    )


def spread_over_epochs(c: Constraint, rise: Array | None) -> Constraint:
    """Return a constraint for each epoch; `rise` (..., k, 2) is the known change of height, m, and its rate, m/s."""
    if isinstance(c, Polygon):
        return c
    if isinstance(c, AnyOf):
        spread = [tuple(spread_over_epochs(band, rise) for band in member) for member in c.members]
        return replace(c, members=tuple(spread))  # type: ignore[arg-type]  # bands stay bands
    # the axis of epochs becomes the last batch axis, unless all problems share the numbers
    lower, upper = (bound[..., None] if bound.ndim else bound for bound in (c.lower, c.upper))
    rise_of_height = 0.0 if rise is None or not c.along else rise[..., 0]
    coefficients = c.coefficients if c.coefficients.ndim == 1 else np.expand_dims(c.coefficients, -2)
    return replace(c, lower=lower + rise_of_height, upper=upper + rise_of_height, coefficients=coefficients)


def _map_z(problem: Problem, change: Any) -> Problem:
    """Return the problem with the measured values of each block replaced by ``change(z)``."""
    return replace(problem, rows=tuple(replace(r, z=change(r.z)) for r in problem.rows))

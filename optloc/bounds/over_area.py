"""Maps of the Cramer-Rao bound: the best possible accuracy of a fix, as a function of the target's position.

Letters: nx and ny columns and rows of the grid, n positions, d coordinates, s stations.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.types import Array
from optloc.bounds.cramer_rao import crlb
from optloc.models import MODELS
from optloc.problem.layout import state_names
from optloc.problem.noise import variances
from optloc.problem.problem import Problem

# Positions that are linearised together: enough to hide the overhead of numpy calls, with about ten megabytes for
# hundreds of rows.
_AT_ONCE = 2000
# Latitude, degrees, at which a map ends: a grid of longitude and latitude has no edge at the poles.
_POLE = 89.0
# Latitude, degrees, up to which the cosine scales longitudes; beyond, a side of the map would go around the Earth.
_SQUEEZED = 85.0
_LEAST = (1e-3, 1.0)  # least side of a map, about 100 m in degrees, or 1 m: a single point has no side


@dataclass(frozen=True, slots=True)
class Grid:
    """Positions of a map, at one height.

    Parameters
    ----------
    x, y : array (nx,), (ny,)
        Longitude and latitude in degrees on Earth, else metres of the frame.
    height : float
        Height above the ellipsoid on Earth, else the third coordinate; 0 in the plane; metres.
    places : array (ny nx, d)
        Positions in the frame, metres; x varies fastest.
    slot : slice
        Columns of the position in the shared unknowns.
    stations : array (s, 2)
        Positions of the s stations in the units of x and y.
    names : tuple of s str
        Names of the stations.
    geodetic : bool
        Whether x and y are degrees.
    """

    x: Array
    y: Array
    height: float
    places: Array
    slot: slice
    stations: Array
    names: tuple[str, ...]
    geodetic: bool

    @property
    def shape(self) -> tuple[int, int]:
        """Return the shape (ny, nx) of the grid."""
        return len(self.y), len(self.x)


@dataclass(frozen=True, slots=True)
class BoundMap(Grid):
    """The bound of the position over a grid of positions.

    Parameters
    ----------
    sigma : array (ny, nx)
        Root of the trace of the bound of the position, metres; NaN where the geometry is singular.
    horizontal, vertical : array (ny, nx)
        The same for the horizontal coordinates, and for the height (NaN in the plane).
    row : float
        Root mean square standard deviation of a row, metres; NaN if not all rows are lengths.
    """

    sigma: Array
    horizontal: Array
    vertical: Array
    row: float

    @property
    def dilution(self) -> Array:
        """Return the geometric dilution of precision (ny, nx): the bound over the deviation of a row."""
        return np.asarray(self.sigma / self.row)


def bound_map(
    problem: Problem, truth: Array, x: Array, y: Array, height: float = 0.0, *, geodetic: bool | None = None
) -> BoundMap:
    """Return the Cramer-Rao bound of a target at every point of a grid.

    Noise, station errors and biases are taken from the problem.

    Parameters
    ----------
    problem : Problem
        A single problem with one unknown target; of a batch, the first. Its measurements do not matter.
    truth : array (size,)
        True parameter vector; the points of the grid replace its position.
    x, y : array (nx,), (ny,)
        Longitudes and latitudes in degrees on Earth, else metres of the frame.
    height : float
        Height of the target, metres: above the ellipsoid, or its third coordinate.
    geodetic : bool, optional
        Whether x and y are degrees; by default in three-dimensional frames of the Earth.

    Raises
    ------
    InvalidProblem
        If no target or several targets are unknown, or every epoch of a run has a separate position.
    """
    grid = grid_of(problem, x, y, height, geodetic)
    single = problem.flat().take(np.zeros(1, dtype=int)) if problem.batch_shape else problem
    vectors = np.tile(np.asarray(truth, dtype=float), (len(grid.places), 1))
    vectors[:, grid.slot] = grid.places
    parts = []
    for first in range(0, len(vectors), _AT_ONCE):
        bound = np.asarray(crlb(single, vectors[first : first + _AT_ONCE]))
        parts.append(bound[..., grid.slot, grid.slot])
    covariance = np.concatenate(parts)
    # east, north and up at each position, since the axes of the frame differ from them
    axes = problem.frame.enu_axes(grid.places)
    variance = np.maximum(np.diagonal(axes @ covariance @ np.swapaxes(axes, -1, -2), axis1=-2, axis2=-1), 0.0)
    plan = np.sqrt(variance[:, :2].sum(-1))
    up = np.sqrt(variance[:, 2]) if problem.dimension == 3 else np.full(len(vectors), np.nan)
    return BoundMap(
        **{one.name: getattr(grid, one.name) for one in fields(grid)},
        sigma=np.sqrt(variance.sum(-1)).reshape(grid.shape),
        horizontal=plan.reshape(grid.shape),
        vertical=up.reshape(grid.shape),
        row=_deviation(problem),
    )


def grid_of(problem: Problem, x: Array, y: Array, height: float, geodetic: bool | None = None) -> Grid:
    """Return the grid of a map, with its positions and stations; arguments and exceptions as of `bound_map`."""
    slot = _slot(problem)
    earth = problem.frame.geodetic and problem.dimension == 3 if geodetic is None else geodetic
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    east, north = np.meshgrid(x, y)
    places = _places(problem.frame, east.ravel(), north.ravel(), height, problem.dimension, earth)
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    places_of_stations = map_coordinates(problem.frame, stations, earth)[:, :2]
    if earth:  # a map across the date line has longitudes beyond 180 degrees, so its stations need them too
        places_of_stations[:, 0] = (places_of_stations[:, 0] - np.mean(x) + 180.0) % 360.0 - 180.0 + np.mean(x)
    return Grid(x, y, float(height), places, slot, places_of_stations, problem.stations.names, earth)


def _slot(problem: Problem) -> slice:
    """Return the columns of the position of the unknown target in the shared unknowns.

    Raise InvalidProblem without exactly one unknown target, or if every epoch has a separate position.
    """
    sought = [i for i, motion in enumerate(problem.motions) if motion.known is None]
    advice = "use a file with one unknown target"
    if len(sought) != 1:
        raise InvalidProblem(f"{len(sought)} targets are unknown, and a map needs one", "map", advice)
    motion = problem.motions[sought[0]]
    name = state_names(sought[0], len(problem.motions), motion.order)[0]
    slot, shared = problem.layout.find(name)
    if not shared:
        advice = "give the target a motion, or map one epoch"
        raise InvalidProblem("every epoch has a separate position", "map", advice)
    return slice(slot.start, slot.start + slot.size)


def _places(frame: Frame, x: Array, y: Array, height: float, dimension: int, earth: bool) -> Array:
    """Return grid points as positions (n, d) in the frame, metres.

    x and y (n,) are degrees if `earth` is True, else metres. `height` is in metres, and `dimension` is d.
    """
    if earth:
        return frame.from_geodetic(np.radians(y), np.radians((x + 180.0) % 360.0 - 180.0), np.full(len(x), height))
    return np.stack([x, y, np.full(len(x), height)][:dimension], axis=-1)


def map_coordinates(frame: Frame, position: Array, earth: bool) -> Array:
    """Return positions (n, d) as longitude, latitude (deg) and height (m) if `earth` is True, else unchanged."""
    if not earth:
        return position
    lat, lon, height = frame.to_geodetic(position)
    return np.stack([np.degrees(lon), np.degrees(lat), height], axis=-1)


def _deviation(problem: Problem) -> float:
    """Return the root mean square standard deviation of the rows, metres; NaN if not all rows are lengths."""
    if {MODELS[rows.kind].quantity for rows in problem.rows} != {"length"}:
        return float("nan")
    return float(np.sqrt(np.mean(variances(problem.noise, problem.count))))


def extent(problem: Problem, places: Array | None = None, *, widen: float = 0.5) -> tuple[float, float, float, float]:
    """Return x and y limits around stations and positions (n, d): least and greatest x, least and greatest y.

    Every side is widened by `widen` times the larger side. `places` (n, d) are the positions, None for stations only.
    Limits are degrees in three-dimensional frames of the Earth, else metres.
    """
    earth = problem.frame.geodetic and problem.dimension == 3
    stations = problem.stations.position.reshape(-1, problem.dimension)
    points = stations if places is None else np.concatenate([stations, places])
    flat = map_coordinates(problem.frame, points[np.isfinite(points).all(-1)], earth)[:, :2]
    if earth:  # one interval of longitudes, also across the date line
        flat[:, 0] = (flat[:, 0] - flat[0, 0] + 180.0) % 360.0 - 180.0 + flat[0, 0]
    low, high = flat.min(0), flat.max(0)
    # a degree of longitude is shorter than a degree of latitude by this factor
    squeeze = np.array([np.cos(np.radians(np.clip(flat[:, 1].mean(), -_SQUEEZED, _SQUEEZED))) if earth else 1.0, 1.0])
    side = max(float(((high - low) * squeeze).max()), _LEAST[0] if earth else _LEAST[1])
    low, high = low - widen * side / squeeze, high + widen * side / squeeze
    if earth:
        low[1], high[1] = max(low[1], -_POLE), min(high[1], _POLE)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])

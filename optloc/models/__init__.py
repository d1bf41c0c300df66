"""Measurement kinds: every h(x) is written here, once, elementwise.

The same entry serves numbers (NumPy), symbols (CasADi) and derivatives (Jet). To add a kind, add one entry, or from
another package an entry point of the group ``optloc.models``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache
from math import log, tau
from typing import Any

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.registry import Registry
from optloc.base.units import UNITS
from optloc.models.medium import Atmosphere as Atmosphere, Layers as Layers, arrival, path, path_rate
from optloc.models.primitives import (
    Components,
    Point,
    distance,
    dot,
    geodetic_height,
    local,
    namespace,
    range_rate,
    wrap,
)

__all__ = [
    "BEARING",
    "BETWEEN",
    "MODELS",
    "LiftedRow",
    "Model",
    "Point",
    "distance",
    "kind_named",
    "lifted_row",
    "local",
    "namespace",
    "range_rate",
    "rss_difference",
    "wrap",
]


@dataclass(frozen=True, slots=True)
class LiftedRow:
    """A measurement as a row linear in position and ranges: ``x.position + ra r_a + rb r_b + constant = 0``.

    Parameters
    ----------
    x : tuple of d numbers, or None
        Coefficients of the target's position (1); None where the row has ranges only.
    ra, rb : number
        Coefficients of the ranges to the first and second station.
    constant : number
        Constant term, metres.
    factor : callable of (t, a, b)
        Derivative of the row with respect to the measured value: turns measurement noise into row noise.
    """

    x: Components | None
    ra: Any
    rb: Any
    constant: Any
    factor: Callable[[Point, Point, Point], Any]


@dataclass(frozen=True, slots=True)
class Model:
    """A measurement kind.

    Parameters
    ----------
    h : callable of (t, a, b)
        The measurement of target `t` by stations `a` and `b`, elementwise on `Point` components, SI units and radians.
    quantity : str
        What it measures, a key of `optloc.base.units.UNITS`: "length", "angle", "ratio", "level" (decibels), "speed" or
        "plain" (a number); decides which units a file may use.
    stations : int
        How many stations it takes: 0, 1 or 2.
    summary : str
        One line for listings.
    ranges : (ra, rb), optional
        Set where ``h = ra r_a + rb r_b`` exactly.
    signs : (sa, sb), optional
        Set where ``h = sa q_a + sb q_b`` of something that each station measures by itself: rows that share a station
        share its error (`arrival_sigma`). That of ranges is `ranges`.
    nodes : tuple of (factor, node)
        What a proof takes h for where it is no sum of ranges: ``h = sum of factor phi``, each phi a node
        (`optloc.proof.nodes.node.Node`) or the name of one that optloc has; with `signs`, that of q. Empty: nothing is
        proven of such rows.
    lifted : callable of (m, a, b), optional
        The `LiftedRow` of a measured value m, where there is one that is not a sum of ranges.
    period : float, optional
        Period of an angle, radians; the residual is wrapped.
    ray : callable of (t, a, b), optional
        The measurement along the rays of a medium, which the points carry (`optloc.models.medium`); None where it is
        not known what rays that bend do to it. ``MODELS["ray_" + kind]`` is the kind that is measured so.
    straight : str, optional
        Of a kind along rays: the name of the kind that it is where waves come straight. Starts take that one.
    emission : bool
        True where an unknown emission time (times c, metres) of the epoch is added.
    velocity, axes, ecef : bool
        What the points must carry beyond their position.
    dimensions : tuple of int
        Dimensions in which the kind makes sense.
    aliases : tuple of str
        Other words for the kind, which are read wherever its name is; see `kind_named`.

    Raises
    ------
    InvalidProblem
        For an unknown quantity or a number of stations that no row can name.
    """

    h: Callable[[Point, Point, Point], Any]
    quantity: str
    stations: int
    summary: str
    ranges: tuple[int, int] | None = None
    signs: tuple[int, int] | None = None
    nodes: tuple[tuple[float, Any], ...] = ()
    lifted: Callable[[Any, Point, Point], LiftedRow] | None = None
    period: float | None = None
    ray: Callable[[Point, Point, Point], Any] | None = None
    straight: str | None = None
    emission: bool = False
    velocity: bool = False
    axes: bool = False
    ecef: bool = False
    dimensions: tuple[int, ...] = (2, 3)
    aliases: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.quantity not in UNITS:
            raise InvalidProblem(f"unknown quantity {self.quantity!r}", "quantity", nearest(self.quantity, list(UNITS)))
        if self.stations not in (0, 1, 2):
            raise InvalidProblem(f"a row cannot name {self.stations} stations", "stations", "give 0, 1 or 2")
        if self.signs is None:
            object.__setattr__(self, "signs", self.ranges)


def _azimuth(line: Components) -> Any:
    return namespace(line[1]).atan2(line[1], line[0])


def _elevation(line: Components) -> Any:
    # By both legs: the arcsine of a ratio loses its digits overhead.
    xp = namespace(line[2])
    return xp.atan2(line[2], xp.hypot(line[0], line[1]))


def _height(t: Point, a: Point, b: Point) -> Any:
    assert t.ecef is not None
    return geodetic_height(t.ecef)


def rss_difference(exponent: float = 2.0) -> Model:
    """Return the kind "difference of received signal strengths" for a path-loss exponent.

    Power falls with ``r^-exponent``: ``h = 10 exponent log10(r_b / r_a)`` decibels, positive where a hears more.
    A measured z means ``r_a = 10^(-z / (10 exponent)) r_b``, which is linear in the ranges. The table has the kind for
    free space, 2; values and standard deviations of another exponent n times ``2 / n`` are of that kind.

    Parameters
    ----------
    exponent : float
        Path-loss exponent (1): 2 in free space.

    References
    ----------
    T. S. Rappaport, "Wireless Communications" (2002), eq. 4.67 to 4.69; A. J. Weiss, "On the accuracy of a cellular
    location system based on RSS measurements", IEEE Trans. Veh. Technol. 52 (2003).
    """
    decibels = 10.0 * exponent / log(10.0)

    def h(t: Point, a: Point, b: Point) -> Any:
        ratio = distance(t, b) / distance(t, a)
        return decibels * namespace(ratio).log(ratio)

    def lifted(m: Any, a: Point, b: Point) -> LiftedRow:
        ratio = namespace(m).exp(m / -decibels)
        return LiftedRow(None, 1.0, -1.0 * ratio, 0.0, lambda t, a, b: ratio / decibels * distance(t, b))

    summary = f"difference of received signal strengths, {10.0 * exponent:g} log10(r_b / r_a)"
    nodes = ((-decibels, "log range"),)
    return Model(h, "level", 2, summary, signs=(1, -1), nodes=nodes, lifted=lifted, aliases=("rssd", "drss"))


def _basis(a: Point) -> tuple[Components, ...]:
    if a.axes is not None:
        return a.axes
    d = len(a.position)
    return tuple(tuple(float(i == j) for j in range(d)) for i in range(d))


def _lifted_azimuth(m: Any, a: Point, b: Point) -> LiftedRow:
    xp = namespace(m)
    basis = _basis(a)
    # The normal of the vertical plane through the station that the azimuth names: the target lies in it.
    across = tuple(xp.cos(m) * v - xp.sin(m) * u for u, v in zip(basis[0], basis[1], strict=True))

    def horizontal(t: Point, a: Point, b: Point) -> Any:
        line = local(t, a)
        # An error of the angle moves the row by the horizontal range.
        return -1.0 * namespace(line[0]).hypot(line[0], line[1])

    return LiftedRow(across, 0.0, 0.0, -1.0 * dot(across, a.position), horizontal)


def _lifted_elevation(m: Any, a: Point, b: Point) -> LiftedRow:
    xp = namespace(m)
    up = _basis(a)[2]
    return LiftedRow(
        up, -1.0 * xp.sin(m), 0.0, -1.0 * dot(up, a.position), lambda t, a, b: -1.0 * distance(t, a) * xp.cos(m)
    )


BEARING = "bearing"
"""The word for an azimuth that is a compass bearing wherever nothing else is said: degrees from north, clockwise."""

RAY = "ray_"
"""What the name of a kind begins with that is measured along the rays of a medium."""

# Signs and units are those of files after conversion: metres, radians; a is the first station named.
_KINDS: dict[str, Model] = {
    "tdoa": Model(
        lambda t, a, b: distance(t, a) - distance(t, b),
        "length",
        2,
        "time difference of arrival times c, r_a - r_b",
        ranges=(1, -1),
        ray=lambda t, a, b: path(t, a) - path(t, b),
        aliases=("time_difference", "range_difference", "rdoa", "dtoa"),
    ),
    "groa": Model(
        lambda t, a, b: distance(t, a) / distance(t, b),
        "ratio",
        2,
        "gain ratio of arrival, r_a / r_b",
        nodes=((1.0, "ratio"),),
        lifted=lambda m, a, b: LiftedRow(None, 1.0, -1.0 * m, 0.0, lambda t, a, b: -1.0 * distance(t, b)),
        aliases=("gain_ratio",),
    ),
    "range": Model(
        lambda t, a, b: distance(t, a),
        "length",
        1,
        "range r_a",
        ranges=(1, 0),
        ray=lambda t, a, b: path(t, a),
        # no "rtt": a round trip is two ranges
        aliases=("distance", "twr", "tof", "slant_range", "dme"),
    ),
    "toa": Model(
        lambda t, a, b: distance(t, a),
        "length",
        1,
        "time of arrival times c, r_a plus the epoch's unknown emission time",
        ranges=(1, 0),
        emission=True,
        ray=lambda t, a, b: path(t, a),
        aliases=("pseudorange", "arrival", "arrival_time", "time_of_arrival"),
    ),
    "range_sum": Model(
        lambda t, a, b: distance(t, a) + distance(t, b),
        "length",
        2,
        "bistatic range, r_a + r_b",
        ranges=(1, 1),
        ray=lambda t, a, b: path(t, a) + path(t, b),
        aliases=("bistatic_range", "tsoa"),
    ),
    "azimuth": Model(
        lambda t, a, b: _azimuth(local(t, a)),
        "angle",
        1,
        "azimuth from the station's first axis towards its second",
        nodes=((1.0, "azimuth"),),
        lifted=_lifted_azimuth,
        period=tau,
        axes=True,
        ray=lambda t, a, b: _azimuth(arrival(t, a)),
        aliases=("aoa", "doa", BEARING),
    ),
    "elevation": Model(
        lambda t, a, b: _elevation(local(t, a)),
        "angle",
        1,
        "elevation above the plane of the station's first two axes",
        nodes=((1.0, "elevation"),),
        lifted=_lifted_elevation,
        period=tau,
        axes=True,
        dimensions=(3,),
        ray=lambda t, a, b: _elevation(arrival(t, a)),
        aliases=("elevation_angle",),
    ),
    "height": Model(
        _height,
        "length",
        0,
        "height above the WGS 84 ellipsoid",
        nodes=((1.0, "height"),),
        ecef=True,
        dimensions=(3,),
        aliases=("altitude",),
    ),
    "range_rate": Model(
        lambda t, a, b: range_rate(t, a),
        "speed",
        1,
        "Doppler shift as range rate, r'_a",
        signs=(1, 0),
        nodes=((1.0, "range_rate"),),
        velocity=True,
        ray=lambda t, a, b: path_rate(t, a),
        aliases=("doppler", "radial_velocity"),
    ),
    "fdoa": Model(
        lambda t, a, b: range_rate(t, a) - range_rate(t, b),
        "speed",
        2,
        "frequency difference of arrival as range-rate difference, r'_a - r'_b",
        signs=(1, -1),
        nodes=((1.0, "range_rate"),),
        velocity=True,
        ray=lambda t, a, b: path_rate(t, a) - path_rate(t, b),
        aliases=("frequency_difference",),
    ),
    "rss_difference": rss_difference(),
}


BETWEEN = "station to station"
"""The kind of a distance between two stations, which no target enters: of networks whose stations are unknown."""


class _Unlisted(dict[str, Model]):
    """Kinds that are listed nowhere: those along rays, made of what their names say, and distances of stations."""

    def __missing__(self, name: str) -> Model:
        if name == BETWEEN:
            return Model(lambda t, a, b: distance(a, b), "length", 2, "distance of two stations")
        if not name.startswith(RAY):
            raise KeyError(name)
        return _along_rays(name)


@lru_cache(maxsize=64)
def _along_rays(name: str) -> Model:
    kind = name.removeprefix(RAY)
    model = MODELS[kind]
    if model.ray is None:
        raise KeyError(name)
    # Nothing is linear there, and nothing proven.
    return replace(
        model,
        h=model.ray,
        summary=f"{model.summary}, along the rays of a medium",
        ranges=None,
        signs=model.signs,
        nodes=(),
        lifted=None,
        ray=None,
        straight=kind,
        dimensions=(3,),
        aliases=(),
    )


MODELS: Registry[Model] = Registry("optloc.models", lambda value: isinstance(value, Model), _KINDS, _Unlisted)


def kind_named(word: str, where: str | None = "kind") -> str:
    """Return the kind of measurement that a word stands for: its name, or one of its aliases, in any case.

    Raises
    ------
    InvalidProblem
        For a word that is none, with the kinds whose names or aliases are spelled alike.
    """
    if word in MODELS:
        return word
    folded = str(word).strip().lower().replace("-", "_").replace(" ", "_")
    words = {alias: name for name, model in MODELS.items() for alias in (name, *model.aliases)}
    if folded in words:
        return words[folded]
    raise InvalidProblem(f"unknown kind {word!r}", where, _likely_kind(folded, words))


# Words of the field for quantities that no kind is: differences of angles and of phases, round trips, received power.
_FOREIGN = {"adoa", "pdoa", "poa", "rtt", "rss", "rssi", "csi", "snr"}


def _likely_kind(word: str, words: dict[str, str]) -> str:
    # Spelled alike is not meant alike: slips of the pen are guessed, one letter of four and not the first.
    alike = [known for known in words if known[:1] == word[:1]]
    close = [] if word in _FOREIGN else get_close_matches(word, alike, n=1, cutoff=0.75)
    known = f"known are {', '.join(sorted(MODELS))}; 'optloc list kinds' has their other names"
    return f"did you mean {close[0]!r}? {known}" if close else known


def bent(kind: str) -> str:
    """Return the kind that a kind is along the rays of a medium; the same where it does not depend on waves.

    Raises
    ------
    InvalidProblem
        For kinds of which it is not known what rays that bend do to them.
    """
    model = MODELS[kind]
    if model.straight is not None or not model.stations:
        return kind
    if model.ray is None:
        known = ", ".join(name for name, other in _KINDS.items() if other.ray is not None)
        what = f"what bent rays do to {kind} rows is not known"
        raise InvalidProblem(what, kind, f"leave them out, or the medium; known are {known}")
    return RAY + kind


def lifted_row(model: Model, m: Any, a: Point, b: Point) -> LiftedRow | None:
    """Return the row of a measured value that is linear in position and ranges, or None where there is none.

    Parameters
    ----------
    model : Model
        The measurement kind.
    m : number or array
        Measured value, SI units or radians.
    a, b : Point
        Its stations.
    """
    if model.ranges is not None:
        # Sums of ranges are linear in them as they are; an error of the measurement is one of the row.
        return LiftedRow(None, float(model.ranges[0]), float(model.ranges[1]), -1.0 * m, lambda t, a, b: -1.0)
    return None if model.lifted is None else model.lifted(m, a, b)

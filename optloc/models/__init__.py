"""Measurement kinds: the function h(x) of every kind, written once and elementwise.

The same function works on numbers (NumPy), on symbols (CasADi) and on derivatives (Jet). To add a kind, add an entry to
the table, or declare an entry point of the group ``optloc.models`` in another package.

In all functions, `t` is the target and `a` and `b` are the first and the second station of a row. r_a and r_b are their
ranges to the target, metres, and r'_a and r'_b the range rates, metres per second. A node is one scalar function of the
position of which rows are sums, for instance a range.
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
from optloc.models.medium import Atmosphere as Atmosphere, Layers as Layers, Wind as Wind, arrival, path, path_rate
from optloc.models.phase_layers import S_TOA, PhaseLayers as PhaseLayers, shear_path
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
    """A measurement as an equation linear in position and ranges: ``x.position + ra r_a + rb r_b + constant = 0``.

    The equation is linear if the ranges count as additional unknowns (lifting). Closed-form starts solve such
    equations.

    Parameters
    ----------
    x : tuple of d numbers, or None
        Coefficients of the target's position, without a unit; None if the equation has ranges only.
    ra, rb : number
        Coefficients of the ranges to the first and second station.
    constant : number
        Constant term, metres.
    factor : callable of (t, a, b)
        Derivative of the left side with respect to the measured value. It converts measurement noise to equation noise.
    """

    x: Components | None
    ra: Any
    rb: Any
    constant: Any
    factor: Callable[[Point, Point, Point], Any]


@dataclass(frozen=True, slots=True)
class Model:
    """A measurement kind: its function h(x) and its properties.

    Parameters
    ----------
    h : callable of (t, a, b)
        The measurement of target `t` by stations `a` and `b`, elementwise on `Point` components, SI units and radians.
    quantity : str
        Physical quantity of the measurement, a key of `optloc.base.units.UNITS`: "length", "angle", "ratio", "level"
        (decibels), "speed" or "plain" (a number). It decides which units a file may use.
    stations : int
        Number of stations of a row: 0, 1 or 2.
    summary : str
        One line for listings.
    ranges : (ra, rb), optional
        Given if ``h = ra r_a + rb r_b`` exactly.
    signs : (sa, sb), optional
        Given if ``h = sa q_a + sb q_b``, where each station measures one q. Rows that share a station then share its
        error (`arrival_sigma`). Default: `ranges`.
    nodes : tuple of (factor, node)
        Form of h in proofs if it is not a sum of ranges: ``h`` is the sum of ``factor phi`` over the nodes phi. Each
        phi is a node (`optloc.proof.nodes.node.Node`) or the name of a node of optloc. With `signs` the sum is q
        instead of h. Empty: proofs do not cover rows of this kind.
    lifted : callable of (m, a, b), optional
        Function that returns the `LiftedRow` of a measured value m. Only kinds that are not a sum of ranges need it.
    period : float, optional
        Period of an angle, radians, with which the residual is wrapped.
    ray : callable of (t, a, b), optional
        The measurement along the rays of a medium, which the points contain (`optloc.models.medium`). None: there is no
        model for bent rays. ``MODELS["ray_" + kind]`` is the kind with this measurement.
    straight : str, optional
        For a kind along rays: the name of the same kind with straight rays, from which the search for a solution
        starts.
    emission : bool
        Whether an unknown emission time of the epoch (times c, metres) is added.
    velocity, axes, ecef : bool
        Whether points need a velocity, axes or ECEF coordinates.
    dimensions : tuple of int
        Dimensions in which the kind is defined.
    aliases : tuple of str
        Other names of the kind, which are accepted everywhere; see `kind_named`.

    Raises
    ------
    InvalidProblem
        For an unknown quantity, or a number of stations other than 0, 1 or 2.
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
        """Check the fields, and use `ranges` as the default of `signs`."""
        if self.quantity not in UNITS:
            raise InvalidProblem(f"unknown quantity {self.quantity!r}", "quantity", nearest(self.quantity, list(UNITS)))
        if self.stations not in (0, 1, 2):
            raise InvalidProblem(f"a row cannot have {self.stations} stations", "stations", "give 0, 1 or 2")
        if self.signs is None:
            object.__setattr__(self, "signs", self.ranges)


def _azimuth(line: Components) -> Any:
    """Return the azimuth of a line of sight, radians from the first axis towards the second."""
    return namespace(line[1]).atan2(line[1], line[0])


def _elevation(line: Components) -> Any:
    """Return the elevation of a line of sight above the plane of the first two axes, radians."""
    # By the arctangent, because the arcsine of a ratio loses digits near the zenith.
    xp = namespace(line[2])
    return xp.atan2(line[2], xp.hypot(line[0], line[1]))


def _height(t: Point, a: Point, b: Point) -> Any:
    """Return the height of the target above the WGS 84 ellipsoid, metres."""
    assert t.ecef is not None
    return geodetic_height(t.ecef)


def rss_difference(exponent: float = 2.0) -> Model:
    """Return the kind "difference of received signal strengths" for a path-loss exponent.

    Received power is proportional to ``r^-exponent``. The measurement is ``h = 10 exponent log10(r_b / r_a)`` decibels,
    positive if station a receives more. A measured z means ``r_a = 10^(-z / (10 exponent)) r_b``, which is linear in
    the ranges. The table contains this kind for free space, exponent 2. To use it for an exponent n, multiply the
    values and standard deviations by ``2 / n``.

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
        """Return the measurement, decibels."""
        ratio = distance(t, b) / distance(t, a)
        return decibels * namespace(ratio).log(ratio)

    def lifted(m: Any, a: Point, b: Point) -> LiftedRow:
        """Return the equation ``r_a - ratio r_b = 0`` of a measured value m, decibels."""
        ratio = namespace(m).exp(m / -decibels)
        return LiftedRow(None, 1.0, -1.0 * ratio, 0.0, lambda t, a, b: ratio / decibels * distance(t, b))

    summary = f"difference of received signal strengths, {10.0 * exponent:g} log10(r_b / r_a)"
    nodes = ((-decibels, "log range"),)
    return Model(h, "level", 2, summary, signs=(1, -1), nodes=nodes, lifted=lifted, aliases=("rssd", "drss"))


def _axes_of(a: Point) -> tuple[Components, ...]:
    """Return the axes of a station: d unit vectors in the problem's frame; the axes of the frame if none are stated."""
    if a.axes is not None:
        return a.axes
    d = len(a.position)
    return tuple(tuple(float(i == j) for j in range(d)) for i in range(d))


def _lifted_azimuth(m: Any, a: Point, b: Point) -> LiftedRow:
    """Return the equation of a measured azimuth m, radians: the target is in a vertical plane through the station."""
    xp = namespace(m)
    axes = _axes_of(a)
    # Normal of the vertical plane through the station at this azimuth. The target is in this plane, so the equation is
    # across . (position - station) = 0.
    across = tuple(xp.cos(m) * v - xp.sin(m) * u for u, v in zip(axes[0], axes[1], strict=True))

    def horizontal(t: Point, a: Point, b: Point) -> Any:
        """Return the derivative of the equation with respect to the azimuth: minus the horizontal range, metres."""
        line = local(t, a)
        # An error of the angle changes the equation by error times horizontal range.
        return -1.0 * namespace(line[0]).hypot(line[0], line[1])

    return LiftedRow(across, 0.0, 0.0, -1.0 * dot(across, a.position), horizontal)


def _lifted_elevation(m: Any, a: Point, b: Point) -> LiftedRow:
    """Return the equation of a measured elevation m, radians: height above the station = sin(m) times range."""
    xp = namespace(m)
    up = _axes_of(a)[2]
    return LiftedRow(
        up, -1.0 * xp.sin(m), 0.0, -1.0 * dot(up, a.position), lambda t, a, b: -1.0 * distance(t, a) * xp.cos(m)
    )


BEARING = "bearing"
"""Name for an azimuth that is by default a compass bearing: in degrees, clockwise from north."""

RAY = "ray_"
"""Prefix of the names of kinds that are measured along the rays of a medium."""

# Signs and units are those after conversion: metres and radians; a is the first named station.
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
        # Not "rtt", because a round trip is two ranges.
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
"""Name of the kind for a distance between two stations, without a target, in networks with unknown stations."""


_S_TOA = Model(
    lambda t, a, b: distance(t, a),
    "length",
    1,
    "time of arrival of an S wave times the speed of P waves, in layers with two speeds",
    emission=True,
    ray=lambda t, a, b: shear_path(t, a),
)


class _DerivedKinds(dict[str, Model]):
    """Table of kinds that are not listed: kinds along rays, made from their names, and distances between stations."""

    def __missing__(self, name: str) -> Model:
        """Return the kind with this name; raise KeyError if the name is not a derived kind."""
        if name == BETWEEN:
            return Model(lambda t, a, b: distance(a, b), "length", 2, "distance of two stations")
        if name == S_TOA:
            return _S_TOA
        if not name.startswith(RAY):
            raise KeyError(name)
        return _along_rays(name)


@lru_cache(maxsize=64)
def _along_rays(name: str) -> Model:
    """Return the kind "ray_...", measured along the rays of a medium; raise KeyError without a model for bent rays."""
    kind = name.removeprefix(RAY)
    model = MODELS[kind]
    if model.ray is None:
        raise KeyError(name)
    # Kinds along rays have no linear form, and proofs do not cover them.
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
        aliases=(),
    )


MODELS: Registry[Model] = Registry("optloc.models", lambda value: isinstance(value, Model), _KINDS, _DerivedKinds)


def kind_named(word: str, where: str | None = "kind") -> str:
    """Return the name of the measurement kind for a word: a name or an alias, in upper or lower case.

    Raises
    ------
    InvalidProblem
        For an unknown word; the message lists similar names and all kinds.
    """
    if word in MODELS:
        return word
    folded = str(word).strip().lower().replace("-", "_").replace(" ", "_")
    words = {alias: name for name, model in MODELS.items() for alias in (name, *model.aliases)}
    if folded in words:
        return words[folded]
    raise InvalidProblem(f"unknown kind {word!r}", where, _likely_kind(folded, words))


# Terms for quantities that are not kinds of optloc: differences of angles and phases, round trips, received power.
_FOREIGN = {"adoa", "pdoa", "poa", "rtt", "rss", "rssi", "csi", "snr"}


def _likely_kind(word: str, words: dict[str, str]) -> str:
    """Return advice for an unknown kind: a likely correction, and the known kinds.

    `words` maps each name and alias to the name of its kind.
    """
    # Only a likely typing error is corrected: one letter of four, not the first. Other similar words have other
    # meanings.
    alike = [known for known in words if known[:1] == word[:1]]
    close = [] if word in _FOREIGN else get_close_matches(word, alike, n=1, cutoff=0.75)
    known = f"known are {', '.join(sorted(MODELS))}; 'optloc list kinds' has their other names"
    return f"did you mean {close[0]!r}? {known}" if close else known


def bent(kind: str) -> str:
    """Return the kind along the rays of a medium for a kind; the same name if the kind does not depend on waves.

    Raises
    ------
    InvalidProblem
        For kinds without a model for bent rays.
    """
    model = MODELS[kind]
    if model.straight is not None or not model.stations:
        return kind
    if model.ray is None:
        known = ", ".join(name for name, other in _KINDS.items() if other.ray is not None)
        what = f"{kind} rows have no model for bent rays"
        raise InvalidProblem(what, kind, f"leave out these rows or the medium; kinds with a model are {known}")
    return RAY + kind


def lifted_row(model: Model, m: Any, a: Point, b: Point) -> LiftedRow | None:
    """Return the equation of a measured value that is linear in position and ranges; None if it does not exist.

    Parameters
    ----------
    model : Model
        The measurement kind.
    m : number or array
        Measured value, SI units or radians.
    a, b : Point
        Stations of the row.
    """
    if model.ranges is not None:
        # A sum of ranges is already linear. An error of the measurement is an error of the equation.
        return LiftedRow(None, float(model.ranges[0]), float(model.ranges[1]), -1.0 * m, lambda t, a, b: -1.0)
    return None if model.lifted is None else model.lifted(m, a, b)

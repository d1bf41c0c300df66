"""Speeds of P and S waves in the ground: two numbers, or a table of layers.

If the ratio of the two speeds is one number for all layers, as in HYPO71 (W. H. K. Lee, J. C. Lahr, USGS Open-File
Report 75-311, 1975), P and S waves follow the same rays. Otherwise each wave has its own rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from pathlib import Path

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.columns import stem, unit_of
from optloc.files.csv_formats import read_table
from optloc.files.roles import ColumnPlaces
from optloc.files.settings import Units
from optloc.files.table import Table
from optloc.files.table_import import ColumnHints
from optloc.models.layers import Layers
from optloc.models.phase_layers import PhaseLayers

# Relative spread of vp / vs in a table up to which its mean is used in all layers: the rounding of two decimals.
_EQUAL = 0.005
# Usual ratio vp / vs of rock, the square root of 3, for an advice.
_USUAL = 1.73
# The surface of the layers is rounded up to this step, so that no station is above it by rounding, metres.
_STEP = 100.0


@dataclass(frozen=True, slots=True)
class Crust:
    """Speeds of P and S waves.

    Parameters
    ----------
    vp_vs : float, optional
        Speed of P waves divided by the speed of S waves, on average over layers; None if only P waves are known.
    speed : float, optional
        Speed of P waves, m/s; None with layers.
    depths, speeds : tuple of float
        Tops of layers, metres below the sea, and their speeds of P waves, m/s.
    note : str
        Description for the user.
    s_speeds : tuple of float
        Speeds of S waves of the layers, m/s, if their ratio differs between layers; else empty.
    """

    vp_vs: float | None
    speed: float | None
    depths: tuple[float, ...] = ()
    speeds: tuple[float, ...] = ()
    note: str = ""
    s_speeds: tuple[float, ...] = ()

    @property
    def ratio(self) -> str:
        """Return the value of the key `vp_vs` of a problem file."""
        return '"layers"' if self.s_speeds else repr(self.vp_vs)

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the line of a problem file that states the speed of P waves; none with layers."""
        return () if self.speed is None else (f"propagation_speed = {self.speed!r}",)

    def frame(self, places: ColumnPlaces) -> tuple[str, ...]:
        """Return the lines of a frame whose third axis is the height, which layers need; none without layers.

        The origin is at sea level, at the mean of the stations.
        """
        if self.speed is not None or places.frame != "geodetic":
            return ()
        lat, lon = (round(float(places.columns[key].mean()), 4) for key in ("lat_deg", "lon_deg"))
        return ('kind = "enu"', f"origin = {{ lat_deg = {lat!r}, lon_deg = {lon!r}, height = 0.0 }}")

    def medium(self, highest: float) -> tuple[str, ...]:
        """Return the lines of a problem file for the layers; none without layers.

        The first layer extends upwards to all stations; `highest` is the height of the highest, metres.
        """
        if self.speed is not None:
            return ()
        layers = self.layers(highest)
        slow = (f"s_speeds = {[*self.s_speeds]!r}",) if self.s_speeds else ()
        return (
            "", "[medium]", 'kind = "layers"', f"depths = {[*layers.depth]!r}", f"speeds = {[*layers.speed]!r}", *slow,
            'between = "constant"', f"surface = {layers.surface!r}",
        )  # fmt: skip

    def layers(self, highest: float) -> Layers:
        """Return the layers as a medium; the first extends upwards to all stations, the highest at `highest` metres."""
        surface = _STEP * ceil(max(highest, -self.depths[0]) / _STEP + 0.5)
        depths = (0.0, *(depth + surface for depth in self.depths[1:]))
        if self.s_speeds:
            return PhaseLayers(depths, self.speeds, "constant", surface, None, self.s_speeds)
        return Layers(depths, self.speeds, "constant", surface)


def crust_of(hints: ColumnHints, *, with_s: bool) -> Crust:
    """Return the speeds that --vp and --vs state; `with_s` is whether there are S waves.

    Raise InvalidProblem for a missing speed, and for P waves that are not faster than S waves.
    """
    if hints.vp is None:
        advice = "state both, such as --vp '6 km/s' --vs '3.5 km/s', or a table of layers with --vp crust.csv"
        raise InvalidProblem("the speeds of the P and S waves are unknown", "--vp", advice)
    if Path(hints.vp).suffix.lower() in (".csv", ".tsv", ".txt"):
        return _of_table(Path(hints.vp), hints, with_s)
    vp = _speed(hints.vp, "--vp")
    if not with_s:
        return Crust(None, vp, note=f"P waves have {vp:.6g} m/s (straight rays)")
    if hints.vs is None:
        advice = f"state it; vp / 1.73 is {vp / _USUAL:.0f} m/s"
        raise InvalidProblem("the speed of the S waves is unknown", "--vs", advice)
    vs = _speed(hints.vs, "--vs")
    _check(vp, vs, "--vs")
    note = f"P waves have {vp:.6g} m/s and S waves {vs:.6g} m/s (straight rays), with one origin time"
    return Crust(vp / vs, vp, note=note)


def _speed(given: str, where: str) -> float:
    """Return a speed, m/s; raise InvalidProblem for a speed that is not positive."""
    value = Units("speed").plain(given, None, where)
    if not value > 0.0:
        raise InvalidProblem(f"the speed {given} is not positive", where, "write it as '6 km/s'")
    return value


def _check(vp: float, vs: float, where: str) -> None:
    """Raise InvalidProblem unless 0 < vs < vp."""
    if not 0.0 < vs < vp:
        raise InvalidProblem(f"P waves of {vp:g} m/s are not faster than S waves of {vs:g} m/s", where, "correct it")


def _of_table(path: Path, hints: ColumnHints, with_s: bool) -> Crust:
    """Return the layers of a table with columns for depth, vp and optionally vs, which --vs replaces."""
    table = read_table(path)
    depth = _column(table, "depth", "length")
    vp = _column(table, "vp", "speed")
    if depth is None or vp is None:
        what = f"the columns {', '.join(table.columns)} lack a depth or vp"
        raise InvalidProblem(what, path.name, "name the columns 'depth km', 'vp km/s' and 'vs km/s'")
    if (np.diff(depth) <= 0.0).any() or (vp <= 0.0).any():
        raise InvalidProblem("depths must increase, and speeds must be positive", path.name, "correct the table")
    vs = _column(table, "vs", "speed")
    note = f"{len(depth)} layers of {path.name}, P waves of {vp.min():.6g} to {vp.max():.6g} m/s"
    if not with_s:
        return Crust(None, None, tuple(depth.tolist()), tuple(vp.tolist()), note)
    if hints.vs is not None:
        ratio, more = _stated_ratio(hints.vs), ""
    elif vs is None:
        advice = "add a column 'vs km/s', or state the ratio of both speeds, such as --vs 'vp/1.73'"
        raise InvalidProblem("the speed of the S waves is unknown", path.name, advice)
    else:
        for one, other in zip(vp.tolist(), vs.tolist(), strict=True):
            _check(one, other, path.name)
        ratio = float((vp / vs).mean())
        low, high = float((vp / vs).min()), float((vp / vs).max())
        if high / low - 1.0 > _EQUAL:
            note += f"; vp / vs is {low:.4g} to {high:.4g}, so P and S waves have separate rays"
            return Crust(ratio, None, tuple(depth.tolist()), tuple(vp.tolist()), note, tuple(vs.tolist()))
        more = ""
    return Crust(ratio, None, tuple(depth.tolist()), tuple(vp.tolist()), f"{note}; vp / vs = {ratio:.4g}{more}")


def _stated_ratio(given: str) -> float:
    """Return the ratio vp / vs of a text such as "vp/1.73"; raise InvalidProblem for another text."""
    head, sign, number = given.replace(" ", "").lower().partition("/")
    try:
        ratio = float(number) if sign and head == "vp" else 0.0
    except ValueError:
        ratio = 0.0
    if not 1.0 < ratio < np.inf:
        raise InvalidProblem(f"{given!r} is not a ratio of P to S in layers", "--vs", "write --vs 'vp/1.73'")
    return ratio


def _column(table: Table, name: str, quantity: str) -> Array | None:
    """Return a column of the table in SI units, by the start of its name; None without it.

    Raise InvalidProblem if the name has no unit.
    """
    known = UNITS[quantity]  # type: ignore[index]  # "length" and "speed" are quantities
    # "vp_km_s" is a usual spelling, because a slash is not valid in names of variables.
    spelled = {column: column.replace("km_s", "km/s").replace("m_s", "m/s") for column in table.columns}
    found = next((column for column, text in spelled.items() if stem(text) == name), None)
    if found is None:
        return None
    unit = unit_of(spelled[found], known)
    if unit is None:
        example = "depth km" if quantity == "length" else f"{name} km/s"
        raise InvalidProblem(f"the unit of the column {found!r} is unknown", table.source, f"name it {example!r}")
    return np.asarray(table.numbers(found) * known[unit])

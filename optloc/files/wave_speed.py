"""Statements of the wave speed: texts such as "air:20C", tables of a profile, and options of the command line.

Texts are the values of the option ``--wave-speed``, of the key ``propagation_speed`` in files, and of the argument
``wave_speed`` in Python.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.sound import sound_in_air, sound_in_water
from optloc.base.types import Array
from optloc.base.units import LARGEST, SPEED_OF_LIGHT, UNITS, Quantity
from optloc.files.columns import stem, unit_of
from optloc.files.csv_formats import read_table
from optloc.files.schema import DataTable, MediumTable, ProblemFile
from optloc.files.settings import Units, join
from optloc.files.table import Table, table_of

FORMS = '"343 m/s", "343+-5 m/s", "air:20C", "air:20C,50%", "water:8C,35,50m", "profile.csv" or "light"'
"""Examples of all forms of a wave speed, for messages."""

_LIGHT = "light"
# Endings of tables with a profile of the speed.
_PROFILES = (".csv", ".tsv", ".txt", ".parquet")
_AMOUNT = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
_UNCERTAIN = re.compile(r"\s*(?:±|\+/?-)\s*")
# Names of the columns of a profile, in the form of `stem`.
_DEPTHS, _HEIGHTS = ("depth", "d"), ("height", "z", "altitude", "alt", "elevation", "h")
_SPEEDS = ("speed", "c", "soundspeed", "velocity", "soundvelocity", "v", "vp", "wavespeed", "svel", "ss")


@dataclass(frozen=True, slots=True)
class StatedSpeed:
    """A stated wave speed.

    speed: metres per second. sigma: its standard deviation, or None. words: description for reports.
    """

    speed: float
    sigma: float | None
    words: str


@dataclass(frozen=True, slots=True)
class WaveOptions:
    """Options of the command line on the wave and on the times.

    Parameters
    ----------
    speed : str, optional
        Wave speed, as for `stated_speed`, or the file of a profile.
    wind : str, optional
        Velocity of the medium, as for `wind_of`.
    two_way : bool
        Whether ranges are times of the way there and back.
    turn_around : str, optional
        Time between arrival and reply at the other end, such as "2 ms".
    """

    speed: str | None = None
    wind: str | None = None
    two_way: bool = False
    turn_around: str | None = None

    @property
    def stated(self) -> str:
        """Return the name of the first stated option; empty if none is stated."""
        given = {
            "--wave-speed": self.speed, "--wind": self.wind, "--two-way": self.two_way,
            "--turn-around": self.turn_around,
        }  # fmt: skip
        return next((name for name, value in given.items() if value), "")


def is_profile(text: Any) -> bool:
    """Return whether a stated speed is the name of a table."""
    return isinstance(text, str) and text.strip().lower().endswith(_PROFILES)


# Units of a text that states a temperature without its medium.
_TEMPERATURES = ("C", "°C", "degC")


def stated_speed(text: str, where: str) -> StatedSpeed:
    """Return the wave speed of a text.

    Parameters
    ----------
    text : str
        An amount with or without a standard deviation (``"343 m/s"``, ``"343+-5 m/s"``); ``"light"``; air with its
        temperature and relative humidity (``"air:20C"``, ``"air:20C,50%"``); or water with temperature, salinity in
        g/kg and depth (``"water:8C,35,50m"``). An amount without a unit is in metres per second.
    where : str
        Place for messages.

    Raises
    ------
    InvalidProblem
        For another text, and for values outside the range of validity of a formula.
    """
    name, colon, rest = text.strip().partition(":")
    if colon and name.strip().lower() in _MEDIA:
        parts = [part.strip() for part in rest.split(",")]
        try:
            return _MEDIA[name.strip().lower()](parts, text, where)
        except InvalidProblem as error:
            raise InvalidProblem(error.what, where, error.advice) from None
    if colon:
        raise InvalidProblem(f"there is no medium {name!r}", where, nearest(name, list(_MEDIA)))
    if name.lower() == _LIGHT:
        return StatedSpeed(SPEED_OF_LIGHT, None, f"{SPEED_OF_LIGHT:.9g} m/s, light")
    value, *sigmas = _UNCERTAIN.split(text.strip())
    if len(sigmas) > 1:
        raise InvalidProblem(f"{text!r} has two standard deviations", where, "write it as 343+-5 m/s")
    units = [_AMOUNT.fullmatch(part) for part in (value, *sigmas)]
    unit = next((match[2] for match in units if match and match[2] and match[2] != "%"), None)
    speed = _positive(value, unit, text, where)
    if not sigmas:
        return StatedSpeed(speed, None, f"{speed:.9g} m/s")
    percent = sigmas[0].endswith("%")
    sigma = _positive(sigmas[0].removesuffix("%"), None if percent else unit, text, where)
    sigma = sigma * speed / 100.0 if percent else sigma
    return StatedSpeed(speed, sigma, f"{speed:.9g} ± {sigma:.3g} m/s, estimated with the target")


def _positive(text: str, unit: str | None, given: str, where: str) -> float:
    """Return a positive amount, m/s; `unit` applies to a text without a unit, and `given` is the whole text."""
    match = _AMOUNT.fullmatch(text)
    if match is None:
        raise InvalidProblem(f"{given!r} is no wave speed", where, f"write {FORMS}")
    # a bare number is in metres per second, as in a file
    name = match[2] or unit or "m/s"
    if name not in UNITS["speed"] or name == "Hz":
        if name in _TEMPERATURES:
            raise InvalidProblem(f"{given!r} is a temperature", where, f'name the medium, such as "air:{given}"')
        known = [other for other in UNITS["speed"] if other != "Hz"]
        raise InvalidProblem(f"{name!r} is not a unit of speed", where, nearest(name, known))
    speed = float(Units("speed").conversion(name, where).to_si(float(match[1])))
    if not 1.0 / LARGEST < speed < LARGEST:
        raise InvalidProblem(f"the speed {given} is not positive", where, "write it as 340 m/s")
    return speed


def _air(parts: Sequence[str], text: str, where: str) -> StatedSpeed:
    """Return the speed of sound in air, for the parts of a text such as "20C,50%"."""
    if len(parts) > 2:
        raise InvalidProblem(f"{text!r} has {len(parts)} values", where, "write temperature and humidity: air:20C,50%")
    celsius = _number(parts[0], ("c", "°c", "degc", ""), text, where, "air:20C")
    if len(parts) < 2:
        speed = sound_in_air(celsius)
        return StatedSpeed(speed, None, f"{speed:.6g} m/s, dry air of {celsius:g} °C (ideal gas)")
    humidity = _number(parts[1], ("%",), text, where, "air:20C,50%")
    speed = sound_in_air(celsius, humidity)
    return StatedSpeed(speed, None, f"{speed:.6g} m/s, air of {celsius:g} °C, {humidity:g} % humid (Cramer 1993)")


def _water(parts: Sequence[str], text: str, where: str) -> StatedSpeed:
    """Return the speed of sound in water, for the parts of a text such as "8C,35,50m"."""
    example = "water:8C,35,50m"
    celsius = _number(parts[0], ("c", "°c", "degc", ""), text, where, example)
    if len(parts) == 1:
        advice = f"write water:{celsius:g}C,35 for the sea, or water:{celsius:g}C,0 for fresh water"
        raise InvalidProblem("the salinity of the water is missing", where, advice)
    if len(parts) > 3:
        what = f"{text!r} has {len(parts)} values"
        raise InvalidProblem(what, where, f"write temperature, salinity and depth: {example}")
    salinity = _number(parts[1], ("", "g/kg", "psu", "ppt"), text, where, example)
    depth = _number(parts[2], ("m", ""), text, where, example) if len(parts) == 3 else 0.0
    speed = sound_in_water(celsius, salinity, depth)
    words = f"{speed:.6g} m/s, water of {celsius:g} °C, {salinity:g} g/kg salt, {depth:g} m deep (UNESCO 1983)"
    return StatedSpeed(speed, None, words)


_MEDIA = {"air": _air, "water": _water}


def _number(part: str, units: Sequence[str], text: str, where: str, example: str) -> float:
    """Return the number of a part of a text with one of the `units`, in lower case; `example` is for messages."""
    match = _AMOUNT.fullmatch(part)
    if match is None or match[2].lower().replace(" ", "") not in units:
        raise InvalidProblem(f"{part!r} of {text!r} is not understood", where, f"write it as {example}")
    return float(match[1])


# Profiles: speed by depth or height.


def profile_of(path: str, where: str, folder: Path | None = None) -> MediumTable:
    """Return the layers of a table with columns of depth (or height) and speed; the speed is linear between the rows.

    Parameters
    ----------
    path : str
        File of the table.
    where : str
        Place for messages.
    folder : Path, optional
        Folder of the problem file that names the table; None for a path of the command line.

    Raises
    ------
    InvalidProblem
        For a table without these columns.
    """
    table = read_table(Path(path)) if folder is None else table_of(DataTable(file=path), folder, where)
    level, speed = _column(table, (*_DEPTHS, *_HEIGHTS), "depth_m"), _column(table, _SPEEDS, "speed_m_s")
    down = 1.0 if stem(level) in _DEPTHS else -1.0
    depth, speeds = _in_si(table, level, "length"), _in_si(table, speed, "speed")
    order = np.argsort(down * depth, kind="stable")
    return MediumTable(kind="layers", depths=(down * depth)[order].tolist(), speeds=speeds[order].tolist())


def _column(table: Table, names: Sequence[str], example: str) -> str:
    """Return the name of the first column with one of the names; raise InvalidProblem without one."""
    for name in table.columns:
        if _stem_of_speed(name) in names:
            return name
    advice = f"name the columns depth_m (or height_m) and speed_m_s, not {', '.join([*table.columns][:4])}"
    raise InvalidProblem(f"the profile has no column {example}", table.source, advice)


def _stem_of_speed(name: str) -> str:
    """Return the stem of a column name; the unit m_s is written with an underscore, since a slash is rare in names."""
    return stem(re.sub(r"[ _(\[]*(k?m)[ _/]?(s|/s)[)\]]?$", "", name.strip(), flags=re.IGNORECASE))


def _in_si(table: Table, name: str, quantity: Quantity) -> Array:
    """Return a column in SI units, by the unit at the end of its name; metres, or metres per second, without a unit."""
    unit = unit_of(name, [each for each in UNITS[quantity] if each not in UNITS["time"]])
    if quantity == "speed" and re.search(r"km[ _/]?s[)\]]?$", name, flags=re.IGNORECASE):
        unit = "km/s"
    return np.asarray(Units(quantity).conversion(unit, table.source).to_si(table.numbers(name)), dtype=float)


# Problem files with a profile, and with the options of the command line.


def with_profile(file: ProblemFile, folder: Path | None, source: str) -> ProblemFile:
    """Return a problem file in which a profile that `propagation_speed` names has become the medium.

    `folder` is the folder of the file, and `source` its name for messages.
    """
    given = file.propagation_speed
    if not is_profile(given):
        return file
    place = join(source, "key 'propagation_speed'")
    if file.medium is not None:
        raise InvalidProblem("the speed is given twice", place, "remove it, or the table [medium]")
    medium = profile_of(str(given), place, folder)
    return file.model_copy(update={"propagation_speed": None, "medium": medium})


def with_options(file: ProblemFile, wave: WaveOptions | None) -> ProblemFile:
    """Return a problem file with the options of the command line, which replace its own statements."""
    if wave is None or not wave.stated:
        return file
    changes: dict[str, Any] = {}
    if wave.speed is not None:
        profile = profile_of(wave.speed, "--wave-speed") if is_profile(wave.speed) else None
        changes |= {"propagation_speed": None if profile else wave.speed, "medium": profile}
        if profile is None:
            stated_speed(wave.speed, "--wave-speed")  # so that an error names the option
    if wave.wind is not None:
        wind_of(wave.wind, "--wind")
        changes["wind"] = wave.wind
    if wave.two_way or wave.turn_around is not None:
        ranges = [section.kind == "range" for section in file.measurements]
        if not any(ranges):
            flag = "--two-way" if wave.two_way else "--turn-around"
            raise InvalidProblem("the file has no ranges", flag, "remove this option")
        keys = {"two_way": True, "turn_around": wave.turn_around}
        changes["measurements"] = [
            section.model_copy(update=keys) if chosen else section
            for section, chosen in zip(file.measurements, ranges, strict=True)
        ]
    return file.model_copy(update=changes)


def wind_of(given: str | Sequence[float], where: str) -> tuple[float, ...]:
    """Return the velocity of the medium towards the axes x and y (and z), m/s; east and north on Earth.

    Parameters
    ----------
    given : str or sequence of float
        Speed and the compass direction from which the wind comes, ``"5 m/s from 270"``; or the velocity, ``"5,0"``.
    where : str
        Place for messages.

    Raises
    ------
    InvalidProblem
        For another text.
    """
    advice = "write '5 m/s from 270' (from the west, degrees), or the velocity '5,0' towards x and y in m/s"
    if not isinstance(given, str):
        return tuple(float(v) for v in given)
    speed, word, angle = given.partition(" from ")
    if word:
        strength, bearing = (_AMOUNT.fullmatch(part) for part in (speed, angle))
        units = UNITS["speed"]
        if strength is None or bearing is None or bearing[2] not in ("", "deg", "°") or strength[2] not in units:
            raise InvalidProblem(f"{given!r} is not a wind", where, advice)
        size = float(Units("speed").conversion(strength[2], where).to_si(float(strength[1])))
        turn = np.radians(float(bearing[1]))
        # a wind from the west has no exact zero towards the north; the last digits of a sine have no meaning
        return tuple(round(float(-size * part), 12) + 0.0 for part in (np.sin(turn), np.cos(turn)))
    try:
        parts = tuple(float(part) for part in given.split(","))
    except ValueError:
        parts = ()
    if len(parts) not in (2, 3) or not all(abs(v) <= LARGEST for v in parts):
        raise InvalidProblem(f"{given!r} is not a wind", where, advice)
    return parts

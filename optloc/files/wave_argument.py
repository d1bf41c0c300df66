"""The argument `wave_speed` of `optloc.locate`: a number, a text, a pair with a standard deviation, or a medium."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.types import Array, Stations
from optloc.base.units import SPEED_OF_LIGHT, UNITS, Conversion, in_si
from optloc.files.crust import Crust
from optloc.files.propagation import BOTH_WAYS, fits_sound, medium_of, wind_in
from optloc.files.settings import Units
from optloc.files.wave_speed import is_profile, profile_of, stated_speed, wind_of
from optloc.models.medium import Medium
from optloc.problem.bias import scale_of
from optloc.problem.problem import Problem

# Length of a speed with its standard deviation.
_PAIR = 2
_NAME = "wave_speed"
# Arrivals differ at most by the distance between two stations. This multiple of it means a wrong unit.
_TOO_FAR = 100.0


class Wave(NamedTuple):
    """The wave of a call.

    speed: m/s. sigma: standard deviation of the speed. medium: its medium. stated: whether the speed is stated. wind:
    velocity of the medium, m/s. two_way: whether ranges are times of the way there and back. turn_around: time between
    arrival and reply, s. crust: speeds of P and S waves.
    """

    speed: float
    sigma: float | None = None
    medium: Medium | None = None
    stated: bool = True
    wind: tuple[float, ...] | None = None
    two_way: bool = False
    turn_around: float = 0.0
    crust: Crust | None = None

    @property
    def range_speed(self) -> float:
        """Return the speed that converts the times of ranges, m/s: half of the wave speed for both ways."""
        return 0.5 * self.speed if self.two_way else self.speed


def with_way(wave: Wave, wind: Any, two_way: bool, turn_around: Any, words: Collection[str]) -> Wave:
    """Return a wave with a wind and with two-way ranges, which are arguments of `locate`.

    `words` are the arguments with measurements. Raise InvalidProblem for values that are not understood or that have no
    effect.
    """
    if wind is not None:
        if wave.medium is not None or wave.sigma is not None or not wave.stated:
            what = "a wind needs one wave speed without a sigma"
            raise InvalidProblem(what, "wind", 'state it, such as wave_speed="air:20C"')
        if not isinstance(wind, str | Sequence | np.ndarray):
            raise InvalidProblem(f"{type(wind).__name__} is not a wind", "wind", "give '5 m/s from 270', or (5.0, 0.0)")
        try:
            velocity = wind_of(wind if isinstance(wind, str) else [float(v) for v in wind], "wind")
        except (TypeError, ValueError):
            what, advice = f"{wind!r} is not a wind", "give '5 m/s from 270', or (5.0, 0.0) towards x and y"
            raise InvalidProblem(what, "wind", advice) from None
        wave = wave._replace(wind=velocity)
    if not two_way and turn_around is None:
        return wave
    name = "two_way" if two_way else "turn_around"
    if "ranges" not in words:
        raise InvalidProblem("there are no ranges", name, "give the times as ranges=, or remove this argument")
    if wind is not None:
        raise InvalidProblem(BOTH_WAYS, "wind", "remove the wind")
    pause = 0.0 if turn_around is None else Units("time").plain(turn_around, "s", "turn_around")
    if not pause >= 0.0:
        raise InvalidProblem("the turn-around time is negative", "turn_around", 'write it as "2 ms"')
    return wave._replace(two_way=True, turn_around=pause)


def without_turn_around(unit: Conversion, wave: Wave, name: str) -> Conversion:
    """Return the conversion of two-way times to ranges, without the turn-around time.

    `unit` is the conversion of half of a time, and `name` the name of the unit. Raise InvalidProblem for a length.
    """
    if name not in UNITS["time"]:
        advice = "give unit='ms' or another unit of time, or remove this argument"
        raise InvalidProblem(f"two-way ranges are times, but the unit is {name}", "two_way", advice)
    return replace(unit, offset=-wave.range_speed * wave.turn_around)


def medium_at(wave: Wave, frame: Frame, stations: Stations) -> Medium | None:
    """Return the medium of a wave in the frame of the stations; None for straight rays at one speed."""
    if wave.wind is not None:
        return wind_in(wave.wind, wave.speed, frame, stations, "wind")
    if wave.crust is not None and wave.crust.depths:
        base = 0.0 if frame.origin is None else frame.origin[2]
        highest = float(stations.position[..., 2].max()) if stations.dimension > 2 else 0.0
        layers = wave.crust.layers(base + highest)
        return replace(layers, surface=layers.surface - base)
    return wave.medium


def wave_of(given: Any) -> Wave:
    """Return the wave of the argument `wave_speed`; light without it.

    Raises
    ------
    InvalidProblem
        For a value that is not positive, a text that is not understood, or a tuple without exactly two numbers.
    """
    if given is None:
        return Wave(SPEED_OF_LIGHT, stated=False)
    if isinstance(given, Medium):
        return Wave(given.unit_speed, medium=given)
    if isinstance(given, tuple | list):
        if len(given) != _PAIR:
            what = f"the speed has {len(given)} numbers"
            raise InvalidProblem(what, _NAME, "give (speed, sigma), such as (343, 5)")
        speed, sigma = (_positive(in_si(each, "speed", _NAME)) for each in given)
        return Wave(speed, sigma)
    if is_profile(given):
        medium = medium_of(profile_of(given, _NAME), None, _NAME)
        return Wave(medium.unit_speed, medium=medium)
    if isinstance(given, str):
        found = stated_speed(given, _NAME)
        return Wave(found.speed, found.sigma)
    return Wave(_positive(given))


def _positive(given: Any) -> float:
    """Return a speed, m/s; raise InvalidProblem for a value that is not a positive number."""
    if isinstance(given, bool) or not isinstance(given, float | int | np.number) or not 0.0 < given < np.inf:
        advice = "give metres per second, a text such as 'air:20C', or optloc.models.Layers"
        raise InvalidProblem("the speed is not a positive number", _NAME, advice)
    return float(given)


def with_speed(problem: Problem, wave: Wave, timed: Sequence[bool]) -> Problem:
    """Return a problem in which an uncertain wave speed is unknown, as a scale bias of all rows that are times.

    `timed` is whether each group of rows has times.
    """
    if wave.sigma is None:
        return problem
    ends = [(start, start + rows.count) for rows, start in zip(problem.rows, problem.starts, strict=True)]
    times = [np.arange(*end) for end, time in zip(ends, timed, strict=True) if time]
    return replace(problem, biases=(*problem.biases, scale_of(wave.speed, wave.sigma, times, _NAME)))


def check_times(word: str, z: Array, sigma: float, extent: float, wave: Wave) -> None:
    """Raise InvalidProblem for times that are much longer than the paths between stations.

    Their unit is wrong, or the wave is sound and its speed is not stated. The limit is 100 times the greater of the
    extent of the stations and `sigma`.

    Parameters
    ----------
    word : str
        Argument of `locate` with the times.
    z : array (..., m)
        Times multiplied by the wave speed, m.
    sigma : float
        Their standard deviation, m.
    extent : float
        Greatest extent of the stations along an axis, m.
    wave : Wave
        Wave of the call.
    """
    most = float(np.fmax.reduce(np.abs(z), axis=None, initial=0.0))
    if not wave.stated and fits_sound(most, sigma, extent):
        what = (
            f"light travels {max(most, sigma) / 1e3:.3g} km in these times, but the stations are {extent:.3g} m apart"
        )
        advice = 'state the speed, such as wave_speed="air:20C" (or "light"), or correct the unit, such as unit="ns"'
        raise InvalidProblem(what, word, advice)
    if word in ("toa", "tdoa") and most > _TOO_FAR * max(extent, sigma):
        what = f"the arrivals are {most / 1e3:.3g} km apart, but the stations {extent / 1e3:.3g} km"
        raise InvalidProblem(what, word, "state the unit of the times, such as unit='ns', or correct them")

"""The argument `wave_speed` of `optloc.locate`: a number, a text, a pair with a standard deviation, or a medium."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import SPEED_OF_LIGHT, in_si
from optloc.files.propagation import fits_sound, medium_of
from optloc.files.wave_speed import is_profile, profile_of, stated_speed
from optloc.models.medium import Medium
from optloc.problem.bias import scale_of
from optloc.problem.problem import Problem

# Length of a speed with its standard deviation.
_PAIR = 2
_NAME = "wave_speed"
# Arrivals differ at most by the distance between two stations. This multiple of it means a wrong unit.
_TOO_FAR = 100.0


class Wave(NamedTuple):
    """The wave of a call: its speed, m/s, the standard deviation of the speed, the medium, and whether it is stated."""

    speed: float
    sigma: float | None = None
    medium: Medium | None = None
    stated: bool = True


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

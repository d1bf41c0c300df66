"""Explanations by another reading of all values: unit, sign, sense of bearings, declination, speed, coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from optloc.advice.change import Change, ErrorColumn, MisfitCase, Wording, Words
from optloc.advice.suspects import Suspects
from optloc.advice.wording import bias_lines, size_text, station_lines
from optloc.base.types import Array, CompassRows
from optloc.base.units import SPEED_OF_LIGHT, UNITS
from optloc.models import MODELS

_TIMES = ("s", "ms", "us", "ns", "ps")
# Units that a file states, first the unit without a statement; and units that may be meant. Feet occur if the unit is
# not stated, thousands if the prefix is wrong, and times if the speed of the wave is missing.
_STATED_UNITS = ("m", "s", "ns", "ft")
_MEANT_UNITS = ("m", "km", "mm", "cm", "ft", "s", "ms", "us", "ns")
# Largest number of pairs of units in a sentence.
_MAX_PAIRS = 3
# Units of coordinates that may be meant where metres are stated, and the other way round.
_COORDINATE_UNITS = ("km", "cm", "mm", "ft")
# Speeds that may be confused, m/s: light, sound in air and in water.
_SPEEDS = (SPEED_OF_LIGHT, 343.0, 1500.0)
# Relative difference of equal units.
_SAME_UNIT = 1e-6
# Share of a turn by which noise and rounding may exceed it.
_ROUNDED = 0.01
# Largest difference between the logarithms of speeds in one medium: air in frost and heat, fresh and salt water.
_NEAR_SPEED = 0.3
# Starts of the scale of all lengths: a speed that is wrong by up to a factor of four.
_SCALES = (-0.75, -0.5, -0.2, 0.0, 0.25, 1.0, 3.0)
# Starts of the declination, rad: every 45 degrees.
_TURNS = tuple(np.radians(np.arange(-135.0, 181.0, 45.0)).tolist())


def units(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield other units of the lengths and of the angles, each with the noise in the same unit or as stated."""
    yield from _as_lines(case, _units(case))


def _units(case: MisfitCase) -> Iterator[Change]:
    """Yield other units."""
    lengths = tuple(kind for kind in case.kinds if MODELS[kind].quantity == "length" and MODELS[kind].stations)
    groups = [group for group in dict.fromkeys((lengths, *((kind,) for kind in lengths))) if group]
    for group in groups:
        ratios = _ratios(case, group)
        rows = np.any([case.rows_of(kind) for kind in group], axis=0)
        for ratio, (stated, meant) in ratios.items():
            words = partial(_unit_words, case, group, stated, meant, ratio)
            yield from _read(case, rows, ratio, words, len(ratios) * len(groups))
    angles = tuple(kind for kind in case.kinds if MODELS[kind].quantity == "angle")
    rows = case.rows_where("angle")
    for stated, meant, ratio in (("rad", "deg", np.pi / 180.0), ("deg", "rad", 180.0 / np.pi)) if angles else ():
        words = partial(_angle_words, angles, stated, meant)
        yield from _read(case, rows, ratio, words, 2)


def _read(case: MisfitCase, rows: Array, ratio: float, words: Words, choices: float) -> Iterator[Change]:
    """Yield values times a ratio, with noise times this ratio, and with the stated noise.

    The values of compass bearings turn about north.
    """
    factor, shift = np.where(rows, ratio, 1.0), np.zeros(case.present.shape)
    for i, block in enumerate(case.base.rows):
        part = case.part(i)
        if MODELS[block.kind].period is None or not rows[part].any():
            continue
        # readings of angles are within one turn, so that a larger unit must not make several turns of them
        compass = isinstance(block, CompassRows)
        z = np.broadcast_to(case.base.z, case.present.shape)[:, part]
        reading = np.where(case.present[:, part], np.pi / 2 - z if compass else z, 0.0)
        turns = np.round(reading / (2.0 * np.pi)) if ratio > 1.0 else np.zeros_like(reading)
        if np.abs(ratio * (reading - 2.0 * np.pi * turns)).max() > 2.0 * np.pi * (1.0 + _ROUNDED):
            return
        back = ratio * 2.0 * np.pi * turns
        shift[:, part] = np.pi / 2 * (1.0 - ratio) + back if compass else -back
    written = case.base.written
    if written is None or not written.noise_has_unit:
        yield Change("unit", words, factor=factor, shift=shift, alternatives=choices)
    # a noise that is stated with a unit stays: in the recorded unit it is larger by the inverse of the ratio
    spread = np.where(rows, 1.0 / ratio, 1.0)
    if written is None or written.noise_has_unit:
        yield Change("unit", words, factor=factor, shift=shift, spread=spread, alternatives=choices)


def _ratios(case: MisfitCase, kinds: tuple[str, ...]) -> dict[float, tuple[str, str]]:
    """Return the stated and the meant unit by the ratio of their sizes; times are multiplied by the wave speed.

    Without a file, the wave is light and the stated unit is one of a few.
    """
    written = case.base.written
    sizes = {abs(written.units.get(kind, 1.0)) for kind in kinds} if written is not None else set()
    if written is not None and len(sizes) == 1:
        size, speed = sizes.pop(), written.speed or SPEED_OF_LIGHT
        own = {name: UNITS["length"][name] * (speed if name in _TIMES else 1.0) for name in _MEANT_UNITS}
        return {other / size: ("", name) for name, other in own.items() if abs(other / size - 1.0) > _SAME_UNIT}
    table = {name: size * (SPEED_OF_LIGHT if name in _TIMES else 1.0) for name, size in UNITS["length"].items()}
    out: dict[float, tuple[str, str]] = {}
    for stated in _STATED_UNITS:
        for meant in _MEANT_UNITS:
            ratio = table[meant] / table[stated]
            if abs(ratio - 1.0) > 1e-6 and not any(abs(ratio / old - 1.0) < 1e-6 for old in out):
                out[ratio] = (stated, meant)
    return out


def _unit_words(
    case: MisfitCase, kinds: tuple[str, ...], stated: str, meant: str, ratio: float, theta: Array, sigma: Array
) -> Wording:
    written = case.base.written
    sizes = {abs(written.units.get(kind, 1.0)) for kind in kinds} if written is not None else set()
    if written is not None and len(sizes) == 1:
        return _words_of_file(kinds, sizes.pop(), ratio, written.speed or SPEED_OF_LIGHT)
    table = {name: size * (SPEED_OF_LIGHT if name in _TIMES else 1.0) for name, size in UNITS["length"].items()}
    what = " and ".join(kinds)
    pairs = [f"{a} for {b}" for b in table for a in table if abs(table[a] / table[b] / ratio - 1.0) < 1e-6]
    seen = f"the {what} values fit in {meant} instead of the stated {stated}, {ratio:.4g} times as large"
    advice = f"state their unit; by the ratio it may be {' or '.join(pairs[:_MAX_PAIRS])}"
    return Wording(seen, advice, f'unit = "{meant}"\n')


def _words_of_file(kinds: tuple[str, ...], size: float, ratio: float, speed: float) -> Wording:
    """Return the text about a unit whose size is `ratio` times the size in the file, m."""
    table = {name: own * (speed if name in _TIMES else 1.0) for name, own in UNITS["length"].items()}
    stated, meant = (
        next((name for name, own in table.items() if abs(own / wanted - 1.0) < _SAME_UNIT), "")
        for wanted in (size, size * ratio)
    )
    what = " and ".join(kinds)
    if not meant:
        seen = f"the {what} values fit in a unit that is {ratio:.4g} times as large as the stated one"
        return Wording(seen, "check the unit of the values and of the stations")
    seen = f"the {what} values fit in {meant} instead of the stated {stated}, {ratio:.4g} times as large"
    return Wording(seen, "state their unit", f'unit = "{meant}"\n', f"--unit {meant}")


def _angle_words(kinds: tuple[str, ...], stated: str, meant: str, theta: Array, sigma: Array) -> Wording:
    seen = f"the {' and '.join(kinds)} values fit in {meant} instead of the stated {stated}"
    return Wording(seen, "state their unit", f'unit = "{meant}"\n')


def signs(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield the opposite sign of all differences, and of all arrival times."""
    for kind in case.kinds:
        model = MODELS[kind]
        if model.ranges != (1, -1) and not model.emission and kind != "rss_difference":
            continue
        difference = not model.emission
        turned = case.base.written is not None and case.base.written.units.get(kind, 1.0) < 0.0
        words = partial(_sign_words, kind, difference, turned)
        yield Change("sign", words, factor=np.where(case.rows_of(kind), -1.0, 1.0))


def _sign_words(kind: str, difference: bool, turned: bool, theta: Array, sigma: Array) -> Wording:
    seen = f"the {kind} values fit with the opposite sign"
    if difference:
        key = "a-farther" if turned else "b-farther"
        return Wording(
            seen,
            "state which station is farther if the number is positive",
            f'positive = "{key}"\n',
            f"--positive {key}",
        )
    return Wording(f"{seen}: the counters count down to zero", "write a minus before each value")


def senses(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield other senses of azimuths: compass, anticlockwise from north, and half a turn."""
    yield from _as_lines(case, _senses(case))


def _as_lines(case: MisfitCase, changes: Iterator[Change]) -> Iterator[Change]:
    """Yield changes with keys of `[[measurements]]`, which stay lines only if the file has one kind of rows."""

    def sentence(words: Words, theta: Array, sigma: Array) -> Wording:
        text = words(theta, sigma)
        keys = text.toml.strip().replace("\n", " and ")
        return replace(text, advice=f"{text.advice}: {keys} in the table of these rows", toml="") if keys else text

    for change in changes:
        yield change if len(case.kinds) == 1 else replace(change, words=partial(sentence, change.words))


def _senses(case: MisfitCase) -> Iterator[Change]:
    """Yield other senses of azimuths."""
    rows = case.rows_of("azimuth")
    if "azimuth" not in case.kinds:
        return
    compass = any(isinstance(block, CompassRows) and block.kind == "azimuth" for block in case.base.rows)
    half, east, north = np.pi / 2, 'azimuth = "east-counterclockwise"\n', 'azimuth = "north-counterclockwise"\n'
    if compass:
        # the reading r was taken as pi/2 - r
        yield _sense(rows, "compass", -1.0, half, "as angles from east, counter-clockwise", east)
        yield _sense(rows, "anticlockwise", -1.0, np.pi, "as angles from north, counter-clockwise", north)
    else:
        yield _sense(rows, "compass", -1.0, half, "as compass bearings", 'azimuth = "north-clockwise"\n')
        yield _sense(rows, "anticlockwise", 1.0, half, "as angles from north, counter-clockwise", north)
        degrees = 'unit = "deg"\nazimuth = "north-clockwise"\n'
        for spread in (1.0, 180.0 / np.pi):
            yield _sense(rows, "compass", -np.pi / 180.0, half, "as compass bearings in degrees", degrees, spread)
    turned = "if each is turned by half a turn: they point from the target to the station"
    yield _sense(rows, "opposite", 1.0, np.pi, turned, 'correction = "180 deg"\n')


def _sense(rows: Array, cause: str, factor: float, shift: float, how: str, toml: str, spread: float = 1.0) -> Change:
    return Change(
        cause,
        partial(_sense_words, how, toml),
        factor=np.where(rows, factor, 1.0),
        shift=np.where(rows, shift, 0.0),
        spread=np.where(rows, spread, 1.0),
        alternatives=4,
    )


def _sense_words(how: str, toml: str, theta: Array, sigma: Array) -> Wording:
    return Wording(f"the azimuths do not fit as read, but they fit {how}", "state the convention", toml)


def declinations(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield one turn of all azimuths."""
    if "azimuth" not in case.kinds or len(case.stations) < 2:
        return
    column = np.broadcast_to(case.coefficients("kind", "offset", "azimuth"), case.present.shape)
    starts = tuple((turn,) for turn in _TURNS)
    yield Change("declination", partial(_turn_words, case), columns=(ErrorColumn("adds", column),), starts=starts)


def _turn_words(case: MisfitCase, theta: Array, sigma: Array) -> Wording:
    seen = f"a turn of all azimuths by {size_text(theta[0], sigma[0], 'rad')} would explain the misfit"
    advice = "check north: state the declination, or model the error"
    return Wording(seen, advice, bias_lines(case, "offset", "kind", "azimuth"))


def speeds(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield one factor of all lengths: another speed of the wave."""
    rows = case.rows_where("length")
    if not case.present[:, rows].any():
        return
    known = [one / other - 1.0 for one in _SPEEDS for other in _SPEEDS if one != other]
    column = np.broadcast_to(rows * 1.0, case.present.shape)
    starts = tuple((start,) for start in (*_SCALES, *known))
    kinds = [kind for kind in case.kinds if rows[case.rows_of(kind)].any()]
    words, columns = partial(_speed_words, case, kinds), (ErrorColumn("scales", column),)
    yield Change("speed", words, columns=columns, starts=starts, admits=_is_speed)


def _is_speed(theta: Array) -> bool:
    """Return whether a scale of all lengths comes from a wrong speed, or from times of both ways instead of one."""
    ratios = np.array([one / other for one in _SPEEDS for other in _SPEEDS] + [0.5, 2.0])
    return bool((np.abs(np.log((1.0 + theta[0]) / ratios)) < _NEAR_SPEED).any())


def _speed_words(case: MisfitCase, kinds: list[str], theta: Array, sigma: Array) -> Wording:
    ratio = 1.0 / (1.0 + theta[0])
    seen = f"the lengths fit if all are multiplied by {ratio:.6g} (± {100.0 * sigma[0] / (1.0 + theta[0]):.2g} %)"
    advice = f"check the speed of the wave, {ratio:.5g} times the stated one, and the unit; until then, model the error"
    written = case.base.written
    if (
        written is not None
        and written.speed
        and all(_is_time(written.units.get(kind, 1.0), written.speed) for kind in kinds)
    ):
        stated = written.speed * (2.0 if written.there_and_back else 1.0)
        speed = float(f"{stated * ratio:.9g}")
        seen = f"the times fit with a wave speed of {speed:.6g} m/s instead of {stated:.6g} m/s"
        return Wording(
            seen, "check the speed of the wave", f"propagation_speed = {speed!r}\n", f"--wave-speed '{speed:.9g} m/s'"
        )
    lines = bias_lines(case, "scale", "kind", kinds[0]) if len(kinds) == 1 else ""
    return Wording(seen, advice, lines)


def _is_time(size: float, speed: float) -> bool:
    """Return whether a unit of lengths is a time that is multiplied by the speed."""
    return any(abs(abs(size) / (speed * UNITS["length"][name]) - 1.0) < _SAME_UNIT for name in _TIMES)


def coordinate_units(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield other units of the coordinates of the stations."""
    place = case.base.stations.position
    written = case.base.written
    numbers = written is not None and written.place_keys[:1] == ("x",)  # no latitudes and longitudes
    if (case.base.frame.geodetic and not numbers) or not case.present[:, case.rows_where("length")].any():
        return
    sizes = [UNITS["length"][unit] for unit in _COORDINATE_UNITS]
    for factor in dict.fromkeys([*sizes, *(1.0 / size for size in sizes)]):
        words = partial(_coordinate_words, case, factor)
        yield Change("coordinate-unit", words, position=place * factor, alternatives=2 * len(sizes))


def _coordinate_words(case: MisfitCase, factor: float, theta: Array, sigma: Array) -> Wording:
    table, written = UNITS["length"], case.base.written
    size = (
        written.place_unit if written is not None and written.place_unit else 1.0 if factor in table.values() else 0.0
    )
    size = size or 1.0 / factor
    stated, meant = (
        next((name for name, own in table.items() if abs(own / wanted - 1.0) < _SAME_UNIT), "")
        for wanted in (size, size * factor)
    )
    if not meant:
        seen = f"the values fit with coordinates of stations that are {factor:.4g} times as large"
        return Wording(seen, "check their unit")
    seen = f"the values fit with coordinates of stations in {meant} instead of {stated}, {factor:.4g} times as large"
    lines = f'[stations]\nunit = "{meant}"\n' if written is not None and written.place_unit else ""
    return Wording(seen, f'state their unit: unit = "{meant}" in the table of the stations', lines)


def swapped_coordinates(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield exchanged latitudes and longitudes of all stations."""
    stations, frame = case.base.stations, case.base.frame
    if not frame.geodetic or stations.position.ndim > 3 or (stations.axes is not None and stations.axes.ndim > 4):
        return
    lat, lon, height = frame.to_geodetic(stations.position)
    if np.abs(lon).max() > np.pi / 2:
        return
    position = frame.from_geodetic(lon, lat, height)
    yield Change("lat-lon", partial(_lat_lon_words, case, position), position=position)


def _lat_lon_words(case: MisfitCase, position: Array, theta: Array, sigma: Array) -> Wording:
    lines = station_lines(case, dict(enumerate(position.reshape(-1, case.base.dimension))))
    seen = "the values fit if latitude and longitude of the stations are exchanged"
    return Wording(seen, "exchange the two columns", lines)

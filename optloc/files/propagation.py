"""The propagation speed and the medium of a problem file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.sound import sound_in_air, sound_in_water
from optloc.base.types import Array, Bias, Stations
from optloc.base.units import SPEED_OF_LIGHT, UNITS
from optloc.files.measurements import RowChunk
from optloc.files.schema import MediumTable, ProblemFile, SoundTable, SpeedTable
from optloc.files.settings import Units, join
from optloc.files.wave_speed import StatedSpeed, stated_speed, wind_of
from optloc.models.medium import Atmosphere, Layers, Medium, Wind
from optloc.models.phase_layers import PhaseLayers
from optloc.problem.bias import SPEED, scale_of

NOT_STATED = f"{SPEED_OF_LIGHT:.9g} m/s, light (not stated)"
"""Text of the wave speed of a file that states none."""
BOTH_WAYS = "a wind has almost no effect on the way there and back, and the model has one way"
"""Text for a wind with two-way ranges: to first order, the two ways cancel."""

# Keys of each kind of medium.
_MEDIA = {
    "layers": ("depths", "speeds", "s_speeds", "between", "surface", "unit", "speed_unit"),
    "atmosphere": ("refractivity", "scale_height"),
}


def medium_in(
    file: ProblemFile, source: str, frame: Frame | None = None, stations: Stations | None = None
) -> Medium | None:
    """Return the medium of a problem file; None if the propagation speed is one number.

    A wind on Earth needs the `frame` and the `stations`, since the axes of an ECEF frame are not east and north.
    """
    stated = _stated(file, source)
    if file.wind is None:
        reference = None if stated is None else stated.speed
        return None if file.medium is None else medium_of(file.medium, reference, join(source, "[medium]"))
    place = join(source, "key 'wind'")
    if file.medium is not None:
        raise InvalidProblem("a wind needs one wave speed, and the file has [medium]", place, "remove one of them")
    if stated is None or stated.sigma is not None:
        what = "a wind needs a wave speed" if stated is None else "a wind needs a wave speed without a sigma"
        raise InvalidProblem(what, place, 'write propagation_speed = "air:20C", or --wave-speed air:20C')
    if any(section.two_way or section.turn_around is not None for section in file.measurements):
        raise InvalidProblem(BOTH_WAYS, place, "remove the wind")
    return wind_in(wind_of(file.wind, place), stated.speed, frame, stations, place)


def wind_in(
    velocity: tuple[float, ...], speed: float, frame: Frame | None, stations: Stations | None, place: str
) -> Wind:
    """Return a wind with its velocity, m/s, in the axes of a frame; east and north become axes of an ECEF frame.

    `speed` is the wave speed, m/s, and `place` the place for messages.
    """
    if frame is not None and frame.kind == "ecef" and stations is not None:
        middle = stations.position.reshape(-1, stations.dimension).mean(0)
        axes = frame.enu_axes(middle)  # rows: east, north and up
        velocity = tuple((np.array([*velocity, 0.0][:3]) @ axes).tolist())
    try:
        return Wind(velocity, speed)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, place, error.advice) from None


def speed_of(file: ProblemFile, source: str) -> float:
    """Return the speed that converts times to lengths, m/s; by default the speed of light."""
    medium, stated = medium_in(file, source), _stated(file, source)
    if medium is not None:
        return medium.unit_speed
    return SPEED_OF_LIGHT if stated is None else stated.speed


def speed_words(file: ProblemFile, source: str) -> str:
    """Return the wave speed of a problem file as text, for reports."""
    medium, stated = medium_in(file, source), _stated(file, source)
    if isinstance(medium, Wind):
        assert stated is not None
        parts = ", ".join(f"{v:.3g}" for v in medium.velocity)
        return f"{stated.words}; wind ({parts}) m/s"
    if medium is not None:
        return medium.words
    return NOT_STATED if stated is None else stated.words


def medium_of(table: MediumTable, reference: float | None, place: str) -> Medium:
    """Return the medium of a table; raise InvalidProblem for missing or superfluous keys.

    `reference` is the propagation speed of the file, m/s; None if it states none. It converts times to lengths in
    layers. `place` is the place for messages.
    """
    permitted_keys = _MEDIA[table.kind]
    given = {key for key in table.model_fields_set - {"kind"} if getattr(table, key) is not None}
    wrong, lacking = (
        sorted(given - set(permitted_keys)),
        [key for key in ("depths", "speeds") if key in permitted_keys and key not in given],
    )
    if wrong:
        raise InvalidProblem(
            f"the kind {table.kind!r} has no {wrong[0]!r}", place, f"use the keys {', '.join(permitted_keys)}"
        )
    if lacking:
        raise InvalidProblem(f"the kind {table.kind!r} needs {lacking[0]}", place, "give a list of numbers")
    if table.kind == "atmosphere" and reference is not None:
        what = "an atmosphere determines the speed: the speed of light over the refractive index"
        raise InvalidProblem(what, place, "remove propagation_speed")
    # functions that convert lengths and speeds from the units of the table to SI
    length, speed = (
        Units(quantity).conversion(unit, place).to_si  # type: ignore[arg-type]
        for quantity, unit in (("length", table.unit), ("speed", table.speed_unit))
    )
    try:
        if table.kind == "atmosphere":
            return Atmosphere(**{key: getattr(table, key) for key in given})
        surface = Units("length").plain(table.surface, table.unit, place)
        depth, speeds = (
            tuple(float(to_si(v)) for v in values or ())
            for to_si, values in ((length, table.depths), (speed, table.speeds))
        )
        if table.s_speeds is None:
            return Layers(depth, speeds, table.between, surface, reference)
        slow = tuple(float(speed(v)) for v in table.s_speeds)
        return PhaseLayers(depth, speeds, table.between, surface, reference, slow)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, place, error.advice) from None


def _stated(file: ProblemFile, source: str) -> StatedSpeed | None:
    """Return the propagation speed that a file states; None if it states none."""
    given, place = file.propagation_speed, join(source, "key 'propagation_speed'")
    if given is None:
        return None
    if isinstance(given, SoundTable):
        return _sound(given, place)
    if isinstance(given, SpeedTable):
        speed, sigma = positive_speed(given.value, "speed", place), positive_speed(given.sigma, "sigma", place)
        return StatedSpeed(speed, sigma, f"{speed:.9g} ± {sigma:.3g} m/s, estimated with the target")
    if isinstance(given, str):
        return stated_speed(given, place)
    return StatedSpeed(positive_speed(given, "speed", place), None, f"{given:.9g} m/s")


def _sound(given: SoundTable, place: str) -> StatedSpeed:
    """Return the speed of sound in the medium of a table."""
    water = given.medium != "air"
    # Grams of salt in a kilogram of water: sea water has 35 by default, other water none.
    if not water and (given.salinity is not None or given.depth):
        raise InvalidProblem("air has no salinity and no depth", place, "remove them")
    usual = 35.0 if given.medium == "sea water" else 0.0
    salinity = usual if given.salinity is None else given.salinity
    if not water:
        speed = sound_in_air(given.celsius)
        return StatedSpeed(speed, None, f"{speed:.6g} m/s, air of {given.celsius:g} °C")
    speed = sound_in_water(given.celsius, salinity, given.depth)
    return StatedSpeed(speed, None, f"{speed:.6g} m/s, {given.medium} of {given.celsius:g} °C")


def positive_speed(given: float | str, what: str, place: str) -> float:
    """Return a speed or its standard deviation, m/s; raise InvalidProblem for zero or negative values.

    `what` is the noun and `place` the place for the message.
    """
    speed = Units("speed").plain(given, "m/s", place)
    if not speed > 0.0:
        raise InvalidProblem(f"the {what} {given} is not positive", place, 'write it as 340.0 or "340 m/s"')
    return speed


# A speed with a standard deviation: one factor scales all times, so the error of the speed is a scale bias.


def is_time(units: Units, unit: str | None, place: str) -> bool:
    """Return whether values in `unit` are times for a quantity that is a length, so that they depend on the speed."""
    if units.quantity != "length":
        return False
    once, twice = (Units("length", speed=factor * units.speed).conversion(unit, place).factor for factor in (1.0, 2.0))
    return once != twice


def speed_bias(
    file: ProblemFile, written: Sequence[tuple[Array, Units, str]], biases: Sequence[Bias], source: str
) -> tuple[Bias, ...]:
    """Return the scale bias of a speed with a sigma; empty for a speed without a sigma.

    `written` has the global row numbers (m,), the quantity and the unit of each set of values. `biases` are the other
    biases of the file.
    """
    stated, place = _stated(file, source), join(source, "key 'propagation_speed'")
    if stated is None or stated.sigma is None:
        return ()
    if file.medium is not None:
        raise InvalidProblem("the medium determines the speed", place, "remove the sigma")
    if any(bias.name == SPEED for bias in biases):
        raise InvalidProblem("the bias 'speed' is stated twice", place, "remove [[biases]] 'speed' or the sigma")
    rows = [numbers for numbers, units, unit in written if is_time(units, unit, place)]
    return (scale_of(stated.speed, stated.sigma, rows, place),)


# Times without a stated speed: light is the default, and wrong for times of sound.

# A wave between 10 m/s and 10 km/s is sound or an earthquake; waves on a string are outside.
_SLOWEST, _FASTEST = 10.0, 10e3
# A noise of 100 times the size of the network leaves no information.
_USELESS = 100.0


def check_speed(
    file: ProblemFile, chunks: Sequence[RowChunk], groups: Sequence[Array], stations: Stations, source: str
) -> None:
    """Raise InvalidProblem if times fit the network only as times of sound, and no wave speed is stated.

    `groups` are the numbers (m,) of the epoch and target of each row of each chunk, for example of one message.
    """
    if file.propagation_speed is not None or file.medium is not None or stations.dimension < 2:
        return
    extent = float(np.nanmax(np.ptp(stations.position.reshape(-1, stations.dimension), axis=0), initial=0.0))
    timed = [(chunk, group) for chunk, group in zip(chunks, groups, strict=True) if chunk.written_unit in UNITS["time"]]
    for chunk, group in timed if extent > 0.0 else ():
        if chunk.units.quantity != "length":
            continue
        longest, noise = _longest(chunk, group), _noise(chunk)
        if fits_sound(longest, noise, extent):
            what = f"light travels {max(longest, noise) / 1e3:.3g} km in these times, and no wave speed is stated"
            advice = 'state it: --wave-speed air:20C, or propagation_speed = "air:20C" in a file; or correct the unit'
            if source == "arguments":
                advice = 'state it, such as wave_speed="air:20C", or correct the unit'
            raise InvalidProblem(what, chunk.table.source, advice)


def fits_sound(longest: float, noise: float, extent: float) -> bool:
    """Return whether times make sense as times of sound, and not as times of light.

    `longest` is the longest path, `noise` the least standard deviation, and `extent` the size of the network, all in
    metres at the speed of light.
    """
    if not extent > 0.0:
        return False
    product = SPEED_OF_LIGHT * extent
    return _SLOWEST * longest < product and (product < _FASTEST * longest or noise > _USELESS * extent)


def _longest(chunk: RowChunk, group: Array) -> float:
    """Return the longest path of the rows of a chunk, m: for arrivals, the longest time after the first of a group."""
    present = (chunk.weight > 0.0) & np.isfinite(chunk.z)
    z, number = chunk.z[present], group[present]
    if not len(z):
        return 0.0
    if chunk.kind != "toa":
        return float(np.abs(z).max())
    first = np.full(int(number.max()) + 1, np.inf)
    np.minimum.at(first, number, z)
    return float((z - first[number]).max())


def _noise(chunk: RowChunk) -> float:
    """Return the least standard deviation of the rows of a chunk, m; zero for other forms of noise."""
    sigma = chunk.sigma if chunk.sigma is not None else chunk.arrival
    positive = np.zeros(0) if sigma is None else sigma[sigma > 0.0]
    return float(positive.min(initial=np.inf)) if len(positive) else 0.0

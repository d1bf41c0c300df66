"""Pseudoranges of a GNSS receiver, corrected with broadcast ephemerides: RINEX files and Android logs.

A corrected pseudorange is an arrival from the satellite position at transmission, rotated with the Earth during the
flight, without the satellite clock error. Atmospheric delays depend on elevations, which come from a first pass of
fixes. So you need not give a position.

Source of the Android part: European GNSS Agency, "Using GNSS raw measurements on Android devices" (2017), 2.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import ECEF
from optloc.base.inputs import decoded, read_bytes
from optloc.base.types import Array
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files.broadcast import Ephemeris, ionosphere, orbit, troposphere, turned
from optloc.files.rinex import SYSTEMS, WEEK, Observations, is_rinex, read_navigation, read_observations
from optloc.files.settings import Units
from optloc.files.table import Table, of_rows
from optloc.problem.build import assemble, measured, station_array

# Largest time from the reference time of a valid ephemeris, s: fits of GPS and Galileo cover four hours.
_MAX_AGE = 7200.0
# Elevation, degrees, below which refraction and reflections exceed the noise: the usual mask of surveyors.
MASK = 10.0
# Satellites needed for a receiver and its clock; greatest distance of a receiver from the Earth's centre, m.
_MIN_SATELLITES, _MAX_RADIUS = 4, 1e7
# State bits of an Android measurement: code lock, and known time of week.
_TRACKED, _TIMED = 1, 8 | 16384
# Largest uncertainty of an Android time, ns; lowest frequency of L1 and E1 signals, Hz.
_MAX_UNCERTAINTY, _MIN_FREQUENCY = 500.0, 1.5e9
_CONSTELLATIONS = {"1": "G", "4": "J", "6": "E"}
_QZSS = 192  # QZSS satellite numbers start after it


@dataclass(frozen=True, slots=True)
class Received:
    """Corrected pseudoranges of m receptions.

    Parameters
    ----------
    epoch : int array (m,)
        Number of the epoch.
    time : array (m,)
        Seconds of GPS time since 1980.
    satellite : object array (m,)
        Names.
    place : array (m, 3)
        Position of each satellite at transmission, in the ECEF axes at reception, metres.
    z : array (m,)
        Pseudoranges without satellite clock errors and modelled delays of the atmosphere, metres.
    sigma : array (m,)
        Standard deviations of the pseudoranges, metres.
    about : tuple of (str, str)
        Interpretation of the file.
    notes : tuple of str
        Assumptions, and observations that were left out.
    """

    epoch: Array
    time: Array
    satellite: Array
    place: Array
    z: Array
    sigma: Array
    about: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]


def is_log(path: Path) -> bool:
    """Return whether a file is a raw log of Android's GnssLogger."""
    try:
        with path.open("rb") as file:
            return b"# Raw," in file.read(20_000)
    except OSError:
        return False


def is_gnss(path: Path) -> bool:
    """Return whether a file has observations of a GNSS receiver."""
    return is_rinex(path) or is_log(path)


def received(
    source: Path, navigation: Path | None, sigma: str | None, *, system: str | None = None, mask: str | None = None
) -> Received:
    """Return the corrected pseudoranges of a file with satellite positions.

    Parameters
    ----------
    source, navigation : Path
        RINEX observations or an Android log, and RINEX navigation.
    sigma : str
        Error of a pseudorange at the zenith, such as "3 m"; it grows with the inverse sine of the elevation.
    system : str, optional
        Letter of one satellite system; by default GPS. Other systems have other clocks.
    mask : str, optional
        Lowest elevation of satellites, such as "15 deg".

    Raises
    ------
    InvalidProblem
        The message names the file and its line, or the missing option.
    """
    letter = (system or "G").upper()
    if letter not in SYSTEMS:
        choices = ", ".join(f"{key} ({name})" for key, name in SYSTEMS.items())
        raise InvalidProblem(f"there is no system {system!r}", "--system", f"write one of {choices}")
    if navigation is None:
        advice = "give the RINEX navigation file of that day with --navigation"
        raise InvalidProblem("the satellite positions are unknown", "--navigation", advice)
    if sigma is None:
        advice = "state --sigma '3 m'; it is divided by the sine of the elevation"
        raise InvalidProblem("the accuracy of the pseudoranges is unknown", "--sigma", advice)
    accuracy = Units("length").plain(sigma, "m", "--sigma")
    least = np.radians(MASK) if mask is None else Units("angle").plain(mask, "deg", "--mask")
    seen = read_observations(source, letter) if is_rinex(source) else read_log(source, letter)
    known = read_navigation(navigation)
    chosen, place, z, notes = _at_transmission(seen, known.ephemerides, letter)
    times, epoch = np.unique(seen.time[chosen], return_inverse=True)
    rough = _first_pass(source, epoch, turned(place, z / SPEED_OF_LIGHT), z, len(times))[epoch]
    # from the distance, since a pseudorange includes the receiver clock error
    flight = np.linalg.norm(place - rough, axis=-1) / SPEED_OF_LIGHT
    place = turned(place, flight)
    (lat, lon, height), elevation, azimuth = _sky(rough, place)
    z = z - troposphere(lat, height, np.maximum(elevation, np.radians(1.0)))
    if known.ionosphere is None:
        notes += ("delays of the ionosphere, about 2 to 30 m, are unknown: include them in --sigma",)
    else:
        z = z - ionosphere(known.ionosphere, (lat, lon), azimuth, elevation, seen.time[chosen])
    high = elevation >= least
    if not high.any():
        raise InvalidProblem("no satellite is above the mask", "--mask", "lower it, or check that the days agree")
    low = int((~high).sum())
    notes += (f"{low} pseudoranges of satellites below {np.degrees(least):g} deg are left out",) if low else ()
    about = (
        ("pseudoranges", f"{int(high.sum())} of {SYSTEMS[letter]}, {seen.code}, with a clock of each epoch"),
        ("epochs", f"{len(np.unique(epoch[high]))} of {len(times)}, seconds of GPS time since 1980"),
        ("satellites", f"{len(set(seen.satellite[chosen][high]))} by {known.source}, turned with the Earth"),
        ("corrections", f"satellite clocks, troposphere{', ionosphere' if known.ionosphere is not None else ''}"),
        ("sigma", f"{accuracy:g} m over the sine of the elevation"),
    )
    chosen, remarks = chosen[high], (*seen.notes, *notes)
    error = accuracy / np.sin(elevation[high])
    return Received(epoch[high], seen.time[chosen], seen.satellite[chosen], place[high], z[high], error, about, remarks)


def _at_transmission(
    seen: Observations, ephemerides: Mapping[str, Ephemeris], system: str
) -> tuple[Array, Array, Array, tuple[str, ...]]:
    """Return the observations that have a healthy ephemeris, with the positions of their satellites at transmission.

    The result has the indices (n,) of these observations in the order of time, and the satellite positions (n, 3),
    ECEF, m. It also has the pseudoranges without the satellite clock errors (n,), m, and notes. Positions are in the
    Earth axes at transmission. `system` is the letter of the satellite system.
    """
    count = len(seen.time)
    place, clock, good = np.full((count, 3), np.nan), np.full(count, np.nan), np.zeros(count, dtype=bool)
    sent = seen.time - seen.pseudorange / SPEED_OF_LIGHT
    for name in set(seen.satellite):
        rows = np.flatnonzero(seen.satellite == name)
        if name not in ephemerides:
            continue
        every = ephemerides[name]
        # age (rows, ephemerides), s; infinite for an ephemeris of an unhealthy satellite
        age = np.abs(sent[rows, None] - every.toe) + np.where(every.health == 0.0, 0.0, np.inf)
        nearest = age.argmin(1)
        fresh = np.take_along_axis(age, nearest[:, None], axis=1)[:, 0] <= _MAX_AGE
        rows, elements = rows[fresh], Ephemeris(*(column[nearest[fresh]] for column in every))
        # transmission time = time of the satellite clock minus its error
        _, ahead = orbit(elements, system, sent[rows])
        place[rows], clock[rows] = orbit(elements, system, sent[rows] - ahead)
        good[rows] = True
    if not good.any():
        what = f"no satellite has a healthy ephemeris within {_MAX_AGE / 3600.0:g} hours"
        raise InvalidProblem(what, "--navigation", "use the navigation file of that day")
    left_out = int((~good).sum())
    notes = (f"{left_out} pseudoranges of satellites without a healthy ephemeris are left out",) if left_out else ()
    chosen = np.flatnonzero(good)
    chosen = chosen[np.argsort(seen.time[chosen], kind="stable")]
    twice = {*zip(seen.time[chosen].tolist(), seen.satellite[chosen], strict=True)}
    if len(twice) < len(chosen):
        what = f"{len(chosen) - len(twice)} satellites occur twice at one time"
        raise InvalidProblem(what, seen.source, "remove the repeated epochs")
    return chosen, place[chosen], (seen.pseudorange + SPEED_OF_LIGHT * clock)[chosen], notes


def _first_pass(source: Path, epoch: Array, place: Array, z: Array, count: int, *, level: bool = False) -> Array:
    """Return the receiver position at each epoch (count, 3), ECEF, m, accurate to some hundred metres.

    `epoch` (n,) are the epoch numbers, sorted. `place` (n, 3) are the satellite positions, and `z` (n,) the
    pseudoranges, m. No first guess is needed. With `level`, the receiver is on the ground, and three satellites are
    enough. An epoch without a fix gets the position of the nearest epoch.
    """
    from optloc.linear.constraints import height
    from optloc.solvers.solution import solve

    # number of each satellite in its epoch, 0, 1 and so on; epochs are sorted
    slot = np.arange(len(epoch)) - np.searchsorted(epoch, epoch)
    width = int(slot.max()) + 1
    stations, ranges, weight = np.zeros((count, width, 3)), np.zeros((count, width)), np.zeros((count, width))
    stations[:] = place[0]  # any finite position, for places that stay empty: their weight is 0
    stations[epoch, slot], ranges[epoch, slot], weight[epoch, slot] = place, z, 1.0
    least, on_ground = (_MIN_SATELLITES - 1, height(0.0, 0.0)) if level else (_MIN_SATELLITES, ())
    enough = np.flatnonzero(weight.sum(1) >= least)
    found = np.full((count, 3), np.nan)
    if len(enough):
        rows = measured("toa", ranges[enough], a=np.arange(width), sigma=10.0, weight=weight[enough])
        problem = assemble(station_array(stations[enough, None]), rows, frame=ECEF, constraints=on_ground)
        fix = solve(problem, "auto" if level else "gtrs+lsr")
        found[enough] = np.where(np.linalg.norm(fix.position, axis=-1)[:, None] < _MAX_RADIUS, fix.position, np.nan)
    good = np.flatnonzero(np.isfinite(found).all(-1))
    if not len(good):
        what = f"no epoch has {least} satellites that give a position"
        raise InvalidProblem(what, source.name, "check that both files are of one day, or use another --system")
    # an epoch without a fix takes the position of the nearest epoch
    after = np.searchsorted(good, np.arange(count)).clip(max=len(good) - 1)
    before = (after - 1).clip(min=0)
    nearer = np.arange(count) - good[before] <= good[after] - np.arange(count)
    return found[good[np.where(nearer & (good[before] <= np.arange(count)), before, after)]]


# Passes of the rotation of satellites in a table. The first has the error of the Earth rotation in a flight time, 150
# m. The second has the error of the rotation while light travels this error, 1 mm. The third is below rounding.
_PASSES = 3


def at_reception(source: Path, epoch: Array, place: Array, z: Array) -> Array:
    """Return satellite positions at transmission (n, 3), m, in the Earth axes at reception.

    `epoch` (n,) has the epoch labels, `place` (n, 3) the positions in the Earth axes at transmission, m, and `z` (n,)
    the pseudoranges, m. The flight time comes from the distance, since a pseudorange includes the receiver clock error
    of up to a second. Raise InvalidProblem if no epoch has enough satellites for a fix.
    """
    labels, number = np.unique(np.asarray(epoch).astype(str), return_inverse=True)
    order = np.argsort(number, kind="stable")
    number, place, z = number[order], place[order], z[order]
    now = place
    for _ in range(_PASSES):
        rough = _rough_position(source, number, now, z, len(labels))[number]
        now = turned(place, np.linalg.norm(now - rough, axis=-1) / SPEED_OF_LIGHT)
    out = np.empty_like(now)
    out[order] = now
    return out


def _rough_position(source: Path, epoch: Array, place: Array, z: Array, count: int) -> Array:
    """Return the receiver position of a table at each epoch (count, 3), ECEF, m, accurate to some hundred metres.

    Parameters are as in `_first_pass`. If no epoch has four satellites that give a position, a receiver on the ground
    is assumed.
    """
    try:
        return _first_pass(source, epoch, place, z, count)
    except InvalidProblem:
        # Three satellites suffice for a receiver on the ground: a height error of a kilometre shifts satellites by
        # millimetres.
        try:
            return _first_pass(source, epoch, place, z, count, level=True)
        except InvalidProblem as error:
            advice = "use --turned if the positions are already in the Earth axes at reception"
            what = f"{error.what}, so satellite positions cannot be rotated with the Earth"
            raise InvalidProblem(what, source.name, advice) from None


def _sky(rough: Array, place: Array) -> tuple[tuple[Array, Array, Array], Array, Array]:
    """Return the geodetic positions of receivers, and the directions of satellites as seen from them.

    The result is ((latitude, longitude, height), elevation, azimuth), arrays (n,), rad and m; azimuths are clockwise
    from north. `rough` (n, 3) are the receivers and `place` (n, 3) the satellites, ECEF, m.
    """
    lat, lon, height = ECEF.to_geodetic(rough)
    direction = place - rough
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    north = np.cross(up, east)
    elevation = np.arcsin((direction * up).sum(-1))
    return (lat, lon, height), elevation, np.arctan2((direction * east).sum(-1), (direction * north).sum(-1))


# Android.


def read_log(path: Path, system: str) -> Observations:
    """Return the pseudoranges of one system in a GnssLogger log; raise InvalidProblem if required data are missing.

    `system` is the letter of the satellite system.
    """
    table = _raw(path)
    more = {name: _or_zero(table, name) for name in ("BiasNanos", "TimeOffsetNanos", "HardwareClockDiscontinuityCount")}
    whole = {name: _whole(table, name) for name in ("TimeNanos", "FullBiasNanos", "ReceivedSvTimeNanos")}
    letters = np.array([_CONSTELLATIONS.get(str(v).split(".")[0], "") for v in table.raw("ConstellationType")])
    state = _or_zero(table, "State").astype(np.int64)
    good = (letters == system) & ((state & _TRACKED) > 0) & ((state & _TIMED) > 0)
    good &= _or_zero(table, "ReceivedSvTimeUncertaintyNanos") < _MAX_UNCERTAINTY
    carrier = _or_zero(table, "CarrierFrequencyHz")
    good &= (carrier > _MIN_FREQUENCY) | (carrier == 0.0)
    if not good.any():
        advice = "use another with --system; phones need a minute to find the time"
        raise InvalidProblem(f"there is no {SYSTEMS[system]} signal with a known time", path.name, advice)
    # without a clock discontinuity, keep the first bias: then clock drift is part of the receiver clock error
    count = more["HardwareClockDiscontinuityCount"]
    _, first, run = np.unique(count[good], return_index=True, return_inverse=True)
    first = np.flatnonzero(good)[first][run]
    rows = np.flatnonzero(good)
    clock = whole["TimeNanos"][rows] - whole["FullBiasNanos"][first]  # whole nanoseconds: 19 digits
    rest = more["TimeOffsetNanos"][rows] - more["BiasNanos"][first]
    week = int(WEEK * 1e9)
    flight_ns = (clock % week - whole["ReceivedSvTimeNanos"][rows]).astype(float) + rest
    flight_ns -= week * np.round(flight_ns / week)  # at the turn of a week
    names = [f"{system}{int(v) - (_QZSS if system == 'J' else 0):02d}" for v in table.numbers("Svid")[rows]]
    # a satellite that occurs twice at one time keeps its first row: in reversed order, the first row is stored last
    keys = {(t, name): k for k, (t, name) in reversed([*enumerate(zip(clock.tolist(), names, strict=True))])}
    kept = np.array(sorted(keys.values(), key=lambda k: (clock[k], k)))
    far = flight_ns[kept] * 1e-9 * SPEED_OF_LIGHT
    if not ((far > 0.0) & (far < 1e8)).any():
        raise InvalidProblem(
            "the times give no valid distance of a satellite", path.name, "check that the log is complete"
        )
    kept, far = kept[(far > 0.0) & (far < 1e8)], far[(far > 0.0) & (far < 1e8)]
    left_out = table.count - len(kept)
    notes = (
        (f"{left_out} rows of other systems, frequencies, or without a known time are left out",) if left_out else ()
    )
    return Observations(
        path.name, clock[kept] * 1e-9, np.array(names, dtype=object)[kept], far, "raw times of Android", notes
    )


def _raw(path: Path) -> Table:
    """Return the rows "Raw" of a log as a table; raise InvalidProblem for a log without them."""
    lines = decoded(read_bytes(path, lines=True), path.name).splitlines()
    head = next((line for line in lines if line.startswith("# Raw,")), None)
    rows = [line.removeprefix("Raw,") for line in lines if line.startswith("Raw,")]
    if head is None or not rows:
        advice = "enable measurements, and log again"
        raise InvalidProblem("the log has no rows that begin with Raw", path.name, advice)
    names = [name.strip() for name in head.removeprefix("# Raw,").split(",")]
    return of_rows([dict(zip(names, row.split(","), strict=False)) for row in rows], path.name, {})


def _or_zero(table: Table, name: str) -> Array:
    """Return a column of numbers (m,); empty cells and a missing column are zero."""
    return np.nan_to_num(table.numbers(name, optional=True)) if table.has(name) else np.zeros(table.count)


def _whole(table: Table, name: str) -> Array:
    """Return a column of integers (m,) with up to 19 digits; empty cells are zero."""
    out = []
    for row, text in enumerate(table.raw(name)):
        try:
            out.append(int(str(text or 0).partition(".")[0] or 0))
        except ValueError:
            raise InvalidProblem(f"{text!r} is not a number", table.where(name, row), "correct the row") from None
    return np.array(out, dtype=np.int64)

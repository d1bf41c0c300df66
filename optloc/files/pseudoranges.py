"""Pseudoranges of a receiver, with what broadcast ephemerides say of the satellites: RINEX files and Android logs.

A pseudorange becomes an arrival at the place where the satellite was when it sent, turned with the Earth during the
flight, free of the satellite's clock. Where satellites stand in the sky, which the atmosphere depends on, is seen from
fixes of a first pass: no place is asked for.

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
from optloc.files.schema import Units
from optloc.files.table import Table, of_rows
from optloc.problem.build import assemble, measured, station_array

# Seconds from its reference time at which an ephemeris still holds: fits are of four hours, and Galileo's of as many.
_FRESH = 7200.0
# Elevation below which refraction and reflections outgrow the noise, degrees: the usual mask of surveyors.
MASK = 10.0
# Satellites that fix a receiver and its clock, and Earth radii that no receiver is beyond in the first pass, metres.
_ENOUGH, _BEYOND = 4, 1e7
# Bits of the state of an Android measurement: its code is tracked, and the time of its week is known.
_TRACKED, _TIMED = 1, 8 | 16384
# Nanoseconds of uncertainty beyond which a time of Android is none, and hertz above which a signal is of L1 or E1.
_SHARP, _FIRST = 500.0, 1.5e9
_CONSTELLATIONS = {"1": "G", "4": "J", "6": "E"}
_QZSS = 192  # numbers of its satellites begin behind it


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
        Where each satellite was, ECEF, metres.
    z, sigma : array (m,)
        Pseudoranges free of satellite clocks and of what is known of the atmosphere, and their errors, metres.
    about : tuple of (str, str)
        What was understood.
    notes : tuple of str
        What was assumed and left out.
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
    """Return whether a file holds what a receiver of navigation satellites has seen."""
    return is_rinex(path) or is_log(path)


def received(
    source: Path, navigation: Path | None, sigma: str | None, *, system: str | None = None, mask: str | None = None
) -> Received:
    """Return the pseudoranges of a file with the satellites' places.

    Parameters
    ----------
    source, navigation : Path
        RINEX observations or a log of Android, and RINEX navigation.
    sigma : str
        Error of a pseudorange at the zenith, such as "3 m"; it grows with the inverse sine of the elevation.
    system : str, optional
        Letter of the one system that is taken; GPS. Another has a clock of its own.
    mask : str, optional
        Elevation below which satellites are left out, such as "15 deg".

    Raises
    ------
    InvalidProblem
        Naming the file, its line, or the option that lacks.
    """
    letter = (system or "G").upper()
    if letter not in SYSTEMS:
        told = ", ".join(f"{key} ({name})" for key, name in SYSTEMS.items())
        raise InvalidProblem(f"there is no system {system!r}", "--system", f"write one of {told}")
    if navigation is None:
        advice = "name the RINEX navigation file of that day with --navigation"
        raise InvalidProblem("nothing is known of where the satellites are", "--navigation", advice)
    if sigma is None:
        advice = "say it with --sigma '3 m'; it is divided by the sine of the elevation"
        raise InvalidProblem("nothing is known of how accurate the pseudoranges are", "--sigma", advice)
    accuracy = Units("length").plain(sigma, "m", "--sigma")
    least = np.radians(MASK) if mask is None else Units("angle").plain(mask, "deg", "--mask")
    seen = read_observations(source, letter) if is_rinex(source) else read_log(source, letter)
    known = read_navigation(navigation)
    chosen, place, z, notes = _sent(seen, known.ephemerides, letter)
    times, epoch = np.unique(seen.time[chosen], return_inverse=True)
    rough = _first_pass(source, epoch, turned(place, z / SPEED_OF_LIGHT), z, len(times))[epoch]
    # by the way itself: the pseudorange has the receiver's clock in it
    flight = np.linalg.norm(place - rough, axis=-1) / SPEED_OF_LIGHT
    place = turned(place, flight)
    (lat, lon, height), elevation, azimuth = _sky(rough, place)
    z = z - troposphere(lat, height, np.maximum(elevation, np.radians(1.0)))
    if known.ionosphere is None:
        notes += ("no delays of the ionosphere are known, of some 2 to 30 m: let --sigma hold them",)
    else:
        z = z - ionosphere(known.ionosphere, (lat, lon), azimuth, elevation, seen.time[chosen])
    high = elevation >= least
    if not high.any():
        raise InvalidProblem("no satellite is above the mask", "--mask", "lower it, or see whether the days agree")
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


def _sent(
    seen: Observations, ephemerides: Mapping[str, Ephemeris], system: str
) -> tuple[Array, Array, Array, tuple[str, ...]]:
    """Return which observations have an ephemeris, in order of time, places (n, 3) at sending, ranges, and remarks."""
    count = len(seen.time)
    place, clock, good = np.full((count, 3), np.nan), np.full(count, np.nan), np.zeros(count, dtype=bool)
    sent = seen.time - seen.pseudorange / SPEED_OF_LIGHT
    for name in set(seen.satellite):
        rows = np.flatnonzero(seen.satellite == name)
        if name not in ephemerides:
            continue
        every = ephemerides[name]
        apart = np.abs(sent[rows, None] - every.toe) + np.where(every.health == 0.0, 0.0, np.inf)
        nearest = apart.argmin(1)
        fresh = np.take_along_axis(apart, nearest[:, None], axis=1)[:, 0] <= _FRESH
        rows, own = rows[fresh], Ephemeris(*(column[nearest[fresh]] for column in every))
        # the time of sending is that of the satellite's clock less what this is ahead
        _, ahead = orbit(own, system, sent[rows])
        place[rows], clock[rows] = orbit(own, system, sent[rows] - ahead)
        good[rows] = True
    if not good.any():
        what = f"no satellite has a healthy ephemeris within {_FRESH / 3600.0:g} hours"
        raise InvalidProblem(what, "--navigation", "name the navigation file of that day")
    left = int((~good).sum())
    notes = (f"{left} pseudoranges of satellites without a healthy ephemeris are left out",) if left else ()
    chosen = np.flatnonzero(good)
    chosen = chosen[np.argsort(seen.time[chosen], kind="stable")]
    twice = {*zip(seen.time[chosen].tolist(), seen.satellite[chosen], strict=True)}
    if len(twice) < len(chosen):
        what = f"{len(chosen) - len(twice)} satellites occur twice at one time"
        raise InvalidProblem(what, seen.source, "leave the repeated epochs out")
    return chosen, place[chosen], (seen.pseudorange + SPEED_OF_LIGHT * clock)[chosen], notes


def _first_pass(source: Path, epoch: Array, place: Array, z: Array, count: int, *, level: bool = False) -> Array:
    """Return where the receiver was at each epoch (count, 3), to some hundred metres, without a guess.

    On the ground (`level`) three satellites are enough.
    """
    from optloc.linear.constraints import height
    from optloc.solvers.solution import solve

    slot = np.arange(len(epoch)) - np.searchsorted(epoch, epoch)  # epochs stand in order
    width = int(slot.max()) + 1
    stations, ranges, weight = np.zeros((count, width, 3)), np.zeros((count, width)), np.zeros((count, width))
    stations[:] = place[0]
    stations[epoch, slot], ranges[epoch, slot], weight[epoch, slot] = place, z, 1.0
    least, held = (_ENOUGH - 1, height(0.0, 0.0)) if level else (_ENOUGH, ())
    enough = np.flatnonzero(weight.sum(1) >= least)
    found = np.full((count, 3), np.nan)
    if len(enough):
        rows = measured("toa", ranges[enough], a=np.arange(width), sigma=10.0, weight=weight[enough])
        problem = assemble(station_array(stations[enough, None]), rows, frame=ECEF, constraints=held)
        fix = solve(problem, "auto" if level else "gtrs+lsr")
        found[enough] = np.where(np.linalg.norm(fix.position, axis=-1)[:, None] < _BEYOND, fix.position, np.nan)
    good = np.flatnonzero(np.isfinite(found).all(-1))
    if not len(good):
        what = f"no epoch has {least} satellites that fix a place"
        raise InvalidProblem(what, source.name, "see whether both files are of one day, or name another --system")
    # an epoch without one is near its neighbours
    after = np.searchsorted(good, np.arange(count)).clip(max=len(good) - 1)
    before = (after - 1).clip(min=0)
    nearer = np.arange(count) - good[before] <= good[after] - np.arange(count)
    return found[good[np.where(nearer & (good[before] <= np.arange(count)), before, after)]]


# Passes that turn satellites of a table: the first is off by what the Earth turns in a flight, 150 m, the second by
# what it turns while light covers these, 1 mm, and the third by less than rounding.
_PASSES = 3


def at_reception(source: Path, epoch: Array, place: Array, z: Array) -> Array:
    """Return where satellites were when they sent (n, 3), along the axes that the Earth has at reception.

    How long a signal flew is seen from the distance of its satellite: a pseudorange holds the clock of the receiver,
    which may be a second off.

    Parameters
    ----------
    source : Path
        The table, to be named.
    epoch : object array (n,)
        Label of the epoch of each pseudorange.
    place : array (n, 3)
        Satellites along the axes of the Earth at transmission, metres.
    z : array (n,)
        Pseudoranges, metres.

    Raises
    ------
    InvalidProblem
        Where no epoch has the satellites that fix a receiver.
    """
    labels, number = np.unique(np.asarray(epoch).astype(str), return_inverse=True)
    order = np.argsort(number, kind="stable")
    number, place, z = number[order], place[order], z[order]
    now = place
    for _ in range(_PASSES):
        rough = _rough(source, number, now, z, len(labels))[number]
        now = turned(place, np.linalg.norm(now - rough, axis=-1) / SPEED_OF_LIGHT)
    out = np.empty_like(now)
    out[order] = now
    return out


def _rough(source: Path, epoch: Array, place: Array, z: Array, count: int) -> Array:
    """Return where the receiver of a table was at each epoch (count, 3), to some hundred metres."""
    try:
        return _first_pass(source, epoch, place, z, count)
    except InvalidProblem:
        # Three satellites fix a receiver on the ground: a kilometre of height turns them by some millimetres.
        try:
            return _first_pass(source, epoch, place, z, count, level=True)
        except InvalidProblem as error:
            advice = "say --turned if they are along the axes of the Earth at reception already"
            what = f"{error.what}, and their satellites cannot be turned with the Earth"
            raise InvalidProblem(what, source.name, advice) from None


def _sky(rough: Array, place: Array) -> tuple[tuple[Array, Array, Array], Array, Array]:
    """Return latitudes, longitudes and heights of places (n, 3), and elevation and azimuth of satellites (n, 3)."""
    lat, lon, height = ECEF.to_geodetic(rough)
    way = place - rough
    way = way / np.linalg.norm(way, axis=-1, keepdims=True)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    north = np.cross(up, east)
    elevation = np.arcsin((way * up).sum(-1))
    return (lat, lon, height), elevation, np.arctan2((way * east).sum(-1), (way * north).sum(-1))


# Android.


def read_log(path: Path, system: str) -> Observations:
    """Return the pseudoranges of one system in a log of GnssLogger; raise InvalidProblem naming what it lacks."""
    table = _raw(path)
    more = {name: _or_zero(table, name) for name in ("BiasNanos", "TimeOffsetNanos", "HardwareClockDiscontinuityCount")}
    whole = {name: _whole(table, name) for name in ("TimeNanos", "FullBiasNanos", "ReceivedSvTimeNanos")}
    letters = np.array([_CONSTELLATIONS.get(str(v).split(".")[0], "") for v in table.raw("ConstellationType")])
    state = _or_zero(table, "State").astype(np.int64)
    good = (letters == system) & ((state & _TRACKED) > 0) & ((state & _TIMED) > 0)
    good &= _or_zero(table, "ReceivedSvTimeUncertaintyNanos") < _SHARP
    carrier = _or_zero(table, "CarrierFrequencyHz")
    good &= (carrier > _FIRST) | (carrier == 0.0)
    if not good.any():
        advice = "name another with --system; phones need a minute to know the time"
        raise InvalidProblem(f"there is no {SYSTEMS[system]} signal whose time is known", path.name, advice)
    # a clock that has not begun anew keeps its first bias: its drift is that of the receiver
    count = more["HardwareClockDiscontinuityCount"]
    _, first, run = np.unique(count[good], return_index=True, return_inverse=True)
    first = np.flatnonzero(good)[first][run]
    rows = np.flatnonzero(good)
    clock = whole["TimeNanos"][rows] - whole["FullBiasNanos"][first]  # whole nanoseconds: 19 digits
    rest = more["TimeOffsetNanos"][rows] - more["BiasNanos"][first]
    week = int(WEEK * 1e9)
    apart = (clock % week - whole["ReceivedSvTimeNanos"][rows]).astype(float) + rest
    apart -= week * np.round(apart / week)  # at the turn of a week
    names = [f"{system}{int(v) - (_QZSS if system == 'J' else 0):02d}" for v in table.numbers("Svid")[rows]]
    keys = {(t, name): k for k, (t, name) in reversed([*enumerate(zip(clock.tolist(), names, strict=True))])}
    kept = np.array(sorted(keys.values(), key=lambda k: (clock[k], k)))
    far = apart[kept] * 1e-9 * SPEED_OF_LIGHT
    if not ((far > 0.0) & (far < 1e8)).any():
        raise InvalidProblem("the times say no distance of a satellite", path.name, "see whether the log is whole")
    kept, far = kept[(far > 0.0) & (far < 1e8)], far[(far > 0.0) & (far < 1e8)]
    left = table.count - len(kept)
    notes = (f"{left} rows of other systems, frequencies, or without a known time are left out",) if left else ()
    return Observations(
        path.name, clock[kept] * 1e-9, np.array(names, dtype=object)[kept], far, "raw times of Android", notes
    )


def _raw(path: Path) -> Table:
    """Return the rows "Raw" of a log as a table."""
    lines = decoded(read_bytes(path, lines=True), path.name).splitlines()
    head = next((line for line in lines if line.startswith("# Raw,")), None)
    rows = [line.removeprefix("Raw,") for line in lines if line.startswith("Raw,")]
    if head is None or not rows:
        advice = "switch measurements on, and log anew"
        raise InvalidProblem("the log has no rows that begin with Raw", path.name, advice)
    names = [name.strip() for name in head.removeprefix("# Raw,").split(",")]
    return of_rows([dict(zip(names, row.split(","), strict=False)) for row in rows], path.name, {})


def _or_zero(table: Table, name: str) -> Array:
    """Return a column of numbers, zero where it has none."""
    return np.nan_to_num(table.numbers(name, optional=True)) if table.has(name) else np.zeros(table.count)


def _whole(table: Table, name: str) -> Array:
    """Return a column of whole numbers of up to 19 digits (m,), zero where there is none."""
    out = []
    for row, text in enumerate(table.raw(name)):
        try:
            out.append(int(str(text or 0).partition(".")[0] or 0))
        except ValueError:
            raise InvalidProblem(f"{text!r} is no number", table.where(name, row), "correct the row") from None
    return np.array(out, dtype=np.int64)

"""RINEX 2 and 3: pseudoranges of observation files and ephemerides of navigation files.

This module reads the files without a library: georinex 1.16 skips invalid lines without a warning, and depends on
xarray and netCDF4 for a table of fixed columns. Here, an error message names an invalid line.

Sources: W. Gurtner, L. Estey, "RINEX: The Receiver Independent Exchange Format", versions 2.11 (2007) and 3.05 (2020).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import check_budget, read_bytes
from optloc.base.types import Array
from optloc.files.broadcast import Ephemeris

WEEK = 604800.0
_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
# Codes of first-frequency pseudoranges, the code of most receivers first.
_CODES = {"G": ("C1C", "C1W", "C1X", "C1", "P1"), "E": ("C1C", "C1X", "C1B", "C1"), "J": ("C1C", "C1X", "C1")}
SYSTEMS = {"G": "GPS", "E": "Galileo", "J": "QZSS"}
"""Satellite systems with supported ephemerides, by letter."""
# Time scales that are equal to GPS time.
_SCALES = ("", "GPS", "GAL", "QZS")
_LABEL = 60  # column of the label in a header line
_FIELD, _NUMBER, _ELEMENT = 16, 14, 19  # characters of an observation with flags, without flags, and of an element
_LINES, _EVENTS = 8, 2  # lines of an ephemeris; lowest flag of an event instead of observations
_WRAPPED = {"satellites": 12, "observations": 5}  # entries per line in version 2


@dataclass(frozen=True, slots=True)
class Observations:
    """Pseudoranges of a receiver.

    Parameters
    ----------
    source : str
        Name of the file.
    time : array (m,)
        Reception times by the receiver clock, seconds of GPS time since 1980.
    satellite : object array (m,)
        Names such as "G07".
    pseudorange : array (m,)
        Metres.
    code : str
        Observation code, such as "C1C".
    notes : tuple of str
        Observations that were left out.
    """

    source: str
    time: Array
    satellite: Array
    pseudorange: Array
    code: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Navigation:
    """Broadcast ephemerides by satellite name, and the eight ionosphere coefficients or None."""

    source: str
    ephemerides: Mapping[str, Ephemeris]
    ionosphere: Array | None


@dataclass(frozen=True, slots=True)
class _File:
    """A RINEX file: its header lines as (label, text), and the lines after the header.

    version: version of the format. letter: type of the file, O for observations. first: number of the first line after
    the header, for messages.
    """

    source: str
    version: float
    letter: str
    header: tuple[tuple[str, str], ...]
    lines: tuple[str, ...]
    first: int

    def at(self, i: int) -> str:
        """Return the place of a line, counted from 0 after the header, for messages."""
        return f"{self.source}, line {self.first + i}"

    def line(self, i: int) -> str:
        """Return a line, counted from 0 after the header; raise InvalidProblem beyond the end of the file."""
        if i >= len(self.lines):
            raise InvalidProblem("the file ends within a record", self.source, "copy the file again")
        return self.lines[i]


def is_rinex(path: Path) -> bool:
    """Return whether the first line of a file has the RINEX label."""
    try:
        with path.open("rb") as file:
            return b"RINEX VERSION" in file.readline(200)
    except OSError:
        return False


def _read(path: Path, kind: str, letters: str) -> _File:
    """Return a RINEX file; raise InvalidProblem for another version or type.

    `kind` is "observation" or "navigation", and `letters` are the permitted types of files.
    """
    source = path.name
    lines = read_bytes(path, lines=True).decode("ascii", errors="replace").splitlines()
    if not lines or "RINEX VERSION" not in lines[0]:
        raise InvalidProblem("this is not a RINEX file", source, f"name a RINEX {kind} file")
    if "CRINEX" in lines[0]:
        raise InvalidProblem("the file is compressed by Hatanaka's method", source, "expand it with crx2rnx")
    try:
        version, letter = float(lines[0][:9]), lines[0][20:21]
    except ValueError:
        raise InvalidProblem("the version is not a number", f"{source}, line 1", "copy the file again") from None
    if not 2.0 <= version < 4.0:
        raise InvalidProblem(f"RINEX {version:g} is not supported", source, "convert it to version 3")
    if letter not in letters:
        what = f"the file is of type {letter!r}, which has no {'ephemerides' if kind == 'navigation' else 'ranges'}"
        raise InvalidProblem(what, source, f"name a RINEX {kind} file of GPS, Galileo or QZSS")
    end = next((i for i, line in enumerate(lines) if line[_LABEL:].strip() == "END OF HEADER"), None)
    if end is None:
        raise InvalidProblem("the header has no end", source, "copy the file again")
    header = tuple((line[_LABEL:].strip(), line[:_LABEL]) for line in lines[:end])
    return _File(source, version, letter, header, tuple(lines[end + 1 :]), end + 2)


def _number(file: _File, i: int, text: str, what: str) -> float:
    """Return a number, which may have a Fortran exponent (1.5D-3).

    `i` is its line, and `what` the noun for the message of InvalidProblem.
    """
    try:
        return float(text.replace("D", "E").replace("d", "e"))
    except ValueError:
        raise InvalidProblem(f"{what} {text.strip()[:20]!r} is not a number", file.at(i), "correct the line") from None


def _seconds(file: _File, i: int, text: str) -> float:
    """Return a calendar time as seconds since 1980-01-06; years may have two digits. `i` is the line for messages."""
    parts = text.split()
    try:
        year, month, day, hour, minute = map(int, parts[:5])
        year += 0 if year > 99 else 1900 if year > 79 else 2000  # two-digit years of version 2
        whole = (datetime(year, month, day, tzinfo=UTC) - _EPOCH).total_seconds()
        return whole + 3600.0 * hour + 60.0 * minute + float(parts[5])
    except (ValueError, IndexError):
        raise InvalidProblem(f"{text.strip()[:40]!r} is not a time", file.at(i), "correct the line") from None


def _satellite_name(text: str) -> str:
    """Return the name of a satellite; version 2 may omit the letter of GPS."""
    text = text.ljust(3)
    return f"{text[0] if text[0] != ' ' else 'G'}{text[1:3].strip().zfill(2)}"


# Observations.


def read_observations(path: Path, system: str) -> Observations:
    """Return the pseudoranges of one system in a RINEX observation file; raise InvalidProblem with the line."""
    file = _read(path, "observation", "O")
    scale = next((text[48:51].strip() for label, text in file.header if label == "TIME OF FIRST OBS"), "")
    if scale not in _SCALES:
        raise InvalidProblem(f"the time scale is {scale}", file.source, "convert them to GPS time")
    types = _observation_codes(file, system)
    code = next((each for each in _CODES[system] if each in types), None)
    if code is None:
        what = f"there are no {SYSTEMS[system]} pseudoranges of the first frequency"
        raise InvalidProblem(what, file.source, "name another system with --system, or another file")
    old = file.version < 3.0  # RINEX version
    records = list(_records_of_2(file, len(types)) if old else _records_of_3(file))
    check_budget("rows", len(records), file.source)
    time, satellite, z, others = [], [], [], 0
    for i, seconds, name, text in records:
        start = _FIELD * types.index(code)
        cell = text[start : start + _NUMBER]
        if name[0] != system:
            others += 1
        elif cell.strip() and (value := _number(file, i, cell, "the pseudorange")) > 0.0:
            time.append(seconds)
            satellite.append(name)
            z.append(value)
    if not z:
        raise InvalidProblem(f"there are no {SYSTEMS[system]} pseudoranges", file.source, "name another with --system")
    notes = (f"{others} observations of other systems are left out",) if others else ()
    return Observations(file.source, np.array(time), np.array(satellite, dtype=object), np.array(z), code, notes)


def _observation_codes(file: _File, system: str) -> list[str]:
    """Return the observation codes of a system, such as "C1C", in the order of the columns of a record."""
    if file.version < 3.0:  # RINEX version
        return [word for label, text in file.header if label == "# / TYPES OF OBSERV" for word in text[6:].split()]
    found, system_of_line = [], ""
    for label, text in file.header:
        if label == "SYS / # / OBS TYPES":
            system_of_line = text[0].strip() or system_of_line
            found += text[6:].split() if system_of_line == system else []
    return found


def _records_of_3(file: _File) -> Iterator[tuple[int, float, str, str]]:
    """Yield the line number, the time (s since 1980), the satellite and the text of the observations of each record.

    The file has version 3. Events and other records without observations are skipped.
    """
    i = 0
    while i < len(file.lines):
        line = file.lines[i]
        if not line.strip():
            i += 1
            continue
        if not line.startswith(">"):
            raise InvalidProblem("an epoch must begin with >", file.at(i), "copy the file again")
        flag, count = (int(_number(file, i, line[a:b] or "0", "the count")) for a, b in ((31, 32), (32, 35)))
        if flag < _EVENTS:
            seconds = _seconds(file, i, line[1:29])
            for k in range(i + 1, i + 1 + count):
                yield k, seconds, _satellite_name(file.line(k)), file.line(k)[3:]
        i += 1 + count


def _records_of_2(file: _File, types: int) -> Iterator[tuple[int, float, str, str]]:
    """Yield records as `_records_of_3` for a file of version 2, whose lines have at most 80 columns.

    `types` is the number of observations of a satellite, which determines the number of lines of a record.
    """
    each, i = -(-types // _WRAPPED["observations"]), 0  # `each` is the number of lines of a satellite, rounded up
    while i < len(file.lines):
        line = file.lines[i]
        if not line.strip():
            i += 1
            continue
        flag, count = (int(_number(file, i, line[a:b] or "0", "the count")) for a, b in ((28, 29), (29, 32)))
        if flag >= _EVENTS:
            i += 1 + count
            continue
        seconds, names = _seconds(file, i, line[:26]), ""
        # The list of satellites wraps: three characters each, in the columns 33 to 68 of one or more lines.
        more = max(1, -(-count // _WRAPPED["satellites"]))
        for k in range(i, i + more):
            names += file.line(k)[32:68].ljust(36)
        i += more
        for k in range(count):
            wide = 16 * _WRAPPED["observations"]
            text = "".join(file.line(i + row)[:wide].ljust(wide) for row in range(each))
            yield i, seconds, _satellite_name(names[3 * k : 3 * k + 3]), text
            i += each


# Navigation.

# Index of each element among the numbers of a record; the first line has three numbers, the others four.
_PLACES = {
    "crs": 4, "delta_n": 5, "m0": 6, "cuc": 7, "e": 8, "cus": 9, "root_a": 10, "toe": 11, "cic": 12, "omega0": 13,
    "cis": 14, "i0": 15, "crc": 16, "omega": 17, "omega_dot": 18, "idot": 19, "week": 21, "health": 24,
}  # fmt: skip
# Galileo has two group delays; users of E1 with the I/NAV message need the second.
_DELAY = {"G": 25, "J": 25, "E": 26}
_SHORT = {"R": 4, "S": 4}  # lines of records of other systems; the default is eight
_NEEDED = 22  # an orbit needs these first numbers


def read_navigation(path: Path) -> Navigation:
    """Return the ephemerides of a RINEX navigation file; raise InvalidProblem with the line."""
    file = _read(path, "navigation", "NE" if path.suffix.lower() != ".g" else "N")
    old = file.version < 3.0  # RINEX version
    found: dict[str, list[list[float]]] = {}
    i = 0
    while i < len(file.lines):
        if not file.lines[i].strip():
            i += 1
            continue
        name = _satellite_name(f"G{file.lines[i][:2]}" if old else file.lines[i][:3])
        if not re.fullmatch(r"[A-Z]\d\d", name):
            raise InvalidProblem(
                "an ephemeris must begin with a satellite such as G07", file.at(i), "copy the file again"
            )
        lines = _SHORT.get(name[0], _LINES)  # number of lines of the record, which depends on the system
        if name[0] in SYSTEMS:
            found.setdefault(name, []).append(_elements(file, i, name[0], old=old))
        i += lines
    if not found:
        raise InvalidProblem("there is no ephemeris of GPS, Galileo or QZSS", file.source, "name another file")
    ephemerides = {name: Ephemeris(*np.array(rows).T) for name, rows in found.items()}
    return Navigation(file.source, ephemerides, _ionosphere(file))


def _elements(file: _File, i: int, system: str, *, old: bool) -> list[float]:
    """Return the numbers of one ephemeris in the order of `Ephemeris`.

    `i` is the first of its eight lines. `old` is whether the file has version 2. Raise InvalidProblem for invalid or
    missing numbers.
    """
    indent = 3 if old else 4
    first = file.line(i)
    toc = _seconds(file, i, first[2:22] if old else first[3:23])
    cells = [(i, first[start : start + _ELEMENT]) for start in range(22 if old else 23, 79, _ELEMENT)][:3]
    for k in range(i + 1, i + _LINES):
        line = file.line(k).ljust(80)
        cells += [(k, line[start : start + _ELEMENT]) for start in range(indent, indent + 4 * _ELEMENT, _ELEMENT)]
    lacking = next((k for k, text in cells[:_NEEDED] if not text.strip()), None)
    if lacking is not None:
        raise InvalidProblem("a number is missing in the ephemeris", file.at(lacking), "remove its eight lines")
    # Numbers after the first `_NEEDED` may be empty; they count as zero.
    values = [_number(file, k, text, "the element") if text.strip() else 0.0 for k, text in cells]
    by_name = {name: values[place] for name, place in _PLACES.items()}
    by_name |= {"toc": toc, "tgd": values[_DELAY[system]]} | dict(zip(("af0", "af1", "af2"), values, strict=False))
    # week numbers of old files may have overflowed at 1024: use the week of the clock reference time
    by_name["week"] = WEEK * np.round((toc - by_name["toe"]) / WEEK)
    by_name["toe"] += by_name["week"]
    if not (0.0 <= by_name["e"] < 1.0 and by_name["root_a"] > 0.0):
        raise InvalidProblem("the elements are not an orbit", file.at(i), "remove its eight lines")
    return [by_name[name] for name in Ephemeris._fields]


def _ionosphere(file: _File) -> Array | None:
    """Return the coefficients alpha and beta (8,) of Klobuchar's ionosphere; None if the header does not have both."""
    labels_of_2 = {"ION ALPHA": (2, ""), "ION BETA": (2, "")}
    parts: dict[str, list[float]] = {}
    for label, text in file.header:
        if label in labels_of_2:
            parts[label[4]] = [float(text[2 + 12 * k : 14 + 12 * k].replace("D", "E")) for k in range(4)]
        elif label == "IONOSPHERIC CORR" and text[:4] in ("GPSA", "GPSB"):
            parts[text[3]] = [float(text[5 + 12 * k : 17 + 12 * k].replace("D", "E")) for k in range(4)]
    return np.array(parts["A"] + parts["B"]) if {"A", "B"} <= parts.keys() else None

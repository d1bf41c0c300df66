"""RINEX 2 and 3: pseudoranges of observation files and ephemerides of navigation files.

Read here, not by a library: the one that is kept (georinex 1.16) passes over lines that it cannot read without a word,
and brings xarray and netCDF4 for what is a table of numbers in fixed columns. Here such a line is named.

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
# Pseudoranges of the first frequency, the one that most receivers have first.
_CODES = {"G": ("C1C", "C1W", "C1X", "C1", "P1"), "E": ("C1C", "C1X", "C1B", "C1"), "J": ("C1C", "C1X", "C1")}
SYSTEMS = {"G": "GPS", "E": "Galileo", "J": "QZSS"}
"""Systems whose ephemerides are read, by their letter."""
# Scales that count as GPS time does.
_SCALES = ("", "GPS", "GAL", "QZS")
_LABEL = 60  # column at which the label of a line of the header begins
_FIELD, _NUMBER, _ELEMENT = 16, 14, 19  # widths of an observation with its flags, without, and of an element
_LINES, _EVENTS = 8, 2  # lines of an ephemeris; the first flag of an epoch that is no observation
_WRAPPED = {"satellites": 12, "observations": 5}  # in a line of version 2


@dataclass(frozen=True, slots=True)
class Observations:
    """Pseudoranges of a receiver.

    Parameters
    ----------
    source : str
        Name of the file.
    time : array (m,)
        When each was received by the receiver's clock, seconds of GPS time since 1980.
    satellite : object array (m,)
        Names such as "G07".
    pseudorange : array (m,)
        Metres.
    code : str
        What was read, such as "C1C".
    notes : tuple of str
        What was left out.
    """

    source: str
    time: Array
    satellite: Array
    pseudorange: Array
    code: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Navigation:
    """Broadcast ephemerides of satellites by name, and the ionosphere's eight coefficients where they are known."""

    source: str
    ephemerides: Mapping[str, Ephemeris]
    ionosphere: Array | None


@dataclass(frozen=True, slots=True)
class _File:
    """Lines of a file behind its header, of which the first has a number; labels and texts of the header's lines."""

    source: str
    version: float
    letter: str
    header: tuple[tuple[str, str], ...]
    lines: tuple[str, ...]
    first: int

    def at(self, i: int) -> str:
        return f"{self.source}, line {self.first + i}"

    def line(self, i: int) -> str:
        if i >= len(self.lines):
            raise InvalidProblem("the file ends within a record", self.source, "copy the file anew")
        return self.lines[i]


def is_rinex(path: Path) -> bool:
    """Return whether a file says that it is RINEX."""
    try:
        with path.open("rb") as file:
            return b"RINEX VERSION" in file.readline(200)
    except OSError:
        return False


def _read(path: Path, kind: str, letters: str) -> _File:
    source = path.name
    lines = read_bytes(path, lines=True).decode("ascii", errors="replace").splitlines()
    if not lines or "RINEX VERSION" not in lines[0]:
        raise InvalidProblem("this is no RINEX file", source, f"name a RINEX {kind} file")
    if "CRINEX" in lines[0]:
        raise InvalidProblem("the file is compressed by Hatanaka's method", source, "expand it by crx2rnx")
    try:
        version, letter = float(lines[0][:9]), lines[0][20:21]
    except ValueError:
        raise InvalidProblem("the version is not a number", f"{source}, line 1", "copy the file anew") from None
    if not 2.0 <= version < 4.0:
        raise InvalidProblem(f"RINEX {version:g} is not read", source, "convert it to version 3")
    if letter not in letters:
        what = f"the file is of type {letter!r}, which holds no {'ephemerides' if kind == 'navigation' else 'ranges'}"
        raise InvalidProblem(what, source, f"name a RINEX {kind} file of GPS, Galileo or QZSS")
    end = next((i for i, line in enumerate(lines) if line[_LABEL:].strip() == "END OF HEADER"), None)
    if end is None:
        raise InvalidProblem("the header has no end", source, "copy the file anew")
    header = tuple((line[_LABEL:].strip(), line[:_LABEL]) for line in lines[:end])
    return _File(source, version, letter, header, tuple(lines[end + 1 :]), end + 2)


def _number(file: _File, i: int, text: str, what: str) -> float:
    try:
        return float(text.replace("D", "E").replace("d", "e"))
    except ValueError:
        raise InvalidProblem(f"{what} {text.strip()[:20]!r} is no number", file.at(i), "correct the line") from None


def _seconds(file: _File, i: int, text: str) -> float:
    """Return seconds since 1980 of a calendar time, whose years may have two digits."""
    parts = text.split()
    try:
        year, month, day, hour, minute = map(int, parts[:5])
        year += 0 if year > 99 else 1900 if year > 79 else 2000  # as version 2 counts years
        whole = (datetime(year, month, day, tzinfo=UTC) - _EPOCH).total_seconds()
        return whole + 3600.0 * hour + 60.0 * minute + float(parts[5])
    except (ValueError, IndexError):
        raise InvalidProblem(f"{text.strip()[:40]!r} is no time", file.at(i), "correct the line") from None


def _named(text: str) -> str:
    """Return the name of a satellite, whose system version 2 may leave out: GPS."""
    text = text.ljust(3)
    return f"{text[0] if text[0] != ' ' else 'G'}{text[1:3].strip().zfill(2)}"


# Observations.


def read_observations(path: Path, system: str) -> Observations:
    """Return the pseudoranges of one system in a RINEX observation file; raise InvalidProblem naming the line."""
    file = _read(path, "observation", "O")
    scale = next((text[48:51].strip() for label, text in file.header if label == "TIME OF FIRST OBS"), "")
    if scale not in _SCALES:
        raise InvalidProblem(f"times are those of {scale}", file.source, "convert them to GPS time")
    types = _types(file, system)
    code = next((each for each in _CODES[system] if each in types), None)
    if code is None:
        what = f"there are no {SYSTEMS[system]} pseudoranges of the first frequency"
        raise InvalidProblem(what, file.source, "name another system with --system, or another file")
    old = file.version < 3.0  # the number of a version
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


def _types(file: _File, system: str) -> list[str]:
    """Return what the observations of a system are, in order."""
    if file.version < 3.0:  # the number of a version
        return [word for label, text in file.header if label == "# / TYPES OF OBSERV" for word in text[6:].split()]
    found, whose = [], ""
    for label, text in file.header:
        if label == "SYS / # / OBS TYPES":
            whose = text[0].strip() or whose
            found += text[6:].split() if whose == system else []
    return found


def _records_of_3(file: _File) -> Iterator[tuple[int, float, str, str]]:
    """Yield line, time, satellite and observations of each record of version 3."""
    i = 0
    while i < len(file.lines):
        line = file.lines[i]
        if not line.strip():
            i += 1
            continue
        if not line.startswith(">"):
            raise InvalidProblem("an epoch begins with >", file.at(i), "copy the file anew")
        flag, count = (int(_number(file, i, line[a:b] or "0", "the count")) for a, b in ((31, 32), (32, 35)))
        if flag < _EVENTS:
            seconds = _seconds(file, i, line[1:29])
            for k in range(i + 1, i + 1 + count):
                yield k, seconds, _named(file.line(k)), file.line(k)[3:]
        i += 1 + count


def _records_of_2(file: _File, types: int) -> Iterator[tuple[int, float, str, str]]:
    """Yield the same of version 2, whose lines are of at most 80 columns."""
    each, i = -(-types // _WRAPPED["observations"]), 0
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
        more = max(1, -(-count // _WRAPPED["satellites"]))
        for k in range(i, i + more):
            names += file.line(k)[32:68].ljust(36)
        i += more
        for k in range(count):
            wide = 16 * _WRAPPED["observations"]
            text = "".join(file.line(i + row)[:wide].ljust(wide) for row in range(each))
            yield i, seconds, _named(names[3 * k : 3 * k + 3]), text
            i += each


# Navigation.

# Where each element stands among the numbers of a record, three of its first line and four of each other.
_PLACES = {
    "crs": 4, "delta_n": 5, "m0": 6, "cuc": 7, "e": 8, "cus": 9, "root_a": 10, "toe": 11, "cic": 12, "omega0": 13,
    "cis": 14, "i0": 15, "crc": 16, "omega": 17, "omega_dot": 18, "idot": 19, "week": 21, "health": 24,
}  # fmt: skip
# Galileo has two delays: for users of E1 who take the I/NAV message, the second.
_DELAY = {"G": 25, "J": 25, "E": 26}
_SHORT = {"R": 4, "S": 4}  # lines of records of other systems, of eight else
_NEEDED = 22  # numbers without which there is no orbit


def read_navigation(path: Path) -> Navigation:
    """Return the ephemerides of a RINEX navigation file; raise InvalidProblem naming the line."""
    file = _read(path, "navigation", "NE" if path.suffix.lower() != ".g" else "N")
    old = file.version < 3.0  # the number of a version
    found: dict[str, list[list[float]]] = {}
    i = 0
    while i < len(file.lines):
        if not file.lines[i].strip():
            i += 1
            continue
        name = _named(f"G{file.lines[i][:2]}" if old else file.lines[i][:3])
        if not re.fullmatch(r"[A-Z]\d\d", name):
            raise InvalidProblem("an ephemeris begins with a satellite such as G07", file.at(i), "copy the file anew")
        lines = _SHORT.get(name[0], _LINES)
        if name[0] in SYSTEMS:
            found.setdefault(name, []).append(_elements(file, i, name[0], old=old))
        i += lines
    if not found:
        raise InvalidProblem("there is no ephemeris of GPS, Galileo or QZSS", file.source, "name another file")
    ephemerides = {name: Ephemeris(*np.array(rows).T) for name, rows in found.items()}
    return Navigation(file.source, ephemerides, _ionosphere(file))


def _elements(file: _File, i: int, system: str, *, old: bool) -> list[float]:
    """Return the numbers of one ephemeris in the order of `Ephemeris`."""
    indent = 3 if old else 4
    first = file.line(i)
    toc = _seconds(file, i, first[2:22] if old else first[3:23])
    cells = [(i, first[start : start + _ELEMENT]) for start in range(22 if old else 23, 79, _ELEMENT)][:3]
    for k in range(i + 1, i + _LINES):
        line = file.line(k).ljust(80)
        cells += [(k, line[start : start + _ELEMENT]) for start in range(indent, indent + 4 * _ELEMENT, _ELEMENT)]
    lacking = next((k for k, text in cells[:_NEEDED] if not text.strip()), None)
    if lacking is not None:
        raise InvalidProblem("the ephemeris lacks a number", file.at(lacking), "leave its eight lines out")
    values = [_number(file, k, text, "the element") if text.strip() else 0.0 for k, text in cells]
    own = {name: values[place] for name, place in _PLACES.items()}
    own |= {"toc": toc, "tgd": values[_DELAY[system]]} | dict(zip(("af0", "af1", "af2"), values, strict=False))
    # weeks of old files may have begun anew after 1024: that of the clock's time is meant
    own["week"] = WEEK * np.round((toc - own["toe"]) / WEEK)
    own["toe"] += own["week"]
    if not (0.0 <= own["e"] < 1.0 and own["root_a"] > 0.0):
        raise InvalidProblem("the elements are no orbit", file.at(i), "leave its eight lines out")
    return [own[name] for name in Ephemeris._fields]


def _ionosphere(file: _File) -> Array | None:
    """Return alpha and beta of the ionosphere, or None where the file has none."""
    held = {"ION ALPHA": (2, ""), "ION BETA": (2, "")}
    parts: dict[str, list[float]] = {}
    for label, text in file.header:
        if label in held:
            parts[label[4]] = [float(text[2 + 12 * k : 14 + 12 * k].replace("D", "E")) for k in range(4)]
        elif label == "IONOSPHERIC CORR" and text[:4] in ("GPSA", "GPSB"):
            parts[text[3]] = [float(text[5 + 12 * k : 17 + 12 * k].replace("D", "E")) for k in range(4)]
    return np.array(parts["A"] + parts["B"]) if {"A", "B"} <= parts.keys() else None

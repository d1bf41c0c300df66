"""Picks of earthquakes in the formats of other programs, as tables with event, station, phase and time.

- HYPO71: W. H. K. Lee, J. C. Lahr, "HYPO71 (revised)", USGS Open-File Report 75-311 (1975), phase cards.
- NonLinLoc: A. Lomax, "NonLinLoc", phase file format of observations (NLLOC_OBS).
- QuakeML: D. Schorlemmer and others, "QuakeML - an overview", Annals of Geophysics 54 (2011); read by obspy.

In the functions, `text` is the content of a file and `source` is its name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timedelta
from io import BytesIO
from typing import Any

from optloc.base.errors import InvalidProblem
from optloc.files.table import Table, of_rows

Row = dict[str, Any]

# Two digits of a year from this number are in the 20th century: digital networks began about 1970.
_CENTURY = 70
# HYPO71 weights: shares of the full weight, which is 0. A pick of weight 4 is not used.
_UNUSED, _SHARES = "4", {"1": 0.75, "2": 0.5, "3": 0.25}
SHARE = "share of full weight"
"""Column of the share of the full weight of a pick: its variance is the stated variance divided by the share."""
# Characters of a line that a message shows.
_SHOWN = 40

HYPO71 = re.compile(
    rb"(?:[ \t]*\r?\n)*(?=[A-Z0-9 ]{4})[A-Z0-9]{2,4} *[IE? ]P[ UDCN+?-][0-4 ].\d{6}[ \d]{4}[ \d]{2}[.\d][ \d]{2}"
)
"""Start of a HYPO71 phase file: station, onset, P, first motion, weight, date, hour, minute and seconds."""
NONLINLOC = re.compile(
    rb"(?:\s*(?:#|PUBLIC_ID|EQEVENT|EQ_EVENT)[^\n]*\n)*\s*\S+[ \t]+\S+[ \t]+\S+[ \t]+[A-Za-z?][ \t]+\S+[ \t]+\S[ \t]+"
    rb"\d{8}[ \t]+\d{1,4}[ \t]+-?\d*\.?\d+[ \t]+[A-Z]{3}\b"
)
"""Start of a NonLinLoc observation file: comments, then a line with nine columns and the type of the error."""
QUAKEML = re.compile(rb"(?:\xef\xbb\xbf)?\s*(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*<(?:\w+:)?quakeml\b", re.DOTALL)
"""Start of a QuakeML document."""


def hypo71(text: str, source: str) -> Table:
    """Return the picks of a HYPO71 phase file; picks with weight 4 are left out.

    HYPO71 multiplies squared residuals by the weight of the pick (USGS Open-File Report 75-311, phase card, columns 8
    and 40): 1, 3/4, 1/2, 1/4 and 0 for the codes 0 to 4.

    An event ends with a blank card, or with an instruction card, which has no station.
    """
    rows: list[Row] = []
    event, unused, weighted = 1, 0, 0
    for number, line in enumerate(text.splitlines(), 1):
        if not line[:4].strip():
            event += bool(rows and rows[-1]["event"] == event)
            continue
        for row, weight in _card(line, f"{source}, line {number}"):
            if weight == _UNUSED:
                unused += 1
                continue
            weighted += weight in _SHARES
            rows.append({"event": event, **row, SHARE: _SHARES.get(weight, 1.0)})
    notes = [f"picks with weight 4 are left out: {unused}; change their weight to use them"] if unused else []
    if weighted:
        notes.append(
            f"{weighted} picks have weights 1 to 3, which are 3/4, 1/2 and 1/4 of full weight: "
            "1.15, 1.41 and 2 times the sigma"
        )
    else:
        for each in rows:
            del each[SHARE]
    return _table(rows, source, notes)


def _card(line: str, where: str) -> Iterator[tuple[Row, str]]:
    """Yield station, phase and time of the P and the S pick of a phase card, with their weights.

    The columns count from 1: station 1-4, P remark 5-8, date and time 10-19, P seconds 20-24, S seconds 32-36, S remark
    37-40. `where` is the place of the line for messages.
    """
    station, remark = line[:4].strip(), line[4:8]
    try:
        parts = [int(line[i : i + 2].replace(" ", "0")) for i in range(9, 19, 2)]
        year = parts[0] + (1900 if parts[0] >= _CENTURY else 2000)
        # Hour 24 and minute 60 occur, because cards of one event share the minute.
        day = datetime(year, parts[1], parts[2])  # noqa: DTZ001  (UTC, as all times of picks)
        minute = day + timedelta(hours=parts[3], minutes=parts[4])
        p, s = (_seconds(line[first:last]) for first, last in ((19, 24), (31, 36)))
    except (ValueError, OverflowError):
        what = f"{line[:_SHOWN].rstrip()!r} is not a phase card"
        advice = "write station, P remark, date and seconds in the columns of HYPO71"
        raise InvalidProblem(what, where, advice) from None
    if remark[1:2].upper() == "P" and p is not None:
        yield {"station": station, "phase": "P", "time": _date(minute, p)}, remark[3:4].strip()
    if line[37:38].upper() == "S" and s is not None:
        yield {"station": station, "phase": "S", "time": _date(minute, s)}, line[39:40].strip()


def _seconds(field: str) -> float | None:
    """Return the seconds of a field F5.2, which has two decimals if it has no point; None for an empty field."""
    text = field.strip()
    if not text:
        return None
    return float(text) if "." in text else float(text) / 100.0


def _date(minute: datetime, seconds: float) -> str:
    """Return the date of a time after a minute, UTC, with microseconds; seconds may be negative or above 60."""
    return (minute + timedelta(microseconds=round(seconds * 1e6))).isoformat(timespec="microseconds") + "Z"


def nonlinloc(text: str, source: str) -> Table:
    """Return the picks of a NonLinLoc observation file, with their errors as standard deviations.

    Events are separated by blank lines. Picks with the prior weight 0 are left out.
    """
    rows: list[Row] = []
    event, unused = 1, 0
    for number, line in enumerate(text.splitlines(), 1):
        cells = line.split()
        if not cells:
            event += bool(rows and rows[-1]["event"] == event)
            continue
        if cells[0].startswith("#") or cells[0] in ("PUBLIC_ID", "EQEVENT", "EQ_EVENT"):
            continue
        try:
            day = datetime.strptime(cells[6], "%Y%m%d")  # noqa: DTZ007  (the format has no zone: UTC)
            clock, seconds, error = int(cells[7]), float(cells[8]), float(cells[10])
            weight = float(cells[14]) if len(cells) > 14 else 1.0
            time = _date(day + timedelta(hours=clock // 100, minutes=clock % 100), seconds)
        except (ValueError, IndexError, OverflowError):
            what = f"{line[:_SHOWN]!r} is not a NonLinLoc observation"
            advice = "write station, instrument, component, onset, phase, motion, date, time, seconds, GAU, error"
            raise InvalidProblem(what, f"{source}, line {number}", advice) from None
        if weight == 0.0:
            unused += 1
            continue
        sigma = error if error > 0.0 and cells[9] == "GAU" else None
        rows.append({"event": event, "station": cells[0], "phase": cells[4], "time": time, "sigma_s": sigma})
    return _table(
        rows,
        source,
        [f"picks with prior weight 0 are left out: {unused}; change their weight to use them"] if unused else [],
    )


def quakeml(text: str, source: str) -> Table:
    """Return the picks of a QuakeML document; raise InvalidProblem if obspy is not installed.

    The phase of a pick is its hint, or the phase of its arrival in the preferred origin.
    """
    try:
        from obspy import read_events
    except ImportError:
        advice = "install it with pip install obspy, or save the picks as CSV with station, phase and time"
        raise InvalidProblem("QuakeML needs the package obspy, which is not installed", source, advice) from None
    try:
        catalog = read_events(BytesIO(text.encode()), format="QUAKEML")
    except Exception as error:  # noqa: BLE001  (obspy and lxml raise many types for an invalid document)
        reason = " ".join(str(error).split())[:_SHOWN]
        raise InvalidProblem(f"obspy cannot read it ({reason})", source, "check that the file is complete") from None
    rows: list[Row] = []
    unknown = 0
    for number, event in enumerate(catalog, 1):
        origin = event.preferred_origin() or next(iter(event.origins), None)
        phases = {str(arrival.pick_id): arrival.phase for arrival in (origin.arrivals if origin else ())}
        for pick in event.picks:
            phase = pick.phase_hint or phases.get(str(pick.resource_id))
            station = pick.waveform_id.station_code if pick.waveform_id else None
            if pick.evaluation_status == "rejected" or not phase or not station or pick.time is None:
                unknown += 1
                continue
            deviation = pick.time_errors.uncertainty if pick.time_errors else None
            sigma = float(deviation) if deviation else None
            rows.append({"event": number, "station": station, "phase": phase, "time": str(pick.time), "sigma_s": sigma})
    notes = (
        [f"picks that are rejected, or without phase or station, are left out: {unknown}; complete them to use them"]
        if unknown
        else []
    )
    return _table(rows, source, notes)


def _table(rows: list[Row], source: str, notes: list[str]) -> Table:
    """Return a table of picks; standard deviations of a part of the picks are left out.

    Raise InvalidProblem for a file without picks.
    """
    if not rows:
        raise InvalidProblem("the file has no picks", source, "check that it is a file of phase picks")
    known = sum(row.get("sigma_s") is not None for row in rows)
    if known < len(rows):
        rows = [{key: value for key, value in row.items() if key != "sigma_s"} for row in rows]
        notes = [*notes, *([f"only {known} of {len(rows)} picks have an error, so --sigma is needed"] if known else [])]
    return replace(of_rows(rows, source, {}), notes=tuple(notes))

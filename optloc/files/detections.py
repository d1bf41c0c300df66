"""Tables of sound events that opensoundscape writes: arrivals of each event at its receivers.

Source: S. Lapp and others, "OpenSoundscape", Methods in Ecology and Evolution 14 (2023), with the tables of
`events_to_df` and `positions_to_df`. A delay is the arrival at a receiver minus the arrival at the first receiver of
the event, seconds.
"""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from decimal import Decimal
from io import StringIO
from pathlib import PurePosixPath
from typing import Any

from optloc.base.errors import InvalidProblem
from optloc.files.table import Table, of_rows

EVENTS = re.compile(rb"(?=[^\n]*\breceiver_files\b)(?=[^\n]*\btdoas\b)")
"""Header of a table of events with delays."""
CLIPS = re.compile(rb"(?:\xef\xbb\xbf)?\"?file\"?,\"?start_time\"?,\"?end_time\"?,")
"""Header of a table of detections in clips, without delays."""

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_TEXT = re.compile(r"'([^']*)'|\"([^\"]*)\"")


def sound_events(text: str, source: str) -> Table:
    """Return the arrivals of each event: one row for each receiver, with its position, metres, and arrival, seconds.

    Arrivals are relative to the first of the event. `text` is the content of the file and `source` is its name. Raise
    InvalidProblem for events whose lists have different lengths.
    """
    csv.field_size_limit(len(text) + 1)  # a cell may have a long list
    rows: list[dict[str, Any]] = []
    lacking = 0
    for number, record in enumerate(csv.DictReader(StringIO(text)), 1):
        files = [one or other for one, other in _TEXT.findall(record.get("receiver_files") or "")]
        delays = [Decimal(word) for word in _NUMBER.findall(record.get("tdoas") or "")]
        if not delays:
            lacking += 1
            continue
        places = [Decimal(word) for word in _NUMBER.findall(record.get("receiver_locations") or "")]
        size = len(places) // len(files) if files else 0
        if len(files) != len(delays) or (places and (size not in (2, 3) or len(places) != size * len(files))):
            what = f"the event has {len(files)} receivers, {len(delays)} delays and {len(places)} coordinates"
            raise InvalidProblem(what, f"{source}, row {number}", "save the table again with opensoundscape")
        first = min(delays)
        for i, (name, delay) in enumerate(zip(files, delays, strict=True)):
            row: dict[str, Any] = {"event": number, "station": PurePosixPath(name.replace("\\", "/")).name}
            row |= {f"{axis}_m": str(places[size * i + j]) for j, axis in enumerate("xyz"[:size])}
            rows.append({**row, "toa_s": str(delay - first)})
    if not rows:
        what = "no event has delays"
        raise InvalidProblem(what, source, "run estimate_location of opensoundscape, then save events_to_df")
    notes = (f"events without delays are left out: {lacking}; add their delays to use them",) if lacking else ()
    return replace(of_rows(rows, source, {}), notes=notes)


def clips(text: str, source: str) -> Table:
    """Raise InvalidProblem: detections in clips have no arrival times. `text` is not used."""
    what = "these are detections in clips, which have no arrival times"
    advice = "estimate delays with localize_detections of opensoundscape, and give its events_to_df"
    raise InvalidProblem(what, source, advice)

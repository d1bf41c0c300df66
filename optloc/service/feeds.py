"""Feeds of a stream: its records in the formats of other programs, and the latest fix of each target for maps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from time import time

import numpy as np

from optloc.problem import Frame
from optloc.service.answers import Record, finite, join, to_line
from optloc.show import FORMATS as FILE_FORMATS, Mark, Other, earth_points, ellipse95, live_mark, mark_of

# Metres of a foot.
_FEET = 0.3048
# Times of a stream from this value on, s, are since 1970, UTC: it is the year 2000. Smaller times are seconds of a run.
_FIRST_DATE = 946_684_800.0
# Seconds after which a target is removed from the list; maps of aircraft use this limit.
_MAX_AGE = 60.0
# Positions of a trail: two minutes of one fix a second, few enough for a feed that is read once a second.
_TRAIL = 120


def to_feature(record: Record, frame: Frame) -> Record:
    """Return a record as a GeoJSON feature (RFC 7946); the geometry is null without a position on Earth.

    Its properties are the entries of the record. Where the 95 % ellipse is valid, they also have its semi-axes, m,
    `ellipse95_1` and `ellipse95_2`, and `ellipse95_bearing`, the bearing of the long axis, degrees. The standard
    deviations, m, are `sigma_east`, `sigma_north` and `sigma_up`.
    """
    left_out = ("lat_deg", "lon_deg", "height", "position", "cov")
    about = {key: value for key, value in record.items() if key not in left_out}
    if record.get("lat_deg") is None:
        return {"type": "Feature", "geometry": None, "properties": about}
    place = {"type": "Point", "coordinates": [record["lon_deg"], record["lat_deg"], record["height"]]}
    mark = to_mark(record, frame)
    if mark.covers:
        major, minor, bearing = ellipse95(mark.level)
        sigma = np.sqrt(np.maximum(np.diagonal(mark.level), 0.0)).tolist()
        about |= {"ellipse95_1": major, "ellipse95_2": minor, "ellipse95_bearing": bearing}
        about |= dict(zip(("sigma_east", "sigma_north", "sigma_up"), sigma, strict=False))
    return {"type": "Feature", "geometry": place, "properties": about}


def to_aircraft(record: Record, seen: float = 0.0) -> Record:
    """Return a fix on Earth as an entry of readsb's ``aircraft.json``: heights in feet, the target as `hex`.

    `seen` is the age of the fix, s.
    """
    return {
        "hex": _name_of(record),
        "type": "mlat",
        "lat": round(record["lat_deg"], 6),
        "lon": round(record["lon_deg"], 6),
        "alt_geom": round(record["height"] / _FEET),
        "mlat": ["lat", "lon", "alt_geom"],
        "tisb": [],
        "messages": 1,
        "seen": round(seen, 1),
        "seen_pos": round(seen, 1),
        "status": record["status"],
    }


def to_mark(record: Record, frame: Frame) -> Mark:
    """Return a fix or the state of a track in the form that the export formats need.

    `record` is an answer with a position, m, in `frame`. Without a covariance in the record, the covariance is NaN.
    """
    position, d = np.array(record["position"], dtype=float), len(record["position"])
    covariance = np.full((d, d), np.nan) if record.get("cov") is None else np.array(record["cov"], dtype=float)
    texts = {"reason": record.get("reason", ""), "unchecked": record.get("unchecked", False), "dof": record.get("dof")}
    texts |= {"undetermined": "; ".join(record["undetermined"])} if "undetermined" in record else {}
    others = [
        Other(
            x := np.array(each["position"], dtype=float),
            earth_points(frame, x[None])[0],
            each["gap"],
            _probability(each),
        )
        for each in record.get("alternatives", ())
    ]
    name = _name_of(record)
    return mark_of(
        frame,
        position,
        covariance,
        record["status"],
        velocity=np.array(record["velocity"], dtype=float) if record.get("velocity") else None,
        name=name,
        target=name,
        time=(when := float(record.get("time", np.nan))),
        dated=when >= _FIRST_DATE,
        sentence=record.get("sentence", ""),
        texts=texts,
        others=tuple(others),
    )


def _probability(each: Record) -> float:
    """Return the probability of an alternative relative to the fix, from its gap (difference of chi-square).

    The formula is the formula of `optloc.problem.fix_parts.Alternatives`.
    """
    return float(1.0 / (1.0 + np.exp(min(each["gap"] / 2.0, 700.0))))  # exp overflows beyond 700


def _of_file(each: Callable[[Mark], str]) -> Callable[[Record, Frame], bytes | None]:
    """Return a function that writes a record as a line of a file format, from `each`, which formats one mark.

    The result of the function is None for a record without a position on Earth.
    """

    def line(record: Record, frame: Frame) -> bytes | None:
        """Return a record in the file format, ending in a line break; None without a position on Earth."""
        if record.get("lat_deg") is None:
            return None
        text = each(to_mark(record, frame))
        return (text if text.endswith("\n") else text + "\n").encode()

    return line


FORMATS: Mapping[str, Callable[[Record, Frame], bytes | None]] = {
    "ndjson": lambda record, _: to_line(record),
    "geojson": lambda record, frame: to_line(to_feature(record, frame)),
    "aircraft": lambda record, _: to_line(to_aircraft(record)) if record.get("lat_deg") is not None else None,
    **{name: _of_file(one.each) for name, one in FILE_FORMATS.items() if one.each is not None},
}
"""Output formats by name: functions of a record and the frame of its site that return a line."""

# Formats whose readers take each line as a new position, and a line without a position as the loss of all positions:
# they get one line for each event, the last.
_ONCE = ("nmea",)


def to_feed(name: str, record: Record, whole: Record, frame: Frame, *, last: bool) -> bytes:
    """Return an answer of an event as a line of a format; empty if the format leaves it out.

    `record` is the answer, `whole` all answers of the event so far as one record, and `last` marks the last answer.
    Lines of JSON have the answer alone, since their readers join it by its event. The other formats replace the first
    answer by a whole second answer with its status.
    """
    if name in _ONCE and not last:
        return b""
    return FORMATS[name](record if name == "ndjson" else whole, frame) or b""


OF_RECORDS = ("ndjson", "geojson")
"""Formats with lines for notes, errors and health; with other formats these go to standard error."""


def _event_of(record: Record) -> tuple[str, str]:
    """Return the client and the id of the event of a record."""
    return record.get("client", ""), record["event"]


def _name_of(record: Record) -> str:
    """Return the name of a fix in feeds: its target, or its event with the client."""
    return record.get("target") or "/".join(filter(None, _event_of(record)))


class Latest:
    """The latest fix of each target, or of each event without a target, for maps.

    `most` is the largest number of targets.
    """

    def __init__(self, most: int = 1024) -> None:
        self._most, self._total = most, 0  # `_total` counts the stored fixes since the start
        # by name of the target or event, the oldest first: time of the fix (s since 1970) and record
        self._stored: dict[str, tuple[float, Record]] = {}
        # by name of the target: its latest positions, the oldest first, for trails
        self._trails: dict[str, deque[list[float]]] = {}
        # by name of the target: the record of the last request for marks, and its mark
        self._drawn: dict[str, tuple[Record, Record]] = {}
        self._last: float | None = None  # time of the last answer to an event, s since 1970

    def __call__(self, record: Record) -> None:
        """Store a record if it has a position, or add it to the stored record of the same event.

        If there are too many targets, the target whose event is oldest is removed. Notes and errors are ignored.
        """
        if "event" not in record or "note" in record:
            return
        self._last = time()
        name = _name_of(record)
        old = self._stored.get(name)
        if old is not None and _event_of(old[1]) == _event_of(record):
            self._stored[name] = (old[0], join(old[1], record))
            if record.get("position") is not None:
                self._trails[name][-1] = record["position"]
            return
        if record.get("position") is None:
            return
        # Each step is one call of a built-in: a reader in another thread gets the old or the new record.
        self._stored.pop(name, None)
        self._stored[name] = (time(), join(None, record))
        if old is None or time() - old[0] > _MAX_AGE:  # a target that returns starts a new trail
            self._trails[name] = deque(maxlen=_TRAIL)
        self._trails[name].append(record["position"])
        self._total += 1
        if len(self._stored) > self._most:
            oldest = next(iter(self._stored))
            self._stored.pop(oldest, None)
            self._trails.pop(oldest, None)
            self._drawn.pop(oldest, None)

    def _present(self) -> list[tuple[float, Record]]:
        """Return the age (s) and the record of each target with a fix in the last minute."""
        now = time()
        return [(now - when, record) for when, record in list(self._stored.values()) if now - when < _MAX_AGE]

    def features(self, frame: Frame) -> Record:
        """Return the latest fixes as a GeoJSON feature collection; `frame` is the frame of the site."""
        shown = [to_feature(record, frame) for _, record in self._present()]
        return {"type": "FeatureCollection", "features": shown}

    def marks(self, frame: Frame) -> Record:
        """Return the latest fixes for the live map: `now` and `last` event (s since 1970, None without one), `fixes`.

        `frame` is the frame of the site. For the keys of a fix see `optloc.show.live_mark`; `received` is its time of
        arrival, s since 1970.
        """
        now, found = time(), []
        for age, record in self._present():
            name = _name_of(record)
            drawn = self._drawn.get(name)
            # A stored record is never changed, only replaced: the same object has the same mark.
            if drawn is None or drawn[0] is not record:
                trail = [np.array(place) for place in list(self._trails.get(name, ()))]
                mark = live_mark(frame, to_mark(record, frame), trail) | {"received": round(now - age, 3)}
                drawn = self._drawn[name] = (record, finite(mark))
            found.append(drawn[1])
        last = None if self._last is None else round(self._last, 3)  # rounded as `now`, so that it is never later
        return {"now": round(now, 3), "last": last, "fixes": found}

    def aircraft(self) -> Record:
        """Return the latest fixes as readsb's ``aircraft.json``."""
        found = [to_aircraft(record, age) for age, record in self._present() if record.get("lat_deg") is not None]
        return {"now": round(time(), 1), "messages": self._total, "aircraft": found}

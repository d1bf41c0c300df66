"""Answers of a stream: records of fixes, proofs and tracks, and their conversion to other formats.

A record is a dictionary that is written as one JSON line. An event has up to two answers: the first phase gives the
fix, the second phase gives the proof.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from time import time
from typing import Any

import numpy as np

from optloc.problem import PROOFS, UNKNOWN, Array, Fix, Frame, Problem, Status
from optloc.service.events import Event
from optloc.service.messages import shown_name
from optloc.show import FORMATS as FILE_FORMATS, Mark, Other, earth_points, ellipse95, live_mark, mark_of
from optloc.tracking import Entry, scan_sentence

Record = dict[str, Any]

# All threads share this encoder: it has no state.
_JSON = json.JSONEncoder(allow_nan=False, separators=(",", ":"))
_LABELS = {int(status): status.label for status in Status}
_FEET = 0.3048

UNNAMED = "target"
"""Name of the target of events without a target in tracks, as in files."""

# Seconds after which a target is removed from the list; maps of aircraft use this limit.
_MAX_AGE = 60.0
# Positions of a trail: two minutes of one fix a second, few enough for a feed that is read once a second.
_TRAIL = 120


def fix_records(fix: Fix, events: Sequence[Event], phase: str | None) -> list[Record]:
    """Return the answers to the events of a batch (n,): metres in the frame of the site, degrees; None for no number.

    `phase` is the phase of the answer, None for a single answer.
    """
    position, covariance = fix.position, fix.covariance()
    known = np.asarray(np.isfinite(position).all(-1))
    # `wild` (n, d) marks coordinates that the data do not determine. Their covariance is not written.
    wild = fix.undetermined()
    has_cov = np.asarray(known & np.isfinite(covariance).all((-1, -2)) & ~wild.any(-1))
    columns: dict[str, list[Any]] = {} if phase is None else {"phase": [phase] * len(events)}
    columns |= {
        "status": [_LABELS[code] for code in fix.code.tolist()],
        "position": _known(position, known),
        "cov": _known(covariance, has_cov),
        "cost": _known(fix.cost, np.isfinite(fix.cost)),
        "dof": fix.dof.tolist(),
    }
    if fix.frame.geodetic:
        lat, lon, height = fix.frame.to_geodetic(np.where(known[:, None], position, 0.0))
        for name, values in (("lat_deg", np.degrees(lat)), ("lon_deg", np.degrees(lon)), ("height", height)):
            columns[name] = _known(values, known)
    names, others, alone = ("event", *columns), _alternatives(fix), np.ravel(fix.unchecked)
    made = [
        dict(zip(names, row, strict=True))
        for row in zip((_id_of(event) for event in events), *columns.values(), strict=True)
    ]
    for i, (record, event) in enumerate(zip(made, events, strict=True)):
        record["alternatives"] = others.get(i, [])
        if fix.reason[i]:
            record["reason"] = fix.reason[i]
        if alone[i]:
            record["unchecked"] = True
        if wild[i].any():
            record["undetermined"] = ["xyz"[axis] for axis in np.flatnonzero(wild[i])]
        _add_exceptions(record, event)
    return made


def unsolved(event: Event, phase: str = "fix", **why: Any) -> Record:
    """Return the answer to an event without a position; `why` is its status, or an error."""
    record = {"event": _id_of(event), "phase": phase, **why, "position": None}
    _add_exceptions(record, event)
    return record


def _id_of(event: Event) -> str:
    """Return the id of an event, without the name of its client."""
    return event.name.rpartition("\n")[2]


def _known(values: Array, known: Array) -> list[Any]:
    """Return `values` (n, ...) as a list with one entry for each event, None where `known` (n,) is false."""
    given: list[Any] = values.tolist()
    return (
        given if known.all() else [value if good else None for value, good in zip(given, known.tolist(), strict=True)]
    )


def _alternatives(fix: Fix) -> dict[int, list[Record]]:
    """Return the other positions of the events of a batch, by event number; events without any are absent.

    Each entry has the position in metres and the gap, which is its cost (chi-square) minus the cost of the fix.
    """
    gap = fix.alternatives.gap
    if not gap.shape[-1]:
        return {}
    place, out = fix.layout.take(fix.alternatives.x, "position"), {}
    for i in np.flatnonzero(np.isfinite(gap).any(-1)).tolist():
        shown = np.isfinite(gap[i])
        pairs = zip(place[i][shown].tolist(), gap[i][shown].tolist(), strict=True)
        out[i] = [{"position": x, "gap": g} for x, g in pairs]
    return out


def _add_exceptions(record: Record, event: Event) -> None:
    """Add the properties of an event that not all events have: client, time, closing reason, revision, and others."""
    if event.when is not None:
        record.setdefault("time", event.when * 1e-12)
    if _id_of(event) != event.name:
        record |= shown_name(event.name)
    if event.closed != "whole":
        record["closed"] = event.closed
    if event.revision > 1:
        record["revision"] = event.revision
    if event.conflict:
        record["conflict"] = True
    if event.target:
        record["target"] = event.target


def proof_records(fix: Fix, events: Sequence[Event], before: Sequence[Record | None]) -> list[Record]:
    """Return the answers of the second phase (n): the proof alone, or a better fix with its proof.

    `fix` has the fixes (n,) of the whole method. `before` has the answers of the first phase. If an entry is None, or
    the fix has changed, the answer includes the fix.
    """
    records = fix_records(fix, events, None)
    out = []
    proofs = (column.tolist() for column in (fix.claims.proof, fix.claims.margin, fix.claims.boxes, fix.claims.reason))
    # `number` is the outcome of the proof, as an index of `PROOFS`.
    for new, old, number, margin, boxes, reason in zip(records, before, *proofs, strict=True):
        proof: Record = {"proof": PROOFS[number], "margin": margin, "boxes": boxes}
        if number == UNKNOWN:
            proof["why"] = reason
        if old is None:
            out.append(new | proof)
        elif _is_same_fix(new, old):
            changed = {
                key: new[key] for key in ("alternatives", "revision", "reason", "target", "client") if new.get(key)
            }
            out.append({"event": new["event"], "phase": "proof", "status": new["status"], **proof, **changed})
        else:
            head = {"event": new.pop("event"), "phase": "proof"}
            out.append(head | new | proof | {"revised": True})
    return out


# Relative difference of costs and coordinates that is rounding: the whole method refines to eleven digits.
_ROUNDING = 1e-9


def _is_same_fix(new: Record, old: Record) -> bool:
    """Return whether the whole method gives the same fix as the first phase: `new` and `old` are their answers.

    Positions may differ by rounding. Both fixes must have a covariance, or both none; the covariances are not compared.
    """
    if new["position"] is None or old["position"] is None:
        return bool(new["position"] == old["position"])
    size = 1.0 + max(map(abs, old["position"]))
    difference = max(abs(a - b) for a, b in zip(new["position"], old["position"], strict=True))
    return bool(difference <= _ROUNDING * size and (new["cov"] is None) == (old["cov"] is None))


def track_record(event: Event, time: float, entry: Entry, problem: Problem) -> Record:
    """Return the answer to an event of a track: metres and seconds in the frame of the site, angles in degrees.

    `time` is the time of the event, s. `entry` is the result of the scan, with a state of position, velocity and
    acceleration, or fewer of them. `problem` gives the dimension and the frame. The value `cov` is the covariance of
    the state. `nis` is the normalised innovation squared of the scan.
    """
    d, mean = problem.dimension, entry.updated.mean
    known = bool(np.isfinite(mean).all())
    record: Record = {"event": _id_of(event), "phase": "track", "target": UNNAMED, "time": time, "status": entry.label}
    for i, name in enumerate(("position", "velocity", "acceleration")[: len(mean) // d]):
        record[name] = mean[i * d : (i + 1) * d].tolist() if known else None
    record["cov"] = entry.updated.cov.tolist() if known else None
    if problem.frame.geodetic and known:
        lat, lon, height = problem.frame.to_geodetic(mean[:d])
        record |= {"lat_deg": float(np.degrees(lat)), "lon_deg": float(np.degrees(lon)), "height": float(height)}
    nis = float(entry.updated.nis)
    record |= {"nis": nis if np.isfinite(nis) else None, "rows": int(entry.updated.count), "rejected": entry.rejected}
    if entry.reason:
        record["reason"] = entry.reason
    _add_exceptions(record, event)
    return record


def unproven(event: Event, why: str, before: Record | None) -> Record:
    """Return the answer to an event whose proof was not finished.

    `why` is "deadline" or "skipped: load". `before` is the answer of the first phase; None if it was not written yet.
    """
    proof = {"proof": "unknown", "margin": 0.0, "boxes": 0, "why": why}
    proof |= {"target": event.target} if event.target else {}
    proof |= {"revision": event.revision} if event.revision > 1 else {}
    names = shown_name(event.name)
    if before is not None:
        return {**names, "phase": "proof", "status": before["status"], **proof}
    return {**names, **proof}


def join(first: Record | None, then: Record) -> Record:
    """Return the answers of both phases of an event as one record.

    `first` is the answer of the first phase, or None. Its values are replaced by the values of `then`, the later
    answer.
    """
    left_out = ("phase", "reason")  # the second phase replaces the reason of the first
    kept = {} if first is None else {key: value for key, value in first.items() if key not in left_out}
    return kept | {key: value for key, value in then.items() if key != "phase"}


def to_line(record: Record) -> bytes:
    """Return a record as one line of strict JSON; numbers that are not finite become null."""
    try:
        return _JSON.encode(record).encode() + b"\n"
    except ValueError:
        return _JSON.encode(_finite(record)).encode() + b"\n"


def _finite(value: Any) -> Any:
    """Return a value of JSON with null (None) instead of each number that is not finite, at all depths."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


# Other formats.


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
        time=float(record.get("time", np.nan)),
        sentence=_sentence(record),
        texts=texts,
        others=tuple(others),
    )


# The advice for an unproven fix of a file, another method, is wrong for a stream: its proof is a second answer.
_PENDING = "The position is refined, but its proof is not finished, so another position is not excluded."


def _sentence(record: Record) -> str:
    """Return the sentence of the status of a record if it is not the sentence of `Status`; otherwise empty."""
    if "nis" in record:
        return scan_sentence(record["status"])
    return _PENDING if record["status"] == Status.UNPROVEN.label and "proof" not in record else ""


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
        self._held: dict[str, tuple[float, Record]] = {}
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
        old = self._held.get(name)
        if old is not None and _event_of(old[1]) == _event_of(record):
            self._held[name] = (old[0], join(old[1], record))
            if record.get("position") is not None:
                self._trails[name][-1] = record["position"]
            return
        if record.get("position") is None:
            return
        # Each step is one call of a built-in: a reader in another thread gets the old or the new record.
        self._held.pop(name, None)
        self._held[name] = (time(), join(None, record))
        if old is None or time() - old[0] > _MAX_AGE:  # a target that returns starts a new trail
            self._trails[name] = deque(maxlen=_TRAIL)
        self._trails[name].append(record["position"])
        self._total += 1
        if len(self._held) > self._most:
            gone = next(iter(self._held))
            self._held.pop(gone, None)
            self._trails.pop(gone, None)
            self._drawn.pop(gone, None)

    def _present(self) -> list[tuple[float, Record]]:
        """Return the age (s) and the record of each target with a fix in the last minute."""
        now = time()
        return [(now - when, record) for when, record in list(self._held.values()) if now - when < _MAX_AGE]

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
                drawn = self._drawn[name] = (record, _finite(mark))
            found.append(drawn[1])
        last = None if self._last is None else round(self._last, 3)  # rounded as `now`, so that it is never later
        return {"now": round(now, 3), "last": last, "fixes": found}

    def aircraft(self) -> Record:
        """Return the latest fixes as readsb's ``aircraft.json``."""
        found = [to_aircraft(record, age) for age, record in self._present() if record.get("lat_deg") is not None]
        return {"now": round(time(), 1), "messages": self._total, "aircraft": found}

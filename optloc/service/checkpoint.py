"""Checkpoints of a stream: open events, ids of answered events, counts and the account, as one JSON object."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from optloc.files import Budget, access, json_of, read_text
from optloc.problem import InvalidProblem
from optloc.service.account import SETTLED, STATES, total
from optloc.service.answers import Record
from optloc.service.events import Event, Events
from optloc.service.messages import full_name_under, name_under, picoseconds, rows_and_arrivals
from optloc.service.metrics import COUNTS
from optloc.service.site import Site

_FORMAT = "optloc live 2"
# Format 1 has neither the account nor revisions.
_FORMATS = ("optloc live 1", _FORMAT)
# Bytes of a checkpoint with the largest state: 4096 open events of 64 kB and 65 536 ids.
_BUDGET = Budget(text=1 << 29)
# Largest count: a million a second for 30 000 years, which is exact as a float.
_MAX_COUNT = 1 << 60
# Largest number of characters of an invalid value in a message.
_SHOWN = 40
_NAMES: dict[type, str] = {list: "list", dict: "object", str: "text", int: "whole number", bool: "true or false"}
T = TypeVar("T")


def state_of(events: Events, unwritten: Iterable[Event] = (), *, ended: bool = False) -> Record:
    """Return the state that a stream needs to continue.

    `unwritten` has closed events whose answers may not be written yet: they count as open. If an event is there in two
    revisions, the last revision is stored, with the lines of both. `ended` is whether the stream ended by itself: its
    answers are then complete. After another end, events may be answered again, with a higher revision.
    """
    site, waiting, lines = events.site, dict[str, Event](), dict[str, Counter[str]]()
    for event in (*unwritten, *events.open.values()):
        waiting[event.name] = event
        lines.setdefault(event.name, Counter()).update(event.lines)

    def record_of(event: Event) -> Record:
        """Return an event as JSON values: rows by kind and stations, arrivals by station in picoseconds as text."""
        rows = [[*site.row(key)[2:5], value, event.sigmas.get(key)] for key, value in event.rows.items()]
        times = [[site.stations[i], str(value)] for i, value in event.times.items()]
        about = {"target": event.target, "revision": event.revision, "conflict": event.conflict}
        about |= {"when": None if event.when is None else str(event.when), "track": event.track}
        about |= {"refused": event.refused} if event.refused else {}
        about |= {"lines": dict(lines[event.name])}
        return {"event": event.name, "rows": rows, "times": times, **about}

    return {
        "format": _FORMAT,
        "site": site.source,
        "ended": ended,
        "revision": events.revision,
        "open": [record_of(event) for event in waiting.values()],
        "closed": [name for name in events.closed if name not in waiting],
        "counts": dict(events.metrics.counts),
        "account": events.metrics.account.for_checkpoint(total(lines.values())),
    }


def restore(path: Path, events: Events, now: float) -> None:
    """Restore a checkpoint into the events of a stream that has read no line: all of the checkpoint, or nothing.

    `now` is the time of the clock of the stream, s. Unless the former stream ended by itself, it may have answered
    events after its last checkpoint, so all further answers get a higher revision. Raise InvalidProblem for a file that
    is not a checkpoint, is damaged, or has names that the site does not have.
    """
    try:
        with access(anew=True, budget=_BUDGET):  # forget the input: it is written again later
            found = json_of(read_text(path), path.name)
    except InvalidProblem as error:
        what = f"the checkpoint cannot be read ({error.what})"
        raise InvalidProblem(what, str(path), "use another file, or remove it") from None
    if not isinstance(found, dict) or found.get("format") not in _FORMATS:
        raise InvalidProblem("this is not a checkpoint of a stream", str(path), "use another file, or remove it")
    where = str(path)
    try:
        closed = [full_name_under("closed", name) for name in _typed(found.get("closed"), list, "closed")]
        counts, account = _counts(found.get("counts")), _account(found.get("account", {}))
        ended = _typed(found.get("ended", False), bool, "ended")
        revision = _count(found.get("revision", 1), "revision") + (not ended)
        # Fill `opened` first, and change `events` only if the whole file is valid.
        taken, opened = set(closed), dict[str, Event]()
        for number, each in enumerate(_typed(found.get("open"), list, "open"), 1):
            where = f"{path}, open event {number}"
            event = _event(each, events.site, now, taken)
            taken.add(event.name)
            event.revision = max(event.revision + (not ended), revision)
            opened[event.name] = event
        _check_open(account, total(event.lines for event in opened.values()))
    except InvalidProblem as error:
        if error.where in ("kind", "a", "b", "station"):
            raise InvalidProblem(error.what, where, "the checkpoint is of another site; use another file") from None
        raise InvalidProblem(f"this checkpoint is damaged ({error.where}: {error.what})", where, "remove it") from None
    for name in closed:
        events.remember(name, None)
    events.open.update(opened)
    events.revision = revision
    events.metrics.counts.update(counts)
    events.metrics.account.restore(account)


def _event(found: Any, site: Site, now: float, taken: set[str]) -> Event:
    """Return an open event from its record in a checkpoint.

    `now` is the time from which the event waits, s. Raise InvalidProblem with a key as its place if a value is invalid,
    or if the name of the event is in `taken`.
    """
    each = _typed(found, dict, "open")
    entries = [_parts(entry, 5, "rows") for entry in _typed(each.get("rows"), list, "rows")]
    given = [
        {"kind": kind, "a": a, "b": b, "z": value} | ({} if sigma is None else {"sigma": sigma})
        for kind, a, b, value, sigma in entries
    ]
    entries = [_parts(entry, 2, "times") for entry in _typed(each.get("times"), list, "times")]
    arrivals = [{"station": station, "time_ps": time} for station, time in entries]
    rows, sigmas, times = rows_and_arrivals(given, arrivals, site)
    refused = _typed(each.get("refused", ""), str, "refused")
    if not rows and not times and not refused:
        raise InvalidProblem("an event has no rows", "rows", "remove the event")
    name, target = full_name_under("event", each.get("event")), _typed(each.get("target"), str, "target")
    if name in taken:
        raise InvalidProblem(f"the event {name!r} occurs twice", "event", "remove one")
    event = Event(name, rows, times, now, now, sigmas, target and name_under("target", target))
    event.revision = _count(each.get("revision"), "revision")
    event.conflict = _typed(each.get("conflict"), bool, "conflict")
    # checkpoints of versions without tracks have neither key
    event.when = None if each.get("when") is None else picoseconds(each["when"], "time_ps")
    event.track = _typed(each.get("track", False), bool, "track")
    event.refused = refused
    lines = _typed(each.get("lines", {}), dict, "lines")
    event.lines = {source: _count(count, "lines") for source, count in lines.items()}
    return event


def _typed(found: Any, kind: type[T], where: str) -> T:
    """Return a value of the type `kind`; raise InvalidProblem for another type. True is not a number."""
    if type(found) is not kind:
        raise InvalidProblem(f"{str(found)[:_SHOWN]!r} is not of the type {_NAMES[kind]}", where, "remove it")
    return found


def _parts(found: Any, count: int, where: str) -> list[Any]:
    """Return a value as a list of `count` entries; raise InvalidProblem with the key `where` otherwise."""
    entry = _typed(found, list, where)
    if len(entry) != count:
        raise InvalidProblem(f"an entry has {len(entry)} values, {count} are needed", where, "remove it")
    return entry


def _count(found: Any, where: str) -> int:
    """Return a count from 0 to 2^60; raise InvalidProblem with the key `where` for another value."""
    number = _typed(found, int, where)
    if not 0 <= number <= _MAX_COUNT:
        raise InvalidProblem(f"{str(number)[:_SHOWN]} is not a count", where, "remove it")
    return number


def _counts(found: Any) -> dict[str, int]:
    """Return the counts, by the names of `optloc.service.metrics.COUNTS`."""
    counts = _typed(found, dict, "counts")
    unknown = counts.keys() - COUNTS.keys()
    if unknown:
        raise InvalidProblem(f"there is no count {min(unknown)[:_SHOWN]!r}", "counts", "remove it")
    return {name: _count(number, "counts") for name, number in counts.items()}


def _account(found: Any) -> dict[str, dict[str, int]]:
    """Return the account of a checkpoint: counts of `STATES` by source; raise InvalidProblem if it does not balance."""
    account = {}
    for source, counts in _typed(found, dict, "account").items():
        if _typed(counts, dict, "account").keys() != set(STATES):
            raise InvalidProblem("the counts of a source are incomplete", "account", "remove it")
        account[source] = {state: _count(counts[state], "account") for state in STATES}
    for counts in account.values():
        if counts["received"] != sum(counts[state] for state in (*SETTLED, "open")):
            raise InvalidProblem("the counts of a source do not balance", "account", "remove it")
    return account


def _check_open(account: dict[str, dict[str, int]], waiting: Counter[str]) -> None:
    """Raise InvalidProblem if the open lines of an account are not the `waiting` lines of the open events."""
    if {source: counts["open"] for source, counts in account.items() if counts["open"]} != +waiting:
        raise InvalidProblem("the open lines of a source are not the lines of the open events", "account", "remove it")

"""Recordings: lines with their times of reading, or the epochs of a problem file, replayed at any speed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Event
from typing import NamedTuple

import numpy as np

from optloc.files import Draft, draft, read_bytes
from optloc.models import MODELS
from optloc.service.adapters import Adapter, convert
from optloc.service.queues import QueuedLine
from optloc.service.stream import Stream

# Lines per batch if the replay does not wait for the clock.
_MANY = 64


class Recorded(NamedTuple):
    """A line and its time of reading, s; NaN: directly after the previous line."""

    received: float
    data: bytes


def read_recording(path: Path) -> list[Recorded]:
    """Return the lines of a recording.

    A recording has JSON lines, with the key ``received`` if ``--record`` wrote them. In a problem file (.toml), each
    epoch is an event. Raise InvalidProblem if the file cannot be read.
    """
    if path.suffix.lower() == ".toml":
        return list(_epochs(draft(path, values=True)))
    return [Recorded(_received(line), line) for line in read_bytes(path, lines=True).split(b"\n") if line.strip()]


def _received(line: bytes) -> float:
    """Return the time of reading under the key ``received`` of a line, s; NaN if the line has none."""
    if b'"received"' not in line:
        return np.nan
    try:
        found = json.loads(line)
        return float(found.get("received", np.nan))
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError):
        return np.nan  # the stream reports the error


def _epochs(made: Draft) -> Iterator[Recorded]:
    """Yield the epochs of a problem file as events, in the order of their times.

    `made` is the problem with the tables of the file. Its rows refer to entries of these tables, whose values are in
    the units of the file.
    """
    loaded = made.loaded
    rows: list[list[dict[str, object]]] = [[] for _ in loaded.epochs]
    names = loaded.problem.stations.names
    epoch = loaded.problem.epoch
    for chunk, number in zip(made.chunks, made.numbers, strict=True):
        section = made.file.measurements[next(i for i, table in enumerate(made.tables) if table is chunk.table)]
        # `count` is the number of stations of a row
        z, count = chunk.table.numbers("z", optional=True), MODELS[chunk.kind].stations
        sigma = chunk.table.numbers("sigma") if chunk.table.has("sigma") else None
        # The reader exchanged the stations of reversed differences. The values of the file need their original order.
        reversed_rows = section.positive == "b-farther" and _is_reversible(chunk.kind)
        ends = (chunk.b, chunk.a) if reversed_rows else (chunk.a, chunk.b)
        for i in np.flatnonzero(chunk.weight > 0.0).tolist():
            row: dict[str, object] = {"kind": chunk.kind, "z": float(z[chunk.row[i]])}
            row |= {key: names[int(end[i])] for key, end in zip("ab"[:count], ends, strict=False)}
            rows[epoch[number[i]]].append(row if sigma is None else row | {"sigma": float(sigma[chunk.row[i]])})
    for i in np.argsort(loaded.times, kind="stable").tolist():
        name = f"{loaded.epochs[i]} {loaded.targets[i]}" if loaded.own_epochs else loaded.epochs[i]
        line = {"event": name, "rows": rows[i]} | ({"target": loaded.targets[i]} if loaded.own_epochs else {})
        when = float(loaded.times[i])
        yield Recorded(when, json.dumps(line | ({"time": when} if np.isfinite(when) else {})).encode())


def _is_reversible(kind: str) -> bool:
    """Return whether a row is a difference or ratio of two stations, so that a file may reverse its sign."""
    model = MODELS[kind]
    return model.stations > 1 and not (model.ranges is not None and sum(model.ranges) > 1)


def replay(
    recording: Sequence[Recorded], stream: Stream, speed: float, source: str, adapter: Adapter | None = None
) -> None:
    """Pass the lines of a recording to a stream until the end of the recording or of the stream.

    `speed` is the replay speed relative to the recording; infinity: as fast as the stream answers. `source` is the name
    of the recording for messages. `adapter` converts recorded lines to lines of a stream.
    """
    # `when` is the time of reading of the last line that has one. `never` is not set: its wait is a sleep.
    began, first, when, never = stream.clock(), np.nan, 0.0, Event()
    waiting: list[QueuedLine] = []
    for number, (received, data) in enumerate(recording, 1):
        first = received if np.isnan(first) else first
        wait = 0.0 if np.isnan(received) else (received - first) / speed - (stream.clock() - began)
        if wait > 0.0 or len(waiting) >= _MANY:
            stream.inbox.put(waiting)
            waiting = []
            while wait > 0.0 and not stream.inbox.closed:
                never.wait(min(wait, 0.2))
                wait = (received - first) / speed - (stream.clock() - began)
        if stream.inbox.closed:
            return
        when = when if np.isnan(received) else received
        line, fault = convert(adapter, data)
        waiting.append(QueuedLine(line, number, source, stream.clock(), when, fault=fault))
    stream.inbox.put(waiting)

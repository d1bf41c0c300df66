"""Recordings: lines with the seconds at which they were read, or the epochs of a problem file, again at any speed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Event
from typing import NamedTuple

import numpy as np

from optloc.files import Draft, draft, read_bytes
from optloc.models import MODELS
from optloc.service.queues import QueuedLine
from optloc.service.stream import Stream

# Lines that are handed on at once where nobody waits for the clock.
_MANY = 64


class Recorded(NamedTuple):
    """A line, and the seconds at which it was read; NaN: right behind the one before."""

    received: float
    data: bytes


def read_recording(path: Path) -> list[Recorded]:
    """Return the lines of a recording.

    Parameters
    ----------
    path : Path
        Lines of JSON, with the key ``received`` where ``--record`` wrote them; or a problem file (.toml), of which each
        epoch is an event.

    Raises
    ------
    InvalidProblem
        Where it cannot be read.
    """
    if path.suffix.lower() == ".toml":
        return list(_epochs(draft(path, values=True)))
    return [Recorded(_received(line), line) for line in read_bytes(path, lines=True).split(b"\n") if line.strip()]


def _received(line: bytes) -> float:
    if b'"received"' not in line:
        return np.nan
    try:
        found = json.loads(line)
        return float(found.get("received", np.nan))
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError):
        return np.nan  # the stream says what is wrong with it


def _epochs(made: Draft) -> Iterator[Recorded]:
    """Yield the epochs of a problem file as events, in the order of their times."""
    loaded = made.loaded
    rows: list[list[dict[str, object]]] = [[] for _ in loaded.epochs]
    names = loaded.problem.stations.names
    epoch = loaded.problem.epoch
    for chunk, number in zip(made.chunks, made.numbers, strict=True):
        section = made.file.measurements[next(i for i, table in enumerate(made.tables) if table is chunk.table)]
        z, count = chunk.table.numbers("z", optional=True), MODELS[chunk.kind].stations
        sigma = chunk.table.numbers("sigma") if chunk.table.has("sigma") else None
        ends = (chunk.b, chunk.a) if section.positive == "b-farther" and _turned(chunk.kind) else (chunk.a, chunk.b)
        for i in np.flatnonzero(chunk.weight > 0.0).tolist():
            row: dict[str, object] = {"kind": chunk.kind, "z": float(z[chunk.row[i]])}
            row |= {key: names[int(end[i])] for key, end in zip("ab"[:count], ends, strict=False)}
            rows[epoch[number[i]]].append(row if sigma is None else row | {"sigma": float(sigma[chunk.row[i]])})
    for i in np.argsort(loaded.times, kind="stable").tolist():
        name = f"{loaded.epochs[i]} {loaded.targets[i]}" if loaded.own_epochs else loaded.epochs[i]
        line = {"event": name, "rows": rows[i]} | ({"target": loaded.targets[i]} if loaded.own_epochs else {})
        when = float(loaded.times[i])
        yield Recorded(when, json.dumps(line | ({"time": when} if np.isfinite(when) else {})).encode())


def _turned(kind: str) -> bool:
    """Return whether a row sets one station against another, so that a file may turn its sign."""
    model = MODELS[kind]
    return model.stations > 1 and not (model.ranges is not None and sum(model.ranges) > 1)


def replay(recording: Sequence[Recorded], stream: Stream, speed: float, source: str) -> None:
    """Hand the lines of a recording to a stream, and close it behind them.

    Parameters
    ----------
    recording : sequence of Recorded
        The lines.
    stream : Stream
        Who gets them.
    speed : float
        How many times as fast as they were read; infinity: as fast as they are answered.
    source : str
        What complaints call them.
    """
    began, first, when, never = stream.clock(), np.nan, 0.0, Event()
    waiting: list[QueuedLine] = []
    for number, (received, data) in enumerate(recording, 1):
        first = received if np.isnan(first) else first
        left = 0.0 if np.isnan(received) else (received - first) / speed - (stream.clock() - began)
        if left > 0.0 or len(waiting) >= _MANY:
            stream.inbox.put(waiting)
            waiting = []
            while left > 0.0 and not stream.inbox.closed:
                never.wait(min(left, 0.2))
                left = (received - first) / speed - (stream.clock() - began)
        if stream.inbox.closed:
            return
        when = when if np.isnan(received) else received
        waiting.append(QueuedLine(data, number, source, stream.clock(), when))
    stream.inbox.put(waiting)
    stream.close()

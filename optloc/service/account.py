"""The account of a stream: for each source, how many lines were received, and what became of them.

Each received line is in one of four states, so that ``received = answered + refused + dropped + open``:

answered
    Its event has its last answer, or its command was run.
refused
    The line is invalid, or the queue was full and the client got an error.
dropped
    The line is in no answer: it was late, had another value than its answered event, belongs to another process, or
    found no place in a queue.
open
    The line waits in a queue, or for the answer of its event.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from threading import Lock

SETTLED = ("answered", "refused", "dropped")
"""States of a line that do not change any more."""

STATES = ("received", *SETTLED, "open")
"""Counts of a source."""

# Largest number of sources with separate counts, since names of sources may come from clients.
_SOURCES = 256
OTHERS = "others"
"""Source that has the lines of all sources beyond the largest number of sources."""


class Account:
    """Counts of lines by source and state; thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._counts: dict[str, Counter[str]] = {}

    def _of(self, source: str) -> Counter[str]:
        """Return the counts of a source; the caller has the lock."""
        found = self._counts.get(source)
        if found is None:
            if len(self._counts) >= _SOURCES:
                source = OTHERS
            found = self._counts.setdefault(source, Counter(dict.fromkeys(STATES, 0)))
        return found

    def receive(self, source: str, count: int = 1) -> None:
        """Count lines of a source as received and open."""
        with self._lock:
            found = self._of(source)
            found["received"] += count
            found["open"] += count

    def settle(self, state: str, lines: Mapping[str, int]) -> None:
        """Move open lines, given as numbers by source, to a state of `SETTLED`."""
        with self._lock:
            for source, count in lines.items():
                found = self._of(source)
                found["open"] -= count
                found[state] += count

    def records(self) -> dict[str, dict[str, int]]:
        """Return the counts by source, each a dictionary with the keys `STATES`."""
        with self._lock:
            return {source: dict(found) for source, found in self._counts.items()}

    def for_checkpoint(self, waiting: Mapping[str, int]) -> dict[str, dict[str, int]]:
        """Return the counts for a checkpoint, in which only the `waiting` lines of its events are open, by source.

        Lines that wait in a queue are not in the checkpoint, so they do not count as received.
        """
        out = {}
        for source, found in self.records().items():
            open_lines = waiting.get(source, 0)
            settled = {state: found[state] for state in SETTLED}
            out[source] = {"received": sum(settled.values()) + open_lines, **settled, "open": open_lines}
        return out

    def restore(self, stored: Mapping[str, Mapping[str, int]]) -> None:
        """Replace the counts by the counts of a checkpoint."""
        with self._lock:
            self._counts = {source: Counter(found) for source, found in stored.items()}

    def difference(self, waiting: Mapping[str, int]) -> dict[str, int]:
        """Return by source the open lines minus the lines `waiting` in queues and events; empty if they are equal."""
        counts = self.records()
        found = {source: counts[source]["open"] - waiting.get(source, 0) for source in counts}
        return {source: count for source, count in found.items() if count}


def total(lines: Iterable[Mapping[str, int]]) -> Counter[str]:
    """Return the sum of numbers of lines by source."""
    found: Counter[str] = Counter()
    for each in lines:
        found.update(each)
    return found

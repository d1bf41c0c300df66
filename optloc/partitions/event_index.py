"""Events that occur in two partitions: their readings would be fixed apart, as two events."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optloc.base.types import Array


def event_hashes(epoch: Iterable[Any], target: Iterable[Any]) -> Array:
    """Return 64-bit hashes (n,) of events, sorted and distinct; an event is an epoch and a target, as texts."""
    from pandas.util import hash_array

    texts = np.array([f"{one}\0{other}" for one, other in zip(epoch, target, strict=True)], dtype=object)
    return np.unique(hash_array(texts, categorize=False))


@dataclass(slots=True)
class EventIndex:
    """The hashes of the events of partitions: 12 bytes for each event.

    `_runs` are sorted hashes with the numbers of their partitions. Each run has at least twice the size of the next
    one, so that adding n partitions merges each hash log(n) times.
    """

    names: list[str] = field(default_factory=list)
    _runs: list[tuple[Array, Array]] = field(default_factory=list)

    def add(self, name: str, hashes: Array) -> list[str]:
        """Add the events of a partition, and return the earlier partitions that seem to have one of its events.

        Hashes of different events can be equal, so compare the events of the returned partitions.
        """
        suspects = set[int]()
        for known, owner in self._runs:
            place = np.minimum(np.searchsorted(known, hashes), len(known) - 1)
            suspects |= set(owner[place[known[place] == hashes]].tolist())
        found = [self.names[number] for number in sorted(suspects)]
        if len(hashes):
            self._runs.append((hashes, np.full(len(hashes), len(self.names), dtype=np.uint32)))
        self.names.append(name)
        while len(self._runs) > 1 and len(self._runs[-2][0]) < 2 * len(self._runs[-1][0]):
            (one, owners), (other, others) = self._runs.pop(), self._runs.pop()
            hashes, owner = np.concatenate([one, other]), np.concatenate([owners, others])
            order = np.argsort(hashes, kind="stable")
            self._runs.append((hashes[order], owner[order]))
        return found

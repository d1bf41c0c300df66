"""Rows that a file has twice, most often because it was put together of overlapping parts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.chunk import Chunk
from optloc.files.epochs import Epochs
from optloc.types import Array


def check_repeats(
    chunks: Sequence[Chunk], index: Sequence[Array], target: Sequence[Array], stations: Sequence[str], epochs: Epochs
) -> None:
    """Refuse a row that another one repeats.

    Two measurements of the same stations at the same epoch are welcome where each has noise of its own; the same value
    at the same stated time or epoch is a copy. Where the noise is that of arrivals, both have the same noise and only
    one can be right.

    Parameters
    ----------
    chunks : sequence of Chunk
        Rows of each kind of each table.
    index, target : sequence of int array (m,)
        Epoch and target of each row of each chunk.
    stations : sequence of str
        Names of the stations.
    epochs : Epochs
        The epochs.

    Raises
    ------
    InvalidProblem
        Naming the row and the one that it repeats.
    """
    for kind in dict.fromkeys(chunk.kind for chunk in chunks):
        same = [i for i, chunk in enumerate(chunks) if chunk.kind == kind]
        table = np.concatenate([_table(chunks[i], index[i], target[i], i) for i in same], axis=1)
        order = np.lexsort(table[_PLACE:0:-1])
        keys = table[1:_PLACE, order]
        twice = np.flatnonzero((keys[:, 1:] == keys[:, :-1]).all(0))
        if len(twice):
            at = twice[np.argmin(order[twice + 1])]
            one, two = (table[[0, _PLACE], order[i]].astype(int) for i in (at, at + 1))
            epoch = epochs.labels[int(table[3, order[at]])]
            raise _repeated((chunks[two[0]], two[1]), (chunks[one[0]], one[1]), stations, epoch)


_PLACE = 8


def _table(chunk: Chunk, index: Array, target: Array, number: int) -> Array:
    """Return the number of the chunk, what makes rows equal, and the place in the chunk, as columns (9, present)."""
    own = chunk.arrival is None
    time = np.zeros(len(index)) if chunk.time is None or not own else chunk.time
    value = chunk.z if own else np.zeros(len(index))
    same = (chunk.a, chunk.b, index, target, np.full(len(index), own), value, time)
    table = np.array([np.full(len(index), number), *same, np.arange(len(index))], dtype=float)
    dated = not own or chunk.label is not None or chunk.time is not None
    return table[:, (chunk.weight > 0.0) & ~np.isnan(value) & dated]


def _repeated(
    again: tuple[Chunk, int], first: tuple[Chunk, int], stations: Sequence[str], epoch: str
) -> InvalidProblem:
    (chunk, i), (other, j) = again, first
    names = "-".join(stations[s] for s in (chunk.a[i], chunk.b[i]) if s >= 0)
    row = f"row {other.row[j] + 1}" + ("" if other.table is chunk.table else f" of {other.table.source}")
    what = " ".join(f"{chunk.kind} {names} of epoch {epoch!r} is already in {row}".split())
    advice = "leave one of them out, or give each an epoch of its own"
    if chunk.arrival is not None:
        what += ", and by arrival_sigma both have the same noise"
    return InvalidProblem(what, chunk.table.where("z", int(chunk.row[i])), advice)

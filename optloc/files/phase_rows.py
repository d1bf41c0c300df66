"""P and S arrivals in problem files: rows with a phase, converted to rows of the kinds of a problem.

A section with the key `vp_vs` has arrivals with a column `phase`. They become arrival times, ranges and range
differences with a joint noise (`optloc.problem.phases`). In shapes, m is the number of rows of a chunk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.files.measurements import RowChunk
from optloc.files.schema import MediumTable
from optloc.files.settings import join
from optloc.files.table import Table
from optloc.models.phase_layers import S_TOA
from optloc.problem.noise import Block
from optloc.problem.phases import Combination, phase_blocks, phase_rows

LAYERS = "layers"
"""Value of the key `vp_vs` if layers have speeds of both waves."""


def wave_of(phase: str) -> str | None:
    """Return the wave of a phase name, "P" or "S", such as "P" for "Pg" or "IPU0"; None for other phases.

    The first letter may be I or E, for an impulsive or an emergent onset. Phases through the core of the Earth, such as
    "PKP" and "ScS", and surface waves have other paths, so they are None.
    """
    text = phase.strip()
    text = text[1:] if text[:1].upper() in ("I", "E") else text
    wave, rest = text[:1].upper(), text[1:]
    direct = rest[:1] in ("", "g", "n", "b", "m", "1", "?", "_", "G", "N", "B", "U", "D", "+", "-", "C", " ")
    return wave if wave in ("P", "S") and (direct or rest[:1].isdigit()) else None


def is_s_of(table: Table) -> Array:
    """Return whether each row (m,) of a table with a column `phase` is an S wave; raise InvalidProblem for others."""
    waves = [wave_of(str(phase)) for phase in table.labels("phase").tolist()]
    if None in waves:
        row = waves.index(None)
        what = f"the phase {str(table.labels('phase')[row])[:20]!r} is neither P nor S"
        raise InvalidProblem(what, table.where("phase", row), "write P or S, or remove the row")
    return np.array([wave == "S" for wave in waves], dtype=bool)


def split_phases(
    chunks: Sequence[RowChunk], index: Sequence[Array], target: Sequence[Array], source: str
) -> tuple[list[RowChunk], list[Array], list[Array]]:
    """Return chunks without phases, and the epoch and target (m,) of their rows.

    `index` and `target` are the epoch and target of the rows of `chunks`. A chunk with phases becomes one chunk for
    each kind of its combinations. Raise InvalidProblem for phases without standard deviations.
    """
    made: list[RowChunk] = []
    epochs: list[Array] = []
    targets: list[Array] = []
    for chunk, epoch, label in zip(chunks, index, target, strict=True):
        if chunk.vp_vs is None:
            parts = [(chunk, np.arange(len(epoch)))]
        elif chunk.vp_vs == LAYERS:
            parts = _separate(chunk)
        else:
            parts = _combined(chunk, epoch, label, source)
        made += [part for part, _ in parts]
        epochs += [epoch[rows] for _, rows in parts]
        targets += [label[rows] for _, rows in parts]
    return made, epochs, targets


def _separate(chunk: RowChunk) -> list[tuple[RowChunk, Array]]:
    """Return the P and the S waves of a chunk as separate chunks, and their rows; layers have a speed for each."""
    is_s = is_s_of(chunk.table)[chunk.row]
    parts = []
    for kind, rows in (("toa", np.flatnonzero(~is_s)), (S_TOA, np.flatnonzero(is_s))):
        if not len(rows):
            continue
        names = ("row", "z", "a", "b", "weight", "correction", "slope", "baseline", "sigma", "label", "time", "written")
        columns = {name: getattr(chunk, name) for name in (*names, "target")}
        taken = {name: None if column is None else column[rows] for name, column in columns.items()}
        parts.append((replace(chunk, kind=kind, vp_vs=None, **taken), rows))
    return parts


def check_layers(chunks: Sequence[RowChunk], medium: MediumTable | None, source: str) -> None:
    """Raise InvalidProblem if the speeds of S waves are stated to be in layers, and the file has no such layers."""
    if any(chunk.vp_vs == LAYERS for chunk in chunks) and (medium is None or medium.s_speeds is None):
        advice = "add s_speeds to [medium], or write a ratio such as 1.73"
        raise InvalidProblem("the file has no layers with speeds of S waves", join(source, "key 'vp_vs'"), advice)


def _combined(chunk: RowChunk, epoch: Array, target: Array, source: str) -> list[tuple[RowChunk, Array]]:
    """Return the chunks of the combinations of a chunk with phases, and the first arrival of each of their rows.

    `epoch` and `target` are of the rows of the chunk. `source` is the name of the file for messages.
    """
    assert isinstance(chunk.vp_vs, float)
    present = np.flatnonzero(chunk.weight > 0.0)
    if chunk.sigma is None or (chunk.weight[present] != 1.0).any():
        what = "P and S arrivals need standard deviations, and weights of 0 or 1"
        raise InvalidProblem(what, chunk.table.source, 'write sigma = "0.1 s", or a column sigma')
    is_s = is_s_of(chunk.table)[chunk.row]
    event = np.unique(np.column_stack([epoch, target]), axis=0, return_inverse=True)[1].reshape(-1)
    try:
        sets, unused = phase_rows(chunk.a[present], is_s[present], event[present], chunk.vp_vs)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, join(source, "key 'vp_vs'"), "give a ratio such as 1.73") from None
    made, events, variance = [], event[present], chunk.sigma[present] ** 2
    for rows in sets:
        first = present[rows.arrival[:, 0]]
        columns: dict[str, Any] = {name: rows.combine(getattr(chunk, name)[present]) for name in ("z", "correction")}
        columns |= {
            name: None if (values := getattr(chunk, name)) is None else values[first]
            for name in ("row", "weight", "slope", "baseline", "label", "time", "written", "target")
        }
        combination = Combination(rows, events, variance, chunk.a[present[unused]])
        part = replace(
            chunk, kind=rows.kind, a=rows.a, b=rows.b, sigma=None, vp_vs=None, combination=combination,
            **columns,
        )  # fmt: skip
        made.append((part, first))
    return made


def unused_picks(chunks: Sequence[RowChunk], names: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence for each section with S picks that no row contains; `names` are the names of the stations."""
    by_section = {id(one.combination.event): one.combination.unused for one in chunks if one.combination is not None}
    return tuple(
        f"{len(unused)} S pick{'s' if len(unused) > 1 else ''} of {_list_names(unused, names)} not used: no station of "
        "the event has both P and S; add a P pick of one of these stations"
        for unused in by_section.values()
        if len(unused)
    )


# Most stations that a sentence names.
_NAMED = 3


def _list_names(stations: Array, names: Sequence[str]) -> str:
    """Return the names of stations (u,) as text, three at most, with the verb of the sentence."""
    found = [str(names[i]) for i in dict.fromkeys(stations.tolist())]
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return f"{', '.join(found[:_NAMED])}{more} {'is' if len(stations) == 1 else 'are'}"


def combined_noise(chunks: Sequence[RowChunk], numbers: Sequence[Array]) -> list[Block]:
    """Return the noise of the chunks that are combinations of arrivals; `numbers` (m,) are global row numbers."""
    # The chunks of one section share the array of events.
    by_section: dict[int, list[tuple[Combination, Array]]] = {}
    for chunk, number in zip(chunks, numbers, strict=True):
        if chunk.combination is not None:
            by_section.setdefault(id(chunk.combination.event), []).append((chunk.combination, number))
    blocks = []
    for section in by_section.values():
        first = section[0][0]
        sets, rows = [one.rows for one, _ in section], [number for _, number in section]
        blocks += phase_blocks(sets, rows, first.event, first.variance)
    return blocks

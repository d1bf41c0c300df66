"""Targets whose positions are given, for calibration: their tables are read like those of stations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.epochs import Epochs
from optloc.files.moving import spread
from optloc.files.schema import FrameTable, Origin, ProblemFile, StationsTable, TargetTable
from optloc.files.sources import table_of
from optloc.files.stations import survey
from optloc.files.table import Table
from optloc.files.words import join
from optloc.frames import Frame
from optloc.types import Array


def places_of(file: ProblemFile, folder: Path, source: str) -> dict[str | None, Table]:
    """Return the tables of targets whose motion is known, by name; None is the table ``[target]``."""
    sections: list[tuple[str | None, TargetTable]] = [(None, file.target), *file.targets.items()]
    found = {}
    for name, section in sections:
        where = join(source, "[target]" if name is None else f"[targets.{name}]")
        if section.moves == "known":
            found[name] = table_of(section, folder, where)
        elif section.file is not None or section.rows is not None:
            advice = 'write motion = "known", or leave the rows out'
            raise InvalidProblem(f"the motion is {section.motion}, but its places are given", where, advice)
    return found


def known_of(
    file: ProblemFile, places: Mapping[str | None, Table], epochs: Epochs, frame: Frame, dimension: int
) -> dict[str, Array]:
    """Return the states (k or 1, order + 1, d) of the known targets by name; arguments as `places_of` returns them."""
    states = {}
    for i, name in enumerate(epochs.targets):
        key = name if name in file.targets else None
        if key in places:
            section = file.target if key is None else file.targets[key]
            wanted = _settled(file.frame, frame, dimension)
            states[name] = _states(
                section, places[key], name, epochs, np.unique(epochs.index[epochs.target == i]), wanted
            )
    return states


def _states(section: TargetTable, table: Table, name: str, epochs: Epochs, heard: Array, wanted: FrameTable) -> Array:
    dated = table.has("time") or table.has("epoch")
    if table.count > 1 and not dated:
        raise InvalidProblem(f"target {name!r} has several places", table.source, "give a column 'time' or 'epoch'")
    own = {key: value for key, value in table.names.items() if key != "name"}
    named = Table(table.source, {**table.columns, "name": np.full(table.count, name, dtype=object)}, table.count, own)
    units = StationsTable(unit=section.unit, speed_unit=section.speed_unit, time_unit=section.time_unit)
    found = replace(survey(units, named, wanted, table.source)[0], noun="target")
    position, velocity = found.position[:, None], None if found.velocity is None else found.velocity[:, None]
    if dated:
        used = np.stack([heard, np.zeros_like(heard)], axis=-1)
        position, velocity, _ = spread(found, units, epochs, used)
    return position if velocity is None else np.concatenate([position, velocity], axis=-2)


def _settled(wanted: FrameTable, frame: Frame, dimension: int) -> FrameTable:
    """Return the frame table with the origin and the dimension that the stations decided."""
    origin = None
    if frame.origin is not None:
        lat, lon = np.degrees(frame.origin[:2]).tolist()
        origin = Origin(lat_deg=lat, lon_deg=lon, height=frame.origin[2])
    return wanted.model_copy(update={"dimension": dimension, "origin": origin})

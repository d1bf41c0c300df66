"""Options that all partitions of a data set share, and their record in its journal."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Stations
from optloc.files.constraint_table import ConstraintTable
from optloc.files.measurements import ESTIMATE
from optloc.files.stations import station_table
from optloc.files.table_import import ColumnHints
from optloc.files.wave_speed import WaveOptions
from optloc.partitions.journal import digest_of

# Options on the wave by field of `WaveOptions`.
_WAVES = {"wave_speed": "speed", "wind": "wind", "two_way": "two_way", "turn_around": "turn_around"}


@dataclass(frozen=True, slots=True)
class FixOptions:
    """Options that all partitions of a data set share.

    Parameters
    ----------
    hints : ColumnHints
        Facts that the tables do not contain.
    method : str
        Method as in `optloc.solve`.
    more : mapping of str to ConstraintTable
        Constraints by the name of their option.
    """

    hints: ColumnHints
    method: str = "auto"
    more: Mapping[str, ConstraintTable] = field(default_factory=dict)


def hints_of(stations: Any, options: Mapping[str, Any]) -> ColumnHints:
    """Return the hints for stations in any accepted form, and for further fields of `ColumnHints` by name."""
    other = ("stations", "times", "navigation", "wave")
    known = [*(name for name in ColumnHints.__dataclass_fields__ if name not in other), *_WAVES]
    unknown = next((name for name in options if name not in known), None)
    if unknown is not None:
        raise InvalidProblem(f"there is no option {unknown!r}", unknown, nearest(unknown, known))
    wave = WaveOptions(**{_WAVES[name]: value for name, value in options.items() if name in _WAVES})
    options = {name: value for name, value in options.items() if name not in _WAVES} | {"wave": wave}
    if isinstance(stations, str | Path):
        return ColumnHints(stations=Path(stations), **options)
    if stations is None:
        return ColumnHints(**options)
    named = isinstance(stations, Stations | Mapping) or hasattr(stations, "columns")
    if not named:
        raise InvalidProblem("the stations have no names", "stations", "give a mapping, a data frame or a file")
    return ColumnHints(stations=station_table(stations, "stations"), **options)


def check_shared(hints: ColumnHints) -> None:
    """Raise InvalidProblem for options whose result depends on the other events of a partition."""
    if hints.window is not None:
        advice = "give each event an identifier, and state its column with --column message=NAME"
        raise InvalidProblem("each partition would begin with a new window", "--window", advice)
    if hints.still:
        raise InvalidProblem("a partition has many events", "--still", "use this option for one file")
    if hints.sigma is not None and ESTIMATE in hints.sigma:
        advice = "estimate it for one file with optloc fix, and state the number"
        raise InvalidProblem("each partition would have another sigma", "--sigma", advice)


def identity_of(options: FixOptions) -> dict[str, Any]:
    """Return everything on which fixes depend as a JSON value; files are represented by their checksums."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        release = version("optloc")
    except PackageNotFoundError:
        release = "0"
    plain = partial(json.dumps, default=_json_value, sort_keys=True)
    values = _checksums_and_values(options.hints)
    hints = {name: json.loads(plain(value)) for name, value in values.items() if value}
    constraints = {place: table.model_dump(mode="json", exclude_none=True) for place, table in options.more.items()}
    return {"version": release, "method": options.method, **hints, "constraint": constraints}


def _checksums_and_values(record: Any) -> dict[str, Any]:
    """Return the fields of a dataclass by name; the name of a file is replaced by its checksum."""

    def checksum_or_value(value: Any) -> Any:
        named = isinstance(value, str | Path) and len(str(value)) < 1000  # longer names are no files on any system
        return f"checksum {digest_of(Path(value))}" if named and Path(value).is_file() else value

    return {name: checksum_or_value(getattr(record, name)) for name in record.__dataclass_fields__}


def _json_value(value: Any) -> Any:
    """Return a value that JSON does not have as an object of fields or as text."""
    return _checksums_and_values(value) if hasattr(value, "__dataclass_fields__") else str(value)

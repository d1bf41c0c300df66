"""The function `fix_table`: the fixes of one partition of readings, as a table with a fixed schema."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Stations, Status
from optloc.files.constraint_table import ConstraintTable, constraint_of_text
from optloc.files.convert import interpret_table
from optloc.files.measurements import ESTIMATE
from optloc.files.reader import Loaded
from optloc.files.stations import station_table
from optloc.files.table import Table, of_arrow
from optloc.files.table_import import ColumnHints
from optloc.files.table_problem import TableProblem
from optloc.partitions.epoch_fixes import fix_columns, fix_epochs
from optloc.partitions.fix_schema import frame_of
from optloc.problem.epochs import separable
from optloc.show.columns import Columns

if TYPE_CHECKING:
    import pandas as pd

# The reason of an event in which each receiver is missing.
_NO_READING = "the event has no reading"


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


def fix_table(
    frame: pd.DataFrame,
    stations: Any = None,
    *,
    method: str = "auto",
    constraints: Sequence[str] = (),
    **options: Any,
) -> pd.DataFrame:
    """Return the fixes of a table of readings, one row for each event, with the schema `optloc.fix_schema`.

    Each partition of a data set gives a table with the same columns and types, also an empty partition. So Dask, Ray
    Data and Spark can call the function for partitions. All readings of an event must be in one partition.

    Parameters
    ----------
    frame : pandas.DataFrame
        Readings: one in each row, with a column of events; or a column for each receiver. Missing readings are NaN.
    stations : path, pandas.DataFrame, mapping of name to coordinates, or Stations, optional
        Station positions, as in `optloc.load_table` or `optloc.locate`; by default from the table itself.
    method : str
        Method as in `optloc.solve`.
    constraints : sequence of str
        Constraints as texts of the command line, such as ``"height exactly=2 m"``.
    **options
        Further fields of `optloc.files.table_import.ColumnHints`: ``sigma="20 ns"``, ``what="range"``,
        ``columns={"message": "event_id"}`` and others.

    Returns
    -------
    pandas.DataFrame
        Metres, seconds and degrees; NaN marks a missing number. An event without a reading has the status "too few
        rows". The index of `frame` is not used.

    Raises
    ------
    InvalidProblem
        The message names the column, the row or the option.

    Examples
    --------
    >>> import optloc, pandas as pd
    >>> anchors = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0), "D": (8.0, 6.0)}
    >>> table = pd.DataFrame({"event": [7, 9], "A": [5.01, None], "B": [5.02, 4.9], "C": [4.98, 5.1], "D": [5.0, 5.0]})
    >>> options = {"what": "range", "unit": "m", "sigma": "5 cm", "columns": {"message": "event"}}
    >>> fixes = optloc.fix_table(table, anchors, **options)
    >>> fixes[["epoch", "status"]].values.tolist()
    [['7', 'ok'], ['9', 'ok']]
    """
    import pyarrow as pa

    texts = {f"constraints, item {i + 1}": text for i, text in enumerate(constraints)}
    more = {place: constraint_of_text(text, place) for place, text in texts.items()}
    try:
        readings = pa.Table.from_pandas(frame, preserve_index=False)
    except (pa.ArrowException, TypeError, ValueError, AttributeError) as error:
        what = f"the table cannot be read ({str(error).splitlines()[0]})"
        raise InvalidProblem(what, "frame", "give a data frame with columns of numbers, dates or text") from None
    options_of_all = FixOptions(hints_of(stations, options), method, more)
    return fix_rows(of_arrow(readings, "frame"), Path("frame"), options_of_all)


def hints_of(stations: Any, options: Mapping[str, Any]) -> ColumnHints:
    """Return the hints for stations in any accepted form, and for further fields of `ColumnHints` by name."""
    known = [name for name in ColumnHints.__dataclass_fields__ if name not in ("stations", "times", "navigation")]
    unknown = next((name for name in options if name not in known), None)
    if unknown is not None:
        raise InvalidProblem(f"there is no option {unknown!r}", unknown, nearest(unknown, known))
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
        raise InvalidProblem("windows would begin anew in each partition", "--window", advice)
    if hints.still:
        raise InvalidProblem("a partition has many events", "--still", "use this option for one file")
    if hints.sigma is not None and ESTIMATE in hints.sigma:
        advice = "estimate it for one file with optloc fix, and state the number"
        raise InvalidProblem("each partition would have another sigma", "--sigma", advice)


def fix_rows(table: Table, source: Path, options: FixOptions) -> pd.DataFrame:
    """Return the fixes of a table of readings, with the schema `optloc.fix_schema`.

    `source` is the name of the table for messages, and `options` are the options of all partitions.
    """
    check_shared(options.hints)
    if not table.count:
        return frame_of({}, 0)
    with np.errstate(all="ignore"):  # the status reports values that are not finite
        found = interpret_table(source, options.hints, table)
        _check_events(found)
        loaded = found.read(options.more)
        if not separable(loaded.problem):
            what = "all events share an unknown, such as a wave speed with a standard deviation"
            raise InvalidProblem(what, source.name, "state its value, so that each event is fixed alone")
        fix, _ = fix_epochs(loaded, options.method)
        columns = fix_columns(loaded, fix, 0)
    return frame_of(*_with_missing(columns, found, loaded, -fix.layout.size))


def _check_events(found: TableProblem) -> None:
    """Raise InvalidProblem for a table with one reading in each row and without a column of events."""
    if not found.events.keys() & {"epoch", "time"}:
        advice = "state the column with --column message=NAME or --column time=NAME"
        raise InvalidProblem("no column has the event of each reading", found.source.name, advice)


def has_labels(found: TableProblem) -> bool:
    """Return whether columns name the events; otherwise each row is an event, and its number is the label."""
    return bool({"message", "time"} & set(found.uses.values()))


def _with_missing(columns: Columns, found: TableProblem, loaded: Loaded, dof: int) -> tuple[Columns, int]:
    """Return a table of fixes with a row for each event without a reading, and its number of rows.

    `columns` is the table of fixes. `dof` is the number of degrees of freedom without a reading.
    """
    count = len(columns["x"])
    missing = _missing_events(columns, found, loaded)
    lost = len(missing["epoch"])
    if not lost:
        return columns, count
    missing["status"] = np.array([Status.TOO_FEW_ROWS.label] * lost, dtype=object)
    missing["reason"] = np.array([_NO_READING] * lost, dtype=object)
    missing["dof"] = np.full(lost, dof)
    rows = {}
    for name, column in columns.items():
        blank: Any = "" if column.dtype == object else np.nan if column.dtype.kind == "f" else 0
        rows[name] = np.concatenate([column, missing.get(name, np.full(lost, blank, dtype=column.dtype))])
    return rows, count + lost


def _missing_events(columns: Columns, found: TableProblem, loaded: Loaded) -> Columns:
    """Return the columns epoch, time and target of the events of a table that have no fix; arguments as above."""
    events = {name: np.asarray(column) for name, column in found.events.items()}
    count = len(next(iter(events.values())))
    epoch = events["epoch"] if "epoch" in events else events["time"]
    target = events.get("target", np.full(count, loaded.targets[0], dtype=object))
    time = events.get("time", np.full(count, np.nan))
    # Fixes of tables without labels have the text of the time as a label, so their times are compared.
    known = columns["epoch"] if "epoch" in events else columns["time"]
    fixed = set(zip(known.tolist(), columns["target"].tolist(), strict=True))
    lost: dict[tuple[Any, Any], int] = {}
    for row, pair in enumerate(zip(epoch.tolist(), target.tolist(), strict=True)):
        if pair not in fixed and pair not in lost:
            lost[pair] = row
    rows = list(lost.values())
    label = np.array([str(epoch[row]) for row in rows], dtype=object)
    return {"epoch": label, "time": time[rows].astype(float), "target": target[rows]}

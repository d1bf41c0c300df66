"""The function `fix_table`: the fixes of one partition of readings, as a table with a fixed schema."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Status
from optloc.files.columns import PLACE
from optloc.files.constraint_table import constraint_of_text
from optloc.files.convert import interpret_table
from optloc.files.reader import Loaded
from optloc.files.roles import Roles
from optloc.files.shapes import events_of_rows
from optloc.files.table import Table, of_arrow
from optloc.files.table_import import NoReading, without_ignored_columns
from optloc.partitions.epoch_fixes import fix_columns, fix_epochs, solve_floors
from optloc.partitions.fix_options import FixOptions, check_shared, hints_of
from optloc.partitions.fixed_columns import arrow_of, frame_of
from optloc.problem.epochs import separable
from optloc.show.columns import Columns

if TYPE_CHECKING:
    import pandas as pd

Frame = TypeVar("Frame")
"""A pandas data frame, or a table of pyarrow."""

# The reason of an event in which each receiver is missing.
_NO_READING = "the event has no reading"


def fix_table(
    frame: Frame,
    stations: Any = None,
    *,
    method: str = "auto",
    constraints: Sequence[str] = (),
    **options: Any,
) -> Frame:
    """Return the fixes of a table of readings, one row for each event, with the schema `optloc.partitions.fix_schema`.

    Each partition of a data set gives a table with the same columns and types, also an empty partition. So Dask, Ray
    Data and Spark can call the function for partitions. All readings of an event must be in one partition.

    Parameters
    ----------
    frame : pandas.DataFrame or pyarrow.Table
        Readings: one in each row, with a column of events; or a column for each receiver. Missing readings are NaN or
        null.
    stations : path, pandas.DataFrame, mapping of name to coordinates, or Stations, optional
        Station positions, as in `optloc.load_table` or `optloc.locate`; by default from the table itself.
    method : str
        Method as in `optloc.solve`.
    constraints : sequence of str
        Constraints as texts of the command line, such as ``"height exactly=2 m"``.
    **options
        Further fields of `optloc.files.table_import.ColumnHints`: ``sigma="20 ns"``, ``what="range"``,
        ``columns={"message": "event_id"}``; and `wave_speed`, `wind`, `two_way` and `turn_around`, as texts of the
        command line.

    Returns
    -------
    pandas.DataFrame or pyarrow.Table
        As `frame`. Metres, seconds and degrees; NaN marks a missing number, null in a table of pyarrow. An event
        without a reading has the status "too few rows". The index of `frame` is not used.

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
    given: Any = frame
    try:
        readings = given if isinstance(given, pa.Table) else pa.Table.from_pandas(given, preserve_index=False)
    except (pa.ArrowException, TypeError, ValueError, AttributeError) as error:
        what = f"the table cannot be read ({str(error).splitlines()[0]})"
        raise InvalidProblem(what, "frame", "give a data frame with columns of numbers, dates or text") from None
    options_of_all = FixOptions(hints_of(stations, options), method, more)
    fixes: Any = fix_rows_labelled(of_arrow(readings, "frame"), Path("frame"), options_of_all)[0]
    return arrow_of(fixes) if readings is given else fixes  # type: ignore[no-any-return]


def fix_rows_labelled(table: Table, source: Path, options: FixOptions) -> tuple[pd.DataFrame, bool]:
    """Return the fixes of a table of readings, in the schema of `fix_schema`, and whether columns name events.

    `source` is the name of the table for messages, and `options` are the options of all partitions. Without a column
    of events, each row of a wide table is an event, and its label is the number of the row.
    """
    check_shared(options.hints)
    if not table.count:
        return frame_of({}, 0), True
    with np.errstate(all="ignore"):  # the status reports values that are not finite
        try:
            found = interpret_table(source, options.hints, table)
        except NoReading:
            stated = {role: name for role, name in options.hints.columns.items() if role not in PLACE}
            roles = Roles.of(without_ignored_columns(table, options.hints.ignore), stated)
            labelled = bool(roles.find("message") or roles.find("time"))
            return frame_of(*_with_missing({}, events_of_rows(roles, options.hints), "target")), labelled
        if not found.events.keys() & {"epoch", "time"}:
            advice = "state the column with --column message=NAME or --column time=NAME"
            raise InvalidProblem("no column has the event of each reading", source.name, advice)
        loaded = found.read(options.more)
        columns = _fix_events(loaded, options.method)
    labelled = bool({"message", "time"} & set(found.uses.values()))
    return frame_of(*_with_missing(columns, found.events, loaded.targets[0])), labelled


def _fix_events(loaded: Loaded, method: str) -> Columns:
    """Return the fixes of separate events as columns.

    Raise InvalidProblem if the events share an unknown.
    """
    problem = loaded.problem
    if separable(problem):
        fix, _ = fix_epochs(loaded, method)
        return fix_columns(loaded, fix, 0)
    if problem.epochs > 1 or problem.biases or problem.stations.unknown_for == "run":
        what = "all events share an unknown, such as a wave speed with a standard deviation"
        raise InvalidProblem(what, loaded.source, "state its value, so that each event is fixed alone")
    return fix_columns(loaded, solve_floors(problem, method, loaded.floors), None)


def _with_missing(columns: Columns, events: Mapping[str, Any], target: str) -> tuple[Columns, int]:
    """Return a table of fixes with a row for each event without a reading, and its number of rows.

    `columns` is the table of fixes; empty without any. `events` has the columns epoch, time and target of all rows of
    the readings. `target` is the name of the target if no column names it.
    """
    missing = _missing_events(columns, events, target)
    count, lost = len(columns.get("x", ())), len(missing["epoch"])
    if not lost:
        return columns, count
    missing["status"] = np.array([Status.TOO_FEW_ROWS.label] * lost, dtype=object)
    missing["reason"] = np.array([_NO_READING] * lost, dtype=object)
    if not count:
        return missing, lost
    rows = {}
    for name, column in columns.items():
        blank: Any = "" if column.dtype == object else np.nan if column.dtype.kind == "f" else 0
        rows[name] = np.concatenate([column, missing.get(name, np.full(lost, blank, dtype=column.dtype))])
    return rows, count + lost


def _missing_events(columns: Columns, events: Mapping[str, Any], target: str) -> Columns:
    """Return the columns epoch, time and target of the events that have no fix; arguments as `_with_missing`."""
    given = {name: np.asarray(column) for name, column in events.items()}
    epoch = given["epoch"] if "epoch" in given else given["time"]
    owner = given.get("target", np.full(len(epoch), target, dtype=object))
    time = given.get("time", np.full(len(epoch), np.nan))
    # Without labels, an epoch has the text of its time as a label, so times are compared.
    known = columns.get("epoch" if "epoch" in given else "time", np.zeros(0))
    fixed = set(zip(known.tolist(), columns.get("target", known).tolist(), strict=True))
    lost: dict[tuple[Any, Any], int] = {}
    for row, pair in enumerate(zip(epoch.tolist(), owner.tolist(), strict=True)):
        if pair not in fixed:
            lost.setdefault(pair, row)
    rows = list(lost.values())
    label = np.array([str(epoch[row]) for row in rows], dtype=object)
    return {"epoch": label, "time": time[rows].astype(float), "target": owner[rows]}

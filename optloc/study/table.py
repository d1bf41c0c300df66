"""Read the parts of a study as one table; the columns are described in `optloc.study.columns`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.study.columns import COLUMNS, GAP, arrow_schema
from optloc.study.parts import part_files

if TYPE_CHECKING:
    import pandas as pd

SORTED = ("scenario", "sweep", "noise", "method", "key", "trial")


def read_arrow(folder: Path, columns: Sequence[str] | None = None) -> Any:
    """Return the Arrow table of all parts of a study, sorted, so that it does not depend on their order.

    Parameters
    ----------
    folder : Path
        Output folder of a study.
    columns : sequence of str, optional
        Columns to read; all by default. The column `gap` is added where cost, data and trial are among them.

    Raises
    ------
    InvalidProblem
        Where the folder holds no study.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    from pyarrow import parquet

    schema = arrow_schema()
    wanted = [c.name for c in COLUMNS] if columns is None else [c.name for c in COLUMNS if c.name in set(columns)]
    read = list(dict.fromkeys([*wanted, *SORTED]))
    parts = [parquet.read_table(path, columns=read) for path in part_files(folder)]
    empty = pa.schema([schema.field(name) for name in read]).empty_table()
    table = pa.concat_tables([empty, *(part.cast(empty.schema) for part in parts)]).unify_dictionaries()
    plain = {name: pc.cast(table[name], pa.string()) if _text(table, name) else table[name] for name in SORTED}
    table = table.take(pc.sort_indices(pa.table(plain), [(name, "ascending") for name in SORTED]))
    table = table.select(wanted).combine_chunks()
    return with_gap(table) if {"data", "trial", "cost"} <= set(wanted) else table


def _text(table: Any, name: str) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_dictionary(table.schema.field(name).type))


def with_gap(table: Any) -> Any:
    """Return a table with the column `gap`: the cost less the lowest cost of the same data over all methods."""
    import pyarrow as pa

    cells = table["data"].combine_chunks()
    data = np.asarray(cells.indices) if len(table) else np.zeros(0, dtype=np.int64)
    trial, cost = np.asarray(table["trial"]), np.asarray(table["cost"], dtype=float)
    _, inverse = np.unique(np.stack([data.astype(np.int64), trial], axis=1), axis=0, return_inverse=True)
    best = np.full(inverse.max(initial=-1) + 1, np.inf)
    np.minimum.at(best, inverse, np.where(np.isfinite(cost), cost, np.inf))
    with np.errstate(invalid="ignore"):
        gap = cost - best[inverse]
    field = pa.field(GAP.name, pa.float64(), metadata={"unit": GAP.unit, "meaning": GAP.meaning})
    return table.append_column(field, pa.array(gap))


def read_frame(folder: Path, columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Return all rows of a study as a pandas frame (categories for text); arguments and errors as `read_arrow`."""
    frame: pd.DataFrame = read_arrow(folder, columns).to_pandas()
    return frame


def swept(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a frame with one column for each swept parameter, named as in the study file, from the column `sweep`."""
    found: dict[str, dict[str, Any]] = {text: json.loads(text) for text in frame["sweep"].unique()}
    names = dict.fromkeys(name for values in found.values() for name in values)
    return frame.assign(
        **{name: frame["sweep"].astype(object).map(lambda t, n=name: found[t].get(n)) for name in names}
    )

"""Write foreign tables as a problem file with CSV tables beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optloc.convert.arrivals import arrivals
from optloc.convert.places import GEOJSON, Places, places_of
from optloc.convert.pseudoranges import pseudoranges
from optloc.convert.roles import GUESSES, Roles, read_table
from optloc.convert.rows import Measured
from optloc.errors import InvalidProblem, nearest
from optloc.files.loaded import Loaded
from optloc.files.reader import read

INPUTS = ("arrivals", "pseudoranges", "stations")


@dataclass(frozen=True, slots=True)
class Converted:
    """What was written, the problem that it is (None of stations alone), and what had to be assumed."""

    written: tuple[Path, ...]
    loaded: Loaded | None
    notes: tuple[str, ...] = ()


def convert(
    source: Path,
    out: Path,
    *,
    stations: Path | None = None,
    sigma: str | None = None,
    what: str | None = None,
    columns: Mapping[str, str] | None = None,
    unit: str | None = None,
    frame: str | None = None,
) -> Converted:
    """Write a table as a problem file.

    Parameters
    ----------
    source : Path
        Arrival times or pseudoranges as CSV or Parquet; or stations, as such a table or as GeoJSON.
    out : Path
        Problem file to write, .toml; its tables go to CSV files beside it. Of stations alone: the CSV file.
    stations : Path, optional
        Where the stations of arrival times are: CSV, Parquet or GeoJSON.
    sigma : str, optional
        Standard deviation of each row with its unit, such as "20 ns"; "estimate" finds it from many epochs.
    what : "arrivals", "pseudoranges" or "stations", optional
        What `source` holds; by default what its columns suggest.
    columns : mapping of str to str, optional
        Column of each role that is not found by its name: "message", "station", "time", "epoch", "satellite",
        "pseudorange", "name", "x", "y", "z", "lat", "lon", "height". "set+msg" puts two columns together.
    unit : str, optional
        Unit of the values; by default what the column's name ends in, else s of times and m of pseudoranges.
    frame : "cartesian" or "ecef", optional
        Frame of stations in x, y, z; cartesian by default.

    Returns
    -------
    Converted
        The files, and the problem as it is read back from them.

    Raises
    ------
    InvalidProblem
        Naming the file, the row and the column.
    """
    told = dict(columns or {})
    for role in told:
        if role not in GUESSES:
            raise InvalidProblem(f"there is no role {role!r}", "--column", nearest(role, GUESSES))
    if frame not in (None, "cartesian", "ecef"):
        raise InvalidProblem(f"there is no frame {frame!r}", "--frame", nearest(str(frame), ("cartesian", "ecef")))
    if what is not None and what not in INPUTS:
        raise InvalidProblem(f"there is no input {what!r}", "--as", nearest(what, INPUTS))
    if what == "stations" or source.suffix.lower() in GEOJSON:
        return _stations(source, out, told, frame)
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("the problem file must end in .toml", str(out), f"write --out {out.with_suffix('.toml')}")
    roles = Roles(read_table(source), told)
    seen = what or _seen(roles)
    if seen == "stations":
        return _stations(source, out, told, frame)
    if sigma is None:
        advice = "say it with --sigma '20 ns' (or metres); --sigma estimate finds it from many epochs"
        raise InvalidProblem("nothing is known of how accurate the rows are", "--sigma", advice)
    if seen == "arrivals":
        if stations is None:
            advice = "name a table or GeoJSON file with --stations"
            raise InvalidProblem("nothing is known of where the stations are", "--stations", advice)
        own = {role: name for role, name in told.items() if role in ("name", "x", "y", "z", "lat", "lon", "height")}
        place = places_of(stations, own, frame)
        found = arrivals(roles, place.names, stations.name, unit)
    else:
        found, place = pseudoranges(roles, unit)
    return _written(source, out, found, place, sigma)


def _seen(roles: Roles) -> str:
    """Return what a table holds by its columns; raise InvalidProblem where they do not tell."""
    if roles.find("pseudorange") is not None and roles.find("satellite") is not None:
        return "pseudoranges"
    if roles.find("station") is not None and roles.find("time") is not None:
        return "arrivals"
    what = f"the columns {', '.join(roles.table.columns)} do not tell what this is"
    advice = f"say it with --as {', --as '.join(INPUTS)}, and name columns with --column ROLE=NAME"
    raise InvalidProblem(what, roles.table.source, advice)


def _stations(source: Path, out: Path, told: Mapping[str, str], frame: str | None) -> Converted:
    if out.suffix.lower() != ".csv":
        what = "stations alone are no problem: they become a CSV table"
        raise InvalidProblem(what, str(out), f"write --out {out.with_suffix('.csv')}, or convert the measurements")
    found = places_of(source, told, frame)
    _csv(out, found.columns)
    return Converted((out,), None, (found.note,) if found.note else ())


def _written(source: Path, out: Path, found: Measured, place: Places, sigma: str) -> Converted:
    tables = {out.with_name(f"{out.stem}-stations.csv"): place.columns}
    tables[out.with_name(f"{out.stem}-rows.csv")] = found.columns
    for path, columns in tables.items():
        _csv(path, columns)
    one, two = (json.dumps(path.name) for path in tables)
    text = f"""# Made from {source.name} by optloc convert.
format = 1
title = {json.dumps(source.stem)}

[frame]
kind = "{place.frame}"

[stations]
file = {one}
unit = "{place.unit}"

[[measurements]]
kind = "toa"                         # {found.comment}
file = {two}
unit = "{found.unit}"
sigma = {json.dumps(sigma)}
"""
    _written_text(out, text)
    notes = (*found.notes, *((place.note,) if place.note else ()))
    return Converted((out, *tables), read(out), notes)


def _csv(path: Path, columns: Mapping[str, Any]) -> None:
    import pyarrow as pa
    from pyarrow import csv

    table = pa.table({name: pa.array(list(np.asarray(values).tolist())) for name, values in columns.items()})
    try:
        csv.write_csv(table, path, csv.WriteOptions(quoting_style="needed"))
    except OSError as error:
        raise _refused(path, error) from None


def _written_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise _refused(path, error) from None


def _refused(path: Path, error: OSError) -> InvalidProblem:
    return InvalidProblem(f"the file cannot be written ({error.strerror or error})", str(path), "choose another place")

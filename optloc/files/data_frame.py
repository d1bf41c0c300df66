"""Problems from data frames: the long table that an analysis already has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Stations
from optloc.files.reader import assemble
from optloc.files.schema import validate
from optloc.files.table import Table, of_frame
from optloc.problem.problem import Problem


def from_table(
    table: Any,
    stations: Any,
    *,
    kind: str | None = None,
    unit: str | Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    sigma: float | str | None = None,
    motion: str | None = None,
    frame: str | Mapping[str, Any] = "cartesian",
    window: str | None = None,
    propagation_speed: float | None = None,
    station_options: Mapping[str, Any] | None = None,
    constraints: Sequence[Mapping[str, Any]] = (),
    values: bool = True,
    **options: Any,
) -> Problem:
    """Return the problem of a long table with one row for each measurement.

    Parameters
    ----------
    table : pandas.DataFrame, or mapping of str to array (m,)
        Columns ``kind, a, b, z`` and, where wanted, ``epoch`` or ``time``, ``sigma``, ``target``, ``weight``,
        ``correction``.
    stations : pandas.DataFrame, mapping of str to array (s,), mapping of name to coordinates (d,), or Stations
        A table with the columns ``name, x, y, z`` or ``name, lat_deg, lon_deg, height``; or positions by name.
    kind : str, optional
        Kind of all rows, where there is no column ``kind``.
    unit : str or mapping of kind to str, optional
        Unit of ``z``; SI by default.
    columns : mapping of str to str, optional
        What the table calls its columns: ``{"z": "tdoa_ns"}``.
    sigma : float or str, optional
        Standard deviation of every row, in `unit` or as text with its own: ``"30 ns"``.
    motion : "static", "free", "constant_velocity" or "constant_acceleration", optional
        How the target moves; static with one epoch, free with several by default.
    frame : str or mapping
        ``"cartesian"``, ``"ecef"``, ``"geodetic"``, or the table ``[frame]`` of a problem file.
    window : str, optional
        Length of an epoch, such as ``"0.1 s"``.
    propagation_speed : float, optional
        Metres per second; light in vacuum by default.
    station_options : mapping, optional
        Further keys of the table ``[stations]`` of a problem file, for instance ``{"unit": "km"}``.
    constraints : sequence of mapping
        Tables ``[[constraints]]`` of a problem file, for instance ``{"kind": "height", "exactly": "500 m"}``.
    values : bool
        Whether measured values are needed; False to simulate them.
    **options
        Further keys of a table ``[[measurements]]``: ``arrival_sigma``, ``azimuth``, ``positive`` and so on.

    Returns
    -------
    Problem
        In SI units.

    Raises
    ------
    InvalidProblem
        Naming the row and column.
    """
    names = dict(columns or {})
    place: dict[str, Any] = {"kind": frame} if isinstance(frame, str) else dict(frame)
    station_table = _station_table(stations, (station_options or {}).get("columns", {}))
    measured = {"kind": kind, "unit": dict(unit) if isinstance(unit, Mapping) else unit, "sigma": sigma, **options}
    # The arguments as a problem file: one reader serves both, and complaints name "arguments".
    settings = {
        "format": 1,
        "propagation_speed": propagation_speed,
        "frame": place,
        "stations": dict(station_options or {}),
        "measurements": [{key: value for key, value in measured.items() if value is not None}],
        "epochs": {"window": window},
        "target": {"motion": motion},
        "constraints": [dict(constraint) for constraint in constraints],
    }
    file = validate(settings, "arguments")
    return assemble(file, station_table, [of_frame(table, "table", names)], "arguments", values=values).loaded.problem


def _station_table(stations: Any, names: Mapping[str, str]) -> Table:
    if isinstance(stations, Stations):
        if stations.position.shape[:-2] != (1,):
            raise InvalidProblem("these stations move or are a batch", "stations", "give a table with a column 'time'")
        stations = dict(zip(stations.names, stations.position[0], strict=True))
    # A mapping of names to coordinates, unless it has a column of names.
    if isinstance(stations, Mapping) and "name" not in stations and names.get("name") not in stations:
        try:
            position = np.array([np.asarray(value, dtype=float) for value in stations.values()])
        except ValueError:
            position = np.zeros(0)
        if position.ndim != 2 or position.shape[1] not in {2, 3}:
            raise InvalidProblem(
                "the stations are no positions of 2 or 3 coordinates", "stations", "give name: (x, y, z)"
            )
        stations = {"name": np.array(list(stations), dtype=object)} | dict(zip("xyz", position.T, strict=False))
    return of_frame(stations, "stations", names)

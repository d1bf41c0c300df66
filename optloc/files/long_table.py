"""Problems from data frames and mappings in long form, with one row for each measurement."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from optloc.base.moved import renamed
from optloc.base.types import Stations
from optloc.files.constraint_reader import StatedConstraints, stated_arguments
from optloc.files.reader import assemble
from optloc.files.schema import validate
from optloc.files.stations import station_table
from optloc.files.table import of_frame
from optloc.files.wave_speed import with_profile
from optloc.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd


def from_table(
    table: pd.DataFrame | Mapping[str, ArrayLike],
    stations: pd.DataFrame | Mapping[str, ArrayLike] | Stations,
    *,
    kind: str | None = None,
    unit: str | Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    sigma: float | str | None = None,
    motion: str | None = None,
    frame: str | Mapping[str, object] = "cartesian",
    window: str | None = None,
    wave_speed: float | str | None = None,
    station_options: Mapping[str, object] | None = None,
    constraints: StatedConstraints = (),
    values: bool = True,
    propagation_speed: float | str | None = None,
    **options: object,
) -> Problem:
    """Return the problem of a long table with one row for each measurement.

    Parameters
    ----------
    table : pandas.DataFrame, or mapping of str to array (m,)
        Columns ``kind, a, b, z`` and optionally ``epoch`` or ``time``, ``sigma``, ``target``, ``weight``,
        ``correction``.
    stations : pandas.DataFrame, mapping of str to array (s,), mapping of name to coordinates (d,), or Stations
        A table with the columns ``name, x, y, z`` or ``name, lat_deg, lon_deg, height``; or positions by name.
    kind : str, optional
        Kind of all rows, if there is no column ``kind``.
    unit : str or mapping of kind to str, optional
        Unit of ``z``; by default SI.
    columns : mapping of str to str, optional
        Names of the columns in the table: ``{"z": "tdoa_ns"}``.
    sigma : float or str, optional
        Standard deviation of each row, in `unit` or as text with a unit: ``"30 ns"``.
    motion : "static", "free", "free_velocity", "constant_velocity" or "constant_acceleration", optional
        Motion of the target; by default static for one epoch, free for several.
    frame : str or mapping
        ``"cartesian"``, ``"ecef"``, ``"geodetic"``, or the table ``[frame]`` of a problem file.
    window : str, optional
        Length of an epoch, such as ``"0.1 s"``.
    wave_speed : float or str, optional
        Metres per second, or text such as ``"air:20C"`` (as in `optloc.locate`); by default light in vacuum.
    station_options : mapping, optional
        Further keys of the table ``[stations]`` of a problem file, for instance ``{"unit": "km"}``.
    constraints : sequence of mapping or of constraints
        Tables ``[[constraints]]`` of a problem file, for instance ``{"kind": "height", "exactly": "500 m"}``; or
        constraints of `optloc.constraints`.
    values : bool
        Whether measured values are required; False to simulate them.
    propagation_speed : float or str, optional
        Old name of `wave_speed`.
    **options
        Further keys of a table ``[[measurements]]``: ``arrival_sigma``, ``azimuth``, ``positive`` and others.

    Returns
    -------
    Problem
        In SI units.

    Raises
    ------
    InvalidProblem
        The message names the row and column.
    """
    names = dict(columns or {})
    settings_of_stations: Any = station_options or {}
    place: dict[str, Any] = {"kind": frame} if isinstance(frame, str) else dict(frame)
    places = station_table(stations, "stations", names=settings_of_stations.get("columns"))
    measured = {"kind": kind, "unit": dict(unit) if isinstance(unit, Mapping) else unit, "sigma": sigma, **options}
    # Arguments are read like a problem file with the name "arguments", so both use one reader.
    settings = {
        "format": 1,  # keeps the convention of azimuths of this function
        "propagation_speed": renamed("propagation_speed", propagation_speed, "wave_speed", wave_speed),
        "frame": place,
        "stations": dict(settings_of_stations),
        "measurements": [{key: value for key, value in measured.items() if value is not None}],
        "epochs": {"window": window},
        "target": {"motion": motion},
    }
    file, limits = with_profile(validate(settings, "arguments"), None, "arguments"), stated_arguments(constraints)
    rows = [of_frame(table, "table", names)]
    return assemble(file, places, rows, "arguments", values=values, limits=limits).plausible("file").problem

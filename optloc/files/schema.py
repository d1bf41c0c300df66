"""What a problem file may say, as tables from which its JSON schema is derived."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from optloc.models import MODELS
from optloc.units import AzimuthConvention

Amount = float | str
"""A number in the unit of its table, or text such as "30 ns"."""

Bound = Annotated[float, Field(allow_inf_nan=True)]
"""One coordinate of a box; infinite where there is no bound."""

Cell = str | int | float

Row = dict[str, Cell]


class _Table(BaseModel):
    """A table of the file; keys that it does not know are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class Origin(_Table):
    """A point on Earth, WGS 84."""

    lat_deg: float
    """Latitude, degrees."""
    lon_deg: float
    """Longitude, degrees."""
    height: float = 0.0
    """Height above the ellipsoid, metres."""


class FrameTable(_Table):
    """The frame in which positions are computed and answered."""

    kind: Literal["cartesian", "ecef", "enu", "geodetic"] = "cartesian"
    """Axes anywhere; Earth-centred Earth-fixed; east, north, up; or latitude, longitude, height (computed in ECEF)."""
    origin: Origin | None = None
    """Origin of an ENU frame; by default the mean of stations that are given by latitude and longitude."""
    dimension: Literal[2, 3] | None = None
    """Dimension of the positions; by default 3 where there is a z or a height."""


class DataTable(_Table):
    """Where rows come from: a file, or the table itself."""

    file: str | None = None
    """CSV or Parquet file, relative to the problem file."""
    rows: list[Row] | None = None
    """The rows themselves, one inline table each."""
    columns: dict[str, str] = Field(default_factory=dict)
    """What the file calls its columns: `{ a = "rx1", z = "tdoa_ns" }`."""
    separator: str = Field(default=",", min_length=1, max_length=1)
    """What separates the fields of a CSV file."""


class StationsTable(DataTable):
    """The stations. Columns: name; x, y, z or lat_deg, lon_deg, height; optional ones are listed in the manual."""

    unit: str = "m"
    """Unit of x, y, z, height and sigma."""
    speed_unit: str = "m/s"
    """Unit of vx, vy, vz."""
    time_unit: str = "s"
    """Unit of the time column of moving stations."""
    axes: Literal["frame", "enu"] | None = None
    """Axes that angles refer to: the frame's, or east, north, up at each station (default on Earth)."""
    sigma: Amount | None = None
    """Standard deviation of each coordinate of the positions; None: surveyed exactly."""
    span: Literal["epoch", "run", "noise"] = "epoch"
    """Whether a position error is an unknown of each epoch, one of the whole run, or noise drawn anew at each epoch."""


class MeasurementsTable(DataTable):
    """Measurements of one kind. Columns: a, b, z; optional ones are listed in the manual."""

    kind: str | None = Field(default=None, json_schema_extra=lambda schema: schema.update(enum=[*sorted(MODELS), None]))
    """Measurement kind; None where the rows have a column `kind`."""
    unit: str | dict[str, str] | None = None
    """Unit of z, or one unit for each kind; SI by default."""
    a: str | None = None
    """First station of all rows, where there is no column a."""
    b: str | None = None
    """Second station of all rows, where there is no column b."""
    azimuth: AzimuthConvention = "east-counterclockwise"
    """Where azimuth zero is and which way it grows."""
    positive: Literal["a-farther", "b-farther"] = "a-farther"
    """Sign of differences (and sense of ratios): a against b, or b against a."""
    excess: bool = False
    """Whether a range_sum is given less the distance between its two stations."""
    carrier_hz: float | None = Field(default=None, gt=0.0)
    """Carrier frequency; needed by the unit Hz."""
    sigma: Amount | None = None
    """Standard deviation of each row; "estimate": one for each kind, found from the data."""
    arrival_sigma: Amount | dict[str, Amount] | None = None
    """Standard deviation of the arrival at each station; rows of an epoch that share a station are then correlated."""
    covariance: list[list[float]] | None = None
    """Covariance of the rows of one epoch in their order, unit squared."""
    correction: Amount | None = None
    """Known amount by which every row exceeds the model."""
    weight: float | None = Field(default=None, ge=0.0, le=1.0)
    """Weight of all rows: 1 as measured, 0 absent."""
    time_unit: str = "s"
    """Unit of the column time."""


class TargetTable(DataTable):
    """How targets move; the rows of a known one. Columns: x, y, z or lat_deg, lon_deg, height; time or epoch."""

    motion: Literal["static", "free", "constant_velocity", "constant_acceleration", "known"] | None = None
    """Default: known with rows or a file, else static with one epoch, else a free position at every epoch."""
    reference: float | None = None
    """Time at which the state of a moving target is answered, seconds; the first epoch by default."""
    unit: str = "m"
    """Unit of x, y, z and height of a known target."""
    speed_unit: str = "m/s"
    """Unit of vx, vy, vz."""
    time_unit: str = "s"
    """Unit of the time column."""

    @property
    def moves(self) -> str | None:
        """Return the motion that is stated, if only by giving the places."""
        given = self.file is not None or self.rows is not None
        return self.motion or ("known" if given else None)


class ConstraintTable(_Table):
    """What the answer must meet."""

    kind: Literal["box", "height", "above-ground", "polygon", "visible", "speed"]
    """What is bounded; each kind has its own keys."""
    target: str | None = None
    """Name of the target; all by default."""
    exactly: Amount | None = None
    """Known height above the WGS 84 ellipsoid."""
    min: Amount | list[Bound] | None = None
    """Least height or speed; least coordinates of a box in the frame, -inf for none."""
    max: Amount | list[Bound] | None = None
    """Greatest height or speed; greatest coordinates of a box, inf for none."""
    unit: str | None = None
    """Unit of bare numbers; metres or metres per second by default."""
    corners: list[list[float]] | None = None
    """Corners [x, y] of a polygon in the plan, in order around it."""
    corners_deg: list[list[float]] | None = None
    """The same as [latitude, longitude] in degrees, at the height of the origin of an ENU frame."""
    stations: str | list[str] | None = None
    """Stations, for instance satellites, that stand above the target's horizon: "all" (default), or names."""
    elevation: Amount | None = None
    """Least elevation of these stations, degrees; 0 by default."""


class BiasTable(_Table):
    """A family of unknown systematic errors."""

    name: str = Field(min_length=1)
    """Its name."""
    form: Literal["offset", "scale", "drift", "rotation"] = "offset"
    """Added; times the measured quantity; times the seconds of the run; or a turn of the station's axes."""
    per: Literal["station", "pair", "kind"] = "station"
    """Who has one of his own: each station (with the sign of its arrival), each pair of stations, or the kind."""
    kind: str | None = None
    """Kind of the rows that are touched; needed where the file has several."""
    members: list[str] | dict[str, list[str]] | None = None
    """Stations that have one; all that measure by default. Leave out the reference of a difference. Or groups of
    stations that share one: `{ GPS = ["G01", "G07"] }`. Of pairs: names such as "A-B"."""
    mean: Amount | None = None
    """Prior mean."""
    sigma: Amount | None = None
    """Prior standard deviation with its unit, such as "200 m"; without it the bias is unknown."""


class PriorTable(_Table):
    """Prior knowledge of an unknown."""

    name: str
    """Unknown: position, velocity, acceleration, with `[0]` and so on behind it where there are several targets."""
    mean: list[float]
    """Its mean, in the frame's coordinates."""
    sigma: list[float] | Amount
    """Standard deviation of each coordinate."""
    unit: str | None = None
    """Unit of both; metres, metres per second, metres per second squared by default."""


class WindowTable(_Table):
    """How rows are put together to epochs by their times."""

    window: str | None = None
    """Length of an epoch, such as "0.1 s"; by default rows of exactly equal time belong together."""


class ProblemFile(_Table):
    """A problem file, format 1."""

    format: Literal[1]
    """Version of the format."""
    title: str | None = None
    """What it is."""
    propagation_speed: float | None = Field(default=None, gt=0.0)
    """Metres per second; light in vacuum by default."""
    frame: FrameTable = FrameTable()
    stations: StationsTable
    measurements: list[MeasurementsTable] = Field(min_length=1)
    epochs: WindowTable = WindowTable()
    target: TargetTable = TargetTable()
    targets: dict[str, TargetTable] = Field(default_factory=dict)
    """Motions of single targets by name."""
    biases: list[BiasTable] = Field(default_factory=list)
    priors: list[PriorTable] = Field(default_factory=list)
    constraints: list[ConstraintTable] = Field(default_factory=list)
    covariance: list[list[float]] | None = None
    """Covariance of the rows of one epoch across all kinds, in the order of the file, in their units."""


def schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a problem file."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **ProblemFile.model_json_schema()}

"""Schema of problem files: tables and keys, from which the JSON schema is derived.

The docstring of a key is its description in the JSON schema and in the manual.
"""

from __future__ import annotations

from collections import Counter
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, Field, ValidationError, field_validator

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.inputs import STANDARD_INPUT, read_text, toml_of
from optloc.base.time_scales import TimeScale
from optloc.base.types import (
    Amount,  # of a table: bare numbers are in its unit
    FormName,
)
from optloc.base.units import (
    AzimuthConvention,
)
from optloc.files.constraint_table import ConstraintTable
from optloc.files.settings import FileTable, join
from optloc.models import MODELS, Model, kind_named

# Names and amounts such as "30 ns".


def kind_model(kind: str, where: str) -> Model:
    """Return the model of a kind, by its name or an alias; raise InvalidProblem for an unknown kind."""
    return MODELS[kind_named(kind, where)]


Cell = str | int | float
Row = dict[str, Cell]
_Model = TypeVar("_Model", bound=BaseModel)
# Sentences for errors of pydantic; other errors are quoted.
_WHAT = {
    "missing": "the key {key!r} is missing",
    "extra_forbidden": "unknown key {key!r}",
    "finite_number": "{key} is {value}, not a finite number",
}


class Origin(FileTable):
    """A point on Earth, WGS 84."""

    lat_deg: float
    """Latitude, degrees."""
    lon_deg: float
    """Longitude, degrees."""
    height: float = 0.0
    """Height above the ellipsoid, metres."""


class FrameTable(FileTable):
    """The frame of computations and results."""

    kind: Literal["cartesian", "ecef", "enu", "geodetic"] = "cartesian"
    """Local axes; Earth-centred Earth-fixed; east, north, up; or latitude, longitude, height (computed in ECEF)."""
    origin: Origin | None = None
    """Origin of an ENU frame; by default the mean of stations with latitude and longitude."""
    dimension: Literal[2, 3] | None = None
    """Dimension of the positions; by default 3 if there is a z or a height."""


class DataTable(FileTable):
    """Source of rows: a file, or rows in the table."""

    file: str | None = None
    """CSV or Parquet file, relative to the problem file."""
    rows: list[Row] | None = None
    """Rows as inline tables."""
    columns: dict[str, str] = Field(default_factory=dict)
    """Names of the columns in the file: `{ a = "rx1", z = "tdoa_ns" }`."""
    separator: Literal[",", ";", "\t", "|", ":", " "] = ","
    """Separator of the fields of a CSV file."""


class StationsTable(DataTable):
    """The stations. Columns: name; x, y, z or lat_deg, lon_deg, height; the manual lists optional columns."""

    unit: str = "m"
    """Unit of x, y, z, height and sigma."""
    speed_unit: str = "m/s"
    """Unit of vx, vy, vz and velocity_sigma."""
    time_unit: str = "s"
    """Unit of the time column of moving stations."""
    axes: Literal["frame", "enu"] | None = None
    """Axes that angles refer to: the axes of the frame, or east, north, up at each station (default on Earth)."""
    sigma: Amount | None = None
    """Standard deviation of each coordinate of the positions; None: exact positions."""
    velocity_sigma: Amount | None = None
    """Standard deviation of each coordinate of the velocities; None: exact velocities."""
    span: Literal["epoch", "run", "noise"] = "epoch"
    """Span of an error of position or velocity: an unknown of each epoch, an unknown of the whole run, or independent
    noise at each epoch."""


class DeclinationTable(FileTable):
    """The magnetic declination of the World Magnetic Model at each station."""

    date: str
    """Day in ISO 8601, such as "2026-06-01"."""

    @field_validator("date", mode="before")
    @classmethod
    def _written(cls, value: Any) -> Any:
        """Return a TOML date as text."""
        return value.isoformat() if isinstance(value, date) else value


def _kind_words() -> list[str]:
    """Return all names of measurement kinds: standard names, then alternative names."""
    return [*sorted(MODELS), *sorted(alias for model in MODELS.values() for alias in model.aliases)]


class MeasurementsTable(DataTable):
    """Measurements of one kind. Columns: a, b, z; the manual lists optional columns."""

    kind: str | None = Field(default=None, json_schema_extra=lambda schema: schema.update(enum=[*_kind_words(), None]))
    """Measurement kind; None if the rows have a column `kind`."""
    unit: str | dict[str, str] | None = None
    """Unit of z, or one unit for each kind; by default SI."""
    a: str | None = None
    """First station of all rows, if there is no column a."""
    b: str | None = None
    """Second station of all rows, if there is no column b."""
    azimuth: AzimuthConvention | None = None
    """Zero direction and sense of azimuths. Default: a compass (north-clockwise) for the kind `bearing`, and in format
    2 for all frames on Earth; else east-counterclockwise."""
    declination: Amount | DeclinationTable | None = None
    """Magnetic declination, east positive, of bearings from magnetic north: a number in the unit of z or an amount such
    as "4 deg"; or a date such as "2026-06-01", for which the World Magnetic Model gives the value at each station."""
    positive: Literal["a-farther", "b-farther"] = "a-farther"
    """Sign of differences (and sense of ratios): a minus b, or b minus a."""
    excess: bool = False
    """Whether the distance between the two stations is subtracted from a range_sum."""
    two_way: bool = False
    """Whether ranges are times of the way there and back."""
    turn_around: Amount | None = None
    """Time from arrival to reply at the other end of two-way ranges: "2 ms"."""
    after: Literal["time", "date"] | None = None
    """For arrivals (toa): z is seconds after the column `time`; or after a date, the seconds since 1970 (UTC) in it."""
    vp_vs: Annotated[float, Field(gt=1.0)] | Literal["layers"] | None = None
    """For arrivals (toa) with a column `phase`, P or S: speed of P waves, the propagation speed, divided by the speed
    of S waves; or "layers" for layers with `s_speeds`. Rows of one epoch have one origin time."""
    carrier_hz: float | None = Field(default=None, gt=0.0)
    """Carrier frequency; needed by the unit Hz."""
    sigma: Amount | None = None
    """Standard deviation of each row; "estimate": one value for each kind, estimated from the data."""
    arrival_sigma: Amount | dict[str, Amount] | None = None
    """Standard deviation of the arrival at each station; rows of an epoch that share a station are then correlated."""
    covariance: list[list[float]] | None = None
    """Covariance of the rows of one epoch in their order, unit squared."""
    snr: Amount | dict[str, Amount] | None = None
    """Signal-to-noise ratio of power within the band, one value or one for each station, "10 dB" or a ratio. With
    `bandwidth` and `duration`, it determines the noise of time differences and gain ratios."""
    bandwidth: Amount | None = None
    """Bandwidth from zero frequency, hertz; for a signal around a carrier, give half its bandwidth and twice the
    duration."""
    duration: Amount | None = None
    """Integration time of one measurement, seconds."""
    correction: Amount | None = None
    """Known offset of all rows from the model; for azimuths, a clockwise angle."""
    weight: float | None = Field(default=None, ge=0.0, le=1.0)
    """Weight of all rows: 1 as measured, 0 absent."""
    time_unit: str = "s"
    """Unit of the column time."""


class TargetTable(DataTable):
    """Motion of targets, and the rows of a known target.

    Columns: x, y, z or lat_deg, lon_deg, height; time or epoch.
    """

    motion: Literal["static", "free", "free_velocity", "constant_velocity", "constant_acceleration", "known"] | None = (
        None
    )
    """Default: known with rows or a file, else static for one epoch, else a free position at each epoch, without
    velocity; free_velocity also has a free velocity at each epoch."""
    reference: float | None = None
    """Time of the estimated state of a moving target, seconds; by default the first epoch."""
    unit: str = "m"
    """Unit of x, y, z and height of a known target."""
    speed_unit: str = "m/s"
    """Unit of vx, vy, vz."""
    time_unit: str = "s"
    """Unit of the time column."""

    @property
    def moves(self) -> str | None:
        """Return the stated motion; positions without a motion mean "known"."""
        given = self.file is not None or self.rows is not None
        return self.motion or ("known" if given else None)


# Maximum number of depths in a table of speeds: each ray traces all of them, and a profile of the sea has a few dozen.
_LAYERS = 1000
# Maximum number of biases, priors and constraints, which a person writes: each step of each fix evaluates all of them.
_MANY = 100


class BiasTable(FileTable):
    """A family of unknown systematic errors."""

    name: str = Field(min_length=1)
    """Name of the bias."""
    form: FormName = "offset"
    """Form of the error: an offset; a scale of the measured quantity; a drift in time; a rotation of the axes of the
    station; a delay of the station along its course, seconds; or an offset that changes with time: a random walk, such
    as of a clock, or a smooth function of time."""
    per: Literal["station", "pair", "kind", "target"] = "station"
    """Members with separate errors: each station (with the sign of its arrival), pair of stations, or target; or one
    error for the kind."""
    kind: str | None = None
    """Kind of the affected rows; required if the file has several quantities, but not for a time."""
    members: list[str] | dict[str, list[str]] | None = None
    """Stations with an error; by default all that measure. Leave out the reference of a difference. Or groups of
    stations that share an error: `{ GPS = ["G01", "G07"] }`. For pairs: names such as "A-B"; for targets: names of
    targets."""
    mean: Amount | None = None
    """Prior mean."""
    sigma: Amount | None = None
    """Prior standard deviation with its unit, such as "200 m"; without it the bias is unknown. For a walk, the prior
    applies to the value at the first epoch."""
    density: str | None = None
    """For a walk: spectral density of the white noise that it sums, such as "0.04 m^2/s" or "4 ns^2/s"."""
    rate_density: str | None = None
    """For a walk with a walking rate: spectral density of the rate, such as "1e-6 m^2/s^3"."""
    allan: list[list[float]] | None = Field(default=None, max_length=_MANY)
    """For a walk of times or lengths, instead of densities: pairs of averaging time in seconds and Allan deviation of
    the clock, such as [[1.0, 1e-9], [100.0, 2e-10]]."""
    knots: int | list[float] | None = None
    """For a spline: the times in seconds between which it is a cubic polynomial, or the number of evenly spaced
    times."""


class PriorTable(FileTable):
    """Prior knowledge of an unknown."""

    name: str
    """Unknown: position, velocity, acceleration; for several targets with an index, such as `position[0]`."""
    mean: list[float]
    """Mean, in the coordinates of the frame."""
    sigma: list[float] | Amount
    """Standard deviation of each coordinate."""
    unit: str | None = None
    """Unit of mean and sigma; by default metres, metres per second, metres per second squared."""


class SoundTable(FileTable):
    """The medium of sound waves."""

    medium: Literal["air", "fresh water", "sea water"]
    """Kind of the medium."""
    celsius: float
    """Temperature, degrees Celsius."""
    salinity: float | None = None
    """Grams of salt in a kilogram of water; by default 0 in fresh water and 35 in sea water."""
    depth: float = 0.0
    """Metres below the surface."""


class SpeedTable(FileTable):
    """A speed with a standard deviation."""

    value: Amount
    """The stated speed: metres per second, or text with a unit."""
    sigma: Amount
    """Standard deviation of the speed: metres per second, or text with a unit."""


class MediumTable(FileTable):
    """A medium without a single speed; rows are then measured along rays."""

    kind: Literal["layers", "atmosphere"]
    """Speeds over depth below a level surface; or air for radio waves."""
    depths: list[float] | None = Field(default=None, max_length=_LAYERS)
    """For layers: increasing depths; of points between which the speed is linear, or of the tops of layers."""
    speeds: list[float] | None = Field(default=None, max_length=_LAYERS)
    """For layers: the speed at each depth; with `s_speeds`, of P waves."""
    s_speeds: list[float] | None = Field(default=None, max_length=_LAYERS)
    """For layers: the speed of S waves at each depth."""
    between: Literal["linear", "constant"] = "linear"
    """For layers: speed between the depths, linear or constant."""
    surface: Amount = 0.0
    """For layers: third coordinate of depth zero."""
    unit: str = "m"
    """Unit of depths and surface."""
    speed_unit: str = "m/s"
    """Unit of speeds."""
    refractivity: float | None = None
    """For an atmosphere: refractivity (n - 1) 1e6 at height zero; by default 315."""
    scale_height: float | None = None
    """For an atmosphere: height in metres over which the refractivity decreases to 1 / e; by default 7350."""


class WindowTable(FileTable):
    """Times of the rows, and their assignment to epochs."""

    window: str | None = None
    """Length of an epoch, such as "0.1 s"; by default, rows of exactly equal time form an epoch."""
    time_scale: TimeScale | None = None
    """Scale of numbers in columns of times: "unix" or "utc" (since 1970, UTC), "gps" (since 6 January 1980) or "tai"
    (since 1970). Results then have dates in UTC. By default "none": seconds that are no dates."""


class ProblemFile(FileTable):
    """A problem file."""

    format: Literal[1, 2]
    """Version of the format: in 2, azimuths on Earth are compass bearings by default."""
    title: str | None = None
    """Title of the problem."""
    propagation_speed: Annotated[float, Field(gt=0.0)] | str | SoundTable | SpeedTable | None = None
    """Metres per second; "343 m/s", "343+-5 m/s", "air:20C,50%", "water:8C,35,50m" or the file of a profile; or
    { medium = "air", celsius = 20.0 }; or { value = 343.0, sigma = 5.0 }, estimated with the target. By default light.
    With layers: the speed that converted times to ranges in metres."""
    wind: str | list[float] | None = None
    """Velocity of the medium: "5 m/s from 270" (degrees from north), or components towards the axes, m/s."""
    medium: MediumTable | None = None
    """Layers or air, if the speed is not one number."""
    frame: FrameTable = FrameTable()
    stations: StationsTable
    measurements: list[MeasurementsTable] = Field(min_length=1)
    epochs: WindowTable = WindowTable()
    target: TargetTable = TargetTable()
    targets: dict[str, TargetTable] = Field(default_factory=dict)
    """Motions of single targets by name."""
    biases: list[BiasTable] = Field(default_factory=list, max_length=_MANY)
    priors: list[PriorTable] = Field(default_factory=list, max_length=_MANY)
    constraints: list[ConstraintTable] = Field(default_factory=list, max_length=_MANY)
    covariance: list[list[float]] | None = None
    """Covariance of the rows of one epoch across all kinds, in the order of the file, in their units."""


def schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a problem file."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **ProblemFile.model_json_schema()}


# Read a TOML file and validate it against the schema; each error is one sentence with its place.


def read_document(path: Path) -> ProblemFile:
    """Return the contents of a problem file, or of standard input; raise InvalidProblem for an invalid file."""
    return document_of(read_text(path), name_of(path))


def document_of(text: str, source: str) -> ProblemFile:
    """Return the contents of the text of a problem file; `source` is the place for messages."""
    data = parse_toml(text, source, formats=(1, 2))
    # only files of networks have these two keys: `optloc.sites.calibration.network_file`
    if isinstance(stations := data.get("stations"), dict) and {"dimension", "synchronised"} & set(stations):
        raise InvalidProblem("the station positions of this file are unknown", source, "use optloc calibrate")
    return validate(data, source)


def name_of(path: Path) -> str:
    """Return the name of a document for messages."""
    return "standard input" if path == STANDARD_INPUT else path.name


def parse_toml(text: str, source: str, formats: tuple[int, ...] = (1,)) -> dict[str, Any]:
    """Return TOML text as data, if its format is permitted; `source` is the place for messages."""
    if not text.strip():
        raise InvalidProblem("the file is empty", source, f"begin it with the line format = {max(formats)}")
    data = toml_of(text, source)
    # true equals 1 in Python
    if data.get("format") not in formats or isinstance(data.get("format"), bool):
        given = f"format {data['format']!r} is unknown" if "format" in data else "the key 'format' is missing"
        raise InvalidProblem(given, source, f"begin the file with the line format = {max(formats)}")
    return data


def validate(data: dict[str, Any], source: str) -> ProblemFile:
    """Return data as a problem file; `source` is the place for messages."""
    return validated(ProblemFile, data, source)


def validated(model: type[_Model], data: dict[str, Any], source: str) -> _Model:
    """Return data as a table of a schema; raise InvalidProblem with the first error.

    Parameters
    ----------
    model : type of pydantic model
        The schema.
    data : dict
        The data to check.
    source : str
        Place for messages.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _sentence(error, source, data, model) from None


def _sentence(error: ValidationError, source: str, data: dict[str, Any], model: type[BaseModel]) -> InvalidProblem:
    """Return the error of a file as one sentence with its place, from the errors that pydantic found.

    `source` is the place of the data, `data` the content of the file, and `model` its schema.
    """
    # Each alternative of a union reports errors. Use the table with the fewest errors, and its deepest error.
    found = error.errors()
    counts = Counter(e["loc"][:2] for e in found if _is_alternative(e["loc"]))
    first = max(
        found,
        key=lambda e: (
            -counts[e["loc"][:2]] if _is_alternative(e["loc"]) else -len(found),
            e["type"] in {"extra_forbidden", "finite_number"},
            len(_path(e["loc"], data)[0]),
        ),
    )
    path, key = _path(first["loc"], data)  # path of the table, and the key in it
    template = _WHAT.get(first["type"])
    if template is not None:
        what = template.format(key=key, value=first["input"])
    else:
        what = f"{key} = {first['input']!r} does not fit: {first['msg'][0].lower()}{first['msg'][1:]}"
    advice = None
    if first["type"] in {"extra_forbidden", "missing"}:
        known = _keys(path, model, first["loc"])
        advice = nearest(key, known) if first["type"] == "extra_forbidden" else "add the key"
    if first["type"] == "literal_error":
        known = [part.strip().strip("'") for part in str(first["ctx"]["expected"]).replace(" or ", ", ").split(",")]
        what, advice = f"{key} = {first['input']!r} is unknown", nearest(str(first["input"]), known)
    return InvalidProblem(what, join(source, *_spell(path)), advice)


def _is_alternative(loc: tuple[int | str, ...]) -> bool:
    """Return whether an error is about a key of one of several tables that a place allows."""
    return len(loc) > _IN_TABLE and str(loc[1]).endswith("Table")


# Number of names before the key in the place of this error: the key of the file, and the table.
_IN_TABLE = 2


def _path(loc: tuple[int | str, ...], data: Any) -> tuple[list[int | str], str]:
    """Return the path of the table and the key of an error, without the names of union members.

    `loc` is the place that pydantic reports, and `data` the content of the file.
    """
    path: list[int | str] = []
    at: Any = data
    # pydantic inserts the names of union members between keys: skip parts that are not in the data.
    for part in loc:
        if (isinstance(at, dict) and part in at) or (isinstance(at, list) and part in range(len(at))):
            at = at[part]  # type: ignore[index]  # just checked
        elif part != loc[-1] or not isinstance(at, dict):
            continue
        path.append(part)
    *table, key = path or ["file"]
    # An error in a list entry has the key of the list.
    while table and isinstance(key, int):
        key = table.pop()
    return table, str(key)


def _spell(path: list[int | str]) -> list[str]:
    """Return a path in the notation of a file: ``[[measurements]] 2``."""
    names: list[str] = []
    for part in path:
        if isinstance(part, int):
            names[-1] = f"{names[-1].replace('[', '[[').replace(']', ']]')} {part + 1}"
        else:
            names.append(f"[{part}]")
    return names


def _keys(path: list[int | str], model: Any, loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the table at a path of a schema; if the place allows several tables, `loc` names the table."""
    for part in path:
        if isinstance(part, str) and part in getattr(model, "model_fields", {}):
            found = _models_in(model.model_fields[part].annotation)
            model = next((table for table in found if table.__name__ in loc), found[0] if found else None)
    return sorted(model.model_fields)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the tables that an annotation allows."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in getattr(annotation, "__args__", ()) for model in _models_in(inner)]

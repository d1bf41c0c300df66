"""What a problem file may say, as tables from which its JSON schema is derived."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.inputs import STANDARD_INPUT, read_text, toml_of
from optloc.base.types import (
    Amount,  # of a table: bare numbers are in its unit
    FormName,
)
from optloc.base.units import (
    SI_UNIT,
    SPEED_OF_LIGHT,
    AzimuthConvention,
    Conversion,
    Quantity,
    conversion,
    example_of,
    split_amount,
)
from optloc.models import MODELS, Model, kind_named

# Words that a file may get wrong, and amounts such as "30 ns".


def join(*places: str | None) -> str:
    """Return one place out of several, from the file inwards."""
    return ", ".join(place for place in places if place)


def kind_model(kind: str, where: str) -> Model:
    """Return the model of a kind, by its name or an alias; raise InvalidProblem for an unknown one."""
    return MODELS[kind_named(kind, where)]


@dataclass(frozen=True, slots=True)
class Units:
    """What a number measures and what its units depend on.

    Parameters
    ----------
    quantity : Quantity
        It decides which units make sense.
    speed : float
        Propagation speed, metres per second.
    carrier : float, optional
        Carrier frequency, hertz.
    convention : AzimuthConvention
        Of azimuths.
    """

    quantity: Quantity
    speed: float = SPEED_OF_LIGHT
    carrier: float | None = None
    convention: AzimuthConvention = "east-counterclockwise"

    @property
    def clockwise(self) -> bool:
        """Return whether numbers grow clockwise, as those of a compass do."""
        return self.convention == "north-clockwise"

    def name(self, unit: str | None) -> str:
        """Return a unit; None is the SI unit."""
        return SI_UNIT[self.quantity] if unit is None else unit

    def conversion(self, unit: str | None, where: str) -> Conversion:
        """Return how a unit becomes SI; None is the SI unit."""
        return conversion(
            self.name(unit),
            self.quantity,
            propagation_speed=self.speed,
            carrier=self.carrier,
            convention=self.convention,
            where=where,
        )

    def amount(self, value: float | str, default: Conversion | None, where: str) -> tuple[float, Conversion]:
        """Return the number of an amount and how its unit becomes SI.

        Parameters
        ----------
        value : float or str
            A number in the default unit, or a number and a unit: ``"30 ns"``.
        default : Conversion, optional
            Unit of a bare number; None: a bare number is refused.
        where : str
            Place to name.
        """
        number, unit = split_amount(value, self.quantity, where)
        if unit:
            return number, self.conversion(unit, where)
        if default is None:
            example = example_of(number, str(value).strip(), self.quantity)
            raise InvalidProblem(f"{value!r} has no unit", where, f"write it with its unit, such as {example}")
        return number, default

    def plain(self, value: float | str, default: str | None, where: str) -> float:
        """Return an amount in SI units; `default` is the unit of a bare number, None refuses it."""
        number, unit = self.amount(value, None if default is None else self.conversion(default, where), where)
        return float(unit.to_si(number))


Bound = Annotated[float, Field(allow_inf_nan=True)]
"""One coordinate of a box; infinite where there is no bound."""

Cell = str | int | float
Row = dict[str, Cell]
_Model = TypeVar("_Model", bound=BaseModel)
# Complaints of pydantic that need words of their own; all others are quoted.
_WHAT = {
    "missing": "the key {key!r} is missing",
    "extra_forbidden": "unknown key {key!r}",
    "finite_number": "{key} is {value}, not a finite number",
}


class _FileTable(BaseModel):
    """A table of the file; keys that it does not know are refused."""

    # Strict and closed: a number in quotes or a misspelt key is refused, never guessed.
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class Origin(_FileTable):
    """A point on Earth, WGS 84."""

    lat_deg: float
    """Latitude, degrees."""
    lon_deg: float
    """Longitude, degrees."""
    height: float = 0.0
    """Height above the ellipsoid, metres."""


class FrameTable(_FileTable):
    """The frame in which positions are computed and answered."""

    kind: Literal["cartesian", "ecef", "enu", "geodetic"] = "cartesian"
    """Axes anywhere; Earth-centred Earth-fixed; east, north, up; or latitude, longitude, height (computed in ECEF)."""
    origin: Origin | None = None
    """Origin of an ENU frame; by default the mean of stations that are given by latitude and longitude."""
    dimension: Literal[2, 3] | None = None
    """Dimension of the positions; by default 3 where there is a z or a height."""


class DataTable(_FileTable):
    """Where rows come from: a file, or the table itself."""

    file: str | None = None
    """CSV or Parquet file, relative to the problem file."""
    rows: list[Row] | None = None
    """The rows themselves, one inline table each."""
    columns: dict[str, str] = Field(default_factory=dict)
    """What the file calls its columns: `{ a = "rx1", z = "tdoa_ns" }`."""
    separator: Literal[",", ";", "\t", "|", ":", " "] = ","
    """What separates the fields of a CSV file."""


class StationsTable(DataTable):
    """The stations. Columns: name; x, y, z or lat_deg, lon_deg, height; optional ones are listed in the manual."""

    unit: str = "m"
    """Unit of x, y, z, height and sigma."""
    speed_unit: str = "m/s"
    """Unit of vx, vy, vz and velocity_sigma."""
    time_unit: str = "s"
    """Unit of the time column of moving stations."""
    axes: Literal["frame", "enu"] | None = None
    """Axes that angles refer to: the frame's, or east, north, up at each station (default on Earth)."""
    sigma: Amount | None = None
    """Standard deviation of each coordinate of the positions; None: surveyed exactly."""
    velocity_sigma: Amount | None = None
    """Standard deviation of each coordinate of the velocities; None: known exactly."""
    span: Literal["epoch", "run", "noise"] = "epoch"
    """Whether an error of position or velocity is an unknown of each epoch, one of the whole run, or noise drawn anew
    at each epoch."""


class DeclinationTable(_FileTable):
    """The magnetic declination of the World Magnetic Model at each station."""

    date: str
    """Day in ISO 8601, such as "2026-06-01"."""

    @field_validator("date", mode="before")
    @classmethod
    def _written(cls, value: Any) -> Any:
        """Return a date of TOML as text."""
        return value.isoformat() if isinstance(value, date) else value


def _kind_words() -> list[str]:
    return [*sorted(MODELS), *sorted(alias for model in MODELS.values() for alias in model.aliases)]


class MeasurementsTable(DataTable):
    """Measurements of one kind. Columns: a, b, z; optional ones are listed in the manual."""

    kind: str | None = Field(default=None, json_schema_extra=lambda schema: schema.update(enum=[*_kind_words(), None]))
    """Measurement kind; None where the rows have a column `kind`."""
    unit: str | dict[str, str] | None = None
    """Unit of z, or one unit for each kind; SI by default."""
    a: str | None = None
    """First station of all rows, where there is no column a."""
    b: str | None = None
    """Second station of all rows, where there is no column b."""
    azimuth: AzimuthConvention | None = None
    """Where azimuth zero is and which way it grows. Default: a compass (north-clockwise) for the kind `bearing`, and in
    format 2 wherever there is an Earth; else east-counterclockwise."""
    declination: Amount | DeclinationTable | None = None
    """Magnetic declination, east positive, of bearings from magnetic north: a number in the unit of z or an amount such
    as "4 deg"; or a date such as "2026-06-01", at which the World Magnetic Model gives that of each station."""
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
    snr: Amount | dict[str, Amount] | None = None
    """Signal-to-noise ratio of power within the band, one or of each station, "10 dB" or a ratio: with `bandwidth` and
    `duration` the noise of time differences and gain ratios follows."""
    bandwidth: Amount | None = None
    """Hertz, from zero up; of a signal about a carrier half its bandwidth, with twice the duration."""
    duration: Amount | None = None
    """Seconds that are integrated for one measurement."""
    correction: Amount | None = None
    """Known amount by which every row exceeds the model; of azimuths the angle by which all turn clockwise."""
    weight: float | None = Field(default=None, ge=0.0, le=1.0)
    """Weight of all rows: 1 as measured, 0 absent."""
    time_unit: str = "s"
    """Unit of the column time."""


class TargetTable(DataTable):
    """How targets move; the rows of a known one. Columns: x, y, z or lat_deg, lon_deg, height; time or epoch."""

    motion: Literal["static", "free", "free_velocity", "constant_velocity", "constant_acceleration", "known"] | None = (
        None
    )
    """Default: known with rows or a file, else static with one epoch, else a free position at every epoch, where the
    target is at rest; free_velocity has a velocity of each epoch, too."""
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


class ConstraintTable(_FileTable):
    """What the answer must meet."""

    kind: Literal["box", "height", "above-ground", "polygon", "visible", "speed"]
    """What is bounded; each kind has its own keys."""
    target: str | None = None
    """Name of the target; all by default."""
    exactly: Amount | list[Bound] | None = None
    """Known height above the WGS 84 ellipsoid; or one number for each epoch, as reported."""
    within: Amount | None = None
    """Half the width of a band about `exactly`."""
    along: bool | None = None
    """Whether the height of a target that moves is held at every epoch (default), on a course that follows the
    Earth, or at the reference time alone."""
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


# Depths of a table of speeds: each is a unit of work in every ray, and a profile of the sea has a few dozen.
_LAYERS = 1000
# Biases, priors and constraints that a person writes down; each is a unit of work in every step of every fix.
_MANY = 100


class BiasTable(_FileTable):
    """A family of unknown systematic errors."""

    name: str = Field(min_length=1)
    """Its name."""
    form: FormName = "offset"
    """Added; times the measured quantity; times the seconds of the run; a turn of the station's axes; the seconds by
    which the station is further along its course; or added, and another at each epoch: a random walk, as of a clock, or
    a smooth function of time."""
    per: Literal["station", "pair", "kind", "target"] = "station"
    """Who has one of his own: each station (with the sign of its arrival), pair of stations, or target; or the kind."""
    kind: str | None = None
    """Kind of the rows that are touched; needed where the file has several quantities, but not for a time."""
    members: list[str] | dict[str, list[str]] | None = None
    """Stations that have one; all that measure by default. Leave out the reference of a difference. Or groups of
    stations that share one: `{ GPS = ["G01", "G07"] }`. Of pairs: names such as "A-B"; of targets: theirs."""
    mean: Amount | None = None
    """Prior mean."""
    sigma: Amount | None = None
    """Prior standard deviation with its unit, such as "200 m"; without it the bias is unknown. Of a walk that of its
    value at the first epoch."""
    density: str | None = None
    """Of a walk: spectral density of the white noise that it is the sum of, such as "0.04 m^2/s" or "4 ns^2/s"."""
    rate_density: str | None = None
    """Of a walk whose rate walks too: the density of that, such as "1e-6 m^2/s^3"."""
    allan: list[list[float]] | None = Field(default=None, max_length=_MANY)
    """Of a walk of times or lengths, in place of densities: Allan deviations of the clock, each with its averaging time
    in seconds, such as [[1.0, 1e-9], [100.0, 2e-10]]."""
    knots: int | list[float] | None = None
    """Of a spline: the times in seconds between which it is a cubic polynomial, or how many evenly spaced ones."""


class PriorTable(_FileTable):
    """Prior knowledge of an unknown."""

    name: str
    """Unknown: position, velocity, acceleration, with `[0]` and so on behind it where there are several targets."""
    mean: list[float]
    """Its mean, in the frame's coordinates."""
    sigma: list[float] | Amount
    """Standard deviation of each coordinate."""
    unit: str | None = None
    """Unit of both; metres, metres per second, metres per second squared by default."""


class SoundTable(_FileTable):
    """The medium through which sound comes."""

    medium: Literal["air", "fresh water", "sea water"]
    """What it is."""
    celsius: float
    """Its temperature."""
    salinity: float | None = None
    """Grams of salt in a kilogram of water; 0 in fresh water and 35 in sea water by default."""
    depth: float = 0.0
    """Metres below the surface."""


class SpeedTable(_FileTable):
    """A speed that is not quite known."""

    value: Amount
    """The stated speed: metres per second, or text with a unit."""
    sigma: Amount
    """Its standard deviation, likewise."""


class MediumTable(_FileTable):
    """What the waves come through where their speed is not one number: each row is then measured along its rays."""

    kind: Literal["layers", "atmosphere"]
    """Speeds over depth below a level surface; or air as radio waves meet it."""
    depths: list[float] | None = Field(default=None, max_length=_LAYERS)
    """Of layers: depths that grow; of the points between which speeds are straight lines, or of tops of layers."""
    speeds: list[float] | None = Field(default=None, max_length=_LAYERS)
    """Of layers: the speed at each depth."""
    between: Literal["linear", "constant"] = "linear"
    """Of layers: what holds between the depths."""
    surface: Amount = 0.0
    """Of layers: third coordinate of depth zero."""
    unit: str = "m"
    """Unit of depths and surface."""
    speed_unit: str = "m/s"
    """Unit of speeds."""
    refractivity: float | None = None
    """Of an atmosphere: (n - 1) 1e6 at height zero; 315 by default."""
    scale_height: float | None = None
    """Of an atmosphere: metres over which it falls to 1 / e; 7350 by default."""


class WindowTable(_FileTable):
    """How rows are put together to epochs by their times."""

    window: str | None = None
    """Length of an epoch, such as "0.1 s"; by default rows of exactly equal time belong together."""


class ProblemFile(_FileTable):
    """A problem file."""

    format: Literal[1, 2]
    """Version of the format: in 2, azimuths on Earth are compass bearings where nothing else is said."""
    title: str | None = None
    """What it is."""
    propagation_speed: Annotated[float, Field(gt=0.0)] | str | SoundTable | SpeedTable | None = None
    """Metres per second, or text with a unit; or of sound: { medium = "air", celsius = 20.0 }. Light by default.
    A speed with a sigma is estimated with the target: { value = 343.0, sigma = 5.0 }.
    Beside layers: the speed by which ranges in metres were made of times."""
    medium: MediumTable | None = None
    """Layers or air, where the speed is not one number."""
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


# Read a TOML file and hold it against the schema; every complaint is one sentence with its place.


def read_document(path: Path) -> ProblemFile:
    """Return the contents of a problem file, or of standard input; raise InvalidProblem where it is none."""
    return document_of(read_text(path), name_of(path))


def document_of(text: str, source: str) -> ProblemFile:
    """Return the contents of the text of a problem file; `source` is the place to name."""
    data = parse_toml(text, source, formats=(1, 2))
    # these two a network alone has: `optloc.sites.calibration.network_file`
    if isinstance(stations := data.get("stations"), dict) and {"dimension", "synchronised"} & set(stations):
        raise InvalidProblem("the stations of this file are yet to be found", source, "use optloc calibrate")
    return validate(data, source)


def name_of(path: Path) -> str:
    """Return what to call a document."""
    return "standard input" if path == STANDARD_INPUT else path.name


def parse_toml(text: str, source: str, formats: tuple[int, ...] = (1,)) -> dict[str, Any]:
    """Return TOML of one of some formats as data; `source` is the place to name."""
    if not text.strip():
        raise InvalidProblem("the file is empty", source, f"begin it with the line format = {max(formats)}")
    data = toml_of(text, source)
    # true equals 1 in Python.
    if data.get("format") not in formats or isinstance(data.get("format"), bool):
        given = f"format {data['format']!r} is unknown" if "format" in data else "the key 'format' is missing"
        raise InvalidProblem(given, source, f"begin the file with the line format = {max(formats)}")
    return data


def validate(data: dict[str, Any], source: str) -> ProblemFile:
    """Return data as a problem file; `source` is the place to name."""
    return validated(ProblemFile, data, source)


def validated(model: type[_Model], data: dict[str, Any], source: str) -> _Model:
    """Return data as a table of a schema; raise InvalidProblem with the first complaint.

    Parameters
    ----------
    model : type of pydantic model
        The schema.
    data : dict
        What was written.
    source : str
        Place to name.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _sentence(error, source, data, model) from None


def _sentence(error: ValidationError, source: str, data: dict[str, Any], model: type[BaseModel]) -> InvalidProblem:
    # Alternatives of a union each complain. The table with the fewest complaints was meant, and its deepest complaint
    # names the mistake.
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
    path, key = _path(first["loc"], data)
    template = _WHAT.get(first["type"])
    if template is not None:
        what = template.format(key=key, value=first["input"])
    else:
        what = f"{key} = {first['input']!r} does not fit: {first['msg'][0].lower()}{first['msg'][1:]}"
    advice = None
    if first["type"] in {"extra_forbidden", "missing"}:
        known = _keys(path, model, first["loc"])
        advice = nearest(key, known) if first["type"] == "extra_forbidden" else "add it"
    if first["type"] == "literal_error":
        known = [part.strip().strip("'") for part in str(first["ctx"]["expected"]).replace(" or ", ", ").split(",")]
        what, advice = f"{key} = {first['input']!r} is unknown", nearest(str(first["input"]), known)
    return InvalidProblem(what, join(source, *_spell(path)), advice)


def _is_alternative(loc: tuple[int | str, ...]) -> bool:
    """Return whether a complaint is about a key of one of several tables that the file may use in a place."""
    return len(loc) > _IN_TABLE and str(loc[1]).endswith("Table")


# Names before the key in the place of such a complaint: the key of the file, and the table.
_IN_TABLE = 2


def _path(loc: tuple[int | str, ...], data: Any) -> tuple[list[int | str], str]:
    """Return the path of the table and the key of a complaint, without the names of union members."""
    path: list[int | str] = []
    at: Any = data
    # pydantic puts the names of a union's members between keys: what is not in the data is one of them.
    for part in loc:
        if (isinstance(at, dict) and part in at) or (isinstance(at, list) and part in range(len(at))):
            at = at[part]  # type: ignore[index]  # just checked
        elif part != loc[-1] or not isinstance(at, dict):
            continue
        path.append(part)
    *table, key = path or ["file"]
    # The key of a complaint about an entry of a list is that of the list.
    while table and isinstance(key, int):
        key = table.pop()
    return table, str(key)


def _spell(path: list[int | str]) -> list[str]:
    """Return a path as a file spells it: ``[[measurements]] 2``."""
    names: list[str] = []
    for part in path:
        if isinstance(part, int):
            names[-1] = f"{names[-1].replace('[', '[[').replace(']', ']]')} {part + 1}"
        else:
            names.append(f"[{part}]")
    return names


def _keys(path: list[int | str], model: Any, loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the table at a path of a schema; a complaint names the table where a place allows several."""
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

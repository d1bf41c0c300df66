"""Content of a study file, as tables from which its JSON schema is derived."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from optloc.files import Units
from optloc.models import MODELS
from optloc.problem import Amount, InvalidProblem

Level = float | str | dict[str, Amount]
"""A factor on the noise of a file, the standard deviation of every row, or the standard deviation of each kind."""

# Names appear in every row, in titles of figures and in legends: one line at most.
Name = Annotated[str, Field(min_length=1, max_length=120)]


# Limits of counts catch typing errors before hours are spent: no array has more stations, and the nine digits in the
# name of a part number no more trials.
class _DesignTable(BaseModel):
    """A table of the file; unknown keys are rejected."""

    # Strict: a number in quotes is text with a unit, and a misspelt key must not become a default without a message.
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class LayoutTable(_DesignTable):
    """Stations placed by a rule, and their measurements; lengths are amounts."""

    stations: int = Field(default=6, ge=1, le=1000)
    """Number of stations."""
    dimension: Literal[2, 3] = 3
    """Dimension of the positions."""
    placement: Literal["random", "frozen", "ring", "star", "given"] = "random"
    """Random in the box, drawn in every trial; frozen: drawn once; ring: on an ellipse in the box; star: a ring with
    the first station in the middle; given: at `places`."""
    box: list[Amount] = Field(default=["10 km", "10 km", "6 km"], min_length=2, max_length=3)
    """Widths of the box around the origin."""
    places: list[list[float]] | None = None
    """Positions of the stations, metres."""
    kinds: list[str] = Field(default=["tdoa"], min_length=1)
    """Measurement kinds. Kinds of one station have a row at every station, kinds of two at every pair."""
    pairs: Literal["first", "all"] = "first"
    """Pairs of stations: all against the first, or every pair."""
    independent: bool = False
    """Whether differences with a common station are independent; by default they share the error of its arrival."""
    survey: Amount | None = None
    """Standard deviation of each coordinate of the stations' positions, drawn in every trial; None: exact."""


class TruthTable(_DesignTable):
    """Position and velocity of the target; lengths are amounts."""

    kind: Literal["fixed", "box", "shell", "hull", "area"]
    """Fixed: one position; box: in a box; shell: in all directions from the stations' centre; hull: inside their hull;
    area: in a rectangle of latitude and longitude."""
    at: list[Amount] | None = None
    """Fixed: coordinates in the frame."""
    at_deg: list[float] | None = None
    """Fixed: latitude and longitude in degrees, height in metres."""
    centre: list[Amount] | None = None
    """Box: its centre; the stations' centre by default."""
    box: list[Amount] | None = None
    """Box: its widths; on Earth along east, north and up."""
    distance: list[Amount] | None = Field(default=None, min_length=2, max_length=2)
    """Shell: least and greatest distance from the stations' centre; the distance is uniform between them."""
    elevation_deg: list[float] | None = Field(default=None, min_length=2, max_length=2)
    """Shell: least and greatest elevation of the direction; all directions by default."""
    lat_deg: list[float] | None = Field(default=None, min_length=2, max_length=2)
    """Area: least and greatest latitude."""
    lon_deg: list[float] | None = Field(default=None, min_length=2, max_length=2)
    """Area: least and greatest longitude."""
    height: Amount = 0.0
    """Area: height above the ellipsoid."""
    speed: Amount | None = None
    """Speed of a moving target in a random direction; zero by default."""
    velocity: list[Amount] | None = None
    """Velocity of a moving target, instead of `speed`."""


class OutlierTable(_DesignTable):
    """Gross errors of single stations."""

    share: float = Field(gt=0.0, le=1.0)
    """Probability that a station has a gross error in a trial."""
    size: Amount | dict[str, Amount]
    """Size of the error, for all kinds or for each. A difference takes the error of its second station with the other
    sign."""
    late: bool = False
    """Whether all errors are positive, as a blocked path makes an arrival late; by default the sign is random."""


class ErrorTable(_DesignTable):
    """Errors in the measurements that no method has a model of."""

    offset: Amount | dict[str, Amount] | None = None
    """Standard deviation of a constant error of each station, drawn in every trial: for all kinds, or for each."""
    outliers: OutlierTable | None = None
    """Gross errors of a share of the stations."""


class ScenarioTable(_DesignTable):
    """A geometry, a truth and its noise levels."""

    name: Name
    """Its name in tables."""
    problem: str | None = None
    """Problem file, relative to the study file, or the name of a shipped one: stations, rows, biases, constraints."""
    layout: LayoutTable | None = None
    """Stations placed by a rule, instead of a problem file."""
    truth: TruthTable
    """Position and velocity of the target."""
    noise: list[Level] = Field(default=[1.0], min_length=1)
    """Noise levels: "10 m" is the standard deviation of every row; { tdoa = "10 m", azimuth = "5 mrad" } names kinds; a
    bare number is a factor on the noise of the problem file."""
    bias: dict[str, Amount | list[Amount]] = Field(default_factory=dict)
    """True values of the biases of the file: a list with one value for each member, or the standard deviation of a draw
    in every trial. By default the prior means."""
    error: ErrorTable = ErrorTable()
    """Errors that are not modelled."""
    sweep: dict[str, list[Any]] = Field(default_factory=dict)
    """Values of other keys of this table, by dotted names such as "layout.stations": every combination is a case."""
    trials: int | None = Field(default=None, ge=1, le=100_000_000)
    """Number of trials, instead of the study's number."""


class NetworkTable(_DesignTable):
    """Networks of unknown stations, clocks and pulses, drawn in every trial; lengths are amounts."""

    name: Name
    """Its name in tables."""
    stations: int = Field(default=8, ge=2, le=1000)
    """Number of stations."""
    pulses: int = Field(default=30, ge=1, le=100_000)
    """Number of pulses."""
    dimension: Literal[2, 3] = 3
    """Dimension of the positions."""
    box: list[Amount] = Field(default=["20 m", "20 m", "6 m"], min_length=2, max_length=3)
    """Widths of the box that contains the stations."""
    around: list[Amount] | None = Field(default=None, min_length=2, max_length=3)
    """Widths of the box that contains the pulses, with the same centre; by default the box of the stations."""
    emission: Amount = "200 m"
    """Width of the interval of emission times, times the propagation speed."""
    synchronised: bool = True
    """Whether the stations share one clock; methods know whether they do."""
    clocks: Amount = "10 m"
    """Width of the interval of station clocks, times the propagation speed, if the stations are not synchronised."""
    missing: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Share of the arrivals that are missing; each pulse keeps at least two arrivals more than it has unknowns."""
    outliers: OutlierTable | None = None
    """Gross errors of a share of the arrivals; no method has a model of them."""
    noise: list[Amount] = Field(default=["3 cm"], min_length=1)
    """Standard deviations of an arrival."""
    sweep: dict[str, list[Any]] = Field(default_factory=dict)
    """Values of other keys of this table, by dotted names such as "pulses": every combination is a case."""
    trials: int | None = Field(default=None, ge=1, le=100_000_000)
    """Number of trials, instead of the study's number."""


class MethodTable(_DesignTable):
    """Methods that solve the problems. A list in `method`, `baseline` or `solver` makes one method of each member."""

    name: Name | None = None
    """Name in tables; by default made of the other keys."""
    method: str | list[str] | None = None
    """"auto", or stages joined by "+", see `optloc list methods`; "calibrate" for networks."""
    baseline: str | list[str] | None = None
    """Baseline to compare with, instead of a method; see `optloc list baselines`."""
    solver: str | list[str] | None = None
    """Solver of the conic or nonlinear programs; see `optloc list solvers`."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings of the solver, such as a time limit or a tolerance."""
    start: Literal["centre", "truth", "box"] = "centre"
    """Start of a baseline that needs a guess: at the stations' centre, at the truth, or at random in a box."""
    width: Amount = "100 km"
    """Width of this box around the stations' centre."""
    batch: int | None = Field(default=None, ge=1)
    """Fixes in one call; by default all fixes of a chunk. With 1, each fix is timed separately."""
    chunk: int | None = Field(default=None, ge=1, le=1_000_000)
    """Trials of one task; by default a number that takes seconds."""


class StudyFile(_DesignTable):
    """A study file, format 1."""

    format: Literal[1]
    """Version of the format."""
    name: Name
    """Name of the study."""
    title: str | None = None
    """Question of the study, in one line."""
    note: str | None = None
    """Advice on how to read the results."""
    seed: int = Field(default=0, ge=0, lt=2**64)
    """Seed of all random numbers."""
    trials: int = Field(default=1000, ge=1, le=100_000_000)
    """Trials of each scenario at each noise level."""
    scenario: list[ScenarioTable] = Field(default_factory=list)
    """Problems of positions from known stations."""
    network: list[NetworkTable] = Field(default_factory=list)
    """Networks to calibrate. A study has either scenarios or networks, as no method solves both."""
    method: list[MethodTable] = Field(min_length=1)


def study_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a study file."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **StudyFile.model_json_schema()}


# Amounts of a study file as numbers.


def sigma_of(kind: str, amount: Amount, where: str) -> float:
    """Return a standard deviation of rows of a kind in SI units; raise InvalidProblem unless it is positive.

    Decibels are converted at a ratio of one. `where` is the location for error messages.
    """
    quantity = MODELS[kind].quantity
    units = Units(quantity)  # type: ignore[arg-type]  # models hold known quantities only
    number, unit = units.amount(amount, None if isinstance(amount, str) else units.conversion(None, where), where)
    # A decibel is a share of the ratio, so the deviation depends on the ratio: one is the middle of the scale.
    value = float(unit.sigma_to_si(number, np.ones(()))) if unit.logarithmic else abs(unit.factor) * number
    if not value > 0.0:
        raise InvalidProblem(f"{amount!r} is not positive", where, "give a positive standard deviation")
    return value

"""What a study file may say, as tables from which its JSON schema is derived."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from optloc.files import Units
from optloc.models import MODELS
from optloc.problem import Amount, InvalidProblem

Level = float | str | dict[str, Amount]
"""A factor on the noise of a file, the standard deviation of every row, or that of every kind."""

# Names stand in every row, in titles of figures and in legends: one line at most.
Name = Annotated[str, Field(min_length=1, max_length=120)]


# Limits of counts catch slips before hours are spent: more stations than any array has, more trials than the nine
# digits of a part's name can number.
class _DesignTable(BaseModel):
    """A table of the file; keys that it does not know are refused."""

    # Strict: a number in quotes is text with a unit, and a misspelt key must not be a default in silence.
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class LayoutTable(_DesignTable):
    """Stations placed by rule, and who measures what; lengths are amounts."""

    stations: int = Field(default=6, ge=1, le=1000)
    """Number of stations."""
    dimension: Literal[2, 3] = 3
    """Dimension of the positions."""
    placement: Literal["random", "frozen", "ring", "star", "given"] = "random"
    """Random in the box anew in every trial; drawn once; on an ellipse in the box; the same with the first station in
    the middle; or as `places` says."""
    box: list[Amount] = Field(default=["10 km", "10 km", "6 km"], min_length=2, max_length=3)
    """Widths of the box around the origin."""
    places: list[list[float]] | None = None
    """Positions of the stations, metres."""
    kinds: list[str] = Field(default=["tdoa"], min_length=1)
    """Measurement kinds: of one station at every station, of two at the pairs."""
    pairs: Literal["first", "all"] = "first"
    """Pairs of stations: all against the first, or every pair."""
    independent: bool = False
    """Whether differences of one station are independent; by default they share the error of its arrival."""
    survey: Amount | None = None
    """Standard deviation of each coordinate of the stations' positions, drawn anew in every trial; None: exact."""


class TruthTable(_DesignTable):
    """Where the target is; lengths are amounts."""

    kind: Literal["fixed", "box", "shell", "hull", "area"]
    """At one place; in a box; in all directions from the stations' centre; inside their hull; in a rectangle of
    latitude and longitude."""
    at: list[Amount] | None = None
    """Fixed: coordinates in the frame."""
    at_deg: list[float] | None = None
    """Fixed: latitude and longitude in degrees, height in metres."""
    centre: list[Amount] | None = None
    """Box: its centre; the stations' centre by default."""
    box: list[Amount] | None = None
    """Box: its widths; along east, north and up on Earth."""
    distance: list[Amount] | None = Field(default=None, min_length=2, max_length=2)
    """Shell: least and greatest distance from the stations' centre, equally likely between."""
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
    """Velocity of a moving target, in the place of `speed`."""


class OutlierTable(_DesignTable):
    """Gross errors of single stations."""

    share: float = Field(gt=0.0, le=1.0)
    """Probability that a station is off in a trial."""
    size: Amount | dict[str, Amount]
    """How far off: of all kinds, or of each. A difference takes the error of its second station with the other sign."""
    late: bool = False
    """Whether stations are off in one direction only, as blocked paths make arrivals late; by default in either."""


class ErrorTable(_DesignTable):
    """What the measurements suffer and no method is told."""

    offset: Amount | dict[str, Amount] | None = None
    """Standard deviation of a constant error of each station, drawn in every trial: of all kinds, or of each."""
    outliers: OutlierTable | None = None
    """Gross errors of a share of the stations."""


class ScenarioTable(_DesignTable):
    """A geometry, a truth and its noise levels."""

    name: Name
    """Its name in tables."""
    problem: str | None = None
    """Problem file, relative to the study file, or the name of a shipped one: stations, rows, biases, constraints."""
    layout: LayoutTable | None = None
    """Stations placed by rule, in the place of a file."""
    truth: TruthTable
    """Where the target is."""
    noise: list[Level] = Field(default=[1.0], min_length=1)
    """Noise levels: "10 m" is the standard deviation of every row; { tdoa = "10 m", azimuth = "5 mrad" } names kinds;
    a bare number is a factor on the noise of the problem file."""
    bias: dict[str, Amount | list[Amount]] = Field(default_factory=dict)
    """True values of the biases of the file: one for each member, or the standard deviation of a draw in every trial.
    By default their prior means."""
    error: ErrorTable = ErrorTable()
    """Errors that are not modelled."""
    sweep: dict[str, list[Any]] = Field(default_factory=dict)
    """Values of other keys of this table, by dotted names such as "layout.stations": every combination is a case."""
    trials: int | None = Field(default=None, ge=1, le=100_000_000)
    """Number of trials, in the place of the study's."""


class NetworkTable(_DesignTable):
    """Stations, clocks and pulses that are unknown together, drawn anew in every trial; lengths are amounts."""

    name: Name
    """Its name in tables."""
    stations: int = Field(default=8, ge=2, le=1000)
    """Number of stations."""
    pulses: int = Field(default=30, ge=1, le=100_000)
    """Number of pulses."""
    dimension: Literal[2, 3] = 3
    """Of space."""
    box: list[Amount] = Field(default=["20 m", "20 m", "6 m"], min_length=2, max_length=3)
    """Widths of the box in which the stations are."""
    around: list[Amount] | None = Field(default=None, min_length=2, max_length=3)
    """Widths of the box, with the same centre, in which the pulses are; that of the stations by default."""
    emission: Amount = "200 m"
    """Width in which times of emission are, times the speed of propagation."""
    synchronised: bool = True
    """Whether the stations share a clock, and methods know it."""
    clocks: Amount = "10 m"
    """Width in which the clocks of stations are that do not."""
    missing: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Share of the arrivals that are missing; each pulse keeps as many as it has unknowns, and two more."""
    outliers: OutlierTable | None = None
    """Gross errors of a share of the arrivals, which no method is told."""
    noise: list[Amount] = Field(default=["3 cm"], min_length=1)
    """Standard deviations of an arrival."""
    sweep: dict[str, list[Any]] = Field(default_factory=dict)
    """Values of other keys of this table, by dotted names such as "pulses": every combination is a case."""
    trials: int | None = Field(default=None, ge=1, le=100_000_000)
    """Number of trials, in the place of the study's."""


class MethodTable(_DesignTable):
    """How the problems are solved. A list in `method`, `baseline` or `solver` stands for one method each."""

    name: Name | None = None
    """Its name in tables; made of the rest by default."""
    method: str | list[str] | None = None
    """"auto", or stages joined by "+", see `optloc list methods`; "calibrate" of networks."""
    baseline: str | list[str] | None = None
    """Something to compare with, in the place of a method; see `optloc list baselines`."""
    solver: str | list[str] | None = None
    """Back end of the conic or nonlinear programs; see `optloc list solvers`."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings of that back end, such as a time limit or a tolerance."""
    start: Literal["centre", "truth", "box"] = "centre"
    """Where a baseline that needs a guess begins: at the stations' centre, at the truth, or anywhere in a box."""
    width: Amount = "100 km"
    """Width of that box around the stations' centre."""
    batch: int | None = Field(default=None, ge=1)
    """Fixes in one call; by default as many as a chunk has. 1: each is timed by itself."""
    chunk: int | None = Field(default=None, ge=1, le=1_000_000)
    """Trials of one task; by default so many that it takes seconds."""


class StudyFile(_DesignTable):
    """A study file, format 1."""

    format: Literal[1]
    """Version of the format."""
    name: Name
    """What the study is called."""
    title: str | None = None
    """What it asks, in one line."""
    note: str | None = None
    """How to read its results."""
    seed: int = Field(default=0, ge=0, lt=2**64)
    """Decides all draws."""
    trials: int = Field(default=1000, ge=1, le=100_000_000)
    """Trials of each scenario at each noise level."""
    scenario: list[ScenarioTable] = Field(default_factory=list)
    """What is fixed from known stations."""
    network: list[NetworkTable] = Field(default_factory=list)
    """What is calibrated. A study has either scenarios or networks, as no method serves both."""
    method: list[MethodTable] = Field(min_length=1)


def study_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a study file."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **StudyFile.model_json_schema()}


# Amounts of a study file as numbers.


def sigma_of(kind: str, amount: Amount, where: str) -> float:
    """Return a standard deviation of rows of a kind in SI units; of ratios in decibels, at a ratio of one."""
    quantity = MODELS[kind].quantity
    units = Units(quantity)  # type: ignore[arg-type]  # models hold known quantities only
    number, unit = units.amount(amount, None if isinstance(amount, str) else units.conversion(None, where), where)
    # A decibel is a share of the ratio, so its deviation depends on the ratio: one, where nothing is nearer.
    value = float(unit.sigma_to_si(number, np.ones(()))) if unit.logarithmic else abs(unit.factor) * number
    if not value > 0.0:
        raise InvalidProblem(f"{amount!r} is not positive", where, "give a positive standard deviation")
    return value

"""The values of an estimation problem, and the words of a verdict: frozen, SI units and radians, leading axes batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Any, Literal

import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]

Whole = int | Sequence[int] | Array
"""Whole numbers, one or one for each row."""

Amount = float | str
"""A number in SI units, or text with a unit such as "20 ns"."""

Amounts = Amount | Sequence[Amount] | Sequence[Sequence[float]] | Array
"""Numbers in SI units, or texts with a unit, of any shape."""
FormName = Literal["offset", "scale", "drift", "rotation", "time", "walk", "spline"]
"""Names of the forms of a `Bias`, for type checkers: the keys of `optloc.problem.forms.FORMS`."""


@dataclass(frozen=True, slots=True)
class Stations:
    """Where the stations are.

    Parameters
    ----------
    position : array (..., k or 1, s, d)
        Metres, in the problem's frame; one entry along the epoch axis for stations that stay.
    names : tuple of s str
        Unique names.
    velocity : array (..., k or 1, s, d), optional
        Metres per second.
    axes : array (..., k or 1, s, d, d), optional
        Rows are the unit vectors of each station's own axes, in the problem's frame; None: the frame's axes.
    covariance : array (..., s, d, d), optional
        Covariance of the position errors, square metres; None: surveyed exactly.
    span : "epoch", "run" or "noise"
        An error of position or velocity is an unknown of each epoch, or one that lasts the whole run; or it is drawn
        anew at each epoch and not estimated: it enlarges the noise of the rows that the station takes part in.
    velocity_covariance : array (..., s, d, d), optional
        Covariance of the velocity errors, square metres per second squared, independent of those of the positions;
        None: known exactly. They enter the kinds that depend on velocities: range rates and their differences.
    """

    position: Array
    names: tuple[str, ...]
    velocity: Array | None = None
    axes: Array | None = None
    covariance: Array | None = None
    span: Literal["epoch", "run", "noise"] = "epoch"
    velocity_covariance: Array | None = None

    @property
    def errors(self) -> tuple[tuple[str, str, Array], ...]:
        """Return name, SI unit and covariance (..., s, d, d) of the errors there are, in the order of their slots."""
        both = (("stations", "m", self.covariance), ("station velocities", "m/s", self.velocity_covariance))
        return tuple((name, unit, covariance) for name, unit, covariance in both if covariance is not None)

    @property
    def unknown_for(self) -> Literal["epoch", "run"] | None:
        """Return the span of errors that are unknowns; None for noise, and for stations without errors."""
        return self.span if self.span != "noise" and self.errors else None

    @property
    def weighed(self) -> bool:
        """Return whether errors of positions or velocities are noise of each epoch."""
        return self.span == "noise" and bool(self.errors)

    @property
    def isotropic(self) -> bool:
        """Return whether the errors of each position are equally large in all directions."""
        if self.covariance is None:
            return True
        # Nine digits: variances may come from conversions of units.
        equal = np.eye(self.dimension) * self.covariance[..., :1, :1]
        return bool((np.abs(self.covariance - equal) <= 1e-9 * equal).all())

    def with_noise(self) -> Stations:
        """Return the stations with errors of each epoch as noise of its rows: no other epoch shares them."""
        return replace(self, span="noise") if self.unknown_for == "epoch" else self

    @property
    def dimension(self) -> int:
        """Return 2 or 3."""
        return int(self.position.shape[-1])

    @property
    def count(self) -> int:
        """Return the number of stations."""
        return int(self.position.shape[-2])

    @property
    def places(self) -> Array:
        """Return where stations are at any epoch, (..., k * s, d): moving ones span what they pass."""
        return self.position.reshape(*self.position.shape[:-3], -1, self.dimension)


@dataclass(frozen=True, slots=True)
class Rows:
    """Measurements of one kind.

    Parameters
    ----------
    kind : str
        A key of `optloc.models.MODELS`.
    z : array (..., m)
        Measured values, SI units or radians.
    a, b : int array (m,)
        Stations of each row; -1 where the kind takes none.
    epoch : int array (m,)
        Index into the problem's times.
    target : int array (m,)
        Index of the target; -1 for an unlabelled row.
    weight : array (..., m)
        1 for a row as measured, 0 for an absent one; between, its own variance is divided by the weight.
    correction : array (..., m)
        Known amount by which the measurement exceeds the model, for instance refraction.
    """

    kind: str
    z: Array
    a: Array
    b: Array
    epoch: Array
    target: Array
    weight: Array
    correction: Array

    @property
    def count(self) -> int:
        """Return the number of rows."""
        return int(self.a.shape[0])

    @property
    def sense(self) -> float:
        """Return the sign of errors of `z` in reports of biases, residuals and suspects: -1 of compass bearings."""
        return 1.0

    def clockwise(self) -> Rows:
        """Return the same rows as compass bearings, whose errors are reported clockwise, as they were read."""
        return CompassRows(*(getattr(self, one.name) for one in fields(self)))


@dataclass(frozen=True, slots=True)
class CompassRows(Rows):
    """Azimuths that were read clockwise from north: `z` is anticlockwise from the first axis all the same."""

    @property
    def sense(self) -> float:
        """Return -1."""
        return -1.0


@dataclass(frozen=True, slots=True)
class Motion:
    """How one target moves: a polynomial in time over the whole run, or a free state at each epoch, or known.

    Parameters
    ----------
    order : 0, 1 or 2
        Position only; position and velocity; position, velocity and acceleration.
    span : "run" or "epoch"
        One state for the run, or an independent one at every epoch.
    known : array (..., k or 1, order + 1, d), optional
        The target's true state at each epoch (calibration); it is then not estimated.
    reference : float, optional
        Time at which the state of a run holds, seconds; None: the first epoch.
    over : "space" or "ground"
        The course of a run is a polynomial in space, or it follows the Earth: along a great circle with that way, at
        a height that is a polynomial of that order (`optloc.models.course`).
    rise : array (..., k, 2), optional
        Height at each epoch beyond that polynomial, metres, and its rate, metres per second: the known shape of a
        height that was reported. Zero at the reference time.
    """

    order: int = 0
    span: Literal["run", "epoch"] = "run"
    known: Array | None = None
    reference: float | None = None
    over: Literal["space", "ground"] = "space"
    rise: Array | None = None


@dataclass(frozen=True, slots=True)
class Bias:
    """A family of unknown systematic errors that share a name and a form, one per member.

    Parameters
    ----------
    name : str
        Name of the family, for instance "clock".
    members : tuple of q str
        Names of its members, for instance the stations.
    row, member : int array (n,)
        Sparse design: which global rows are touched, and by which member.
    coefficient : float array (n,)
        Sign or size of each touch, for instance +1 for station a and -1 for station b. Of compass bearings -1: their
        bias is clockwise, like the readings.
    form : "offset", "scale", "drift", "rotation", "time", "walk" or "spline"
        Added to the measurement; times the measured quantity; times seconds since the first target's reference time
        (by default the first epoch); or a turn of
        the station's axes (one angle in the plane, a rotation vector in space; a member is then a station's mount); or
        the seconds by which a station is further along its course (coefficient 1 where it is the row's first, -1 where
        it is the second); or added, another value at each epoch: a random walk, or a smooth function of time.
    mean : float array (q,) or (q, c)
        Prior mean, in the unit of the form; of a walk that of its value at the first epoch, of a spline that of each of
        its coefficients, which have the unit of the rows.
    sigma : float array like `mean`, optional
        Prior standard deviation; None: unknown.
    density : float array (q, 1 or 2), optional
        Of a walk: spectral density of the white noise that it is the sum of, unit of the rows squared per second; and
        of that which its rate is the sum of, per second cubed (`optloc.problem.clocks.process`).
    knots : float array (p,), optional
        Of a spline: times between which it is a cubic polynomial, seconds.
    """

    name: str
    members: tuple[str, ...]
    row: Array
    member: Array
    coefficient: Array
    form: FormName = "offset"
    # One zero stands for all members; an array of its own for each bias, for arrays can be written into.
    mean: Array = field(default_factory=lambda: np.zeros(1))
    sigma: Array | None = None
    density: Array | None = None
    knots: Array | None = None


@dataclass(frozen=True, slots=True)
class Band:
    """A quantity of a target that must lie between two values, or equal one.

    Parameters
    ----------
    kind : str
        A key of `optloc.models.surfaces.SURFACES`, for instance "height".
    lower, upper : array (...)
        Bounds in SI units; equal for an equality, infinite for none.
    coefficients : array (..., c)
        What the quantity is made of, for instance the normal of a plane.
    name : str
        How reports call it.
    target : int
        Which target.
    along : bool
        Whether it holds at every epoch of a run, less the known `rise` of a height, or at the reference time alone.
    """

    kind: str
    lower: Array
    upper: Array
    coefficients: Array
    name: str
    target: int = 0
    along: bool = False


@dataclass(frozen=True, slots=True)
class Polygon:
    """A region of the plan (first two coordinates) that must contain a target.

    Parameters
    ----------
    vertices : array (v, 2)
        Corners in order, metres; the polygon is simple, convex or not.
    name : str
        How reports call it.
    target : int
        Which target.
    """

    vertices: Array
    name: str = "polygon"
    target: int = 0


@dataclass(frozen=True, slots=True)
class Prior:
    """Gaussian prior knowledge of one named part of the parameter vector.

    Parameters
    ----------
    name : str
        A slot of the problem's layout, for instance "position".
    mean : array (..., n)
        Mean in SI units.
    covariance : array (..., n, n)
        Covariance.
    """

    name: str
    mean: Array
    covariance: Array


# Verdicts: is there an answer, and how sure is it the best one?


class Status(IntEnum):
    """Whether a fix holds an answer; every member carries a sentence with advice."""

    # The numbers stand in stored studies: a new member takes the next one, none changes.
    OK = 0
    AMBIGUOUS = 1
    SEARCHED = 2
    MAX_ITERATIONS = 3
    STALLED = 4
    SINGULAR_GEOMETRY = 5
    TOO_FEW_ROWS = 6
    INFEASIBLE = 7
    UNBOUNDED = 8
    NUMERICAL = 9
    REJECTED = 10
    UNAVAILABLE = 11
    DISCONNECTED = 12
    CONTRADICTORY = 13
    MISFIT = 14
    UNPROVEN = 15
    CURVED = 16
    UNREFINED = 17
    UNCHECKED = 18
    TAILS = 19
    ROBUST = 20
    RESCALED = 21

    def __str__(self) -> str:
        """Return the label: what `print` shows."""
        return self.label

    def __format__(self, spec: str) -> str:
        """Return the label, or the number where a format asks for one."""
        return format(int(self), spec) if spec else self.label

    @property
    def sentence(self) -> str:
        """Return what happened and what to do about it."""
        return _SENTENCES[self]

    @property
    def label(self) -> str:
        """Return the member's name as people and files spell it, for instance "too few rows"."""
        return self.name.lower().replace("_", " ")

    @property
    def mark(self) -> int:
        """Return the bit that stands for the status where all that applies to a fix is kept in one number."""
        return 1 << int(self)


# The result, then the next step: users read these sentences in every output.
_SENTENCES: dict[Status, str] = {
    Status.OK: "Use it: the residuals fit the stated noise, no other position fits, and the error ellipse is valid.",
    Status.AMBIGUOUS: "Several positions fit the data about equally well; see the alternatives, and add a station, a "
    "measurement or a known height that decides.",
    Status.SEARCHED: "No safe start is known for these kinds of measurements; this is the best position of a seeded "
    "search, and a better one is not excluded.",
    Status.MAX_ITERATIONS: "The iterations did not converge; check units, signs and station positions with "
    "'optloc check'.",
    Status.STALLED: "The refinement stopped before the minimum: its steps no longer lower chi-square, but the gradient "
    "is not zero; check units and noise with 'optloc check'.",
    Status.SINGULAR_GEOMETRY: "The measurements leave one direction of the answer undetermined; add a station in "
    "another direction.",
    Status.TOO_FEW_ROWS: "There are fewer measurements than unknowns; add measurements or fix an unknown.",
    Status.INFEASIBLE: "No position meets the constraints; check their limits.",
    Status.UNBOUNDED: "The target is too far for these stations: the data give a direction and a minimum range; add a "
    "distant station, a bearing or a known height.",
    Status.NUMERICAL: "A solver failed, and the reason names it; check the scale and the units of the input, or choose "
    "another solver.",
    Status.REJECTED: "A measurement is not a finite number; remove the row or give it weight zero.",
    Status.UNAVAILABLE: "The method has no start for these measurements; see the reason, or use 'auto', which accepts "
    "all kinds.",
    Status.DISCONNECTED: "The station pairs form groups without a common station, so no closed form gives a start; use "
    "'auto', which searches, or add a pair that links the groups.",
    Status.CONTRADICTORY: "The measurements contradict each other or the constraints, even without a few of them; "
    "check station positions, clocks, noise levels and bounds.",
    Status.MISFIT: "Do not use it: the residuals are larger than the stated noise allows; run 'optloc check', find the "
    "wrong row with the method 'robust', or correct the noise.",
    Status.UNPROVEN: "The position is refined, but another position is not excluded, as the certificate explains; try "
    "the method 'auto', or accept this status with 'allow'.",
    Status.CURVED: "The position is right, but the error ellipse in metres is not valid; use the fix's chart, its "
    "interval, or optloc.uncertainty.likelihood_region.",
    Status.UNREFINED: "This is the estimate of a start, without refinement and verdict; append '+lsr+certify' to the "
    "method.",
    Status.UNCHECKED: "No redundancy: a wrong measurement would not be noticed; add a station, a measurement or a "
    "known height.",
    Status.TAILS: "Repeats of the measurement confirm the 95 % figures, but not the 99.9 % region.",
    Status.ROBUST: "The rows that keep their weight prove the position; that no other choice of rejected rows explains "
    "the data is searched, not proven.",
    Status.RESCALED: "The fixes of the batch show larger noise than stated; chi-square and covariance use the larger "
    "noise.",
}

PRECEDENCE = (
    # those without a finished answer exclude each other
    Status.REJECTED,
    Status.TOO_FEW_ROWS,
    Status.DISCONNECTED,
    Status.UNAVAILABLE,
    Status.UNREFINED,
    Status.INFEASIBLE,
    Status.NUMERICAL,
    Status.SINGULAR_GEOMETRY,
    Status.STALLED,
    Status.MAX_ITERATIONS,
    Status.CONTRADICTORY,
    # gaps between minima mean nothing under noise that is refuted, and a rival does not close an open region
    Status.MISFIT,
    Status.UNBOUNDED,
    Status.AMBIGUOUS,
    Status.SEARCHED,
    Status.UNPROVEN,
    Status.CURVED,
    Status.OK,
)
"""Which of all that applies to a fix is its status: the first of these."""

NOTES = (Status.UNCHECKED, Status.TAILS, Status.ROBUST, Status.RESCALED)
"""Findings that are never a status: they stand beside one, `ok` included."""

ANSWERED = (
    Status.OK,
    Status.CURVED,
    Status.UNPROVEN,
    Status.SEARCHED,
    Status.AMBIGUOUS,
    Status.UNBOUNDED,
    Status.MISFIT,
)
"""Statuses of fixes that have a position with a covariance, as far as there is a finite one."""

HAS_ANSWER = np.isin(np.arange(1 + max(Status)), ANSWERED)
"""The same by status number: a search takes 30 us, and the text of a fix needs five."""


def first_status(marks: Array) -> Array:
    """Return the statuses (...) of the marks (...) of all that applies; `ok` where nothing but notes does."""
    marks = np.asarray(marks)
    code = np.full(marks.shape, int(Status.OK), dtype=np.int8)
    anywhere = int(np.bitwise_or.reduce(marks, axis=None))  # few statuses occur in a batch
    for status in reversed(PRECEDENCE):
        if anywhere & status.mark:
            code[marks & status.mark != 0] = int(status)
    return code


def statuses_of(code: Array) -> Array:
    """Return the members (...), objects, of status numbers (...)."""
    numbers = np.asarray(code, dtype=np.intp)
    out = np.empty(numbers.shape, dtype=object)
    for number in np.unique(numbers):
        out[numbers == number] = Status(int(number))
    return out


@dataclass(frozen=True, slots=True)
class Certificate:
    """How sure it is that a fix is the best one.

    Parameters
    ----------
    proof : "global", "region", "local" or "unknown"
        What has been proven about the maximum-likelihood cost: no position costs less, none of a region does, none
        nearby does, or nothing.
    reason : str
        What is claimed in a sentence, and why it is this and not more.
    method : str
        What was done to find out.
    bound : float
        Lower bound of the maximum-likelihood cost over all positions, or over the region; NaN where none was computed.
    gap : float
        Cost less bound.
    unique : bool
        Whether it is proven too that no other minimum costs less than `margin` more, but for listed alternatives;
        otherwise other minima were searched for, not excluded.
    margin : float
        Cost beyond that of the fix below which no other minimum is left; 0 where uniqueness is not proven.
    boxes : int
        How many boxes a proof by branch and bound looked at; where it was not finished, in all attempts.
    region : tuple of (lower, upper), optional
        Corners of the region of the claim, each d coordinates in the problem's frame, metres.
    asked : bool
        Whether the claim is limited to that region because somebody asked for it, not because more could not be proven.
    """

    proof: str
    reason: str
    method: str
    bound: float = float("nan")
    gap: float = float("nan")
    unique: bool = False
    margin: float = 0.0
    boxes: int = 0
    region: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    asked: bool = False

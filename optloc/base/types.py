"""Data types of a problem, its status and its certificate: frozen, in SI units and radians, batch axes first.

Letters: s stations, k epochs, m rows, d coordinates, q members of a bias, n entries of a named part. Leading axes `...`
count the problems of a batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Any, Literal

import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]

Whole = int | Sequence[int] | Array
"""One whole number, or one for each row."""

Amount = float | str
"""A number in SI units, or text with a unit such as "20 ns"."""

Amounts = Amount | Sequence[Amount] | Sequence[Sequence[float]] | Array
"""Numbers in SI units, or texts with a unit, of any shape."""
FormName = Literal["offset", "scale", "drift", "rotation", "time", "walk", "spline"]
"""Names of the forms of a `Bias`, for type checkers: the keys of `optloc.problem.forms.FORMS`."""


@dataclass(frozen=True, slots=True)
class Stations:
    """Positions, velocities, axes and position errors of stations.

    Parameters
    ----------
    position : array (..., k or 1, s, d)
        Metres, in the frame of the problem. The epoch axis has length one for fixed stations.
    names : tuple of s str
        Unique names.
    velocity : array (..., k or 1, s, d), optional
        Metres per second.
    axes : array (..., k or 1, s, d, d), optional
        Axes of each station in the frame of the problem: the rows of each matrix are unit vectors. None: the axes of
        the frame.
    covariance : array (..., s, d, d), optional
        Covariance of the position errors, square metres; None: surveyed exactly.
    span : "epoch", "run" or "noise"
        How the errors of positions and velocities are treated. "epoch": as unknowns of each epoch. "run": as unknowns
        of the whole run. "noise": they are not estimated, are independent at each epoch, and add to the noise of all
        rows of the station.
    velocity_covariance : array (..., s, d, d), optional
        Covariance of the velocity errors, (m/s)^2, independent of the position errors. None: velocities are exact.
        These errors matter for kinds that depend on velocities: range rates and their differences.
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
        """Return name, SI unit and covariance (..., s, d, d) of the existing errors, in the order of their slots."""
        both = (("stations", "m", self.covariance), ("station velocities", "m/s", self.velocity_covariance))
        return tuple((name, unit, covariance) for name, unit, covariance in both if covariance is not None)

    @property
    def unknown_for(self) -> Literal["epoch", "run"] | None:
        """Return the span of errors that are unknowns; None for errors treated as noise, and for exact stations."""
        return self.span if self.span != "noise" and self.errors else None

    @property
    def weighed(self) -> bool:
        """Return whether errors of positions or velocities are treated as noise of each epoch."""
        return self.span == "noise" and bool(self.errors)

    @property
    def isotropic(self) -> bool:
        """Return whether the errors of each position are equally large in all directions."""
        if self.covariance is None:
            return True
        # A relative tolerance of 1e-9, because variances can come from unit conversions.
        equal = np.eye(self.dimension) * self.covariance[..., :1, :1]
        return bool((np.abs(self.covariance - equal) <= 1e-9 * equal).all())

    def with_noise(self) -> Stations:
        """Return the stations with errors of span "epoch" changed to noise, because no other epoch shares them.

        The errors then need no unknowns.
        """
        return replace(self, span="noise") if self.unknown_for == "epoch" else self

    @property
    def dimension(self) -> int:
        """Return the dimension, 2 or 3."""
        return int(self.position.shape[-1])

    @property
    def count(self) -> int:
        """Return the number of stations."""
        return int(self.position.shape[-2])

    @property
    def places(self) -> Array:
        """Return all positions of the stations at all epochs, (..., k * s, d)."""
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
        Station numbers of each row; -1 if the kind does not use the station.
    epoch : int array (m,)
        Index into the problem's times.
    target : int array (m,)
        Index of the target; -1 for an unlabelled row.
    weight : array (..., m)
        1 for a present row, 0 for an absent one. For values between, the variance of the row is divided by the weight.
    correction : array (..., m)
        Known error of the measurement (measured minus modelled), for instance refraction.
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
        """Return the sign of errors of `z` in reports: -1 for compass bearings, whose errors count clockwise, or 1."""
        return 1.0

    def clockwise(self) -> Rows:
        """Return the same rows as compass bearings, whose errors are reported clockwise, like the readings."""
        return CompassRows(*(getattr(self, one.name) for one in fields(self)))


@dataclass(frozen=True, slots=True)
class CompassRows(Rows):
    """Azimuths that were read clockwise from north. As in `Rows`, `z` is anticlockwise from the first axis."""

    @property
    def sense(self) -> float:
        """Return -1, because errors of compass bearings count clockwise in reports and `z` counts anticlockwise."""
        return -1.0


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion model of one target: a polynomial in time over the run, a free state at each epoch, or a known motion.

    Parameters
    ----------
    order : 0, 1 or 2
        Position only; position and velocity; position, velocity and acceleration.
    span : "run" or "epoch"
        One state for the run, or an independent state at each epoch.
    known : array (..., k or 1, order + 1, d), optional
        Known true state of the target at each epoch, for calibration. It is then not estimated.
    reference : float, optional
        Reference time of the state of a run, seconds. None: the first epoch.
    over : "space" or "ground"
        "space": the course is a polynomial in space. "ground": it follows the Earth. The way along a great circle and
        the height are then polynomials in time (`optloc.models.course`).
    rise : array (..., k, 2), optional
        Known height profile: height above the polynomial at each epoch, metres, and its rate, metres per second. It
        comes from reported heights and is zero at the reference time.
    """

    order: int = 0
    span: Literal["run", "epoch"] = "run"
    known: Array | None = None
    reference: float | None = None
    over: Literal["space", "ground"] = "space"
    rise: Array | None = None


@dataclass(frozen=True, slots=True)
class Bias:
    """A family of unknown systematic errors with a common name and form, one error per member.

    Parameters
    ----------
    name : str
        Name of the family, for instance "clock".
    members : tuple of q str
        Names of the members, for instance the stations.
    row, member : int array (n,)
        Sparse design matrix: global numbers of the affected rows, and the numbers of the members that affect them.
    coefficient : float array (n,)
        Coefficient of each entry, for instance +1 for station a and -1 for station b. It is -1 for compass bearings,
        because their bias is clockwise like the readings.
    form : "offset", "scale", "drift", "rotation", "time", "walk" or "spline"
        How the error enters the measurement. "offset": it is added. "scale": it is multiplied by the measured quantity.
        "drift": it is multiplied by the seconds since the reference time of the first target (default: the first
        epoch). "rotation": it turns the axes of the station, by one angle in the plane or a rotation vector in space;
        each member is one station, or a group of stations that turn together. "time": the station is ahead on its
        course by this number of seconds (coefficient 1 for the first station of the row, -1 for the second). "walk": an
        added error that is a random walk over the epochs. "spline": an added error that is a smooth function of time.
    mean : float array (q,) or (q, c)
        Prior mean, in the unit of the form. For a walk it applies to the value at the first epoch. For a spline it
        applies to each coefficient, in the unit of the rows.
    sigma : float array like `mean`, optional
        Prior standard deviation. None: there is no prior.
    density : float array (q, 1 or 2), optional
        For a walk: spectral density of the white noise that drives the error, squared unit of the rows per second; and
        of the white noise that drives its rate, per second cubed (`optloc.problem.clocks.process`).
    knots : float array (p,), optional
        For a spline: times of the knots, seconds. Between two knots it is a cubic polynomial.
    """

    name: str
    members: tuple[str, ...]
    row: Array
    member: Array
    coefficient: Array
    form: FormName = "offset"
    # A single zero applies to all members. Each bias gets a new array, because arrays are writable.
    mean: Array = field(default_factory=lambda: np.zeros(1))
    sigma: Array | None = None
    density: Array | None = None
    knots: Array | None = None


@dataclass(frozen=True, slots=True)
class Band:
    """A constraint: a quantity of a target must be between two values, or equal to one.

    Parameters
    ----------
    kind : str
        A key of `optloc.models.surfaces.SURFACES`, for instance "height".
    lower, upper : array (...)
        Bounds in SI units; equal for an equality, infinite for no bound.
    coefficients : array (..., c)
        Parameters of the quantity, for instance the normal of a plane.
    name : str
        Name in reports.
    target : int
        Number of the target.
    along : bool
        Whether the constraint applies at every epoch of a run (for a height, minus its known `rise`), or at the
        reference time only.
    other : int, optional
        Number of a second target, for a quantity of two targets.
    table : object, optional
        Immutable data of the quantity that are no coefficients, for instance a grid of heights. It needs a property
        `digest` that differs for different data.
    """

    kind: str
    lower: Array
    upper: Array
    coefficients: Array
    name: str
    target: int = 0
    along: bool = False
    other: int | None = None
    table: Any = None


@dataclass(frozen=True, slots=True)
class Polygon:
    """A constraint: a polygon in the horizontal plane (first two coordinates) that contains the target.

    Parameters
    ----------
    vertices : array (v, 2)
        Corners in order, metres. The polygon is simple; it need not be convex.
    name : str
        Name in reports.
    target : int
        Number of the target.
    outside : bool
        Whether the target is outside the polygon instead.
    """

    vertices: Array
    name: str = "polygon"
    target: int = 0
    outside: bool = False


@dataclass(frozen=True, slots=True)
class AnyOf:
    """A constraint: a union of regions, of which at least one contains the target.

    Parameters
    ----------
    members : tuple of tuples of Band
        The regions. Each is a conjunction: a target is in it if it satisfies all of its bands.
    name : str
        Name in reports.
    target : int
        Number of the target.
    """

    members: tuple[tuple[Band, ...], ...]
    name: str = "any of"
    target: int = 0


Constraint = Band | Polygon | AnyOf
"""A condition that an answer must meet."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Gaussian prior of one named part of the parameter vector.

    Parameters
    ----------
    name : str
        A slot of the problem's layout, for instance "position".
    mean : array (..., n)
        Mean in SI units.
    covariance : array (..., n, n)
        Covariance, squared SI units.
    """

    name: str
    mean: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class Fence:
    """A half-plane that contains the target, with an uncertain boundary: ``n . x <= b + N(0, s^2)``.

    It is no constraint: it adds ``-2 log Phi((b - n . x) / s)`` to the cost, where Phi is the normal distribution
    function.

    Parameters
    ----------
    normal : array (..., d)
        Unit normal n, directed out of the half-plane.
    offset : array (...)
        Stated place b of the boundary along the normal, metres.
    sigma : array (...)
        Standard deviation s of this place, metres.
    name : str
        Name in reports.
    target : int
        Number of the target. Of a moving target, the position at the reference time counts.
    """

    normal: Array
    offset: Array
    sigma: Array
    name: str = "fence"
    target: int = 0


# Status: is there an answer? Certificate: is it the best one?


class Status(IntEnum):
    """Status or finding of a fix. Every member has a sentence with advice."""

    # The numbers are stored with studies: a new member gets the next number, and no number changes.
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
        """Return the label, which `print` shows."""
        return self.label

    def __format__(self, spec: str) -> str:
        """Return the label, or the number if the format specification is for a number."""
        return format(int(self), spec) if spec else self.label

    @property
    def sentence(self) -> str:
        """Return a sentence about the result, with advice."""
        return _SENTENCES[self]

    @property
    def label(self) -> str:
        """Return the name as users and files write it, for instance "too few rows"."""
        return self.name.lower().replace("_", " ")

    @property
    def mark(self) -> int:
        """Return the bit of this status in the `marks` of a fix, which store all its findings in one integer."""
        return 1 << int(self)


# Each sentence states first what happened, then what helps. Users read it without any code.
_SENTENCES: dict[Status, str] = {
    Status.OK: "Use it: the residuals fit the stated noise, no other solution fits, and the error ellipse is valid.",
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
    Status.UNPROVEN: "The position is refined, but another position is not excluded, as the reason states; add "
    "measurements or a box around the target, or accept this status with 'allow'.",
    Status.CURVED: "The position is right, but the error ellipse in metres is not valid; use the fix's chart, its "
    "interval, or optloc.uncertainty.likelihood_region.",
    Status.UNREFINED: "This estimate is not refined or judged; append '+lsr+certify' to the method, or for a pose use "
    "refine=True or a constraint of optloc.constraints.",
    Status.UNCHECKED: "No redundancy: a wrong measurement would not be noticed; add a station, a measurement or a "
    "known height.",
    Status.TAILS: "Repeats of the measurement confirm the 95 % figures, but not the 99.9 % region.",
    Status.ROBUST: "The rows that keep their weight prove the position; that no other choice of rejected rows explains "
    "the data is searched, not proven.",
    Status.RESCALED: "The fixes of the batch show larger noise than stated; chi-square and covariance use the larger "
    "noise.",
}

PRECEDENCE = (
    # Statuses without a finished answer exclude each other.
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
    # If the stated noise is refuted, cost gaps between minima have no meaning. An alternative does not close an open
    # region.
    Status.MISFIT,
    Status.UNBOUNDED,
    Status.AMBIGUOUS,
    Status.SEARCHED,
    Status.UNPROVEN,
    Status.CURVED,
    Status.OK,
)
"""Statuses in the order of precedence: the first among the findings of a fix is its status."""

NOTES = (Status.UNCHECKED, Status.TAILS, Status.ROBUST, Status.RESCALED)
"""Findings that are never the status. They occur together with any status, including `ok`."""

ANSWERED = (
    Status.OK,
    Status.CURVED,
    Status.UNPROVEN,
    Status.SEARCHED,
    Status.AMBIGUOUS,
    Status.UNBOUNDED,
    Status.MISFIT,
)
"""Statuses of fixes that have a position with a covariance, if these are finite."""

HAS_ANSWER = np.isin(np.arange(1 + max(Status)), ANSWERED)
"""The same as an array by status number, because a search in a tuple takes 30 us and the text of a fix only five."""


def first_status(marks: Array) -> Array:
    """Return the status numbers (...) of findings `marks` (...); `ok` if the marks contain notes only.

    The marks of a fix are the sum of `Status.mark` over its findings. The status is the first of them in `PRECEDENCE`.
    """
    marks = np.asarray(marks)
    code = np.full(marks.shape, int(Status.OK), dtype=np.int8)
    anywhere = int(np.bitwise_or.reduce(marks, axis=None))  # a batch has few different statuses
    for status in reversed(PRECEDENCE):
        if anywhere & status.mark:
            code[marks & status.mark != 0] = int(status)
    return code


def statuses_of(code: Array) -> Array:
    """Return an object array (...) of `Status` members for status numbers (...)."""
    numbers = np.asarray(code, dtype=np.intp)
    out = np.empty(numbers.shape, dtype=object)
    for number in np.unique(numbers):
        out[numbers == number] = Status(int(number))
    return out


@dataclass(frozen=True, slots=True)
class Certificate:
    """How far it is proven that a fix has the least cost of all positions.

    Parameters
    ----------
    proof : "global", "region", "local" or "unknown"
        Region in which no position has a lower maximum-likelihood cost: everywhere, a box, or near the fix. "unknown":
        nothing is proven.
    reason : str
        A sentence that states what is proven, and why not more.
    method : str
        Method of the proof or of the search.
    bound : float
        Lower bound of the maximum-likelihood cost over all positions, or over the region; NaN if it was not computed.
    gap : float
        Cost minus bound.
    unique : bool
        Whether it is also proven that every other minimum, except listed alternatives, costs at least `margin` more.
        If not, other minima were searched for, but are not excluded.
    margin : float
        Proven difference between the cost of other minima and the cost of the fix; 0 if uniqueness is not proven.
    boxes : int
        Number of boxes that branch and bound examined; for an unfinished proof, the sum over all attempts.
    region : tuple of (lower, upper), optional
        Corners of the region of the proof, each d coordinates in the frame of the problem, metres.
    asked : bool
        Whether the proof is limited to this region on request, and not because a larger proof failed.
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

"""The answer: estimate, covariance, verdict and the other positions that the data allow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, cast

import numpy as np

from optloc.base.errors import InvalidProblem, NoSolution, status_named, too_weak, whole_redundancy
from optloc.base.frames import Frame
from optloc.base.records import Axes, change
from optloc.base.types import HAS_ANSWER, NOTES, PRECEDENCE, Array, Certificate, Status, statuses_of
from optloc.problem.chart import CARTESIAN, Chart, Extent, tail_probability
from optloc.problem.claims import Claims
from optloc.problem.determined import Determined
from optloc.problem.explanations import Suspect
from optloc.problem.layout import Layout
from optloc.problem.problem import Problem
from optloc.problem.state_order import components, in_order

if TYPE_CHECKING:
    import pandas as pd

TOLD = 0.95  # level up to which the regions of a fix with the finding `tails` hold
_STATES = ("position", "velocity", "acceleration")
# Sizes of stations and target together, beyond which a standard deviation of a position says nothing: a fix is not
# Gaussian from one on, and what symmetry leaves open is wider by many decades.
_OPEN = 100.0
# The same of all else, by SI unit, and of positions whose stations are not known: light, turns, a hundredfold error of
# scale, and for lengths the distance of the outer planets.
_OPEN_BY_UNIT = {"m/s": 299_792_458.0, "m/s^2": 299_792_458.0, "rad": 1e3, "1": 100.0, "s": 1e4}
_OPEN_LENGTH = 1e12


@dataclass(frozen=True, slots=True)
class Stage:
    """One step on the way to a fix.

    Parameters
    ----------
    name : str
        Method, for instance "gtrs" or "lsr".
    detail : str
        What it did, in a few words.
    seconds : float
        Wall-clock time for the whole batch.
    """

    name: str
    detail: str
    seconds: float


@dataclass(frozen=True, slots=True)
class Active:
    """A constraint that holds a fix with equality.

    Parameters
    ----------
    name : str
        Constraint and side, for instance "height upper".
    multiplier : float
        The gradient of the cost plus all multipliers times the gradients of their quantities is zero: positive at
        an upper bound, negative at a lower one, in cost per SI unit of the quantity.
    """

    name: str
    multiplier: float


@dataclass(frozen=True, slots=True)
class Alternatives:
    """Other minima of the cost that were found, cheapest first.

    Parameters
    ----------
    x : array (..., q, size)
        Parameter vectors; NaN where there is none.
    gap : array (..., q)
        Their cost less the cost of the fix; infinite where there is none.
    """

    x: Annotated[Array, Axes(2, slots=True)]
    gap: Annotated[Array, Axes(1, slots=True, empty=np.inf)]

    @property
    def doubt(self) -> Array:
        """Return the probability (..., q) that an alternative is the right one, if it is this one or the fix.

        Each is as likely before the measurement, and the data then weigh them by exp(-cost / 2).
        """
        from scipy.special import expit

        return np.asarray(expit(-0.5 * self.gap))


Index: TypeAlias = int | np.integer[Any] | slice | list[int] | Array | tuple[int | slice | Array, ...]
"""Chooses some fixes of a batch, as NumPy does."""


@dataclass(frozen=True, slots=True, repr=False)
class Fix:
    """Estimates of a batch of problems; a single problem has no leading axes.

    Parameters
    ----------
    x : array (..., size)
        Parameter vector in the order of `layout`; NaN where there is no answer.
    cov : array (..., n, n)
        Covariance of the shared unknowns; NaN where it does not exist.
    layout : Layout
        What each entry means.
    frame : Frame
        What the coordinates mean.
    code : int array (...)
        `Status` numbers.
    reason : object array (...)
        Sentence that belongs to the status: the direction, the groups, the count.
    claims : Claims
        What is proven of each, in columns; see `certificate`.
    alternatives : Alternatives
        Other minima.
    cost : array (...)
        Weighted sum of squared residuals, chi-square distributed if the model is right.
    dof : int array (...)
        Degrees of freedom, or redundancy: rows present less unknowns without a prior. See `unchecked`.
    weights : array (..., m)
        Row weights that were used.
    stages : tuple of Stage
        How it was found.
    active : object array (...), optional
        Constraints that hold each fix with equality, a tuple of `Active`.
    local : array (..., k, p, p), optional
        Covariance of the states that targets have at each epoch of a run, in the order of the layout; NaN where an
        epoch leaves them open.
    explanations : object array (...), optional
        Where the data contradict each other, a tuple of `Explanation`: all that come within the gap of the best, which
        is the first and was taken; an empty tuple elsewhere. None where nobody asked.
    marks : int array (...), optional
        All that applies to each fix, a bit for each `Status`; see `findings`.
    chart : Chart, optional
        In which coordinates each is Gaussian; None for problems that are not of one position.
    infinity : array (...), optional
        Least cost of positions infinitely far away less that of the fix; NaN where nobody has looked.
    reach : array (...), optional
        Greatest distance of a station, and of a target without a chart, from the middle of the stations, metres.
    labels : array (...), optional
        Labels of the fixes, such as the index of the data frame that they come from.
    source : object array (...), optional
        A `Source` for `determined`; None for fixes that are `ok`, and where many are not.
    """

    x: Annotated[Array, Axes(1)]
    cov: Annotated[Array, Axes(2)]
    layout: Layout
    frame: Frame
    code: Annotated[Array, Axes(0)]
    reason: Annotated[Array, Axes(0, empty="")]
    claims: Claims
    alternatives: Alternatives
    cost: Annotated[Array, Axes(0)]
    dof: Annotated[Array, Axes(0)]
    weights: Annotated[Array, Axes(1, slots=True, empty=0.0)]
    stages: tuple[Stage, ...] = ()
    active: Annotated[Array, Axes(0, empty=())] | None = None
    local: Annotated[Array, Axes(3)] | None = None
    explanations: Annotated[Array, Axes(0, empty=())] | None = None
    marks: Annotated[Array, Axes(0, empty=0)] | None = None
    chart: Chart | None = None
    infinity: Annotated[Array, Axes(0)] | None = None
    reach: Annotated[Array, Axes(0)] | None = None
    source: Annotated[Array, Axes(0, empty=None)] | None = None
    labels: Annotated[Array, Axes(0, empty=None)] | None = None
    # told once: a program may ask for one after the other
    _certificates: list[Array] = field(default_factory=list, init=False, repr=False, compare=False)

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the batch axes; () for a single fix."""
        return tuple(self.x.shape[:-1])

    @property
    def status(self) -> Status:
        """Return the status of a single fix; raise InvalidProblem for a batch, which has `statuses`."""
        if self.shape:
            advice = "use fix.statuses, or the status of one of them: fix[i].status"
            raise InvalidProblem(f"these are fixes of shape {self.shape}", "status", advice)
        return Status(int(self.code))

    @property
    def statuses(self) -> Array:
        """Return the statuses (...), an array of `Status`."""
        return statuses_of(self.code)

    @property
    def certificate(self) -> Certificate:
        """Return the certificate of a single fix; of a batch the same as `certificates`."""
        return cast("Certificate", self.certificates[()])

    @property
    def certificates(self) -> Array:
        """Return the certificates (...), an object array of `Certificate`."""
        if not self._certificates:
            self._certificates.append(self.claims.tell())
        return self._certificates[0]

    @property
    def position(self) -> Array:
        """Return the position (..., d) of the only unknown target, or of each epoch (..., k, d), metres."""
        return self.take("position")

    @property
    def velocity(self) -> Array:
        """Return the velocity like `position`, metres per second."""
        return self.take("velocity")

    def take(self, name: str) -> Array:
        """Return a named part of the estimate, for instance "position[1]" or "clock"."""
        return self.layout.take(self.x, self._slot(name))

    def _slot(self, name: str) -> str:
        """Return the name of a part: "position" is that of the only target whose place is not known beforehand."""
        slots = [slot.name for slot in (*self.layout.shared, *self.layout.local)]
        numbered = [slot for slot in slots if slot.partition("[")[0] == name]
        return numbered[0] if name in _STATES and len(numbered) == 1 else name

    def state(self, order: str = "") -> tuple[Array, Array]:
        """Return mean (..., m) and covariance (..., m, m) of the state [p, v, a] of the only unknown target.

        Parameters
        ----------
        order : str
            Names of components in another order, such as "x vx y vy"; all of x y z vx vy vz ax ay az by default.
        """
        parts = [self._slot(name) for name in _STATES]
        slots = [slot for slot in self.layout.shared if slot.name in parts]
        index = np.concatenate([np.arange(slot.start, slot.start + slot.size) for slot in slots])
        mean, cov = self.x[..., index], self.cov[..., index[:, None], index]
        d = slots[0].size
        return in_order(order or components(d, len(index)), d, mean, cov)

    @property
    def bias(self) -> Mapping[str, Array]:
        """Return the estimates of everything that is not the state of a target, by name."""
        names = (slot.name for slot in (*self.layout.shared, *self.layout.local))
        return {name: self.take(name) for name in names if name.partition("[")[0] not in _STATES}

    def members(self, name: str) -> tuple[str, ...]:
        """Return what the entries of a named part are called, for instance the stations of "clock"."""
        return self.layout.find(name)[0].entries

    def covariance(self, name: str = "position") -> Array:
        """Return the covariance of a named part: (..., q, q), or (..., k, q, q) of a state at each epoch."""
        slot, shared = self.layout.find(self._slot(name))
        part = slice(slot.start, slot.start + slot.size)
        if shared:
            return self.cov[..., part, part]
        if self.local is None or slot.start + slot.size > self.local.shape[-1]:
            raise InvalidProblem(
                f"{name} is an unknown of each epoch whose covariance is not kept", name, "ask for others"
            )
        return self.local[..., part, part]

    def sigma(self, name: str = "position") -> Array:
        """Return the standard deviations of a named part: (..., q), or (..., k, q) of a state at each epoch."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance(name), axis1=-2, axis2=-1)))

    def undetermined(self, name: str = "position") -> Array:
        """Return a mark for each entry (..., q) of a named part that the data do not determine.

        The standard deviation of such an entry is more than 100 times the size of stations and target together, that of
        a speed more than the speed of light. Symmetry causes such entries, such as the height of a target in the plane
        of the stations. Tables and texts call them "not determined".

        Parameters
        ----------
        name : str
            Part of the estimate, as of `sigma`.
        """
        sigma, limit = self.sigma(name), self.widest(name)
        with np.errstate(invalid="ignore"):
            return np.asarray(sigma > limit.reshape(*limit.shape, *(1,) * (sigma.ndim - limit.ndim)))

    def widest(self, name: str = "position") -> Array:
        """Return the standard deviation (...) beyond which entries of a named part are not determined, SI units."""
        slot, _ = self.layout.find(self._slot(name))
        limit = np.full(self.shape, _OPEN_BY_UNIT.get(slot.unit, _OPEN_LENGTH))
        if slot.name.partition("[")[0] != "position" or self.reach is None:
            return limit
        away = 0.0 if self.chart is None else np.nan_to_num(self.chart.distance)
        size = np.nan_to_num(self.reach) + away
        # a single station that stays has no size, and a target on it no distance
        return np.where(size > 0.0, _OPEN * size, limit)

    @property
    def p_value(self) -> Array:
        """Return the probability (...) of a cost at least this large if the model is right; NaN without redundancy."""
        return tail_probability(self.cost, self.dof)

    @property
    def geodetic(self) -> tuple[Array, Array, Array]:
        """Return latitude, longitude (radians) and ellipsoidal height (metres) of the position."""
        return self.frame.to_geodetic(self.position)

    @property
    def latlon(self) -> Array:
        """Return latitude and longitude (degrees) and ellipsoidal height (metres) of the position, (..., 3)."""
        lat, lon, height = self.geodetic
        return np.stack([np.degrees(lat), np.degrees(lon), height], axis=-1)

    def ellipse(self, probability: float = 0.95) -> tuple[Array, Array]:
        """Return the error ellipse or ellipsoid of the position.

        Parameters
        ----------
        probability : float
            Probability that it contains the target.

        Returns
        -------
        semi_axes : array (..., d)
            Lengths in metres, ascending.
        directions : array (..., d, d)
            Unit vectors of the axes in columns.
        """
        from scipy.special import gammaincinv

        cov = self.covariance()
        known = np.asarray(np.isfinite(cov).all((-1, -2)))
        values, vectors = np.linalg.eigh(np.where(known[..., None, None], cov, 0.0))
        scale = np.sqrt(2.0 * gammaincinv(cov.shape[-1] / 2, probability))
        axes = scale * np.sqrt(np.maximum(values, 0.0))
        return np.where(known[..., None], axes, np.nan), np.where(known[..., None, None], vectors, np.nan)

    def __repr__(self) -> str:
        """Return what the command line shows of a fix; of a batch how many have which status."""
        return str(_TELLER[0]().text_of(self)) if _TELLER else object.__repr__(self)

    def _repr_html_(self) -> str:
        """Return the same as HTML, for notebooks."""
        return str(_TELLER[0]().html_of(self)) if _TELLER else ""

    @property
    def determined(self) -> Determined | None:
        """Return the `Determined` of a single fix: directions, ranges and curves that the data know in its status.

        It is computed when it is read. None where the problem is not at hand, as in batches with many refused fixes:
        `optloc.model_checks.determined(problem, fix)` returns it then.
        """
        return cast("Determined | None", _TELLER[0]().determined_of(self))

    def to_dict(self) -> dict[str, object]:
        """Return the fix as plain numbers, texts and lists, ready for JSON.

        Returns
        -------
        dict
            Status, position, sigma, covariance, alternatives, certificate and more by name, as ``optloc fix --json``
            has them: metres and degrees, None where there is no number. Of a batch ``{"fixes": [...]}``.
        """
        return dict(_TELLER[0]().dict_of(self))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a data frame with one row for each fix (and target, and epoch), as ``optloc fix --out`` writes.

        Its index comes from the data frame of the measurements, see `labels`.

        Raises
        ------
        InvalidProblem
            Where pandas is not installed.
        """
        return cast("pd.DataFrame", _TELLER[0]().frame_of(self))

    def to_geojson(self, problem: Problem | None = None) -> dict[str, object]:
        """Return positions and what holds 95 % as a GeoJSON feature collection (RFC 7946).

        Parameters
        ----------
        problem : Problem, optional
            What was solved: its stations are features, too, and so is a curved region.

        Raises
        ------
        InvalidProblem
            For positions that are not on Earth.
        """
        return dict(_TELLER[0]().geojson_of(self, problem))

    def gaussian(self) -> tuple[Array, Array]:
        """Return mean (..., n) and covariance (..., n, n), cut off by bounds, of the unknowns: a start of a tracker."""
        mean, cov = self.x[..., : self.layout.n_shared], self.cov
        if self.chart is not None and self.chart.truncated is not None:
            mean = self.chart.mean_of(mean, cov, self.layout.find("position")[0].start)
        if self.chart is not None and self.chart.inflation is not None:
            cov = cov * self.chart.inflation[..., None, None]
        return mean, cov

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Return what was left out of a single fix; of a batch an object array (...) of such tuples.

        They are those of the first of `explanations`: where there are several, others are suspected as much.
        """
        out = np.empty(self.shape, dtype=object)
        for i in np.ndindex(self.shape):
            found = () if self.explanations is None else self.explanations[i]
            out[i] = found[0].suspects if found else ()
        return cast("tuple[Suspect, ...]", out[()])

    @property
    def answered(self) -> Array:
        """Return where there is a position with a covariance, whatever stands against it, (...)."""
        # that of a run to infinity has none
        return HAS_ANSWER[self.code] & np.isfinite(self.x).any(-1)

    def has(self, *statuses: Status) -> Array:
        """Return where one of some statuses is among the findings, (...)."""
        return np.asarray((self._all_marks & sum({one.mark for one in statuses})) != 0)

    @property
    def unchecked(self) -> Array | bool:
        """Return the mask (...) of answered fixes without redundancy, which every measurement fits; a bool of one."""
        out = np.asarray(self.answered & (self.dof <= 0))
        return bool(out) if self.shape == () else out

    @property
    def _all_marks(self) -> Array:
        # a fix of a solver from outside may have a status alone
        marks = np.left_shift(1, self.code.astype(np.int32)) if self.marks is None else self.marks
        return np.asarray(marks | np.where(self.unchecked, Status.UNCHECKED.mark, 0))

    @property
    def findings(self) -> tuple[Status, ...]:
        """Return all that stands against a single fix; of a batch an object array (...) of such tuples.

        The most serious comes first: it is the status. Notes come last: an `ok` fix has nothing but these, `unchecked`
        where it has no redundancy.
        """
        # Many fixes have few different sets of findings.
        marks, index = np.unique(self._all_marks, return_inverse=True)
        sets = np.empty(len(marks), dtype=object)
        for i, found in enumerate(marks.tolist()):
            sets[i] = tuple(one for one in (*PRECEDENCE, *NOTES) if one is not Status.OK and found & one.mark)
        return cast("tuple[Status, ...]", sets[index.reshape(self.shape)] if self.shape else sets[0])

    def covers(self, points: Array, level: float = 0.95) -> Array:
        """Return whether points lie in the regions that hold the target with a given probability.

        Parameters
        ----------
        points : array (..., d)
            Metres; they broadcast against the fixes, (q, d) for one fix and (q, N, d) for N.
        level : float
            Probability that the region of a fix contains the target.

        Returns
        -------
        bool array (...)
            By the Gaussian in the coordinates where it covers, see `chart`.

        Raises
        ------
        InvalidProblem
            Where no Gaussian covers: `optloc.uncertainty.likelihood_region` shows what does.
        """
        return self._gaussian_chart(level).covers(points, level)

    def interval(self, extent: Extent, level: float = 0.95) -> tuple[Array, Array]:
        """Return the ends (...) of an interval that holds one number of the target.

        Parameters
        ----------
        extent : "range", "bearing", "elevation", "height", "x", "y" or "z"
            Seen from the middle of the stations; metres or radians, see `optloc.problem.chart.Chart.interval`.
        level : float
            Probability that the interval contains it.

        Raises
        ------
        InvalidProblem
            Where no Gaussian covers: `optloc.uncertainty.likelihood_region` shows what does.
        """
        return self._gaussian_chart(level).interval(extent, level)

    def _gaussian_chart(self, level: float) -> Chart:
        if self.chart is None:
            raise InvalidProblem("a fix that is not of one position has no chart", "fix", "see its covariance")
        if level > TOLD and bool((self.has(Status.TAILS) & (self.chart.kind == CARTESIAN)).any()):
            told = f"some regions hold at {TOLD:g} but not at {level:g}"
            raise InvalidProblem(told, "level", "take fixes without the finding 'tails'")
        return self.chart

    def require(self, allow: Iterable[Status | str] = (), *, redundancy: int = 0, level: float = 0.95) -> Fix:
        """Return the fix if every status in it is `ok` or allowed; raise NoSolution with the first that is not.

        Parameters
        ----------
        allow : iterable of Status or str
            What passes beside `ok`, for instance ``("curved", "unproven")``.
        redundancy : int
            Least degrees of freedom of a fix that passes: with 1 a wrong measurement is noticed, 0 passes `unchecked`.
        level : float
            Probability that regions must hold. Above 0.95 a fix with the finding `tails` does not pass.

        Raises
        ------
        NoSolution
            With the first fix of another status, of less redundancy, or with `tails`.
        InvalidProblem
            For an unknown status or a redundancy that is no whole number.
        """
        wanted = whole_redundancy(redundancy)
        passing = [Status.OK, *(one if isinstance(one, Status) else status_named(one) for one in allow)]
        bad = np.flatnonzero(~np.isin(np.ravel(self.code), passing))
        if len(bad):
            raise NoSolution(None, self.flat()[int(bad[0])])
        weak = np.flatnonzero(np.ravel(self.dof) < wanted)
        if len(weak):
            raise NoSolution(None, self.flat()[int(weak[0])], too_weak(self, weak, wanted))
        if level > TOLD and len(tails := np.flatnonzero(np.ravel(self.has(Status.TAILS)))):
            raise NoSolution(None, self.flat()[int(tails[0])], Status.TAILS.sentence)
        return self

    def flat(self) -> Fix:
        """Return the same fixes with exactly one batch axis."""
        return self.reshape((self.code.size,))

    def reshape(self, shape: tuple[int, ...]) -> Fix:
        """Return the fixes of a flat batch with other batch axes."""
        return change(self, lambda array, core: array.reshape((*shape, *array.shape[array.ndim - core :])))

    def __getitem__(self, index: Index) -> Fix:
        """Return some fixes of a batch."""
        return change(self, lambda array, core: _as_array(array[index]))

    def __len__(self) -> int:
        """Return the length of the first batch axis."""
        return int(self.x.shape[0])


# Words, tables and maps are made on a higher floor: `optloc` says by whom, once.
_TELLER: list[Callable[[], Any]] = []


def set_renderer(teller: Callable[[], Any]) -> None:
    """Say which module, loaded when it is needed, tells fixes in words and tables: `optloc.show.fixes`."""
    _TELLER[:] = [teller]


def _as_array(value: Any) -> Array:
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value)
    out = np.empty(1, dtype=object)
    out[0] = value
    return out.reshape(())

"""The answer to a problem: estimate, covariance, status, certificate, and other positions that fit the data.

Letters: size of the parameter vector, n shared unknowns, d coordinates, k epochs, p unknowns of an epoch, m rows, q
entries of a named part. Leading axes `...` count the fixes of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, cast

import numpy as np

from optloc.base.errors import InvalidProblem, NoSolution, status_named, too_weak, whole_redundancy
from optloc.base.frames import Frame
from optloc.base.plots import plot_of
from optloc.base.records import Axes, change
from optloc.base.types import HAS_ANSWER, NOTES, PRECEDENCE, Array, Certificate, Status, statuses_of
from optloc.problem.chart import CARTESIAN, Chart, Extent, tail_probability
from optloc.problem.claims import Claims, sentences_of
from optloc.problem.determined import Determined
from optloc.problem.explanations import Suspect
from optloc.problem.fix_parts import Alternatives, Stage
from optloc.problem.layout import Layout
from optloc.problem.posed_answer import PosedAnswer
from optloc.problem.problem import Problem
from optloc.problem.state_order import components, in_order

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes as PlotAxes

TOLD = 0.95  # greatest probability level at which the region of a fix with the finding `tails` is valid
_STATES = ("position", "velocity", "acceleration")
# A standard deviation of a position above 100 times the size of stations and target counts as undetermined. A fix is
# not Gaussian from 1 on, and coordinates that a symmetry leaves open have deviations that are larger by many decades.
_OPEN = 100.0
# Limits of other unknowns by SI unit, and of positions without known stations: the speed of light, many turns, a
# hundredfold scale, and for lengths the distance of the outer planets.
_OPEN_BY_UNIT = {"m/s": 299_792_458.0, "m/s^2": 299_792_458.0, "rad": 1e3, "1": 100.0, "s": 1e4}
_OPEN_LENGTH = 1e12


Index: TypeAlias = int | np.integer[Any] | slice | list[int] | Array | tuple[int | slice | Array, ...]
"""Index that selects fixes of a batch, as in NumPy."""


@dataclass(frozen=True, slots=True, repr=False)
class Fix:
    """Estimates of a batch of problems, with covariance, status and certificate; a single fix has no batch axes.

    Parameters
    ----------
    x : array (..., size)
        Parameter vectors in the order of `layout`; NaN without an answer.
    cov : array (..., n, n)
        Covariance of the shared unknowns; NaN if it does not exist.
    layout : Layout
        Names, order and units of the unknowns.
    frame : Frame
        Coordinate frame.
    code : int array (...)
        Numbers of `Status`.
    reason : object array (...)
        Sentence that explains the status, for instance with the open direction, the groups or the count.
    claims : Claims
        Certificates of the fixes as columns; see `certificate`.
    alternatives : Alternatives
        Other minima of the cost.
    cost : array (...)
        Weighted sum of squared residuals, chi-square distributed if the model is right.
    dof : int array (...)
        Degrees of freedom (redundancy): present rows minus unknowns without a prior. See `unchecked`.
    weights : array (..., m)
        Row weights of the estimate.
    stages : tuple of Stage
        Steps of the computation.
    active : object array (...), optional
        For each fix, a tuple of `Active`: the constraints that it meets with equality.
    local : array (..., k, p, p), optional
        Covariance of the states of targets at each epoch of a run, in the order of the layout; NaN where an epoch does
        not determine them.
    explanations : object array (...), optional
        For each fix with contradictory data, a tuple of `Explanation`, the best first: the fix uses the best. The
        scores of the others are higher by at most `optloc.solvers.policy.AMBIGUOUS_GAP`. Empty for other fixes. None if
        explanations were not requested.
    marks : int array (...), optional
        All findings of each fix, as one bit for each `Status`; see `findings`.
    chart : Chart, optional
        Coordinates in which the error of each fix is Gaussian; None for problems with other unknowns than one position.
    infinity : array (...), optional
        Least cost of positions at infinity minus the cost of the fix; NaN if it was not computed.
    reach : array (...), optional
        Greatest distance, metres, of a station from the mean of the stations; also of a target without a chart.
    labels : array (...), optional
        Labels of the fixes, such as the index of the data frame of the measurements; the index of `to_dataframe`.
    label_names : tuple
        Name of the labels, such as the name of that index, or one name for each of its levels; None for no name.
    posed : PosedAnswer, optional
        Values, duals and solver report of a single fix from `optloc.pose`; None for other fixes.
    source : object array (...), optional
        A `Source` for `determined` and `plot`; in batches None for fixes with status `ok`, or if many have another
        status.
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
    label_names: tuple[Any, ...] = ()
    posed: PosedAnswer | None = None
    # Cached at the first use, because a program can read one certificate after the other.
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
            raise InvalidProblem(f"a batch of shape {self.shape} has no single status", "status", advice)
        return Status(int(self.code))

    @property
    def statuses(self) -> Array:
        """Return the statuses (...), an array of `Status`."""
        return statuses_of(self.code)

    @property
    def certificate(self) -> Certificate:
        """Return the certificate of a single fix; for a batch the same as `certificates`."""
        return cast("Certificate", self.certificates[()])

    @property
    def certificates(self) -> Array:
        """Return the certificates (...), an object array of `Certificate`."""
        if not self._certificates:
            self._certificates.append(self.claims.tell())
        return self._certificates[0]

    @property
    def position(self) -> Array:
        """Return the position (..., d) of the only unknown target, or (..., k, d) with one per epoch, metres."""
        return self.take("position")

    @property
    def velocity(self) -> Array:
        """Return the velocity in the same shape as `position`, metres per second."""
        return self.take("velocity")

    def take(self, name: str) -> Array:
        """Return the named unknowns of the estimate, (..., q) or (..., k, q), for instance "position[1]" or "clock"."""
        return self.layout.take(self.x, self._slot(name))

    def _slot(self, name: str) -> str:
        """Return the name that the layout uses for a part.

        "position" means the position of the only target with unknown position. The layout adds a number, such as
        "position[1]", if there are several targets.
        """
        slots = [slot.name for slot in (*self.layout.shared, *self.layout.local)]
        numbered = [slot for slot in slots if slot.partition("[")[0] == name]
        return numbered[0] if name in _STATES and len(numbered) == 1 else name

    def state(self, order: str = "") -> tuple[Array, Array]:
        """Return mean (..., m) and covariance (..., m, m) of the state [p, v, a] of the only unknown target.

        Parameters
        ----------
        order : str
            Names of components in the wanted order, such as "x vx y vy". Default: x y z vx vy vz ax ay az.
        """
        parts = [self._slot(name) for name in _STATES]
        slots = [slot for slot in self.layout.shared if slot.name in parts]
        index = np.concatenate([np.arange(slot.start, slot.start + slot.size) for slot in slots])
        mean, cov = self.x[..., index], self.cov[..., index[:, None], index]
        d = slots[0].size
        return in_order(order or components(d, len(index)), d, mean, cov)

    @property
    def bias(self) -> Mapping[str, Array]:
        """Return the estimates of all unknowns except the states of targets, by name, in SI units."""
        names = (slot.name for slot in (*self.layout.shared, *self.layout.local))
        return {name: self.take(name) for name in names if name.partition("[")[0] not in _STATES}

    def members(self, name: str) -> tuple[str, ...]:
        """Return the names of the entries of a named part, for instance the stations of "clock"."""
        return self.layout.find(name)[0].entries

    def covariance(self, name: str = "position") -> Array:
        """Return the covariance of a named part: (..., q, q), or (..., k, q, q) for a state at each epoch.

        The unit is the squared SI unit of the part.
        """
        slot, shared = self.layout.find(self._slot(name))
        entries = slice(slot.start, slot.start + slot.size)
        if shared:
            return self.cov[..., entries, entries]
        if self.local is None or slot.start + slot.size > self.local.shape[-1]:
            raise InvalidProblem(
                f"the covariance of {name} is not stored, because it is unknown at each epoch", name, "read other names"
            )
        return self.local[..., entries, entries]

    def sigma(self, name: str = "position") -> Array:
        """Return the standard deviations of a named part: (..., q), or (..., k, q) for a state at each epoch.

        The unit is the SI unit of the part.
        """
        return np.asarray(np.sqrt(np.diagonal(self.covariance(name), axis1=-2, axis2=-1)))

    def undetermined(self, name: str = "position") -> Array:
        """Return a mask (..., q) of the entries of a named part that the data do not determine.

        These entries have a standard deviation above 100 times the size of stations and target together; for a speed,
        above the speed of light. A symmetry is the usual cause, for instance for the height of a target if all stations
        are in one plane. Tables and texts show these entries as "not determined".

        Parameters
        ----------
        name : str
            Part of the estimate, as for `sigma`.
        """
        sigma, limit = self.sigma(name), self.widest(name)
        with np.errstate(invalid="ignore"):
            return np.asarray(sigma > limit.reshape(*limit.shape, *(1,) * (sigma.ndim - limit.ndim)))

    def widest(self, name: str = "position") -> Array:
        """Return the limit (...) of the standard deviation above which `undetermined` marks an entry, SI units."""
        slot, _ = self.layout.find(self._slot(name))
        limit = np.full(self.shape, _OPEN_BY_UNIT.get(slot.unit, _OPEN_LENGTH))
        if slot.name.partition("[")[0] != "position" or self.reach is None:
            return limit
        distance = 0.0 if self.chart is None else np.nan_to_num(self.chart.distance)
        size = np.nan_to_num(self.reach) + distance
        # A single fixed station has size zero, and a target at this station has distance zero.
        return np.where(size > 0.0, _OPEN * size, limit)

    @property
    def p_value(self) -> Array:
        """Return the probability (...) of a cost at least this large if the model is right; NaN without redundancy."""
        return tail_probability(self.cost, self.dof)

    @property
    def geodetic(self) -> tuple[Array, Array, Array]:
        """Return latitude, longitude (radians) and ellipsoidal height (metres) of the position, each (...)."""
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
            Probability that the region contains the target.

        Returns
        -------
        semi_axes, directions : array (..., d), (..., d, d)
            Lengths in metres, ascending, and unit vectors of the axes in columns.
        """
        from scipy.special import gammaincinv

        cov = self.covariance()
        known = np.asarray(np.isfinite(cov).all((-1, -2)))
        values, vectors = np.linalg.eigh(np.where(known[..., None, None], cov, 0.0))
        scale = np.sqrt(2.0 * gammaincinv(cov.shape[-1] / 2, probability))
        axes = scale * np.sqrt(np.maximum(values, 0.0))
        return np.where(known[..., None], axes, np.nan), np.where(known[..., None, None], vectors, np.nan)

    def __repr__(self) -> str:
        """Return the answer as text, as the command line prints it; for a batch the table of its fixes."""
        return str(_RENDERER[0]().text_of(self)) if _RENDERER else object.__repr__(self)

    def _repr_html_(self) -> str:
        """Return the same text as HTML, for notebooks."""
        return str(_RENDERER[0]().html_of(self)) if _RENDERER else ""

    @property
    def determined(self) -> Determined | None:
        """Return directions, ranges and curves of a single fix that the data determine, in every status.

        They are computed when you read them. The result is None if the fix does not contain its problem, as in batches
        with many refused fixes. `optloc.model_checks.determined(problem, fix)` then computes them.
        """
        return cast("Determined | None", _RENDERER[0]().determined_of(self))

    def to_dict(self) -> dict[str, object]:
        """Return the fix as plain numbers, texts and lists, ready for JSON.

        Returns
        -------
        dict
            Status, position, sigma (on Earth also `sigma_east`, `sigma_north`, `sigma_up`), and more by name, as in
            ``optloc fix --json``: metres and degrees, None for missing numbers. For a batch ``{"fixes": [...]}``.
        """
        return dict(_RENDERER[0]().dict_of(self))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a data frame with one row for each fix (and target, and epoch), as ``optloc fix --out`` writes it.

        Raises
        ------
        InvalidProblem
            If pandas is not installed.
        """
        return cast("pd.DataFrame", _RENDERER[0]().frame_of(self))

    def to_geojson(self, problem: Problem | None = None) -> dict[str, object]:
        """Return positions and their 95 % regions as a GeoJSON feature collection (RFC 7946).

        Parameters
        ----------
        problem : Problem, optional
            The problem of these fixes. With it the result also contains its stations, and curved regions.

        Raises
        ------
        InvalidProblem
            If the positions are not on Earth.
        """
        return dict(_RENDERER[0]().geojson_of(self, problem))

    def plot(self, problem: Problem | None = None, **options: Any) -> PlotAxes:
        """Return a plan in matplotlib axes; see `optloc.show.fix_axes` for the options."""
        return plot_of(self, problem=problem, **options)

    def gaussian(self) -> tuple[Array, Array]:
        """Return the mean (..., n) and covariance (..., n, n) of the shared unknowns, for the start of a tracker.

        The mean accounts for truncation at bounds. The covariance is multiplied by `Chart.inflation`, which is above 1
        for fixes with the finding `tails`.
        """
        mean, cov = self.x[..., : self.layout.n_shared], self.cov
        if self.chart is not None and self.chart.truncated is not None:
            mean = self.chart.mean_of(mean, cov, self.layout.find("position")[0].start)
        if self.chart is not None and self.chart.inflation is not None:
            cov = cov * self.chart.inflation[..., None, None]
        return mean, cov

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Return the suspects that were left out of a single fix; for a batch an object array (...) of such tuples.

        They belong to the first of `explanations`. If there are several explanations, the others are equally plausible.
        """
        out = np.empty(self.shape, dtype=object)
        for i in np.ndindex(self.shape):
            explanations = () if self.explanations is None else self.explanations[i]
            out[i] = explanations[0].suspects if explanations else ()
        return cast("tuple[Suspect, ...]", out[()])

    @property
    def answered(self) -> Array:
        """Return a mask (...) of fixes that have a position with a covariance, with or without findings."""
        # A run to infinity has no finite estimate.
        return HAS_ANSWER[self.code] & np.isfinite(self.x).any(-1)

    def has(self, *statuses: Status) -> Array:
        """Return a mask (...) of fixes that have at least one of these statuses among their findings."""
        return np.asarray((self._all_marks & sum({one.mark for one in statuses})) != 0)

    @property
    def unchecked(self) -> Array | bool:
        """Return a mask (...) of answered fixes without redundancy, which cannot be tested; a bool for one fix."""
        out = np.asarray(self.answered & (self.dof <= 0))
        return bool(out) if self.shape == () else out

    @property
    def _all_marks(self) -> Array:
        """Return all findings of each fix (...), one bit for each `Status`, including the note `unchecked`."""
        # A fix of an external solver can have a status without marks.
        marks = np.left_shift(1, self.code.astype(np.int32)) if self.marks is None else self.marks
        return np.asarray(marks | np.where(self.unchecked, Status.UNCHECKED.mark, 0))

    @property
    def findings(self) -> tuple[Status, ...]:
        """Return all findings of a single fix; for a batch an object array (...) of such tuples.

        The most serious finding is first; it is the status. Notes are last: an `ok` fix has notes only, such as
        `unchecked` if it has no redundancy.
        """
        # Many fixes share few different sets of findings.
        marks, index = np.unique(self._all_marks, return_inverse=True)
        sets = np.empty(len(marks), dtype=object)
        for i, bits in enumerate(marks.tolist()):
            sets[i] = tuple(one for one in (*PRECEDENCE, *NOTES) if one is not Status.OK and bits & one.mark)
        return cast("tuple[Status, ...]", sets[index.reshape(self.shape)] if self.shape else sets[0])

    @property
    def sentence(self) -> str:
        """Return the sentence of the status of a single fix, with advice that its method has not yet followed.

        For a batch, the result is an object array (...) of such sentences.
        """
        found = sentences_of(np.asarray(self.code), self.claims)
        return cast("str", found if self.shape else found[()])

    def covers(self, points: Array, level: float = 0.95) -> Array:
        """Return whether points are in the regions that contain the target with a given probability.

        Parameters
        ----------
        points : array (..., d)
            Metres; they broadcast against the fixes, (q, d) for one fix and (q, N, d) for N.
        level : float
            Probability that the region of a fix contains the target.

        Returns
        -------
        bool array (...)
            Computed in the coordinates in which the error is Gaussian, see `chart`.

        Raises
        ------
        InvalidProblem
            If no Gaussian is valid for the fix. Use `optloc.uncertainty.likelihood_region` for its region.
        """
        return self._gaussian_chart(level).covers(points, level)

    def interval(self, extent: Extent, level: float = 0.95) -> tuple[Array, Array]:
        """Return the ends (...) of an interval for one coordinate of the target.

        Parameters
        ----------
        extent : "range", "bearing", "elevation", "height", "x", "y" or "z"
            Coordinate, seen from the mean of the stations; metres or radians, see
            `optloc.problem.chart.Chart.interval`.
        level : float
            Probability that the interval contains the true value.

        Raises
        ------
        InvalidProblem
            If no Gaussian is valid for the fix. Use `optloc.uncertainty.likelihood_region` for its region.
        """
        return self._gaussian_chart(level).interval(extent, level)

    def _gaussian_chart(self, level: float) -> Chart:
        """Return the chart; raise if it does not exist, or if the finding `tails` forbids this probability level."""
        if self.chart is None:
            raise InvalidProblem("only a fix of a single position has a chart", "fix", "use its covariance")
        if level > TOLD and bool((self.has(Status.TAILS) & (self.chart.kind == CARTESIAN)).any()):
            what = f"some regions are valid at level {TOLD:g}, but not at {level:g}"
            raise InvalidProblem(what, "level", "take fixes without the finding 'tails'")
        return self.chart

    def require(self, allow: Iterable[Status | str] = (), *, redundancy: int = 0, level: float = 0.95) -> Fix:
        """Return the fix if all its statuses are `ok` or allowed; otherwise raise NoSolution for the first that is not.

        Parameters
        ----------
        allow : iterable of Status or str
            Statuses to accept in addition to `ok`, for instance ``("curved", "unproven")``.
        redundancy : int
            Required degrees of freedom. With 1, a wrong measurement can be detected; with 0, `unchecked` fixes pass.
        level : float
            Required probability level of regions. Above 0.95, fixes with the finding `tails` do not pass.

        Raises
        ------
        NoSolution
            For the first fix with another status, with less redundancy, or with `tails`.
        InvalidProblem
            For an unknown status, or if the redundancy is not a whole number.
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
        """Return the fixes of a flat batch with the batch axes `shape`."""
        return change(self, lambda array, core: array.reshape((*shape, *array.shape[array.ndim - core :])))

    def __getitem__(self, index: Index) -> Fix:
        """Return the selected fixes of a batch."""
        return change(self, lambda array, core: _as_array(array[index]))

    def __len__(self) -> int:
        """Return the length of the first batch axis."""
        return int(self.x.shape[0])


# A module of a higher layer makes texts, tables and maps. The package `optloc` registers it here once.
_RENDERER: list[Callable[[], Any]] = []


def set_renderer(renderer: Callable[[], Any]) -> None:
    """Register the loader of the module that makes texts, tables and maps of fixes: `optloc.show.fixes`.

    `renderer` returns the module. It is called at the first use, because the module belongs to a higher layer.
    """
    _RENDERER[:] = [renderer]


def _as_array(value: Any) -> Array:
    """Return an array without axes if the value is a scalar or an object, so that `Fix` stores arrays only."""
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value)
    out = np.empty(1, dtype=object)
    out[0] = value
    return out.reshape(())

"""The cost of one fix over its position, every other unknown at its best: what regions and samples look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.adequacy.shape import departure, profile
from optloc.base.errors import InvalidProblem
from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array
from optloc.compute.sums import equations_at
from optloc.linear.constraints import exact
from optloc.linear.normal import covariance
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE, Chart
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem

# Evaluations of the cost at a time: their normal equations then take some megabytes.
_PART = 2**13
# Departure from a Gaussian beyond which none covers: that of the verdict `curved`, measured there.
_BENT = 0.3


@dataclass(frozen=True, slots=True)
class Surface:
    """The cost ``f(x)`` of one problem over the position, and the fix on it.

    Parameters
    ----------
    problem : Problem
        Flat batch of one, rows weighted as in the fix.
    x : array (1, size)
        All unknowns of the fix.
    chart : Chart
        Position, covariance, and where the fix is Gaussian.
    least : float
        Cost of the fix.
    """

    problem: Problem
    x: Array
    chart: Chart
    least: float

    @classmethod
    def of(cls, problem: Problem, fix: Fix) -> Surface:
        """Return the surface of a single fix of one position that stays; raise InvalidProblem for others."""
        _check(problem, fix)
        if not np.isfinite(fix.position).all() or not np.isfinite(fix.covariance()).all():
            raise InvalidProblem("the fix has no position with a covariance", "fix", "its status says why")
        kind = None if fix.chart is None or int(fix.chart.kind) == CURVED else int(fix.chart.kind)
        return cls._about(problem, fix, fix.x, fix.cov, kind)

    @classmethod
    def at(cls, problem: Problem, fix: Fix, x: Array) -> Surface:
        """Return the surface of another minimum x (size,) of the problem of a single fix."""
        _check(problem, fix)
        flat = problem.flat().with_rows(weight=fix.weights[None])
        cov, ok = covariance(equations_at(flat, x[None]))
        if not ok[0]:
            raise InvalidProblem("another minimum has no covariance", "fix", "ask for samples of the fix alone")
        return cls._about(problem, fix, x, cov[0], None)

    @classmethod
    def _about(cls, problem: Problem, fix: Fix, x: Array, cov: Array, kind: int | None) -> Surface:
        """Return the surface of a minimum with a covariance of the shared unknowns."""
        flat, x = problem.flat().with_rows(weight=fix.weights[None]), x[None]
        slot, _ = problem.layout.find("position")
        part = slice(slot.start, slot.start + slot.size)
        if fix.chart is not None:
            centre = fix.chart.centre
        else:
            centre = centre_and_spread(problem.stations.places)[0].reshape(-1, slot.size)[0]
        if kind is None:
            metres, inverse = departure(flat, x, cov[None], (), centre[None])[0]
            kind = CARTESIAN if metres <= _BENT else INVERSE_RANGE if inverse <= _BENT else CURVED
        chart = Chart(np.asarray(kind, dtype=np.int8), x[0, part], cov[part, part], centre)
        return cls(flat, x, chart, float(profile(flat, x[None], x, _passes(flat))[0][0, 0]))

    @property
    def kind(self) -> int:
        """Return the kind of the chart, for instance `optloc.problem.chart.INVERSE_RANGE`."""
        return int(self.chart.kind)

    @property
    def position(self) -> Array:
        """Return the position (d,) of the fix, metres."""
        return self.chart.position

    def look(self, points: Array) -> tuple[Array, Array, Array]:
        """Return the cost at points, and its normal equations.

        Parameters
        ----------
        points : array (..., d)
            Positions, metres; those that are not finite have an infinite cost.

        Returns
        -------
        cost : array (...)
            Least weighted sum of squared residuals.
        information : array (..., d, d)
            Of the position, the other unknowns eliminated.
        vector : array (..., d)
            Half the negative gradient of the cost.
        """
        d = points.shape[-1]
        flat = np.ascontiguousarray(points).reshape(-1, d)
        good = np.isfinite(flat).all(-1)
        slot, _ = self.problem.layout.find("position")
        x = np.repeat(self.x, len(flat), axis=0)
        x[:, slot.start : slot.start + d] = np.where(good[:, None], flat, self.position)
        cost, information, vector = np.empty(len(x)), np.empty((len(x), d, d)), np.empty((len(x), d))
        for first in range(0, len(x), _PART):
            part = slice(first, first + _PART)
            found = profile(self.problem, x[part, None], self.x, _passes(self.problem))
            cost[part], information[part], vector[part] = (each[:, 0] for each in found)
        shape = points.shape[:-1]
        cost = np.where(good & np.isfinite(cost), cost, np.inf)
        return cost.reshape(shape), information.reshape(*shape, d, d), vector.reshape(*shape, d)

    def cost(self, points: Array) -> Array:
        """Return the cost (...) at points (..., d), metres."""
        return self.look(points)[0]


def _passes(problem: Problem) -> int:
    """Return how often the other unknowns move to their best: far from the fix they are far off, and rounding shows."""
    return 1 if problem.layout.size == problem.dimension else 2


def _check(problem: Problem, fix: Fix) -> None:
    """Raise unless the fix is a single one of one static position, found, and held by no equality."""
    advice = "take one fix of a batch: `problem.flat().take([i])` and `fix.flat()[i]`"
    if fix.shape != () or int(np.prod(problem.batch_shape)) != 1:
        raise InvalidProblem("a region or samples are those of one fix, and these are several", "fix", advice)
    motion = problem.motions[0]
    shared = any(slot.name == "position" for slot in problem.layout.shared)
    if len(problem.motions) > 1 or motion.order > 0 or motion.known is not None or not shared:
        raise InvalidProblem("a region or samples are those of one position that stays", "problem")
    if exact(problem):
        raise InvalidProblem(
            "the position is held by an equality, such as a known height, along which regions are not drawn",
            "problem",
            "give the height as a prior with its standard deviation",
        )

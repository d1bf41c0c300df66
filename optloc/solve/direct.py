"""Positions from ranges in one compiled call; what is not plainly good takes the stages of the long way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from optloc.fix import Alternatives, Fix, Stage
from optloc.problem import Problem
from optloc.solve.maps import Direct, direct
from optloc.solve.parts import in_parts
from optloc.solve.reasons import doubt
from optloc.solve.stages import Solver, gtrs, lsr
from optloc.solve.verdict import _LOCAL
from optloc.status import Status
from optloc.threads import mapped
from optloc.types import Array

_CHUNK = 4096
_TOLERANCE, _LIMIT = 1e-7, 100  # of the refinement of the method "lsr"


@dataclass(frozen=True, slots=True)
class Quick:
    """The stages "gtrs" and "lsr" as one solver, which takes the direct way where there is one.

    Parameters
    ----------
    least : int
        Batches with fewer problems take the stages as they are.
    """

    least: int = 1

    def __call__(self, problem: Problem, fix: Fix | None) -> Fix:
        """Return the fixes of a flat batch of problems."""
        count = problem.batch_shape[0]
        plan = direct(problem) if fix is None and count >= self.least else None
        if plan is None:
            return in_parts(problem, lambda some, part: lsr(some, gtrs(some, None if fix is None else fix[part])))
        z = problem.z if len(problem.rows) > 1 else problem.rows[0].z
        place = problem.stations.position.reshape(-1, *problem.stations.position.shape[-2:])
        z = z if len(z) == count else np.broadcast_to(z, (count, problem.count))
        return fixed(plan, z, place, lambda items: by_stages(problem, items))


def shortened(solvers: Sequence[Solver], least: int = 1) -> list[Solver]:
    """Return the solvers of a method, with a leading "gtrs", "lsr" as one `Quick`."""
    return [Quick(least), *solvers[2:]] if list(solvers[:2]) == [gtrs, lsr] else list(solvers)


def by_stages(problem: Problem, items: Array) -> Fix:
    """Return the fixes of some problems of a flat batch by the stages "gtrs" and "lsr"."""
    return in_parts(problem.take(items), lambda some, part: lsr(some, gtrs(some, None)))


def fixed(direct: Direct, z: Array, position: Array, rest: Callable[[Array], Fix], threads: int | None = None) -> Fix:
    """Return the fixes of measurements: directly where the answer is plain, else by other means.

    Parameters
    ----------
    direct : Direct
        From `direct` for problems of the same structure.
    z : array (N, m)
        Measurements.
    position : array (N or 1, stations, d)
        Of all stations.
    rest : callable
        Maps the numbers of problems whose answer is not plain to their fixes.
    threads : int, optional
        At most so many; as many as `optloc.threads.thread_count` says if absent.
    """
    from optloc.kernels.fixes import Model, fixes

    began = perf_counter()
    model = Model(*direct.maps)  # type: ignore[arg-type]
    count, d = len(z), position.shape[-1]
    x, covariance = np.empty((count, direct.layout.size)), np.empty((count, d, d))
    cost, plain = np.empty(count), np.empty(count, dtype=np.bool_)
    everyone = len(direct.station) == position.shape[1]

    def work(first: int) -> int:
        part = slice(first, min(first + _CHUNK, count))
        stations = position[part] if len(position) > 1 else position
        stations = _owned(stations if everyone else stations[:, direct.station])
        rows = _owned(z[part])
        return int(fixes(model, rows, stations, _TOLERANCE, _LIMIT, x[part], covariance[part], cost[part], plain[part]))

    steps = mapped(work, range(0, count, _CHUNK), threads)
    detail = f"{count} candidates, {max(steps, default=0)} steps at most"
    stages = (Stage("gtrs", "1 candidates at most", 0.0), Stage("lsr", detail, perf_counter() - began))
    fix = _judged(direct, x, covariance, cost, stages)
    doubt(fix, np.flatnonzero(plain & (cost > direct.limit)))
    left = np.flatnonzero(~plain)
    return _replaced(fix, left, rest(left)) if len(left) else fix


def _judged(direct: Direct, x: Array, covariance: Array, cost: Array, stages: tuple[Stage, ...]) -> Fix:
    """Return plain answers as fixes; all share one certificate."""
    count = len(x)
    return Fix(
        x,
        covariance,
        direct.layout,
        direct.frame,
        np.full(count, int(Status.OK), dtype=np.int8),
        _filled(count, ""),
        _filled(count, _LOCAL),
        Alternatives(np.full((count, 0, x.shape[1]), np.nan), np.full((count, 0), np.inf)),
        cost,
        np.full(count, direct.dof, dtype=np.int32),
        np.broadcast_to(direct.weight, (count, len(direct.weight))),
        stages,
        _filled(count, ()),
        None,
    )


def _owned(values: Array) -> Array:
    """Return values as the one type of array for which there is machine code: float, C order, writable."""
    return np.require(values, dtype=float, requirements=["C", "W"])


def _filled(count: int, value: object) -> Array:
    out = np.empty(count, dtype=object)
    out.fill(value)
    return out


def _replaced(fix: Fix, items: Array, other: Fix) -> Fix:
    """Return fresh fixes with some of them overwritten by others."""
    for name in ("x", "cov", "code", "reason", "certificate", "cost", "dof", "active"):
        getattr(fix, name)[items] = getattr(other, name)
    width = other.alternatives.gap.shape[1]
    if not width:
        return fix
    more = np.full((len(fix), width, fix.x.shape[1]), np.nan), np.full((len(fix), width), np.inf)
    more[0][items], more[1][items] = other.alternatives.x, other.alternatives.gap
    return replace(fix, alternatives=Alternatives(*more))

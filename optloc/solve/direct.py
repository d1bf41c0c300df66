"""Positions from ranges in one compiled call: the linear maps from measurements to a fix, made once for a structure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from optloc import linalg
from optloc.fix import Alternatives, Fix, Stage
from optloc.frames import Frame
from optloc.kernels.jit import enabled
from optloc.layout import Layout
from optloc.models import MODELS
from optloc.noise import variances, whiten
from optloc.problem import Problem
from optloc.proof.eliminate import whitened, without
from optloc.solve.freedom import degrees_of_freedom
from optloc.solve.reasons import DOUBT
from optloc.solve.reduce import Ranges, ranges
from optloc.solve.verdict import _LOCAL
from optloc.status import Status
from optloc.threads import mapped
from optloc.types import Array
from optloc.weigh import depends_on_place, weighed

_CHUNK = 4096
_MOST = 64  # rows, and epochs with emission times, up to which dense maps pay
_TOLERANCE, _LIMIT = 1e-7, 100  # of the refinement of the method "lsr"


@dataclass(frozen=True, slots=True)
class Direct:
    """What turns measurements of one structure into fixes: all but the measurements and the stations.

    Parameters
    ----------
    layout : Layout
        Position, and the emission time of each epoch where rows have one.
    frame : Frame
        Of the positions.
    weight : array (m,)
        Row weights.
    dof : int
        Degrees of freedom.
    station : int array (s,)
        Stations that take part.
    maps : tuple
        Fields of `optloc.kernels.fixes.Model`.
    """

    layout: Layout
    frame: Frame
    weight: Array
    dof: int
    station: Array
    maps: tuple[Array | int | float, ...]


def direct(problem: Problem) -> Direct | None:
    """Return what fixes problems of one structure directly, or None where they need the stages of the long way.

    One static position; rows that are sums of ranges, which link all stations that take part; stations that stay;
    weights, corrections and noise shared by the batch; nothing else unknown but emission times.

    Parameters
    ----------
    problem : Problem
        Batch of problems; their measurements are not looked at.
    """
    if not (enabled() and _simple(problem)):
        return None
    one = weighed(_probe(problem))
    found = ranges(one)
    if found is None or len(found.groups) != 1 or len(found.groups[0]) != 1 or not found.inside.all():
        return None
    white = linalg.whitening(found.covariance)[0]
    dof = int(degrees_of_freedom(one)[0])
    if dof < 0 or np.triu(white, 1).any():
        return None
    correction = np.concatenate([rows.correction for rows in problem.rows])
    maps = _maps(one, correction, found, white, dof)
    return Direct(problem.layout, problem.frame, one.weight, dof, found.station, maps)


def _simple(problem: Problem) -> bool:
    """Return whether the structure, and what the batch shares, are such that linear maps exist and pay."""
    stations, motion = problem.stations, problem.motions[0]
    shared = [r.weight for r in problem.rows] + [r.correction for r in problem.rows]
    return (
        not (problem.constraints or problem.biases or problem.priors)
        and len(problem.motions) == 1
        and (motion.order, motion.span, motion.known) == (0, "run", None)
        and all(MODELS[r.kind].ranges is not None and bool((r.target == 0).all()) for r in problem.rows)
        and stations.position.shape[-3] == 1
        and (stations.covariance is None or (stations.span == "noise" and stations.covariance.ndim == 3))
        and not depends_on_place(problem)
        and 0 < problem.count <= _MOST
        and problem.layout.size <= problem.dimension + _MOST
        and all(array.ndim == 1 for array in shared)
        and all(block.covariance.ndim == 3 for block in problem.noise.blocks)
    )


def _probe(problem: Problem) -> Problem:
    """Return one problem for each row, whose measurement is one and all others zero."""
    parts = np.split(np.eye(problem.count), problem.starts[1:], axis=1)
    rows = tuple(
        replace(r, z=part, correction=np.zeros(r.count)) for r, part in zip(problem.rows, parts, strict=True)
    )
    stations = problem.stations
    place = stations.position.reshape(-1, *stations.position.shape[-3:])[0]
    return replace(problem, rows=rows, stations=replace(stations, position=place, velocity=None, axes=None))


def _maps(one: Problem, correction: Array, found: Ranges, white: Array, dof: int) -> tuple[Array | int | float, ...]:
    """Return the fields of the compiled model, in its order."""
    from scipy.special import gammainccinv

    count, epochs = one.count, one.epochs if one.layout.n_local else 0
    design, emitted = np.zeros((count, len(found.station))), np.zeros((count, epochs))
    place = {int(s): i for i, s in enumerate(found.station)}
    anchor, start = np.full(count, -1), np.full(epochs, -1)
    for rows, first in zip(one.rows, one.starts, strict=True):
        model = MODELS[rows.kind]
        for i in range(rows.count):
            for coefficient, station in zip(model.ranges or (), (int(rows.a[i]), int(rows.b[i])), strict=False):
                if coefficient:
                    design[first + i, place[station]] += coefficient
            if model.emission and rows.weight[i] > 0.0:
                epoch = int(rows.epoch[i])
                emitted[first + i, epoch] = 1.0
                start[epoch] = first + i if start[epoch] < 0 else start[epoch]
                anchor[first + i] = start[epoch]
    alone = whitened(whiten(one.noise, one.weight), np.eye(count))
    times = alone @ emitted
    bare = without(times, alone)
    basis, upper = np.linalg.qr(bare @ design, mode="complete")
    inside = min(upper.shape)
    turned = basis.T @ bare
    loops = turned[inside:]
    loops = loops[np.abs(loops).max(-1, initial=0.0) > 1e-12 * np.abs(alone).max()]
    emission = np.linalg.pinv(times) @ alone
    present = one.weight > 0.0
    precision = np.where(present, 1.0 / np.where(present, variances(one.noise, count), 1.0), 0.0)
    return (
        np.stack([correction, precision]),
        anchor,
        np.concatenate([found.offset.T, turned[:inside], emission, loops]),
        found.sign[0].astype(float),
        int(found.reference[0]) if found.free.all() else -1,
        white,
        upper[:inside].copy(),
        emission @ design,
        start,
        2.0 * float(gammainccinv(dof / 2, DOUBT)) * (1.0 - 1e-9) if dof else np.inf,
    )


def fixed(
    direct: Direct, z: Array, position: Array, rest: Callable[[Array], Fix], threads: int | None = None
) -> Fix:
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
        stations = np.ascontiguousarray(stations if everyone else stations[:, direct.station])
        rows = np.ascontiguousarray(z[part])
        return int(
            fixes(model, rows, stations, _TOLERANCE, _LIMIT, x[part], covariance[part], cost[part], plain[part])
        )

    steps = mapped(work, range(0, count, _CHUNK), threads)
    detail = f"{count} candidates, {max(steps, default=0)} steps at most"
    stages = (Stage("gtrs", "1 candidates at most", 0.0), Stage("lsr", detail, perf_counter() - began))
    fix = _judged(direct, x, covariance, cost, stages)
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

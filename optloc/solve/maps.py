"""The linear maps from measurements to all that a fix from ranges needs, made once for a structure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc import linalg
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
from optloc.types import Array
from optloc.weigh import depends_on_place, weighed

_MOST = 64  # rows, and epochs with emission times, up to which dense maps pay
_NOTHING = 1e-12  # share of the largest weight below which a combination of rows is rounding


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
    limit : float
        Cost above which the noise may not allow the residuals.
    station : int array (s,)
        Stations that take part.
    maps : tuple
        Fields of `optloc.kernels.fixes.Model`.
    """

    layout: Layout
    frame: Frame
    weight: Array
    dof: int
    limit: float
    station: Array
    maps: tuple[Array | int, ...]


_KEPT: dict[tuple[Any, ...], Direct | None] = {}
_KEPT_MOST = 64


def direct(problem: Problem) -> Direct | None:
    """Return what fixes problems of one structure directly, or None where they need the stages of the long way.

    One static position; rows that are sums of ranges, which link all stations that take part; stations that stay;
    weights, corrections and noise shared by the batch; nothing else unknown but emission times. Kept for problems that
    differ in measurements and station positions only.

    Parameters
    ----------
    problem : Problem
        Batch of problems; their measurements are not looked at.
    """
    if not (_simple(problem) and enabled()):
        return None
    numbers = [array for r in problem.rows for array in (r.weight, r.correction)]
    numbers += [block.covariance for block in problem.noise.blocks]
    numbers += [] if problem.stations.covariance is None else [problem.stations.covariance]
    key = (problem.structure, *(array.tobytes() for array in numbers))
    if key not in _KEPT:
        if len(_KEPT) >= _KEPT_MOST:
            _KEPT.clear()
        _KEPT[key] = _direct(problem)
    return _KEPT[key]


def _direct(problem: Problem) -> Direct | None:
    from scipy.special import gammainccinv

    one = weighed(_probe(problem))
    found = ranges(one)
    if found is None or len(found.groups) != 1 or len(found.groups[0]) != 1:
        return None
    heard = np.flatnonzero(found.inside[0])
    white = linalg.whitening(found.covariance[0, heard[:, None], heard])
    dof = int(degrees_of_freedom(one)[0])
    if dof < 0 or np.triu(white, 1).any():
        return None
    correction = np.concatenate([rows.correction for rows in problem.rows])
    maps = _maps(one, correction, found, heard, white)
    limit = 2.0 * float(gammainccinv(dof / 2, DOUBT)) * (1.0 - 1e-9) if dof else np.inf
    return Direct(problem.layout, problem.frame, one.weight, dof, limit, found.station[heard], maps)


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
        and problem.epochs <= _MOST
        and all(array.ndim == 1 for array in shared)
        and all(block.covariance.ndim == 3 for block in problem.noise.blocks)
    )


def _probe(problem: Problem) -> Problem:
    """Return one problem for each row, whose measurement is one and all others zero."""
    parts = np.split(np.eye(problem.count), problem.starts[1:], axis=1)
    rows = tuple(replace(r, z=part, correction=np.zeros(r.count)) for r, part in zip(problem.rows, parts, strict=True))
    stations = problem.stations
    place = stations.position.reshape(-1, *stations.position.shape[-3:])[0]
    return replace(problem, rows=rows, stations=replace(stations, position=place, velocity=None, axes=None))


def _maps(one: Problem, correction: Array, found: Ranges, heard: Array, white: Array) -> tuple[Array | int, ...]:
    """Return the fields of the compiled model, in its order."""
    count = one.count
    design, emitted, anchor, start = _design(one, found.station[heard])
    alone = whitened(whiten(one.noise, one.weight), np.eye(count))
    times = alone @ emitted
    bare = without(times, alone)
    basis, upper = np.linalg.qr(bare @ design, mode="complete")
    inside = min(upper.shape)
    turned = basis.T @ bare
    loops = turned[inside:]
    loops = loops[np.abs(loops).max(-1, initial=0.0) > _NOTHING * np.abs(alone).max()]
    emission = np.linalg.pinv(times) @ alone
    present = one.weight > 0.0
    precision = np.where(present, 1.0 / np.where(present, variances(one.noise, count), 1.0), 0.0)
    return (
        np.stack([correction, precision]),
        anchor,
        np.concatenate([found.offset[:, heard].T, turned[:inside], emission, loops]),
        np.array(found.sign[0, heard], dtype=float),
        int(np.searchsorted(heard, found.reference[0])) if found.free.all() else -1,
        np.array(white, order="C"),
        np.array(upper[:inside], order="C"),
        np.array(emission @ design, order="C"),
        start,
    )


def _design(one: Problem, station: Array) -> tuple[Array, Array, Array, Array]:
    """Return the rows over ranges (m, s) and emission times (m, k), the anchor of each row and of each time."""
    epochs = one.epochs if one.layout.n_local else 0
    design, emitted = np.zeros((one.count, len(station))), np.zeros((one.count, epochs))
    anchor, start = np.full(one.count, -1), np.full(epochs, -1)
    place = {int(s): i for i, s in enumerate(station)}
    for rows, first in zip(one.rows, one.starts, strict=True):
        model = MODELS[rows.kind]
        for i in np.flatnonzero(rows.weight > 0.0):
            for coefficient, end in zip(model.ranges or (), (int(rows.a[i]), int(rows.b[i])), strict=False):
                if coefficient:
                    design[first + i, place[end]] += coefficient
            if model.emission:
                epoch = int(rows.epoch[i])
                emitted[first + i, epoch] = 1.0
                start[epoch] = first + i if start[epoch] < 0 else start[epoch]
                anchor[first + i] = start[epoch]
    return design, emitted, anchor, start

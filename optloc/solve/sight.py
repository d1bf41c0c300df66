"""What the Earth hides: no signal of a target reaches a satellite through the ground."""

from __future__ import annotations

import numpy as np

from optloc.layout import state_names
from optloc.models import MODELS
from optloc.models.primitives import WGS84_A, WGS84_F
from optloc.problem import Problem
from optloc.types import Array

_SATELLITE = 1.0 + 100e3 / WGS84_A
_GRAZE = 1.0 - 5e3 / WGS84_A


def hidden(problem: Problem, x: Array) -> Array:
    """Return which vectors x (N, size) place a target behind the Earth as seen from a station above 100 km.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems; in plain Cartesian frames nothing is hidden.
    x : array (N, size)
        Parameter vectors.
    """
    out = np.zeros(len(x), dtype=bool)
    if not problem.frame.geodetic or problem.dimension != 3:
        return out
    position = np.broadcast_to(problem.stations.position, (len(x), *problem.stations.position.shape[-3:]))
    stretch = np.array([1.0, 1.0, 1.0 / (1.0 - WGS84_F)]) / WGS84_A
    stations = problem.frame.to_ecef(position) * stretch
    for target, motion in enumerate(problem.motions):
        if motion.known is not None or motion.span == "epoch":
            continue
        slot, _ = problem.layout.find(state_names(target, len(problem.motions), 0)[0])
        point = problem.frame.to_ecef(x[:, slot.start : slot.start + 3]) * stretch
        for nodes in _heard(problem, target):
            out |= _blocked(point, stations[:, nodes[0], nodes[1]], nodes[2])
    return out


def _heard(problem: Problem, target: int) -> list[tuple[int, int, Array]]:
    """Return (epoch, station, mask (N,) of problems in which it is heard) of every station that measures a target."""
    moving = problem.stations.position.shape[-3] > 1
    weight = np.broadcast_to(problem.weight, (problem.batch_shape[0], problem.count))
    found: dict[tuple[int, int], Array] = {}
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        present = weight[:, start : start + rows.count] > 0.0
        for index in (rows.a, rows.b)[: MODELS[rows.kind].stations]:
            for i in np.flatnonzero(rows.target == target):
                key = (int(rows.epoch[i]) if moving else 0, int(index[i]))
                found[key] = found.get(key, np.zeros(len(present), dtype=bool)) | present[:, i]
    return [(epoch, station, mask) for (epoch, station), mask in found.items()]


def _blocked(point: Array, station: Array, heard: Array) -> Array:
    """Return whether the line from point to station dips below the ground; unit sphere coordinates, 5 km of slack."""
    high = heard & ((station**2).sum(-1) > _SATELLITE**2)
    line = station - point
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.clip(-(point * line).sum(-1) / (line**2).sum(-1), 0.0, 1.0)
        nearest = ((point + share[:, None] * line) ** 2).sum(-1)
    return np.asarray(high & (share > 0.0) & (nearest < _GRAZE**2))

"""What the Earth hides: no signal of a target reaches a station through the ground."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.models import MODELS
from optloc.models.primitives import WGS84_A, WGS84_F, geodetic_normal
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem

# Height above which a station is a satellite, Earth radii: above all aircraft, below all orbits.
_SATELLITE = 1.0 + 100e3 / WGS84_A
# How deep a line may dip: 5 km to a satellite, for refraction and for targets below the ellipsoid or badly measured; 50
# km to others, a chord of 1 600 km along the ground: only what is clearly on the other side of the Earth is excluded.
_GRAZE, _GROUND = 1.0 - 5e3 / WGS84_A, 1.0 - 50e3 / WGS84_A


def is_hidden(problem: Problem, x: Array) -> Array:
    """Return which vectors x (N, size) place a target behind the Earth as seen from a station that hears it.

    The straight line may pass 5 km below the ellipsoid to a station above 100 km, and 50 km to others.

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
    # stretched along the axis the ellipsoid is the unit sphere, and lines stay lines
    stretch = np.array([1.0, 1.0, 1.0 / (1.0 - WGS84_F)]) / WGS84_A
    stations = problem.frame.to_ecef(position) * stretch
    for target, motion in enumerate(problem.motions):
        if motion.known is not None or motion.span == "epoch":
            continue
        slot, _ = problem.layout.find(state_names(target, len(problem.motions), 0)[0])
        point = problem.frame.to_ecef(x[:, slot.start : slot.start + 3]) * stretch
        for nodes in _heard(problem, target):
            out |= _is_blocked(point, stations[:, nodes[0], nodes[1]], nodes[2])
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


def _is_blocked(point: Array, station: Array, heard: Array) -> Array:
    """Return whether the line from point to station dips too deep; unit sphere coordinates."""
    limit = np.where((station**2).sum(-1) > _SATELLITE**2, _GRAZE, _GROUND)
    line = station - point
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        # the point of the segment next to the centre; at its ends nothing lies in between
        share = np.clip(-(point * line).sum(-1) / (line**2).sum(-1), 0.0, 1.0)
        nearest = ((point + share[:, None] * line) ** 2).sum(-1)
    return np.asarray(heard & (share > 0.0) & (nearest < limit**2))


def lowest_sight(problem: Problem, x: Array) -> Array:
    """Return the sine of the lowest elevation (N,) at which targets x (N, size) see satellites that hear them.

    Zero in plain Cartesian frames and without satellites: a rule to order positions that fit equally well.
    """
    worst = np.full(len(x), np.inf)
    if not problem.frame.geodetic or problem.dimension != 3:
        return np.zeros(len(x))
    position = np.broadcast_to(problem.stations.position, (len(x), *problem.stations.position.shape[-3:]))
    stations = problem.frame.to_ecef(position)
    for target, motion in enumerate(problem.motions):
        if motion.known is not None or motion.span == "epoch":
            continue
        slot, _ = problem.layout.find(state_names(target, len(problem.motions), 0)[0])
        point = problem.frame.to_ecef(x[:, slot.start : slot.start + 3])
        up = np.stack(geodetic_normal((point[:, 0], point[:, 1], point[:, 2])), axis=-1)
        for epoch, station, heard in _heard(problem, target):
            line = stations[:, epoch, station] - point
            high = heard & ((stations[:, epoch, station] ** 2).sum(-1) > (_SATELLITE * WGS84_A) ** 2)
            sine = (line * up).sum(-1) / np.sqrt((line**2).sum(-1))
            worst = np.where(high, np.minimum(worst, sine), worst)
    return np.where(np.isfinite(worst), worst, 0.0)

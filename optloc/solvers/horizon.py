"""Lines of sight that the Earth blocks: which targets are hidden, and sentences about minima that are.

Letters: N problems, q slots for candidates, k stations, `size` numbers of a parameter vector. Costs are chi-square
values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import Array
from optloc.engine.admission import GRAZE, GROUND, SATELLITE
from optloc.linear.constraints import TOLERANCE, violation
from optloc.models import MODELS
from optloc.models.primitives import WGS84_A, WGS84_F, geodetic_normal
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem


def is_hidden(problem: Problem, x: Array, reach: float = 0.0) -> Array:
    """Return flags (N,) of vectors x (N, size) whose target the Earth hides from a station with a row of it.

    Two kinds of lines are tested. First, lines with one end in space, above 100 km: no wave passes through the Earth
    into space. Second, lines of rows that are angles: a bearing follows the line of sight. The straight line to a
    satellite may pass 5 km below the ellipsoid, a line to the ground 50 km. All other rows may connect any two points
    on the ground: waves of earthquakes pass through the Earth, and radio waves go around it.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems; in plain Cartesian frames nothing is hidden.
    x : array (N, size)
        Parameter vectors.
    reach : float
        Radius, metres, of a ball that must be hidden as a whole.
    """
    out = np.zeros(len(x), dtype=bool)
    for sight in sights(problem):
        out |= sight.blocked(x, reach).any(1)
    return out


@dataclass(frozen=True, slots=True)
class Sight:
    """The lines of sight from a target to its k stations.

    Parameters
    ----------
    frame : Frame
        Frame of the vectors.
    part : slice
        Columns of the position of the target in a parameter vector.
    station : int array (k,)
        Numbers of the stations.
    place : array (N, k, 3)
        Earth-centred positions of the stations, scaled so that the ellipsoid is the unit sphere.
    present, angular : bool array (N, k)
        True if the station has a row in a problem, and if one of its rows is an angle.
    """

    frame: Frame
    part: slice
    station: Array
    place: Array
    present: Array
    angular: Array

    def blocked(self, x: Array, reach: float = 0.0) -> Array:
        """Return flags (N, k) of stations that the Earth hides from targets at x (N, size).

        `reach` is the radius, metres, of a ball around the target that must be hidden as a whole; see `is_hidden`.
        """
        point = self.frame.to_ecef(x[:, self.part]) * _STRETCH
        return _is_blocked(point[:, None], self.place, self.present, self.angular, reach * float(_STRETCH.max()))


# Factors that turn the ellipsoid into the unit sphere; straight lines stay straight.
_STRETCH = np.array([1.0, 1.0, 1.0 / (1.0 - WGS84_F)]) / WGS84_A


def sights(problem: Problem) -> list[Sight]:
    """Return the lines of sight of all targets of a flat batch; empty in plain Cartesian frames."""
    if not problem.frame.geodetic or problem.dimension != 3:
        return []
    found, position = list[Sight](), problem.stations.position
    place = problem.frame.to_ecef(position if position.ndim == 4 else position[None]) * _STRETCH
    for target, motion in enumerate(problem.motions):
        # only targets whose unknown state lasts the run are tested
        if motion.known is not None or motion.span == "epoch":
            continue
        slot, _ = problem.layout.find(state_names(target, len(problem.motions), 0)[0])
        epoch, station, measured, angular = _measured_by(problem, target)
        part = slice(slot.start, slot.start + 3)
        found.append(Sight(problem.frame, part, station, place[:, epoch, station], measured, angular))
    return found


def _measured_by(problem: Problem, target: int) -> tuple[Array, Array, Array, Array]:
    """Return the k pairs of epoch and station that measure a target: epochs (k,), stations (k,), and two flags (N, k).

    The first flag is True if the pair has a row in a problem, and the second if it has an angle. If no station moves,
    all epochs count as epoch 0.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    target : int
        Number of the target.
    """
    moving = problem.stations.position.shape[-3] > 1
    weight = np.broadcast_to(problem.weight, (problem.batch_shape[0], problem.count))
    no_rows = np.zeros(len(weight), dtype=bool)
    found: dict[tuple[int, int], Array] = {}
    sighted: dict[tuple[int, int], Array] = {}
    # for each pair (epoch, station): flags (N,) of problems with a row, and of problems with an angle
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        present, model = weight[:, start : start + rows.count] > 0.0, MODELS[rows.kind]
        rows_of_target = np.flatnonzero(rows.target == target).tolist()
        for index in (rows.a, rows.b)[: model.stations]:
            for i in rows_of_target:
                key = (int(rows.epoch[i]) if moving else 0, int(index[i]))
                found[key] = found.get(key, no_rows) | present[:, i]
                if model.quantity == "angle":
                    sighted[key] = sighted.get(key, no_rows) | present[:, i]
    epoch, station = np.array(list(found), dtype=int).reshape(-1, 2).T
    measured, angular = (np.empty((len(weight), len(found)), dtype=bool) for _ in range(2))
    for k, key in enumerate(found):
        measured[:, k], angular[:, k] = found[key], sighted.get(key, no_rows)
    return epoch, station, measured, angular


def _is_blocked(point: Array, station: Array, present: Array, angular: Array, reach: float) -> Array:
    """Return flags (...) of lines from point to station that pass too deep below the surface; unit sphere coordinates.

    Parameters
    ----------
    point, station : array (..., 3)
        Ends of the line; the ellipsoid is the unit sphere.
    present, angular : bool array (...)
        True if the station has a row, and if one of its rows is an angle.
    reach : float
        Further depth that a line must reach to count, in the same unit.
    """
    # SATELLITE, GRAZE and GROUND are distances from the centre in Earth radii
    satellite = (station**2).sum(-1) > SATELLITE**2
    limit = np.where(satellite, GRAZE, GROUND)
    line = station - point
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        outside = angular | satellite | ((point**2).sum(-1) > SATELLITE**2)
        # the point of the segment nearest to the centre; if it is the far end, nothing is in between
        share = np.clip(-(point * line).sum(-1) / (line**2).sum(-1), 0.0, 1.0)
        nearest = ((point + share[..., None] * line) ** 2).sum(-1)
    return np.asarray(present & outside & (share > 0.0) & (nearest < (limit - reach) ** 2))


def lowest_sight(problem: Problem, x: Array) -> Array:
    """Return the sine (N,) of the elevation of the lowest satellite with rows, as seen from targets x (N, size).

    It is zero in plain Cartesian frames and without satellites. It ranks positions that fit equally well.
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
        epoch, station, measured, _ = _measured_by(problem, target)
        line = stations[:, epoch, station] - point[:, None]
        high = measured & ((stations[:, epoch, station] ** 2).sum(-1) > (SATELLITE * WGS84_A) ** 2)
        sine = (line * up[:, None]).sum(-1) / np.sqrt((line**2).sum(-1))
        worst = np.minimum(worst, np.where(high, sine, np.inf).min(-1, initial=np.inf))
    return np.where(np.isfinite(worst), worst, 0.0)


# Sentences about hidden minima.

# Minima that a sentence locates, and stations that it names for each; further ones are counted.
_PLACED, _NAMED = 2, 3
# Relative tolerance for two refinements of one minimum, in Earth-centred coordinates.
_SAME = 1e-6


def name_hidden(problem: Problem, x: Array, cost: Array) -> Array | None:
    """Return sentences (N,) about minima behind the Earth that break no constraint, or None in plain Cartesian frames.

    Parameters
    ----------
    problem : Problem
        N problems.
    x : array (N, q, size)
        Candidates.
    cost : array (N, q)
        Their costs; infinite for candidates that were not refused.
    """
    if not problem.frame.geodetic or problem.dimension != 3:
        return None
    out = np.full(len(x), "", dtype=object)
    item, slot = np.nonzero(np.isfinite(cost) & np.isfinite(x).all(-1))
    part, points = problem.take(item), x[item, slot]
    behind = is_hidden(part, points) & (violation(part, points) <= TOLERANCE)
    for i in np.unique(item[behind]):
        slots_of_item = np.flatnonzero(behind & (item == i))
        out[i] = _describe(problem, points[slots_of_item], cost[i, slot[slots_of_item]], int(i))
    return out


def first_sentence(one: Array | None, other: Array | None) -> Array | None:
    """Return the sentences (N,) of `one`; if a sentence is empty, the sentence of `other`.

    If either of the two is None, the result is `one`.
    """
    return one if one is None or other is None else np.where(one != "", one, other)


def _describe(problem: Problem, x: Array, cost: Array, item: int) -> str:
    """Return a sentence about minima behind the Earth: costs, positions, and stations that they are hidden from.

    `x` (q, size) and `cost` (q,) are the minima of problem number `item`.
    """
    names = {motion: state_names(motion, len(problem.motions), 0)[0] for motion in range(len(problem.motions))}
    slots = [slot for slot in problem.layout.shared if slot.name in names.values()]
    kept: list[int] = []
    for i in np.argsort(cost, kind="stable"):
        if not any(np.abs(x[i] - x[j]).max() <= _SAME * np.abs(x[j]).max() for j in kept):
            kept.append(int(i))
    lines = (
        f"{len(kept)} minima, the best with chi-square {cost[kept[0]]:.3g}, have stations below their horizon"
        if len(kept) > 1
        else f"the only minimum found, with chi-square {cost[kept[0]]:.3g}, has stations below its horizon"
    )
    places = []
    for j in kept[:_PLACED]:
        below = _below(problem, x[j], item)
        if len(slots) == 1:
            lat, lon, height = problem.frame.to_geodetic(x[j, slots[0].start : slots[0].start + 3])
            below = f"{np.degrees(lat):.3f}, {np.degrees(lon):.3f} deg at {height:.4g} m ({below})"
        places.append(below)
    return f"{lines}: {'; '.join(places)}" + ("; ..." if len(kept) > _PLACED else "")


def _below(problem: Problem, x: Array, item: int) -> str:
    """Return the names of the stations that the Earth hides from a target, three at most and a count of the others.

    The target is at the vector x (size,) of problem number `item`.
    """
    lines = sights(problem.take(np.array([item])))
    found = sorted({int(one) for sight in lines for one in sight.station[sight.blocked(x[None])[0]]})
    names = [problem.stations.names[station] for station in found]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"{', '.join(names[:_NAMED])}{more}"

"""One receiver, one illuminator: a polynomial course straight from delays and angles of several epochs."""

from __future__ import annotations

import numpy as np

from formulations.bistatic import course, triad
from optloc.noise import variances
from optloc.plan import elapsed
from optloc.problem import Problem
from optloc.solve.scale import spread_of
from optloc.types import Array, Rows


def course_starts(problem: Problem) -> Array | None:
    """Return the state (N, order + 1, 3) of the only target, or None where the rows are not of one bistatic pair.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems whose rows are range sums of one pair of still stations, and angles of its receiver.

    Returns
    -------
    array (N, order + 1, 3)
        Position, velocity and acceleration; NaN where the epochs do not determine them.
    """
    found = pair(problem)
    if found is None:
        return None
    receiver, illuminator = found
    size, k = problem.batch_shape[0], problem.epochs
    value, sigma = np.zeros((3, size, k)), np.full((3, size, k), np.inf)
    deviation = np.sqrt(variances(problem.noise, problem.count))
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        kind = ("azimuth", "elevation", "range_sum").index(rows.kind)
        value[kind][:, rows.epoch] = rows.z - rows.correction
        own = deviation[..., start : start + rows.count]
        sigma[kind][:, rows.epoch] = np.where(rows.weight > 0.0, own, np.inf)
    place = np.broadcast_to(problem.stations.position, (size, *problem.stations.position.shape[-3:]))[:, 0]
    home, away = place[:, receiver], place[:, illuminator] - place[:, receiver]
    length = float(spread_of(problem)[1][0])
    axes = triad(value[0], value[1])
    if problem.stations.axes is not None:
        own = np.broadcast_to(problem.stations.axes, (size, *problem.stations.axes.shape[-4:]))[:, 0, receiver]
        axes = axes @ own[:, None]
    excess = value[2] - np.sqrt((away**2).sum(-1))[:, None]
    spread = np.stack([np.cos(value[1]) * sigma[0], sigma[1], sigma[2] / length], axis=-1)
    since, order = elapsed(problem, 0), problem.motions[0].order
    fitted = course(excess / length, axes, away / length, np.broadcast_to(since, (size, k)), spread, order=order)
    state = fitted.coefficients * length * np.array([1.0, 1.0, 2.0])[: order + 1, None]
    state[:, 0] += home
    return np.asarray(state)


def pair(problem: Problem) -> tuple[int, int] | None:
    """Return receiver and illuminator of all rows, or None where they are not of one bistatic pair that stays."""
    kinds = {rows.kind: rows for rows in problem.rows}
    if problem.dimension != 3 or set(kinds) != {"range_sum", "azimuth", "elevation"} or len(kinds) != len(problem.rows):
        return None
    if problem.stations.position.shape[-3] > 1 or not all(_once(rows) for rows in problem.rows):
        return None
    ends = {(int(a), int(b)) for a, b in zip(kinds["range_sum"].a, kinds["range_sum"].b, strict=True)}
    heard = {int(a) for kind in ("azimuth", "elevation") for a in kinds[kind].a}
    if len(heard) != 1 or len({frozenset(end) for end in ends}) != 1:
        return None
    receiver = heard.pop()
    others = {a if b == receiver else b for a, b in ends if receiver in (a, b)}
    return (receiver, others.pop()) if len(others) == 1 else None


def _once(rows: Rows) -> bool:
    return len(np.unique(rows.epoch)) == rows.count

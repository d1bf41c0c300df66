"""Fits to whole tracks, and to a target that stays: pseudo-linear, instrumental, maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.bounds import crlb
from optloc.build import assemble, measured
from optloc.papers.angles import trials
from optloc.papers.angles.filters import STRAIGHT_START
from optloc.papers.angles.scenario import STRAIGHT, TIME_CONSTANT
from optloc.papers.angles.trials import Draw
from optloc.papers.report import Tick
from optloc.problem import Problem
from optloc.simulate import simulate
from optloc.solve import solve
from optloc.solve.angles import courses
from optloc.track import current_statistical
from optloc.track.batch import fitted
from optloc.types import Array, Motion

PLACE = np.array([-10e3, 50e3, 10e3])
"""A target that stays, metres."""


@dataclass(frozen=True, slots=True)
class Rays:
    """Fixes of a target that stays.

    Parameters
    ----------
    stations : int
        How many there are.
    sigma : float
        Standard deviation of an angle, radians.
    bound : float
        Root of the trace of the Cramer-Rao bound, metres.
    fixes : tuple of tuple of float
        Length of the mean error, and root mean square error, of each fix in metres: plain, weighted, instrumental,
        maximum likelihood.
    """

    stations: int
    sigma: float
    bound: float
    fixes: tuple[tuple[float, float], ...]


def whole_track_bound() -> Array:
    """Return the bound (3,) of position, velocity and acceleration at the end of simulation 1."""
    run = replace(STRAIGHT.problem(), motions=(Motion(2, reference=float(STRAIGHT.epochs)),))
    return np.asarray(np.sqrt(np.diagonal(crlb(run, STRAIGHT.truth[-1])).reshape(3, -1).sum(-1)))


def wholes(drawn: Draw, tick: Tick) -> list[tuple[str, Array]]:
    """Return errors (3,) at the end of simulation 1 of fits to the whole track, and of the filter."""
    run = replace(drawn.problem, motions=(Motion(2, reference=float(STRAIGHT.epochs)),))
    exact, unit = STRAIGHT.truth[-1], np.array([1.0, 1.0, 2.0])[:, None]
    found = courses(run)
    assert found is not None
    parts = {"plain": found.plain, "weighted": found.weighted, "instrumental variables": found.instrumental}
    out = [(name, _parts((unit * c).reshape(len(c), -1) - exact)) for name, c in parts.items()]
    out.append(("maximum likelihood (optloc)", _parts(fitted(drawn.problem, 2).x - exact)))
    start = trials.placed(drawn, STRAIGHT_START, known=2)
    for limit in (30.0, 2.0):
        track = trials.tracked(drawn, start, current_statistical(TIME_CONSTANT, limit))
        out.append((f"filter, a_max {limit:g}", _parts(track.mean[:, -1] - exact)))
    tick()
    return out


def rays(count: int, seed: int, key: int, tick: Tick) -> list[Rays]:
    """Return fixes of a target that stays, from few stations and from many."""
    out = []
    for i, (stations, sigma) in enumerate(((2, 0.05), (4, 0.05), (50, 0.02), (50, 0.05))):
        run = still(stations, sigma)
        drawn = simulate(run, PLACE, np.random.SeedSequence(seed, spawn_key=(key + i,)), trials=count)
        found = courses(drawn)
        assert found is not None
        fixes = [c[:, 0] for c in (found.plain, found.weighted, found.instrumental)]
        fixes.append(solve(drawn).position)
        least = float(np.sqrt(np.trace(crlb(run, PLACE))))
        out.append(Rays(stations, sigma, least, tuple(_bias(each - PLACE) for each in fixes)))
        tick()
    return out


def still(count: int, sigma: float) -> Problem:
    """Return one epoch of the angles of a target that stays.

    Two stations are those of simulation 3. More, whose places the text does not give, stand between them, every other
    one 20 km further away from the target.
    """
    place = np.zeros((count, 3))
    place[:, 0] = np.linspace(-40e3, 40e3, count)
    place[:, 1] = np.where(np.arange(count) % 2, 0.0, -20e3) * (count > 2)
    a = np.arange(count)
    return assemble(place, *(measured(kind, a=a, sigma=sigma) for kind in ("azimuth", "elevation")))


def _parts(error: Array) -> Array:
    return np.asarray(np.sqrt((error.reshape(len(error), 3, -1) ** 2).sum(-1).mean(0)))


def _bias(error: Array) -> tuple[float, float]:
    good = error[np.isfinite(error).all(-1)]
    return float(np.linalg.norm(good.mean(0))), float(np.sqrt((good**2).sum(-1).mean()))

"""Filters in the three simulations: errors against time, bounds and lost tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.papers.angles import trials
from optloc.papers.angles.scenario import READINGS, REPAIRED, STRAIGHT, TIME_CONSTANT, WINDING, Scenario
from optloc.papers.angles.trials import Draw, Sigmas
from optloc.papers.angles.variants import printed_transition, printed_variance
from optloc.papers.report import Tick
from optloc.track import Dynamics, State, current_statistical, polynomial
from optloc.types import Array

STRAIGHT_START: Sigmas = (0.1, 0.1, 0.2)
WINDING_START: Sigmas = (0.1, 2.0, 1.0)
CIRCLE_START = (500.0, 50.0)
"""Standard deviations of the starts; of velocity and acceleration in simulation 3, which begins at a fix."""

SETTLED = 20
"""Seconds of simulation 3 that are not scored."""


@dataclass(frozen=True, slots=True)
class Curve:
    """Errors against time.

    Parameters
    ----------
    label : str
        What made them.
    seconds : array (q,)
        When.
    error : array (q, 3)
        Root mean square errors, or bounds, of position, velocity and acceleration.
    """

    label: str
    seconds: Array
    error: Array

    def total(self, first: int = 0, last: int | None = None) -> Array:
        """Return the root mean square (3,) over first < t <= last seconds."""
        inside = (self.seconds > first) & (self.seconds <= (np.inf if last is None else last))
        return np.asarray(np.sqrt((self.error[inside] ** 2).mean(0)))

    def phases(self, scenario: Scenario) -> list[float]:
        """Return the root mean square position error of each phase; the first `SETTLED` seconds do not count."""
        first = (SETTLED, *scenario.phases[:-1])
        return [float(self.total(a, b)[0]) for a, b in zip(first, scenario.phases, strict=True)]


def curve(label: str, drawn: Draw, start: State, dynamics: Dynamics, update: str = "ekf") -> Curve:
    """Return the errors of the tracks from a start."""
    return scored(label, drawn, trials.tracked(drawn, start, dynamics, update).mean)


def scored(label: str, drawn: Draw, mean: Array) -> Curve:
    """Return the errors of states (trials, q, n) at the last q epochs."""
    error = trials.rms(trials.errors(drawn, mean), (0,))
    last = drawn.scenario.epochs
    return Curve(label, np.arange(last - len(error) + 1.0, last + 1.0), error)


def bounded(label: str, scenario: Scenario, start: State, dynamics: Dynamics) -> Curve:
    """Return the posterior bound from a start."""
    least = trials.bound(scenario, start, dynamics)
    return Curve(label, np.arange(start.time + 1.0, scenario.epochs + 1.0), least)


def straight(drawn: Draw, tick: Tick) -> list[Curve]:
    """Return simulation 1: the filter with the right and the printed transition, three limits, and bounds."""
    start, out = trials.placed(drawn, STRAIGHT_START, known=2), []
    for limit in (30.0, 2.0, 0.3):
        for label, make in (("filter", current_statistical), ("printed f33", printed_transition)):
            out.append(curve(f"{label}, a_max {limit:g}", drawn, start, make(TIME_CONSTANT, limit)))
            tick()
    out.append(bounded("posterior bound, a_max 2", STRAIGHT, start, trials.fixed_variance(2.0)))
    out.append(bounded("bound of one track", STRAIGHT, start, polynomial(2)))
    tick()
    return out


def winding(drawn: Draw, tick: Tick) -> list[Curve]:
    """Return simulation 2: started at rest, and by a fit of the first three epochs."""
    model = current_statistical(TIME_CONSTANT, 30.0)
    start = trials.placed(drawn, WINDING_START, known=1)
    out = [
        curve("filter, started at rest", drawn, start, model),
        curve("filter, started by a fit of 3 s", drawn, trials.fitted_start(drawn, 3), model, "iekf"),
        bounded("posterior bound", WINDING, start, trials.fixed_variance(30.0)),
    ]
    tick()
    return out


def circles(drawn: Draw, tick: Tick) -> dict[float, list[Curve]]:
    """Return the repaired simulation 3 by limit: three filters and the bound."""
    start, out = trials.first_fix(drawn, *CIRCLE_START), {}
    places = trials.fixes(drawn)
    tick()
    for limit in (100.0, 300.0):
        model = current_statistical(TIME_CONSTANT, limit)
        out[limit] = [
            curve("single step", drawn, start, model),
            curve("converged", drawn, start, model, "iekf"),
            scored("fixes, then a linear filter", drawn, trials.linear_track(places, start, model)),
            bounded("posterior bound", REPAIRED, start, trials.fixed_variance(limit)),
        ]
        tick()
    return out


@dataclass(frozen=True, slots=True)
class Reading:
    """Position errors and bounds of the phases of simulation 3 as printed.

    Parameters
    ----------
    scenario : Scenario
        One of `READINGS`.
    limit : float
        Largest acceleration of the model.
    error, bound : list of float
        Metres, by phase.
    """

    scenario: Scenario
    limit: float
    error: list[float]
    bound: list[float]


def readings(count: int, seed: int, key: int, tick: Tick) -> list[Reading]:
    """Return simulation 3 as printed."""
    out = []
    for i, scenario in enumerate(READINGS):
        drawn = trials.draw(scenario, count, seed, key + i)
        start = trials.first_fix(drawn, *CIRCLE_START)
        for limit in (100.0, 300.0):
            found = curve("", drawn, start, current_statistical(TIME_CONSTANT, limit))
            tick()
            least = bounded("", scenario, start, trials.fixed_variance(limit))
            out.append(Reading(scenario, limit, found.phases(scenario), least.phases(scenario)))
            tick()
    return out


def snapshot() -> Curve:
    """Return the bound of every second of the repaired simulation 3 by itself, whose last two columns are NaN."""
    least = trials.snapshot_bound(REPAIRED)
    error = np.full((len(least), 3), np.nan)
    error[:, 0] = least
    return Curve("snapshot", np.arange(1.0, len(least) + 1.0), error)


@dataclass(frozen=True, slots=True)
class Lost:
    """Shares of lost tracks of simulation 1.

    Parameters
    ----------
    sigma : float
        Standard deviation of each coordinate of the start, metres; 0 for a fit of the first epochs.
    limit : float
        Largest acceleration of the model.
    share : mapping of str to float
        By filter.
    """

    sigma: float
    limit: float
    share: dict[str, float]


def starts(drawn: Draw, tick: Tick) -> list[Lost]:
    """Return who is lost from starts on the line through the stations, and from a fit of three epochs."""
    out = []
    fit = trials.fitted_start(drawn, 3)
    for sigma, limit in ((1.0, 5.0), (1.0, 30.0), (3.0, 5.0), (3.0, 30.0), (0.0, 30.0)):
        start = trials.scattered(drawn, (sigma, 0.1, 0.2)) if sigma else fit
        model = current_statistical(TIME_CONSTANT, limit)
        names = ("ekf", "iekf", "mgekf", "mvekf")
        out.append(Lost(sigma, limit, {n: trials.lost(drawn, trials.tracked(drawn, start, model, n)) for n in names}))
        tick()
    return out


def clamps(drawn: Draw, tick: Tick) -> dict[str, float]:
    """Return the share of lost tracks with the variance as published and clamped, from 3 m and with a_max 0.3."""
    start = trials.scattered(drawn, (3.0, 0.1, 0.2))
    models = {"as published": printed_variance, "clamped": current_statistical}
    found = {
        name: trials.lost(drawn, trials.tracked(drawn, start, make(TIME_CONSTANT, 0.3)))
        for name, make in models.items()
    }
    tick()
    return found


def ends(drawn: Draw, tick: Tick) -> dict[str, Array]:
    """Return the distances (trials,) from the truth at the end of simulation 1, by start and filter."""
    model = current_statistical(TIME_CONSTANT, 30.0)
    start = trials.scattered(drawn, (1.0, 0.1, 0.2))
    tracks = {
        "single step (the paper), start of 1 m": trials.tracked(drawn, start, model, "ekf"),
        "converged, start of 1 m": trials.tracked(drawn, start, model, "iekf"),
        "single step, started by a fit of 3 s": trials.tracked(drawn, trials.fitted_start(drawn, 3), model, "ekf"),
    }
    tick()
    return {name: trials.distances(drawn, track) for name, track in tracks.items()}

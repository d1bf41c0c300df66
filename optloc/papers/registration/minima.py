"""The second minimum of a flat array: the target's image in the plane of the stations."""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc, sqrt

import numpy as np

from optloc.evaluate import predict
from optloc.papers.registration.scenario import Scenario, problem, truth
from optloc.solve import solve
from optloc.types import Array

_SAME = 1.0


@dataclass(frozen=True, slots=True)
class Ghost:
    """Another minimum of the cost of noise-free measurements.

    Parameters
    ----------
    x : array (n,)
        Its parameter vector.
    gap : float
        Its cost: a weighted sum of squares, zero at the truth.
    """

    x: Array
    gap: float

    @property
    def doubt(self) -> float:
        """Return the probability that noise makes it cheaper than the truth."""
        return 0.5 * erfc(sqrt(self.gap) / 2.0 / sqrt(2.0))


def mirror(scenario: Scenario) -> tuple[Array, Array]:
    """Return place at t = 0 and velocity, (3,) each, of the target's image in the plane of the stations.

    The plane is the one that fits the stations best at t = 0, and moves with their mean velocity.
    """
    centre = scenario.position.mean(0)
    normal = np.linalg.svd(scenario.position - centre)[2][-1]
    course = np.zeros(3) if scenario.course is None else scenario.course
    drift = scenario.velocity.mean(0)
    place = scenario.target - 2.0 * ((scenario.target - centre) @ normal) * normal
    return place, course - 2.0 * ((course - drift) @ normal) * normal


def ghost(scenario: Scenario, epochs: int, *, sigma: float | None = None, station_sigma: float = 1.0) -> Ghost | None:
    """Return the minimum to which the mirror image of the target leads, or None where that is the truth.

    Parameters
    ----------
    scenario : Scenario
        Stations and target.
    epochs : int
        Number of epochs.
    sigma, station_sigma : float
        As `problem` takes them.
    """
    made = problem(scenario, epochs, sigma=sigma, station_sigma=station_sigma)
    exact = truth(scenario, made)
    place, velocity = mirror(scenario)
    if scenario.course is None:
        state = place + 0.5 * scenario.times(epochs)[-1] * velocity
    else:
        state = np.concatenate([place, velocity])
    start = np.concatenate([state, exact[len(state) :]])
    fix = solve(made.with_rows(z=predict(made, exact)), "lsr", start=start)
    if np.linalg.norm(fix.x[:3] - exact[:3]) < _SAME:
        return None
    return Ghost(fix.x, float(fix.cost))

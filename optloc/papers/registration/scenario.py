"""The scenes of the paper, as printed, and one more whose stations span space and never meet."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from optloc.bias import with_bias
from optloc.build import assemble, measured
from optloc.noise import Block, Noise
from optloc.problem import Problem
from optloc.types import Array, Motion, Stations

SPEED = 3e8
"""Speed of light of the paper, metres per second; with it 100 ns are exactly 30 m."""

NANOSECOND = 1e-9 * SPEED

Shape = Literal["full", "half", "diag"]

# Variance of a row's own noise, and of what all rows of an epoch share, over sigma squared.
_SHAPES: dict[Shape, tuple[float, float]] = {"full": (1.0, 1.0), "half": (0.5, 0.5), "diag": (1.0, 0.0)}


@dataclass(frozen=True, slots=True)
class Scenario:
    """Stations that fly straight, one target, and the systematic errors of their channels.

    The first station is the reference of every difference and ratio.

    Parameters
    ----------
    position, velocity : array (s, 3)
        Stations at t = 0, metres and metres per second.
    target : array (3,)
        Its place at t = 0, metres.
    course : array (3,), optional
        Its velocity, metres per second; None: it stays, and nothing but its place is unknown.
    delays : array (s - 1,)
        Biases of the range differences, metres.
    gains : array (s - 1,)
        Biases of the gain ratios.
    sigma : float
        Standard deviation of an arrival, metres.
    interval : float
        Seconds between epochs.
    """

    position: Array
    velocity: Array
    target: Array
    course: Array | None = None
    delays: Array = field(default_factory=lambda: np.array([30.0, -40.0, 50.0, -30.0]))
    gains: Array = field(default_factory=lambda: np.array([0.3, -0.4, 0.5, -0.3]))
    sigma: float = 3.0
    interval: float = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the stations: "1", "2" and so on."""
        return tuple(str(i + 1) for i in range(len(self.position)))

    def times(self, epochs: int) -> Array:
        """Return the seconds (k,) of the first epochs."""
        return self.interval * np.arange(epochs)

    def track(self, epochs: int) -> Array:
        """Return the positions (k, s, 3) of the stations, metres."""
        return np.asarray(self.position + self.times(epochs)[:, None, None] * self.velocity)


def _fleet(*rows: tuple[float, ...]) -> tuple[Array, Array]:
    """Return positions and velocities of stations given in kilometres and metres per second."""
    table = np.array(rows, dtype=float)
    return 1e3 * table[:, :3], table[:, 3:]


PRINTED = Scenario(
    *_fleet(
        (0, 0, 10, 0, 300, 0),
        (-15, 0, 10, 0, 300, 0),
        (15, 0, 10, 0, 300, 0),
        (-5, 30, 0, 100, 300, 0),
        (5, 30, 0, -100, 300, 0),
    ),
    target=np.array([200e3, 300e3, 0.0]),
)
"""Table 1 as printed: all stations lie in one plane at every epoch, and the fourth and fifth meet at 50 s."""

MOVING = replace(PRINTED, target=np.array([200e3, 300e3, 5e3]), course=np.array([-100.0, 0.0, 0.0]))
"""The same stations and the target of section 4.4, which flies straight."""

SPATIAL = Scenario(
    *_fleet(
        (0, 0, 10, 0, 300, 0),
        (-15, 0, 6, -20, 290, 0),
        (15, 0, 9, 20, 290, 0),
        (-8, 30, 3, -60, 300, 0),
        (8, 30, 11, 60, 280, 0),
    ),
    target=np.array([200e3, 300e3, 0.0]),
)
"""Stations of like size and speed that span space at every epoch and keep their distance."""


def problem(
    scenario: Scenario,
    epochs: int,
    *,
    sigma: float | None = None,
    station_sigma: float = 1.0,
    gain_sigma: float | None = None,
    prior: float | None = None,
    shape: Shape = "full",
) -> Problem:
    """Return the estimation problem of the first epochs of a scene, without measurements.

    Parameters
    ----------
    scenario : Scenario
        Stations and target.
    epochs : int
        Number of epochs K.
    sigma : float, optional
        Standard deviation of an arrival, metres; that of the scene by default.
    station_sigma : float
        Standard deviation of each coordinate of a station, drawn anew at each epoch, metres; 0 for exact stations.
    gain_sigma : float, optional
        Standard deviation of a gain ratio; None: time differences only.
    prior : float, optional
        Prior standard deviation of the biases of the range differences, metres; None: unknown.
    shape : "full", "half" or "diag"
        Covariance of the rows of one kind and epoch: sigma^2 times I + 11', its half, or I. The paper's text allows
        all three, its numbers only the first.

    Returns
    -------
    Problem
        Unknowns: position, velocity where the target moves, "delay", and "gain" with gain ratios.
    """
    count, spread = len(scenario.position), scenario.sigma if sigma is None else sigma
    a, epoch = np.tile(np.arange(1, count), epochs), np.repeat(np.arange(epochs), count - 1)
    kinds = {"tdoa": spread} if gain_sigma is None else {"tdoa": spread, "groa": gain_sigma}
    rows = [measured(kind, a=a, b=0, epoch=epoch, sigma=size) for kind, size in kinds.items()]
    covariance = np.broadcast_to(station_sigma**2 * np.eye(3), (count, 3, 3)) if station_sigma else None
    made = assemble(
        Stations(scenario.track(epochs), scenario.names, covariance=covariance, span="noise"),
        *rows,
        times=scenario.times(epochs),
        motions=[Motion(order=0 if scenario.course is None else 1)],
    )
    own, common = _SHAPES[shape]
    unit = own * np.eye(count - 1) + common
    members = np.arange(made.count).reshape(-1, count - 1)
    blocks = [
        Block(part, size**2 * unit[None])
        for part, size in zip(np.split(members, len(kinds)), kinds.values(), strict=True)
    ]
    made = with_bias(replace(made, noise=Noise(tuple(blocks))), "delay", per="pair", kind="tdoa", sigma=prior)
    return made if gain_sigma is None else with_bias(made, "gain", per="pair", kind="groa")


def truth(scenario: Scenario, problem: Problem) -> Array:
    """Return the true parameter vector (size,) of a problem of a scene."""
    values = {
        "position": scenario.target,
        "velocity": scenario.course,
        "delay": scenario.delays,
        "gain": scenario.gains,
    }
    return np.concatenate([np.asarray(values[slot.name], dtype=float) for slot in problem.layout.shared])

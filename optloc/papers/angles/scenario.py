"""The three simulations of the paper, as printed where they can be and repaired where not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.build import assemble, measured
from optloc.problem import Problem
from optloc.types import Array, Motion

TIME_CONSTANT = 10.0
"""The "manoeuvre constant 10": seconds after which the acceleration has forgotten 63 % of itself."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Two stations that stay, and a target whose state is written down.

    Parameters
    ----------
    name : str
        For tables.
    stations : array (s, d)
        Metres; in the plane there are azimuths only.
    states : array (k + 1, 3, d)
        Position, velocity and acceleration of the target at 0, 1, ... k seconds; it is measured from 1 s on.
    sigma : float
        Standard deviation of an angle, radians.
    phases : tuple of int
        Epoch behind the last of each phase.
    """

    name: str
    stations: Array
    states: Array
    sigma: float
    phases: tuple[int, ...]

    @property
    def epochs(self) -> int:
        """Return the number of epochs k."""
        return len(self.states) - 1

    @property
    def dimension(self) -> int:
        """Return 2 or 3."""
        return int(self.stations.shape[1])

    @property
    def truth(self) -> Array:
        """Return the true states (k + 1, 3 d), ordered [p, v, a]."""
        return self.states.reshape(len(self.states), -1)

    def problem(self, order: int | None = None) -> Problem:
        """Return the run without measurements.

        Parameters
        ----------
        order : int, optional
            Of the polynomial that the target follows, its state held at the last epoch; None: any course.
        """
        count, k = len(self.stations), self.epochs
        a, epoch = np.tile(np.arange(count), k), np.repeat(np.arange(k), count)
        times = np.arange(1.0, k + 1.0)
        kinds = ("azimuth", "elevation")[: self.dimension - 1]
        motion = Motion(span="epoch") if order is None else Motion(order, reference=float(k))
        rows = [measured(kind, a=a, epoch=epoch, sigma=self.sigma) for kind in kinds]
        return assemble(self.stations, *rows, times=times, motions=(motion,))


def _straight() -> Scenario:
    t, zero = np.arange(51.0), np.zeros(51)
    states = np.stack(
        [
            np.stack([2.0 * t + 0.1 * t**2, zero], -1),
            np.stack([2.0 + 0.2 * t, zero], -1),
            np.stack([zero + 0.2, zero], -1),
        ],
        axis=1,
    )
    return Scenario("simulation 1", _BASE, states, _FINE, (50,))


def _winding() -> Scenario:
    t, rate = np.arange(51.0), np.pi / 36.0
    sine, cosine = 10.0 * np.sin(rate * t), 10.0 * np.cos(rate * t)
    states = np.stack(
        [
            np.stack([2.0 * t, sine], -1),
            np.stack([np.full(51, 2.0), rate * cosine], -1),
            np.stack([np.zeros(51), -(rate**2) * sine], -1),
        ],
        axis=1,
    )
    return Scenario("simulation 2", _BASE, states, _FINE, (50,))


def phased(name: str, speeds: tuple[float, float], seconds: tuple[int, int, int], rate: float) -> Scenario:
    """Return simulation 3: straight, in a circle of 3 km, straight.

    Parameters
    ----------
    name : str
        For tables.
    speeds : tuple of two float
        On the straight parts, towards (2, 1, 0), and in the circle, m/s.
    seconds : tuple of three int
        How long each part lasts.
    rate : float
        Turn to the left, radians per second.
    """
    along, across = np.array([2.0, 1.0, 0.0]) / np.sqrt(5.0), np.array([-1.0, 2.0, 0.0]) / np.sqrt(5.0)
    slow, fast = speeds
    radius, turn = fast / rate, rate * seconds[1]
    one, two, three = (np.arange(n + 1.0)[:, None] for n in seconds)
    leave = np.array([-10e3, 50e3, 10e3]) + slow * seconds[0] * along
    sine, cosine = np.sin(rate * two), np.cos(rate * two)
    circle = [
        leave + radius * (sine * along + (1.0 - cosine) * across),
        fast * (cosine * along + sine * across),
        fast * rate * (cosine * across - sine * along),
    ]
    heading = np.cos(turn) * along + np.sin(turn) * across
    # Where the heading has turned back, the paper's velocity is that of its first part again.
    heading = heading if slow == fast else along
    parts = [
        [np.array([-10e3, 50e3, 10e3]) + slow * one * along, slow * along + 0.0 * one, 0.0 * one * along],
        circle,
        [circle[0][-1] + slow * three * heading, slow * heading + 0.0 * three, 0.0 * three * heading],
    ]
    states = np.concatenate([np.stack(part, axis=1)[i > 0 :] for i, part in enumerate(parts)])
    ends = np.cumsum(seconds)
    return Scenario(name, _WIDE, states, 5e-3, tuple(int(end) for end in ends))


_BASE = np.array([[0.0, 50.0], [0.0, 100.0]])
_WIDE = np.array([[-40e3, 0.0, 0.0], [40e3, 0.0, 0.0]])
_FINE = float(np.deg2rad(1e-3))
_RATE = 0.157

STRAIGHT = _straight()
"""Simulation 1: constant acceleration. The stations and the place at t = 0 lie on one line."""

WINDING = _winding()
"""Simulation 2: a sine."""

REPAIRED = phased("repaired", (150.0 * np.pi, 150.0 * np.pi), (100, 40, 100), np.pi / 20.0)
"""Simulation 3 with one speed, one full turn and straight parts of 100 s."""

SLOW = phased("m/s", (np.hypot(0.2, 0.1) * 1e3, 3e3 * _RATE), (1500, 500, 1000), _RATE)
"""Simulation 3 as printed."""

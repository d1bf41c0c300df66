"""The three simulations of the paper, as printed where they can be and repaired where not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.build import assemble, measured
from optloc.problem import Problem
from optloc.types import Array, Motion

TIME_CONSTANT = 10.0
"""The "manoeuvre constant 10": seconds after which a deviation of the acceleration has fallen to 1/e."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Two stations that stay, and a target whose states are written down.

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
        Last second of each phase.
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

    def problem(self) -> Problem:
        """Return the run without measurements; every epoch has a position of its own."""
        count, k = len(self.stations), self.epochs
        a, epoch = np.tile(np.arange(count), k), np.repeat(np.arange(k), count)
        kinds = ("azimuth", "elevation")[: self.dimension - 1]
        rows = [measured(kind, a=a, epoch=epoch, sigma=self.sigma) for kind in kinds]
        return assemble(self.stations, *rows, times=np.arange(1.0, k + 1.0), motions=(Motion(span="epoch"),))


def _states(*parts: tuple[Array, Array, Array]) -> Array:
    """Return positions, velocities and accelerations (k + 1, d) as states; each part begins where the last ended."""
    return np.concatenate([np.stack(part, axis=1)[i > 0 :] for i, part in enumerate(parts)])


def _straight() -> Scenario:
    t, still = np.arange(51.0)[:, None], np.zeros((51, 2))
    ahead = np.array([1.0, 0.0])
    states = _states(((2.0 * t + 0.1 * t**2) * ahead, (2.0 + 0.2 * t) * ahead, still + 0.2 * ahead))
    return Scenario("simulation 1", _BASE, states, _FINE, (50,))


def _winding() -> Scenario:
    t, rate = np.arange(51.0), np.pi / 36.0
    wave, zero = np.exp(1j * rate * t), np.zeros(51)
    parts = [
        np.stack(pair, axis=-1)
        for pair in (
            (2.0 * t, 10.0 * wave.imag),
            (zero + 2.0, 10.0 * rate * wave.real),
            (zero, -10.0 * rate**2 * wave.imag),
        )
    ]
    return Scenario("simulation 2", _BASE, _states((parts[0], parts[1], parts[2])), _FINE, (50,))


def circling(name: str, slow: float, fast: float, rate: float, seconds: tuple[int, int, int]) -> Scenario:
    """Return simulation 3: straight, in a circle, straight.

    Parameters
    ----------
    name : str
        For tables.
    slow, fast : float
        Speed on the straight parts, which begin towards (2, 1, 0), and in the circle, m/s.
    rate : float
        Turn to the left, radians per second.
    seconds : tuple of three int
        How long each part lasts.

    Notes
    -----
    The last part has the velocity of the first, as printed, whatever the heading at the end of the circle.
    """
    ahead, left = np.array([2.0, 1.0, 0.0]) / np.sqrt(5.0), np.array([-1.0, 2.0, 0.0]) / np.sqrt(5.0)
    one, two, three = (np.arange(n + 1.0)[:, None] for n in seconds)
    begin, radius = np.array([-10e3, 50e3, 10e3]), fast / rate
    leave = begin + slow * seconds[0] * ahead
    sine, cosine = np.sin(rate * two), np.cos(rate * two)
    circle = leave + radius * (sine * ahead + (1.0 - cosine) * left)
    states = _states(
        (begin + slow * one * ahead, slow * ahead + 0.0 * one, 0.0 * one * ahead),
        (circle, fast * (cosine * ahead + sine * left), fast * rate * (cosine * left - sine * ahead)),
        (circle[-1] + slow * three * ahead, slow * ahead + 0.0 * three, 0.0 * three * ahead),
    )
    ends = np.cumsum(seconds)
    return Scenario(name, _WIDE, states, 5e-3, (int(ends[0]), int(ends[1]), int(ends[2])))


_BASE = np.array([[0.0, 50.0], [0.0, 100.0]])
_WIDE = np.array([[-40e3, 0.0, 0.0], [40e3, 0.0, 0.0]])
_FINE = float(np.deg2rad(1e-3))
_RATE, _RADIUS = 0.157, 3e3
_PRINTED = (1500, 500, 1000)

STRAIGHT = _straight()
"""Simulation 1: constant acceleration. The stations and the place at t = 0 lie on one line."""

WINDING = _winding()
"""Simulation 2: a sine."""

REPAIRED = circling("repaired", _RADIUS * np.pi / 20.0, _RADIUS * np.pi / 20.0, np.pi / 20.0, (100, 40, 100))
"""Simulation 3 with one speed, 471 m/s, one full turn in 40 s, and straight parts of 100 s."""

READINGS = (
    circling("as printed, in m/s", float(np.hypot(0.2, 0.1)), _RADIUS * _RATE, _RATE, _PRINTED),
    circling("as printed, in km/s", 1e3 * float(np.hypot(0.2, 0.1)), _RADIUS * _RATE, _RATE, _PRINTED),
)
"""Simulation 3 as printed: the speed of the straight parts has no unit."""

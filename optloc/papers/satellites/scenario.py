"""The scene of the paper, as printed: three satellites that stay above the Earth, and a slow target on the sea."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.build import assemble, measured, station_array
from optloc.constraints import height as known_height
from optloc.frames import ECEF, geodetic_to_ecef
from optloc.problem import Problem
from optloc.track.dynamics import Dynamics, polynomial
from optloc.types import Array, Motion
from optloc.units import SPEED_OF_LIGHT

SATELLITES = geodetic_to_ecef(
    np.radians([24.44, 25.09, 24.44]), np.radians([125.21, 125.68, 125.99]), np.full(3, 800e3)
)
"""Positions (3, 3), ECEF metres: 800 km high, about 90 km apart."""

START = geodetic_to_ecef(np.radians(25.80), np.radians(127.37), 0.0)
"""First position of the target, ECEF metres."""

COURSE = np.array([20.0, 20.0, 0.0])
"""Its velocity as printed, ECEF metres per second: it climbs by 3.4 m/s."""

SIGMA = 50e-9 * SPEED_OF_LIGHT
"""Standard deviation of a range difference, metres: 50 ns."""

HEIGHT = 500.0
"""Standard deviation of the assumed height, metres."""

DRIVE = 0.01
"""Standard deviation of the acceleration, m/s^2: that of a ship."""

ORBIT = 7.4e3
"""Speed of satellites that really move, metres per second."""


def dynamics() -> Dynamics:
    """Return the motion that the filters assume: constant velocity, driven by white accelerations."""
    return polynomial(1, DRIVE)


def surface_course() -> Array:
    """Return the velocity (3,) without what makes the target climb."""
    up = ECEF.enu_axes(START)[2]
    return np.asarray(COURSE - (COURSE @ up) * up)


def orbits(epochs: int, heading: float, *, interval: float = 1.0) -> Array:
    """Return satellites (epochs, 3, 3) that circle the centre of the Earth together.

    Parameters
    ----------
    epochs : int
        Number of epochs.
    heading : float
        Direction of flight of the formation's centre, radians from north towards east.
    interval : float
        Seconds between epochs.
    """
    centre = SATELLITES.mean(0)
    east, north, _ = ECEF.enu_axes(centre)
    along = np.cos(heading) * north + np.sin(heading) * east
    axis = np.cross(centre / np.linalg.norm(centre), along)
    axis /= np.linalg.norm(axis)
    angle = ORBIT * interval * np.arange(epochs)[:, None, None] / np.linalg.norm(centre)
    across = (SATELLITES @ axis)[:, None] * axis
    turned = (SATELLITES - across) * np.cos(angle) + np.cross(axis, SATELLITES) * np.sin(angle)
    return np.asarray(turned + across)


def problem(
    epochs: int,
    *,
    order: int = 1,
    height: float | None = HEIGHT,
    satellites: Array = SATELLITES,
    correlated: bool = False,
) -> Problem:
    """Return the estimation problem of the first epochs, one a second, without measurements.

    Parameters
    ----------
    epochs : int
        Number of epochs.
    order : 0 or 1
        Order of the target's motion.
    height : float, optional
        Standard deviation of the height measured at each epoch, metres; None: it is exactly zero.
    satellites : array (3, 3) or (epochs, 3, 3)
        Positions, ECEF metres.
    correlated : bool
        Whether both differences share the first satellite's arrival, each arrival having 50 ns over the root of 2.
    """
    epoch = np.arange(epochs)
    noise = {"arrival_sigma": SIGMA / np.sqrt(2.0)} if correlated else {"sigma": SIGMA}
    pairs = {"a": np.tile([0, 0], epochs), "b": np.tile([1, 2], epochs), "epoch": np.repeat(epoch, 2)}
    rows = [measured("tdoa", **pairs, **noise)]
    if height is not None:
        rows.append(measured("height", epoch=epoch, sigma=height))
    made = assemble(station_array(satellites), *rows, frame=ECEF, motions=[Motion(order)])
    return made if height is not None else replace(made, constraints=known_height(exactly=0.0))


def truth(epochs: int, course: Array = COURSE) -> Array:
    """Return the true states (epochs, 6) of a target that moves uniformly, ECEF."""
    place = START + np.arange(epochs)[:, None] * course
    return np.concatenate([place, np.broadcast_to(course, (epochs, 3))], axis=1)

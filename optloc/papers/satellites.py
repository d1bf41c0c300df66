"""Monte Carlo trials of the four filters: from fixes, from starts that are far off, with several kinds of height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.frames import ECEF, ecef_to_geodetic, geodetic_to_ecef
from optloc.base.types import Array, Motion
from optloc.base.units import SPEED_OF_LIGHT
from optloc.bounds.crlb import crlb
from optloc.linear.constraints import height as known_height
from optloc.linear.simulate import simulate
from optloc.problem.bias import with_bias
from optloc.problem.build import assemble, measured, station_array
from optloc.problem.epochs import cut
from optloc.problem.problem import Problem
from optloc.solvers import solve
from optloc.track.batch import posterior_bound
from optloc.track.constants import begun_with_constants, followed_with_constants
from optloc.track.dynamics import Dynamics, polynomial
from optloc.track.start import two_point, with_height_rows
from optloc.track.track import State, Track, followed

# The scene of the paper, as printed: three satellites that stay above the Earth, and a slow target on the sea.

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


FILTERS = ("ekf", "iekf", "mgekf", "mvekf")
"""Names in `optloc.track.UPDATES`, in the order of the tables."""

SPEED = 50.0
"""Standard deviation of each coordinate of the velocity in starts that are far off, metres per second."""


@dataclass(frozen=True, slots=True)
class Run:
    """Position errors of the trials of one filter.

    Parameters
    ----------
    position : array (trials, steps, 3)
        Estimates, ECEF metres.
    error : array (trials, steps)
        Distance from the truth, metres.
    claimed : array (trials, steps)
        The root of the trace of the filter's own position covariance, metres.
    """

    position: Array
    error: Array
    claimed: Array

    @property
    def rms(self) -> Array:
        """Return root mean square errors (steps,), metres."""
        return np.asarray(np.sqrt((self.error**2).mean(0)))


def scored(track: Track, exact: Array) -> Run:
    """Return the errors of a track whose last scans are those of true states (epochs, 6)."""
    at = exact[len(exact) - len(track.times) :, :3]
    own = np.sqrt(np.trace(track.cov[..., :3, :3], axis1=-2, axis2=-1))
    return Run(track.position, np.linalg.norm(track.position - at, axis=-1), own)


def from_fixes(drawn: Problem) -> State:
    """Return the state at the second epoch from the fixes of the first two, each without a guess."""
    one, two = (solve(replace(cut(drawn, k, k + 1), motions=(Motion(0),))) for k in (0, 1))
    return two_point(one, two, (float(drawn.times[0]), float(drawn.times[1])))


def prior(at: Array, satellites: Array = SATELLITES) -> Array:
    """Return the covariance (6, 6) of position and velocity from fixes, a second apart, that reach their bound."""
    one = crlb(problem(1, order=0, satellites=satellites), at)
    return np.block([[one, one], [one, 2.0 * one]])


def root_trace(cov: Array) -> Array:
    """Return the root of the trace of the position part (...,) of covariances (..., n, n)."""
    return np.asarray(np.sqrt(np.trace(cov[..., :3, :3], axis1=-2, axis2=-1)))


def fixed(steps: int, trials: int, sequence: np.random.SeedSequence) -> tuple[dict[str, Run], Array]:
    """Return all filters started by the first two fixes, and the posterior bound (steps,), metres."""
    exact = truth(steps + 2)
    drawn = simulate(problem(steps + 2), exact[0], sequence, trials)
    start = from_fixes(drawn)
    found = {name: scored(followed(drawn, start, dynamics(), name), exact) for name in FILTERS}
    bound = posterior_bound(problem(steps + 2), exact, State(1.0, exact[1], prior(exact[1, :3])), dynamics())
    return found, root_trace(bound)


def wild(width: float, steps: int, trials: int, sequence: np.random.SeedSequence) -> tuple[dict[str, Run], Array]:
    """Return all filters from starts that are wrong by `width` metres in each coordinate, and the posterior bound.

    The same data are tracked from the first two fixes as well, by the filter "quartic + ekf".
    """
    draws, errors = sequence.spawn(2)
    exact = truth(steps)
    drawn = simulate(problem(steps), exact[0], draws, trials)
    sigma = np.repeat([width, SPEED], 3)
    mean = exact[0] - np.concatenate([exact[0, 3:], np.zeros(3)])
    mean = mean + sigma * np.random.default_rng(errors).standard_normal((trials, 6))
    start = State(-1.0, mean, np.broadcast_to(np.diag(sigma**2), (trials, 6, 6)))
    found = {name: scored(followed(drawn, start, dynamics(), name), exact) for name in FILTERS}
    found["quartic + ekf"] = scored(followed(drawn, from_fixes(drawn), dynamics(), "ekf"), exact)
    bound = posterior_bound(problem(steps), exact, State(-1.0, exact[0], np.diag(sigma**2)), dynamics())
    return found, root_trace(bound)


def moving(satellites: Array, trials: int, sequence: np.random.SeedSequence) -> tuple[Run, Array]:
    """Return the IEKF with satellites (epochs, 3, 3) that move, from the first two fixes, and the posterior bound."""
    exact = truth(len(satellites))
    drawn = simulate(problem(len(satellites), satellites=satellites), exact[0], sequence, trials)
    start = from_fixes(drawn)
    run, given = problem(len(satellites), satellites=satellites), prior(exact[1, :3], satellites[:1])
    bound = posterior_bound(run, exact, State(1.0, exact[1], given), dynamics())
    return scored(followed(drawn, start, dynamics(), "iekf"), exact), root_trace(bound)


def heights(steps: int, trials: int, sequence: np.random.SeedSequence) -> dict[str, Run]:
    """Return the IEKF on the same sea-level target with several kinds of height, by what the filter takes it for."""
    exact, epochs = truth(steps + 2, surface_course()), steps + 2
    keys = sequence.spawn(5)
    out = {}
    for key, (name, sigma) in zip(keys, {"white, 500 m": HEIGHT, "white, 10 m": 10.0}.items(), strict=False):
        drawn = simulate(problem(epochs, height=sigma), exact[0], key, trials)
        out[name] = scored(followed(drawn, from_fixes(drawn), dynamics()), exact)
    level = simulate(problem(epochs, height=None), exact[0], keys[2], trials)
    held = followed(with_height_rows(level), from_fixes(level), dynamics())
    out["known: the ellipsoid itself"] = scored(held, exact)
    assumed = with_bias(problem(epochs, height=1.0), "height", per="kind", kind="height", sigma=HEIGHT)
    wrong = HEIGHT * np.random.default_rng(keys[3]).standard_normal((trials, 1))
    vectors = np.concatenate([np.broadcast_to(exact[0], (trials, 6)), wrong], axis=1)
    drawn = simulate(assumed, vectors, keys[4])
    white = problem(epochs).with_rows(z=drawn.z)
    out["constant error of 500 m, taken for white"] = scored(followed(white, from_fixes(white), dynamics()), exact)
    start = begun_with_constants(drawn, dynamics(), 2)
    out["constant error of 500 m, as a state"] = scored(followed_with_constants(drawn, start, dynamics()), exact)
    return out


def climbing(steps: int, trials: int, sequence: np.random.SeedSequence) -> Run:
    """Return the IEKF on the target as printed, which climbs, while its height is said to be zero within 500 m."""
    exact, (draws, errors) = truth(steps + 2), sequence.spawn(2)
    drawn = simulate(problem(steps + 2), exact[0], draws, trials)
    level = HEIGHT * np.random.default_rng(errors).standard_normal((trials, steps + 2))
    said = drawn.with_rows(z=np.concatenate([drawn.rows[0].z, level], axis=-1))
    return scored(followed(said, from_fixes(said), dynamics()), exact)


def far(angles: Sequence[float], bearings: int = 12) -> Array:
    """Return the bound of a fix at a known height, metres (q,), root mean square over bearings, by distance.

    Parameters
    ----------
    angles : sequence of float
        Distance of the target from the point below the satellites, radians at the centre of the Earth.
    bearings : int
        Number of directions.
    """
    centre = SATELLITES.mean(0)
    up = centre / np.linalg.norm(centre)
    east, north, _ = ECEF.enu_axes(centre)
    east, north = (v - (v @ up) * up for v in (east, north))
    turn = 2.0 * np.pi * np.arange(bearings) / bearings
    side = np.cos(turn)[:, None] * north + np.sin(turn)[:, None] * east
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    out = []
    for angle in angles:
        lat, lon, _ = ecef_to_geodetic(6.37e6 * (np.cos(angle) * up + np.sin(angle) * side))
        at = geodetic_to_ecef(lat, lon, np.zeros(bearings))
        cov = crlb(problem(1, order=0, height=None), at)
        out.append(np.sqrt(np.trace(cov, axis1=-2, axis2=-1).mean()))
    return np.array(out)


# Tracking of ships by the time differences of three satellites and a known height: four Kalman filters.

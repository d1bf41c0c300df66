"""Monte Carlo trials of the four filters: from fixes, from starts that are far off, with several kinds of height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.bias import with_bias
from optloc.bounds import crlb
from optloc.frames import ECEF, ecef_to_geodetic, geodetic_to_ecef
from optloc.papers.satellites.scenario import HEIGHT, SATELLITES, dynamics, problem, surface_course, truth
from optloc.problem import Problem
from optloc.simulate import simulate
from optloc.solve import solve
from optloc.track.bound import posterior_bound
from optloc.track.constants import begun_with_constants, followed_with_constants
from optloc.track.heights import with_height_rows
from optloc.track.start import two_point
from optloc.track.track import State, Track, followed
from optloc.types import Array, Motion
from optloc.windows import cut

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

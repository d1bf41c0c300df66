"""Monte Carlo trials: the recursion of the paper, its cures, and fixes without a guess, on the same data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from optloc.bounds import crlb, crlb_course
from optloc.papers.bistatic.scenario import ANGLE, COURSE, PATH, draw, place, polar, problem, truth
from optloc.papers.report import Tick
from optloc.problem import Problem
from optloc.solve import solve
from optloc.solve.bistatic import course_starts
from optloc.track.bistatic import simplified
from optloc.track.dynamics import polynomial
from optloc.track.measurement_space import lines
from optloc.track.start import first_fix, state_of
from optloc.track.track import Track, followed
from optloc.types import Array, Motion
from optloc.windows import cut

SPEED = 50.0
"""Prior standard deviation of each coordinate of the velocity for the Kalman filters, metres per second."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of range, azimuth and elevation, against time.

    Parameters
    ----------
    epochs : int array (q,)
        Number of epochs that each estimate has used.
    error : array (trials, q, 3)
        Metres and radians.
    """

    epochs: Array
    error: Array

    def rms(self, epochs: int) -> Array:
        """Return root mean square errors (3,) after a number of epochs."""
        return np.asarray(np.sqrt((self.error[:, self.epochs == epochs] ** 2).mean((0, 1))))

    def mean(self, epochs: int) -> Array:
        """Return mean errors (3,) after a number of epochs."""
        return np.asarray(self.error[:, self.epochs == epochs].mean((0, 1)))

    def over(self, first: int) -> float:
        """Return the root mean square error of the range from the epoch `first` on, metres."""
        return float(np.sqrt((self.error[:, self.epochs >= first, 0] ** 2).mean()))


def _errors(position: Array, slow: bool, epochs: Array) -> Errors:
    exact = polar(truth(int(epochs.max()), slow=slow)[epochs - 1])
    error = polar(position) - exact
    error[..., 1] = np.arctan2(np.sin(error[..., 1]), np.cos(error[..., 1]))
    return Errors(epochs, error)


def of_track(track: Track, epochs: int, *, slow: bool) -> Errors:
    """Return the errors of a track that ends after a number of epochs."""
    return _errors(track.position, slow, np.arange(epochs - len(track.times) + 1, epochs + 1))


def kalman(drawn: Problem, update: str) -> Track:
    """Return the track of a Cartesian Kalman filter with constant velocity, begun from the first epoch."""
    dynamics = polynomial(1)
    start = state_of(drawn, first_fix(drawn, dynamics, 1, speed=SPEED), 1)
    return followed(drawn, start, dynamics, update)


def still(epochs: int, trials: int, sequence: np.random.SeedSequence) -> dict[str, Errors]:
    """Return the errors for a target that stays: of the corrected recursion, and of the closed-form fix."""
    drawn = draw(epochs, trials, sequence)
    return {
        "simplified": of_track(simplified(drawn), epochs, slow=False),
        "maximum likelihood": of_track(lines(drawn, 0), epochs, slow=False),
    }


Tracker = Callable[[Problem], Track]

TRACKERS: Mapping[str, Tracker] = {
    "single fix": lambda drawn: lines(drawn, 0, window=1),
    "simplified, no restart": simplified,
    "restart every 10": lambda drawn: simplified(drawn, restart=10),
    "restart every 25": lambda drawn: simplified(drawn, restart=25),
    "restart every 50": lambda drawn: simplified(drawn, restart=50),
    "restart every 100": lambda drawn: simplified(drawn, restart=100),
    "restart every 25 from the mean of 10": lambda drawn: simplified(drawn, restart=25, mean=10),
    "gain floor 0.05": lambda drawn: simplified(drawn, floor=0.05),
    "Cartesian EKF": lambda drawn: kalman(drawn, "ekf"),
    "Cartesian IEKF": lambda drawn: kalman(drawn, "iekf"),
    "line fit": lines,
}
"""Every tracker of the slow target, by the name that tables give it."""


def moving(epochs: int, trials: int, sequence: np.random.SeedSequence, tick: Tick) -> dict[str, Errors]:
    """Return the errors of all `TRACKERS` for the slow target."""
    drawn = draw(epochs, trials, sequence, slow=True)
    out = {}
    for name, tracker in TRACKERS.items():
        out[name] = of_track(tracker(drawn), epochs, slow=True)
        tick()
    return out


def batches(
    epochs: int, trials: int, sequence: np.random.SeedSequence, *, path: float = PATH, whole: int | None = None
) -> dict[str, Errors]:
    """Return the errors after a number of epochs: of the pseudo-linear course, and of the batch fit started by it.

    Parameters
    ----------
    epochs : int
        Epochs that are used.
    trials : int
        Independent draws.
    sequence : SeedSequence
        Decides the draw.
    path : float
        Standard deviation of the excess path, metres.
    whole : int, optional
        Epochs that are drawn, so that shorter records are the beginnings of the same ones.
    """
    drawn = draw(epochs if whole is None else whole, trials, sequence, slow=True, path=path)
    run = replace(cut(drawn, 0, epochs), motions=(Motion(1, reference=float(epochs - 1)),))
    course = course_starts(run)
    assert course is not None
    fix = solve(run, "lsr", start=course.reshape(trials, 6))
    at = np.array([epochs])
    return {
        "pseudo-linear course": _errors(course[:, None, 0], True, at),
        "batch maximum likelihood": _errors(fix.position[:, None], True, at),
    }


def _spread(cov: Array, at: Array) -> Array:
    """Return standard deviations (..., 3) of range, azimuth and elevation of covariances (..., 3, 3) at positions."""
    r = np.linalg.norm(at, axis=-1)
    flat = np.hypot(at[..., 0], at[..., 1])
    u = at / r[..., None]
    east = np.stack([-at[..., 1], at[..., 0], 0.0 * flat], axis=-1) / flat[..., None]
    axes = np.stack([u, east, np.cross(u, east)], axis=-2)
    size = np.sqrt(np.einsum("...ai,...ij,...aj->...a", axes, cov, axes))
    return np.asarray(size / np.stack([np.ones_like(r), flat, r], axis=-1))


def bound_still(epochs: Array) -> Array:
    """Return the bound (q, 3) of range, azimuth and elevation of a target that stays, after numbers of epochs."""
    course = crlb_course(problem(int(epochs.max())), place(), epochs)
    return _spread(course.covariance, place())


def bound_moving(epochs: Array, path: float = PATH) -> Array:
    """Return the same (q, 3) of the slow target's present place, with constant velocity."""
    course = crlb_course(problem(int(epochs.max()), order=1, path=path), np.concatenate([place(), COURSE]), epochs)
    since = (epochs - 1.0)[:, None, None]
    ahead = np.concatenate([np.broadcast_to(np.eye(3), (len(epochs), 3, 3)), since * np.eye(3)], axis=-1)
    cov = ahead @ course.covariance @ np.swapaxes(ahead, -1, -2)
    return _spread(cov, truth(int(epochs.max()), slow=True)[epochs - 1])


def bound_single(azimuth: float, elevation: float = 0.123) -> float:
    """Return the bound of the range after one epoch in another direction, metres."""
    at = place(azimuth=azimuth, elevation=elevation)
    return float(_spread(crlb(problem(1), at), at)[0])


def printed_angles(epochs: int, trials: int, sequence: np.random.SeedSequence) -> Array:
    """Return the azimuth errors (trials, epochs) of the angle step with the printed sign, radians.

    Printed is a_i = a_(i-1) - (a'_i - a_(i-1)) / i, which moves away from the measurement.
    """
    noise = ANGLE * np.random.default_rng(sequence).standard_normal((trials, epochs))
    out = noise.copy()
    for i in range(2, epochs + 1):
        out[:, i - 1] = out[:, i - 2] - (noise[:, i - 1] - out[:, i - 2]) / i
    return out

"""Monte Carlo trials: the recursion of the paper, its cures, and fixes without a guess, on the same data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array, Motion
from optloc.base.units import SPEED_OF_LIGHT
from optloc.bounds.crlb import crlb, crlb_course
from optloc.linear.constraints import box
from optloc.linear.evaluate import predict
from optloc.linear.simulate import simulate
from optloc.papers.report import Table, Tick
from optloc.problem.build import assemble, measured
from optloc.problem.epochs import cut
from optloc.problem.problem import Problem
from optloc.solvers import solve
from optloc.solvers.starts.angles import course_starts
from optloc.track.dynamics import polynomial
from optloc.track.measurement_space import lines, simplified
from optloc.track.start import first_fix, state_of
from optloc.track.track import Track, followed

# The scene of the paper, as printed: receiver at the origin, illuminator on the x axis, a target 81 km away.

BASELINE = 150e3
"""Distance of the illuminator, metres."""

RANGE, AZIMUTH, ELEVATION = 81.2e3, 1.446, 0.123
"""Place of the target at t = 0: metres and radians."""

COURSE = np.array([4.0, 10.0, 6.0])
"""Velocity of the slow target, metres per second; signs as printed, so that its range grows by 11 m/s."""

PATH = 20e-9 * SPEED_OF_LIGHT
"""Standard deviation of the excess path, metres: 20 ns."""

ANGLE = float(np.radians(1.0))
"""Standard deviation of both angles, radians."""

EPOCHS = 200
"""Epochs, one a second."""


def place(distance: float = RANGE, azimuth: float = AZIMUTH, elevation: float = ELEVATION) -> Array:
    """Return a position (3,) in metres."""
    ahead = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    return distance * np.array(ahead)


def problem(epochs: int, *, order: int = 0, path: float = PATH, reference: float | None = None) -> Problem:
    """Return the estimation problem of the first epochs, without measurements.

    Parameters
    ----------
    epochs : int
        Number of epochs.
    order : 0 or 1
        A target that stays, or one that moves uniformly.
    path : float
        Standard deviation of the excess path, metres.
    reference : float, optional
        Second at which the state holds; 0 by default.
    """
    epoch = np.arange(epochs)
    return assemble(
        np.array([[0.0, 0.0, 0.0], [BASELINE, 0.0, 0.0]]),
        measured("range_sum", a=0, b=1, epoch=epoch, sigma=path),
        measured("azimuth", a=0, epoch=epoch, sigma=ANGLE),
        measured("elevation", a=0, epoch=epoch, sigma=ANGLE),
        motions=[Motion(order, reference=reference)],
    )


def draw(
    epochs: int, trials: int, sequence: np.random.SeedSequence, *, slow: bool = False, path: float = PATH
) -> Problem:
    """Return measured runs (trials,) of the target that stays, or of the slow one."""
    start = np.concatenate([place(), COURSE]) if slow else place()
    return simulate(problem(epochs, order=int(slow), path=path), start, sequence, trials)


def truth(epochs: int, *, slow: bool = False) -> Array:
    """Return the true positions (epochs, 3), metres."""
    return place() + np.arange(epochs)[:, None] * (COURSE if slow else 0.0)


_ONE = problem(1)


def polar(position: Array) -> Array:
    """Return range, azimuth and elevation (..., 3) of positions (..., 3)."""
    angles = predict(_ONE, position)[..., 1:]
    return np.concatenate([np.linalg.norm(position, axis=-1)[..., None], angles], axis=-1)


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


# What a ground below the target, or its known height, adds to the fix of one epoch.

CASES = {
    "target of the paper, 10 km high": (1.446, 0.123),
    "the same, 0.2 km high": (1.446, float(np.arcsin(200.0 / RANGE))),
    "azimuth 0.3, elevation 0.5": (0.3, 0.5),
}
"""Azimuth and elevation of each case, radians."""


def spread(azimuth: float, elevation: float, trials: int, sequence: np.random.SeedSequence) -> dict[str, Array]:
    """Return root mean square errors (range, height, in space) of fixes of one epoch, metres, by what is known.

    Parameters
    ----------
    azimuth, elevation : float
        Direction of the target, radians.
    trials : int
        Independent draws.
    sequence : SeedSequence
        Decides the draw.
    """
    at = place(azimuth=azimuth, elevation=elevation)
    drawn = simulate(problem(1), at, sequence, trials)
    open_ = np.full(3, np.inf)
    floor, level = np.array([-np.inf, -np.inf, 0.0]), np.array([np.inf, np.inf, at[2]])
    regions = {
        "free": (),
        "above ground": box(floor.tolist(), open_.tolist()),
        "known height": box((-level * [1, 1, -1]).tolist(), level.tolist()),
    }
    out = {}
    for name, region in regions.items():
        found = solve(replace(drawn, constraints=region)).position
        error = found - at
        away = np.linalg.norm(found, axis=-1) - RANGE
        out[name] = np.sqrt(np.mean([away**2, error[:, 2] ** 2, (error**2).sum(-1)], axis=1))
    return out


def table(trials: int, sequence: np.random.SeedSequence, tick: Tick) -> Table:
    """Return the table of all `CASES`."""
    lines = []
    for (name, direction), child in zip(CASES.items(), sequence.spawn(len(CASES)), strict=True):
        found = spread(*direction, trials, child)
        lines += [(name, how, *(f"{value / 1e3:.3f}" for value in errors)) for how, errors in found.items()]
        tick()
    header = ("case", "known", "range, km", "height, km", "in space, km")
    note = "A ground or a height repairs the height only: the error in range is that of the azimuth."
    return Table("ground", "One epoch above ground, and at a known height", header, tuple(lines), note)


# Location of slow targets by one receiver with one illuminator: excess path, azimuth and elevation.

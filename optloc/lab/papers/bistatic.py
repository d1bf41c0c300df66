"""Slow targets by one receiver and one illuminator of opportunity: excess path, azimuth and elevation.

The recursion of the paper, its corrections, and fixes without a guess run on the same data; the page is
``bistatic.md``. Errors are range, azimuth and elevation from the receiver, in metres and radians. In shapes, q is the
number of scored epochs. The recursion averages range and angles ("simplified"), and may restart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from optloc.bounds import crlb, crlb_course
from optloc.engine import box, predict, simulate
from optloc.lab.papers.report import (
    Ink,
    Report,
    Size,
    Study,
    Tick,
    canvas,
    explain,
    label,
    percent,
    scale,
    tabulate,
    typeset,
)
from optloc.problem import SPEED_OF_LIGHT, Array, Motion, Problem, assemble, cut, measured
from optloc.show import ABSENT, TextTable
from optloc.solvers import course_starts, solve
from optloc.tracking import Track, first_fix, followed, lines, polynomial, simplified, state_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The scene: receiver at the origin, illuminator on the x axis, a target 81 km away. Values are printed unless noted.

BASELINE = 150e3
"""Distance of the illuminator, metres."""

RANGE, AZIMUTH, ELEVATION = 81.2e3, 1.446, 0.123
"""Position of the target at t = 0: metres and radians."""

COURSE = np.array([4.0, 10.0, 6.0])
"""Velocity of the slow target, m/s; signs as printed, so that its range grows by 11 m/s."""

PATH = 20e-9 * SPEED_OF_LIGHT
"""Standard deviation of the excess path, metres: 20 ns."""

ANGLE = float(np.radians(1.0))
"""Standard deviation of both angles, radians."""

EPOCHS = 200
"""Number of epochs, one a second; not printed. With 200 the lag of the recursion exceeds its noise, as the paper
states."""


def place(distance: float = RANGE, azimuth: float = AZIMUTH, elevation: float = ELEVATION) -> Array:
    """Return a position (3,) in metres from a distance in metres and angles in radians."""
    direction = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    return distance * np.array(direction)


def problem(epochs: int, *, order: int = 0, path: float = PATH, reference: float | None = None) -> Problem:
    """Return the estimation problem of the first `epochs` epochs, without measurements.

    `order` is 0 for a fixed target and 1 for uniform motion. `path` is the standard deviation of the excess path in
    metres. The unknown state is the state at the time `reference` in seconds, 0 by default.
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
    """Return measured runs (trials,) of the fixed target, or of the slow one."""
    start = np.concatenate([place(), COURSE]) if slow else place()
    return simulate(problem(epochs, order=int(slow), path=path), start, sequence, trials)


def truth(epochs: int, *, slow: bool = False) -> Array:
    """Return the true positions (epochs, 3) of the fixed or of the slow target, metres."""
    return place() + np.arange(epochs)[:, None] * (COURSE if slow else 0.0)


_ONE = problem(1)


def polar(position: Array) -> Array:
    """Return range, azimuth and elevation (..., 3) of positions (..., 3), metres and radians."""
    angles = predict(_ONE, position)[..., 1:]
    return np.concatenate([np.linalg.norm(position, axis=-1)[..., None], angles], axis=-1)


SPEED = 50.0
"""Prior standard deviation of each coordinate of the velocity for the Kalman filters, m/s; the target has 12."""


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
        """Return the root mean square errors (3,) over the trials after `epochs` epochs."""
        return np.asarray(np.sqrt((self.error[:, self.epochs == epochs] ** 2).mean((0, 1))))

    def mean(self, epochs: int) -> Array:
        """Return the mean errors (3,) over the trials after `epochs` epochs."""
        return np.asarray(self.error[:, self.epochs == epochs].mean((0, 1)))

    def over(self, first: int) -> float:
        """Return the root mean square error of the range from the epoch `first` on, metres."""
        return float(np.sqrt((self.error[:, self.epochs >= first, 0] ** 2).mean()))


def _errors(position: Array, slow: bool, epochs: Array) -> Errors:
    """Return the errors of positions (trials, q, 3) after the numbers of epochs `epochs` (q,).

    `slow` is True for the slow target.
    """
    true = polar(truth(int(epochs.max()), slow=slow)[epochs - 1])
    error = polar(position) - true
    # Azimuths are compared on the circle.
    error[..., 1] = np.arctan2(np.sin(error[..., 1]), np.cos(error[..., 1]))
    return Errors(epochs, error)


def of_track(track: Track, epochs: int, *, slow: bool) -> Errors:
    """Return the errors of a track that ends after `epochs` epochs; `slow` is True for the slow target."""
    return _errors(track.position, slow, np.arange(epochs - len(track.times) + 1, epochs + 1))


def kalman(drawn: Problem, update: str) -> Track:
    """Return the track of a Cartesian Kalman filter with constant velocity; it starts at the fix of the first epoch."""
    dynamics = polynomial(1)
    start = state_of(drawn, first_fix(drawn, dynamics, 1, speed=SPEED), 1)
    return followed(drawn, start, dynamics, update)


def run_still(epochs: int, trials: int, sequence: np.random.SeedSequence) -> dict[str, Errors]:
    """Return the errors for a fixed target, by estimator: the corrected recursion, and the closed-form fix.

    `sequence` is the seed of the draws.
    """
    drawn = draw(epochs, trials, sequence)
    return {
        "simplified": of_track(simplified(drawn), epochs, slow=False),
        "maximum likelihood": of_track(lines(drawn, 0), epochs, slow=False),
    }


Tracker = Callable[[Problem], Track]

# The paper prints no period of the restarts: these span little lag to little noise. A floor of 0.05 is the gain of a
# mean of twenty epochs.
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
"""All trackers of the slow target, by their names in tables."""


def run_slow(epochs: int, trials: int, sequence: np.random.SeedSequence, tick: Tick) -> dict[str, Errors]:
    """Return the errors of all `TRACKERS` for the slow target, by name; `sequence` is the seed of the draws."""
    drawn = draw(epochs, trials, sequence, slow=True)
    errors = {}
    for name, tracker in TRACKERS.items():
        errors[name] = of_track(tracker(drawn), epochs, slow=True)
        tick()
    return errors


def run_batches(
    epochs: int, trials: int, sequence: np.random.SeedSequence, *, path: float = PATH, whole: int | None = None
) -> dict[str, Errors]:
    """Return the errors of two estimates of a uniform course from its first `epochs` epochs, by name.

    The pseudo-linear course is a closed form; the batch fit is least squares that starts from it.

    Parameters
    ----------
    epochs : int
        Number of epochs used.
    trials : int
        Independent draws.
    sequence : SeedSequence
        Seed of the draws.
    path : float
        Standard deviation of a measured excess path, metres.
    whole : int, optional
        Number of epochs drawn, so that shorter records are the first parts of longer ones.
    """
    drawn = draw(epochs if whole is None else whole, trials, sequence, slow=True, path=path)
    # The state at the last epoch, at which trackers are also scored.
    run = replace(cut(drawn, 0, epochs), motions=(Motion(1, reference=float(epochs - 1)),))
    course = course_starts(run)
    assert course is not None
    fix = solve(run, "lsr", start=course.reshape(trials, 6))
    last = np.array([epochs])
    return {
        "pseudo-linear course": _errors(course[:, None, 0], slow=True, epochs=last),
        "batch maximum likelihood": _errors(fix.position[:, None], slow=True, epochs=last),
    }


def _polar_sigmas(cov: Array, position: Array) -> Array:
    """Return the standard deviations (..., 3) of range, azimuth and elevation, metres and radians.

    `cov` (..., 3, 3) are the covariances of the positions `position` (..., 3), m^2 and metres.
    """
    r = np.linalg.norm(position, axis=-1)
    horizontal = np.hypot(position[..., 0], position[..., 1])
    outward = position / r[..., None]
    east = np.stack([-position[..., 1], position[..., 0], 0.0 * horizontal], axis=-1) / horizontal[..., None]
    axes = np.stack([outward, east, np.cross(outward, east)], axis=-2)
    deviation = np.sqrt(np.einsum("...ai,...ij,...aj->...a", axes, cov, axes))
    # An error across is divided by the range for the elevation, and by its horizontal part for the azimuth.
    return np.asarray(deviation / np.stack([np.ones_like(r), horizontal, r], axis=-1))


def bound_still(epochs: Array) -> Array:
    """Return the bounds (q, 3) of range, azimuth and elevation of a fixed target, after numbers of epochs (q,).

    Bounds are standard deviations in metres and radians.
    """
    course = crlb_course(problem(int(epochs.max())), place(), epochs)
    return _polar_sigmas(course.covariance, place())


def bound_moving(epochs: Array, path: float = PATH) -> Array:
    """Return the bounds (q, 3) of range, azimuth and elevation of the slow target, after numbers of epochs (q,).

    Bounds are standard deviations at the last epoch, in metres and radians.
    """
    course = crlb_course(problem(int(epochs.max()), order=1, path=path), np.concatenate([place(), COURSE]), epochs)
    elapsed = (epochs - 1.0)[:, None, None]
    transition = np.concatenate([np.broadcast_to(np.eye(3), (len(epochs), 3, 3)), elapsed * np.eye(3)], axis=-1)
    cov = transition @ course.covariance @ np.swapaxes(transition, -1, -2)
    return _polar_sigmas(cov, truth(int(epochs.max()), slow=True)[epochs - 1])


def bound_single(azimuth: float, elevation: float = 0.123) -> float:
    """Return the bound of the range after one epoch in another direction: a standard deviation in metres."""
    position = place(azimuth=azimuth, elevation=elevation)
    return float(_polar_sigmas(crlb(problem(1), position), position)[0])


def printed_angles(epochs: int, trials: int, sequence: np.random.SeedSequence) -> Array:
    """Return the azimuth errors (trials, epochs) of the angle step with the printed sign, radians.

    Printed is a_i = a_(i-1) - (a'_i - a_(i-1)) / i, which moves away from the measurement.
    """
    noise = ANGLE * np.random.default_rng(sequence).standard_normal((trials, epochs))
    errors = noise.copy()
    # The factor is 1 + 1/i instead of 1 - 1/i, so the old error grows, and a new error is added.
    for i in range(2, epochs + 1):
        errors[:, i - 1] = errors[:, i - 2] - (noise[:, i - 1] - errors[:, i - 2]) / i
    return errors


# Effect of a ground below the target, or of its known height, on the fix of one epoch.

# High; so near to the ground that a fix may be below it; and in a direction where the path hardly constrains the range.
CASES = {
    "target of the paper, 10 km high": (1.446, 0.123),
    "the same, 0.2 km high": (1.446, float(np.arcsin(200.0 / RANGE))),
    "azimuth 0.3, elevation 0.5": (0.3, 0.5),
}
"""Azimuth and elevation of each case, radians."""


def fix_grounded(azimuth: float, elevation: float, trials: int, sequence: np.random.SeedSequence) -> dict[str, Array]:
    """Return rms errors (3,) of fixes of one epoch by the known constraint: range, height, in space; metres.

    `azimuth` and `elevation` are the direction of the target in radians; `sequence` is the seed of the draws.
    """
    position = place(azimuth=azimuth, elevation=elevation)
    drawn = simulate(problem(1), position, sequence, trials)
    unbounded = np.full(3, np.inf)
    floor, known_height = np.array([-np.inf, -np.inf, 0.0]), np.array([np.inf, np.inf, position[2]])
    # A known height is a slab without thickness; the ground is one without an upper face.
    regions = {
        "free": (),
        "above ground": box(floor.tolist(), unbounded.tolist()),
        "known height": box((-known_height * [1, 1, -1]).tolist(), known_height.tolist()),
    }
    errors = {}
    for name, region in regions.items():
        fixes = solve(replace(drawn, constraints=region), "searched").position  # errors over many draws
        error = fixes - position
        range_error = np.linalg.norm(fixes, axis=-1) - RANGE
        errors[name] = np.sqrt(np.mean([range_error**2, error[:, 2] ** 2, (error**2).sum(-1)], axis=1))
    return errors


# Tables of the claims, the recursion, the corrections and the bounds.

CLAIMS = (("range", 0, 1e3, "< 1 km"), ("azimuth", 1, 0.005, "< 0.005 rad"), ("elevation", 2, 0.008, "< 0.008 rad"))
"""Claims of the text on the errors after 10 epochs."""


def kilometres(value: float) -> str:
    """Return metres as kilometres with three decimals."""
    return f"{value / 1e3:.3f}"


def _cells(errors: Array) -> tuple[str, str, str]:
    """Return errors of range, azimuth and elevation (3,) as text."""
    return kilometres(errors[0]), f"{errors[1]:.5f}", f"{errors[2]:.5f}"


def table_still(found: Mapping[str, Errors], bounds: Mapping[int, Array]) -> TextTable:
    """Return a table of rms errors of a fixed target; `found` is by estimator, `bounds` (3,) by number of epochs."""
    lines = []
    for count, bound in bounds.items():
        lines += [(str(count), name, *_cells(errors.rms(count))) for name, errors in found.items()]
        lines.append((str(count), "bound", *_cells(bound)))
    return tabulate("still", ("epochs", "estimator", "range, km", "azimuth, rad", "elevation, rad"), lines)


def table_claims(found: Mapping[str, Errors]) -> TextTable:
    """Return a table of the share of runs within the paper's claims for 10 epochs, and of the rms errors."""
    lines = []
    for name, column, limit, claim in CLAIMS:
        within = [np.abs(errors.error[:, errors.epochs == 10, column]) < limit for errors in found.values()]
        rms = [errors.rms(10)[column] for errors in found.values()]
        unit = "{:.0f} m" if column == 0 else "{:.4f} rad"
        lines.append((name, claim, *(percent(inside.mean()) for inside in within), *map(unit.format, rms)))
    header = ("error", "printed", *(f"{name}, share" for name in found), *(f"{name}, rms" for name in found))
    return tabulate("claims", header, lines)


def table_slow(
    tracks: Mapping[str, Errors], fits: Mapping[int, Mapping[str, Errors]], bounds: Mapping[int, Array]
) -> TextTable:
    """Return a table of root mean square errors of the slow target.

    `tracks` is by tracker. `fits` are fits of whole records, by number of epochs; `bounds` (3,) has the same numbers.
    """
    early, late = sorted(fits)
    lines = [
        (name, kilometres(e.rms(early)[0]), *_cells(e.rms(late)), kilometres(e.mean(late)[0]), kilometres(e.over(11)))
        for name, e in tracks.items()
    ]
    for name, last in fits[late].items():
        first = kilometres(fits[early][name].rms(early)[0])
        lines.append((name, first, *_cells(last.rms(late)), kilometres(last.mean(late)[0]), ABSENT))
    lines.append(("bound, constant velocity", kilometres(bounds[early][0]), *_cells(bounds[late]), ABSENT, ABSENT))
    header = (
        "estimator", f"range at {early}, km", f"range at {late}, km", "azimuth, rad", "elevation, rad",
        "mean error, km", f"range from 11 to {late}, km",
    )  # fmt: skip
    return tabulate("slow", header, lines)


def table_short(trials: int, sequences: Sequence[np.random.SeedSequence], tick: Tick) -> TextTable:
    """Return a table of batch fits of ten epochs and their bound, with printed and with ten times the path noise."""
    lines = []
    for sequence, (name, path) in zip(sequences, {"20 ns": PATH, "200 ns": 10.0 * PATH}.items(), strict=True):
        errors = run_batches(10, trials, sequence, path=path)["batch maximum likelihood"]
        lengths = (errors.rms(10)[0], errors.mean(10)[0], bound_moving(np.array([10]), path)[0, 0])
        lines.append((name, *map(kilometres, lengths)))
        tick()
    return tabulate(
        "short", ("noise of the path", "batch maximum likelihood, km", "mean error, km", "bound, km"), lines
    )


def table_directions() -> TextTable:
    """Return a table of the bound of the range of one epoch against azimuth."""
    lines = [(f"{azimuth:.3f}", kilometres(bound_single(azimuth))) for azimuth in _AZIMUTHS]
    return tabulate("directions", ("azimuth, rad", "bound of the range, km"), lines)


def table_ground(trials: int, sequence: np.random.SeedSequence, tick: Tick) -> TextTable:
    """Return a table of the effect of a ground or a known height in all `CASES`."""
    lines = []
    for (name, direction), child in zip(CASES.items(), sequence.spawn(len(CASES)), strict=True):
        by_constraint = fix_grounded(*direction, trials, child)
        lines += [(name, constraint, *map(kilometres, errors)) for constraint, errors in by_constraint.items()]
        tick()
    return tabulate("ground", ("case", "known", "range, km", "height, km", "in space, km"), lines)


def table_printed(azimuth: Array) -> TextTable:
    """Return a table of the error of the angle step as printed; azimuth errors are (trials, epochs), radians."""
    rms = np.sqrt((azimuth**2).mean(0))
    epochs = azimuth.shape[1]
    shown = [i for i in (1, 2, 5, 10, 50, epochs) if i <= epochs]
    lines = [(str(i), f"{rms[i - 1]:.3f}", f"{ANGLE / np.sqrt(i):.4f}") for i in shown]
    return tabulate("printed", ("epochs", "as printed, rad", "with the sign corrected, rad"), lines)


# The figures: errors against time, and one run.

# Dashes over a full line show two estimators that agree.
_STYLE = {
    "single fix": (Ink.GREY, "-"),
    "simplified": (Ink.RED, "-"),
    "simplified, no restart": (Ink.RED, "-"),
    "maximum likelihood": (Ink.BLUE, "--"),
    "restart every 50": (Ink.GREEN, "-"),
    "gain floor 0.05": (Ink.PINK, "-"),
    "Cartesian EKF": (Ink.ORANGE, "-"),
    "line fit": (Ink.BLUE, "-"),
}
_AXES = {"range, km": 1e-3, "azimuth, rad": 1.0, "elevation, rad": 1.0}  # panels, and their factors on SI units
_SHOWN = ("single fix", "simplified, no restart", "restart every 50", "gain floor 0.05", "Cartesian EKF", "line fit")
_RUN = ("single fix", "simplified, no restart", "restart every 50", "line fit")


def against_time(found: Mapping[str, Errors], bound: tuple[Array, Array], points: Mapping[str, Errors]) -> Figure:
    """Return a figure of root mean square errors of range, azimuth and elevation against the number of epochs.

    Parameters
    ----------
    found : mapping of str to Errors
        Curves.
    bound : tuple of array (q,) and array (q, 3)
        Numbers of epochs and the bound.
    points : mapping of str to Errors
        Estimates, each after one number of epochs.
    """
    figure = canvas(15.0, 4.6)
    for i, (ax, (name, factor)) in enumerate(zip(figure.subplots(1, 3), _AXES.items(), strict=True)):
        ax.plot(bound[0], factor * bound[1][:, i], color=Ink.BLACK, lw=1.0, label="Cramér-Rao bound")
        for curve, errors in found.items():
            rms, (colour, dash) = np.sqrt((errors.error[..., i] ** 2).mean(0)), _STYLE[curve]
            ax.plot(errors.epochs, factor * rms, dash, color=colour, lw=1.6, label=curve)
        for point, errors in points.items():
            rms = np.sqrt((errors.error[..., i] ** 2).mean(0))
            ax.plot(errors.epochs, factor * rms, "D", color=Ink.BLACK, mfc="none", ms=7, label=point)
        scale(ax)
        label(ax, "epochs, one a second", f"error of {name} (root mean square)")
    explain(figure, 4)
    return figure


def one_run(found: Mapping[str, Errors]) -> Figure:
    """Return a figure of the errors of the first run of each estimator against the number of epochs."""
    figure = canvas(15.0, 4.6)
    for i, (ax, (name, factor)) in enumerate(zip(figure.subplots(1, 3), _AXES.items(), strict=True)):
        for curve, errors in found.items():
            width = 0.7 if curve == "single fix" else 1.6  # it jumps every second and would hide the others
            ax.plot(errors.epochs, factor * errors.error[0, :, i], color=_STYLE[curve][0], lw=width, label=curve)
        ax.axhline(0.0, color=Ink.BLACK, lw=0.8)
        label(ax, "epochs, one a second", f"error of {name}")
    explain(figure, 4)
    return figure


def _figures(
    fixed: Mapping[str, Errors], tracks: Mapping[str, Errors], fits: Mapping[int, Mapping[str, Errors]]
) -> dict[str, Figure]:
    """Return the figures of the fixed target, of the slow one and of one run, by file name."""
    counts = np.unique(np.geomspace(1, max(fits), 40).astype(int))
    # Two epochs determine a course, but its bound is beyond the axis.
    later = counts[counts >= 5]
    batch = "batch maximum likelihood"
    last_errors = np.concatenate([fits[k][batch].error for k in sorted(fits)], axis=1)
    points = {batch: Errors(np.array(sorted(fits)), last_errors)}
    return {
        "still": against_time(fixed, (counts, bound_still(counts)), {}),
        "slow": against_time({name: tracks[name] for name in _SHOWN}, (later, bound_moving(later)), points),
        "run": one_run({name: tracks[name] for name in _RUN}),
    }


# All results of the paper, in a quick and in a full size.

_COUNTS = (1, 10, 50, 200)  # of epochs: the start, the claim of the paper, and its restarts
_EARLY = 50  # epochs after which the lag of the recursion is about its noise
_AZIMUTHS = (0.05, 0.2, 0.5, 1.0, 1.446, 2.0, 2.6, 3.1)  # from the illuminator to its opposite, with the target


@dataclass(frozen=True, slots=True)
class BistaticSample:
    """Numbers of trials.

    Parameters
    ----------
    still, slow : int
        Trials of the fixed target, and of the slow one.
    ground : int
        Trials of each case with a ground.
    epochs : int
        Length of the records, more than 50.
    """

    still: int
    slow: int
    ground: int
    epochs: int = EPOCHS


# Quick: half a minute, mostly for the whole records of the slow target. Full: errors within two per cent.
_SIZES: dict[Size, BistaticSample] = {"quick": BistaticSample(1000, 150, 200), "full": BistaticSample(2000, 1000, 2000)}


def _run(sample: BistaticSample, seed: int, tick: Tick) -> Report:
    """Return the report of all simulations with the sizes `sample`; call `tick` after each simulation."""

    def sequence(key: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(seed, spawn_key=(key,))

    fixed = run_still(sample.epochs, sample.still, sequence(0))
    tick()
    tracks = run_slow(sample.epochs, sample.slow, sequence(1), tick)
    fits = {}
    for count in (_EARLY, sample.epochs):
        fits[count] = run_batches(count, sample.slow, sequence(1), whole=sample.epochs)
        tick()
    bounds = {count: bound_moving(np.array([count]))[0] for count in (_EARLY, sample.epochs)}
    counts = [count for count in _COUNTS if count <= sample.epochs]
    tables = (
        table_still(fixed, {count: bound_still(np.array([count]))[0] for count in counts}),
        table_claims(fixed),
        table_slow(tracks, fits, bounds),
        table_short(sample.slow, (sequence(2), sequence(3)), tick),
        table_directions(),
        table_ground(sample.ground, sequence(4), tick),
        table_printed(printed_angles(sample.epochs, sample.still, sequence(5))),
    )
    return typeset("bistatic", sample, seed, tables, _figures(fixed, tracks, fits))


STUDY = Study(_SIZES, lambda _: len(TRACKERS) + len(CASES) + 5, _run)
"""The reproduction of the paper."""

"""Ships by the time differences of three satellites and a known height: four Kalman filters.

Each filter starts from fixes and from distant points, and runs with several kinds of height; the page is
``satellites.md``. A step is one update of a filter, once a second. States and covariances are ordered position,
velocity (6 numbers) in ECEF coordinates and SI units. The posterior bound is the Cramer-Rao bound of a filter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from optloc.bounds import crlb
from optloc.engine import height as known_height, simulate
from optloc.lab.papers.report import Ink, Report, Size, Study, Tick, canvas, explain, label, scale, tabulate, typeset
from optloc.problem import (
    ECEF,
    SPEED_OF_LIGHT,
    Array,
    Motion,
    Problem,
    assemble,
    cut,
    ecef_to_geodetic,
    geodetic_to_ecef,
    measured,
    station_array,
    with_bias,
)
from optloc.show import ABSENT, TextTable
from optloc.solvers import solve
from optloc.tracking import (
    Dynamics,
    State,
    Track,
    begun_with_constants,
    followed,
    followed_with_constants,
    polynomial,
    posterior_bound,
    two_point,
    with_height_rows,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The scene: three satellites that are fixed above the Earth, and a slow target on the sea. Values are printed unless
# noted.

SATELLITES = geodetic_to_ecef(
    np.radians([24.44, 25.09, 24.44]), np.radians([125.21, 125.68, 125.99]), np.full(3, 800e3)
)
"""Positions (3, 3), ECEF metres: 800 km high, about 90 km apart."""

START = geodetic_to_ecef(np.radians(25.80), np.radians(127.37), 0.0)
"""First position of the target, on the ellipsoid, ECEF metres."""

COURSE = np.array([20.0, 20.0, 0.0])
"""Velocity of the target as printed, ECEF metres per second; the target climbs by 3.4 m/s."""

SIGMA = 50e-9 * SPEED_OF_LIGHT
"""Standard deviation of a range difference, metres: 50 ns."""

HEIGHT = 500.0
"""Standard deviation of the assumed height, metres."""

DRIVE = 0.01
"""Standard deviation of the acceleration, m/s^2; not printed, and typical of a ship."""

ORBIT = 7.4e3
"""Speed of moving satellites, metres per second: a circular orbit 800 km high has 7.45 km/s."""


def dynamics() -> Dynamics:
    """Return the motion model of the filters: constant velocity, driven by white accelerations."""
    return polynomial(1, DRIVE)


def surface_course() -> Array:
    """Return the velocity (3,) of the target without its climb, ECEF metres per second."""
    up = ECEF.enu_axes(START)[2]
    return np.asarray(COURSE - (COURSE @ up) * up)


def orbits(epochs: int, heading: float, *, interval: float = 1.0) -> Array:
    """Return positions (epochs, 3, 3) of satellites that circle the centre of the Earth together, ECEF metres.

    `heading` is the direction of flight of the formation's centre, radians from north towards east; `interval` is in
    seconds.
    """
    centre = SATELLITES.mean(0)
    east, north, _ = ECEF.enu_axes(centre)
    along = np.cos(heading) * north + np.sin(heading) * east
    # All turn about one axis by one angle (Rodrigues), so the formation keeps its shape.
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
        Standard deviation of the height measured at each epoch, metres; None: the height is exactly zero.
    satellites : array (3, 3) or (epochs, 3, 3)
        Positions, ECEF metres.
    correlated : bool
        Whether both differences share the first satellite's arrival; each arrival then has 50 ns over the root of 2.
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
    """Return the true states (epochs, 6) of a target that moves uniformly, ECEF, SI units."""
    place = START + np.arange(epochs)[:, None] * course
    return np.concatenate([place, np.broadcast_to(course, (epochs, 3))], axis=1)


FILTERS = ("ekf", "iekf", "mgekf", "mvekf")
"""Names in `optloc.tracking.UPDATES`, in the order of the tables."""

SPEED = 50.0
"""Standard deviation of each coordinate of the velocity in distant starts, m/s; the ship has 28."""


# Distance by which the paper divides errors, metres.
_DISTANCE = 100e3


@dataclass(frozen=True, slots=True)
class SatelliteRun:
    """Position errors of the trials of one filter.

    Parameters
    ----------
    position : array (trials, steps, 3)
        Estimates, ECEF metres.
    error : array (trials, steps)
        Distance from the truth, metres.
    claimed : array (trials, steps)
        The root of the trace of the position covariance that the filter claims, metres.
    """

    position: Array
    error: Array
    claimed: Array

    @property
    def rms(self) -> Array:
        """Return root mean square errors (steps,), metres."""
        return np.asarray(np.sqrt((self.error**2).mean(0)))

    @property
    def relative(self) -> Array:
        """Return the mean errors (steps,), divided by 100 km as in the paper."""
        return np.asarray(self.error.mean(0) / _DISTANCE)


def root_trace(cov: Array) -> Array:
    """Return the roots of the traces (...) of the position part of covariances (..., n, n), metres."""
    return np.asarray(np.sqrt(np.trace(cov[..., :3, :3], axis1=-2, axis2=-1)))


def score(track: Track, exact: Array) -> SatelliteRun:
    """Return the position errors of a track; its scans are the last of the true states `exact` (epochs, 6)."""
    positions = exact[len(exact) - len(track.times) :, :3]
    return SatelliteRun(track.position, np.linalg.norm(track.position - positions, axis=-1), root_trace(track.cov))


def from_fixes(drawn: Problem) -> State:
    """Return the state at the second epoch from separate fixes of the first two epochs, without a guess."""
    # Filters need positions and covariances only, and proofs would take most of the time.
    one, two = (solve(replace(cut(drawn, k, k + 1), motions=(Motion(0),)), "searched") for k in (0, 1))
    return two_point(one, two, (float(drawn.times[0]), float(drawn.times[1])))


def prior(at: Array, satellites: Array = SATELLITES) -> Array:
    """Return the covariance (6, 6) of position and velocity from two efficient fixes, a second apart, SI units.

    `at` is the position (3,) of the target. The posterior bound of a filter that starts from fixes begins with it.
    """
    # The position is the second fix, and the velocity its difference from the first: both share the error of the
    # second.
    one = crlb(problem(1, order=0, satellites=satellites), at)
    return np.block([[one, one], [one, 2.0 * one]])


def run_fixed(steps: int, trials: int, sequence: np.random.SeedSequence) -> tuple[dict[str, SatelliteRun], Array]:
    """Return the errors of each filter that starts from the first two fixes, by name, and the posterior bound.

    The bound (steps,) is a position error in metres. `sequence` is the seed.
    """
    exact = truth(steps + 2)
    drawn = simulate(problem(steps + 2), exact[0], sequence, trials)
    start = from_fixes(drawn)
    runs = {name: score(followed(drawn, start, dynamics(), name), exact) for name in FILTERS}
    bound = posterior_bound(problem(steps + 2), exact, State(1.0, exact[1], prior(exact[1, :3])), dynamics())
    return runs, root_trace(bound)


def run_wild(
    width: float, steps: int, trials: int, sequence: np.random.SeedSequence
) -> tuple[dict[str, SatelliteRun], Array]:
    """Return the errors of each filter from distant starts, by name, and the posterior bound (steps,) in metres.

    The starts have errors of `width` metres (standard deviation) in each coordinate. The filter "quartic + ekf" tracks
    the same data from the first two fixes. `steps` is the number of epochs, and `sequence` is the seed of the draws.
    """
    draws, errors = sequence.spawn(2)
    exact = truth(steps)
    drawn = simulate(problem(steps), exact[0], draws, trials)
    # The start is a second before the first scan, so that the first update follows a prediction, as in a running
    # filter.
    sigma = np.repeat([width, SPEED], 3)
    mean = exact[0] - np.concatenate([exact[0, 3:], np.zeros(3)])
    mean = mean + sigma * np.random.default_rng(errors).standard_normal((trials, 6))
    start = State(-1.0, mean, np.broadcast_to(np.diag(sigma**2), (trials, 6, 6)))
    runs = {name: score(followed(drawn, start, dynamics(), name), exact) for name in FILTERS}
    runs["quartic + ekf"] = score(followed(drawn, from_fixes(drawn), dynamics(), "ekf"), exact)
    bound = posterior_bound(problem(steps), exact, State(-1.0, exact[0], np.diag(sigma**2)), dynamics())
    return runs, root_trace(bound)


def run_moving(satellites: Array, trials: int, sequence: np.random.SeedSequence) -> tuple[SatelliteRun, Array]:
    """Return the errors of the IEKF with moving satellites (epochs, 3, 3), and the posterior bound (steps,) in metres.

    The filter starts from the first two fixes.
    """
    exact = truth(len(satellites))
    drawn = simulate(problem(len(satellites), satellites=satellites), exact[0], sequence, trials)
    start = from_fixes(drawn)
    run, given = problem(len(satellites), satellites=satellites), prior(exact[1, :3], satellites[:1])
    bound = posterior_bound(run, exact, State(1.0, exact[1], given), dynamics())
    return score(followed(drawn, start, dynamics(), "iekf"), exact), root_trace(bound)


def run_heights(steps: int, trials: int, sequence: np.random.SeedSequence) -> dict[str, SatelliteRun]:
    """Return the errors of the iterated extended Kalman filter on a target at sea level, by its model of the height.

    `steps` is the number of updates after the two fixes of the start, and `sequence` is the seed of the draws.
    """
    exact, epochs = truth(steps + 2, surface_course()), steps + 2
    keys = sequence.spawn(5)
    runs = {}
    for key, (name, sigma) in zip(keys, {"white, 500 m": HEIGHT, "white, 10 m": 10.0}.items(), strict=False):
        drawn = simulate(problem(epochs, height=sigma), exact[0], key, trials)
        runs[name] = score(followed(drawn, from_fixes(drawn), dynamics()), exact)
    known = simulate(problem(epochs, height=None), exact[0], keys[2], trials)
    track = followed(with_height_rows(known), from_fixes(known), dynamics())
    runs["known: the ellipsoid itself"] = score(track, exact)
    # The last two runs have the same truth: a constant error of the height for the whole run, and a metre of noise.
    assumed = with_bias(problem(epochs, height=1.0), "height", per="kind", kind="height", sigma=HEIGHT)
    height_error = HEIGHT * np.random.default_rng(keys[3]).standard_normal((trials, 1))
    vectors = np.concatenate([np.broadcast_to(exact[0], (trials, 6)), height_error], axis=1)
    drawn = simulate(assumed, vectors, keys[4])
    white = problem(epochs).with_rows(z=drawn.z)
    runs["constant error of 500 m, taken for white"] = score(followed(white, from_fixes(white), dynamics()), exact)
    start = begun_with_constants(drawn, dynamics(), epochs=2)
    runs["constant error of 500 m, as a state"] = score(followed_with_constants(drawn, start, dynamics()), exact)
    return runs


def run_climbing(steps: int, trials: int, sequence: np.random.SeedSequence) -> SatelliteRun:
    """Return the errors of the IEKF on the target as printed, which climbs.

    The filter assumes a height of zero with a standard deviation of 500 m.
    """
    exact, (draws, errors) = truth(steps + 2), sequence.spawn(2)
    drawn = simulate(problem(steps + 2), exact[0], draws, trials)
    # The measured heights are zero plus noise, although the target climbs.
    measured_height = HEIGHT * np.random.default_rng(errors).standard_normal((trials, steps + 2))
    measured_zero = drawn.with_rows(z=np.concatenate([drawn.rows[0].z, measured_height], axis=-1))
    return score(followed(measured_zero, from_fixes(measured_zero), dynamics()), exact)


# Radius of the Earth, metres, accurate enough for a direction: the height is then set to zero.
_EARTH = 6.37e6


def far(angles: Sequence[float], bearings: int = 12) -> Array:
    """Return the bounds (q,) of a fix at a known height by distance, root mean square over bearings, metres.

    `angles` (q,) are the distances of the target from the point below the satellites, radians at the centre of the
    Earth. `bearings` is the number of directions from that point.
    """
    centre = SATELLITES.mean(0)
    up = centre / np.linalg.norm(centre)
    east, north, _ = ECEF.enu_axes(centre)
    # `up` belongs to a sphere, the axes to the ellipsoid: make the axes orthogonal to `up`.
    east, north = (v - (v @ up) * up for v in (east, north))
    bearing = 2.0 * np.pi * np.arange(bearings) / bearings
    sideways = np.cos(bearing)[:, None] * north + np.sin(bearing)[:, None] * east
    sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
    errors = []
    for angle in angles:
        lat, lon, _ = ecef_to_geodetic(_EARTH * (np.cos(angle) * up + np.sin(angle) * sideways))
        targets = geodetic_to_ecef(lat, lon, np.zeros(bearings))
        errors.append(np.sqrt((root_trace(crlb(problem(1, order=0, height=None), targets)) ** 2).mean()))
    return np.array(errors)


# The tables: the four filters from fixes and from distant starts, the effect of the height, and moving satellites.

NAMES = {
    "ekf": "EKF",
    "iekf": "IEKF",
    "mgekf": "MGEKF",
    "mvekf": "MVEKF",
    "quartic + ekf": "EKF from two fixes",
}
"""Names of the filters in tables and figures."""

# Steps at which errors are shown; a shorter sample shows only its own steps. Effects of the height come late, effects
# of orbits later.
_STEPS, _STEPS_HEIGHT, _STEPS_MOVING = (1, 10, 50, 100, 200), (1, 100, 200), (50, 100, 200)

# Steps that are left out of the comparison of filters: there the first fixes have most weight.
_SETTLED = 10

# A track that ends within this distance of the truth is not lost, metres: nine times the bound after 100 steps.
_NEAR = 1e3


def metres(value: float) -> str:
    """Return metres with a sensible number of digits; large numbers are in km."""
    if value >= 1e4:
        return f"{value / 1e3:.0f} km"
    return f"{value:.1f}" if value < 1e3 else f"{value:.0f}"


def table_fixed(found: Mapping[str, SatelliteRun], bound: Array) -> TextTable:
    """Return the table of filters that start from fixes; `bound` (steps,) is the posterior bound, metres.

    `found` has the runs by filter. The last column is the largest distance of the estimates from the estimates of
    the EKF.
    """
    steps = [step for step in _STEPS if step <= len(bound)]
    plain = found["ekf"].position
    lines = []
    for name, run in found.items():
        apart = np.linalg.norm(run.position - plain, axis=-1)[:, _SETTLED:].max()
        share = f"{100.0 * run.relative[-1]:.4f} %"
        lines.append((NAMES[name], *(metres(run.rms[step - 1]) for step in steps), share, f"{apart:.2f}"))
    lines.append(("posterior bound", *(metres(bound[step - 1]) for step in steps), ABSENT, ABSENT))
    last = f"mean error at {len(bound)}, of 100 km"
    header = ("filter", *(f"step {step}, m" for step in steps), last, "most from EKF after step 10, m")
    return tabulate("fixed", header, lines)


def table_relative(panels: Mapping[str, tuple[Mapping[str, SatelliteRun], Array]]) -> TextTable:
    """Return a table of the values of the paper's figure, in its unit: mean errors over 100 km, by start and filter.

    `panels` has the runs by filter, and the bound (steps,), by the title of the start.
    """
    longest = max(len(bound) for _, bound in panels.values())
    steps = [step for step in _STEPS if step <= longest]
    lines = []
    for title, (runs, bound) in panels.items():
        for name, run in runs.items():
            # a filter that starts from two fixes has no state before the second
            at = [s - 1 - len(bound) + len(run.relative) for s in steps]
            shown = (f"{100.0 * run.relative[i]:.4f} %" if 0 <= i < len(run.relative) else ABSENT for i in at)
            lines.append((title, NAMES[name], *shown))
    return tabulate("relative", ("start", "filter", *(f"step {step}" for step in steps)), lines)


def table_starts(found: Mapping[float, tuple[Mapping[str, SatelliteRun], Array]]) -> TextTable:
    """Return the table of filters after distant starts; `found` has runs and bounds by the start error in metres."""
    lines = []
    for width, (runs, bound) in found.items():
        for name, run in runs.items():
            last = run.error[:, -1]
            lengths = (float(run.rms[-1]), float(np.median(last)), float(run.claimed[:, -1].mean()))
            within = f"{100 * (last < _NEAR).mean():.1f} %"
            lines.append((f"{width / 1e3:.0f} km", NAMES[name], *map(metres, lengths), within, metres(bound[-1])))
    header = ("start error", "filter", "rms, m", "median, m", "claimed, m", "within 1 km", "posterior bound, m")
    return tabulate("starts", header, lines)


def table_pairs(found: Mapping[float, tuple[Mapping[str, SatelliteRun], Array]]) -> TextTable:
    """Return a table of the share of runs in which the MVEKF has a smaller final error than each other filter."""
    lines = []
    for width, (runs, _) in found.items():
        modified = runs["mvekf"].error[:, -1]
        better = [f"{100 * (modified < runs[rival].error[:, -1]).mean():.0f} %" for rival in ("ekf", "iekf", "mgekf")]
        lines.append((f"{width / 1e3:.0f} km", *better))
    return tabulate("pairs", ("start error", "better than EKF", "better than IEKF", "better than MGEKF"), lines)


def table_heights(found: Mapping[str, SatelliteRun]) -> TextTable:
    """Return a table of errors and claimed errors of the IEKF from fixes, by the knowledge of the height."""
    steps = [step for step in _STEPS_HEIGHT if step <= len(next(iter(found.values())).rms)]
    lines = [
        (name, *(f"{metres(run.rms[s - 1])} ({metres(run.claimed[:, s - 1].mean())})" for s in steps))
        for name, run in found.items()
    ]
    return tabulate("heights", ("height", *(f"step {step}: rms (claimed), m" for step in steps)), lines)


def table_moving(found: Mapping[str, tuple[SatelliteRun, Array]], still: Array) -> TextTable:
    """Return a table of errors and bounds with moving satellites, by heading.

    `still` (steps,) is the posterior bound with fixed satellites, metres.
    """
    steps = [step for step in _STEPS_MOVING if step <= len(still)]
    lines = [("as printed: they stay", *(f"{ABSENT} ({metres(still[s - 1])})" for s in steps))]
    for name, (run, bound) in found.items():
        lines.append((name, *(f"{metres(run.rms[s - 1])} ({metres(bound[s - 1])})" for s in steps)))
    return tabulate("moving", ("heading of the satellites", *(f"step {step}: rms (bound), m" for step in steps)), lines)


# Degrees from the point below the satellites: from overhead to errors of tens of kilometres.
_AWAY = (0.0, 5.0, 10.0, 20.0, 25.0)


def table_one_shot() -> TextTable:
    """Return a table of the bounds of a single fix, by known values, and by distance from the point below."""
    cases = {
        "50 ns each, height 500 m": problem(1, order=0),
        "50 ns each, height known": problem(1, order=0, height=None),
        "50 ns correlated, height 500 m": problem(1, order=0, correlated=True),
        "50 ns correlated, height known": problem(1, order=0, height=None, correlated=True),
        "50 ns each, height 10 m": problem(1, order=0, height=HEIGHT / 50.0),
    }
    lines = [(name, metres(float(root_trace(crlb(case, START))))) for name, case in cases.items()]
    for angle, value in zip(_AWAY, far(np.radians(_AWAY).tolist()), strict=True):
        lines.append((f"{angle:.0f}° from the point below, height known", metres(value)))
    return tabulate("one-shot", ("case", "bound, m"), lines)


# The figures: errors of the four filters, and the effect of the height, against time.

# Wide lines below narrow ones, so that filters that agree are all visible.
_STYLE = {
    "ekf": (Ink.RED, "-", 5.0),
    "mvekf": (Ink.ORANGE, "-", 3.2),
    "mgekf": (Ink.GREEN, "-", 1.8),
    "iekf": (Ink.BLUE, "--", 1.2),
    "quartic + ekf": (Ink.PINK, ":", 1.8),
}
# In the order of `heights`; the fourth and the fifth agree, so one is wide and the other narrow.
_STYLE_HEIGHT = ((Ink.BLUE, 1.8), (Ink.GREEN, 1.8), (Ink.SKY, 1.8), (Ink.RED, 4.0), (Ink.PINK, 1.6), (Ink.BLACK, 1.8))


def figure_filters(panels: Mapping[str, tuple[Mapping[str, SatelliteRun], Array]]) -> Figure:
    """Return a figure of root mean square errors and the posterior bound against steps, one panel for each start.

    `panels` has the filters and the bound (steps,) by title.
    """
    figure = canvas(0.6 + 6.0 * len(panels), 8.8)
    rows = figure.subplots(2, len(panels), squeeze=False)
    for above, below, (title, (runs, bound)) in zip(*rows, panels.items(), strict=True):
        for name, (colour, dash, width) in _STYLE.items():
            if name in runs:
                run = runs[name]
                steps = np.arange(len(bound) - len(run.rms) + 1, len(bound) + 1)
                above.plot(steps, run.rms, dash, color=colour, lw=width, label=NAMES[name])
                below.plot(steps, 100.0 * run.relative, dash, color=colour, lw=width, label=NAMES[name])
        above.plot(np.arange(1, len(bound) + 1), bound, color=Ink.BLACK, lw=0.9, label="posterior bound")
        above.set_title(title)
        _against_steps(above)
        scale(below)
        label(below, "step, one a second", "mean error, per cent of 100 km")
    explain(figure)
    return figure


def figure_heights(found: Mapping[str, SatelliteRun]) -> Figure:
    """Return a figure of errors, and the claimed errors (dotted), against steps, by the knowledge of the height."""
    figure = canvas(8.0, 5.2)
    ax = figure.subplots()
    for (colour, width), (name, run) in zip(_STYLE_HEIGHT, found.items(), strict=True):
        steps = np.arange(1, run.error.shape[1] + 1)
        ax.plot(steps, run.rms, color=colour, lw=width, label=name)
        ax.plot(steps, run.claimed.mean(0), ":", color=colour, lw=1.4)
    _against_steps(ax)
    explain(figure, 2)
    return figure


def _against_steps(ax: Axes) -> None:
    """Scale and label a panel of position errors against steps."""
    scale(ax)
    label(ax, "step, one a second", "position error, m (root mean square)")


# All results of the paper, in a quick and in a full size.

_HEADINGS = {"north": 0.0, "north-east": 0.25 * np.pi, "east": 0.5 * np.pi, "south-east": 0.75 * np.pi}
"""Directions of flight of satellites, radians; the opposite ones fly the same circles backwards."""

_PANEL = 100e3
"""Start error of a figure, metres: the smallest error at which the filters differ widely."""


@dataclass(frozen=True, slots=True)
class SatellitesSample:
    """Numbers of trials and steps.

    Parameters
    ----------
    trials : int
        Trials of each case.
    others : int
        Trials of each kind of height, and of each heading of moving satellites.
    widths : tuple of float
        Start errors, metres, including the 100 km of a figure.
    steps, far : int
        Steps of the filters, and of filters from distant starts; more than ten.
    """

    trials: int
    others: int
    widths: tuple[float, ...] = (1e3, 10e3, 30e3, 100e3, 200e3, 400e3)
    steps: int = 200
    far: int = 100


# Quick: root mean squares within five per cent, in about a minute. Full: within two.
_SIZES: dict[Size, SatellitesSample] = {"quick": SatellitesSample(200, 100), "full": SatellitesSample(2000, 1000)}


def _run(sample: SatellitesSample, seed: int, tick: Tick) -> Report:
    """Return the report of all simulations with the sizes `sample`; call `tick` after each simulation."""

    def sequence(key: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(seed, spawn_key=(key,))

    begun = run_fixed(sample.steps, sample.trials, sequence(0))
    tick()
    starts = {}
    for width in sample.widths:
        # The same data for every width: only the start differs.
        starts[width] = run_wild(width, sample.far, sample.trials, sequence(1))
        tick()
    known = run_heights(sample.steps, sample.others, sequence(2))
    tick()
    known["climbing target, height said to be 0"] = run_climbing(sample.steps, sample.others, sequence(3))
    tick()
    flying = {}
    for name, heading in _HEADINGS.items():
        flying[name] = run_moving(orbits(sample.steps + 2, heading), sample.others, sequence(4))
        tick()
    panels = {"from the first two fixes": begun, "start wrong by 100 km": starts[_PANEL]}
    tables = (
        table_fixed(*begun),
        table_relative(panels),
        table_starts(starts),
        table_pairs(starts),
        table_heights(known),
        table_moving(flying, begun[1]),
        table_one_shot(),
    )
    figures = {"filters": figure_filters(panels), "heights": figure_heights(known)}
    return typeset("satellites", sample, seed, tables, figures)


STUDY = Study(_SIZES, lambda sample: len(sample.widths) + len(_HEADINGS) + 3, _run)
"""The reproduction of the paper."""

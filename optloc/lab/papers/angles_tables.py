"""Simulations, tables and figures of the paper of Liu Zhe et al.: each value with the printed value and the bound.

A `run_...` function computes one simulation, and a `table_...` or `figure_...` function shows its result. a_max is the
largest acceleration of the motion model in m/s^2, and is called `limit` here. Each function calls `tick` after each
piece of work.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optloc.lab.papers.angles import (
    CIRCLE_START,
    LOST,
    READINGS,
    REPAIRED,
    STRAIGHT,
    STRAIGHT_START,
    TIME_CONSTANT,
    WINDING,
    WINDING_START,
    AnglesDraw,
    AnglesScenario,
    SimulatedRays,
    bound,
    distances,
    draw,
    errors,
    first_fix,
    fit_start,
    fixed_variance,
    fixes,
    linear_track,
    printed_transition,
    printed_variance,
    rms,
    run_rays,
    scatter_starts,
    share_lost,
    snapshot_bound,
    start_at_truth,
    track_all,
    whole_track_bound,
    whole_track_errors,
)
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
from optloc.problem import Array
from optloc.show import ABSENT, TextTable
from optloc.tracking import Dynamics, State, current_statistical, polynomial

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Values printed in section 3 of the paper.

PRINTED_STRAIGHT = (0.032, 0.0897, 0.176)
"""Simulation 1: root mean square errors of position (m), velocity (m/s) and acceleration (m/s^2)."""

PRINTED_WINDING = (0.16, 0.267, 0.47)
"""Simulation 2: errors as in `PRINTED_STRAIGHT`."""


# Filters in the three simulations: errors against time, bounds and lost tracks.

UPDATES = ("ekf", "iekf", "mgekf", "mvekf")
"""Names in `optloc.tracking.UPDATES`, in the order of the tables."""

SETTLED = 20
"""Seconds of simulation 3 without a score, because it begins at the fix of a single epoch: two time constants of the
model."""

_CLOSE = (0.1, 0.2)
"""Standard deviations of velocity and acceleration for the starts at several positions; see `STRAIGHT_START`."""


@dataclass(frozen=True, slots=True)
class ErrorCurve:
    """Errors against time.

    Parameters
    ----------
    label : str
        Name of the method.
    seconds : array (q,)
        Times.
    error : array (q, 3)
        Root mean square errors, or bounds, of position, velocity and acceleration.
    """

    label: str
    seconds: Array
    error: Array

    def total(self, first: int = 0, last: int | None = None) -> Array:
        """Return the root mean square errors (3,) over the times first < t <= last, seconds."""
        inside = (self.seconds > first) & (self.seconds <= (np.inf if last is None else last))
        return np.asarray(np.sqrt((self.error[inside] ** 2).mean(0)))

    def phases(self, scenario: AnglesScenario) -> list[float]:
        """Return the root mean square position error of each phase in metres, without the first `SETTLED` seconds."""
        first = (SETTLED, *scenario.phases[:-1])
        return [float(self.total(a, b)[0]) for a, b in zip(first, scenario.phases, strict=True)]


def track_curve(label: str, drawn: AnglesDraw, start: State, dynamics: Dynamics, update: str = "ekf") -> ErrorCurve:
    """Return the errors of the tracks of all trials from a start, against time."""
    return score_curve(label, drawn, track_all(drawn, start, dynamics, update).mean)


def score_curve(label: str, drawn: AnglesDraw, mean: Array) -> ErrorCurve:
    """Return the errors of states `mean` (trials, q, n) at the last q epochs, against time."""
    error = rms(errors(drawn, mean), (0,))
    last = drawn.scenario.epochs
    return ErrorCurve(label, np.arange(last - len(error) + 1.0, last + 1.0), error)


def bound_curve(label: str, scenario: AnglesScenario, start: State, dynamics: Dynamics) -> ErrorCurve:
    """Return the posterior bound of tracks from a start, against time."""
    least = bound(scenario, start, dynamics)
    return ErrorCurve(label, np.arange(start.time + 1.0, scenario.epochs + 1.0), least)


def run_straight(drawn: AnglesDraw, tick: Tick) -> list[ErrorCurve]:
    """Return the errors of simulation 1: the right and the printed transition, three values of a_max, and bounds."""
    # The paper prints no a_max: these are 150, 10 and one and a half times the acceleration of the target.
    start, curves = start_at_truth(drawn, STRAIGHT_START, known=2), []
    for limit in (30.0, 2.0, 0.3):
        for name, make in (("filter", current_statistical), ("printed f33", printed_transition)):
            curves.append(track_curve(f"{name}, a_max {limit:g}", drawn, start, make(TIME_CONSTANT, limit)))
            tick()
    curves.append(bound_curve("posterior bound, a_max 2", STRAIGHT, start, fixed_variance(2.0)))
    curves.append(bound_curve("bound of one track", STRAIGHT, start, polynomial(2)))
    tick()
    return curves


def run_winding(drawn: AnglesDraw, tick: Tick) -> list[ErrorCurve]:
    """Return the errors of simulation 2: started at rest, and by a fit of the first three epochs, and a bound."""
    # The paper prints no a_max: 30 m/s² and this start reproduce the printed errors within 15 %.
    model = current_statistical(TIME_CONSTANT, 30.0)
    start = start_at_truth(drawn, WINDING_START, known=1)
    curves = [
        track_curve("filter, started at rest", drawn, start, model),
        track_curve("filter, started by a fit of 3 s", drawn, fit_start(drawn, 3), model, "iekf"),
        bound_curve("posterior bound", WINDING, start, fixed_variance(30.0)),
    ]
    tick()
    return curves


def run_circles(drawn: AnglesDraw, tick: Tick) -> dict[float, list[ErrorCurve]]:
    """Return the errors of the repaired simulation 3 by a_max: three filters and the bound."""
    start, curves = first_fix(drawn, *CIRCLE_START), {}
    positions = fixes(drawn)
    tick()
    for limit in (100.0, 300.0):  # a third above the peak of 74 m/s², and four times the peak
        model = current_statistical(TIME_CONSTANT, limit)
        curves[limit] = [
            track_curve("single step", drawn, start, model),
            track_curve("converged", drawn, start, model, "iekf"),
            score_curve("fixes, then a linear filter", drawn, linear_track(positions, start, model)),
            bound_curve("posterior bound", REPAIRED, start, fixed_variance(limit)),
        ]
        tick()
    return curves


@dataclass(frozen=True, slots=True)
class TableReading:
    """Position errors and bounds of the phases of simulation 3 as printed.

    Parameters
    ----------
    scenario : AnglesScenario
        One of `READINGS`.
    limit : float
        Largest acceleration of the model, m/s^2.
    error, bound : list of float
        Metres, by phase.
    """

    scenario: AnglesScenario
    limit: float
    error: list[float]
    bound: list[float]


def run_readings(count: int, seed: int, key: int, tick: Tick) -> list[TableReading]:
    """Return the errors of simulation 3 as printed, for each reading of its unit and two values of a_max.

    `count` is the number of trials, and `key` is the number of the first draw in the reproduction.
    """
    readings = []
    for i, scenario in enumerate(READINGS):
        drawn = draw(scenario, count, seed, key + i)
        start = first_fix(drawn, *CIRCLE_START)
        for limit in (100.0, 300.0):
            curve = track_curve("", drawn, start, current_statistical(TIME_CONSTANT, limit))
            tick()
            least = bound_curve("", scenario, start, fixed_variance(limit))
            readings.append(TableReading(scenario, limit, curve.phases(scenario), least.phases(scenario)))
            tick()
    return readings


def run_snapshot() -> ErrorCurve:
    """Return the bound of the position of a separate fix at each second of the repaired simulation 3.

    The columns of velocity and acceleration are NaN, because a fix does not determine them.
    """
    least = snapshot_bound(REPAIRED)
    error = np.full((len(least), 3), np.nan)
    error[:, 0] = least
    return ErrorCurve("snapshot", np.arange(1.0, len(least) + 1.0), error)


Lost = dict[tuple[float, float], dict[str, float]]
"""Shares of lost tracks by filter. The keys are the standard deviation of the start's coordinates in metres, and a_max.

A standard deviation of zero means a start by a fit of the first epochs."""


def run_starts(drawn: AnglesDraw, tick: Tick) -> Lost:
    """Return the shares of tracks lost from starts near the line through the stations, and from a fit of 3 epochs."""
    lost: Lost = {}
    fit = fit_start(drawn, 3)
    # Metres off the line through both stations, which are 50 and 100 m away.
    for sigma, limit in ((1.0, 5.0), (1.0, 30.0), (3.0, 5.0), (3.0, 30.0), (0.0, 30.0)):
        start = scatter_starts(drawn, (sigma, *_CLOSE)) if sigma else fit
        model = current_statistical(TIME_CONSTANT, limit)
        lost[sigma, limit] = {name: share_lost(drawn, track_all(drawn, start, model, name)) for name in UPDATES}
        tick()
    return lost


def run_clamps(drawn: AnglesDraw, tick: Tick) -> dict[str, float]:
    """Return the shares of lost tracks with the published and with the clamped variance.

    The starts have standard deviations of 3 m, and a_max is 0.3.
    """
    # 0.3 is 0.1 m/s² above the target's acceleration: starts that are 0.2 m/s² wide cross the limit.
    start = scatter_starts(drawn, (3.0, *_CLOSE))
    models = {"as published": printed_variance, "clamped": current_statistical}
    lost = {
        name: share_lost(drawn, track_all(drawn, start, model(TIME_CONSTANT, 0.3))) for name, model in models.items()
    }
    tick()
    return lost


def run_ends(drawn: AnglesDraw, tick: Tick) -> dict[str, Array]:
    """Return the distances (trials,) from the truth at the end of simulation 1, by start and filter."""
    model = current_statistical(TIME_CONSTANT, 30.0)
    start = scatter_starts(drawn, (1.0, *_CLOSE))
    tracks = {
        "single step (the paper), start of 1 m": track_all(drawn, start, model, "ekf"),
        "converged, start of 1 m": track_all(drawn, start, model, "iekf"),
        "single step, started by a fit of 3 s": track_all(drawn, fit_start(drawn, 3), model, "ekf"),
    }
    tick()
    return {name: distances(drawn, track) for name, track in tracks.items()}


# The tables.

_PARTS = ("position, m", "velocity, m/s", "acceleration, m/s²")
_FAR = 1e6  # metres: such tracks diverge, and a few of them would dominate the mean


def short(value: float) -> str:
    """Return a number with three significant digits; "lost" if it is not finite or beyond 1000 km."""
    if not np.isfinite(value) or value > _FAR:
        return "lost"
    if value == 0.0 or value >= 1e2:
        return f"{value:.0f}"
    return f"{value:.2e}" if value < 1e-3 else f"{value:.{2 - int(np.floor(np.log10(value)))}f}"


def _as_cells(values: Iterable[float]) -> tuple[str, ...]:
    """Return numbers as cells of a table."""
    return tuple(map(short, values))


def table_straight(curves: Sequence[ErrorCurve]) -> TextTable:
    """Return a table of the errors of simulation 1 over the whole track."""
    lines = [("printed", *_as_cells(PRINTED_STRAIGHT)), *((c.label, *_as_cells(c.total())) for c in curves)]
    return tabulate("simulation-1", ("", *_PARTS), lines)


def table_winding(curves: Sequence[ErrorCurve]) -> TextTable:
    """Return a table of the errors of simulation 2, over the whole track and without its first ten seconds."""
    lines = [("0 to 50 s", "printed", *_as_cells(PRINTED_WINDING))]
    for first in (0, 10):
        lines += [(f"{first} to 50 s", c.label, *_as_cells(c.total(first))) for c in curves]
    return tabulate("simulation-2", ("scored", "", *_PARTS), lines)


def table_circles(found: Mapping[float, Sequence[ErrorCurve]], snapshot: ErrorCurve) -> TextTable:
    """Return a table of the position errors of the repaired simulation 3 by phase; `found` is by a_max."""
    lines = [(ABSENT, "bound of every second by itself", *_as_cells(snapshot.phases(REPAIRED)))]
    for limit, curves in found.items():
        lines += [(f"{limit:g}", c.label, *_as_cells(c.phases(REPAIRED))) for c in curves]
    return tabulate("simulation-3", ("a_max", "", "straight", "circle", "straight again"), lines)


def table_readings(found: Sequence[TableReading]) -> TextTable:
    """Return a table of the position errors of simulation 3 as printed, by reading, a_max and phase."""
    lines = []
    for reading in found:
        pairs = [value for pair in zip(reading.error, reading.bound, strict=True) for value in pair]
        lines.append((reading.scenario.name.removeprefix("as printed, in "), f"{reading.limit:g}", *_as_cells(pairs)))
    header = ("reading", "a_max", "straight", "bound", "circle", "bound", "straight again", "bound")
    return tabulate("readings", header, lines)


def table_starts(found: Lost) -> TextTable:
    """Return a table of the shares of lost tracks, by start, a_max and filter."""
    header = ("start", "a_max", "single step", "converged", "modified gain", "modified covariance")
    lines = [
        (f"{sigma:g} m" if sigma else "fit of 3 s", f"{limit:g}", *map(percent, shares.values()))
        for (sigma, limit), shares in found.items()
    ]
    return tabulate("starts", header, lines)


def table_clamps(found: Mapping[str, float]) -> TextTable:
    """Return a table of the shares of lost tracks with and without a clamped variance."""
    return tabulate("clamp", ("variance", "lost"), [(name, percent(share)) for name, share in found.items()])


def table_wholes(found: Sequence[tuple[str, Array]], bound: Array) -> TextTable:
    """Return a table of the errors at the end of simulation 1, by fit; `bound` (3,) is the Cramer-Rao bound."""
    lines = [("Cramér-Rao bound", *_as_cells(bound)), *((name, *_as_cells(error)) for name, error in found)]
    return tabulate("whole-track", ("", *_PARTS), lines)


def table_rays(found: Sequence[SimulatedRays]) -> TextTable:
    """Return a table of bias and error of fixes of a fixed target."""
    names = ("plain", "weighted", "instrumental", "maximum likelihood")
    lines = [
        (f"{rays.stations}", f"{1e3 * rays.sigma:g} mrad", name, *_as_cells((*values, rays.bound)))
        for rays in found
        for name, values in zip(names, rays.fixes, strict=True)
    ]
    return tabulate("rays", ("stations", "noise", "fix", "bias", "error", "bound"), lines)


# Figures 1 to 7 of the paper as errors and bounds against time, and a figure of the starts that lose the track.

_EDGES = (1e-3, 1e8)  # of the axis of distances, metres: from far below the noise to diverging tracks
Style = tuple[str, str, str]
"""Label, colour and line style of a curve."""


def three_parts(curves: Mapping[Style, ErrorCurve], values: Sequence[float]) -> Figure:
    """Return a figure of errors of position, velocity and acceleration against time, one panel for each.

    Parameters
    ----------
    curves : mapping of (label, colour, line) to ErrorCurve
        The curves.
    values : sequence of three float
        Printed errors over the whole track.
    """
    figure = canvas(13.0, 4.4)
    for part, (ax, name) in enumerate(zip(figure.subplots(1, 3), _PARTS, strict=True)):
        for (curve, colour, line), found in curves.items():
            ax.plot(found.seconds, found.error[:, part], line, color=colour, label=curve)
        ax.axhline(values[part], color=Ink.PINK, linestyle=":", label="printed, over the track")
        scale(ax)
        label(ax, "time, s", f"error of {name}")
    explain(figure)
    return figure


def figure_straight(curves: Sequence[ErrorCurve]) -> Figure:
    """Return a figure with figures 1 to 3 of the paper: the errors of simulation 1 against time."""
    by_label = {c.label: c for c in curves}
    return three_parts(
        {
            ("filter, a_max 2", Ink.BLUE, "-"): by_label["filter, a_max 2"],
            ("filter, a_max 30", Ink.GREEN, "-"): by_label["filter, a_max 30"],
            ("printed f33, a_max 2", Ink.RED, "-"): by_label["printed f33, a_max 2"],
            ("posterior bound, a_max 2", Ink.BLACK, "--"): by_label["posterior bound, a_max 2"],
            ("bound of one track", Ink.GREY, "--"): by_label["bound of one track"],
        },
        PRINTED_STRAIGHT,
    )


def figure_winding(curves: Sequence[ErrorCurve]) -> Figure:
    """Return a figure with figures 4 to 6 of the paper: the errors of simulation 2 against time."""
    styles = ((Ink.RED, "-"), (Ink.BLUE, "-"), (Ink.BLACK, "--"))
    return three_parts({(c.label, *style): c for c, style in zip(curves, styles, strict=True)}, PRINTED_WINDING)


def figure_circles(found: Mapping[float, Sequence[ErrorCurve]], snapshot: ErrorCurve) -> Figure:
    """Return figure 7: position errors of the repaired simulation 3, one panel for each a_max; `found` is by a_max."""
    figure = canvas(13.0, 4.6)
    axes = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for ax, (limit, curves) in zip(axes, found.items(), strict=True):
        ax.axvspan(*REPAIRED.phases[:2], color="#EEEEEE")
        ax.plot(snapshot.seconds, snapshot.error[:, 0], ":", color=Ink.GREY, label="bound of every second by itself")
        by_label = {c.label: c for c in curves}
        # The two filters hardly differ: the converged one is a broad line behind the other.
        styles = (
            ("converged", Ink.RED, "-", 4.0),
            ("single step", Ink.BLUE, "-", 1.2),
            ("posterior bound", Ink.BLACK, "--", 1.5),
        )
        for curve, colour, line, width in styles:
            ax.plot(by_label[curve].seconds, by_label[curve].error[:, 0], line, color=colour, label=curve, lw=width)
        label(ax, "time, s", "position error, m (root mean square)" if ax is axes[0] else "")
        ax.set_title(f"a_max = {limit:g} m/s²; shaded: circle with 74 m/s²")
        ax.set_ylim(0.0, 1800.0)
    explain(figure)
    return figure


def figure_starts(ends: Mapping[str, Array]) -> Figure:
    """Return a figure of the share of tracks that end within each distance from the truth.

    `ends` are the distances (trials,) of the last states in metres, by start and filter.
    """
    figure = canvas(7.0, 4.4)
    ax = figure.subplots()
    styles = ((Ink.RED, "-", 1.5), (Ink.BLUE, "-", 4.0), (Ink.GREEN, "--", 1.5))
    for (curve, values), (colour, line, width) in zip(ends.items(), styles, strict=True):
        ordered = np.sort(np.append(np.where(np.isfinite(values), values, np.inf), _EDGES))
        share = np.searchsorted(np.sort(values), ordered, side="right") / len(values)
        ax.step(ordered, share, line, where="post", color=colour, label=curve, lw=width)
    ax.axvline(LOST, color=Ink.GREY, linestyle=":", label="counts as lost")
    ax.set_xscale("log")
    ax.set_xlim(*_EDGES)
    label(ax, "distance from the truth at 50 s, m", "share of tracks")
    ax.legend(loc="lower right", frameon=False)
    return figure


# All results of the paper, in a quick and in a full size.

_TICKS = 31  # calls of `tick` below


@dataclass(frozen=True, slots=True)
class AnglesSample:
    """Numbers of trials.

    Parameters
    ----------
    trials : int
        Trials of simulations 1 and 2 and of fixes.
    many : int
        Trials of the table of lost tracks.
    circles : int
        Trials of the repaired simulation 3.
    readings : int
        Trials of simulation 3 as printed, 3000 s each.
    """

    trials: int
    many: int
    circles: int
    readings: int


# Quick: a minute or two. Full: the shares of lost tracks are accurate to a per cent.
_SIZES: dict[Size, AnglesSample] = {"quick": AnglesSample(200, 200, 60, 10), "full": AnglesSample(1000, 1000, 400, 100)}


def _run(sample: AnglesSample, seed: int, tick: Tick) -> Report:
    """Return the report of all simulations with the sizes `sample`; call `tick` after each simulation."""
    straight_draw = draw(STRAIGHT, sample.trials, seed, 0)
    straight = run_straight(straight_draw, tick)
    whole_tracks = whole_track_errors(straight_draw, tick)
    winding = run_winding(draw(WINDING, sample.trials, seed, 1), tick)
    circles, snapshot = run_circles(draw(REPAIRED, sample.circles, seed, 2), tick), run_snapshot()
    many_draw = draw(STRAIGHT, sample.many, seed, 3)
    starts, clamps, ends = run_starts(many_draw, tick), run_clamps(many_draw, tick), run_ends(many_draw, tick)
    rays = run_rays(sample.trials, seed, 4, tick)
    readings = run_readings(sample.readings, seed, 8, tick)
    tables = (
        table_straight(straight),
        table_wholes(whole_tracks, whole_track_bound()),
        table_starts(starts),
        table_clamps(clamps),
        table_winding(winding),
        table_circles(circles, snapshot),
        table_readings(readings),
        table_rays(rays),
    )
    figures = {
        "figure-1-3": figure_straight(straight),
        "starts": figure_starts(ends),
        "figure-4-6": figure_winding(winding),
        "figure-7": figure_circles(circles, snapshot),
    }
    return typeset("angles", sample, seed, tables, figures)


STUDY = Study(_SIZES, lambda _: _TICKS, _run)
"""The reproduction of the paper."""

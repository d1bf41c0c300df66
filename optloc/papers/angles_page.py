"""The paper made again: simulations 1 to 3, their bounds, and what their starts and their model decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.types import Array
from optloc.papers import angles
from optloc.papers.angles import REPAIRED, STRAIGHT, WINDING, Curve, Lost, Rays, Reading, draw
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick, canvas

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The numbers that the paper prints in section 3, and the bounds that its scenes were found to have.

PRINTED_STRAIGHT = (0.032, 0.0897, 0.176)
"""Simulation 1: root mean square errors of position (m), velocity (m/s) and acceleration (m/s^2)."""

PRINTED_WINDING = (0.16, 0.267, 0.47)
"""Simulation 2: the same."""


# The tables: printed value, reproduced value and bound side by side.

_PARTS = ("position, m", "velocity, m/s", "acceleration, m/s²")
_FAR = 1e6


def short(value: float) -> str:
    """Return a number with three significant digits, "lost" where it is not finite or beyond 1000 km."""
    if not np.isfinite(value) or value > _FAR:
        return "lost"
    if value == 0.0 or value >= 1e2:
        return f"{value:.0f}"
    return f"{value:.2e}" if value < 1e-3 else f"{value:.{2 - int(np.floor(np.log10(value)))}f}"


def percent(share: float) -> str:
    """Return a share as per cent."""
    return f"{100.0 * share:.1f} %"


def straight_table(curves: Sequence[Curve]) -> Table:
    """Return the errors of simulation 1 over the whole track."""
    lines = [("printed", *(short(v) for v in PRINTED_STRAIGHT))]
    lines += [(c.label, *(short(v) for v in c.total())) for c in curves]
    note = (
        "Root mean square over 50 s. The start is the truth with acceleration zero, of standard deviations 0.1 m, "
        "0.1 m/s and 0.2 m/s². The posterior bound averages over tracks of the model, with the variance that it has "
        "without acceleration; this track is smoother than most of them. The last row is the bound of the one track "
        "whose acceleration is known to be constant."
    )
    return Table("simulation-1", "Simulation 1: errors of the filter", ("", *_PARTS), tuple(lines), note)


def winding_table(curves: Sequence[Curve]) -> Table:
    """Return the errors of simulation 2, over the whole track and without its first ten seconds."""
    lines = [("0 to 50 s", "printed", *(short(v) for v in PRINTED_WINDING))]
    for first in (0, 10):
        lines += [(f"{first} to 50 s", c.label, *(short(v) for v in c.total(first))) for c in curves]
    note = (
        "a_max 30. Started at rest with standard deviations of 0.1 m, 2 m/s and 1 m/s²; or by the fit of an "
        "acceleration to the first three seconds, without a guess, and scored from the fourth on."
    )
    return Table("simulation-2", "Simulation 2: errors of the filter", ("scored", "", *_PARTS), tuple(lines), note)


def circles_table(found: Mapping[float, Sequence[Curve]], snapshot: Curve) -> Table:
    """Return the position errors of the repaired simulation 3."""
    lines = [("–", "bound of every second by itself", *(short(v) for v in snapshot.phases(REPAIRED)))]
    for limit, curves in found.items():
        lines += [(f"{limit:g}", c.label, *(short(v) for v in c.phases(REPAIRED))) for c in curves]
    header = ("a_max", "", "straight", "circle", "straight again")
    note = (
        "Position errors in metres; the first 20 s do not count. 74 m/s² is the acceleration in the circle. All "
        "filters start at the fix of the first second."
    )
    return Table("simulation-3", "Simulation 3, repaired", header, tuple(lines), note)


def readings_table(found: Sequence[Reading]) -> Table:
    """Return the position errors of simulation 3 as printed."""
    lines = []
    for each in found:
        pairs = [cell for pair in zip(each.error, each.bound, strict=True) for cell in pair]
        lines.append(
            (each.scenario.name.removeprefix("as printed, in "), f"{each.limit:g}", *(short(v) for v in pairs))
        )
    header = ("reading", "a_max", "straight", "bound", "circle", "bound", "straight again", "bound")
    note = "Metres; the first 20 s do not count; the bound is the posterior one."
    return Table("readings", "Simulation 3 as printed, in two readings", header, tuple(lines), note)


def starts_table(found: Sequence[Lost]) -> Table:
    """Return the shares of lost tracks."""
    header = ("start", "a_max", "single step", "converged", "modified gain", "modified covariance")
    lines = []
    for each in found:
        start = f"{each.sigma:g} m" if each.sigma else "fit of 3 s"
        lines.append((start, f"{each.limit:g}", *(percent(each.share[n]) for n in ("ekf", "iekf", "mgekf", "mvekf"))))
    note = (
        "Share of the tracks of simulation 1 that end further than 10 m from the truth. Starts are drawn around the "
        "truth with the deviation given, 0.1 m/s and 0.2 m/s²; the last row starts by a fit without a guess. The "
        "single step is the update of the paper."
    )
    return Table("starts", "A start on the line through both stations", header, tuple(lines), note)


def clamps_table(found: Mapping[str, float]) -> Table:
    """Return the shares of lost tracks with and without a clamped variance."""
    lines = tuple((name, percent(share)) for name, share in found.items())
    note = "Simulation 1 from starts of 3 m with a_max 0.3; the acceleration is 0.2 m/s². Single step."
    return Table("clamp", "The variance near the limit of the acceleration", ("variance", "lost"), lines, note)


def wholes_table(found: Sequence[tuple[str, Array]], bound: Array) -> Table:
    """Return the errors at the end of simulation 1 of fits to the whole track."""
    lines = [("Cramér-Rao bound", *(short(v) for v in bound))]
    lines += [(name, *(short(v) for v in error)) for name, error in found]
    note = "Root mean square at 50 s. The fits know that the acceleration is constant and have neither start nor prior."
    return Table("whole-track", "Simulation 1: fits to the whole track", ("", *_PARTS), tuple(lines), note)


def rays_table(found: Sequence[Rays]) -> Table:
    """Return bias and error of fixes of a target that stays."""
    header = ("stations", "noise", "fix", "bias", "error", "bound")
    names = ("plain", "weighted", "instrumental", "maximum likelihood")
    lines = [
        (f"{each.stations}", f"{1e3 * each.sigma:g} mrad", name, *(short(v) for v in (*values, each.bound)))
        for each in found
        for name, values in zip(names, each.fixes, strict=True)
    ]
    note = (
        "Target at (-10, 50, 10) km; metres; the bias is known to the error over the root of the number of trials. Two "
        "stations are those of simulation 3, the others stand between them in two rows."
    )
    return Table("rays", "A target that stays: few rays and many", header, tuple(lines), note)


# What the page of the paper says around its tables.

TITLE = "Tracking by azimuth and elevation with the current statistical model"

OPENING = """\
Two stations that stay measure azimuth and elevation of a moving target once a second. The paper (Liu Zhe, Wei Junhu,
Huang Wenzhun, Huang Shiqi: *A new method of target location and tracking by log-likelihood estimation*, in Chinese)
updates the state by normal equations of angles linearised at the prediction, and predicts it by the current statistical
model of Zhou and Kumar. Its three simulations are made again here.

- **single step** is the update of the paper. It is the extended Kalman filter, exactly: pseudo-measurements
  z − h(ŝ) + Hŝ in normal equations give the textbook gain.
- **converged** repeats the linearisation until the state no longer moves. That is the point that the paper's own
  equation 16 asks for, and the iterated extended Kalman filter.
- A **fit** is `optloc.track.batch.fitted`, or `optloc.track.begun` for a single run: maximum likelihood of a polynomial
  course through several seconds, without a guess. `optloc.solve` starts it by pseudo-linear least squares of the whole
  stretch with instrumental variables.

## How the paper was read

- **Missing:** the time constant is 10 s ("manoeuvre constant 10"), scans are at 1, 2, ... 50 s, the target of the first
  simulation moves along x. The largest acceleration a_max of the model and the start are not given: the tables show
  several of the first, and say what was taken for the second. Agreement with a printed number says that it can be
  reached, not that these were the paper's values.
- **Simulation 2** is x = 2t, y = 10 sin(5πt/180).
- **Simulation 3** prints the same place for both stations; they stand at (∓40, 0, 0) km here. The speed of the straight
  parts has no unit, 500 s of a circle at 0.157 rad/s are 12.494 turns, and the speed jumps at both transitions. The
  *repaired* one flies at 471 m/s throughout: 100 s straight, one full turn in 40 s, 100 s straight.
- **Bounds.** The posterior bound has the process noise of the model, with its variance at acceleration zero, and
  averages over all tracks that this noise makes. A track that is smoother can beat it, and these are."""

CLOSING = """\
## What is wrong in the paper

1. The update is not a closed form of the stated problem: it is one Gauss-Newton step towards it. "Avoiding iterations"
   is what loses tracks where the stations and the start lie on one line, as they do in simulation 1 (table *starts*).
   Some more steps on the same cost keep them all; a fit of three seconds needs no start at all.
2. It is not the pseudo-linear estimator either, whose rows sin A (x − x_i) − cos A (y − y_i) = 0 carry noise in their
   coefficients: the tables *whole-track* and *rays* show what that costs, and that instrumental variables mend it.
3. f33 of the transition is printed as 1 − exp(−αT), three times. It has to be exp(−αT): at αT = 0.1 the printed one
   forgets nine tenths of the acceleration in a second. The printed acceleration error, 0.176 of 0.2 m/s², is near to
   what this slip gives, whatever a_max is; with the right one it depends on a_max and is smaller.
4. U is printed as one vector of nine that multiplies three accelerations; it is block diagonal. Q₀ and the rule of the
   variance are not printed.
5. Angles are those of station minus target with the principal arctangent. Sine and cosine then flip where the target
   is to the right of a station, and simulation 1 runs away; with the two-argument one the filter is the one here. The
   signs of equation 19 contradict those of equation 20 and of H.
6. L(s) lacks a factor of one half, and D is printed with the target minus its own prediction.
7. With the acceleration for its mean, the model predicts the state by plain constant acceleration; time constant and
   a_max act through the covariance alone. That decays as Singer's does: in a long manoeuvre it is too small.
8. The variance of the model vanishes where the acceleration comes near a_max, just when the target manoeuvres. With
   a_max = 100 the filter fails in the circle of 74 m/s² in every reading; with four times the peak it is near the
   bound. Beyond a_max the published variance grows without end; here the distance is held at 5 % of a_max (table
   *clamp*).
9. In simulation 2 the printed errors are those of the first seconds: without them the filter is twenty times better.
   The acceleration there never exceeds 0.0762 m/s²: an error of 0.47 is not "within 25 %".
10. Simulations 1 and 2 need different starts to give the printed numbers; the text says that they have the same.
11. That the error of simulation 3 comes near the bound is true of the model's own bound. A linear filter on the fixes
    of every second does as well: it is the model of motion that limits, not the linearisation."""


# Figures 1 to 7 of the paper as errors and bounds against time, and one of the starts that lose the track.

_BLACK, _GREY, _BLUE, _ORANGE, _GREEN, _PURPLE = (
    "#000000",
    "#7F7F7F",
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
)
_FIGURE_PARTS = ("position error, m", "velocity error, m/s", "acceleration error, m/s²")
_EDGES = (1e-3, 1e8)
Style = tuple[str, str, str]
"""Label, colour and line style of a curve."""


def three_parts(curves: Mapping[Style, Curve], values: Sequence[float]) -> Figure:
    """Return errors of position, velocity and acceleration against time, one panel for each.

    Parameters
    ----------
    curves : mapping of (label, colour, line) to Curve
        What is drawn.
    values : sequence of three float
        Printed errors over the whole track.
    """
    figure = canvas(13.0, 4.4)
    axes = figure.subplots(1, 3)
    for part, (ax, name) in enumerate(zip(axes, _FIGURE_PARTS, strict=True)):
        for (label, colour, line), curve in curves.items():
            ax.plot(curve.seconds, curve.error[:, part], line, color=colour, label=label)
        ax.axhline(values[part], color=_PURPLE, linestyle=":", label="printed, over the track")
        _dressed(ax, name)
    _legend(figure, axes[0])
    return figure


def straight_figure(curves: Sequence[Curve]) -> Figure:
    """Return figures 1 to 3: simulation 1."""
    by = {c.label: c for c in curves}
    return three_parts(
        {
            ("filter, a_max 2", _BLUE, "-"): by["filter, a_max 2"],
            ("filter, a_max 30", _GREEN, "-"): by["filter, a_max 30"],
            ("printed f33, a_max 2", _ORANGE, "-"): by["printed f33, a_max 2"],
            ("posterior bound, a_max 2", _BLACK, "--"): by["posterior bound, a_max 2"],
            ("bound of one track", _GREY, "--"): by["bound of one track"],
        },
        PRINTED_STRAIGHT,
    )


def winding_figure(curves: Sequence[Curve]) -> Figure:
    """Return figures 4 to 6: simulation 2."""
    looks = ((_ORANGE, "-"), (_BLUE, "-"), (_BLACK, "--"))
    return three_parts({(c.label, *look): c for c, look in zip(curves, looks, strict=True)}, PRINTED_WINDING)


def circles_figure(found: Mapping[float, Sequence[Curve]], snapshot: Curve) -> Figure:
    """Return figure 7: position errors of the repaired simulation 3, one panel for each limit."""
    figure = canvas(13.0, 4.6)
    axes = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for ax, (limit, curves) in zip(axes, found.items(), strict=True):
        ax.axvspan(*REPAIRED.phases[:2], color="#EEEEEE")
        ax.plot(snapshot.seconds, snapshot.error[:, 0], ":", color=_GREY, label="bound of every second by itself")
        by = {c.label: c for c in curves}
        # The two filters hardly differ: the converged one is a broad line behind the other.
        looks = (
            ("converged", _ORANGE, "-", 4.0),
            ("single step", _BLUE, "-", 1.2),
            ("posterior bound", _BLACK, "--", 1.5),
        )
        for label, colour, line, width in looks:
            ax.plot(by[label].seconds, by[label].error[:, 0], line, color=colour, label=label, lw=width)
        _dressed(ax, "position error, m (root mean square)", logarithmic=False)
        ax.set_title(f"a_max = {limit:g} m/s²; shaded: circle with 74 m/s²")
        ax.set_ylim(0.0, 1800.0)
    axes[1].set_ylabel("")
    _legend(figure, axes[0])
    return figure


def starts_figure(ends: Mapping[str, Array]) -> Figure:
    """Return the share of tracks that end nearer to the truth than a distance.

    Parameters
    ----------
    ends : mapping of str to array (trials,)
        Distances at the end, by label.
    """
    figure = canvas(7.0, 4.4)
    ax = figure.subplots()
    looks = ((_ORANGE, "-", 1.5), (_BLUE, "-", 4.0), (_GREEN, "--", 1.5))
    for (label, values), (colour, line, width) in zip(ends.items(), looks, strict=True):
        ordered = np.sort(np.append(np.where(np.isfinite(values), values, np.inf), _EDGES))
        share = np.searchsorted(np.sort(values), ordered, side="right") / len(values)
        ax.step(ordered, share, line, where="post", color=colour, label=label, lw=width)
    ax.axvline(10.0, color=_GREY, linestyle=":", label="counts as lost")
    ax.set_xscale("log")
    ax.set_xlim(*_EDGES)
    ax.set_xlabel("distance from the truth at 50 s, m")
    ax.set_ylabel("share of tracks")
    ax.grid(visible=True, alpha=0.25)
    ax.legend(loc="lower right", frameon=False)
    return figure


def _dressed(ax: Axes, name: str, *, logarithmic: bool = True) -> None:
    if logarithmic:
        ax.set_yscale("log")
    ax.set_xlabel("time, s")
    ax.set_ylabel(name)
    ax.grid(visible=True, alpha=0.25)


def _legend(figure: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)


_TICKS = 31


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

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


_SIZES: dict[Size, Sample] = {"quick": Sample(200, 200, 60, 10), "full": Sample(1000, 1000, 400, 100)}


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    one = draw(STRAIGHT, sample.trials, seed, 0)
    straight = angles.straight(one, tick)
    wholes = angles.wholes(one, tick)
    winding = angles.winding(draw(WINDING, sample.trials, seed, 1), tick)
    circles, snapshot = angles.circles(draw(REPAIRED, sample.circles, seed, 2), tick), angles.snapshot()
    many = draw(STRAIGHT, sample.many, seed, 3)
    starts, clamps, ends = angles.starts(many, tick), angles.clamps(many, tick), angles.ends(many, tick)
    rays = angles.rays(sample.trials, seed, 4, tick)
    readings = angles.readings(sample.readings, seed, 8, tick)
    return Report(
        TITLE,
        f"seed {seed}, {sample.trials} trials, {sample.many} of the starts, {sample.circles} of simulation 3 repaired "
        f"and {sample.readings} as printed",
        OPENING,
        CLOSING,
        (
            straight_table(straight),
            wholes_table(wholes, angles.whole_track_bound()),
            starts_table(starts),
            clamps_table(clamps),
            winding_table(winding),
            circles_table(circles, snapshot),
            readings_table(readings),
            rays_table(rays),
        ),
        (
            Picture("figure-1-3", "Figures 1 to 3: simulation 1", straight_figure(straight)),
            Picture("starts", "Starts on the line through both stations", starts_figure(ends)),
            Picture("figure-4-6", "Figures 4 to 6: simulation 2", winding_figure(winding)),
            Picture("figure-7", "Figure 7: simulation 3, repaired", circles_figure(circles, snapshot)),
        ),
    )


STUDY = Study(_SIZES, lambda _: _TICKS, _run)
"""The reproduction of the paper."""

"""Everything that the paper shows, in a quick and in a full size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.types import Array
from optloc.bounds.crlb import crlb
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick, canvas
from optloc.papers.satellites import (
    HEIGHT,
    START,
    Run,
    climbing,
    far,
    fixed,
    heights,
    moving,
    orbits,
    problem,
    root_trace,
    wild,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The tables: the four filters from fixes and from afar, what the height is worth, and satellites that move.

NAMES = {
    "ekf": "EKF",
    "iekf": "IEKF",
    "mgekf": "MGEKF",
    "mvekf": "MVEKF",
    "quartic + ekf": "EKF from two fixes",
}
"""How tables and figures call the filters."""

STEPS = (1, 10, 50, 100, 200)
"""Steps at which the filters are looked at."""


def metres(value: float) -> str:
    """Return metres with a sensible number of digits; kilometres are marked."""
    if value >= 1e4:
        return f"{value / 1e3:.0f} km"
    return f"{value:.1f}" if value < 1e3 else f"{value:.0f}"


def fixed_table(found: Mapping[str, Run], bound: Array) -> Table:
    """Return the filters started by fixes; the bound is (steps,), metres."""
    steps = [step for step in STEPS if step <= len(bound)]
    plain = found["ekf"].position
    lines = []
    for name, run in found.items():
        apart = np.linalg.norm(run.position - plain, axis=-1)[:, 10:].max()
        share = f"{run.error.mean(0)[-1] / 1e3:.4f} %"
        lines.append((NAMES[name], *(metres(run.rms[step - 1]) for step in steps), share, f"{apart:.2f}"))
    lines.append(("posterior bound", *(metres(bound[step - 1]) for step in steps), "–", "–"))
    last = f"mean error at {len(bound)}, of 100 km"
    header = ("filter", *(f"step {step}, m" for step in steps), last, "most from EKF after step 10, m")
    note = (
        "Root mean square errors. The paper's curves of the four filters lie far apart; from fixes they are one curve."
    )
    return Table("fixed", "Started by the fixes of the first two epochs", header, tuple(lines), note)


def starts_table(found: Mapping[float, tuple[Mapping[str, Run], Array]], near: float = 1e3) -> Table:
    """Return the filters after starts that are far off, by the standard deviation of each coordinate, metres."""
    lines = []
    for width, (runs, bound) in found.items():
        for name, run in runs.items():
            last = run.error[:, -1]
            figures = (
                metres(float(run.rms[-1])),
                metres(float(np.median(last))),
                metres(float(run.claimed[:, -1].mean())),
            )
            lines.append(
                (
                    f"{width / 1e3:.0f} km",
                    NAMES[name],
                    *figures,
                    f"{100 * (last < near).mean():.1f} %",
                    metres(bound[-1]),
                )
            )
    header = ("start error", "filter", "rms, m", "median, m", "claimed, m", "within 1 km", "posterior bound, m")
    note = (
        "*Claimed* is the root of the trace of the filter's own covariance. The last filter of each group takes no "
        "start: it begins from the fixes of the first two epochs of the same data."
    )
    count = len(next(iter(found.values()))[1])
    return Table("starts", f"Far starts, after {count} steps", header, tuple(lines), note)


def pairs(found: Mapping[float, tuple[Mapping[str, Run], Array]]) -> Table:
    """Return in how many runs the modified covariance did better than its rivals at the end."""
    lines = []
    for width, (runs, _) in found.items():
        own = runs["mvekf"].error[:, -1]
        better = [f"{100 * (own < runs[rival].error[:, -1]).mean():.0f} %" for rival in ("ekf", "iekf", "mgekf")]
        lines.append((f"{width / 1e3:.0f} km", *better))
    header = ("start error", "better than EKF", "better than IEKF", "better than MGEKF")
    return Table("pairs", "Runs in which the MVEKF ends nearer to the truth", header, tuple(lines))


def heights_table(found: Mapping[str, Run]) -> Table:
    """Return errors and claims of the IEKF from fixes, by what is known of the height."""
    lines = []
    for name, run in found.items():
        steps = [step for step in (1, 100, 200) if step <= run.error.shape[1]]
        cells = [f"{metres(run.rms[s - 1])} ({metres(run.claimed[:, s - 1].mean())})" for s in steps]
        lines.append((name, *cells))
    header = ("height", *(f"step {step}: rms (claimed), m" for step in steps))
    note = (
        "A wrong height is a constant. As white noise it seems to average out; as a state with a prior it stays in the "
        "covariance. The height of the sea is known to ten metres."
    )
    return Table("heights", "What the height is worth", header, tuple(lines), note)


def moving_table(found: Mapping[str, tuple[Run, Array]], still: Array) -> Table:
    """Return errors and bounds with satellites that fly, by heading, beside the bound (steps,) of those that stay."""
    steps = [step for step in (50, 100, 200) if step <= len(still)]
    lines = [("as printed: they stay", *(f"– ({metres(still[s - 1])})" for s in steps))]
    for name, (run, bound) in found.items():
        lines.append((name, *(f"{metres(run.rms[s - 1])} ({metres(bound[s - 1])})" for s in steps)))
    header = ("heading of the satellites", *(f"step {step}: rms (bound), m" for step in steps))
    note = "They fly at 7.4 km/s; the geometry is soon worse than that of the printed ones."
    return Table("moving", "Satellites that move, IEKF from two fixes", header, tuple(lines), note)


def one_shot(bounds: Mapping[str, float], far: Mapping[float, float]) -> Table:
    """Return bounds of a single fix, metres: by noise, and by degrees from the point below the satellites."""
    lines = [(name, metres(value)) for name, value in bounds.items()]
    lines += [(f"{angle:.0f}° from the point below, height known", metres(value)) for angle, value in far.items()]
    note = "Root of the trace; over twelve bearings in the last rows."
    return Table("one-shot", "Bound of one fix", ("case", "bound, m"), tuple(lines), note)


# What the page says around its tables.

TITLE = "Three satellites and a known height: four Kalman filters"

OPENING = """\
Three satellites 800 km high and 90 km apart receive the pulses of a ship near 25.8° N, 127.4° E. Two differences of
their arrival times (50 ns each) and an assumed height (500 m) give one position a second. The paper compares four
extended Kalman filters on this task and finds its own, with a covariance that is linearised anew after the update
(MVEKF), the fastest and best. The comparison is made again here:

- **EKF** linearises once, at the prediction. **IEKF** repeats that at the new state until nothing moves, damped.
- **MGEKF** replaces the derivative in the covariance by a function g with h(x) − h(y) = g (x − y) exactly; g is the
  mean of the derivative over the way from the prediction to the update, which exists for every kind of measurement.
- **MVEKF** moves the state like the EKF, and linearises again for the covariance only.
- **From two fixes**: every fix is solved without a guess. The range differences and the ellipsoid at the given
  height give a quartic, of whose roots one is in sight of all satellites; one more step takes in the noise. Two
  fixes give place and velocity, with the covariance between both.

The *posterior bound* is that of Cramér and Rao for the model of motion, in covariance form. Where it is met, a root
mean square of 200 trials still scatters about it by five per cent, alike for all filters: they see the same data.

## How the paper was read

- Time step, length and process noise are not printed: 1 s, 200 steps and 0.01 m/s² are used. Heights are white with
  500 m, and the satellites stay where they are in the Earth's frame, both as printed.
- z = r1 − r2 and r1 − r3: positive when the first satellite is the farther one.
- *Relative error* is the mean error over 100 km.
- *Start error* is that of each coordinate, with a covariance that says so, and 50 m/s for the velocity."""

CLOSING = """\
## What follows

1. Started by fixes, as the paper says it does, the four filters are one: what they linearise is bent by δ²/2r, 0.15
   m for an error of 500 m, against noise of 15 m. They reach the bound.
2. They come apart when the start is wrong by tens of kilometres. One epoch then determines the place, but a single
   linearisation misses by δ²/2r, some 10 km for 100 km, while the covariance says 0.6 km. Only iteration repairs
   that; the MGEKF survives because its covariance stays large. The order is IEKF, MGEKF, and far behind MVEKF and
   EKF.
3. The claim that MVEKF is best holds against the EKF, moderately, for start errors of 30 to 200 km. It holds nowhere
   against the IEKF.
4. A fix needs no start, so the question does not arise: from two fixes even the EKF is at the bound.
5. The height is the weak point. A wrong height is a constant and never averages out; a filter that takes it for
   white noise is wrong by seven times what it claims. As a constant among the states it stays in the covariance. The
   height of the sea is known far better than 500 m, and may be held exactly.

## What is wrong in the paper

1. The height of equation 2, H = √((1 − f)² (x² + y²) + z²) − R, vanishes on the ellipsoid only if R is the polar
   radius. With the equatorial one it is 21 385 m off, and the fix 22 km. Here the height is the exact geodetic one.
2. The velocity (20, 20, 0) m/s in the Earth's frame climbs by 3.4 m/s: the ship is 339 m high after 100 s. The table
   of heights, but for its last row, has a ship that stays on the surface; elsewhere it climbs as printed, and its
   true height is what is measured.
3. White heights with 500 m are no model of an assumed height.
4. Satellites in low orbits fly 7.4 km/s; with satellites that stay the bound is within about 10 % of the true one up
   to 50 s, and at 200 s too small by 20 to 75 %, by heading.
5. The covariance of the two-point start lacks the term between place and velocity, and the second fix is used twice.
   Both are harmless.
6. The IEKF is described as using "the filtered value and covariance repeatedly". Taken literally that uses one
   measurement several times over; the iteration must begin from the same prediction each time.
7. Step 6 of the MVEKF writes K for two different gains; the first moves the state only.
8. If 50 ns is the noise of a difference of three arrivals, the two differences are correlated by one half."""


# Errors of the four filters against time.

# Wide lines below narrow ones: filters that agree are all seen.
_STYLE = {
    "ekf": ("#D55E00", "-", 5.0),
    "mvekf": ("#E69F00", "-", 3.2),
    "mgekf": ("#009E73", "-", 1.8),
    "iekf": ("#0072B2", "--", 1.2),
    "quartic + ekf": ("#CC79A7", ":", 1.8),
}


def filters(panels: Mapping[str, tuple[Mapping[str, Run], Array]]) -> Figure:
    """Return root mean square errors and the posterior bound against steps, one panel for each start.

    Parameters
    ----------
    panels : mapping of str to (mapping of str to Run, array (steps,))
        Filters and bound by title.
    """
    figure = canvas(0.6 + 6.0 * len(panels), 4.8)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (title, (runs, bound)) in zip(axes, panels.items(), strict=True):
        for name, (colour, dash, width) in _STYLE.items():
            if name in runs:
                run = runs[name]
                steps = np.arange(len(bound) - len(run.rms) + 1, len(bound) + 1)
                ax.plot(steps, run.rms, dash, color=colour, lw=width, label=NAMES[name])
        ax.plot(np.arange(1, len(bound) + 1), bound, color="#000000", lw=0.9, label="posterior bound")
        ax.set_title(title)
        _scaled(ax)
    kept = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(kept.values(), kept.keys(), loc="outside lower center", ncols=len(kept), frameon=False)
    return figure


def heights_figure(found: Mapping[str, Run]) -> Figure:
    """Return errors, and what the filter claims of them (dotted), against steps, by what is known of the height."""
    figure = canvas(8.0, 5.2)
    ax = figure.subplots()
    # A wide line below a narrow one: two estimates that agree are both seen.
    styles = (
        ("#0072B2", 1.8),
        ("#009E73", 1.8),
        ("#56B4E9", 1.8),
        ("#D55E00", 4.0),
        ("#CC79A7", 1.6),
        ("#000000", 1.8),
    )
    for (colour, width), (name, run) in zip(styles, found.items(), strict=False):
        steps = np.arange(1, run.error.shape[1] + 1)
        ax.plot(steps, run.rms, color=colour, lw=width, label=name)
        ax.plot(steps, run.claimed.mean(0), ":", color=colour, lw=1.4)
    _scaled(ax)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def _two_or_five(value: float, place: float) -> str:
    """Return the label of a minor tick of a logarithmic axis: 2 and 5 in every decade."""
    return f"{value:g}" if f"{value:.0e}"[0] in "25" else ""


def _scaled(ax: Axes) -> None:
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(_two_or_five)
    ax.set_xlabel("step, one a second")
    ax.set_ylabel("position error, m (root mean square)")
    ax.grid(visible=True, which="both", alpha=0.25)


_FAR = (0.0, 5.0, 10.0, 20.0, 25.0)
_HEADINGS = {"north": 0.0, "north-east": 0.25 * np.pi, "east": 0.5 * np.pi, "south-east": 0.75 * np.pi}
_PANEL = 100e3


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

    Parameters
    ----------
    trials : int
        Trials of each case.
    others : int
        Trials of each kind of height, and of each heading of moving satellites.
    widths : tuple of float
        Start errors, metres; 100 km, which a figure shows, among them.
    steps, far : int
        Steps of the filters, and of those from far starts; more than ten.
    """

    trials: int
    others: int
    widths: tuple[float, ...] = (1e3, 10e3, 30e3, 100e3, 200e3, 400e3)
    steps: int = 200
    far: int = 100


_SIZES: dict[Size, Sample] = {"quick": Sample(200, 100), "full": Sample(2000, 1000)}


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    def sequence(key: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(seed, spawn_key=(key,))

    begun = fixed(sample.steps, sample.trials, sequence(0))
    tick()
    starts = {}
    for width in sample.widths:
        # The same data for every width: only the start differs.
        starts[width] = wild(width, sample.far, sample.trials, sequence(1))
        tick()
    known = heights(sample.steps, sample.others, sequence(2))
    tick()
    known["climbing target, height said to be 0"] = climbing(sample.steps, sample.others, sequence(3))
    tick()
    flying = {}
    for name, heading in _HEADINGS.items():
        flying[name] = moving(orbits(sample.steps + 2, heading), sample.others, sequence(4))
        tick()
    panels = {"from the first two fixes": begun, "start wrong by 100 km": starts[_PANEL]}
    return Report(
        TITLE,
        f"seed {seed}, {sample.trials} trials, {sample.others} in the tables of heights and of moving satellites",
        OPENING,
        CLOSING,
        (
            fixed_table(*begun),
            starts_table(starts),
            pairs(starts),
            heights_table(known),
            moving_table(flying, begun[1]),
            _one_shot(),
        ),
        (
            Picture("filters", "The four filters", filters(panels)),
            Picture(
                "heights",
                "What the height is worth: errors, and what the filter claims (dotted)",
                heights_figure(known),
            ),
        ),
    )


def _one_shot() -> Table:
    """Return the bounds of a single fix."""
    cases = {
        "50 ns each, height 500 m": problem(1, order=0),
        "50 ns each, height known": problem(1, order=0, height=None),
        "50 ns correlated, height 500 m": problem(1, order=0, correlated=True),
        "50 ns correlated, height known": problem(1, order=0, height=None, correlated=True),
        "50 ns each, height 10 m": problem(1, order=0, height=HEIGHT / 50.0),
    }
    bounds = {name: float(root_trace(crlb(case, START))) for name, case in cases.items()}
    return one_shot(bounds, dict(zip(_FAR, far([np.radians(angle) for angle in _FAR]).tolist(), strict=True)))


STUDY = Study(_SIZES, lambda sample: len(sample.widths) + len(_HEADINGS) + 3, _run)
"""The reproduction of the paper."""

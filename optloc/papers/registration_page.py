"""Everything that section 4 shows, in a quick and in a full size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.types import Array
from optloc.bounds.crlb import crlb
from optloc.papers.registration import (
    MOVING,
    NANOSECOND,
    PRINTED,
    SPATIAL,
    History,
    Scenario,
    Score,
    Setting,
    Shape,
    ghost,
    one_shot,
    problem,
    rms,
    run_history,
    score,
    truth,
    wander,
)
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick, canvas
from optloc.solvers import solve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The numbers that the paper prints in section 4.

SIGMA0 = (1855.0, 2758.0, 160.0)
"""Coordinates of the one-shot bound, metres."""

ACCURACY_FIXED = {
    150: (99.60, 89.38, 92.10, 86.65),
    200: (99.72, 95.44, 96.97, 94.80),
    300: (99.97, 98.42, 99.36, 99.02),
    400: (99.99, 99.29, 99.98, 99.86),
}
"""Table 2: accuracy of the four biases at given seconds, per cent."""

INITIAL = {1: (39.3, 0.0), 5: (37.1, 0.0), 10: (36.7, 0.0), 15: (37.8, 0.0), 20: (38.0, 2.5)}
"""Table 3: root mean square error in metres and divergence in per cent, for starts n sigma0 wide."""

NOISE = {20: (39.3, 36.7, 0.0), 30: (74.6, 73.3, 1.0), 40: (120.6, 110.0, 8.5), 50: (153.6, 146.7, 15.0)}
"""Table 4: error and bound in metres and divergence in per cent, for a noise labelled in nanoseconds."""

BOUND = 36.7
"""The bound of table 3, metres."""

ACCURACY_MOVING = {
    300: (92.78, 87.11, 0.00, 0.00),
    400: (94.32, 95.73, 0.00, 0.00),
    550: (99.14, 99.34, 87.71, 79.19),
    700: (99.92, 99.68, 95.69, 93.08),
}
"""Table 5: the same as table 2 for the moving target."""

ACCURACY_JOINT = {
    150: (99.50, 97.39, 98.17, 96.89, 99.88, 99.97, 99.97, 99.93),
    200: (99.81, 99.68, 99.98, 99.96, 99.96, 99.97, 99.97, 99.94),
    300: (99.98, 98.04, 98.13, 96.91, 99.98, 99.96, 99.96, 99.96),
    400: (99.94, 99.51, 99.23, 98.69, 99.99, 99.99, 99.98, 99.98),
}
"""Table 6: the same with gain ratios, four delays and four gains."""

FIXED = {"5 m": 75.0, "1 m": 39.0}
PRINTED_MOVING = {"1 m": 633.0}
JOINT = {"5 m": 71.0, "1 m": 36.0}
"""Root mean square errors at 600 s that the text of section 4 names, metres, by station error."""


# The tables of the paper: printed value, reproduced value, bound, and trials that each route lost.

_CHANNELS = ("r21", "r31", "r41", "r51", "g21", "g31", "g41", "g51")


@dataclass(frozen=True, slots=True)
class Case:
    """One column of table 3 or 4.

    Parameters
    ----------
    label : float
        Width of the start in sigma0, or the printed noise in nanoseconds.
    epochs : int
        Epochs used.
    sigma : float
        Noise of an arrival, metres.
    bound : float
        Cramer-Rao bound of the position, metres.
    plain, found : Score
        The paper's recursion, and the fix without a guess on the same data.
    image : float
        Share of the recursions that ended at the image of the target in the plane of the stations.
    """

    label: float
    epochs: int
    sigma: float
    bound: float
    plain: Score
    found: Score
    image: float


def metres(value: float) -> str:
    """Return a number with four significant digits and no exponent, a dash where it is not finite."""
    if value == 0.0 or not np.isfinite(value):
        return "0" if value == 0.0 else "–"
    return f"{value:.{max(0, 3 - int(np.floor(np.log10(max(abs(value), 0.1)))))}f}"


def percent(share: float) -> str:
    """Return a share as per cent."""
    return f"{100.0 * share:.1f} %"


def accuracy(error: Array, bias: Array) -> Array:
    """Return 100 (1 - |error| / |bias|), zero where the error is the larger."""
    return np.asarray(np.maximum(0.0, 100.0 * (1.0 - np.abs(error) / np.abs(bias))))


def biases(
    name: str, title: str, history: History, exact: Array, rows: Mapping[int, Sequence[float]], note: str = ""
) -> Table:
    """Return a table of bias accuracies at the seconds that the paper prints (its tables 2, 5 and 6).

    Parameters
    ----------
    name, title, note : str
        Of the table.
    history : History
        Scores, at those epochs among others.
    exact : array (n,)
        True parameter vector.
    rows : mapping of int to sequence of float
        Printed accuracies of the channels, by second.
    """
    header = (
        "second", "bias", "printed",
        "recursion, mean of all", "optloc, mean of all", "optloc, one run", "bound, one run",
    )  # fmt: skip
    lines = []
    for second, values in rows.items():
        at = history.epochs.index(second)
        n = len(exact) - len(values)
        spread = np.sqrt(np.diagonal(history.bounds[at]))[n:]
        columns = [
            _mean(None if history.plain is None else history.plain[at], n, exact),
            _mean(history.found[at], n, exact),
        ]
        columns += [_single(history.found[at], n, exact), accuracy(spread, exact[n:])]
        for i, value in enumerate(values):
            shown = ["–" if i >= len(column) else f"{column[i]:.2f}" for column in columns]
            lines.append((str(second), _CHANNELS[i], f"{value:.2f}", *shown))
    return Table(name, title, header, tuple(lines), note)


def _mean(score: Score | None, n: int, exact: Array) -> Array:
    """Return the accuracy of the mean over all trials that are not lost; empty where there are none."""
    if score is None or score.lost.all():
        return np.zeros(0)
    error = score.error[~score.lost, n:].mean(0)
    return accuracy(error, exact[n : n + len(error)])


def _single(score: Score, n: int, exact: Array) -> Array:
    """Return the accuracy of the root mean square error of one run."""
    error = score.error[~score.lost, n:]
    return accuracy(np.sqrt((error**2).mean(0)), exact[n:]) if len(error) else np.zeros(0)


def errors(
    name: str, title: str, histories: Mapping[str, History], figures: Mapping[str, float], note: str = ""
) -> Table:
    """Return root mean square errors, bounds and lost trials against time: the numbers behind a figure.

    Parameters
    ----------
    name, title, note : str
        Of the table.
    histories : mapping of str to History
        By environment.
    figures : mapping of str to float
        Error at 600 s that the paper's text names, by environment.
    """
    header = (
        "environment", "second", "printed", "recursion", "optloc", "bound",
        "recursion lost", "optloc lost", "lost and ok", "ambiguous",
    )  # fmt: skip
    lines = []
    for label, history in histories.items():
        for at, second in enumerate(history.epochs):
            plain = None if history.plain is None else history.plain[at]
            found = history.found[at]
            lines.append(
                (
                    label,
                    str(second),
                    f"{figures[label]:.0f}" if second == 600 and label in figures else "",
                    "–" if plain is None else metres(plain.rmse),
                    metres(found.rmse),
                    metres(rms(history.bounds[at])),
                    "–" if plain is None else percent(plain.share),
                    percent(found.share),
                    percent(history.silent[at]),
                    percent(history.ambiguous[at]),
                )
            )
    return Table(name, title, header, tuple(lines), note)


def starts_table(cases: Sequence[Case]) -> Table:
    """Return table 3: the width of the initial error."""
    header = (
        "n", "printed error", "printed bound", "printed divergence",
        "recursion", "optloc", "bound", "recursion lost", "ended at the image", "optloc lost",
    )  # fmt: skip
    lines = []
    for case in cases:
        error, divergence = INITIAL[int(case.label)]
        lines.append((f"{case.label:.0f}", f"{error:.1f}", f"{BOUND:.1f}", f"{divergence:.1f} %", *_compared(case)))
    note = (
        f"Metres after {cases[0].epochs} epochs; the start is Gaussian, n times sigma0 wide. optloc takes no start, so "
        "its column repeats one number. The printed bound of 36.7 m is not reproduced by any reading of the noise."
    )
    return Table("table-3", "Table 3: initial error", header, tuple(lines), note)


def noises(cases: Sequence[Case], sure: Sequence[Score], later: Sequence[float]) -> Table:
    """Return table 4: the noise.

    Parameters
    ----------
    cases : sequence of Case
        One for each noise.
    sure : sequence of Score
        The recursion on the same data, started at the truth itself.
    later : sequence of float
        Bounds after 700 epochs, metres.
    """
    header = (
        "printed noise", "read as", "printed error", "printed bound", "printed divergence",
        "recursion", "optloc", "bound", "recursion lost", "ended at the image", "optloc lost",
        "recursion from the truth lost", "bound at 700 s",
    )  # fmt: skip
    lines = []
    for case, certain, bound in zip(cases, sure, later, strict=True):
        error, crlb, divergence = NOISE[int(case.label)]
        read = f"{case.sigma / NANOSECOND:.0f} ns"
        line = (f"{case.label:.0f} ns", read, f"{error:.1f}", f"{crlb:.1f}", f"{divergence:.1f} %")
        lines.append((*line, *_compared(case), percent(certain.share), metres(bound)))
    note = (
        f"Metres after {cases[0].epochs} epochs, starts one sigma0 of the case wide. The printed errors are those of "
        "600 s, not of 700 s as the text says, and of 10 to 40 ns, not 20 to 50. The printed bounds are exactly "
        "1 : 2 : 3 : 4, so they leave the station errors out; they are reproduced at neither time."
    )
    return Table("table-4", "Table 4: measurement noise", header, tuple(lines), note)


def _compared(case: Case) -> tuple[str, ...]:
    lengths = (case.plain.rmse, case.found.rmse, case.bound)
    shares = (case.plain.share, case.image, case.found.share)
    return (*(metres(v) for v in lengths), *(percent(v) for v in shares))


# What the page says around its tables: how the paper was read, and what is wrong in it.

TITLE = "Registration of moving stations by TDOA and GROA"

OPENING = """\
Five moving stations measure the range differences of one emitter once a second; every channel has an unknown constant
bias, and the reported station positions are wrong by a metre or five, anew at each epoch. The paper (*Error
registration of multiple moving observers by TDOA and GROA*, Journal of Electronics & Information Technology 39, 2017)
estimates target and biases by least squares. Its section 4 is made again here in two ways, on the same data:

- **recursion** is the algorithm as printed: from a Gaussian start near the truth, two undamped steps over all past data
  at each epoch from the fortieth on. The start is one sigma0 wide where nothing else is said.
- **optloc** is `optloc.solve` on the epochs so far. It takes no start and knows nothing of the truth.

*Lost* is an estimate that is not finite, or further from the truth than ten bounds; errors are those of the trials that
are not lost. *Ambiguous* is a fix of optloc that says so and lists the other place; *lost and ok* is one that is lost
and does not say so. The *bound* is that of Cramér and Rao with the biases unknown.

## How the paper was read

- **Noise.** The covariance of the four differences of an epoch is R = σ² (I + 11'), σ = 3 m, which is 10 ns at
  c = 3·10⁸ m/s, though the text says 20 ns. Only this reading gives the printed sigma0 = (1855, 2758, 160) m: the table
  *readings* compares the others. Gain ratios are read the same way, with 0.03.
- **Station errors** of 1 m or 5 m in each coordinate, drawn anew at each epoch, are part of the weight: R grows by
  G Qs G'. For range differences that is another σs² (I + 11') wherever the target is.
- **Epochs.** The result at 600 s uses 600 epochs, the first at t = 0. Position errors of the moving target are those of
  its place at t = 0: only so does the printed 633 m fit.
- **Accuracy** of a bias is not defined. It is read as 100 (1 − |mean error over all trials| / |bias|), zero where the
  error is the larger. One run is far less accurate than this mean, so two columns give one run: root mean square error
  in the place of the mean, and the bound."""

CLOSING = """\
## What is wrong in the paper

1. Equation 23, the bound for unknown biases, is printed as X − Y Q Y'. With the stacked Q that allows a new bias at
   every epoch, and nothing is left of the information. It has to be X − Y (Σ R⁻¹)⁻¹ Y'. Equation 24 has lost a sign.
2. Equation 15 stacks the target once for each epoch; it is one unknown. The corner of size 3 + 3M is that of one epoch.
3. sigma0 is said to follow from equation 23. It is equation 25, with known biases, for the single epoch t = 0.
4. Stations 4 and 5 of table 1 meet at t = 50 s: their distance is exactly zero.
5. All five stations lie in one plane at every epoch, so five are not enough for the closed form that the paper counts
   on: one epoch says nothing about the side of the plane on which the target is.
6. For that reason the fixed target has a second minimum, the image in the plane (table *minima*). It costs little
   in short records, and it is what catches the recursion when the noise is large: not the worse initial guess that
   the paper blames, for as many trials are lost when the recursion is started at the truth itself (table 4).
7. The image of a uniformly moving target moves uniformly as well, and explains all data exactly. The paper does not say
   so; its recursion stays on the side on which it was started. optloc lists both places and calls the fix ambiguous; a
   height or a speed has to decide. The scores are those of the listed place nearer to the truth.
8. The recursion cannot start the moving target at 40 s: the bound of the position is 618 km by then, and every trial
   runs away. It is started at 200 s here.
9. Table 4 is said to hold at 700 s. Its errors are those of 600 s, where the bound is 40.3 m; at 700 s it is 29.8 m.
   The labels 20 to 50 ns stand for 10 to 40 ns.
10. The bounds of tables 3 and 4, 36.7 to 146.7 m, are in the ratio 1 : 2 : 3 : 4: without station errors. They are not
    reproduced at 600 or at 700 s, with or without them.
11. The text on table 5 refers to table 3. The zeros of table 5 are errors larger than the bias.
12. The gain ratios, with 0.03, change the bound by less than one part in 100 000: the better error of figure 3 (71 and
    36 m against 75 and 39 m) is the scatter of 200 trials. They help from about 3·10⁻⁴ on (table *gains*). The
    recursion is not run with them.

The error of 200 trials scatters by about five per cent. Divergence of 2.5 % is 5 trials of 200: the 95 % interval is
0.8 to 5.7 %."""


# Figures 1 to 3 of the paper: position error and bound against time.

_BLACK, _BLUE, _ORANGE, _GREEN = "#000000", "#0072B2", "#D55E00", "#009E73"
_CURVE = 40


def against_time(
    histories: Sequence[History], titles: Sequence[str], printed: Sequence[float | None], zoom: int | None = None
) -> Figure:
    """Return root mean square position errors and the bound against time, one panel for each history.

    Parameters
    ----------
    histories : sequence of History
        What is drawn.
    titles : sequence of str
        One for each panel.
    printed : sequence of float or None
        Error at 600 s that the paper names, metres.
    zoom : int, optional
        One more panel with the last history from this second on.
    """
    panels = list(zip(histories, titles, printed, strict=True))
    if zoom is not None:
        panels.append((histories[-1], f"the same from {zoom} s on", printed[-1]))
    figure = canvas(0.4 + 5.0 * len(panels), 4.6)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for i, (ax, (history, title, value)) in enumerate(zip(axes, panels, strict=True)):
        _panel(ax, history, value, zoom if zoom is not None and i == len(panels) - 1 else None)
        ax.set_title(title)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def _two_or_five(value: float, place: float) -> str:
    """Return the label of a minor tick of a logarithmic axis: 20, 50, 200, 500 and no other."""
    return f"{value:.0f}" if f"{value:.0e}"[0] in "25" else ""


def _panel(ax: Axes, history: History, printed: float | None, since: int | None) -> None:
    step = history.setting.scenario.interval
    keep = [i for i, k in enumerate(history.epochs) if since is None or k * step >= since]
    epochs = [history.epochs[i] for i in keep]
    curve = np.unique(np.linspace(epochs[0], epochs[-1], _CURVE).astype(int))
    ax.plot(
        step * curve, [rms(bound) for bound in history.setting.bounds(curve)], color=_BLACK, label="Cramér-Rao bound"
    )
    times = step * np.array(epochs)
    if history.plain is not None:
        plain = [history.plain[i].rmse for i in keep]
        ax.plot(times, plain, "o", color=_ORANGE, mfc="none", ms=9, label="recursion of the paper")
    ax.plot(times, [history.found[i].rmse for i in keep], "x", color=_BLUE, ms=7, mew=2, label="optloc, no guess")
    if printed is not None:
        ax.plot([600.0], [printed], "D", color=_GREEN, ms=6, label="printed at 600 s")
    if since is None:
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:.0f}")
        ax.yaxis.set_minor_formatter(_two_or_five)
    ax.set_xlabel("time, s")
    ax.set_ylabel("position error, m (root mean square)")
    ax.grid(visible=True, which="both", alpha=0.25)


# Tables that the paper lacks: how to read its noise, its second minimum, and a scene that is not degenerate.


def readings() -> Table:
    """Return the bounds of the fixed target under each reading of the noise, metres."""
    shapes: dict[Shape, str] = {"full": "I + 11'", "half": "(I + 11') / 2", "diag": "I"}
    header = ("covariance", "σ", "600 s, no station error", "600 s, 1 m", "600 s, 5 m", "700 s, 1 m", "sigma0, 1 m")
    lines: list[tuple[str, ...]] = [("printed", "", "", "39", "75", "36.7", ", ".join(f"{v:.0f}" for v in SIGMA0))]
    for (shape, name), delay in product(shapes.items(), (10, 20)):
        sigma = delay * NANOSECOND
        bounds = [
            _bound(epochs, sigma, errors, shape) for epochs, errors in ((600, 0.0), (600, 1.0), (600, 5.0), (700, 1.0))
        ]
        shot = ", ".join(f"{v:.1f}" for v in one_shot(sigma=sigma, shape=shape))
        lines.append((name, f"{delay} ns", *(f"{v:.2f}" for v in bounds), shot))
    note = (
        "Bounds of the position in metres. The printed 39 and 75 m are errors of the simulation; 36.7 m is the printed "
        "bound, which no reading gives at either time."
    )
    return Table("readings", "Which noise the paper used", header, tuple(lines), note)


def _bound(epochs: int, sigma: float, station_sigma: float, shape: Shape) -> float:
    made = problem(PRINTED, epochs, sigma=sigma, station_sigma=station_sigma, shape=shape)
    return rms(crlb(made, truth(PRINTED, made)))


def minima() -> Table:
    """Return the second minimum of the printed scene with a fixed target."""
    header = (
        "seconds", "image, km", "offset of its biases 4 and 5, m", "cost gap",
        "taken for the truth, 10 ns", "taken for the truth, 40 ns",
    )  # fmt: skip
    lines = []
    for epochs in (40, 100, 200, 300, 600, 700):
        found, noisy = ghost(PRINTED, epochs), ghost(PRINTED, epochs, sigma=40.0 * NANOSECOND)
        if found is None or noisy is None:
            continue
        offset = np.abs(found.x[5:7] - PRINTED.delays[2:]).mean()
        place = " ".join(f"{v:.1f}" for v in 1e-3 * found.x[:3])
        lines.append(
            (str(epochs), place, f"{offset:.0f}", metres(found.gap), _chance(found.doubt), _chance(noisy.doubt))
        )
    note = (
        "Noise-free data, 1 m station error, 10 ns. The gap is the cost of the image, a weighted sum of squares; half "
        "its root is how many standard deviations of noise turn the choice. The image needs biases of hundreds of "
        "metres: a prior of 200 m removes it."
    )
    return Table("minima", "The image in the plane of the stations", header, tuple(lines), note)


def _chance(share: float) -> str:
    return f"{share:.2g}" if share >= 1e-9 else "< 1e-9"


def gains() -> Table:
    """Return what gain ratios of growing accuracy add to the bound of the fixed target."""
    lines = []
    for sigma in (None, 0.03, 3e-3, 3e-4, 3e-5):
        made = problem(PRINTED, 600, gain_sigma=sigma)
        bound = rms(crlb(made, truth(PRINTED, made)))
        lines.append(("none" if sigma is None else f"{sigma:g}", f"{bound:.4f}"))
    note = (
        "Bound of the position after 600 epochs with 1 m station error. The paper has 0.03 and reports a gain of 3 m."
    )
    return Table("gains", "What gain ratios add", ("standard deviation of a ratio", "bound, m"), tuple(lines), note)


def scenes(cases: Mapping[str, Case]) -> Table:
    """Return what the printed stations and those that span space make of the same target."""
    header = (
        "stations", "out of plane, m", "closest pair, m", "bound, m", "recursion, m", "optloc, m",
        "recursion lost", "optloc lost", "cost gap of the image",
    )  # fmt: skip
    lines = []
    for (name, case), scenario in zip(cases.items(), (PRINTED, SPATIAL), strict=True):
        flat, close = flatness(scenario, 700), separation(scenario, 700)
        image = ghost(scenario, 600)
        lengths = (metres(v) for v in (flat, close, case.bound, case.plain.rmse, case.found.rmse))
        lost = (percent(case.plain.share), percent(case.found.share))
        lines.append((name, *lengths, *lost, "no image" if image is None else metres(image.gap)))
    epochs = next(iter(cases.values())).epochs
    note = f"The spatial stations are those of `optloc demo registration`. {epochs} epochs; starts 20 sigma0 wide."
    return Table("scenes", "Stations that span space", header, tuple(lines), note)


def flatness(scenario: Scenario, epochs: int) -> float:
    """Return the least root mean square distance of the stations from their best plane over a run, metres."""
    track = scenario.track(epochs)
    values = np.linalg.svd(track - track.mean(1, keepdims=True), compute_uv=False)
    return float(values[:, -1].min() / np.sqrt(track.shape[1]))


def separation(scenario: Scenario, epochs: int) -> float:
    """Return the least distance of two stations over a run, metres."""
    track: Array = scenario.track(epochs)
    first, second = np.triu_indices(track.shape[1], 1)
    return float(np.linalg.norm(track[:, first] - track[:, second], axis=-1).min())


_GAIN = 0.03
_MOVING_FIRST = 200
_WIDEST = 20.0
_NEAR = 5e3


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

    Parameters
    ----------
    trials : int
        Trials of figures 1 to 3 and tables 2, 5 and 6.
    many : int
        Trials of tables 3 and 4, which count failures.
    fixed, moving : tuple of int
        Epochs at which the fixed and the moving target are looked at; those of the printed tables among them.
    last : int
        Epochs of tables 3 and 4.
    """

    trials: int
    many: int
    fixed: tuple[int, ...]
    moving: tuple[int, ...]
    last: int = 600


_SIZES: dict[Size, Sample] = {
    "quick": Sample(30, 60, (150, 200, 300, 400, 600), (300, 400, 550, 600, 700)),
    "full": Sample(200, 500, tuple(range(150, 701, 50)), tuple(range(250, 801, 50))),
}


def _work(sample: Sample) -> int:
    histories = 4 * len(sample.fixed) + len(sample.moving) + 3
    return histories + len(INITIAL) + 2 * len(NOISE) + 1


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    fixed = {
        name: run_history(Setting(PRINTED, sample.trials, seed, key, station_sigma=size), sample.fixed, tick)
        for key, (name, size) in enumerate((("5 m", 5.0), ("1 m", 1.0)))
    }
    moving = run_history(Setting(MOVING, sample.trials, seed, 2), sample.moving, tick, first=_MOVING_FIRST)
    joint = {
        name: run_history(
            Setting(PRINTED, sample.trials, seed, key, None, size, _GAIN), sample.fixed, tick, plain=False
        )
        for key, (name, size) in enumerate((("5 m", 5.0), ("1 m", 1.0)), 3)
    }
    starts = _starts(Setting(PRINTED, sample.many, seed, 5), sample.last, tick)
    noisy = [Setting(PRINTED, sample.many, seed, 6 + i, (ns - 10) * NANOSECOND) for i, ns in enumerate(NOISE)]
    spatial = _case(Setting(SPATIAL, sample.many, seed, 10), sample.last, _WIDEST, tick)
    pictures, tabled = _figures(fixed, moving, joint)
    return Report(
        TITLE,
        f"seed {seed}, {sample.trials} trials, {sample.many} in tables 3 and 4 and for the spatial stations",
        OPENING,
        CLOSING,
        (
            *_accuracies(fixed["1 m"], moving, joint["1 m"]),
            starts_table(starts),
            _noises(noisy, sample.last, tick),
            *tabled,
            scenes({"printed": starts[-1], "spatial": spatial}),
            minima(),
            gains(),
            readings(),
        ),
        pictures,
    )


def _case(setting: Setting, epochs: int, width: float, tick: Tick, label: float = 0.0) -> Case:
    """Return both routes on the same draw."""
    drawn, bound = setting.draw(epochs), setting.bound(epochs)
    (plain,) = wander(setting, drawn, (epochs,), (bound,), width=width)
    found = score(solve(drawn).x, truth(setting.scenario, drawn), bound)
    tick()
    sigma, image = setting.sigma or setting.scenario.sigma, _at_image(setting, epochs, plain)
    return Case(label or width, epochs, sigma, rms(bound), plain, found, image)


def _at_image(setting: Setting, epochs: int, plain: Score) -> float:
    """Return the share of trials that ended at the second minimum of the scene."""
    image = ghost(setting.scenario, epochs, sigma=setting.sigma)
    if image is None:
        return 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.linalg.norm(plain.error[:, :3] - (image.x[:3] - setting.scenario.target), axis=-1)
    return float((plain.lost & (apart < _NEAR)).mean())


def _starts(setting: Setting, epochs: int, tick: Tick) -> list[Case]:
    """Return table 3: one draw, and the recursion from starts of growing width."""
    drawn, bound = setting.draw(epochs), setting.bound(epochs)
    found = score(solve(drawn).x, truth(setting.scenario, drawn), bound)
    cases = []
    for width in INITIAL:
        (plain,) = wander(setting, drawn, (epochs,), (bound,), width=float(width))
        image = _at_image(setting, epochs, plain)
        cases.append(Case(float(width), epochs, setting.scenario.sigma, rms(bound), plain, found, image))
        tick()
    return cases


def _noises(settings: Sequence[Setting], epochs: int, tick: Tick) -> Table:
    """Return table 4, whose labels are 10 ns too large; the recursion is started at the truth itself as well."""
    cases: list[Case] = []
    sure: list[Score] = []
    for setting, label in zip(settings, NOISE, strict=True):
        cases.append(_case(setting, epochs, 1.0, tick, label))
        sure += wander(setting, setting.draw(epochs), (epochs,), (setting.bound(epochs),), width=0.0)
        tick()
    return noises(cases, sure, [rms(setting.bound(700)) for setting in settings])


def _accuracies(fixed: History, moving: History, joint: History) -> tuple[Table, ...]:
    """Return tables 2, 5 and 6."""
    exact = [truth(c.setting.scenario, c.setting.problem(1)) for c in (fixed, moving, joint)]
    return (
        biases("table-2", "Table 2: biases, fixed target", fixed, exact[0], ACCURACY_FIXED),
        biases("table-5", "Table 5: biases, moving target", moving, exact[1], ACCURACY_MOVING),
        biases("table-6", "Table 6: biases with gain ratios", joint, exact[2], ACCURACY_JOINT),
    )


def _figures(
    fixed: Mapping[str, History], moving: History, joint: Mapping[str, History]
) -> tuple[tuple[Picture, ...], tuple[Table, ...]]:
    """Return figures 1 to 3 and the numbers behind them."""
    parts = (
        ("figure-1", "Figure 1: fixed target", dict(fixed), FIXED, None),
        ("figure-2", "Figure 2: moving target", {"1 m": moving}, PRINTED_MOVING, 450),
        ("figure-3", "Figure 3: fixed target, with gain ratios", dict(joint), JOINT, None),
    )
    pictures, tabled = [], []
    for name, title, histories, values, zoom in parts:
        labels = [f"station error {label}" for label in histories]
        figure = against_time(list(histories.values()), labels, [values[label] for label in histories], zoom)
        pictures.append(Picture(name, title, figure))
        tabled.append(errors(name, f"{title}, in numbers", histories, values))
    return tuple(pictures), tuple(tabled)


STUDY = Study(_SIZES, _work, _run)
"""The reproduction of the paper."""

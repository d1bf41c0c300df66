"""Tables and figures of the paper on TDOA and GROA registration: printed value, reproduced value, bound, lost trials.

The recursion of the paper (`plain`) and the fixes of optloc (`found`) use the same data. A lost trial is far from the
truth, see `optloc.lab.papers.registration.FAR`. The image is the mirror image of the target in the plane of the
stations, a second minimum of the cost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from optloc.bounds import crlb
from optloc.lab.papers.registration import (
    MOVING,
    NANOSECOND,
    PRINTED,
    SPATIAL,
    RegistrationScenario,
    RegistrationScore,
    RegistrationSetting,
    Shape,
    branch,
    ghost,
    one_shot,
    problem,
    rms,
    score,
    truth,
    wander,
)
from optloc.lab.papers.registration_recursion import FIRST
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
from optloc.problem import Array, Status
from optloc.show import ABSENT, TextTable
from optloc.solvers import solve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Values printed in section 4 of the paper.

SIGMA0 = (1855.0, 2758.0, 160.0)
"""Coordinates of sigma0, the single-epoch bound with known biases, metres."""

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
"""Table 4: error and bound in metres and divergence in per cent, by the printed noise in nanoseconds."""

BOUND = 36.7
"""The bound of table 3, metres."""

ACCURACY_MOVING = {
    300: (92.78, 87.11, 0.00, 0.00),
    400: (94.32, 95.73, 0.00, 0.00),
    550: (99.14, 99.34, 87.71, 79.19),
    700: (99.92, 99.68, 95.69, 93.08),
}
"""Table 5: accuracies as in table 2, for the moving target."""

ACCURACY_JOINT = {
    150: (99.50, 97.39, 98.17, 96.89, 99.88, 99.97, 99.97, 99.93),
    200: (99.81, 99.68, 99.98, 99.96, 99.96, 99.97, 99.97, 99.94),
    300: (99.98, 98.04, 98.13, 96.91, 99.98, 99.96, 99.96, 99.96),
    400: (99.94, 99.51, 99.23, 98.69, 99.99, 99.99, 99.98, 99.98),
}
"""Table 6: accuracies as in table 2, with gain ratios: four delays and four gains."""

# Figures 1 to 3.
FIXED = {"5 m": 75.0, "1 m": 39.0}
PRINTED_MOVING = {"1 m": 633.0}
JOINT = {"5 m": 71.0, "1 m": 36.0}
"""Root mean square errors at 600 s in the text of section 4, metres, by station error: figures 1 to 3."""


# Recursion and fixes after growing numbers of epochs.


# Without a proof, which takes a second a run: thousands of runs are only scored here.
_METHOD = "searched"


@dataclass(frozen=True, slots=True)
class History:
    """Scores after growing numbers of epochs.

    Parameters
    ----------
    setting : RegistrationSetting
        Setting of the draw.
    epochs : tuple of int
        Numbers of epochs (t).
    bounds : array (t, n, n)
        Cramer-Rao bound of the n unknowns after each number of epochs, squared SI units.
    plain : tuple of RegistrationScore
        The paper's recursion on the same data.
    found : tuple of RegistrationScore
        The fix without a guess.
    ambiguous : tuple of float
        Share of fixes with the status ambiguous: the data allow another position.
    silent : tuple of float
        Share of lost fixes that have no finding against their position.
    """

    setting: RegistrationSetting
    epochs: tuple[int, ...]
    bounds: Array
    plain: tuple[RegistrationScore, ...]
    found: tuple[RegistrationScore, ...]
    ambiguous: tuple[float, ...]
    silent: tuple[float, ...]


def run_history(setting: RegistrationSetting, epochs: Sequence[int], tick: Tick, *, first: int = FIRST) -> History:
    """Return the scores of the recursion and of the fixes on the same data.

    Parameters
    ----------
    setting : RegistrationSetting
        Setting of the draw.
    epochs : sequence of int
        Numbers of epochs.
    tick : callable
        Called after each number of epochs, and after the recursion.
    first : int
        Epochs of the first estimate of the recursion.
    """
    # One long draw: shorter runs are its first parts, so that curves against time show the same trials.
    drawn = setting.draw(max(epochs))
    bounds = setting.bounds(epochs)
    true_vector = truth(setting.scenario, drawn)
    plain = wander(setting, drawn, epochs, bounds, first=first)
    tick()
    found, ambiguous, silent = [], [], []
    for k, bound in zip(epochs, bounds, strict=True):
        fix = solve(setting.first(drawn, k), _METHOD)
        found.append(score(fix.x if setting.scenario.course is None else branch(fix, true_vector), true_vector, bound))
        ambiguous.append(float((fix.code == Status.AMBIGUOUS).mean()))
        unsuspected = fix.answered & ~fix.has(Status.AMBIGUOUS, Status.UNBOUNDED, Status.MISFIT)
        silent.append(float((found[-1].lost & unsuspected).mean()))
        tick()
    return History(setting, tuple(epochs), bounds, plain, tuple(found), tuple(ambiguous), tuple(silent))


# The tables of the paper.

_CHANNELS = ("r21", "r31", "r41", "r51", "g21", "g31", "g41", "g51")


@dataclass(frozen=True, slots=True)
class TableCase:
    """One column of table 3 or 4.

    Parameters
    ----------
    label : float
        Width of the start in sigma0, or the printed noise in nanoseconds.
    epochs : int
        Number of epochs used.
    sigma : float
        Noise of an arrival, metres.
    bound : float
        Cramer-Rao bound of the position, metres.
    plain, found : RegistrationScore
        The paper's recursion, and the fix without a guess on the same data.
    image : float
        Share of the recursions that ended at the image of the target in the plane of the stations.
    """

    label: float
    epochs: int
    sigma: float
    bound: float
    plain: RegistrationScore
    found: RegistrationScore
    image: float


def metres(value: float) -> str:
    """Return a number with four significant digits and no exponent; a dash if it is not finite."""
    if value == 0.0 or not np.isfinite(value):
        return "0" if value == 0.0 else ABSENT
    return f"{value:.{max(0, 3 - int(np.floor(np.log10(max(abs(value), 0.1)))))}f}"


def accuracy(error: Array, bias: Array) -> Array:
    """Return the accuracy 100 (1 - |error| / |bias|) in per cent; zero if the error exceeds the bias."""
    return np.asarray(np.maximum(0.0, 100.0 * (1.0 - np.abs(error) / np.abs(bias))))


def table_biases(name: str, history: History, rows: Mapping[int, Sequence[float]]) -> TextTable:
    """Return a table of bias accuracies at the printed seconds (tables 2, 5 and 6 of the paper).

    `history` contains scores at these epochs. `rows` are the printed accuracies of the channels by second; the biases
    are the last unknowns of a vector.
    """
    true_vector = truth(history.setting.scenario, history.setting.problem(1))
    lines = []
    for second, values in rows.items():
        index, first_bias = history.epochs.index(second), len(true_vector) - len(values)
        plain, found = history.plain[index], history.found[index]
        deviation = np.sqrt(np.diagonal(history.bounds[index]))[first_bias:]
        columns = (
            _mean_accuracy(plain, first_bias, true_vector),
            _mean_accuracy(found, first_bias, true_vector),
            _single_accuracy(found, first_bias, true_vector),
            accuracy(deviation, true_vector[first_bias:]),
        )
        for i, value in enumerate(values):
            shown = (ABSENT if i >= len(column) else f"{column[i]:.2f}" for column in columns)
            lines.append((str(second), _CHANNELS[i], f"{value:.2f}", *shown))
    header = (
        "second", "bias", "printed",
        "recursion, mean of all", "optloc, mean of all", "optloc, one run", "bound, one run",
    )  # fmt: skip
    return tabulate(name, header, lines)


def _mean_accuracy(score: RegistrationScore, first_bias: int, true_vector: Array) -> Array:
    """Return the accuracy of the mean error over all trials that are not lost, per cent, for each bias.

    `first_bias` is the index of the first bias in the vector. The result is empty if all trials are lost.
    """
    if score.lost.all():
        return np.zeros(0)
    error = score.error[~score.lost, first_bias:].mean(0)
    return accuracy(error, true_vector[first_bias : first_bias + len(error)])


def _single_accuracy(score: RegistrationScore, first_bias: int, true_vector: Array) -> Array:
    """Return the accuracy of the rms error of one run, per cent, for each bias; parameters as in `_mean_accuracy`."""
    error = score.error[~score.lost, first_bias:]
    return accuracy(np.sqrt((error**2).mean(0)), true_vector[first_bias:]) if len(error) else np.zeros(0)


def table_errors(name: str, histories: Mapping[str, History], printed: Mapping[str, float]) -> TextTable:
    """Return a table of root mean square errors, bounds and lost trials against time: the numbers of a figure.

    `histories` is by environment; `printed` are errors at 600 s in the paper's text, by environment.
    """
    lines = []
    for environment, history in histories.items():
        for index, second in enumerate(history.epochs):
            plain, found = history.plain[index], history.found[index]
            printed_text = f"{printed[environment]:.0f}" if second == 600 else ""
            lengths = (plain.rmse, found.rmse, rms(history.bounds[index]))
            shares = (plain.share, found.share, history.silent[index], history.ambiguous[index])
            lines.append((environment, str(second), printed_text, *map(metres, lengths), *map(percent, shares)))
    header = (
        "environment", "second", "printed", "recursion", "optloc", "bound",
        "recursion lost", "optloc lost", "lost unnoticed", "ambiguous",
    )  # fmt: skip
    return tabulate(name, header, lines)


_COMPARED = ("recursion", "optloc", "bound", "recursion lost", "ended at the image", "optloc lost")


def table_starts(cases: Sequence[TableCase]) -> TextTable:
    """Return table 3: errors, bounds and lost trials by the width of the start."""
    lines = []
    for case in cases:
        error, divergence = INITIAL[int(case.label)]
        lines.append((f"{case.label:.0f}", f"{error:.1f}", f"{BOUND:.1f}", f"{divergence:.1f} %", *_compared(case)))
    return tabulate("table-3", ("n", "printed error", "printed bound", "printed divergence", *_COMPARED), lines)


def table_noises(cases: Sequence[TableCase], sure: Sequence[RegistrationScore], later: Sequence[float]) -> TextTable:
    """Return table 4: errors, bounds and lost trials by the noise.

    Parameters
    ----------
    cases : sequence of TableCase
        One for each noise.
    sure : sequence of RegistrationScore
        The recursion on the same data, started at the truth.
    later : sequence of float
        Bounds after 700 epochs, metres.
    """
    lines = []
    for case, from_truth, bound in zip(cases, sure, later, strict=True):
        error, least, divergence = NOISE[int(case.label)]
        read_as = f"{case.sigma / NANOSECOND:.0f} ns"
        line = (f"{case.label:.0f} ns", read_as, f"{error:.1f}", f"{least:.1f}", f"{divergence:.1f} %")
        lines.append((*line, *_compared(case), percent(from_truth.share), metres(bound)))
    header = (
        "printed noise", "read as", "printed error", "printed bound", "printed divergence",
        *_COMPARED, "recursion from the truth lost", "bound at 700 s",
    )  # fmt: skip
    return tabulate("table-4", header, lines)


def _compared(case: TableCase) -> tuple[str, ...]:
    """Return the columns of a case that tables 3 and 4 share, as text."""
    lengths = (case.plain.rmse, case.found.rmse, case.bound)
    shares = (case.plain.share, case.image, case.found.share)
    return (*(metres(v) for v in lengths), *(percent(v) for v in shares))


# Figures 1 to 3 of the paper: position error and bound against time.

_CURVE = 40  # points of the bound, enough for a smooth curve


def against_time(histories: Mapping[str, History], printed: Mapping[str, float], zoom: int | None = None) -> Figure:
    """Return a figure of root mean square position errors and the bound against time, one panel for each history.

    Parameters
    ----------
    histories : mapping of str to History
        Histories by station error.
    printed : mapping of str to float
        Error at 600 s in the paper, metres.
    zoom : int, optional
        Start of one more panel of the last history, seconds.
    """
    panels = [(f"station error {name}", each, printed[name], 0) for name, each in histories.items()]
    if zoom is not None:
        panels.append((f"the same from {zoom} s on", *panels[-1][1:3], zoom))
    figure = canvas(0.4 + 5.0 * len(panels), 4.6)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (title, history, value, since) in zip(axes, panels, strict=True):
        _panel(ax, history, value, since)
        ax.set_title(title)
    explain(figure)
    return figure


def _panel(ax: Axes, history: History, printed: float, since: int) -> None:
    """Draw the errors of a history and the bound against time, from the second `since` on."""
    step = history.setting.scenario.interval
    keep = [i for i, k in enumerate(history.epochs) if k * step >= since]
    epochs = [history.epochs[i] for i in keep]
    curve = np.unique(np.linspace(epochs[0], epochs[-1], _CURVE).astype(int))
    bounds = [rms(bound) for bound in history.setting.bounds(curve)]
    ax.plot(step * curve, bounds, color=Ink.BLACK, label="Cramér-Rao bound")
    times = step * np.array(epochs)
    plain = [history.plain[i].rmse for i in keep]
    ax.plot(times, plain, "o", color=Ink.RED, mfc="none", ms=9, label="recursion of the paper")
    ax.plot(times, [history.found[i].rmse for i in keep], "x", color=Ink.BLUE, ms=7, mew=2, label="optloc, no guess")
    ax.plot([600.0], [printed], "D", color=Ink.GREEN, ms=6, label="printed at 600 s")
    if not since:
        scale(ax)
    label(ax, "time, s", "position error, m (root mean square)")


# Tables that the paper lacks: readings of its noise, its second minimum, and a scene that is not degenerate.


def table_readings() -> TextTable:
    """Return a table of the bounds of the fixed target under each reading of the noise, metres."""
    shapes: dict[Shape, str] = {"full": "I + 11'", "half": "(I + 11') / 2", "diag": "I"}
    printed = (f"{FIXED['1 m']:.0f}", f"{FIXED['5 m']:.0f}", f"{BOUND:.1f}")
    lines: list[tuple[str, ...]] = [("printed", "", "", *printed, ", ".join(f"{v:.0f}" for v in SIGMA0))]
    for (shape, name), delay in product(shapes.items(), (10, 20)):
        sigma = delay * NANOSECOND
        cases = ((600, 0.0), (600, 1.0), (600, 5.0), (700, 1.0))
        bounds = (f"{_position_bound(epochs, sigma, errors, shape):.2f}" for epochs, errors in cases)
        sigma0 = ", ".join(f"{v:.1f}" for v in one_shot(sigma=sigma, shape=shape))
        lines.append((name, f"{delay} ns", *bounds, sigma0))
    header = ("covariance", "σ", "600 s, no station error", "600 s, 1 m", "600 s, 5 m", "700 s, 1 m", "sigma0, 1 m")
    return tabulate("readings", header, lines)


def _position_bound(epochs: int, sigma: float, station_sigma: float, shape: Shape) -> float:
    """Return the bound of the position of the fixed target, metres; parameters as in `problem`."""
    without_rows = problem(PRINTED, epochs, sigma=sigma, station_sigma=station_sigma, shape=shape)
    return rms(crlb(without_rows, truth(PRINTED, without_rows)))


def table_minima() -> TextTable:
    """Return a table of the position and the cost of the second minimum of the printed scene, by seconds."""
    lines = []
    for epochs in (40, 100, 200, 300, 600, 700):
        found, noisy = ghost(PRINTED, epochs), ghost(PRINTED, epochs, sigma=40.0 * NANOSECOND)
        if found is None or noisy is None:
            continue
        offset = np.abs(found.x[5:7] - PRINTED.delays[2:]).mean()
        position = " ".join(f"{v:.1f}" for v in 1e-3 * found.x[:3])
        chances = (_chance(found.doubt), _chance(noisy.doubt))
        lines.append((str(epochs), position, f"{offset:.0f}", metres(found.gap), *chances))
    header = (
        "seconds", "image, km", "offset of its biases 4 and 5, m", "cost gap",
        "taken for the truth, 10 ns", "taken for the truth, 40 ns",
    )  # fmt: skip
    return tabulate("minima", header, lines)


def _chance(share: float) -> str:
    """Return a probability as text."""
    return f"{share:.2g}" if share >= 1e-9 else "< 1e-9"


def table_gains() -> TextTable:
    """Return a table of the bound of the fixed target for gain ratios of growing accuracy."""
    lines = []
    for sigma in (None, _GAIN, 0.1 * _GAIN, 0.01 * _GAIN, 0.001 * _GAIN):
        without_rows = problem(PRINTED, 600, gain_sigma=sigma)
        lines.append(
            ("none" if sigma is None else f"{sigma:g}", f"{rms(crlb(without_rows, truth(PRINTED, without_rows))):.4f}")
        )
    return tabulate("gains", ("standard deviation of a ratio", "bound, m"), lines)


def table_scenes(cases: Mapping[str, TableCase]) -> TextTable:
    """Return a table of the results for the same target with the printed stations and with stations that span space."""
    lines = []
    for (name, case), scenario in zip(cases.items(), (PRINTED, SPATIAL), strict=True):
        flat, close = flatness(scenario, 700), separation(scenario, 700)
        image = ghost(scenario, 600)
        lengths = (metres(v) for v in (flat, close, case.bound, case.plain.rmse, case.found.rmse))
        lost = (percent(case.plain.share), percent(case.found.share))
        lines.append((name, *lengths, *lost, "no image" if image is None else metres(image.gap)))
    header = (
        "stations", "out of plane, m", "closest pair, m", "bound, m", "recursion, m", "optloc, m",
        "recursion lost", "optloc lost", "cost gap of the image",
    )  # fmt: skip
    return tabulate("scenes", header, lines)


def flatness(scenario: RegistrationScenario, epochs: int) -> float:
    """Return the least root mean square distance of the stations from their best plane over a run, metres."""
    track = scenario.track(epochs)
    values = np.linalg.svd(track - track.mean(1, keepdims=True), compute_uv=False)
    return float(values[:, -1].min() / np.sqrt(track.shape[1]))


def separation(scenario: RegistrationScenario, epochs: int) -> float:
    """Return the least distance of two stations over a run, metres."""
    track: Array = scenario.track(epochs)
    first, second = np.triu_indices(track.shape[1], 1)
    return float(np.linalg.norm(track[:, first] - track[:, second], axis=-1).min())


# All results of section 4, in a quick and in a full size.

_GAIN = 0.03  # standard deviation of a gain ratio; printed
_MOVING_FIRST = 200  # epochs of the first estimate of the moving target: with 40, as printed, every trial diverges
_WIDEST = 20.0  # widest start of table 3, in sigma0
_NEAR = 5e3  # metres within which a trial is at the image, which is 23 km from the truth after 600 s


@dataclass(frozen=True, slots=True)
class RegistrationSample:
    """Numbers of trials.

    Parameters
    ----------
    trials : int
        Trials of figures 1 to 3 and tables 2, 5 and 6.
    many : int
        Trials of tables 3 and 4, which count failures.
    fixed, moving : tuple of int
        Epochs at which the fixed and the moving target are scored, including the epochs of the printed tables.
    last : int
        Epochs of tables 3 and 4.
    """

    trials: int
    many: int
    fixed: tuple[int, ...]
    moving: tuple[int, ...]
    last: int = 600


# Full: the 200 trials of the paper, and 500 for the counts of failures of a few per cent.
_SIZES: dict[Size, RegistrationSample] = {
    "quick": RegistrationSample(30, 60, (150, 200, 300, 400, 600), (300, 400, 550, 600, 700)),
    "full": RegistrationSample(200, 500, tuple(range(150, 701, 50)), tuple(range(250, 801, 50))),
}


def _work(sample: RegistrationSample) -> int:
    """Return the number of calls of `tick`."""
    histories = 4 * len(sample.fixed) + len(sample.moving) + 5
    return histories + len(INITIAL) + 2 * len(NOISE) + 1


def _run(sample: RegistrationSample, seed: int, tick: Tick) -> Report:
    """Return the report of all simulations with the sizes `sample`; call `tick` after each simulation."""
    fixed = {
        name: run_history(
            RegistrationSetting(PRINTED, sample.trials, seed, key, station_sigma=size), sample.fixed, tick
        )
        for key, (name, size) in enumerate((("5 m", 5.0), ("1 m", 1.0)))
    }
    moving = {
        "1 m": run_history(
            RegistrationSetting(MOVING, sample.trials, seed, 2), sample.moving, tick, first=_MOVING_FIRST
        )
    }
    joint = {
        name: run_history(RegistrationSetting(PRINTED, sample.trials, seed, key, None, size, _GAIN), sample.fixed, tick)
        for key, (name, size) in enumerate((("5 m", 5.0), ("1 m", 1.0)), 3)
    }
    starts = _start_cases(RegistrationSetting(PRINTED, sample.many, seed, 5), sample.last, tick)
    noisy = [
        RegistrationSetting(PRINTED, sample.many, seed, 6 + i, (ns - 10) * NANOSECOND) for i, ns in enumerate(NOISE)
    ]
    spatial = _score_case(RegistrationSetting(SPATIAL, sample.many, seed, 10), sample.last, _WIDEST, tick)
    tables = (
        table_biases("table-2", fixed["1 m"], ACCURACY_FIXED),
        table_biases("table-5", moving["1 m"], ACCURACY_MOVING),
        table_biases("table-6", joint["1 m"], ACCURACY_JOINT),
        table_starts(starts),
        _noise_table(noisy, sample.last, tick),
        table_errors("figure-1", fixed, FIXED),
        table_errors("figure-2", moving, PRINTED_MOVING),
        table_errors("figure-3", joint, JOINT),
        table_scenes({"printed": starts[-1], "spatial": spatial}),
        table_minima(),
        table_gains(),
        table_readings(),
    )
    figures = {
        "figure-1": against_time(fixed, FIXED),
        "figure-2": against_time(moving, PRINTED_MOVING, zoom=450),
        "figure-3": against_time(joint, JOINT),
    }
    return typeset("registration", sample, seed, tables, figures)


def _score_case(setting: RegistrationSetting, epochs: int, width: float, tick: Tick, label: float = 0.0) -> TableCase:
    """Return the scores of the recursion and of the fix on the same draw.

    `width` is the width of the recursion's starts in sigma0, and the label of the case if `label` is 0.
    """
    drawn, bound = setting.draw(epochs), setting.bound(epochs)
    (recursion_score,) = wander(setting, drawn, (epochs,), (bound,), width=width)
    found = score(solve(drawn, _METHOD).x, truth(setting.scenario, drawn), bound)
    tick()
    sigma, image = setting.sigma or setting.scenario.sigma, _at_image(setting, epochs, recursion_score)
    return TableCase(label or width, epochs, sigma, rms(bound), recursion_score, found, image)


def _at_image(setting: RegistrationSetting, epochs: int, recursion_score: RegistrationScore) -> float:
    """Return the share of trials whose recursion ended at the image of the target."""
    image = ghost(setting.scenario, epochs, sigma=setting.sigma)
    if image is None:
        return 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.linalg.norm(recursion_score.error[:, :3] - (image.x[:3] - setting.scenario.target), axis=-1)
    return float((recursion_score.lost & (distance < _NEAR)).mean())


def _start_cases(setting: RegistrationSetting, epochs: int, tick: Tick) -> list[TableCase]:
    """Return the columns of table 3: one draw, and the recursion from starts of growing width."""
    drawn, bound = setting.draw(epochs), setting.bound(epochs)
    found = score(solve(drawn, _METHOD).x, truth(setting.scenario, drawn), bound)
    cases = []
    for width in INITIAL:
        (recursion_score,) = wander(setting, drawn, (epochs,), (bound,), width=float(width))
        image = _at_image(setting, epochs, recursion_score)
        cases.append(TableCase(float(width), epochs, setting.scenario.sigma, rms(bound), recursion_score, found, image))
        tick()
    return cases


def _noise_table(settings: Sequence[RegistrationSetting], epochs: int, tick: Tick) -> TextTable:
    """Return table 4 from noise that is 10 ns less than its labels; the recursion also starts at the truth."""
    cases: list[TableCase] = []
    from_truth: list[RegistrationScore] = []
    for setting, printed in zip(settings, NOISE, strict=True):
        cases.append(_score_case(setting, epochs, 1.0, tick, printed))
        from_truth += wander(setting, setting.draw(epochs), (epochs,), (setting.bound(epochs),), width=0.0)
        tick()
    return table_noises(cases, from_truth, [rms(setting.bound(700)) for setting in settings])


STUDY = Study(_SIZES, _work, _run)
"""The reproduction of the paper."""

"""Figures of a study's report: one panel each, so that a phone shows them one below the other.

`looks` are the colours, markers and lines of the methods by name; they are the same in all figures. `table` contains
cells (`optloc.lab.study.summary.cells`), and `frame` contains judged rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.lab.study.histories import COUNTS, Histories, band
from optloc.lab.study.profiles import WORK, Profiles
from optloc.lab.study.summary import accuracy_rows, distribution, noise_text, wilson
from optloc.problem import Array
from optloc.show import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SIZE,
    Look,
    Looks,
    Picture,
    literal,
    panel,
    panels,
    with_legend,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colour and marker of each noise level in a panel where all levels share the row of a method.
_LEVELS = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "D"), (PURPLE, "^"), (BLACK, "v"), (GREY, "P"))
# Most panels of distributions. With more of them, one panel shows all noise levels of a case.
_MOST_PANELS = 12
# Least cost above the best that is drawn: rounding errors are smaller.
_LEAST_COST = 1e-6
# Points of a stepped curve: two for each pixel of a panel.
_CURVE_POINTS = 480
# Upper limits of logarithmic axes: errors in units of the bound, costs above the best. Differences beyond do not
# matter.
_LARGEST_ERROR, _LARGEST_COST = 1e4, 1e8


def success(table: pd.DataFrame, looks: Looks) -> Iterator[Picture]:
    """Yield one picture for each case: the share of right answers of each method. Each noise level has a colour."""
    for number, (case, part) in enumerate(table.groupby("case", observed=True)):
        levels = list(dict.fromkeys(part["noise_label"]))
        names = [name for name in looks if name in set(part["method"])]
        # The marks of a method's noise levels share four fifths of the row's height. A row is at least a quarter of an
        # inch high, so that names of eight points do not touch.
        step = min(0.24, 0.8 / len(levels))
        height = 1.35 + len(names) * max(0.26, 0.12 * len(levels))
        figure, axes = panel(str(case), (SIZE[0], height))
        for i, level in enumerate(levels):
            selected = part[part["noise_label"] == level].set_index("method").reindex(names)
            right, trials = selected["right"].to_numpy(dtype=float), selected["trials"].to_numpy(dtype=float)
            share, (low, high) = right / trials, wilson(right, trials)
            colour, mark = _LEVELS[i % len(_LEVELS)]
            y = np.arange(len(names)) + step * (i - (len(levels) - 1) / 2)
            bars = 100 * np.maximum([share - low, high - share], 0.0)
            axes.errorbar(
                100 * share, y, xerr=bars, fmt=mark, color=colour, ms=4, lw=1.1, capsize=2, label=noise_text(level)
            )
        axes.set_yticks(np.arange(len(names)), [literal(name) for name in names], fontsize=8)
        axes.set_ylim(len(names) - 0.45, -0.55)
        # Room for whole marks at 0 and 100.
        axes.set_xlim(-3, 103)
        axes.set_xlabel("right answers (%)")
        # Up to four short labels fit in one line below a panel.
        short = max(len(noise_text(level)) for level in levels) < 12
        figure.legend(loc="outside lower center", ncols=len(levels) if short and len(levels) < 5 else 2, **_PLAIN)
        yield Picture(f"success-{number + 1}", f"Right answers: {case}", figure)


_PLAIN: dict[str, Any] = {"frameon": False, "fontsize": 8}


def accuracy(table: pd.DataFrame, looks: Looks) -> Iterator[Picture]:
    """Yield one picture for each case: root mean square error over the bound against noise."""
    for number, (case, part) in enumerate(table.groupby("case", observed=True)):
        figure, axes = panel(str(case))
        positions, labels, name = _noise_axis(part)
        for mark in looks.values():
            selected = part[part["method"] == mark.name]
            x = np.array([positions[label] for label in selected["noise_label"]])
            ratio, half = selected["ratio"].to_numpy(dtype=float), selected["ratio_half"].to_numpy(dtype=float)
            if not np.isfinite(ratio).any():
                continue
            # On a logarithmic axis a bar must end above zero. The half width is NaN for a single trial.
            low = np.minimum(np.nan_to_num(half), 0.9 * ratio)
            _line(axes, mark, x, ratio, marker=True)
            axes.errorbar(x, ratio, yerr=[low, np.nan_to_num(half)], fmt="none", ecolor=mark.colour, lw=0.8, capsize=2)
        axes.axhline(1.0, color=BLACK, linewidth=1.0, zorder=1)
        _log(axes.yaxis, axes.set_yscale, *axes.get_ylim())
        _ticks(axes, positions, labels)
        axes.set_xlabel(name)
        axes.set_ylabel("RMSE / CRLB")
        yield Picture(f"accuracy-{number + 1}", f"Error over the bound: {case}", figure)


def _noise_axis(part: pd.DataFrame) -> tuple[dict[str, float], list[str], str]:
    """Return the x coordinate of each noise level by label, the labels of the ticks, and the label of the axis.

    The coordinate is the logarithm of the noise if the levels have different positive values. Otherwise it is a running
    number.
    """
    levels = part[["noise_label", "noise"]].drop_duplicates("noise_label")
    labels = [str(label) for label in levels["noise_label"]]
    unit = str(part["noise_unit"].iloc[0])
    name = "factor on the noise of the file" if unit == "x" else "standard deviation of a row"
    values = levels["noise"].to_numpy(dtype=float)
    if len(set(values)) == len(values) and (values > 0).all():
        positions = dict(zip(labels, np.log10(values), strict=True))
    else:
        positions = {label: float(i) for i, label in enumerate(labels)}
    return positions, [noise_text(label).replace(", ", "\n") for label in labels], name


def _ticks(axes: Axes, positions: dict[str, float], labels: list[str]) -> None:
    """Set the ticks of the noise levels, with a margin on both sides; `positions` are their x coordinates by label."""
    x = np.array(list(positions.values()))
    axes.set_xticks(x, labels, fontsize=8)
    # An eighth of the axis on each side, for marks and their bars; a single level needs an axis too.
    margin = 0.12 * max(float(np.ptp(x)), 0.5)
    axes.set_xlim(x.min() - margin, x.max() + margin)


def _log(axis: Any, scale: Any, low: float, high: float) -> None:
    """Make an axis logarithmic; if it spans a factor below 30, its labels are plain numbers.

    `scale` is the function that sets the scale of the axis; `low` and `high` are the ends of the axis.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    scale("log")
    # A decade and a half: on a shorter axis, ticks at powers of ten leave at most one label.
    if high / max(low, 1e-300) < 30.0 and low > 0.0:
        axis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())


def _line(axes: Axes, mark: Look, x: Array, y: Array, *, marker: bool, steps: bool = False, width: float = 1.5) -> None:
    """Draw the curve of a method in its style; `width` is the width of the line in points."""
    (line,) = axes.plot(
        x,
        y,
        color=mark.colour,
        linestyle=mark.dash,
        marker=mark.mark if marker else None,
        markersize=4.5,
        linewidth=width,
        drawstyle="steps-post" if steps else "default",
        label=literal(mark.name),
    )
    line.set_gid(mark.line)


def distributions(frame: pd.DataFrame, looks: Looks) -> Iterator[Picture]:
    """Yield the distributions of errors in units of the bound: a picture for each noise level, or for each case."""
    separate = len(frame[["case", "noise_label"]].drop_duplicates()) <= _MOST_PANELS
    names = ["case", "noise", "noise_label"] if separate else ["case"]
    from scipy.special import gammainc

    for number, (key, part) in enumerate(frame.groupby(names, observed=True)):
        text = f"{key[0]}, {noise_text(str(key[-1]))}" if separate else f"{key[0]}, all noise levels"
        figure, axes = panel(text)
        for mark in looks.values():
            selected = part[part["method"] == mark.name]
            if len(selected):
                values = selected["deviation"].to_numpy(dtype=float)[accuracy_rows(selected)]
                # Zero has no logarithm; 0.01 is below the axis, which begins at 0.1.
                _line(axes, mark, *distribution(np.maximum(values, 1e-2), len(selected)), marker=False, steps=True)
        x = np.geomspace(0.1, 10.0, 120)
        # The squared error of an efficient estimate in units of its bound has a chi-square distribution.
        theory = gammainc(part["dimension"].iloc[0] / 2.0, x**2 / 2.0)
        axes.plot(x, theory, color=BLACK, linewidth=3.5, alpha=0.18, zorder=1)
        axes.set_xscale("log")
        axes.set_xlim(0.1, float(np.clip(np.nanmax([10.0, *axes.get_xlim()]), 10.0, _LARGEST_ERROR)))
        axes.set_ylim(-0.02, 1.02)
        axes.set_xlabel("error in units of the bound")
        axes.set_ylabel("share of trials")
        yield Picture(f"errors-{number + 1}", f"Distribution of errors: {text}", figure)


def gaps(frame: pd.DataFrame, looks: Looks) -> Iterator[Picture]:
    """Yield one picture for each case: the distribution of the cost above the lowest known cost."""
    for number, (case, part) in enumerate(frame.groupby("case", observed=True)):
        figure, axes = panel(str(case))
        for mark in looks.values():
            selected = part[part["method"] == mark.name]
            values = selected["above"].to_numpy(dtype=float)[selected["located"].to_numpy(dtype=bool)]
            if len(values):
                _line(
                    axes, mark, *distribution(np.maximum(values, _LEAST_COST), len(selected)), marker=False, steps=True
                )
        axes.set_xscale("log")
        axes.set_xlim(_LEAST_COST * 0.7, float(np.clip(axes.get_xlim()[1], 10.0, _LARGEST_COST)))
        axes.set_ylim(-0.02, 1.02)
        axes.set_xlabel("cost above the best known")
        axes.set_ylabel("share of trials")
        yield Picture(f"gaps-{number + 1}", f"Cost above the best known: {case}", figure)


def profiles(result: Profiles, looks: Looks) -> Iterator[Picture]:
    """Yield the data profile and the performance profile over the trials that every method ran."""
    for name, title, draw in _PROFILES:
        if result.solved.any():
            figure, axes = panel("")
            draw(axes, result, looks)
            yield Picture(name, f"{title} over {result.spent.shape[1]} trials", figure)


def profile_picture(result: Profiles, looks: Looks) -> Figure:
    """Return a figure of both profiles with a legend."""
    figure, axes = panels("", len(_PROFILES))
    for axis, (_, title, draw) in zip(axes, _PROFILES, strict=True):
        axis.set_title(title, fontsize=10)
        if result.solved.any():
            draw(axis, result, looks)
    return with_legend(figure)


def _data_profile(axes: Axes, result: Profiles, looks: Looks) -> None:
    """Draw the share of trials that each method solves against the work that it may use on each trial."""
    work = result.spent[result.solved]
    budgets = np.geomspace(work.min() / 1.5, 1.5 * work.max(), _CURVE_POINTS)
    _curves(axes, result, looks, budgets, result.data(budgets))
    axes.set_xlabel(WORK[result.work])


def _performance_profile(axes: Axes, result: Profiles, looks: Looks) -> None:
    """Draw the share of trials that each method solves against the work as a multiple of the least work."""
    work = np.where(result.solved, result.spent, np.inf)
    with np.errstate(invalid="ignore"):
        slower = np.where(result.solved, work / work.min(0), 1.0)
    # To 1.5 times the last solved trial: no curve rises beyond.
    ratios = np.geomspace(1.0, max(10.0, 1.5 * float(slower.max())), _CURVE_POINTS)
    _curves(axes, result, looks, ratios, result.performance(ratios))
    axes.set_xlabel(f"{WORK[result.work].partition(' (')[0]} / least of any method")


def _curves(axes: Axes, result: Profiles, looks: Looks, x: Array, shares: Array) -> None:
    """Draw the stepped curves (methods, q) of shares over x (q,)."""
    for method, share in zip(result.methods, shares, strict=True):
        _line(axes, looks[method], x, share, marker=False, steps=True)
    axes.set_xscale("log")
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(-0.02, 1.02)
    axes.set_ylabel(f"share of trials solved to {result.tau:g}")


# Opacity of a band of quartiles: lines of other methods that cross the band stay visible.
_BAND = 0.15
# Widths of the first and of the last line, points: lines that coincide stay visible.
_WIDTHS = (3.5, 1.2)


def history_picture(result: Histories, looks: Looks) -> Figure:
    """Return a figure of the cost against evaluations and against iterations: medians over trials, and quartiles."""
    trials = result.frame["trial"].nunique()
    figure, panel_axes = panels(f"{result.title}: {trials} trial{'s' * (trials > 1)}", len(COUNTS))
    for axes, (by, label) in zip(panel_axes, COUNTS.items(), strict=True):
        for name, width in zip(result.methods, np.linspace(*_WIDTHS, len(result.methods)), strict=True):
            counts = result.frame.loc[result.frame["method"] == name, by].to_numpy(dtype=float)
            # The method does not have this count.
            if np.isnan(counts).any():
                continue
            at = np.unique(counts)
            low, middle, high = np.maximum(band(result, name, by, at), _LEAST_COST)
            # A logarithmic axis has no zero, so iterations are drawn from one on.
            x = at + 1.0 if by == "iterations" else at
            _line(
                axes,
                looks[name],
                x,
                np.where(np.isfinite(middle), middle, np.nan),
                marker=False,
                steps=True,
                width=width,
            )
            # Infinite values are drawn beyond the upper end of the panel.
            top = np.where(np.isfinite(high), high, _LARGEST_COST)
            axes.fill_between(x, low, top, color=looks[name].colour, alpha=_BAND, step="post", linewidth=0)
        axes.set_yscale("log")
        _log(axes.xaxis, axes.set_xscale, 1.0, axes.get_xlim()[1])
        axes.set_xlim(left=1.0)
        axes.set_xlabel(label if by == "evaluations" else "iterations + 1")
        axes.set_ylabel("cost above the least known")
    return with_legend(figure)


_PROFILES = (
    ("data-profile", "Data profile", _data_profile),
    ("profile", "Performance profile", _performance_profile),
)


def timing(frame: pd.DataFrame, looks: Looks) -> Iterator[Picture]:
    """Yield one picture for each mixture of kinds: the time of a fix against the number of measurements.

    The picture shows the median, and bars from the 10th to the 90th percentile.
    """
    for number, (kinds, part) in enumerate(frame.groupby("kinds", observed=True)):
        figure, axes = panel(str(kinds).replace("+", " + "))
        sizes = sorted(part["rows"].unique())
        # Marks of one size are 1.2 % apart. With a single size they are 0.6 % apart, as the axis covers 0.9 to 1.1 of
        # it.
        step = 1.006 if len(sizes) == 1 else 1.012
        for mark in looks.values():
            grouped = part[part["method"] == mark.name].groupby("rows")["seconds"]
            low, median, high = (grouped.quantile(share) for share in (0.1, 0.5, 0.9))
            # Shifted, so that bars do not hide one another.
            x = median.index.to_numpy(dtype=float) * step ** (mark.number - (len(looks) - 1) / 2)
            _line(axes, mark, x, median.to_numpy(), marker=True)
            axes.vlines(x, low.to_numpy(), high.to_numpy(), color=mark.colour, linewidth=0.8)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.minorticks_off()
        axes.set_xticks(sizes, [str(size) for size in sizes])
        if len(sizes) == 1:
            axes.set_xlim(sizes[0] / 1.1, sizes[0] * 1.1)
        axes.set_xlabel("measurements of a trial")
        axes.set_ylabel("time of a fix (s)")
        yield Picture(f"time-{number + 1}", f"Time of a fix against its size: {kinds}", figure)

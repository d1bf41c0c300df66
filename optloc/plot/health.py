"""Health of stations: left-out residuals as boxes, the largest bias on top."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optloc.plot.style import BLACK, BLUE, GREY, ORANGE, SKY, figure_class
from optloc.quality.health import Health
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN = 40
_MIDDLE, _WHISKERS = (25.0, 75.0), (2.5, 97.5)
# Bias, in whiskers of the others, beyond which a station is not drawn but named.
_FAR = 10.0


def plot_health(health: Health, *, title: str = "") -> Figure:
    """Return a picture of the left-out residuals of every station, one panel for each unit.

    A box holds the middle half of a station's residuals and its whiskers 95 %; a mark with bars is the bias with two
    standard errors. Residuals that the others predict much worse than most are not drawn, and of many stations those
    with the most fixes are.

    Parameters
    ----------
    health : Health
        Of `optloc.health`.
    title : str
        Title of the picture.

    Returns
    -------
    matplotlib.figure.Figure
        To be written with `optloc.plot.save`.
    """
    units = list(dict.fromkeys(health.units))
    chosen = [_chosen(health, unit) for unit in units]
    tall = [max(2, len(groups)) for groups in chosen]
    size = (8.0, 1.2 + sum(0.9 + 0.27 * n for n in tall))
    figure = figure_class()(figsize=size, layout="constrained")
    panels = figure.subplots(len(units), 1, squeeze=False, height_ratios=tall)[:, 0]
    for panel, unit, groups in zip(panels, units, chosen, strict=True):
        _panel(panel, health, unit, groups)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=8)
    if title:
        figure.suptitle(title)
    return figure


def _limit(panel: Axes, whisker: Array, bias: Array, unit: str) -> None:
    """Set the limits so that boxes can be told apart; of a station far beyond the others the edge tells the bias."""
    most = np.quantile(whisker, 0.8)
    bias = np.nan_to_num(bias)
    far = np.abs(bias) > _FAR * most
    reach = 1.2 * max(most, *np.abs(bias[~far]), *np.minimum(whisker[~far], 2.0 * most))
    panel.set_xlim(-reach, reach)
    for place in np.flatnonzero(far).tolist():
        if bias[place] > 0.0:
            words, side, align = f"{bias[place]:.3g} {unit} \N{RIGHTWARDS ARROW}", reach, "right"
        else:
            words, side, align = f"\N{LEFTWARDS ARROW} {bias[place]:.3g} {unit}", -reach, "left"
        panel.text(0.99 * side, place, words, ha=align, va="center", fontsize=8, color=ORANGE)


def _chosen(health: Health, unit: str) -> Array:
    """Return the groups of a unit that are drawn, those with the smallest bias first."""
    groups = np.flatnonzero(np.array(health.units) == unit)
    groups = groups[np.argsort(-health.count[groups], kind="stable")[:_SHOWN]]
    return groups[np.argsort(np.nan_to_num(health.bias[groups]), kind="stable")]


def _well_checked(health: Health, group: int) -> Array:
    """Return the residuals of a group but for those that the others predict several times worse than most."""
    own = health.group == group
    sigma = health.sigma[own]
    return np.asarray(health.residual[own][sigma <= 3.0 * np.median(sigma)])


def _panel(panel: Axes, health: Health, unit: str, groups: Array) -> None:
    place = np.arange(len(groups))
    quantiles = np.array([np.percentile(_well_checked(health, g), (*_WHISKERS, *_MIDDLE, 50.0)) for g in groups]).T
    factor, shown = (1e3, f"m{unit}") if unit == "rad" else (1.0, unit)
    low, high, left, right, middle = factor * quantiles
    panel.hlines(place, low, high, color=GREY, linewidth=1.2, label="95 % of residuals")
    panel.barh(
        place, right - left, left=left, height=0.6, color=SKY, edgecolor=BLUE, linewidth=0.8, label="middle half"
    )
    panel.scatter(middle, place, marker="|", s=90, color=BLUE, linewidth=2.0, label="median", zorder=3)
    panel.errorbar(
        factor * health.bias[groups],
        place,
        xerr=2.0 * factor * health.bias_error[groups],
        fmt="D",
        color=ORANGE,
        markersize=4,
        capsize=3,
        label="bias ± 2 standard errors",
        zorder=4,
    )
    _limit(panel, np.abs([low, high]).max(0), factor * health.bias[groups], shown)
    panel.axvline(0.0, color=BLACK, linewidth=0.8, zorder=0)
    panel.set_yticks(place, [health.names[g] for g in groups])
    panel.set_xlabel(f"measured less predicted by the others ({shown})" if shown != "1" else "measured less predicted")
    panel.set_ylim(-0.7, len(groups) - 0.3)
    panel.grid(axis="x", color=GREY, alpha=0.3, linewidth=0.6)
    words = [f"{health.outliers[g]:.1%} of {health.count[g]}" for g in groups]
    right_axis = panel.secondary_yaxis("right")
    right_axis.set_yticks(place, words, fontsize=8)
    right_axis.tick_params(length=0)
    right_axis.set_ylabel("outliers")

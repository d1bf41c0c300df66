"""Pictures of residuals by station: of fixes, and against the prediction of the other stations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Rows
from optloc.base.units import SI_UNIT
from optloc.linear.evaluate import differentiate
from optloc.linear.normal import with_station_noise
from optloc.models import MODELS
from optloc.problem.fix import Fix
from optloc.problem.noise import variances
from optloc.problem.problem import Problem
from optloc.show.pictures.style import BLACK, BLUE, GREY, ORANGE, SKY, SMALL, figure_class, finish, grid, literal
from optloc.station_health.stations import Health

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Maximum number of stations or pairs in a panel: those with the largest residuals in sigmas. Maximum number of
# residuals drawn as single points.
_SHOWN, _FEW = 40, 12
# Residuals beyond this many sigmas have another mark.
_BEYOND = 3.0
# Percentiles of a box and of its whiskers.
_MIDDLE, _WHISKERS = (25.0, 75.0), (2.5, 97.5)
# A left-out residual is not drawn if its standard deviation exceeds this many medians: it shows little about the
# station.
_VAGUE = 3.0
# If a bias exceeds this many whiskers of the other stations, a text at the edge of the panel replaces its box.
_FAR = 10.0

Sets = dict[str, tuple[Array, float]]
"""Residuals (n,) and the median standard deviation of a row, by the names of the stations."""


def plot_residuals(problem: Problem, fix: Fix, title: str = "") -> Figure:
    """Return a picture of the residuals z - h(x) by station or pair of stations, one panel for each kind.

    Residuals of compass bearings are clockwise.

    The grey bar covers plus and minus two standard deviations of a row. If a station has many residuals, a box holds
    the middle half of them. A fix follows its measurements, so residuals are smaller than errors. To compare each
    station with the prediction of the others, use `optloc.station_health.health`.

    Parameters
    ----------
    problem : Problem
        Batch (...) of problems. For epochs with separate fixes, use `optloc.problem.by_epoch`.
    fix : Fix
        Their fixes, with the same batch axes.
    title : str
        Title of the picture.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.

    Raises
    ------
    InvalidProblem
        If the batch axes differ, or there is no fix.
    """
    flat, answers = problem.flat(), fix.flat()
    good = np.flatnonzero(np.isfinite(answers.x).all(-1))
    if len(answers) != flat.batch_shape[0]:
        what = f"{len(answers)} fixes do not belong to {flat.batch_shape[0]} problems"
        raise InvalidProblem(what, "plot", "give the problem that was fixed; see `optloc.problem.by_epoch`")
    if not len(good):
        raise InvalidProblem(
            "no epoch has a fix, so there are no residuals", "plot", "see `optloc fix` for the reasons"
        )
    part, vectors = flat.take(good), answers.x[good]
    residual = differentiate(part, vectors)[0]
    sigma = np.broadcast_to(np.sqrt(variances(with_station_noise(part, vectors).noise, part.count)), residual.shape)
    weight = np.broadcast_to(part.weight, residual.shape)
    sets = [
        _residuals_by_station(part, rows, rows.sense * residual[:, cols], sigma[:, cols], weight[:, cols])
        for rows, start in zip(part.rows, part.starts, strict=True)
        for cols in [slice(start, start + rows.count)]
    ]
    return _draw([rows.kind for rows in part.rows], sets, title)


def _residuals_by_station(problem: Problem, rows: Rows, residual: Array, sigma: Array, weight: Array) -> Sets:
    """Return the residuals of one kind of rows by station or pair, for the stations with the largest residuals.

    `residual`, `sigma` and `weight` (N, m) belong to the m rows of N problems. Rows of weight zero are absent.
    """
    names = problem.stations.names
    labels = [_label(names, a, b) for a, b in zip(rows.a, rows.b, strict=True)]
    found: Sets = {}
    for name in dict.fromkeys(labels):
        mask = np.array([label == name for label in labels])
        present = weight[:, mask] > 0.0
        if present.any():
            found[name] = (residual[:, mask][present], float(np.median(sigma[:, mask][present])))
    # Keep the stations with the largest residuals in sigmas, in the order of the file.
    worst = sorted(found, key=lambda name: -float(np.abs(found[name][0]).max() / found[name][1]))[:_SHOWN]
    return {name: values for name, values in found.items() if name in worst}


def _label(names: Sequence[str], a: int, b: int) -> str:
    """Return the names of the stations of a row, or "all" for a row without stations; -1 means no station."""
    return " – ".join(names[i] for i in (a, b) if i >= 0) or "all"


def _draw(kinds: Sequence[str], sets: Sequence[Sets], title: str) -> Figure:
    """Return a figure with one panel of residuals for each kind, and a common legend."""
    figure, panels = _rows_of_panels([len(one) for one in sets], 7.6, 0.3)
    for panel, kind, one in zip(panels, kinds, sets, strict=True):
        _panel(panel, kind, one)
    return finish(figure, title, panels, 4, fontsize=SMALL)


def _rows_of_panels(counts: Sequence[int], width: float, line: float) -> tuple[Figure, Any]:
    """Return a figure with one panel below the other, one for each entry of `counts`.

    An entry is the number of lines of a panel, which sets its height. `width` of the figure and height `line` of a line
    are in inches.
    """
    tall = [max(2, count) for count in counts]
    size = (width, 1.1 + sum(0.9 + line * n for n in tall))
    figure = figure_class()(figsize=size, layout="constrained")
    return figure, figure.subplots(len(tall), 1, squeeze=False, height_ratios=tall)[:, 0]


def _panel(panel: Axes, kind: str, sets: Sets) -> None:
    """Draw the residuals of one kind, one line for each station or pair.

    Few residuals are single points. Many residuals are a box of the middle half with a line of 95 %. `sets` are the
    residuals by the names of the stations or pairs.
    """
    unit = SI_UNIT[MODELS[kind].quantity]  # type: ignore[index]  # the table holds known quantities only
    # Use milliradians: residuals in radians have too many zeros.
    factor, unit = (1e3, f"m{unit}") if unit == "rad" else (1.0, unit)
    for place, (values, sigma) in enumerate(sets.values()):
        scaled, bar = factor * values, 2.0 * factor * sigma
        panel.hlines(
            place, -bar, bar, color=GREY, linewidth=5.0, alpha=0.5, label=_label_of_first(place, "± 2 sigma of a row")
        )
        if len(scaled) > _FEW:
            low, left, middle, right, high = np.percentile(
                scaled, (_WHISKERS[0], _MIDDLE[0], 50.0, _MIDDLE[1], _WHISKERS[1])
            )
            panel.hlines(
                place, low, high, color=BLUE, linewidth=1.2, zorder=3, label=_label_of_first(place, "95 % of residuals")
            )
            style: dict[str, Any] = {"height": 0.5, "color": SKY, "edgecolor": BLUE, "zorder": 3}
            panel.barh(place, right - left, left=left, label=_label_of_first(place, "middle half"), **style)
            panel.scatter(
                middle, place, marker="|", s=70, color=BLACK, zorder=4, label=_label_of_first(place, "median")
            )
            continue
        far = np.abs(scaled) > _BEYOND * factor * sigma
        for chosen, colour, mark, name in (
            (~far, BLUE, "o", "residual"),
            (far, ORANGE, "X", "residual beyond 3 sigma"),
        ):
            if chosen.any():
                panel.scatter(
                    scaled[chosen], np.full(chosen.sum(), place), color=colour, marker=mark, zorder=4, label=name
                )
    panel.axvline(0.0, color=BLACK, linewidth=0.8, zorder=1)
    panel.set_yticks(range(len(sets)), [literal(name) for name in sets])
    panel.set_ylim(len(sets) - 0.4, -0.6)
    panel.set_xlabel(f"measured minus modelled ({unit})" if unit != "1" else "measured minus modelled")
    panel.set_title(kind, fontsize=10)
    grid(panel)


def _label_of_first(place: int, label: str) -> str:
    """Return the label for line number 0, else an empty text, so that the legend lists each label once."""
    return "" if place else label


# Health of stations: left-out residuals as boxes, the largest bias on top.


def plot_health(health: Health, *, title: str = "") -> Figure:
    """Return a picture of the left-out residuals of every station, one panel for each unit.

    A left-out residual compares a measurement with the prediction of the other stations. A box holds the middle half of
    the residuals of a station, and its whiskers 95 %. A mark with bars is the bias with two standard errors. Residuals
    with a much larger prediction error than most are not drawn. If there are many stations, those with the most fixes
    are drawn.

    Parameters
    ----------
    health : Health
        Result of `optloc.station_health.health`.
    title : str
        Title of the picture.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.
    """
    units = list(dict.fromkeys(health.units))
    chosen = [_groups_to_draw(health, unit) for unit in units]
    figure, panels = _rows_of_panels([len(groups) for groups in chosen], 8.0, 0.27)
    for panel, unit, groups in zip(panels, units, chosen, strict=True):
        _health_panel(panel, health, unit, groups)
    return finish(figure, title, panels[:1], 4, fontsize=SMALL)


def _groups_to_draw(health: Health, unit: str) -> Array:
    """Return the numbers of the groups of a unit to draw: those with the most fixes, sorted by bias.

    A group is a station, a pair of stations or a kind, see `Health`.
    """
    numbers = np.flatnonzero(np.array(health.units) == unit)
    numbers = numbers[np.argsort(-health.count[numbers], kind="stable")[:_SHOWN]]
    return numbers[np.argsort(np.nan_to_num(health.bias[numbers]), kind="stable")]


def _health_panel(panel: Axes, health: Health, unit: str, groups: Array) -> None:
    """Draw the left-out residuals of some groups of a unit, with their biases and their shares of outliers.

    `groups` are the numbers of the groups in `health`, from the bottom of the panel to its top.
    """
    place = np.arange(len(groups))
    quantiles = np.array([np.percentile(_well_checked(health, g), (*_WHISKERS, *_MIDDLE, 50.0)) for g in groups]).T
    factor, shown = (1e3, f"m{unit}") if unit == "rad" else (1.0, unit)
    # whiskers, ends of the box and median
    low, high, left, right, middle = factor * quantiles
    panel.hlines(place, low, high, color=GREY, linewidth=1.2, label="95 % of residuals")
    panel.barh(
        place, right - left, left=left, height=0.6, color=SKY, edgecolor=BLUE, linewidth=0.8, label="middle half"
    )
    panel.scatter(middle, place, marker="|", s=90, color=BLUE, linewidth=2.0, label="median", zorder=3)
    style: dict[str, Any] = {"fmt": "D", "color": ORANGE, "markersize": 4, "capsize": 3, "zorder": 4}
    error = 2.0 * factor * health.bias_error[groups]
    panel.errorbar(factor * health.bias[groups], place, xerr=error, label="bias ± 2 standard errors", **style)
    _set_limits(panel, np.abs([low, high]).max(0), factor * health.bias[groups], shown)
    panel.axvline(0.0, color=BLACK, linewidth=0.8, zorder=0)
    panel.set_yticks(place, [literal(health.names[g]) for g in groups])
    label = "measured minus predicted from other stations"
    panel.set_xlabel(f"{label} ({shown})" if shown != "1" else label)
    panel.set_ylim(-0.7, len(groups) - 0.3)
    panel.grid(axis="x", color=GREY, alpha=0.3, linewidth=0.6)
    words = [f"{health.outliers[g]:.1%} of {health.count[g]}" for g in groups]
    right_axis = panel.secondary_yaxis("right")
    right_axis.set_yticks(place, words, fontsize=SMALL)
    right_axis.tick_params(length=0)
    right_axis.set_ylabel("outliers")


def _well_checked(health: Health, group: int) -> Array:
    """Return the residuals of a group, without residuals whose prediction error is much larger than the median."""
    mask = health.group == group
    sigma = health.sigma[mask]
    return np.asarray(health.residual[mask][sigma <= _VAGUE * np.median(sigma)])


def _set_limits(panel: Axes, whisker: Array, bias: Array, unit: str) -> None:
    """Set the limits so that boxes differ visibly; if a bias is far beyond the limits, write its value at the edge.

    `whisker` and `bias` have one number for each line of the panel, in its unit.
    """
    # Use the 80 % quantile of the whiskers: a fifth of the stations can be worse, and the other boxes stay large.
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
        panel.text(0.99 * side, place, words, ha=align, va="center", fontsize=SMALL, color=ORANGE)

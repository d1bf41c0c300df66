"""Pictures of curves: errors of methods against noise, and bounds and estimates of a run against time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.bounds.cramer_rao import Course
from optloc.problem.layout import Slot
from optloc.show.pictures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    SMALL,
    YELLOW,
    figure_class,
    finish,
    grid,
    literal,
    panels_for,
)
from optloc.show.pictures.time_axes import TimeScale, time_scale
from optloc.solvers.running import GrowingRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Each method has a colour and a mark, so that methods differ in grey print.
_LOOKS = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "D"), (PURPLE, "^"), (SKY, "v"), (YELLOW, "P"))
_COURSE_COLOURS = (ORANGE, GREEN, PURPLE, SKY, YELLOW, GREY, BLACK)
_WORDS = {"position": ("position", "m"), "velocity": ("velocity", "m/s"), "acceleration": ("acceleration", "m/s²")}
_SPACE = {2: "the plane", 3: "space"}
# Maximum number of members of a family of biases with one curve each; larger families have one curve, the root mean
# square.
_MANY = 10
_BIAS_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, YELLOW)
_DASHES = ("-", "--", "-.", ":")
# Maximum number of members that are drawn: one for each colour.
_MOST = 6
# 97.5 % quantile of a standard normal variable.
_95 = 1.959963984540054
# Half the height of a panel of estimates, in standard deviations half way through the run. The first intervals are far
# wider and are cut off.
_RIM = 8.0


def plot_accuracy(
    noise: Array, errors: Mapping[str, Array], bound: Array, title: str = "", *, unit: str = "m", what: str = "position"
) -> Figure:
    """Return a picture of root mean square errors and the Cramér-Rao bound against noise, both axes logarithmic.

    Parameters
    ----------
    noise : array (q,)
        Standard deviations of a row; if `unit` is empty, factors on the standard deviations of a problem.
    errors : mapping of str to array (q,)
        Root mean square error of each method, m; NaN if unknown.
    bound : array (q,)
        Root of the trace of the bound, m.
    title : str
        Title of the picture.
    unit : str
        Unit of the noise.
    what : str
        Quantity of the errors, for the label.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.

    Raises
    ------
    InvalidProblem
        If numbers of points differ, or a noise is not positive.
    """
    noise, bound = np.asarray(noise, dtype=float), np.asarray(bound, dtype=float)
    for name, values in {"the bound": bound, **errors}.items():
        if np.shape(values) != noise.shape:
            raise InvalidProblem(
                f"{name} has {np.size(values)} values for {noise.size} noises", "plot", "give one value for each noise"
            )
    if not (noise > 0.0).all():
        raise InvalidProblem("a noise is not positive", "noise", "omit it, because the axis is logarithmic")
    figure = figure_class()(figsize=(6.2, 4.4), layout="constrained")
    axes = figure.subplots()
    # Draw the bound wide and pale behind the methods: curves of efficient methods are on top of it.
    axes.plot(noise, bound, color=BLACK, linewidth=4.0, alpha=0.3, label="Cramer-Rao bound", zorder=2)
    for i, (name, values) in enumerate(errors.items()):
        colour, mark = _LOOKS[i % len(_LOOKS)]
        axes.plot(noise, values, color=colour, marker=mark, markersize=5, linewidth=1.3, label=literal(name), zorder=3)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(f"standard deviation of a row ({unit})" if unit else "factor on the noise")
    axes.set_ylabel(f"root mean square error of the {what} (m)")
    axes.legend(frameon=False, fontsize=9)
    grid(axes)
    if title:
        axes.set_title(literal(title), fontsize=11)
    return figure


# The Cramér-Rao bound against time.


def plot_course(
    course: Course, known: Course | None = None, title: str = "", names: Sequence[str] | None = None
) -> Figure:
    """Return a picture of the bound against time, one panel for each state of a target and each family of biases.

    Parameters
    ----------
    course : Course
        The bound of all unknowns.
    known : Course, optional
        The bound if the biases are known, drawn dashed.
    title : str
        Title of the picture.
    names : sequence of str, optional
        Names of the unknowns to draw; by default all.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.
    """
    slots = [slot for slot in course.layout.shared if names is None or slot.name in names]
    figure, panels = panels_for(len(slots), 3, 4.8, 4.2)
    for panel, slot in zip(panels, slots, strict=True):
        _course_panel(panel, course, known, slot)
    return finish(figure, title)


def _course_panel(panel: Axes, course: Course, known: Course | None, slot: Slot) -> None:
    """Draw the bound of one family of unknowns against time.

    A state of a target has a curve for each axis and for all axes together. A large family of biases has one curve, the
    root mean square. `known` is the bound with known biases, or None. `course` is the bound of all unknowns, and `slot`
    is the place of the family in the vector of unknowns.
    """
    word, unit = _WORDS.get(slot.name.partition("[")[0], (slot.name, slot.unit))
    sigma, entries = course.sigma(slot.name), slot.entries
    scale = time_scale(course.times, dated=course.dated)
    times = scale.values(course.times)
    if slot.members and slot.size > _MANY:
        # `total` is the root of the sum of squares of all members.
        entries, sigma = ("root mean square",), course.total(slot.name)[:, None] / np.sqrt(slot.size)
    for entry, values, colour in zip(entries, sigma.T, _COURSE_COLOURS * 2, strict=False):
        label = f"{word} {entry}".strip() if slot.members else f"along {entry}"
        panel.plot(times, values, color=colour, linewidth=1.8 if slot.members else 1.0, label=literal(label), zorder=3)
    if not slot.members:
        panel.plot(times, course.total(slot.name), color=BLUE, linewidth=3.5, label=f"in {_SPACE[slot.size]}")
        if known is not None:
            total = known.total(slot.name)
            dashed: dict[str, Any] = {"color": BLUE, "linewidth": 1.6, "linestyle": "--"}
            panel.plot(scale.values(known.times), total, label="the same, biases known", **dashed)
    panel.set_yscale("log")
    scale.name(panel)
    panel.set_ylabel(f"bound of the standard deviation ({unit})")
    panel.set_title(literal(slot.name))
    panel.grid(which="both", color=GREY, alpha=0.3, linewidth=0.6)
    panel.legend(frameon=False, fontsize=SMALL)


# Estimates of a run against time, with their intervals: biases and other unknowns that the epochs share.


def plot_biases(
    found: GrowingRun,
    title: str = "",
    *,
    names: Sequence[str] | None = None,
    truth: Mapping[str, Array] | None = None,
    units: Mapping[str, tuple[str, float]] | None = None,
) -> Figure:
    """Return a picture of estimates against the length of a run, with 95 % intervals, one panel for each family.

    The legend has the final estimates with their standard deviations.

    Parameters
    ----------
    found : GrowingRun
        Estimates after the first epochs, from `optloc.solvers.running.growing`.
    title : str
        Title of the picture.
    names : sequence of str, optional
        Names of the unknowns to draw; by default all families of biases.
    truth : mapping of str to array, optional
        True values by name, in SI units, drawn dotted.
    units : mapping of str to (str, float), optional
        Unit of a family by its name, and its size in SI units with sign; see `optloc.files.Loaded.bias_units`. Other
        families are in SI units.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.

    Raises
    ------
    InvalidProblem
        If the run has nothing to draw.
    """
    slots = [slot for slot in found.layout.shared if (bool(slot.members) if names is None else slot.name in names)]
    if not slots:
        advice = f"choose from {', '.join(slot.name for slot in found.layout.shared)}"
        raise InvalidProblem("the run has no biases to draw", "names", advice)
    figure, panels = panels_for(len(slots), 2, 5.4, 4.0)
    for panel, slot in zip(panels, slots, strict=True):
        unit, size = (units or {}).get(slot.name, (slot.unit, 1.0))
        values, sigma = found.take(slot.name)
        estimates = _Estimates(values / size, sigma / abs(size), unit, slot)
        true = None if truth is None or slot.name not in truth else np.ravel(truth[slot.name]) / size
        _bias_panel(panel, found.times, estimates, true, dated=found.dated)
    return finish(figure, title)


class _Estimates(NamedTuple):
    """Estimates of a family in the unit of its panel.

    - values, sigma (k, p): p estimates after each of k epochs, and their standard deviations.
    - unit: unit of the panel; empty for pure numbers.
    - slot: place of the family in the vector of unknowns.
    """

    values: Array
    sigma: Array
    unit: str
    slot: Slot


def _bias_panel(panel: Axes, times: Array, found: _Estimates, truth: Array | None, *, dated: bool) -> None:
    """Draw the estimates of one family against time with their 95 % intervals.

    `times` (k,) are in s; if `dated`, since 1970, UTC. If `truth` (p,) is given, in the unit of the panel,
    the true values are dotted lines.
    """
    values, sigma, unit, slot = found
    scale: TimeScale = time_scale(times, dated=dated)
    shown = scale.values(times)
    for i, entry in enumerate(slot.entries[:_MOST]):
        colour, band = _BIAS_COLOURS[i % len(_BIAS_COLOURS)], _95 * sigma[:, i]
        style: dict[str, Any] = {"color": colour, "linewidth": 1.5, "linestyle": _DASHES[i % len(_DASHES)]}
        label = f"{entry}: {_final_value(values[:, i], sigma[:, i], unit)}"
        panel.plot(shown, values[:, i], label=literal(label), zorder=3, **style)
        panel.fill_between(shown, values[:, i] - band, values[:, i] + band, color=colour, alpha=0.18, linewidth=0.0)
        if truth is not None:
            panel.axhline(truth[i], color=BLACK, linewidth=1.0, linestyle=":", zorder=2)
    _limit_to_estimates(panel, values[:, :_MOST], sigma[:, :_MOST])
    hidden = len(slot.entries) - _MOST
    panel.set_title(literal(slot.name) + (f" (first {_MOST} of {len(slot.entries)})" if hidden > 0 else ""))
    scale.name(panel)
    panel.set_ylabel(f"estimate with 95 % interval ({unit})" if unit else "estimate with 95 % interval")
    # Estimates settle in the middle of the panel, so the legend is below it.
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 2}
    panel.legend(frameon=False, fontsize=SMALL, title="final value ± sigma", title_fontsize=SMALL, **place)
    grid(panel)


def _final_value(values: Array, sigma: Array, unit: str) -> str:
    """Return the last known estimate with its standard deviation and unit as text; "unknown" without an estimate."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(sigma))
    if not len(known):
        return "unknown"
    value, error = float(values[known[-1]]), float(sigma[known[-1]])
    # Two digits of the standard deviation, and the same decimals of the value.
    digits = 0 if error <= 0.0 else max(0, 1 - int(np.floor(np.log10(error))))
    return f"{value:.{digits}f} ± {error:.{digits}f} {unit}".strip()


def _limit_to_estimates(panel: Axes, values: Array, sigma: Array) -> None:
    """Limit the vertical axis to the last estimates plus and minus a margin.

    `values` and `sigma` (k, p) are p estimates after each of k epochs. The margin is `_RIM` times the largest standard
    deviation half way through the run.
    """
    known = np.flatnonzero(np.isfinite(values).all(-1))
    if not len(known):
        return
    last, rim = values[known[-1]], _RIM * np.nanmax(sigma[known[len(known) // 2]])
    panel.set_ylim(float(last.min() - rim), float(last.max() + rim))

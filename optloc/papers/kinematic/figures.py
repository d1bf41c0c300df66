"""The figures of the page: tracks and errors of the three scenes, models, association."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from optloc.papers.kinematic.scenario import Draw
from optloc.papers.kinematic.trials import LOST, Score, mean_error
from optloc.papers.report import canvas
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BLACK = "#000000"
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def scene(drawn: Draw, position: Array, score: Score, bound: Array | None) -> Figure:
    """Return one run in the plane, and the mean error of each target against the step.

    Parameters
    ----------
    drawn : Draw
        The truth.
    position : array (n, t, k, 2)
        Estimates.
    score : Score
        Their errors.
    bound : array (t, k, 2, 2), optional
        Covariance bound at the same steps.
    """
    figure = canvas(11.0, 4.8)
    plan, ax = figure.subplots(1, 2)
    steps = np.arange(1, score.error.shape[-1] + 1)
    for target in range(len(drawn.truth)):
        colour = _COLOURS[target]
        true, found = 1e-3 * drawn.truth[target, :, :2], 1e-3 * position[0, target]
        plan.plot(*true.T, color=colour, lw=1.2)
        plan.plot(*found.T, "o", color=colour, mfc="none", ms=4, label=f"target {target + 1}")
        plan.plot(*true[0], "s", color=colour, ms=6)
        ax.plot(
            steps, 1e-3 * score.error[:, target].mean(0), "o-", color=colour, ms=4, lw=0.8, label=f"target {target + 1}"
        )
        if bound is not None:
            label = "bound" if target == len(bound) - 1 else None
            ax.plot(steps, 1e-3 * mean_error(bound[target]), color=_BLACK, lw=0.8, ls="--", label=label)
    plan.set_title("one run: line and square the truth, circles the filter")
    plan.set_xlabel("x, km")
    plan.set_ylabel("y, km")
    plan.set_aspect("equal", adjustable="datalim")
    ax.set_title(f"mean error of {len(score.error)} runs")
    _steps(ax, "mean position error, km")
    for each in (plan, ax):
        each.legend(frameon=False)
        each.grid(visible=True, alpha=0.25)
    return figure


def probabilities(found: Mapping[str, Array], names: Sequence[str]) -> Figure:
    """Return the mean probability of each model against the step, one panel for each motion.

    Parameters
    ----------
    found : mapping of str to array (k, q)
        By motion.
    names : sequence of q str
        Models.
    """
    figure = canvas(4.0 * len(found), 3.8)
    panels = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
    for ax, (motion, shares) in zip(panels, found.items(), strict=True):
        for i, name in enumerate(names):
            style = ("o-", "s-", "^-")[i % 3]
            ax.plot(np.arange(1, len(shares) + 1), shares[:, i], style, color=_COLOURS[i], ms=4, lw=1, label=name)
        ax.set_title(f"truth: {motion}")
        _steps(ax, "mean probability of the model" if ax is panels[0] else "")
        ax.grid(visible=True, alpha=0.25)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def losses(found: Mapping[str, Score]) -> Figure:
    """Return the share of tracks that are far from the truth against the step.

    Parameters
    ----------
    found : mapping of str to Score
        By rule.
    """
    figure = canvas(7.0, 4.6)
    ax = figure.subplots()
    for i, (rule, score) in enumerate(found.items()):
        far = 100.0 * (score.error > LOST).mean((0, 1))
        style = ("o-", "s--", "^-", "x-")[i % 4]
        ax.plot(np.arange(1, len(far) + 1), far, style, color=_COLOURS[i % 4], ms=4, lw=1, label=rule)
    _steps(ax, "tracks more than 10 km off, %")
    ax.grid(visible=True, alpha=0.25)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _steps(ax: Axes, label: str) -> None:
    ax.set_xlabel("step")
    ax.set_ylabel(label)
    ax.set_xticks(range(0, 21, 5))

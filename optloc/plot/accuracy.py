"""Errors of methods against the Cramer-Rao bound, over noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from optloc.errors import InvalidProblem
from optloc.plot.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, YELLOW, figure_class, grid
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOOKS = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "D"), (PURPLE, "^"), (SKY, "v"), (YELLOW, "P"))


def plot_accuracy(
    noise: Array, errors: Mapping[str, Array], bound: Array, title: str = "", *, unit: str = "m", what: str = "position"
) -> Figure:
    """Return a picture of root mean square errors and the Cramer-Rao bound against noise, both axes logarithmic.

    Parameters
    ----------
    noise : array (q,)
        Standard deviations of a row, or factors on those of a problem where `unit` is empty.
    errors : mapping of str to array (q,)
        Root mean square error of each method, metres; NaN where it has none.
    bound : array (q,)
        Root of the trace of the bound, metres.
    title : str
        Title of the picture.
    unit : str
        Of the noise.
    what : str
        Of what the errors are.

    Returns
    -------
    matplotlib.figure.Figure
        To be written with `optloc.plot.save`.

    Raises
    ------
    InvalidProblem
        Where numbers of points differ, or a noise is not positive.
    """
    noise, bound = np.asarray(noise, dtype=float), np.asarray(bound, dtype=float)
    for name, values in {"the bound": bound, **errors}.items():
        if np.shape(values) != noise.shape:
            raise InvalidProblem(
                f"{name} has {np.size(values)} values for {noise.size} noises", "plot", "give one each"
            )
    if not (noise > 0.0).all():
        raise InvalidProblem("a noise is not positive", "noise", "leave it out: the axis is logarithmic")
    figure = figure_class()(figsize=(6.2, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(noise, bound, color=BLACK, linewidth=4.0, alpha=0.3, label="Cramer-Rao bound", zorder=2)
    for i, (name, values) in enumerate(errors.items()):
        colour, mark = _LOOKS[i % len(_LOOKS)]
        axes.plot(noise, values, color=colour, marker=mark, markersize=5, linewidth=1.3, label=name, zorder=3)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(f"standard deviation of a row ({unit})" if unit else "factor on the noise")
    axes.set_ylabel(f"root mean square error of the {what} (m)")
    axes.legend(frameon=False, fontsize=9)
    grid(axes)
    if title:
        axes.set_title(title, fontsize=11)
    return figure

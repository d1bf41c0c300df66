"""The figures of the benchmarks."""

from __future__ import annotations

from math import ceil, floor, log10
from pathlib import Path
from typing import Any

from benchmarks.scaling import Curve
from benchmarks.table import Line

from optloc.show.pictures import save
from optloc.show.pictures.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, figure_class

GROUPS = {"optloc": (BLUE, "optloc"), "general": (GREY, "general solvers"), "peer": (ORANGE, "libraries of the field")}
COLOURS = (BLUE, SKY, GREEN, ORANGE, PURPLE, BLACK)


def methods(found: list[Line], path: Path) -> None:
    """Write the time of a fix and how often it is right, scene by scene with one order of methods."""
    scenes = list(dict.fromkeys(line.scene for line in found))
    first = sorted((line for line in found if line.scene == scenes[0]), key=lambda line: -line.times.microseconds)
    names = [line.one.name for line in first]
    figure = figure_class()(figsize=(12.0, 0.8 + 0.34 * len(names)), layout="constrained")
    panels = figure.subplots(1, len(scenes), sharey=True, squeeze=False)[0]
    for panel, scene in zip(panels, scenes, strict=True):
        mine = {line.one.name: line for line in found if line.scene == scene}
        panel.set_xscale("log")
        times = [line.times.microseconds for line in found]
        panel.set_xlim(0.5 * min(times), 80.0 * max(times))
        for place, name in enumerate(names):
            _dot(panel, place, mine[name])
        panel.set_yticks(range(len(names)), names)
        panel.set_xlabel("µs a fix, one core")
        panel.set_title(f"emitters {scene} the array", fontsize="medium", loc="left")
        panel.grid(axis="x", color=GREY, alpha=0.3, linewidth=0.6)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
    _legend(figure)
    save(figure, path)


def _dot(panel: Any, place: int, line: Line) -> None:
    time, colour = line.times.microseconds, GROUPS[line.one.group][0]
    panel.hlines(place, panel.get_xlim()[0], time, color=colour, alpha=0.35, linewidth=2.0)
    panel.plot(time, place, "o", color=colour, markersize=7)
    shares = f"{100 * line.verdict['global']:.0f} | {100 * line.verdict['near']:.0f} %"
    panel.annotate(f"{_read(time)}   {shares}", (time, place), (9, 0), textcoords="offset points", va="center", size=8)


def _read(microseconds: float) -> str:
    """Return a time with two digits and a unit."""
    value, unit = (microseconds / 1e3, "ms") if microseconds >= 1e3 else (microseconds, "µs")
    return f"{value:.0f} {unit}" if value >= 9.95 else f"{value:.1f} {unit}"


def _legend(figure: Any) -> None:
    from matplotlib.patches import Patch

    handles = [Patch(color=colour, label=label) for colour, label in GROUPS.values()]
    handles.append(Patch(color="none", label="%: global minimum | within 5σ of the truth"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)


def _base(method: str) -> str:
    return method.partition(", ")[0]


def growth(curves: list[Curve], path: Path) -> None:
    """Write one panel for each quantity that grows: the time of a fix, both axes logarithmic."""
    axes = list(dict.fromkeys(curve.axis for curve in curves))
    figure = figure_class()(figsize=(12.0, 3.9), layout="constrained")
    panels = figure.subplots(1, len(axes), squeeze=False)[0]
    colours = dict(zip(dict.fromkeys(_base(curve.method) for curve in curves), COLOURS, strict=False))
    for panel, axis in zip(panels, axes, strict=True):
        for curve in (one for one in curves if one.axis == axis):
            style = "o-" if curve.method in colours else "o--"
            panel.plot(curve.at, curve.microseconds, style, color=colours[_base(curve.method)], markersize=4)
        panel.set_xscale("log")
        panel.set_yscale("log")
        at = sorted({place for curve in curves if curve.axis == axis for place in curve.at})
        if at[-1] <= 1000:
            panel.set_xticks(at, [str(place) for place in at])
            panel.xaxis.minorticks_off()
        low, high = panel.get_ylim()
        panel.set_ylim(10.0 ** floor(log10(low)), 10.0 ** ceil(log10(high)))
        panel.set_xlabel(axis)
        panel.grid(which="major", color=GREY, alpha=0.35, linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("µs a fix")
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=colour, marker="o", markersize=4, label=name) for name, colour in colours.items()]
    if any(curve.method not in colours for curve in curves):
        handles.append(Line2D([], [], color=BLACK, linestyle="--", label="two threads"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    save(figure, path)

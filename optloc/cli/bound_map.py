"""What ``optloc crlb --map`` does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optloc.cli.bounds import vector
from optloc.cli.output import dumps, saved, write_text
from optloc.epochs import by_epoch, separable
from optloc.errors import InvalidProblem
from optloc.files import read
from optloc.files.words import Units
from optloc.maps import BoundMap, bound_map, extent, plan_of
from optloc.problem import Problem
from optloc.types import Array

_POINTS = 96
_PICTURES = (".png", ".svg", ".pdf")


def run_map(
    file: Path,
    out: Path,
    at: str | None,
    height: str | None,
    limits: str | None,
    velocity: str | None,
    *,
    geodetic: bool,
    dilution: bool,
) -> int:
    """Write the map of the bound of a file, of the first epoch where each has a position of its own."""
    if out.suffix.lower() not in (*_PICTURES, ".html", ".geojson"):
        advice = "use .png, .svg, .pdf, .geojson or .html"
        raise InvalidProblem(f"maps of type {out.suffix or out.name!r} are unknown", str(out), advice)
    loaded = read(file, values=False)
    problem = by_epoch(loaded.problem) if separable(loaded.problem) else loaded.problem
    problem = problem.flat().take(np.zeros(1, dtype=int)) if problem.batch_shape else problem
    truth = vector(problem, at, velocity, geodetic)
    place = _place(file, problem, at, truth, needed=height is None and problem.dimension == 3)
    x0, x1, y0, y1 = extent(problem, place) if limits is None else _limits(limits, problem)
    grid = np.linspace(x0, x1, _POINTS), np.linspace(y0, y1, _POINTS)
    found = bound_map(problem, truth, *grid, _height(problem, place, height))
    what = "dilution of precision" if dilution else "bound of the position error"
    _write(found, out, f"{loaded.title}: {what}", dilution=dilution)
    return 0


def _place(file: Path, problem: Problem, at: str | None, truth: Array, *, needed: bool) -> Array | None:
    """Return the place (1, d) that is given or fixed, None where it is not needed."""
    sought = [i for i, motion in enumerate(problem.motions) if motion.known is None]
    names = [slot for slot in problem.layout.shared if slot.name.partition("[")[0] == "position"]
    if at is not None and len(sought) == 1 and names:
        return np.asarray(truth[None, names[0].start : names[0].start + names[0].size])
    if not needed:
        return None
    from optloc.solve import solve

    fix = solve(read(file).problem)
    place = fix.position.reshape(-1, problem.dimension)
    good = place[np.isfinite(place).all(-1)]
    if not len(good):
        advice = "give the height of the map with --height, or a place with --at"
        raise InvalidProblem("the file has no fix that tells the height", "--map", advice)
    return np.asarray(good[:1])


def _height(problem: Problem, place: Array | None, height: str | None) -> float:
    if problem.dimension == 2:
        return 0.0
    if height is not None:
        return float(Units("length").plain(_number(height), "m", "--height"))
    assert place is not None
    return float(plan_of(problem.frame, place, problem.frame.geodetic)[0, 2])


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _limits(text: str, problem: Problem) -> tuple[float, float, float, float]:
    """Return the limits of a map; raise InvalidProblem where they are none."""
    try:
        x0, x1, y0, y1 = (float(part) for part in text.split(","))
    except ValueError:
        x0 = x1 = y0 = y1 = float("nan")
    earth = problem.frame.geodetic and problem.dimension == 3
    fits = not earth or (-360.0 <= x0 and x1 <= 540.0 and x1 - x0 <= 360.0 and y0 >= -90.0 and y1 <= 90.0)
    if not (x0 < x1 and y0 < y1 and np.isfinite([x0, x1, y0, y1]).all() and fits):
        advice = "write west,east,south,north in degrees" if earth else "write least x, greatest x, least y, greatest y"
        raise InvalidProblem(f"{text!r} is no extent of a map", "--extent", advice)
    return x0, x1, y0, y1


def _write(found: BoundMap, out: Path, title: str, *, dilution: bool) -> None:
    from optloc.plot.bound_map import map_geojson, plot_bound_map

    ending = out.suffix.lower()
    if ending in _PICTURES:
        saved(plot_bound_map(found, title, dilution=dilution), out)
        return
    if dilution:
        raise InvalidProblem("the dilution is drawn as a picture only", str(out), "use .png, .svg or .pdf")
    if ending == ".geojson":
        write_text(out, dumps(map_geojson(found)))
        return
    from optloc.report import map_page

    write_text(out, map_page(found, title))

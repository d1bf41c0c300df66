"""What ``optloc crlb`` and ``optloc simulate`` do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.bounds import Course
from optloc.cli.course import course_records, course_table, courses, shown
from optloc.cli.output import dumps, saved, write_text
from optloc.ellipse import error_ellipse
from optloc.epochs import by_epoch, separable
from optloc.errors import InvalidProblem
from optloc.files import Loaded, read
from optloc.layout import Slot, state_names
from optloc.problem import Problem
from optloc.types import Array


def run_crlb(
    file: Path,
    at: str | None,
    velocity: str | None,
    *,
    geodetic: bool,
    as_json: bool,
    plot: Path | None = None,
    quiet: bool = False,
) -> int:
    """Print the Cramer-Rao bound at a truth or at the fix, draw it against time, and return the exit code."""
    from optloc.bounds import crlb

    loaded = read(file, values=False)
    problem = by_epoch(loaded.problem) if separable(loaded.problem) else loaded.problem
    truth = _fixed(file) if at is None and _sought(problem) else vector(problem, at, velocity, geodetic)
    bound = np.asarray(crlb(problem, truth))
    bound = np.broadcast_to(bound, (*problem.batch_shape, *bound.shape[-2:])).reshape(-1, *bound.shape[-2:])
    labels = loaded.epochs if problem.batch_shape else ("run" if loaded.problem.epochs > 1 else loaded.epochs[0],)
    rows = [
        _bound(label, slot, cov[slot.start : slot.start + slot.size, slot.start : slot.start + slot.size])
        for label, cov in zip(labels, bound, strict=True)
        for slot in problem.layout.shared
    ]
    over_time = courses(problem, truth)
    if plot is not None:
        _draw(plot, loaded, over_time)
    if as_json:
        course = [] if over_time is None else course_records(*over_time)
        write_text(Path("-"), dumps({"file": loaded.source, "bounds": rows, "course": course}))
    elif not quiet:
        console = Console()
        console.print(_bound_table(loaded, rows))
        if over_time is not None:
            console.print(course_table(*over_time))
    return 0 if all(np.isfinite(row["sigma"]).all() for row in rows) and rows else 1


def _sought(problem: Problem) -> bool:
    """Return whether the position of some target is unknown, so that it matters where it is."""
    return any(motion.known is None for motion in problem.motions)


def _fixed(file: Path) -> Array:
    """Return the fix of a file that has measured values."""
    from optloc.solve import solve

    problem = read(file).problem
    return solve(problem).x


def _draw(path: Path, loaded: Loaded, over_time: tuple[Course, Course | None] | None) -> None:
    from optloc.plot import plot_course

    if over_time is None:
        advice = "give the epochs something in common, a motion or biases, but not hundreds of targets"
        raise InvalidProblem("the epochs share no unknowns, or too many to be drawn", "--plot", advice)
    names = shown(over_time[0].layout)
    saved(plot_course(*over_time, title=f"{loaded.title}: Cramer-Rao bound", names=names), path)


def _bound(label: str, slot: Slot, covariance: Array) -> dict[str, Any]:
    record = {"epoch": label, "unknown": slot.name, "entries": slot.entries, "unit": slot.unit}
    record |= {"sigma": np.sqrt(np.diagonal(covariance))}
    if not slot.name.startswith("position"):
        return record
    return record | {"ellipse95": error_ellipse(covariance)[0][::-1], "covariance": covariance}


def _bound_table(loaded: Loaded, rows: list[dict[str, Any]], limit: int = 30) -> Table:
    table = Table(title=f"{loaded.title}: Cramer-Rao bound", title_justify="left")
    for name in ("epoch", "unknown", "sigma", "95 % ellipse, m (semi-axes)"):
        table.add_column(name)
    for row in rows[:limit]:
        ellipse = ", ".join(f"{v:.4g}" for v in row.get("ellipse95", ()))
        table.add_row(row["epoch"], row["unknown"], _sigmas(row), ellipse)
    if len(rows) > limit:
        table.add_row("...", "", f"{len(rows) - limit} more", "--json prints all")
    return table


def _sigmas(row: dict[str, Any], limit: int = 16) -> str:
    """Return standard deviations in a line, those of members one below the other."""
    if set(row["entries"]) <= set("xyz"):
        return f"{', '.join(f'{v:.4g}' for v in row['sigma'])} {row['unit']}"
    named = zip(row["entries"][:limit], row["sigma"], strict=False)
    lines = [f"{entry}: {v:.4g} {row['unit']}".strip(": ") for entry, v in named]
    return "\n".join(
        [*lines, *([f"... and {len(row['entries']) - limit} more"] if len(row["entries"]) > limit else [])]
    )


def vector(problem: Problem, position: str | None, velocity: str | None, geodetic: bool) -> Array:
    """Return the true parameter vector of targets at a position; biases have their prior means, the rest is zero."""
    place = None if position is None else _coordinates(position, "position")
    if geodetic and place is not None:
        if not problem.frame.geodetic or len(place) != 3:
            raise InvalidProblem(
                "latitude, longitude and height need a geodetic frame and three numbers", "--geodetic", "leave it out"
            )
        place = problem.frame.from_geodetic(np.radians(place[0]), np.radians(place[1]), place[2])[: problem.dimension]
    values = {"position": place, "velocity": None if velocity is None else _coordinates(velocity, "--velocity")}
    layout = problem.layout
    shared, local = np.zeros(layout.n_shared), np.zeros((problem.epochs, layout.n_local))
    for i, motion in enumerate(problem.motions):
        if motion.known is not None:
            continue
        for name in state_names(i, len(problem.motions), motion.order):
            value = values.get(name.partition("[")[0])
            if value is None:
                continue
            if len(value) != problem.dimension:
                raise InvalidProblem(
                    f"{len(value)} coordinates do not fit {problem.dimension} dimensions", name, "give one each"
                )
            slot, is_shared = layout.find(name)
            (shared if is_shared else local)[..., slot.start : slot.start + slot.size] = value
    for bias in problem.biases:
        if bias.sigma is not None:
            slot, _ = layout.find(bias.name)
            shared[slot.start : slot.start + slot.size] = np.ravel(bias.mean)
    if velocity is not None and all(motion.order == 0 for motion in problem.motions):
        raise InvalidProblem(
            "the target of this file does not move", "--velocity", 'write motion = "constant_velocity"'
        )
    return np.concatenate([shared, local.ravel()])


def _coordinates(text: str, where: str) -> Array:
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.array([np.nan])
    if not np.isfinite(values).all():
        raise InvalidProblem(f"{text!r} is no list of numbers", where, "write them as 1200,800,50")
    return values


def run_simulate(
    file: Path, truth: str, velocity: str | None, out: Path, *, geodetic: bool, seed: int, trials: int, quiet: bool
) -> int:
    """Draw measurements, write them as a problem file, and return the exit code."""
    from tempfile import TemporaryDirectory

    from optloc.evaluate import predict
    from optloc.files.writer import write_measured
    from optloc.simulate import simulate

    problem = read(file, values=False).problem
    x = vector(problem, truth, velocity, geodetic)
    with TemporaryDirectory() as folder:  # a spread in decibels depends on the values
        exact, *_ = write_measured(file, Path(folder) / out.name, np.atleast_2d(predict(problem, x)), note="")
        drawn = simulate(read(exact).problem, x, seed, trials)
    z = np.concatenate([rows.z for rows in drawn.rows], axis=-1)
    written = write_measured(file, out, z, note=f"drawn at {truth} with seed {seed}")
    if not quiet:
        Console().print(
            f"{trials} trial(s) of {z.shape[-1]} rows are in {', '.join(str(p) for p in written)}.", highlight=False
        )
    return 0

"""What ``optloc crlb`` and ``optloc simulate`` do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.cli.output import dumps, write_text
from optloc.ellipse import error_ellipse
from optloc.epochs import by_epoch, separable
from optloc.errors import InvalidProblem
from optloc.files import Loaded, read
from optloc.layout import state_names
from optloc.problem import Problem
from optloc.types import Array


def run_crlb(file: Path, at: str | None, velocity: str | None, *, geodetic: bool, as_json: bool) -> int:
    """Print the Cramer-Rao bound at a truth or at the fix, and return the exit code."""
    from optloc.bounds import crlb

    loaded = read(file, values=at is None)
    problem = by_epoch(loaded.problem) if separable(loaded.problem) else loaded.problem
    if at is None:
        from optloc.solve import solve

        truth = solve(loaded.problem).x
    else:
        truth = vector(problem, at, velocity, geodetic)
    bound = np.asarray(crlb(problem, truth))
    bound = np.broadcast_to(bound, (*problem.batch_shape, *bound.shape[-2:]))
    labels = loaded.epochs if problem.batch_shape else ("run" if loaded.problem.epochs > 1 else loaded.epochs[0],)
    slots = [slot for slot in problem.layout.shared if slot.name.partition("[")[0] == "position"]
    rows = [
        _bound(label, slot.name, cov[slot.start : slot.start + slot.size, slot.start : slot.start + slot.size])
        for label, cov in zip(labels, bound.reshape(-1, *bound.shape[-2:]), strict=True)
        for slot in slots
    ]
    if as_json:
        write_text(Path("-"), dumps({"file": loaded.source, "bounds": rows}))
    else:
        Console().print(_bound_table(loaded, rows))
    return 0 if all(np.isfinite(row["sigma"]).all() for row in rows) and rows else 1


def _bound(label: str, name: str, covariance: Array) -> dict[str, Any]:
    semi_axes, _ = error_ellipse(covariance)
    sigma = np.sqrt(np.diagonal(covariance))
    return {"epoch": label, "unknown": name, "sigma": sigma, "ellipse95": semi_axes[::-1], "covariance": covariance}


def _bound_table(loaded: Loaded, rows: list[dict[str, Any]], limit: int = 30) -> Table:
    table = Table(title=f"{loaded.title}: Cramer-Rao bound", title_justify="left")
    for name in ("epoch", "unknown", "sigma, m", "95 % ellipse, m (semi-axes)"):
        table.add_column(name)
    for row in rows[:limit]:
        numbers = [", ".join(f"{v:.4g}" for v in row[key]) for key in ("sigma", "ellipse95")]
        table.add_row(row["epoch"], row["unknown"], *numbers)
    if len(rows) > limit:
        table.add_row("...", "", f"{len(rows) - limit} more", "--json prints all")
    return table


def vector(problem: Problem, position: str, velocity: str | None, geodetic: bool) -> Array:
    """Return the true parameter vector of targets at a position; every other unknown is zero."""
    place = _coordinates(position, "position")
    if geodetic:
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
    from optloc.files.writer import write_measured
    from optloc.simulate import simulate

    loaded = read(file, values=False)
    drawn = simulate(loaded.problem, vector(loaded.problem, truth, velocity, geodetic), seed, trials)
    z = np.concatenate([rows.z for rows in drawn.rows], axis=-1)
    written = write_measured(file, out, z, note=f"drawn at {truth} with seed {seed}")
    if not quiet:
        Console().print(
            f"{trials} trial(s) of {z.shape[-1]} rows are in {', '.join(str(p) for p in written)}.", highlight=False
        )
    return 0

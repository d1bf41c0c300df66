"""The Cramer-Rao bound of a run against time, as a table and as records."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table

from optloc.bounds import Course, crlb_course
from optloc.epochs import tied
from optloc.layout import Layout, Slot
from optloc.problem import Problem
from optloc.types import Array

_LINES, _POINTS, _UNKNOWNS = 10, 400, 100
_RMS = {True: " (rms)", False: ""}


def courses(problem: Problem, truth: Array) -> tuple[Course, Course | None] | None:
    """Return the bound against time with biases unknown and, if there are some, known; None where it has none."""
    n, k = problem.layout.n_shared, problem.epochs
    if k == 1 or not 0 < n <= _UNKNOWNS or tied(problem) or problem.batch_shape:
        return None
    counts = np.arange(1, k + 1) if k <= _POINTS else np.unique(np.geomspace(1, k, _POINTS).round().astype(int))
    names = [slot.name for slot in problem.layout.shared if slot.members]
    course = crlb_course(problem, truth, counts)
    targets = len(names) < len(problem.layout.shared)
    return course, crlb_course(problem, truth, counts, known=names) if names and targets else None


def course_records(course: Course, known: Course | None) -> list[dict[str, Any]]:
    """Return the bound at a few times: epochs, time, sigma of every unknown by name, and with biases known."""
    labels = course.layout.labels()
    return [
        {
            "epochs": int(course.counts[i]),
            "time": float(course.times[i]),
            "sigma": dict(zip(labels, _sigmas(course, i), strict=True)),
            "biases_known": None if known is None else dict(zip(labels, _sigmas(known, i), strict=True)),
        }
        for i in _few(course)
    ]


def _sigmas(course: Course, i: int) -> Array:
    return np.asarray(np.sqrt(np.diagonal(course.covariance[i])))


def _few(course: Course) -> list[int]:
    """Return the places of a few times, closer together at the start."""
    wanted = np.geomspace(1, course.counts[-1], _LINES)
    return [int(i) for i in np.unique(np.searchsorted(course.counts, np.floor(wanted)))]


def shown(layout: Layout) -> tuple[str, ...]:
    """Return the names of the unknowns that a table or a picture has room for: of two targets, and four biases."""
    states = [slot.name for slot in layout.shared if not slot.members]
    biases = [slot.name for slot in layout.shared if slot.members]
    return (*states[:4], *biases[:4])


def course_table(course: Course, known: Course | None) -> Table:
    """Return the bound at a few times, as root sum of squares over coordinates and root mean square over members."""
    table = Table(title="Bound after the first epochs", title_justify="left")
    for name in ("epochs", "time, s"):
        table.add_column(name, justify="right")
    columns: list[tuple[Course, Slot]] = []
    for slot in (course.layout.find(name)[0] for name in shown(course.layout)):
        table.add_column(f"{slot.name}{_RMS[bool(slot.members)]}, {slot.unit}".rstrip(", "), justify="right")
        columns.append((course, slot))
        if known is not None and not slot.members:
            table.add_column("biases known", justify="right")
            columns.append((known, slot))
    values = [which.total(slot.name) / np.sqrt(slot.size if slot.members else 1) for which, slot in columns]
    for i in _few(course):
        numbers = [f"{value[i]:.4g}" if np.isfinite(value[i]) else "-" for value in values]
        table.add_row(str(course.counts[i]), f"{course.times[i]:g}", *numbers)
    return table

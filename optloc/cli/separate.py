"""The command ``optloc separate``: assign rows to several emitters, and locate the emitters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Status
from optloc.cli.crlb import vector
from optloc.cli.output import Screen, dumps, show_answer, write_text
from optloc.files.reader import Loaded, read
from optloc.multi_target.answer import Emitters, evenly
from optloc.multi_target.assign import separate
from optloc.problem.problem import Problem
from optloc.show.describe_emitters import answer_of_emitters

# Largest number of digits for a number of emitters; no file has more rows.
_DIGITS = 12


def run_separate(
    file: Path,
    detection: float,
    false: float,
    emitters: str,
    region: str | None,
    *,
    as_json: bool = False,
    quiet: bool = False,
) -> int:
    """Separate the emitters of each epoch of a file; return exit code 1 if a status is not ok.

    `detection` is the probability that an emitter gives a row in a channel. `false` is the mean number of false rows in
    a channel and epoch. `emitters` is their number as text, or "auto". `region` is the search region as text.
    """
    loaded = read(file)
    problem = loaded.problem
    clutter = evenly(problem, detection, false)
    found = separate(problem, clutter, count=_count(emitters, problem.count), region=_region(problem, region))
    # Epochs without rows have no answer, so leave out their labels.
    labels = [loaded.epochs[k] for k in np.unique(problem.epoch)]
    if as_json:
        epochs = [{"epoch": label, **_record(loaded, one)} for label, one in zip(labels, found, strict=True)]
        write_text(Path("-"), dumps({"file": loaded.source, "title": loaded.title, "epochs": epochs}))
    elif not quiet:
        for label, one in zip(labels, found, strict=True):
            title = f"{loaded.title} {label if len(labels) > 1 else ''}".strip()
            show_answer(answer_of_emitters(one, title), Screen())
    return 0 if all(one.status == Status.OK for one in found) else 1


def _count(text: str, rows: int) -> int | None:
    """Return the number of emitters from the text of the option; None for "auto".

    Raise InvalidProblem for another text, or for more emitters than `rows`, the number of rows.
    """
    if text == "auto":
        return None
    if not (text.isascii() and text.isdigit() and len(text) < _DIGITS and int(text) <= rows):
        what = f"{text!r} is not a number of emitters up to the {rows} rows of the file"
        raise InvalidProblem(what, "--emitters", "give a whole number, or auto")
    return int(text)


def _region(problem: Problem, text: str | None) -> tuple[Any, Any] | None:
    """Return the least and the greatest coordinates (d,) of the search region, m; None without a region."""
    if text is None:
        return None
    lower, colon, upper = text.partition(":")
    if not colon:
        raise InvalidProblem(f"{text!r} is not a region", "--region", "give LOW:HIGH, such as 0,0:2000,3000")
    # Parse a corner as a position, with the same units and errors.
    return vector(problem, lower, None, False), vector(problem, upper, None, False)


def _record(loaded: Loaded, found: Emitters) -> dict[str, Any]:
    """Return the emitters of an epoch as a JSON value: metres, costs as chi-square.

    A ghost is a position that is not an emitter in the best assignment of rows, but in another assignment with about
    the same cost.
    """
    return {
        "status": found.status.label,
        "sentence": found.status.sentence,
        "reason": found.reason,
        "cost": found.cost,
        "bound": found.bound,
        "gap": found.gap,
        "margin": found.margin,
        "costs_of_numbers": found.costs,
        "emitters": [
            {
                "position": fix.position,
                "covariance": fix.covariance(),
                "status": Status(int(fix.code)).label,
                "chi2": fix.cost,
                "rows": _names(loaded, found.rows(i)),
            }
            for i, fix in enumerate(found.fixes)
        ],
        "ghosts": [
            {"position": ghost.position, "gap": ghost.gap, "rows": _names(loaded, ghost.rows)} for ghost in found.ghosts
        ],
        "assignment": found.assignment,
    }


def _names(loaded: Loaded, wanted: Any) -> list[str]:
    """Return the rows with the numbers `wanted` as text: kind, stations and row number."""
    stations, words = loaded.problem.stations.names, list[str]()
    for block, start in zip(loaded.problem.rows, loaded.problem.starts, strict=True):
        for i in np.asarray(wanted)[(np.asarray(wanted) >= start) & (np.asarray(wanted) < start + block.count)]:
            ends = [stations[k] for k in (block.a[i - start], block.b[i - start]) if k >= 0]
            words.append(f"{block.kind} {' - '.join(ends)} (row {int(i)})")
    return words

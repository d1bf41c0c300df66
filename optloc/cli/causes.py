"""Advice under a table: why fixes of a file are not ok, and the lines that would help."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Console

from optloc.adequacy.advice import advise, advise_at
from optloc.adequacy.geometry import Advice
from optloc.base.types import Array, Status
from optloc.cli.file_fixes import FileFixes
from optloc.cli.output import say
from optloc.problem.problem import Problem


def advice_for_fixes(found: FileFixes) -> tuple[Advice, ...]:
    """Return the advice for all fixes of a file together; nothing where every one is ok."""
    if all(bool((fix.code == Status.OK).all()) for fix in found.fixes):
        return ()
    problem = found.loaded.problem
    if not found.fixes[0].shape:
        return tuple(advise(problem, found.fixes[0]))
    return advice_for_vectors(problem, np.concatenate([fix.x for fix in found.fixes]))


def advice_for_vectors(problem: Problem, vectors: Array | None) -> tuple[Advice, ...]:
    """Return the advice for a problem at the vectors (k, size) of its epochs, or without any."""
    return advise_at(problem, np.full((1, problem.layout.size), np.nan) if vectors is None else vectors)


def advice_json(found: tuple[Advice, ...]) -> list[dict[str, Any]]:
    """Return advice as a JSON value."""
    return [asdict(one) for one in found]


def show_advice(found: tuple[Advice, ...], console: Console) -> None:
    """Print what is seen and what helps, the lines of a problem file below it as they are to be copied."""
    if not found:
        return
    say(console, "Advice")
    for one in found:
        say(console, f"  {one.seen[0].upper()}{one.seen[1:]}.")
        say(console, f"  {one.advice[0].upper()}{one.advice[1:]}{':' if one.toml else '.'}")
        for line in one.toml.splitlines():
            say(console, f"      {line}")

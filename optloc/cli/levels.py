"""Noise from data for people and machines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.errors import InvalidProblem, nearest
from optloc.files import Loaded
from optloc.quality.groups import GROUPINGS, By
from optloc.quality.levels import NoiseLevels, with_estimated_noise


def noised(loaded: Loaded, by: str | None) -> Loaded:
    """Return a file's problem with its noise estimated for each station, pair or kind; unchanged where not asked."""
    if by is None:
        return loaded
    if by not in GROUPINGS:
        raise InvalidProblem(f"unknown grouping {by!r}", "--noise-from-data", nearest(by, GROUPINGS))
    problem, levels = with_estimated_noise(loaded.problem, cast("By", by))
    return replace(loaded, problem=problem, levels=levels)


def levels_json(levels: NoiseLevels) -> dict[str, Any]:
    """Return noise levels as one JSON value, SI units."""
    columns = {"name": levels.names, "sigma": levels.sigma, "sigma_error": levels.sigma_error}
    columns |= {"stated": levels.stated, "redundancy": levels.redundancy, "count": levels.count, "gross": levels.gross}
    return {
        "by": levels.by,
        "levels": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
        "fixes": levels.fixes,
        "chi_square_stated": levels.before,
        "chi_square": levels.after,
        "sentences": list(levels.sentences),
    }


def show_levels(levels: NoiseLevels, console: Console) -> None:
    """Print noise levels as a table."""
    table = Table(title=f"Noise from data, by {levels.by}", title_justify="left")
    table.add_column(levels.by)
    for name in ("sigma, SI", "stated", "redundancy", "errors", "gross"):
        table.add_column(name, justify="right")
    for i, name in enumerate(levels.names):
        told = np.isfinite(levels.error[i])
        sigma = f"{levels.sigma[i]:.3g} ± {levels.sigma_error[i]:.2g}" if told else "not told"
        cells = (f"{levels.stated[i]:.3g}", f"{levels.redundancy[i]:.0%}", str(levels.count[i]), str(levels.gross[i]))
        table.add_row(name, sigma, *cells)
    console.print(table)
    for sentence in levels.sentences:
        console.print(f"{sentence[0].upper()}{sentence[1:]}.", highlight=False, markup=False, soft_wrap=True)

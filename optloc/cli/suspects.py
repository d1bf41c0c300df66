"""Suspects as a table for people: who, by how much, and on what evidence."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.cli.output import explanations_of
from optloc.fix import Fix
from optloc.suspects import Suspect

_EXPLANATIONS, _SUSPECTS = 8, 12


def show_suspects(fix: Fix, console: Console) -> None:
    """Print what explains the data of a single fix that contradict each other; nothing where they agree."""
    found = explanations_of(fix)
    if not found:
        return
    title = "Left out" if len(found) == 1 else f"{len(found)} explanations: the first was taken"
    table = Table(title=title, title_justify="left")
    for name in ("#", "suspect", "error", "p with", "p without"):
        table.add_column(name, justify="left" if name == "suspect" else "right")
    for i, explanation in enumerate(found[:_EXPLANATIONS]):
        for j, suspect in enumerate(explanation.suspects[:_SUSPECTS]):
            label = str(i + 1) if j == 0 else ""
            table.add_row(label, suspect.name, _error(suspect), _p(suspect.p_with), _p(suspect.p_without))
        if len(explanation.suspects) > _SUSPECTS:
            table.add_row("", f"and {len(explanation.suspects) - _SUSPECTS} more", "", "", "")
    if len(found) > _EXPLANATIONS:
        table.add_row("", f"and {len(found) - _EXPLANATIONS} more explanations", "", "", "")
    console.print(table)


def _error(suspect: Suspect) -> str:
    """Return the errors of a suspect, each with its standard deviation."""
    pairs = [f"{e:+.3g} ± {s:.2g}" for e, s in zip(suspect.error, suspect.sigma, strict=True) if np.isfinite(s)]
    return ", ".join(pairs[:3]) + (" ..." if len(pairs) > 3 else "") if pairs else "not told"


def _p(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2g}"

"""Biases of a registration as records, and as tables for people."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.cli.numbers import with_sigma
from optloc.fix import Fix
from optloc.observe import Observability

_LONG = 40


def bias_records(fix: Fix, seen: Observability | None) -> list[dict[str, Any]]:
    """Return one record for each bias of a single fix: name, member, value, sigma, unit, from_data.

    Parameters
    ----------
    fix : Fix
        A single fix.
    seen : Observability, optional
        What its data show.
    """
    records = []
    for slot in fix.layout.shared:
        if not slot.members:
            continue
        values, sigmas = fix.take(slot.name), fix.sigma(slot.name)
        shares = np.full(slot.size, np.nan) if seen is None else seen.from_data[slot.start : slot.start + slot.size]
        for member, value, sigma, share in zip(slot.entries, values, sigmas, shares, strict=True):
            record = {"name": slot.name, "member": member, "value": float(value), "sigma": float(sigma)}
            records.append(record | {"unit": slot.unit, "from_data": float(share)})
    return records


def show_biases(fix: Fix, seen: Observability | None, console: Console) -> None:
    """Print the biases of a single fix, and what cannot be told apart; nothing where there is none."""
    records = bias_records(fix, seen) if np.isfinite(fix.x).all() else []
    if records:
        console.print(_table(records))
    for sentence in () if seen is None else seen.sentences:
        console.print(f"{sentence[0].upper()}{sentence[1:]}.", highlight=False, markup=False, soft_wrap=True)


def _table(records: list[dict[str, Any]]) -> Table:
    table = Table(title="Biases", title_justify="left")
    for name in ("name", "member", "estimate", "from data"):
        table.add_column(name, justify="right" if name == "from data" else "left")
    for record in records[:_LONG]:
        share = f"{100.0 * record['from_data']:.3g} %" if np.isfinite(record["from_data"]) else "-"
        estimate = with_sigma(record["value"], record["sigma"], record["unit"]).strip()
        table.add_row(record["name"], record["member"], estimate, share)
    if len(records) > _LONG:
        table.add_row("...", f"{len(records) - _LONG} more", "--json prints all", "")
    return table

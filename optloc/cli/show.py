"""Fixes as tables for people."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from optloc.cli.biases import show_biases
from optloc.cli.columns import Columns
from optloc.cli.fixing import Fixed
from optloc.cli.numbers import with_sigma
from optloc.cli.output import active_of, alternative_position
from optloc.cli.suspects import show_suspects
from optloc.fix import Fix
from optloc.status import Status

_GOOD, _CARE, _BAD = "green", "yellow", "red"


def show(fixed: Fixed, console: Console) -> None:
    """Print fixes: one in full, a few of a run below each other, many as a count by status."""
    rows = len(next(iter(fixed.columns.values())))
    first = fixed.fixes[0]
    if rows == 1:
        _one(fixed, first[0] if first.shape else first, console)
    elif not first.shape:
        _one(fixed, first, console)
    else:
        _many(fixed, console)


def _one(fixed: Fixed, fix: Fix, console: Console) -> None:
    verdict = Status(int(fix.code))
    table = Table(title=fixed.loaded.title, show_header=False, title_justify="left", min_width=60)
    table.add_row("status", Text(verdict.label, style=f"bold {_colour(verdict)}"))
    reason = str(fix.reason[()] or "")
    table.add_row("", verdict.sentence if verdict is not Status.OK or not reason else reason)
    if verdict is not Status.OK and reason:
        table.add_row("reason", reason)
    rows = len(fixed.columns["x"])
    for i in range(min(rows, 12)):
        _state_rows(table, fixed.columns, i, _whose(fixed.columns, i) if rows > 1 else "")
    if rows > 12:
        table.add_row("...", f"{rows - 12} more; --out writes all of them")
    for name, values in fix.bias.items():
        slot, shared = fix.layout.find(name)
        if not shared:
            spread = np.sqrt(np.mean(values**2))
            table.add_row(name, f"{values.size} values, root mean square {spread:.4g} {slot.unit}".strip())
    for active in active_of(fix):
        table.add_row(f"held by {active.name}", f"multiplier {active.multiplier:.4g} (cost per SI unit)")
    table.add_row("chi-square", _chi_square(fix))
    certificate: Any = fix.certificate[()]
    if hasattr(certificate, "proof"):
        table.add_row("certificate", f"{certificate.proof}: {certificate.reason}")
    table.add_row("stages", " → ".join(stage.name for stage in fix.stages) or "none")
    console.print(table)
    show_biases(fix, fixed.seen, console)
    show_suspects(fix, console)
    _alternatives(fix, console)


def _colour(verdict: Status) -> str:
    return {Status.OK: _GOOD, Status.AMBIGUOUS: _CARE, Status.SEARCHED: _CARE}.get(verdict, _BAD)


def _whose(columns: Columns, i: int) -> str:
    """Return whose state a row is where there are several."""
    several = len(set(columns["target"].tolist())) > 1
    epoch = f" at {columns['epoch'][i]}" if columns["epoch"][i] != "run" else ""
    return (f" of {columns['target'][i]}" if several else "") + epoch


def _state_rows(table: Table, columns: Columns, i: int, whose: str) -> None:
    if not np.isfinite(columns["x"][i]):
        return
    axes = [axis for axis in "xyz" if axis in columns]
    for axis in axes:
        table.add_row(f"{axis}{whose}", with_sigma(columns[axis][i], columns[f"sigma_{axis}"][i], "m"))
    if "lat_deg" in columns:
        table.add_row(f"latitude{whose}", f"{columns['lat_deg'][i]:.7f} deg")
        table.add_row(f"longitude{whose}", f"{columns['lon_deg'][i]:.7f} deg")
        table.add_row(f"height{whose}", f"{columns['height'][i]:.2f} m")
        local = [columns[f"cov_{axis}{axis}"][i] for axis in "enu" if f"cov_{axis}{axis}" in columns]
        table.add_row("sigma east, north, up", ", ".join(f"{v:.3g}" for v in np.sqrt(np.maximum(local, 0.0))) + " m")
    for letter, word, unit in (("v", "velocity", "m/s"), ("a", "acceleration", "m/s²")):
        found = [axis for axis in axes if f"{letter}{axis}" in columns]
        for axis in found:
            value, sigma = (columns[f"{prefix}{letter}{axis}"][i] for prefix in ("", "sigma_"))
            table.add_row(f"{word} {axis}{whose}", with_sigma(value, sigma, unit))
    semi = [columns[f"ellipse95_{j + 1}"][i] for j in range(len(axes))]
    if np.isfinite(semi).all():
        table.add_row(
            "95 % ellipse" if len(axes) == 2 else "95 % ellipsoid",
            " x ".join(f"{v:.3g}" for v in semi) + " m (semi-axes)",
        )


def _chi_square(fix: Fix) -> str:
    if int(fix.dof) <= 0 or not np.isfinite(fix.cost):
        return "no redundancy: nothing to test"
    p = float(fix.p_value)
    warning = "; the residuals are larger than the stated noise" if p < 1e-3 else ""
    return f"{float(fix.cost):.4g} with {int(fix.dof)} degrees of freedom, p = {p:.3g}{warning}"


def _alternatives(fix: Fix, console: Console) -> None:
    found = np.isfinite(fix.alternatives.gap)
    if not found.any():
        return
    table = Table(title="Alternatives", title_justify="left")
    for name in ("#", "position, m", "cost gap", "probability"):
        table.add_column(name, justify="right")
    others = (fix.alternatives.x[found], fix.alternatives.gap[found], fix.alternatives.doubt[found])
    for i, (x, gap, doubt) in enumerate(zip(*others, strict=True)):
        point = ", ".join(f"{v:.1f}" for v in np.ravel(alternative_position(fix, x))[:6])
        table.add_row(str(i + 1), point, f"{gap:.4g}" if gap >= 1e-3 else "0", f"{doubt:.2g}")
    console.print(table)


def _many(fixed: Fixed, console: Console) -> None:
    columns = fixed.columns
    table = Table(title=f"{fixed.loaded.title}: {len(columns['x'])} fixes", title_justify="left")
    table.add_column("status")
    for name in ("fixes", "median sigma, m", "95 % of sigmas, m", "median p"):
        table.add_column(name, justify="right")
    sigma = np.sqrt(sum(columns[f"sigma_{axis}"] ** 2 for axis in "xyz" if axis in columns))
    for label, count in Counter(columns["status"].tolist()).most_common():
        inside = columns["status"] == label
        cells = [
            _quantile(sigma[inside], 0.5),
            _quantile(sigma[inside], 0.95),
            _quantile(columns["p_value"][inside], 0.5),
        ]
        table.add_row(Text(label, style=_colour(Status[label.upper().replace(" ", "_")])), str(count), *cells)
    console.print(table)
    _failures(columns, console)


def _quantile(values: Any, share: float) -> str:
    finite = values[np.isfinite(values)]
    return f"{np.quantile(finite, share):.3g}" if len(finite) else "-"


def _failures(columns: Columns, console: Console, limit: int = 10) -> None:
    bad = np.flatnonzero(columns["status"] != Status.OK.label)
    for i in bad[:limit]:
        console.print(
            f"epoch {columns['epoch'][i]}: {columns['status'][i]}: {columns['reason'][i]}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    if len(bad) > limit:
        console.print(f"... and {len(bad) - limit} more; --out writes all of them", highlight=False)

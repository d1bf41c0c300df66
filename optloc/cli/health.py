"""Health of stations for people and machines: made from a file's fixes while a bar moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.cli.columns import Columns
from optloc.cli.fixing import CHUNK, bar
from optloc.cli.numbers import with_sigma
from optloc.epochs import separable
from optloc.errors import InvalidProblem
from optloc.files import Loaded
from optloc.quality.elements import batch_of
from optloc.quality.groups import By
from optloc.quality.health import Health, health_of
from optloc.types import Array


@dataclass(frozen=True, slots=True)
class Checked:
    """Health of the stations of a file, or why there is none."""

    health: Health | None
    why: str = ""


def checked_health(loaded: Loaded, method: str, by: By, quiet: bool) -> Checked:
    """Return the health of the stations of a file, each of whose epochs is fixed by itself."""
    problem = loaded.problem
    if problem.epochs < 2:
        return Checked(None, "station health needs several epochs, and the file has one")
    calibrating = all(motion.known is not None for motion in problem.motions)
    if not separable(problem) and not (calibrating and not problem.biases):
        return Checked(None, "station health needs epochs that are fixed one by one, and these share unknowns")
    if not np.isfinite(problem.z[problem.weight > 0.0]).all():
        return Checked(None, "station health needs measured values")
    try:
        return Checked(_made(loaded, method, by, quiet))
    except InvalidProblem as error:
        if error.where in ("by", "method"):
            raise
        return Checked(None, f"station health could not be told: {error}".removesuffix("."))


def _made(loaded: Loaded, method: str, by: By, quiet: bool) -> Health:
    from optloc.solve import solve

    batch = batch_of(loaded.problem)
    count = batch.batch_shape[0]
    vectors, explained = np.full((count, batch.layout.size), np.nan), np.full(count, None, dtype=object)
    if not batch.layout.size:
        return health_of(batch, (np.arange(count), np.zeros((count, 0))), by)
    with bar(loaded.title, count, quiet) as advance:
        for first in range(0, count, CHUNK):
            items = np.arange(first, min(first + CHUNK, count))
            fix = solve(batch.take(items), method)
            vectors[items] = np.where(fix.answered[:, None], fix.x, np.nan)
            found = getattr(fix, "explanations", None)
            explained[items] = None if found is None else found
            advance(len(items))
    kept = np.flatnonzero(np.isfinite(vectors).all(-1))
    if not len(kept):
        raise InvalidProblem("no epoch has a fix", loaded.source, "see `optloc fix` for the reasons")
    asked = any(each is not None for each in explained)
    return health_of(batch, (kept, vectors[kept]), by, explained if asked else None)


def health_columns(health: Health) -> Columns:
    """Return the table of health: one row for each station, SI units and radians, NaN where there is no number."""
    return {
        "name": np.array(health.names, dtype=object),
        "unit": np.array(health.units, dtype=object),
        "count": health.count,
        "bias": health.bias,
        "bias_error": health.bias_error,
        "scale": health.scale,
        "scale_error": health.scale_error,
        "noise": health.noise,
        "noise_error": health.noise_error,
        "outliers": health.outliers,
        "suspect": health.suspect,
    }


def health_json(checked: Checked) -> dict[str, Any]:
    """Return health as one JSON value."""
    if checked.health is None:
        return {"stations": [], "sentences": [checked.why]}
    columns = health_columns(checked.health)
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    levels = checked.health.levels
    noise = {"by": levels.by, "fixes": levels.fixes, "chi_square_stated": levels.before, "chi_square": levels.after}
    return {"stations": rows, "noise": noise, "sentences": list(checked.health.sentences)}


def show_health(checked: Checked, console: Console) -> None:
    """Print health as a table, the largest biases first."""
    health = checked.health
    if health is None:
        console.print(_sentence(checked.why), highlight=False, markup=False, soft_wrap=True)
        return
    scaled, suspected = np.isfinite(health.scale).any(), np.isfinite(health.suspect).any()
    table = Table(title=f"Health by {health.by}", title_justify="left")
    table.add_column(health.by)
    wanted = ["fixes", "bias", *(["scale, ppm"] if scaled else []), "noise", "outliers"]
    for name in [*wanted, *(["suspect"] if suspected else [])]:
        table.add_column(name, justify="right")
    for i in order(health):
        cells = [str(health.count[i]), _told(health.bias[i], health.bias_error[i], health.units[i])]
        cells += [_told(1e6 * health.scale[i], 1e6 * health.scale_error[i], "")] if scaled else []
        cells += [_told(health.noise[i], health.noise_error[i], health.units[i]), f"{health.outliers[i]:.1%}"]
        cells += [f"{health.suspect[i]:.1%}"] if suspected else []
        table.add_row(health.names[i], *cells)
    console.print(table)
    levels = health.levels
    chi = f"chi-square per degree of freedom {levels.before:.3g} with the noise as stated, {levels.after:.3g} as found"
    what = "bias and noise are of measured less predicted by the rest of each fix"
    for sentence in (f"{levels.fixes} fixes; {what}; {chi}", *health.sentences):
        console.print(_sentence(sentence), highlight=False, markup=False, soft_wrap=True)


def order(health: Health) -> Array:
    """Return the groups in the order of their biases, those in one unit together."""
    bias = np.where(np.isfinite(health.bias), health.bias, np.inf)
    return np.lexsort((-bias, np.array(health.units)))


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _told(value: float, error: float, unit: str) -> str:
    if not np.isfinite(value):
        return "-"
    return with_sigma(float(value), float(error), unit).strip()


def draw_health(checked: Checked, title: str, path: Path) -> None:
    """Draw health to a picture file; raise InvalidProblem where there is none or that fails."""
    from optloc.cli.output import saved
    from optloc.plot.health import plot_health

    if checked.health is None:
        raise InvalidProblem(checked.why, "--plot", "leave it out")
    saved(plot_health(checked.health, title=title), path)

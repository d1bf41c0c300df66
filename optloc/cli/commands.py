"""What ``optloc fix`` does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from optloc.cli.fixing import Fixed, fix_file
from optloc.cli.levels import levels_json, noised, show_levels
from optloc.cli.output import dumps, fixed_json, geojson, saved, write_table, write_text
from optloc.cli.show import show
from optloc.errors import InvalidProblem
from optloc.files import read
from optloc.files.schema import ConstraintTable


def run_fix(
    file: Path,
    method: str,
    more: Mapping[str, ConstraintTable],
    *,
    as_json: bool = False,
    geojson_path: Path | None = None,
    plot: Path | None = None,
    out: Path | None = None,
    html: Path | None = None,
    quiet: bool = False,
    noise: str | None = None,
) -> int:
    """Fix a file under constraints of its own and more, write what was asked for, and return the exit code."""
    if as_json and geojson_path is not None and str(geojson_path) == "-":
        raise InvalidProblem("JSON and GeoJSON cannot both go to standard output", "--geojson", "name a file")
    fixed = fix_file(noised(read(file, more=more), noise), method, quiet or as_json)
    if out is not None:
        write_table(out, fixed.columns)
    if geojson_path is not None:
        write_text(geojson_path, dumps(geojson(fixed)))
    if plot is not None:
        draw(fixed, plot)
    if html is not None:
        write_text(html, _map(fixed))
    if as_json:
        levels = fixed.loaded.levels
        noted = {} if levels is None else {"noise": levels_json(levels)}
        write_text(Path("-"), dumps(fixed_json(fixed) | noted))
    elif not quiet:
        console = Console(stderr=geojson_path is not None and str(geojson_path) == "-")
        show(fixed, console)
        if fixed.loaded.levels is not None:
            show_levels(fixed.loaded.levels, console)
    return 0 if fixed.clean else 1


def _map(fixed: Fixed) -> str:
    from optloc.report import fix_page

    loaded = fixed.loaded
    return fix_page(loaded.problem, fixed.fixes, loaded.title, [str(label) for label in fixed.columns["epoch"]])


def draw(fixed: Fixed, path: Path) -> None:
    """Draw fixes to a picture file; raise InvalidProblem where that fails."""
    from optloc.plot import plot_fixes

    saved(plot_fixes(fixed.loaded.problem, fixed.fixes, title=fixed.loaded.title), path)

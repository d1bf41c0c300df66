"""What a fix says in words; the command line, `repr` and notebooks show the same.

A sheet is a table of text with a title. Whoever shows it decides how: `optloc.cli` with colours, `text_of` with spaces,
`html_of` as a notebook has it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from html import escape
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.outputs import visible
from optloc.base.types import NOTES, Array, Status
from optloc.bounds.rank import Observability
from optloc.model_checks.determine import determined, of_fix
from optloc.problem.bias import estimated_speed
from optloc.problem.chart import AXES, CARTESIAN, INVERSE_RANGE, NAMES
from optloc.problem.determined import Determined
from optloc.problem.explanations import Suspect
from optloc.problem.fix import Active, Fix
from optloc.problem.problem import Problem
from optloc.show.columns import (
    RESCALED,
    ROBUST,
    TAILS,
    UNCHECKED,
    Columns,
    active_of,
    alternative_position,
    bias_records,
    explanations_of,
    fix_columns,
    fix_detail,
    level_covariance,
    plain,
    records,
)
from optloc.show.knowledge import has_place, known_rows

# What a coordinate that an equality holds may have as its sigma, as a share of it: rounding.
_HELD = 1e-12
_EARTH = 6.4e6
# A length below this share of another one is rounding: a height that is held has one.
_NOTHING = 1e-6
# What a screen holds of each list; the rest is counted, and tables and JSON have all of it.
SHOWN, _EXPLANATIONS, _SUSPECTS, _BIASES = 12, 8, 12, 40
# p-value below which a misfit is pointed out: one right fix in a thousand.
_UNLIKELY = 1e-3
# A cost gap below this is printed as 0: the two places explain the data equally well.
_NO_GAP = 1e-3
# Signs in a line of text.
_WIDTH = 100


NOT_DETERMINED = "not determined"
"""What is said of an entry that the data leave open, in the place of a number; see `optloc.Fix.undetermined`."""


def with_sigma(value: float, sigma: float, unit: str) -> str:
    """Return a number with its standard deviation, rounded to it; a constraint may leave it none."""
    unit = unit if unit != "1" else ""
    if sigma <= _HELD * (1.0 + abs(value)):
        return f"{value:.10g} {unit} (held)"
    if not np.isfinite(sigma):
        return f"{value:.6g} {unit}"
    # Two digits of the standard deviation, none behind the point of one above 10.
    digits = int(max(0, 1 - np.floor(np.log10(sigma))))
    text = f"{value:.{digits}f}"
    return f"{text if text.strip('-0.') else text.lstrip('-')} ± {sigma:.{digits}f} {unit}"


# In words: one sheet of a fix, and those of its biases, of what was left out and of its alternatives.


class FixSheet(NamedTuple):
    """A table of text: a title, the names of its columns (empty for rows of a label and what it says), its rows."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def fix_sheet(fix: Fix, columns: Columns | None = None, title: str = "") -> FixSheet:
    """Return what a single fix says of itself, a label and a text in each row; the first row is its status.

    Parameters
    ----------
    fix : Fix
        A single fix.
    columns : dict of str to array, optional
        Its table, see `fix_columns`.
    title : str
        What it is of.
    """
    columns = fix_columns(fix) if columns is None else columns
    verdict, reason = Status(int(fix.code)), str(fix.reason[()] or "")
    noted = {Status.TAILS: TAILS, Status.ROBUST: ROBUST, Status.RESCALED: RESCALED}
    notes = [UNCHECKED] * fix.unchecked + [words for note, words in noted.items() if fix.has(note)]
    told = [("status", "; ".join([verdict.label, *notes])), ("", verdict.sentence)]
    told += [("reason", reason)] if reason else []
    others = [one.label for one in fix.findings if one is not verdict and one not in NOTES]
    told += [("besides", ", ".join(others))] if others else []
    # A run may have a state of each epoch: those that fit on a screen.
    rows = len(columns["x"])
    for i in range(min(rows, SHOWN)):
        told += _state(columns, i, whose(columns, i) if rows > 1 else "")
    if rows > SHOWN:
        told.append(("...", f"{rows - SHOWN} more; the table (--out) has all of them"))
    # Errors of single epochs, such as clocks, are too many to list: their size is told.
    for name, values in fix.bias.items():
        slot, shared = fix.layout.find(name)
        if not shared and np.isfinite(values).any():
            spread = np.sqrt(np.nanmean(values**2))
            told.append((name, f"{values.size} values, root mean square {spread:.4g} {slot.unit}".strip()))
    told += [("constraint", _held(active)) for active in active_of(fix)]
    known = known_rows(fix)
    told += known if known and not has_place(fix) else _extents(fix) + known
    told.append(("chi-square", _chi_square(fix)))
    if hasattr(fix.certificate, "proof"):
        told.append(("certificate", f"{fix.certificate.proof}: {fix.certificate.reason}"))
    told.append(("stages", " → ".join(stage.name for stage in fix.stages) or "none"))
    return FixSheet(title, (), told)


def _held(active: Active) -> str:
    """Return what is said of a constraint that holds a fix."""
    if active.name.endswith(" equal"):
        return f"{active.name.removesuffix(' equal')} held as given"
    gain = f"a bound one SI unit farther off lowers the cost by {abs(active.multiplier):.4g}"
    return f"{active.name} bound reached; {gain}"


def whose(columns: Columns, i: int) -> str:
    """Return whose state a row is where there are several."""
    several = "target" in columns and len(set(columns["target"].tolist())) > 1
    epoch = f" at {columns['epoch'][i]}" if "epoch" in columns and columns["epoch"][i] != "run" else ""
    return (f" of {columns['target'][i]}" if several else "") + epoch


def _state(columns: Columns, i: int, whose: str) -> list[tuple[str, str]]:
    """Return what is said of the state of one target at one epoch."""
    if not np.isfinite(columns["x"][i]):
        return []
    axes, lost = [axis for axis in "xyz" if axis in columns], _lost(columns, i)
    numbers = [with_sigma(columns[axis][i], columns[f"sigma_{axis}"][i], "m") for axis in axes]
    told = [(f"{a}{whose}", NOT_DETERMINED if a in lost else text) for a, text in zip(axes, numbers, strict=True)]
    if "lat_deg" in columns:
        lat, lon = f"{columns['lat_deg'][i]:.7f} deg", f"{columns['lon_deg'][i]:.7f} deg"
        told.append((f"latitude{whose}", NOT_DETERMINED if "north" in lost else lat))
        told.append((f"longitude{whose}", NOT_DETERMINED if "east" in lost else lon))
        local = [columns[f"cov_{axis}{axis}"][i] for axis in "enu" if f"cov_{axis}{axis}" in columns]
        held = " (held)" if len(local) == 3 and local[2] < (_HELD * _EARTH) ** 2 else ""
        height = f"{columns['height'][i] + 0.0:.2f} m{held}".replace("-0.00", "0.00")
        told.append((f"height{whose}", NOT_DETERMINED if "up" in lost else height))
        known = [(word, v) for word, v in zip(("east", "north", "up"), local, strict=False) if word not in lost]
        if known:
            sizes = _sizes(np.sqrt(np.maximum([v for _, v in known], 0.0)))
            told.append((f"sigma {', '.join(word for word, _ in known)}", ", ".join(sizes) + " m"))
    for letter, word, unit in (("v", "velocity", "m/s"), ("a", "acceleration", "m/s²")):
        for axis in (axis for axis in axes if f"{letter}{axis}" in columns):
            value, sigma = (columns[f"{prefix}{letter}{axis}"][i] for prefix in ("", "sigma_"))
            text = NOT_DETERMINED if f"{letter}{axis}" in lost else with_sigma(value, sigma, unit)
            told.append((f"{word} {axis}{whose}", text))
    semi = [columns[f"ellipse95_{j + 1}"][i] for j in range(len(axes))]
    if np.isfinite(semi).all() and columns["chart"][i] in {"", NAMES[CARTESIAN]}:
        name = "95 % ellipse" if len(axes) == 2 else "95 % ellipsoid"
        told.append((name, " x ".join(_sizes(semi)) + " m (semi-axes)"))
        if len(columns["x"]) == 1:
            told += _accuracy(level_covariance(columns, i))
    return told


def _lost(columns: Columns, i: int) -> set[str]:
    """Return the names of what is not determined of a row: coordinates, rates, level axes."""
    told = columns["undetermined"][i] if "undetermined" in columns else ""
    return set(told.split("; ")) if isinstance(told, str) else set()


def _sizes(lengths: Iterable[float]) -> list[str]:
    """Return lengths as text; what is rounding beside the largest is 0."""
    known = list(lengths)
    return [f"{v if v > _NOTHING * max(known) else 0.0:.3g}" for v in known]


def _accuracy(covariance: Array) -> list[tuple[str, str]]:
    """Return the radii that data sheets give."""
    from optloc.uncertainty.radii import accuracy

    radii = accuracy(covariance)
    told = [("CEP50, CEP95", f"{radii.cep50:.3g}, {radii.cep95:.3g} m (circles)")]
    if len(covariance) == 3:
        told.append(("SEP50, SEP95", f"{radii.sep50:.3g}, {radii.sep95:.3g} m (spheres)"))
        told.append(("vertical 95 %", f"± {_sizes([float(radii.cep95), float(radii.vertical95)])[1]} m"))
    return told


def _extents(fix: Fix) -> list[tuple[str, str]]:
    """Return what covers where the ellipsoid in metres does not."""
    if fix.chart is None or not fix.answered:
        return []
    if fix.chart.kind == CARTESIAN:
        return _coordinates(fix) if fix.chart.cut_off else []
    if fix.chart.kind != INVERSE_RANGE:
        return [("95 % region", "curved: the numbers behind ± do not cover; optloc.uncertainty.likelihood_region does")]
    low, high = (float(end) for end in fix.interval("range"))
    far = f"to {high:.4g} m" if np.isfinite(high) else "or more, to infinity"
    told = [("95 % range", f"{low:.4g} m {far}, from the middle of the stations")]
    if not fix.frame.geodetic:
        low, high = (float(np.degrees(end)) for end in fix.interval("bearing"))
        told.append(("95 % bearing", f"{low:.4g} to {high:.4g} deg from the first axis towards the second"))
    return told


def _coordinates(fix: Fix) -> list[tuple[str, str]]:
    """Return intervals of the coordinates of a fix whose law bounds cut off: the fix is not in the middle of them."""
    told = []
    for axis in AXES[: fix.position.shape[-1]]:
        low, high = (float(end) for end in fix.interval(axis))
        told.append((f"95 % {axis}", f"{low:.6g} to {high:.6g} m, within the bounds"))
    return told


def _chi_square(fix: Fix) -> str:
    if int(fix.dof) <= 0 or not np.isfinite(fix.cost):
        return "no redundancy: nothing to test"
    p = float(fix.p_value)
    warning = "; the residuals are larger than the stated noise" if p < _UNLIKELY else ""
    return f"{float(fix.cost):.4g} with {int(fix.dof)} degrees of freedom, p = {p:.3g}{warning}"


def bias_sheet(
    fix: Fix, seen: Observability | None = None, unit_of: Callable[[str, str], tuple[str, float]] | None = None
) -> FixSheet | None:
    """Return the biases of a single fix as a sheet; None where there is none.

    Parameters
    ----------
    fix : Fix
        A single fix.
    seen : Observability, optional
        What its data show of its biases.
    unit_of : callable of (name, unit), optional
        Returns the unit that people read a bias in and its SI size.
    """
    records = bias_records(fix, seen) if np.isfinite(fix.x).all() else []
    if not records:
        return None
    rows = []
    for row in records[:_BIASES]:
        share = f"{100.0 * row['from_data']:.3g} %" if np.isfinite(row["from_data"]) else "-"
        unit, size = (row["unit"], 1.0) if unit_of is None else unit_of(row["name"], row["unit"])
        told = with_sigma(row["value"] / size, row["sigma"] / abs(size), unit)
        told = NOT_DETERMINED if row.get("undetermined") else told
        rows.append((row["name"], row["member"], told.strip(), share))
        speed = estimated_speed(row["name"], row["member"], row["value"], row["sigma"])
        if speed is not None and not row.get("undetermined"):
            rows.append((row["name"], "true", with_sigma(*speed, "m/s").strip(), ""))
    if len(records) > _BIASES:
        rows.append(("...", f"{len(records) - _BIASES} more", "--json prints all", ""))
    return FixSheet("Biases", ("name", "member", "estimate", "from data"), rows)


def suspect_sheet(fix: Fix) -> FixSheet | None:
    """Return what explains the data of a single fix that contradict each other; None where they agree."""
    found = explanations_of(fix)
    if not found:
        return None
    title = "Left out" if len(found) == 1 else f"{len(found)} explanations: the first was taken"
    rows = []
    for i, explanation in enumerate(found[:_EXPLANATIONS]):
        for j, suspect in enumerate(explanation.suspects[:_SUSPECTS]):
            label = str(i + 1) if j == 0 else ""
            rows.append((label, suspect.name, _error(suspect), as_p(suspect.p_with), as_p(suspect.p_without)))
        if len(explanation.suspects) > _SUSPECTS:
            rows.append(("", f"and {len(explanation.suspects) - _SUSPECTS} more", "", "", ""))
    if len(found) > _EXPLANATIONS:
        rows.append(("", f"and {len(found) - _EXPLANATIONS} more explanations", "", "", ""))
    return FixSheet(title, ("#", "suspect", "error", "p with", "p without"), rows)


def _error(suspect: Suspect) -> str:
    """Return the errors of a suspect, each with its standard deviation."""
    pairs = [f"{e:+.3g} ± {s:.2g}" for e, s in zip(suspect.error, suspect.sigma, strict=True) if np.isfinite(s)]
    return ", ".join(pairs[:3]) + (" ..." if len(pairs) > 3 else "") if pairs else "not told"


def as_p(value: float) -> str:
    """Return a p-value as people read it, "-" where there is none."""
    return "-" if np.isnan(value) else f"{value:.2g}"


def alternative_sheet(fix: Fix) -> FixSheet | None:
    """Return the other positions that the data of a single fix allow; None where there is none."""
    found = np.isfinite(fix.alternatives.gap)
    if not found.any():
        return None
    others = (fix.alternatives.x[found], fix.alternatives.gap[found], fix.alternatives.doubt[found])
    rows = []
    for i, (x, gap, doubt) in enumerate(zip(*others, strict=True)):
        # Two positions of a pair of targets at the most.
        point = ", ".join(f"{v:.1f}" for v in np.ravel(alternative_position(fix, x))[:6])
        rows.append((str(i + 1), point, f"{gap:.4g}" if gap >= _NO_GAP else "0", f"{doubt:.2g}"))
    return FixSheet("Alternatives", ("#", "position, m", "cost gap", "probability"), rows)


def count_sheet(columns: Columns, title: str) -> FixSheet:
    """Return how many fixes have which status, and how good these are."""
    # One number for the error of a position: the root of the trace of its covariance.
    sigma = np.sqrt(sum(columns[f"sigma_{axis}"] ** 2 for axis in "xyz" if axis in columns))
    rows = []
    for label, count in Counter(columns["status"].tolist()).most_common():
        inside = columns["status"] == label
        # Half of the fixes are better than the median, all but the worst twentieth better than the other.
        shares = ((sigma, 0.5), (sigma, 0.95), (columns["p_value"], 0.5))
        rows.append((label, str(count), *(_quantile(values[inside], share) for values, share in shares)))
    head = ("status", "fixes", "median sigma, m", "95 % of sigmas, m", "median p")
    alone = int(np.asarray(columns["unchecked"], dtype=bool).sum())
    more = f", {alone if alone < len(columns['status']) else 'all'} with {UNCHECKED}" if alone else ""
    return FixSheet(f"{title}{len(columns['status'])} fixes{more}", head, rows)


def _quantile(values: Array, share: float) -> str:
    finite = values[np.isfinite(values)]
    return f"{np.quantile(finite, share):.3g}" if len(finite) else "-"


# A fix by itself, as its methods answer.


def sheets_of(fix: Fix) -> list[FixSheet]:
    """Return all that a fix says; of a batch how many have which status."""
    if fix.shape:
        return [count_sheet(fix_columns(fix), "")] if fix.code.size else [FixSheet("0 fixes", (), [])]
    found = (fix_sheet(fix), bias_sheet(fix), suspect_sheet(fix), alternative_sheet(fix))
    return [sheet for sheet in found if sheet is not None]


def text_of(fix: Fix) -> str:
    """Return a fix as plain text."""
    return "\n".join(line for sheet in sheets_of(fix) for line in _lines(sheet))


def _lines(sheet: FixSheet) -> Iterable[str]:
    """Yield the lines of a sheet: columns that are as wide as their longest cell, the last one wrapped."""
    rows = [[visible(cell) for cell in row] for row in [*([sheet.head] if sheet.head else []), *sheet.rows]]
    if sheet.title:
        yield visible(sheet.title)
    widths = [max(map(len, column)) for column in list(zip(*rows, strict=True))[:-1]]
    indent = sum(widths) + 2 * len(widths)
    for row in rows:
        lead = "".join(f"{cell:{width}}  " for cell, width in zip(row, widths, strict=False))
        width = max(_WIDTH - indent, 30)
        folded = [row[-1]] if len(row[-1]) <= width and row[-1].isprintable() else wrap(row[-1], width) or [""]
        yield (lead + folded[0]).rstrip()
        yield from (" " * indent + line for line in folded[1:])


def html_of(fix: Fix) -> str:
    """Return a fix as HTML tables, every text escaped."""
    parts = []
    for sheet in sheets_of(fix):
        head = "".join(f"<th>{escape(visible(cell))}</th>" for cell in sheet.head)
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(visible(cell))}</td>" for cell in row) + "</tr>" for row in sheet.rows
        )
        title = f"<caption>{escape(visible(sheet.title))}</caption>" if sheet.title else ""
        parts.append(f"<table>{title}{f'<tr>{head}</tr>' if head else ''}{body}</table>")
    return "".join(parts)


def determined_of(fix: Fix) -> Determined | None:
    """Return the `Determined` of a single fix, None without its problem; raise InvalidProblem for a batch."""
    if fix.shape:
        advice = "take one of them: fix[i].determined"
        raise InvalidProblem(f"these are fixes of shape {fix.shape}", "determined", advice)
    source: Any = None if fix.source is None else fix.source[()]
    if source is None:
        return of_fix(fix)
    if source.found is None:
        source.found = determined(source.problem.flat(), fix)
    found: Determined = source.found
    return found


def dict_of(fix: Fix) -> dict[str, Any]:
    """Return a single fix as plain values; a batch, or a fix with several states, as a list of rows."""
    rows = records(fix_columns(fix))
    if fix.shape:
        singles = [dict_of(one) for one in (flat[i] for flat in [fix.flat()] for i in range(len(flat)))]
        return {"fixes": singles}
    detail: dict[str, Any] = plain(fix_detail(fix))
    return rows[0] | detail if len(rows) == 1 else {"states": rows} | detail


def frame_of(fix: Fix) -> Any:
    """Return fixes as a pandas data frame; raise InvalidProblem where pandas is not installed."""
    try:
        import pandas as pd
    except ImportError:
        raise InvalidProblem("pandas is not installed", "to_dataframe", "pip install pandas, or use to_dict") from None
    table = pd.DataFrame(fix_columns(fix))
    # a run has several rows for each fix
    if fix.labels is None or fix.labels.size != len(table):
        return table
    return table.set_index(pd.Index(fix.labels.ravel().tolist()))


def geojson_of(fix: Fix, problem: Problem | None = None) -> dict[str, Any]:
    """Return fixes as a GeoJSON feature collection, with the stations where their problem is given."""
    from optloc.show.formats.marks import Results, geojson

    return geojson(Results(fix_columns(fix), fix.frame, (fix,), problem))

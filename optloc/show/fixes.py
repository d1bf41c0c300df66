"""Fixes as text tables, for the command line, `repr` and notebooks.

A `FixSheet` is a table of text with a title. `optloc.cli` prints sheets with colours, `text_of` returns plain text, and
`html_of` returns HTML for notebooks.
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
    alternative_latlon,
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
from optloc.show.origin_time import origin_text

# If an equality fixes a coordinate, its computed sigma is rounding error: below this share of the coordinate.
_HELD = 1e-12
_EARTH = 6.4e6
# A length below this share of the largest length is rounding error, for instance the sigma of a fixed height.
_NOTHING = 1e-6
# Entries of each list that fit on a screen. Further entries are only counted; tables and JSON list all entries.
SHOWN, _EXPLANATIONS, _SUSPECTS, _BIASES = 12, 8, 12, 40
# p-value below which the text warns of large residuals: by chance this happens in one of 1000 correct fixes.
_UNLIKELY = 1e-3
# A cost gap below this is printed as 0: both positions fit the data equally well.
_NO_GAP = 1e-3
# Characters in a line of text.
_WIDTH = 100


NOT_DETERMINED = "not determined"
"""Text of an entry that the data do not determine; see `optloc.Fix.undetermined`."""


def with_sigma(value: float, sigma: float, unit: str) -> str:
    """Return a number with its standard deviation, both rounded to two digits of the standard deviation.

    If a constraint fixes the number, "(held)" replaces the standard deviation. `value` and `sigma` are in the unit
    `unit`. An infinite or NaN `sigma` is omitted.
    """
    unit = unit if unit != "1" else ""
    if sigma <= _HELD * (1.0 + abs(value)):
        return f"{value:.10g} {unit} (held)"
    if not np.isfinite(sigma):
        return f"{value:.6g} {unit}"
    # Print two digits of the standard deviation, and no decimals if it is 10 or more.
    digits = int(max(0, 1 - np.floor(np.log10(sigma))))
    text = f"{value:.{digits}f}"
    return f"{text if text.strip('-0.') else text.lstrip('-')} ± {sigma:.{digits}f} {unit}"


# Sheets of a fix: the fix, its biases, its suspects and its alternatives.


class FixSheet(NamedTuple):
    """A table of text with a title.

    - title: title above the table; may be empty.
    - head: names of the columns; empty if each row is a label with its text.
    - rows: cells of each row.
    """

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def fix_sheet(fix: Fix, columns: Columns | None = None, title: str = "") -> FixSheet:
    """Return the sheet of a single fix: each row is a label and a text, and the first row is the status.

    Parameters
    ----------
    fix : Fix
        A single fix.
    columns : dict of str to array, optional
        Table of the fix, see `fix_columns`.
    title : str
        Title of the sheet.
    """
    columns = fix_columns(fix) if columns is None else columns
    verdict, reason = Status(int(fix.code)), str(fix.reason[()] or "")
    noted = {Status.TAILS: TAILS, Status.ROBUST: ROBUST, Status.RESCALED: RESCALED}
    notes = [UNCHECKED] * fix.unchecked + [words for note, words in noted.items() if fix.has(note)]
    lines = [("status", "; ".join([verdict.label, *notes])), ("", verdict.sentence)]
    lines += [("reason", reason)] if reason else []
    others = [one.label for one in fix.findings if one is not verdict and one not in NOTES]
    lines += [("also found", ", ".join(others))] if others else []
    # A run can have one state for each epoch: list only the states that fit on a screen.
    rows = len(columns["x"])
    for i in range(min(rows, SHOWN)):
        lines += _state(columns, i, whose(columns, i) if rows > 1 else "")
    if rows > SHOWN:
        lines.append(("...", f"{rows - SHOWN} more; write all of them to a file with --out"))
    # Errors of single epochs, such as clock errors, are too many to list: print their root mean square.
    origin = origin_text(columns, 0) if rows == 1 else ""
    lines += [("emission time", origin)] if origin else []
    for name, values in fix.bias.items():
        if origin and name == "emission":
            continue
        slot, shared = fix.layout.find(name)
        if not shared and np.isfinite(values).any():
            spread = np.sqrt(np.nanmean(values**2))
            lines.append((name, f"{values.size} values, root mean square {spread:.4g} {slot.unit}".strip()))
    lines += [("constraint", _constraint_text(active)) for active in active_of(fix)]
    known = known_rows(fix)
    # Without a valid position, the known quantities replace the intervals of the position.
    lines += known if known and not has_place(fix) else _extents(fix) + known
    lines.append(("chi-square", _chi_square(fix)))
    if hasattr(fix.certificate, "proof"):
        lines.append(("certificate", f"{fix.certificate.proof}: {fix.certificate.reason}"))
    lines.append(("stages", " → ".join(stage.name for stage in fix.stages) or "none"))
    return FixSheet(title, (), lines)


def _constraint_text(active: Active) -> str:
    """Return the text of an active constraint."""
    if active.name.endswith(" equal"):
        return f"{active.name.removesuffix(' equal')} held as given"
    gain = f"relaxing it lowers the cost by {abs(active.multiplier):.4g} per SI unit"
    return f"{active.name} bound reached; {gain}"


def whose(columns: Columns, i: int) -> str:
    """Return " of <target> at <epoch>" for row `i`; each part is empty if the table has only one target or epoch."""
    several = "target" in columns and len(set(columns["target"].tolist())) > 1
    epoch = f" at {columns['epoch'][i]}" if "epoch" in columns and columns["epoch"][i] != "run" else ""
    return (f" of {columns['target'][i]}" if several else "") + epoch


def _state(columns: Columns, i: int, whose: str) -> list[tuple[str, str]]:
    """Return labels and texts of the state in row `i`: position, velocity, acceleration and accuracy.

    `whose` is added to each label, to name target and epoch. A row without a position has no lines. The ellipse is
    omitted if the distribution is not Gaussian in metres. `columns` is the table of the fix.
    """
    if not np.isfinite(columns["x"][i]):
        return []
    axes, undetermined = [axis for axis in "xyz" if axis in columns], _undetermined(columns, i)
    numbers = [with_sigma(columns[axis][i], columns[f"sigma_{axis}"][i], "m") for axis in axes]
    values = [NOT_DETERMINED if a in undetermined else text for a, text in zip(axes, numbers, strict=True)]
    lines = [(f"{a}{whose}", text) for a, text in zip(axes, values, strict=True)]
    if "lat_deg" in columns:
        lat, lon = f"{columns['lat_deg'][i]:.7f} deg", f"{columns['lon_deg'][i]:.7f} deg"
        lines.append((f"latitude{whose}", NOT_DETERMINED if "north" in undetermined else lat))
        lines.append((f"longitude{whose}", NOT_DETERMINED if "east" in undetermined else lon))
        local = [columns[f"cov_{axis}{axis}"][i] for axis in "enu" if f"cov_{axis}{axis}" in columns]
        held = " (held)" if len(local) == 3 and local[2] < (_HELD * _EARTH) ** 2 else ""
        height = f"{columns['height'][i] + 0.0:.2f} m{held}".replace("-0.00", "0.00")
        lines.append((f"height{whose}", NOT_DETERMINED if "up" in undetermined else height))
        shown = [(word, v) for word, v in zip(("east", "north", "up"), local, strict=False) if word not in undetermined]
        if shown:
            sizes = _sizes(np.sqrt(np.maximum([v for _, v in shown], 0.0)))
            lines.append((f"sigma {', '.join(word for word, _ in shown)}", ", ".join(sizes) + " m"))
    for letter, word, unit in (("v", "velocity", "m/s"), ("a", "acceleration", "m/s²")):
        for axis in (axis for axis in axes if f"{letter}{axis}" in columns):
            value, sigma = (columns[f"{prefix}{letter}{axis}"][i] for prefix in ("", "sigma_"))
            text = NOT_DETERMINED if f"{letter}{axis}" in undetermined else with_sigma(value, sigma, unit)
            lines.append((f"{word} {axis}{whose}", text))
    semi = [columns[f"ellipse95_{j + 1}"][i] for j in range(len(axes))]
    if np.isfinite(semi).all() and columns["chart"][i] in {"", NAMES[CARTESIAN]}:
        name = "95 % ellipse" if len(axes) == 2 else "95 % ellipsoid"
        lines.append((name, " x ".join(_sizes(semi)) + " m (semi-axes)"))
        if len(columns["x"]) == 1:
            lines += _accuracy(level_covariance(columns, i))
    return lines


def _undetermined(columns: Columns, i: int) -> set[str]:
    """Return the names of the undetermined entries of row `i`: coordinates, rates, and axes east, north, up."""
    names = columns["undetermined"][i] if "undetermined" in columns else ""
    return set(names.split("; ")) if isinstance(names, str) else set()


def _sizes(lengths: Iterable[float]) -> list[str]:
    """Return lengths as text; a length that is only rounding error compared with the largest length is 0."""
    known = list(lengths)
    return [f"{v if v > _NOTHING * max(known) else 0.0:.3g}" for v in known]


def _accuracy(covariance: Array) -> list[tuple[str, str]]:
    """Return labels and texts of the accuracy radii that data sheets state, from a covariance (d, d), m^2."""
    from optloc.uncertainty.radii import accuracy

    radii = accuracy(covariance)
    lines = [("CEP50, CEP95", f"{radii.cep50:.3g}, {radii.cep95:.3g} m (circles)")]
    if len(covariance) == 3:
        lines.append(("SEP50, SEP95", f"{radii.sep50:.3g}, {radii.sep95:.3g} m (spheres)"))
        lines.append(("vertical 95 %", f"± {_sizes([float(radii.cep95), float(radii.vertical95)])[1]} m"))
    return lines


def _extents(fix: Fix) -> list[tuple[str, str]]:
    """Return labels and texts of valid 95 % intervals for fixes whose ellipsoid in metres is not valid."""
    if fix.chart is None or not fix.answered:
        return []
    if fix.chart.kind == CARTESIAN:
        return _coordinates(fix) if fix.chart.cut_off else []
    if fix.chart.kind != INVERSE_RANGE:
        return [("95 % region", "curved: the ± values are not valid; use optloc.uncertainty.likelihood_region")]
    low, high = (float(end) for end in fix.interval("range"))
    far = f"to {high:.4g} m" if np.isfinite(high) else "or more, to infinity"
    lines = [("95 % range", f"{low:.4g} m {far}, from the middle of the stations")]
    if not fix.frame.geodetic:
        low, high = (float(np.degrees(end)) for end in fix.interval("bearing"))
        lines.append(("95 % bearing", f"{low:.4g} to {high:.4g} deg from the first axis towards the second"))
    return lines


def _coordinates(fix: Fix) -> list[tuple[str, str]]:
    """Return labels and texts of 95 % intervals of the coordinates if bounds cut off the distribution of the position.

    The position is then not in the middle of the intervals.
    """
    lines = []
    for axis in AXES[: fix.position.shape[-1]]:
        low, high = (float(end) for end in fix.interval(axis))
        lines.append((f"95 % {axis}", f"{low:.6g} to {high:.6g} m, within the bounds"))
    return lines


def _chi_square(fix: Fix) -> str:
    """Return the cost, the degrees of freedom and the p-value as text, with a warning if the p-value is small.

    Without redundancy or without a finite cost, the text states why there is no test.
    """
    # a fix that failed before its rows were counted has zero degrees of freedom
    if not np.isfinite(fix.cost) and int(fix.dof) >= 0:
        return "not computed: there is no refined answer"
    if int(fix.dof) <= 0:
        return "no redundancy: nothing to test"
    p = float(fix.p_value)
    warning = "; the residuals are larger than the stated noise allows" if p < _UNLIKELY else ""
    return f"{float(fix.cost):.4g} with {int(fix.dof)} degrees of freedom, p = {p:.3g}{warning}"


def bias_sheet(
    fix: Fix, seen: Observability | None = None, unit_of: Callable[[str, str], tuple[str, float]] | None = None
) -> FixSheet | None:
    """Return the biases of a single fix as a sheet; None if the fix has no biases.

    Parameters
    ----------
    fix : Fix
        A single fix.
    seen : Observability, optional
        Observability of the biases, for the column "from data".
    unit_of : callable of (name, unit), optional
        Returns the unit in which a bias is printed, and its size in SI units.
    """
    records = bias_records(fix, seen) if np.isfinite(fix.x).all() else []
    if not records:
        return None
    rows = []
    for row in records[:_BIASES]:
        share = f"{100.0 * row['from_data']:.3g} %" if np.isfinite(row["from_data"]) else "-"
        unit, size = (row["unit"], 1.0) if unit_of is None else unit_of(row["name"], row["unit"])
        text = with_sigma(row["value"] / size, row["sigma"] / abs(size), unit)
        text = NOT_DETERMINED if row.get("undetermined") else text
        rows.append((row["name"], row["member"], text.strip(), share))
        speed = estimated_speed(row["name"], row["member"], row["value"], row["sigma"])
        if speed is not None and not row.get("undetermined"):
            rows.append((row["name"], "true", with_sigma(*speed, "m/s").strip(), ""))
    if len(records) > _BIASES:
        rows.append(("...", f"{len(records) - _BIASES} more", "--json prints all", ""))
    return FixSheet("Biases", ("name", "member", "estimate", "from data"), rows)


def suspect_sheet(fix: Fix) -> FixSheet | None:
    """Return the explanations of contradicting data of a single fix as a sheet; None if the data agree."""
    found = explanations_of(fix)
    if not found:
        return None
    title = "Excluded suspects" if len(found) == 1 else f"{len(found)} explanations: the fix uses the first"
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
    """Return the text of the estimated errors of a suspect, each with its standard deviation.

    At most three errors are listed. Errors that the other rows do not determine are omitted.
    """
    pairs = [f"{e:+.3g} ± {s:.2g}" for e, s in zip(suspect.error, suspect.sigma, strict=True) if np.isfinite(s)]
    return ", ".join(pairs[:3]) + (" ..." if len(pairs) > 3 else "") if pairs else "unknown"


def as_p(value: float) -> str:
    """Return the text of a p-value with two digits; "-" for NaN."""
    return "-" if np.isnan(value) else f"{value:.2g}"


def alternative_sheet(fix: Fix) -> FixSheet | None:
    """Return the alternatives of a single fix as a sheet; None if it has no alternatives."""
    found = np.isfinite(fix.alternatives.gap)
    if not found.any():
        return None
    others = (fix.alternatives.x[found], fix.alternatives.gap[found], fix.alternatives.doubt[found])
    rows = []
    for i, (x, gap, doubt) in enumerate(zip(*others, strict=True)):
        # Print at most six coordinates: the two positions of a pair of targets.
        on_earth = alternative_latlon(fix, x)
        if on_earth is None:
            point = ", ".join(f"{v:.1f}" for v in np.ravel(alternative_position(fix, x))[:6])
        else:
            places = on_earth.reshape(-1, 3)[:2].tolist()
            point = ", ".join(f"{lat:.6f}, {lon:.6f}, {height:.1f}" for lat, lon, height in places)
        rows.append((str(i + 1), point, f"{gap:.4g}" if gap >= _NO_GAP else "0", f"{doubt:.2g}"))
    what = "position, m" if fix.frame.kind == "cartesian" else "latitude, longitude, height in m"
    return FixSheet("Alternatives", ("#", what, "cost gap", "probability"), rows)


def count_sheet(columns: Columns, title: str) -> FixSheet:
    """Return a sheet of a batch: for each status the number of fixes, their sigmas and their p-value.

    `columns` is the table of the batch, and `title` is the first part of the title of the sheet.
    """
    # One number for the accuracy of a position: the root of the trace of its covariance.
    sigma = np.sqrt(sum(columns[f"sigma_{axis}"] ** 2 for axis in "xyz" if axis in columns))
    rows = []
    for label, count in Counter(columns["status"].tolist()).most_common():
        inside = columns["status"] == label
        # The median and the 95 % quantile of sigma, and the median p-value.
        shares = ((sigma, 0.5), (sigma, 0.95), (columns["p_value"], 0.5))
        rows.append((label, str(count), *(_quantile(values[inside], share) for values, share in shares)))
    head = ("status", "fixes", "median sigma, m", "95 % quantile, m", "median p")
    alone = int(np.asarray(columns["unchecked"], dtype=bool).sum())
    more = f", {alone if alone < len(columns['status']) else 'all'} with {UNCHECKED}" if alone else ""
    return FixSheet(f"{title}{len(columns['status'])} fixes{more}", head, rows)


def _quantile(values: Array, share: float) -> str:
    """Return a quantile of the finite values as text; "-" if there are no finite values."""
    finite = values[np.isfinite(values)]
    return f"{np.quantile(finite, share):.3g}" if len(finite) else "-"


# Text, HTML and dictionaries, for the methods of `Fix`.


def sheets_of(fix: Fix) -> list[FixSheet]:
    """Return all sheets of a single fix; for a batch, one sheet with the number of fixes of each status."""
    if fix.shape:
        return [count_sheet(fix_columns(fix), "")] if fix.code.size else [FixSheet("0 fixes", (), [])]
    found = (fix_sheet(fix), bias_sheet(fix), suspect_sheet(fix), alternative_sheet(fix))
    return [sheet for sheet in found if sheet is not None]


def text_of(fix: Fix) -> str:
    """Return a fix as plain text."""
    return "\n".join(line for sheet in sheets_of(fix) for line in _lines(sheet))


def _lines(sheet: FixSheet) -> Iterable[str]:
    """Yield the lines of a sheet: each column is as wide as its longest cell, and the last column is wrapped."""
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
    """Return a fix as HTML tables; all texts are escaped."""
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
    """Return the quantities that the data of a single fix determine; raise InvalidProblem for a batch.

    If the fix does not refer to its problem, only the intervals of an `ok` fix are known; otherwise the result is None.
    The first call computes the quantities, and the fix keeps them for later calls.
    """
    if fix.shape:
        advice = "select one fix: fix[i].determined"
        raise InvalidProblem(f"a batch of shape {fix.shape} has no single `determined`", "determined", advice)
    source: Any = None if fix.source is None else fix.source[()]
    if source is None:
        return of_fix(fix)
    if source.found is None:
        source.found = determined(source.problem.flat(), fix)
    found: Determined = source.found
    return found


def dict_of(fix: Fix) -> dict[str, Any]:
    """Return a single fix as a dictionary in JSON types; for a batch, a dictionary with the list `fixes`.

    If a fix has several states, their rows are in the list `states`.
    """
    rows = records(fix_columns(fix))
    if fix.shape:
        singles = [dict_of(one) for one in (flat[i] for flat in [fix.flat()] for i in range(len(flat)))]
        return {"fixes": singles}
    detail: dict[str, Any] = plain(fix_detail(fix))
    return rows[0] | detail if len(rows) == 1 else {"states": rows} | detail


def frame_of(fix: Fix) -> Any:
    """Return fixes as a pandas data frame, with the labels of the fixes as index if there is one row for each label.

    If pandas is not installed, the function raises InvalidProblem.
    """
    try:
        import pandas as pd
    except ImportError:
        raise InvalidProblem("pandas is not installed", "to_dataframe", "pip install pandas, or use to_dict") from None
    table = pd.DataFrame(fix_columns(fix))
    # A run has several rows for each fix, so its labels cannot be an index.
    if fix.labels is None or fix.labels.size != len(table):
        return table
    return table.set_index(pd.Index(fix.labels.ravel().tolist()))


def geojson_of(fix: Fix, problem: Problem | None = None) -> dict[str, Any]:
    """Return fixes as a GeoJSON feature collection; with the problem, it also contains stations and 95 % regions."""
    from optloc.show.formats.marks import Results, geojson

    return geojson(Results(fix_columns(fix), fix.frame, (fix,), problem))

"""Tables of an answer: states of several fixes, counts of statuses, biases, suspects and alternatives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from optloc.base.types import Array, Status
from optloc.bounds.rank import Observability
from optloc.problem.bias import estimated_speed
from optloc.problem.explanations import Suspect
from optloc.problem.fix import Fix
from optloc.show.answer_texts import (
    NOT_DETERMINED,
    as_p,
    finite,
    latlon_texts,
    length_text,
    place_rows,
    sigma_of,
    sure_rows,
    undetermined_names,
    with_sigma,
)
from optloc.show.columns import (
    Columns,
    alternative_latlon,
    alternative_position,
    bias_records,
    explanations_of,
)
from optloc.show.fix_answer import FixSheet

# Entries of each list that fit on a screen. Further entries are only counted; tables and JSON list all entries.
_EXPLANATIONS, _SUSPECTS, _BIASES = 8, 12, 40
# A cost gap below this is printed as 0: both positions fit the data equally well.
_NO_GAP = 1e-3
# Characters in a line of a table that has standard deviations in the cells: the width of a terminal.
_WIDEST = 80

MOST_ROWS = 20
"""Number of fixes that a printed table shows completely; of more, it shows the first and the last ten."""

UNCHECKED_MARK = ", unchecked"
"""Suffix of the status of a fix without redundancy, in tables."""


# Several fixes, or several states of one fix.


def state_sheet(columns: Columns, title: str, most: int = MOST_ROWS) -> FixSheet:
    """Return the table of several states, one row for each: names, position, velocity, sigma and status.

    Numbers are rounded as in the text of a single fix. If the table is not too wide, coordinates have their standard
    deviations in the same cell. Otherwise, and for degrees, one column has the standard deviations.

    Parameters
    ----------
    columns : dict of str to array
        Table of the fixes, see `optloc.show.columns.fix_columns`.
    title : str
        Title of the sheet.
    most : int
        Number of rows that are shown completely. Of more rows, the first and the last are shown.
    """
    count, half = len(columns["status"]), most // 2
    shown = list(range(count)) if count <= most else [*range(half), *range(count - half, count)]
    joined = _joined_cells(columns, shown)
    head, rows = _split_cells(columns, shown) if joined is None or _width(*joined) > _WIDEST else joined
    if count > most:
        rows.insert(half, (f"... {count - most} more", *[""] * (len(head) - 1)))
    return FixSheet(title, tuple(head), rows)


# Heads and rows of a table.
_Table = tuple[list[str], list[tuple[str, ...]]]


def _width(head: list[str], rows: list[tuple[str, ...]]) -> int:
    """Return the width of a table as text, with two blanks between columns."""
    return sum(2 + max(map(len, column)) for column in zip(head, *rows, strict=True)) - 2


def _joined_cells(columns: Columns, shown: Sequence[int]) -> _Table | None:
    """Return the heads and rows of a table with a number and its standard deviation in one cell; None on Earth.

    `shown` are the numbers of the rows.
    """
    if "lat_deg" in columns:
        return None
    names, axes, rates = _name_columns(columns), _axes(columns), _rates(columns)
    head = [_HEADS.get(name, name) for name in names]
    head += [*(f"{axis}, m" for axis in axes), *(f"{name}, m/s" for name in rates), "status"]
    rows = []
    for i in shown:
        cells = _cells(columns, i, (*axes, *rates))
        rows.append((*(str(columns[name][i]) for name in names), *cells, _status_cell(columns, i)))
    return head, rows


def _split_cells(columns: Columns, shown: Sequence[int]) -> _Table:
    """Return the heads and rows of a table with standard deviations in one column; `shown` are its row numbers."""
    names, axes, rates, earth = _name_columns(columns), _axes(columns), _rates(columns), "lat_deg" in columns
    third = "cov_uu" if earth else "cov_zz"
    spread = ("east", "north", "up") if earth else ("x", "y", "z")
    head = [_HEADS.get(name, name) for name in names]
    head += ["latitude", "longitude", "height, m"] if earth else [f"{axis}, m" for axis in axes]
    head += [f"{name}, m/s" for name in rates]
    head += [f"sigma {', '.join(spread[: 3 if third in columns else 2])}, m", "status"]
    rows = []
    for i in shown:
        place = _earth_cells(columns, i) if earth else [_before_sigma(cell) for cell in _cells(columns, i, axes)]
        moving = [_before_sigma(cell) for cell in _cells(columns, i, rates)]
        own = (str(columns[name][i]) for name in names)
        rows.append((*own, *place, *moving, _sigma_cell(columns, i), _status_cell(columns, i)))
    return head, rows


def _axes(columns: Columns) -> list[str]:
    """Return the names of the columns of the coordinates."""
    return [axis for axis in "xyz" if axis in columns]


def _rates(columns: Columns) -> list[str]:
    """Return the names of the columns of the velocity."""
    return [f"v{axis}" for axis in _axes(columns) if f"v{axis}" in columns]


def _status_cell(columns: Columns, i: int) -> str:
    """Return the status of row `i`, with a mark if it has no redundancy."""
    alone = "unchecked" in columns and bool(columns["unchecked"][i])
    return str(columns["status"][i]) + (UNCHECKED_MARK if alone else "")


def _sigma_cell(columns: Columns, i: int) -> str:
    """Return the standard deviations of row `i` as the text of a single fix has them; "-" without any."""
    found = [text for label, text in sure_rows(columns, i) if label.startswith("sigma")]
    return found[0].removesuffix(" m") if found else "-"


_HEADS = {"label": "fix", "number": "fix"}


def _name_columns(columns: Columns) -> list[str]:
    """Return the columns that identify a row: the label or the number of the fix, the epoch, and the target.

    The target is omitted if the table has only one. The labels of the user replace the numbers.
    """
    names: list[str] = [name for name in ("label", "epoch", "target") if name in columns]
    if "target" in names and len(set(columns["target"].tolist())) == 1:
        names.remove("target")
    if "label" not in names and "number" in columns:
        names.insert(0, "number")
    return names


def _earth_cells(columns: Columns, i: int) -> list[str]:
    """Return latitude and longitude, degrees, and height, metres, of row `i` as cells; "-" if not determined."""
    if not np.isfinite(columns["lat_deg"][i]):
        return ["-"] * 3
    units = {"latitude": " deg", "longitude": " deg", "height": " m"}
    texts = dict(place_rows(columns, i))
    return ["-" if texts[name] == NOT_DETERMINED else texts[name].replace(unit, "") for name, unit in units.items()]


def _cells(columns: Columns, i: int, names: Sequence[str]) -> list[str]:
    """Return numbers of row `i` with their standard deviations as cells; "-" if not determined."""
    undetermined = undetermined_names(columns, i)
    return [
        with_sigma(float(columns[name][i]), sigma_of(columns, name, i), "").strip()
        if name not in undetermined and np.isfinite(columns[name][i])
        else "-"
        for name in names
    ]


def _before_sigma(cell: str) -> str:
    """Return the number of a cell without its standard deviation."""
    return cell.partition(" ± ")[0]


def _sigma(columns: Columns) -> Array:
    """Return one number for the accuracy of each position: the root of the trace of its covariance, m."""
    return np.asarray(np.sqrt(sum(columns[f"sigma_{axis}"] ** 2 for axis in "xyz" if f"sigma_{axis}" in columns)))


def count_sheet(columns: Columns, title: str = "Statuses") -> FixSheet:
    """Return a sheet of a batch: for each status the number of fixes, their sigmas and their p-value.

    `columns` is the table of the batch.
    """
    sigma, rows = _sigma(columns), []
    for label, count in Counter(columns["status"].tolist()).most_common():
        inside = columns["status"] == label
        # The median and the 95 % quantile of sigma, and the median p-value.
        shares = ((sigma, 0.5), (sigma, 0.95), (columns["p_value"], 0.5))
        rows.append((label, str(count), *(_quantile(values[inside], share) for values, share in shares)))
    head = ("status", "fixes", "median sigma, m", "95 % of sigma, m", "median p")
    return FixSheet(title, head, rows)


def median_sigma(columns: Columns, inside: Array) -> str:
    """Return the median of the accuracy (root of the trace of the covariance, m) of the rows `inside` as text."""
    return _quantile(_sigma(columns)[inside], 0.5)


def _quantile(values: Array, share: float) -> str:
    """Return a quantile of the finite values as text; "-" if there are no finite values."""
    known = finite(values)
    return f"{np.quantile(known, share):.3g}" if len(known) else "-"


# Details of a single fix.


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
            point = ", ".join(length_text(v) for v in np.ravel(alternative_position(fix, x))[:6])
        else:
            places = on_earth.reshape(-1, 3)[:2].tolist()
            point = ", ".join(", ".join([*latlon_texts(*place[:2]), length_text(place[2])]) for place in places)
        rows.append((str(i + 1), point, f"{gap:.4g}" if gap >= _NO_GAP else "0", f"{doubt:.2g}"))
    what = "position, m" if fix.frame.kind == "cartesian" else "latitude, longitude, height in m"
    return FixSheet("Alternatives", ("#", what, "cost gap", "probability"), rows)


def status_words(columns: Columns, notes: Sequence[str]) -> str:
    """Return the number of fixes of each status as a phrase, for instance "20 fixes: 18 ok, 2 ambiguous".

    `columns` is the table of the batch, and `notes` are appended.
    """
    counts = Counter(columns["status"].tolist())
    order = sorted(counts, key=lambda label: (label != Status.OK.label, -counts[label]))
    total = sum(counts.values())
    one = "all" if len(counts) == 1 and total > 1 else None
    parts = ", ".join(f"{one or counts[label]} {label}" for label in order)
    return "; ".join([f"{total} fix{'es' if total != 1 else ''}: {parts}", *notes])

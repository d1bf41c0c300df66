"""What a fix says: in words, as a table, as JSON and as GeoJSON; the command line and `repr` show the same.

A sheet is a table of text with a title. Whoever shows it decides how: `optloc.cli` with colours, `text_of` with spaces,
`html_of` as a notebook has it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from html import escape
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.linalg import error_ellipse
from optloc.base.outputs import visible
from optloc.base.types import Array, Status
from optloc.bounds.observability import Observability
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE, NAMES
from optloc.problem.fix import Active, Explanation, Fix, Suspect
from optloc.problem.problem import Problem

Columns = dict[str, Array]
"""A long table: columns (rows,) by name, in SI units and degrees, NaN where there is no number."""

_RATES = {"velocity": "v", "acceleration": "a"}
_STATES = ("position", *_RATES)
# Corners of an ellipse on a map, one for every 5 degrees: no edge is seen at any zoom that shows the whole.
_CORNERS = 72
# What a coordinate that an equality holds may have as its sigma, as a share of it: rounding.
_HELD = 1e-12
# What a screen holds of each list; the rest is counted, and tables and JSON have all of it.
SHOWN, _EXPLANATIONS, _SUSPECTS, _BIASES = 12, 8, 12, 40
# p-value below which a misfit is pointed out: one right fix in a thousand.
_UNLIKELY = 1e-3
# A cost gap below this is printed as 0: the two places explain the data equally well.
_NO_GAP = 1e-3
# Signs in a line of text.
_WIDTH = 100

# Numbers and tables.


def with_sigma(value: float, sigma: float, unit: str) -> str:
    """Return a number with its standard deviation, rounded to it; a constraint may leave it none."""
    unit = unit if unit != "1" else ""
    if sigma <= _HELD * (1.0 + abs(value)):
        return f"{value:.10g} {unit} (held)"
    if not np.isfinite(sigma):
        return f"{value:.6g} {unit}"
    # Two digits of the standard deviation, none behind the point of one above 10.
    digits = int(max(0, 1 - np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} ± {sigma:.{digits}f} {unit}"


def plain(value: Any) -> Any:
    """Return a value as JSON knows it: arrays as lists, what is not finite as null."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def records(columns: Columns) -> list[dict[str, Any]]:
    """Return a table as one record for each row, ready for JSON."""
    lists = {name: plain(values) for name, values in columns.items()}
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def join_tables(parts: Sequence[Columns]) -> Columns:
    """Return tables below each other; a column that one lacks is NaN there."""
    names = dict.fromkeys(name for part in parts for name in part)
    sizes = [len(next(iter(part.values()))) for part in parts]
    return {
        name: np.concatenate([part.get(name, np.full(size, np.nan)) for part, size in zip(parts, sizes, strict=True)])
        for name in names
    }


def covariance_columns(covariance: Array, axes: str) -> Columns:
    """Return the upper triangles of covariances (n, d, d) along named axes."""
    d = covariance.shape[-1]
    return {f"cov_{axes[i]}{axes[j]}": covariance[:, i, j] for i in range(d) for j in range(i, d)}


def geodetic_columns(frame: Frame, position: Array, covariance: Array) -> Columns:
    """Return latitude and longitude (degrees), height (metres) and covariance along east, north, up."""
    if not frame.geodetic:
        return {}
    with np.errstate(invalid="ignore"):  # epochs without a fix are NaN
        lat, lon, height = frame.to_geodetic(position)
        axes = frame.enu_axes(position)
    local = axes @ covariance @ np.swapaxes(axes, -1, -2)
    degrees = {"lat_deg": np.degrees(lat), "lon_deg": np.degrees(lon), "height": height}
    return degrees | covariance_columns(local, "enu")


# The long table: one row for each target and epoch.

Labels = Callable[[int, bool], Columns]


def fix_columns(
    fix: Fix,
    *,
    targets: Sequence[tuple[int, tuple[str, ...]]] | None = None,
    labels: Labels | None = None,
    dimension: int = 3,
    constrained: bool | None = None,
) -> Columns:
    """Return the table of fixes.

    Parameters
    ----------
    fix : Fix
        One fix, or a batch (n,) of them.
    targets : sequence of (int, tuple of str), optional
        Number of each target and the names of its position, velocity and acceleration; by default those of the layout.
    labels : callable of (int, bool), optional
        Returns the columns that say which row is which, of a target, and whether it has a position at each epoch.
    dimension : int
        Of positions, where none is estimated.
    constrained : bool, optional
        Whether there are constraints that may hold it; by default whether any does.

    Returns
    -------
    dict of str to array (rows,)
        Metres, seconds and degrees; NaN where there is no number.
    """
    flat = fix if len(fix.shape) == 1 else fix.flat()
    if targets is None:
        targets = list(enumerate(_states_of(fix))) or [(0, ("position",))]
    if labels is None:
        labels = _numbered(flat, len(targets))
    words = _told_in_words(
        flat, any(map(len, fix.active.ravel())) if constrained is None and fix.active is not None else bool(constrained)
    )
    return join_tables([_of_target(flat, names, i, labels, dimension, words) for i, names in targets])


def _states_of(fix: Fix) -> list[tuple[str, ...]]:
    """Return the names of position, velocity and acceleration of each target that is estimated."""
    names = [slot.name for slot in (*fix.layout.shared, *fix.layout.local)]
    numbers = [name.removeprefix("position") for name in names if name.partition("[")[0] == "position"]
    return [tuple(f"{word}{number}" for word in _STATES if f"{word}{number}" in names) for number in numbers]


def _numbered(fix: Fix, targets: int) -> Labels:
    """Return labels of fixes that nobody has named: their numbers in the batch, of epochs and of targets."""
    n, k = len(fix), fix.layout.epochs

    def labels(target: int, spread: bool) -> Columns:
        rows = n * k if spread else n
        number = {"number": np.arange(rows) // (k if spread else 1)} if n > 1 else {}
        epoch = {"epoch": np.tile(np.arange(k), n)} if spread else {}
        return number | epoch | ({"target": np.full(rows, target)} if targets > 1 else {})

    return labels


def _of_target(
    fix: Fix, names: Sequence[str], target: int, labels: Labels, dimension: int, words: Mapping[str, Sequence[str]]
) -> Columns:
    """Return the rows of one target: `names` are those of its position, velocity and acceleration."""
    estimated = names[0] in {slot.name for slot in (*fix.layout.shared, *fix.layout.local)}
    position = fix.take(names[0]) if estimated else np.full((len(fix), dimension), np.nan)
    n, d = len(fix), position.shape[-1]
    # A position of each epoch of a run has an axis of epochs (1, k, d), and a covariance where that was asked for.
    spread = position.ndim == 3
    count = position.shape[1] if spread else 1
    told = estimated and (not spread or fix.local is not None)
    columns = dict(labels(target, spread))
    position = position.reshape(n * count, d)
    covariance = fix.covariance(names[0]).reshape(n * count, d, d) if told else np.full((n * count, d, d), np.nan)
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    columns |= _repeat(count, status=[Status(int(code)).label for code in fix.code], reason=list(fix.reason))
    columns |= {axis: position[:, i] for i, axis in enumerate("xyz"[:d])}
    columns |= {f"sigma_{axis}": sigma[:, i] for i, axis in enumerate("xyz"[:d])}
    columns |= covariance_columns(covariance, "xyz")
    for name in names[1:] if estimated else ():
        letter = _RATES[name.partition("[")[0]]
        own = fix.sigma(name).reshape(n * count, d) if told else np.full((n * count, d), np.nan)
        for values, prefix in ((fix.take(name).reshape(n * count, d), letter), (own, f"sigma_{letter}")):
            columns |= {f"{prefix}{axis}": v for axis, v in zip("xyz", values.T, strict=False)}
    columns |= geodetic_columns(fix.frame, position, covariance)
    semi_axes, _ = error_ellipse(covariance)
    # Longest axis first.
    columns |= {f"ellipse95_{i + 1}": semi_axes[:, d - 1 - i] for i in range(d)}
    for name, numbers in {"cost": fix.cost, "dof": fix.dof, "p_value": np.asarray(fix.p_value)}.items():
        columns[name] = np.repeat(numbers, count)
    columns["alternatives"] = np.repeat(np.isfinite(fix.alternatives.gap).sum(-1), count)
    return columns | _repeat(count, **words)


def level_covariance(columns: Columns, i: int) -> Array:
    """Return the covariance (d, d) of one row in level axes: east, north and up where there is a ground."""
    axes = "enu" if "cov_ee" in columns else "xyz"
    axes = axes[: 3 if f"cov_{2 * axes[2]}" in columns else 2]
    pairs = [[f"cov_{min(a, b, key=axes.index)}{max(a, b, key=axes.index)}" for b in axes] for a in axes]
    return np.array([[float(columns[name][i]) for name in row] for row in pairs])


def _repeat(count: int, **texts: Sequence[str]) -> Columns:
    """Return texts of each fix (n,) as columns, each so often as the fix has rows."""
    return {name: np.repeat(np.array(list(values), dtype=object), count) for name, values in texts.items()}


def _told_in_words(fix: Fix, constrained: bool) -> dict[str, list[str]]:
    """Return the proof of each fix, the constraints that hold it, and its suspects: "A; B" together, "A | B" either."""
    texts = {"proof": [getattr(c, "proof", "unknown") for c in fix.claims]}
    texts["findings"] = ["; ".join(one.label for one in each) for each in fix.findings]
    texts["chart"] = [""] * len(fix) if fix.chart is None else list(fix.chart.name)
    if constrained:
        held = [()] * len(fix) if fix.active is None else fix.active
        texts["active"] = ["; ".join(active.name for active in each) for each in held]
        texts["multipliers"] = ["; ".join(f"{active.multiplier:.6g}" for active in each) for each in held]
    if fix.explanations is not None:
        texts["suspects"] = [" | ".join("; ".join(e.names) for e in each) for each in fix.explanations]
    return texts


# What a single fix has besides its numbers.


def explanations_of(fix: Fix) -> tuple[Explanation, ...]:
    """Return what explains the data of a single fix."""
    return () if fix.explanations is None else tuple(fix.explanations[()])


def active_of(fix: Fix) -> tuple[Active, ...]:
    """Return the constraints that hold a single fix with equality."""
    return () if fix.active is None else tuple(fix.active[()])


def alternative_position(fix: Fix, x: Array) -> Array:
    """Return the positions of all targets of a parameter vector, metres."""
    # Two targets are called position[0] and position[1].
    names = [slot.name for slot in (*fix.layout.shared, *fix.layout.local) if slot.name.partition("[")[0] == "position"]
    parts = [fix.layout.take(x, name) for name in names]
    return parts[0] if len(parts) == 1 else np.stack(parts)


def bias_records(fix: Fix, seen: Observability | None) -> list[dict[str, Any]]:
    """Return one record for each bias of a single fix: name, member, value, sigma, unit, from_data.

    Parameters
    ----------
    fix : Fix
        A single fix.
    seen : Observability, optional
        What its data show.
    """
    found = []
    for slot in fix.layout.shared:
        if not slot.members:
            continue
        values, sigmas = fix.take(slot.name), fix.sigma(slot.name)
        shares = np.full(slot.size, np.nan) if seen is None else seen.from_data[slot.start : slot.start + slot.size]
        for member, value, sigma, share in zip(slot.entries, values, sigmas, shares, strict=True):
            record = {"name": slot.name, "member": member, "value": float(value), "sigma": float(sigma)}
            found.append(record | {"unit": slot.unit, "from_data": float(share)})
    return found


def fix_detail(fix: Fix, seen: Observability | None = None, *, reweighted: bool = False) -> dict[str, Any]:
    """Return what a single fix has besides the columns of its table, for JSON.

    Parameters
    ----------
    fix : Fix
        A single fix.
    seen : Observability, optional
        What its data show of its biases.
    reweighted : bool
        Whether rows have other weights than they came with.
    """
    others = fix.alternatives
    shown = np.isfinite(others.gap)
    return {
        "sentence": Status(int(fix.code)).sentence,
        "findings": [one.label for one in fix.findings],
        "gap_to_infinity": None if fix.infinity is None else fix.infinity,
        "chart": _chart_json(fix),
        "alternatives": [
            {"gap": gap, "probability": doubt, "position": alternative_position(fix, x)}
            for x, gap, doubt in zip(others.x[shown], others.gap[shown], others.doubt[shown], strict=True)
        ],
        "explanations": [asdict(explanation) for explanation in explanations_of(fix)],
        "weights": fix.weights if reweighted else None,
        "active": [{"name": a.name, "multiplier": a.multiplier} for a in active_of(fix)],
        "certificate": asdict(fix.certificate),
        "biases": bias_records(fix, seen),
        "not_separable": [] if seen is None else list(seen.sentences),
        "of_each_epoch": {name: values for name, values in fix.bias.items() if not fix.layout.find(name)[1]},
    }


def _chart_json(fix: Fix) -> dict[str, Any] | None:
    """Return in which coordinates a single fix is Gaussian, and its Gaussian there."""
    chart = fix.chart
    if chart is None or not bool(fix.answered):
        return None
    told: dict[str, Any] = {"name": str(chart.name), "centre": chart.centre}
    if chart.kind == INVERSE_RANGE:
        told |= {"distance": chart.distance, "direction": chart.direction, "basis": chart.basis}
        told |= {"mean": chart.mean, "covariance": chart.spread}
    if chart.kind != CURVED:
        told["range95"] = fix.interval("range")
    return told


# In words: one sheet of a fix, and those of its biases, of what was left out and of its alternatives.


class Sheet(NamedTuple):
    """A table of text: a title, the names of its columns (empty for rows of a label and what it says), its rows."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


def fix_sheet(fix: Fix, columns: Columns | None = None, title: str = "") -> Sheet:
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
    told = [("status", verdict.label), ("", verdict.sentence)]
    told += [("reason", reason)] if reason else []
    others = [one.label for one in fix.findings if one is not verdict]
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
        if not shared:
            spread = np.sqrt(np.mean(values**2))
            told.append((name, f"{values.size} values, root mean square {spread:.4g} {slot.unit}".strip()))
    told += [("constraint", _held(active)) for active in active_of(fix)]
    told += _extents(fix)
    told.append(("chi-square", _chi_square(fix)))
    if hasattr(fix.certificate, "proof"):
        told.append(("certificate", f"{fix.certificate.proof}: {fix.certificate.reason}"))
    told.append(("stages", " → ".join(stage.name for stage in fix.stages) or "none"))
    return Sheet(title, (), told)


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
    axes = [axis for axis in "xyz" if axis in columns]
    told = [(f"{axis}{whose}", with_sigma(columns[axis][i], columns[f"sigma_{axis}"][i], "m")) for axis in axes]
    if "lat_deg" in columns:
        told.append((f"latitude{whose}", f"{columns['lat_deg'][i]:.7f} deg"))
        told.append((f"longitude{whose}", f"{columns['lon_deg'][i]:.7f} deg"))
        told.append((f"height{whose}", f"{columns['height'][i]:.2f} m"))
        local = [columns[f"cov_{axis}{axis}"][i] for axis in "enu" if f"cov_{axis}{axis}" in columns]
        names = ", ".join(("east", "north", "up")[: len(local)])
        told.append((f"sigma {names}", ", ".join(f"{v:.3g}" for v in np.sqrt(np.maximum(local, 0.0))) + " m"))
    for letter, word, unit in (("v", "velocity", "m/s"), ("a", "acceleration", "m/s²")):
        for axis in (axis for axis in axes if f"{letter}{axis}" in columns):
            value, sigma = (columns[f"{prefix}{letter}{axis}"][i] for prefix in ("", "sigma_"))
            told.append((f"{word} {axis}{whose}", with_sigma(value, sigma, unit)))
    semi = [columns[f"ellipse95_{j + 1}"][i] for j in range(len(axes))]
    if np.isfinite(semi).all() and columns["chart"][i] in {"", NAMES[CARTESIAN]}:
        name = "95 % ellipse" if len(axes) == 2 else "95 % ellipsoid"
        told.append((name, " x ".join(f"{v:.3g}" for v in semi) + " m (semi-axes)"))
        if len(columns["x"]) == 1:
            told += _accuracy(level_covariance(columns, i))
    return told


def _accuracy(covariance: Array) -> list[tuple[str, str]]:
    """Return the radii that data sheets give."""
    from optloc.uncertainty.radii import accuracy

    radii = accuracy(covariance)
    told = [("CEP50, CEP95", f"{radii.cep50:.3g}, {radii.cep95:.3g} m (circles)")]
    if len(covariance) == 3:
        told.append(("SEP50, SEP95", f"{radii.sep50:.3g}, {radii.sep95:.3g} m (spheres)"))
        told.append(("vertical 95 %", f"± {radii.vertical95:.3g} m"))
    return told


def _extents(fix: Fix) -> list[tuple[str, str]]:
    """Return what covers where the ellipsoid in metres does not."""
    if fix.chart is None or not fix.answered or fix.chart.kind == CARTESIAN:
        return []
    if fix.chart.kind != INVERSE_RANGE:
        return [("95 % region", "curved: the numbers behind ± do not cover; optloc.likelihood_region does")]
    low, high = (float(end) for end in fix.interval("range"))
    far = f"to {high:.4g} m" if np.isfinite(high) else "or more, to infinity"
    told = [("95 % range", f"{low:.4g} m {far}, from the middle of the stations")]
    if not fix.frame.geodetic:
        low, high = (float(np.degrees(end)) for end in fix.interval("bearing"))
        told.append(("95 % bearing", f"{low:.4g} to {high:.4g} deg from the first axis towards the second"))
    return told


def _chi_square(fix: Fix) -> str:
    if int(fix.dof) <= 0 or not np.isfinite(fix.cost):
        return "no redundancy: nothing to test"
    p = float(fix.p_value)
    warning = "; the residuals are larger than the stated noise" if p < _UNLIKELY else ""
    return f"{float(fix.cost):.4g} with {int(fix.dof)} degrees of freedom, p = {p:.3g}{warning}"


def bias_sheet(
    fix: Fix, seen: Observability | None = None, unit_of: Callable[[str, str], tuple[str, float]] | None = None
) -> Sheet | None:
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
        rows.append((row["name"], row["member"], told.strip(), share))
    if len(records) > _BIASES:
        rows.append(("...", f"{len(records) - _BIASES} more", "--json prints all", ""))
    return Sheet("Biases", ("name", "member", "estimate", "from data"), rows)


def suspect_sheet(fix: Fix) -> Sheet | None:
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
    return Sheet(title, ("#", "suspect", "error", "p with", "p without"), rows)


def _error(suspect: Suspect) -> str:
    """Return the errors of a suspect, each with its standard deviation."""
    pairs = [f"{e:+.3g} ± {s:.2g}" for e, s in zip(suspect.error, suspect.sigma, strict=True) if np.isfinite(s)]
    return ", ".join(pairs[:3]) + (" ..." if len(pairs) > 3 else "") if pairs else "not told"


def as_p(value: float) -> str:
    """Return a p-value as people read it, "-" where there is none."""
    return "-" if np.isnan(value) else f"{value:.2g}"


def alternative_sheet(fix: Fix) -> Sheet | None:
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
    return Sheet("Alternatives", ("#", "position, m", "cost gap", "probability"), rows)


def count_sheet(columns: Columns, title: str) -> Sheet:
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
    return Sheet(f"{title}{len(columns['status'])} fixes", head, rows)


def _quantile(values: Array, share: float) -> str:
    finite = values[np.isfinite(values)]
    return f"{np.quantile(finite, share):.3g}" if len(finite) else "-"


# A fix by itself, as its methods answer.


def sheets_of(fix: Fix) -> list[Sheet]:
    """Return all that a fix says; of a batch how many have which status."""
    if fix.shape:
        return [count_sheet(fix_columns(fix), "")] if fix.code.size else [Sheet("0 fixes", (), [])]
    found = (fix_sheet(fix), bias_sheet(fix), suspect_sheet(fix), alternative_sheet(fix))
    return [sheet for sheet in found if sheet is not None]


def text_of(fix: Fix) -> str:
    """Return a fix as plain text."""
    return "\n".join(line for sheet in sheets_of(fix) for line in _lines(sheet))


def _lines(sheet: Sheet) -> Iterable[str]:
    """Yield the lines of a sheet: columns that are as wide as their longest cell, the last one wrapped."""
    rows = [[visible(cell) for cell in row] for row in ([sheet.head] if sheet.head else []) + sheet.rows]
    if sheet.title:
        yield visible(sheet.title)
    widths = [max(map(len, column)) for column in list(zip(*rows, strict=True))[:-1]]
    indent = sum(widths) + 2 * len(widths)
    for row in rows:
        lead = "".join(f"{cell:{width}}  " for cell, width in zip(row, widths, strict=False))
        folded = wrap(row[-1], max(_WIDTH - indent, 30)) or [""]
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
    return pd.DataFrame(fix_columns(fix))


def geojson_of(fix: Fix, problem: Problem | None = None) -> dict[str, Any]:
    """Return fixes as a GeoJSON feature collection, with the stations where their problem is given."""
    return geojson(fix_columns(fix), fix.frame, [fix], problem)


# As GeoJSON.


def geojson(
    columns: Columns, frame: Frame, fixes: Sequence[Fix], problem: Problem | None = None, source: str | None = None
) -> dict[str, Any]:
    """Return stations, fixes and what holds 95 % as a GeoJSON feature collection (RFC 7946).

    An ellipse where it covers, else the outline of the region; a curved fix without one has none.

    Parameters
    ----------
    columns : dict of str to array
        The table of the fixes.
    frame : Frame
        Of their positions.
    fixes : sequence of Fix
        In the order of the table.
    problem : Problem, optional
        Whose stations are told, and by which curved regions are known.
    source : str, optional
        Place to name.
    """
    from optloc.plot.outlines import earth_points, feature, point_geometry

    if not frame.geodetic:
        what = "GeoJSON needs positions on Earth, but the frame is cartesian"
        raise InvalidProblem(what, source, 'give a [frame] of kind "geodetic", "ecef" or "enu"')
    features = []
    if problem is not None:
        place = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
        named = zip(problem.stations.names, earth_points(frame, place), strict=True)
        features = [feature(point_geometry(point), {"role": "station", "name": name}) for name, point in named]
    outlines = {} if problem is None else _outlines(columns, fixes, problem)
    skipped = {"x", "y", "z", "lat_deg", "lon_deg", "height"}
    for number, row in enumerate(records(columns)):
        if row["lat_deg"] is None:
            continue
        about = {name: value for name, value in row.items() if name not in skipped and not name.startswith("cov_")}
        point = np.array([row["lon_deg"], row["lat_deg"], row["height"]])
        features.append(feature(point_geometry(point), {"role": "fix", **about}))
        about = {name: row[name] for name in ("number", "epoch", "target") if name in row}
        if pieces := outlines.get(number, ()):
            features.append(feature(_region(frame, row, pieces), {"role": "region95", **about}))
        elif row["cov_ee"] is not None and number not in outlines:
            features.append(feature(_ellipse(frame, row), {"role": "ellipse95", **about}))
    return {"type": "FeatureCollection", "features": features}


def _outlines(columns: Columns, fixes: Sequence[Fix], problem: Problem) -> dict[int, tuple[Array, ...]]:
    """Return the convex parts of the regions of rows whose ellipses do not cover; empty where they are not known."""
    from optloc.plot.outlines import pieces_of

    charts = [fix.chart for fix in fixes]
    kinds = [np.ravel(chart.kind) for chart in charts if chart is not None]
    # Fixes of one position each: a row is a fix.
    if len(kinds) != len(charts) or sum(map(len, kinds)) != len(columns["x"]):
        return {}
    pieces = [part for fix in fixes for part in pieces_of(problem, fix)]
    return {int(i): pieces[i] for i in np.flatnonzero(np.concatenate(kinds) != CARTESIAN)}


def _region(frame: Frame, row: dict[str, Any], pieces: tuple[Array, ...]) -> dict[str, Any]:
    """Return the plan of a region of convex parts as a geometry."""
    from optloc.plot.outlines import earth_line, polygon_geometry, polygons

    centre = np.array([row[axis] for axis in "xyz" if axis in row])
    axes = frame.enu_axes(centre)[:2]
    plan = polygons([(piece - centre) @ axes.T for piece in pieces])
    return polygon_geometry([[earth_line(frame, centre + line @ axes) for line in each] for each in plan])


def _ellipse(frame: Frame, row: dict[str, Any]) -> dict[str, Any]:
    """Return the horizontal 95 % ellipse of a row as a geometry, counter-clockwise."""
    from optloc.plot.outlines import earth_line, polygon_geometry

    covariance = np.array([[row["cov_ee"], row["cov_en"]], [row["cov_en"], row["cov_nn"]]])
    semi_axes, directions = error_ellipse(covariance)
    # Eigenvectors may be left-handed: the sign of the turn makes up for it.
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1) * np.sign(np.linalg.det(directions))
    plane = (np.stack([np.cos(angle), np.sin(angle)], axis=-1) * semi_axes) @ directions.T
    plane[-1] = plane[0]
    centre = np.array([row[axis] for axis in "xyz" if axis in row])
    return polygon_geometry([[earth_line(frame, centre + plane @ frame.enu_axes(centre)[:2])]])

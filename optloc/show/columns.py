"""Tables of fixes and JSON records, the content of result files.

`fix_columns` returns one row for each target and epoch. `fix_detail` returns the values of a single fix that a table
cannot hold, such as alternatives and biases. Arrays have n fixes or rows, k epochs and d coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from optloc.base.frames import Frame
from optloc.base.linalg import error_ellipse
from optloc.base.types import Array, Status, statuses_of
from optloc.bounds.rank import Observability
from optloc.problem.chart import AXES, CURVED, INVERSE_RANGE
from optloc.problem.claims import PROOFS
from optloc.problem.explanations import Explanation
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Active
from optloc.show.knowledge import is_shown

Columns = dict[str, Array]
"""A table: columns (rows,) by name, in SI units and degrees; NaN marks a missing number."""

UNCHECKED = "no redundancy: a wrong measurement would not be noticed"
TAILS = "the 95 % region is valid, the 99.9 % region is not"
ROBUST = "a search found the minima of the loss"
RESCALED = "the noise is larger than stated"
"""Notes that follow the status of a fix: `unchecked`, `tails`, `robust` and `rescaled`."""

_RATES = {"velocity": "v", "acceleration": "a"}
# Fixes whose ellipses are computed in one batch: this limits the memory to some megabytes.
_BLOCK = 8192
_STATES = ("position", *_RATES)

# Conversion of values and tables.


def plain(value: Any) -> Any:
    """Return a value in JSON types: arrays as lists, non-finite numbers as None."""
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
    """Return a table as a list of dictionaries in JSON types, one for each row."""
    lists = {name: plain(values) for name, values in columns.items()}
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def with_level_sigmas(record: dict[str, Any]) -> dict[str, Any]:
    """Return the record of a row with `sigma_east`, `sigma_north` and `sigma_up`, m, if it is on Earth.

    A standard deviation without a covariance is None.
    """
    found = {name: record[f"cov_{2 * axis}"] for axis, name in _LEVEL.items() if f"cov_{2 * axis}" in record}
    # A constraint that holds a coordinate can leave a negative rounding error as its variance.
    return record | {f"sigma_{name}": None if v is None else max(v, 0.0) ** 0.5 for name, v in found.items()}


def join_tables(parts: Sequence[Columns]) -> Columns:
    """Return one table with the rows of all parts in order; if a part lacks a column, its rows have NaN there.

    The columns have the order of their first occurrence.
    """
    names = dict.fromkeys(name for part in parts for name in part)
    sizes = [len(next(iter(part.values()))) for part in parts]
    return {
        name: np.concatenate([part.get(name, np.full(size, np.nan)) for part, size in zip(parts, sizes, strict=True)])
        for name in names
    }


def covariance_columns(covariance: Array, axes: str) -> Columns:
    """Return the upper triangles of covariances (n, d, d) as columns `cov_xx`, `cov_xy` and so on.

    `axes` holds one letter for each axis, for instance "xyz" or "enu".
    """
    d = covariance.shape[-1]
    return {f"cov_{axes[i]}{axes[j]}": covariance[:, i, j] for i in range(d) for j in range(i, d)}


def geodetic_columns(frame: Frame, position: Array, covariance: Array) -> Columns:
    """Return latitude and longitude (degrees), height (m) and the covariance along east, north, up (m^2) as columns.

    If the frame is not on Earth, the result is empty. Positions are (n, d), m; covariances are (n, d, d), m^2. A
    `position` that is NaN gives NaN in all columns.
    """
    if not frame.geodetic:
        return {}
    with np.errstate(invalid="ignore"):  # Epochs without a fix are NaN.
        lat, lon, height = frame.to_geodetic(position)
        axes = frame.enu_axes(position)
    local = axes @ covariance @ np.swapaxes(axes, -1, -2)
    degrees = {"lat_deg": np.degrees(lat), "lon_deg": np.degrees(lon), "height": height}
    return degrees | covariance_columns(local, "enu")


# The table of fixes: one row for each target and epoch.

Labels = Callable[[int, bool], Columns]


def fix_columns(
    fix: Fix,
    *,
    targets: Sequence[tuple[int, tuple[str, ...]]] | None = None,
    labels: Labels | None = None,
    dimension: int = 3,
    constrained: bool | None = None,
) -> Columns:
    """Return the table of fixes, one row for each target and epoch.

    Parameters
    ----------
    fix : Fix
        One fix, or a batch (n,) of fixes.
    targets : sequence of (int, tuple of str), optional
        Number of each target and the names of its position, velocity and acceleration. By default, the targets of the
        layout.
    labels : callable of (int, bool), optional
        Returns the columns that identify the rows of a target, such as `epoch` and `target`. Arguments: number of the
        target, and whether the target has one position for each epoch.
    dimension : int
        Dimension of the positions if the fix estimates no position.
    constrained : bool, optional
        Whether the table has the columns `active` and `multipliers`. By default, it has them if a constraint is active.

    Returns
    -------
    dict of str to array (rows,)
        Columns in metres, seconds and degrees; NaN marks a missing number.
    """
    flat = fix if len(fix.shape) == 1 else fix.flat()
    if targets is None:
        targets = list(enumerate(_states_of(fix))) or [(0, ("position",))]
    if labels is None:
        labels = _numbered(flat, len(targets))
    words = _text_columns(
        flat, any(map(len, fix.active.ravel())) if constrained is None and fix.active is not None else bool(constrained)
    )
    return join_tables([_target_rows(flat, names, i, labels, dimension, words) for i, names in targets])


def _states_of(fix: Fix) -> list[tuple[str, ...]]:
    """Return the names of position, velocity and acceleration in the layout, for each estimated target.

    A fix with one target has the names "position" and so on; with several targets, the names end in "[0]", "[1]" and so
    on.
    """
    names = [slot.name for slot in (*fix.layout.shared, *fix.layout.local)]
    numbers = [name.removeprefix("position") for name in names if name.partition("[")[0] == "position"]
    return [tuple(f"{word}{number}" for word in _STATES if f"{word}{number}" in names) for number in numbers]


def _numbered(fix: Fix, targets: int) -> Labels:
    """Return a function for the argument `labels` of `fix_columns`, for fixes without names.

    Its columns are the label, the index in the batch, the index of the epoch and the index of the target. A column is
    omitted if it has only one value, or if the fixes have no labels. `targets` is the number of targets.
    """
    n, k = len(fix), fix.layout.epochs

    def labels(target: int, by_epoch: bool) -> Columns:
        count = k if by_epoch else 1
        rows = n * count
        own = {} if fix.labels is None else _repeat(count, label=[_plain_label(one) for one in fix.labels])
        number = {"number": np.arange(rows) // count} if n > 1 else {}
        epoch = {"epoch": np.tile(np.arange(k), n)} if by_epoch else {}
        return own | number | epoch | ({"target": np.full(rows, target)} if targets > 1 else {})

    return labels


def _plain_label(label: Any) -> Any:
    """Return a label as a value of files: texts and whole numbers are unchanged, other labels become text."""
    value = label.item() if isinstance(label, np.generic) and not isinstance(label, np.datetime64) else label
    return value if isinstance(value, str | int) else str(value)


def _target_rows(
    fix: Fix, names: Sequence[str], target: int, labels: Labels, dimension: int, words: Mapping[str, Sequence[str]]
) -> Columns:
    """Return the rows of one target; `names` holds the names of its position, velocity and acceleration.

    `target` is its number, and `labels` and `dimension` are as in `fix_columns`. The columns in `words` (n texts each)
    are appended; every fix repeats its text in all its rows. A target that the fix does not estimate gets NaN numbers.
    """
    estimated = names[0] in {slot.name for slot in (*fix.layout.shared, *fix.layout.local)}
    position = fix.take(names[0]) if estimated else np.full((len(fix), dimension), np.nan)
    n, d = len(fix), position.shape[-1]
    # If the target has one position for each epoch of a run, its shape is (1, k, d). Its covariance exists only if the
    # solver was asked to compute it.
    by_epoch = position.ndim == 3
    count = position.shape[1] if by_epoch else 1
    has_covariance = estimated and (not by_epoch or fix.local is not None)
    columns = dict(labels(target, by_epoch))
    position = position.reshape(n * count, d)
    covariance, undetermined = np.full((n * count, d, d), np.nan), np.zeros((n * count, d), dtype=bool)
    if has_covariance:
        covariance = fix.covariance(names[0]).reshape(n * count, d, d)
        undetermined = fix.undetermined(names[0]).reshape(n * count, d)
    # Before NaN replaces undetermined axes: east, north and up are combinations of x, y and z.
    local = geodetic_columns(fix.frame, position, covariance)
    covariance, undetermined_names = without_open(covariance, undetermined, "xyz")
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    columns |= _repeat(count, status=[one.label for one in statuses_of(fix.code)], reason=list(fix.reason))
    columns |= {axis: position[:, i] for i, axis in enumerate("xyz"[:d])}
    columns |= {f"sigma_{axis}": sigma[:, i] for i, axis in enumerate("xyz"[:d])}
    columns |= covariance_columns(covariance, "xyz")
    for name in names[1:] if estimated else ():
        letter = _RATES[name.partition("[")[0]]
        sigmas = fix.sigma(name).reshape(n * count, d) if has_covariance else np.full((n * count, d), np.nan)
        if has_covariance:
            undetermined = fix.undetermined(name).reshape(n * count, d)
            sigmas = np.where(undetermined, np.nan, sigmas)
            rates = [f"{letter}{axis}" for axis in "xyz"]
            undetermined_names = _append_names(undetermined, rates, undetermined_names)
        for values, prefix in ((fix.take(name).reshape(n * count, d), letter), (sigmas, f"sigma_{letter}")):
            columns |= {f"{prefix}{axis}": v for axis, v in zip("xyz", values.T, strict=False)}
    if "cov_ee" in local:
        # A standard deviation above this limit means an undetermined axis; no limit without an estimate.
        limit = np.repeat(fix.widest(names[0]), count) if estimated else np.full(n * count, np.inf)
        local, undetermined_names = _hide_undetermined_levels(local, limit, undetermined_names)
    columns |= local
    # Compute in blocks: the eigenvectors of a long table need more memory than the table.
    blocks = np.array_split(covariance, 1 + len(covariance) // _BLOCK)
    semi_axes = np.concatenate([error_ellipse(block)[0] for block in blocks])
    # `error_ellipse` sorts in ascending order; the first column is the longest axis.
    columns |= {f"ellipse95_{i + 1}": semi_axes[:, d - 1 - i] for i in range(d)}
    for name, numbers in {"cost": fix.cost, "dof": fix.dof, "p_value": np.asarray(fix.p_value)}.items():
        columns[name] = np.repeat(numbers, count)
    columns["unchecked"] = np.repeat(np.atleast_1d(fix.unchecked), count)
    tails = fix.has(Status.TAILS)
    columns |= {"tails": np.repeat(np.atleast_1d(tails), count)} if tails.any() else {}
    columns["alternatives"] = np.repeat(np.isfinite(fix.alternatives.gap).sum(-1), count)
    columns |= {"undetermined": np.array(undetermined_names, dtype=object)} if any(undetermined_names) else {}
    return columns | _repeat(count, **words)


def without_open(covariance: Array, undetermined: Array, axes: str) -> tuple[Array, list[str]]:
    """Return covariances (n, d, d) with NaN for undetermined axes, and the names of these axes (n).

    `undetermined` (n, d) is true for each undetermined axis.
    """
    hidden = np.where(undetermined[:, :, None] | undetermined[:, None, :], np.nan, covariance)
    return hidden, _append_names(undetermined, axes, [""] * len(undetermined))


def _append_names(undetermined: Array, names: Sequence[str], before: Sequence[str]) -> list[str]:
    """Return the texts in `before` (n), extended by the names of the undetermined entries of each row.

    `undetermined` (n, d) is True for each undetermined entry, and `names` are the d names of the entries.
    """
    if not undetermined.any():
        return list(before)
    new_names = [[names[i] for i in np.flatnonzero(row).tolist()] for row in undetermined]
    return ["; ".join([*([old] if old else []), *new]) for old, new in zip(before, new_names, strict=True)]


_LEVEL = {"e": "east", "n": "north", "u": "up"}


def _hide_undetermined_levels(local: Columns, limit: Array, before: Sequence[str]) -> tuple[Columns, list[str]]:
    """Return geodetic columns with NaN for undetermined axes (east, north, up), and the undetermined names of each row.

    An axis is undetermined if its standard deviation exceeds `limit` (n,), m. `before` holds the names (n texts) that
    other columns already gave. `local` are the columns of `geodetic_columns`.
    """
    axes = [axis for axis in _LEVEL if f"cov_{axis}{axis}" in local]
    with np.errstate(invalid="ignore"):
        undetermined = np.stack([local[f"cov_{axis}{axis}"] > limit**2 for axis in axes], axis=-1)
    if not undetermined.any():
        return local, list(before)
    numbered = list(enumerate(axes))
    pairs = {f"cov_{a}{b}": undetermined[:, i] | undetermined[:, j] for i, a in numbered for j, b in numbered[i:]}
    hidden = {
        name: np.where(pairs[name], np.nan, values) if name in pairs else values for name, values in local.items()
    }
    return hidden, _append_names(undetermined, [_LEVEL[axis] for axis in axes], before)


def level_covariance(columns: Columns, i: int) -> Array:
    """Return the covariance (d, d), m^2, of row `i` along east, north, up; without geodetic columns along x, y, z."""
    axes = "enu" if "cov_ee" in columns else "xyz"
    # Positions in the plane have no column of the third axis; columns hold the upper triangle only.
    axes = axes[: 3 if f"cov_{2 * axes[2]}" in columns else 2]
    pairs = [[f"cov_{min(a, b, key=axes.index)}{max(a, b, key=axes.index)}" for b in axes] for a in axes]
    return np.array([[float(columns[name][i]) for name in row] for row in pairs])


def _repeat(count: int, **texts: Sequence[str]) -> Columns:
    """Return texts (n,) as columns; each text is repeated `count` times, once for each row of its fix."""
    return {name: np.repeat(np.array(list(values), dtype=object), count) for name, values in texts.items()}


def _text_columns(fix: Fix, constrained: bool) -> dict[str, list[str]]:
    """Return text columns (n entries each): proof, findings, chart, active constraints and suspects.

    `constrained` selects the columns of active constraints. "A; B" means A and B together. "A | B" means either A or B
    explains the data.
    """
    texts = {"proof": [PROOFS[number] for number in fix.claims.proof.tolist()]}
    findings: Any = fix.findings  # In a batch, each fix has one tuple.
    found = {each: "; ".join(one.label for one in each) for each in set(findings)}
    texts["findings"] = [found[each] for each in findings]
    texts["chart"] = [""] * len(fix) if fix.chart is None else list(fix.chart.name)
    if constrained:
        active_sets = [()] * len(fix) if fix.active is None else fix.active
        texts["active"] = ["; ".join(active.name for active in each) for each in active_sets]
        texts["multipliers"] = ["; ".join(f"{active.multiplier:.6g}" for active in each) for each in active_sets]
    if fix.explanations is not None:
        texts["suspects"] = [" | ".join("; ".join(e.names) for e in each) for each in fix.explanations]
    return texts


# Values of a single fix that its table row does not hold.


def explanations_of(fix: Fix) -> tuple[Explanation, ...]:
    """Return the explanations of a single fix: sets of suspects whose exclusion makes the data consistent."""
    return () if fix.explanations is None else tuple(fix.explanations[()])


def active_of(fix: Fix) -> tuple[Active, ...]:
    """Return the constraints that are active at a single fix: equalities, and bounds that the fix has reached."""
    return () if fix.active is None else tuple(fix.active[()])


def alternative_position(fix: Fix, x: Array) -> Array:
    """Return the position (d,) in a parameter vector `x`, m; for several targets (targets, d)."""
    # With two targets, the names are position[0] and position[1].
    names = [slot.name for slot in (*fix.layout.shared, *fix.layout.local) if slot.name.partition("[")[0] == "position"]
    parts = [fix.layout.take(x, name) for name in names]
    return parts[0] if len(parts) == 1 else np.stack(parts)


def alternative_latlon(fix: Fix, x: Array) -> Array | None:
    """Return latitude, longitude (degrees) and ellipsoidal height (metres), (3,), of the position in a vector `x`.

    For several targets the shape is (targets, 3). The result is None without a frame on Earth.
    """
    position = alternative_position(fix, x)
    if fix.frame.kind == "cartesian":
        return None
    lat, lon, height = fix.frame.to_geodetic(position)
    return np.stack([np.degrees(lat), np.degrees(lon), height], axis=-1)


def bias_records(fix: Fix, seen: Observability | None) -> list[dict[str, Any]]:
    """Return one record for each bias of a single fix: name, member, value, sigma, unit, from_data.

    Parameters
    ----------
    fix : Fix
        A single fix.
    seen : Observability, optional
        Observability of the biases. It gives `from_data`, the share of the information that comes from the data.
        Without `seen`, the share is NaN.

    A member that the data do not determine has the sigma NaN and the additional key `undetermined`.
    """
    rows = []
    for slot in fix.layout.shared:
        if not slot.members:
            continue
        values, sigmas = fix.take(slot.name), np.where(fix.undetermined(slot.name), np.nan, fix.sigma(slot.name))
        shares = np.full(slot.size, np.nan) if seen is None else seen.from_data[slot.start : slot.start + slot.size]
        for member, value, sigma, share in zip(slot.entries, values, sigmas, shares, strict=True):
            record = {"name": slot.name, "member": member, "value": float(value), "sigma": float(sigma)}
            rows.append(record | {"unit": slot.unit, "from_data": float(share)})
        # The last `slot.size` records belong to this bias.
        for i in np.flatnonzero(fix.undetermined(slot.name)).tolist():
            rows[len(rows) - slot.size + i]["undetermined"] = True
    return rows


def fix_detail(fix: Fix, seen: Observability | None = None, *, reweighted: bool = False) -> dict[str, Any]:
    """Return the values of a single fix that its table row does not hold, for JSON.

    Parameters
    ----------
    fix : Fix
        A single fix.
    seen : Observability, optional
        Observability of the biases.
    reweighted : bool
        Whether the solver changed the weights of rows; if so, the weights are part of the result.
    """
    others = fix.alternatives
    shown = np.isfinite(others.gap)
    return {
        "sentence": fix.sentence,
        "findings": [one.label for one in fix.findings],
        "unchecked": bool(fix.unchecked),
        "gap_to_infinity": None if fix.infinity is None else fix.infinity,
        "chart": _chart_json(fix),
        "determined": None if not is_shown(fix) or (known := fix.determined) is None else known.to_dict(),
        "alternatives": [
            _alternative(fix, x, gap, doubt)
            for x, gap, doubt in zip(others.x[shown], others.gap[shown], others.doubt[shown], strict=True)
        ],
        "explanations": [asdict(explanation) for explanation in explanations_of(fix)],
        "weights": fix.weights if reweighted else None,
        "active": [{"name": a.name, "multiplier": a.multiplier} for a in active_of(fix)],
        "multipliers": [a.multiplier for a in active_of(fix)],
        "certificate": asdict(fix.certificate),
        "biases": bias_records(fix, seen),
        "not_separable": [] if seen is None else list(seen.sentences),
        "of_each_epoch": {name: values for name, values in fix.bias.items() if not fix.layout.find(name)[1]},
    }


def _alternative(fix: Fix, x: Array, gap: float, doubt: float) -> dict[str, Any]:
    """Return the record of an alternative with the vector `x`; on Earth with latitude, longitude and height."""
    on_earth = alternative_latlon(fix, x)
    record = {"gap": gap, "probability": doubt, "position": alternative_position(fix, x)}
    return record if on_earth is None else record | {"latlon": on_earth}


def _chart_json(fix: Fix) -> dict[str, Any] | None:
    """Return the coordinates in which a single fix is Gaussian, with its mean and covariance.

    Without a chart or without a fix, the result is None.
    """
    chart = fix.chart
    if chart is None or not bool(fix.answered):
        return None
    record: dict[str, Any] = {"name": str(chart.name), "centre": chart.centre}
    # The mean and covariance in metres are in the table row; other charts need their parameters here.
    if chart.kind == INVERSE_RANGE:
        record |= {"distance": chart.distance, "direction": chart.direction, "basis": chart.basis}
        record |= {"mean": chart.mean, "covariance": chart.spread}
    # Bounds truncate the distribution: the mean differs from the fix, and intervals replace sigma.
    if chart.cut_off:
        record["mean"] = fix.gaussian()[0][: chart.position.shape[-1]]
        record |= {f"{axis}95": fix.interval(axis) for axis in AXES[: chart.position.shape[-1]]}
    if chart.kind != CURVED and not fix.undetermined().any():
        record["range95"] = fix.interval("range")
    return record

"""Write fixes for machines: CSV, Parquet, JSON, GeoJSON."""

from __future__ import annotations

import json
import logging
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.base.errors import InvalidProblem
from optloc.base.status import Status
from optloc.base.types import Array
from optloc.bounds.observability import Observability
from optloc.cli.fixed import Columns, Fixed
from optloc.problem.fix import Active, Explanation, Fix
from optloc.problem.loss import LOSSES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Numbers as people read them.


def with_sigma(value: float, sigma: float, unit: str) -> str:
    """Return a number with its standard deviation, rounded to it; a constraint may leave it none."""
    unit = unit if unit != "1" else ""
    if sigma <= 1e-12 * (1.0 + abs(value)):
        return f"{value:.10g} {unit} (held)"
    if not np.isfinite(sigma):
        return f"{value:.6g} {unit}"
    digits = int(max(0, 1 - np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} ± {sigma:.{digits}f} {unit}"


# Biases of a registration as records, and as tables for people.

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


LOG = logging.getLogger("optloc.write")


def write_text(path: Path, text: str) -> None:
    """Write a text file, or standard output where the path is "-"; raise InvalidProblem where that fails."""
    if str(path) == "-":
        sys.stdout.write(text + "\n")
        return
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise _unwritable(path, error) from None
    LOG.info("wrote %s", path)


def _unwritable(path: Path, error: OSError) -> InvalidProblem:
    return InvalidProblem(f"the file cannot be written ({error.strerror or error})", str(path), "choose another place")


def write_table(path: Path, columns: Columns) -> None:
    """Write a long table as CSV or Parquet, by the ending of its name; NaN is an empty cell."""
    import pyarrow as pa

    if path.suffix.lower() not in {".csv", ".parquet", ".pq"}:
        raise InvalidProblem(
            f"results of type {path.suffix or path.name!r} are unknown", str(path), "use .csv or .parquet"
        )
    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    try:
        if path.suffix.lower() == ".csv":
            from pyarrow import csv

            csv.write_csv(table, path, csv.WriteOptions(quoting_style="needed"))
        else:
            from pyarrow import parquet

            parquet.write_table(table, path)
    except OSError as error:
        raise _unwritable(path, error) from None
    LOG.info("wrote %s: %d rows", path, table.num_rows)


def saved(figure: Figure, path: Path) -> None:
    """Write a picture; raise InvalidProblem where that fails."""
    from optloc.plot import save

    try:
        save(figure, path)
    except (OSError, ValueError) as error:
        raise InvalidProblem(f"the picture cannot be written ({error})", str(path), "use .png, .svg or .pdf") from None
    LOG.info("wrote %s", path)


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


def dumps(value: Any) -> str:
    """Return strict JSON."""
    return json.dumps(plain(value), allow_nan=False, indent=2)


def fixed_json(fixed: Fixed) -> dict[str, Any]:
    """Return all fixes of a file as one JSON value; lengths in metres, angles in degrees."""
    frame = fixed.loaded.problem.frame
    rows = _records(fixed.columns)
    per_fix = [_detail(fix, fixed.seen) for fix in fixed.singles]
    # One row a fix wherever it has one target and one epoch; else what belongs to the fix stands with the run.
    single = len(rows) == len(per_fix)
    stages = {stage.name: stage for fix in fixed.fixes for stage in fix.stages}
    return {
        "file": fixed.loaded.source,
        "title": fixed.loaded.title,
        "frame": {"kind": frame.kind, "origin_deg": None if frame.origin is None else _origin(frame.origin)},
        "fixes": [row | detail for row, detail in zip(rows, per_fix, strict=True)] if single else rows,
        "runs": [] if single else per_fix,
        "stages": [{"name": s.name, "detail": s.detail} for s in stages.values()],
    }


def _origin(origin: tuple[float, float, float]) -> list[float]:
    return [*np.degrees(origin[:2]).tolist(), origin[2]]


def _records(columns: Columns) -> list[dict[str, Any]]:
    lists = {name: plain(values) for name, values in columns.items()}
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def _detail(fix: Fix, seen: Observability | None) -> dict[str, Any]:
    certificate: Any = fix.certificate[()]
    others = fix.alternatives
    shown = np.isfinite(others.gap)
    return {
        "sentence": Status(int(fix.code)).sentence,
        "alternatives": [
            {"gap": gap, "probability": doubt, "position": alternative_position(fix, x)}
            for x, gap, doubt in zip(others.x[shown], others.gap[shown], others.doubt[shown], strict=True)
        ],
        "explanations": [asdict(explanation) for explanation in explanations_of(fix)],
        "weights": fix.weights if any(stage.name in LOSSES for stage in fix.stages) else None,
        "active": [{"name": a.name, "multiplier": a.multiplier} for a in active_of(fix)],
        "certificate": {part.name: getattr(certificate, part.name) for part in fields(certificate)},
        "biases": bias_records(fix, seen),
        "not_separable": [] if seen is None else list(seen.sentences),
        "of_each_epoch": {name: values for name, values in fix.bias.items() if not fix.layout.find(name)[1]},
    }


def explanations_of(fix: Fix) -> tuple[Explanation, ...]:
    """Return what explains the data of a single fix."""
    return () if fix.explanations is None else tuple(fix.explanations[()])


def active_of(fix: Fix) -> tuple[Active, ...]:
    """Return the constraints that hold a single fix with equality."""
    return () if fix.active is None else tuple(fix.active[()])


def alternative_position(fix: Fix, x: Array) -> Array:
    """Return the positions of all targets of a parameter vector, metres."""
    names = [slot.name for slot in (*fix.layout.shared, *fix.layout.local) if slot.name.partition("[")[0] == "position"]
    parts = [fix.layout.take(x, name) for name in names]
    return parts[0] if len(parts) == 1 else np.stack(parts)


def geojson(fixed: Fixed, points: int = 72) -> dict[str, Any]:
    """Return stations, fixes and their 95 % ellipses as a GeoJSON feature collection (RFC 7946)."""
    problem = fixed.loaded.problem
    if not problem.frame.geodetic:
        raise InvalidProblem(
            "GeoJSON needs positions on Earth, but the frame is cartesian",
            fixed.loaded.source,
            'give a [frame] of kind "geodetic", "ecef" or "enu"',
        )
    features = []
    place = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    for name, point in zip(problem.stations.names, _degrees(fixed, place), strict=True):
        features.append(_feature("Point", point, {"role": "station", "name": name}))
    skipped = {"x", "y", "z", "lat_deg", "lon_deg", "height"}
    for row in _records(fixed.columns):
        if row["lat_deg"] is None:
            continue
        about = {name: value for name, value in row.items() if name not in skipped and not name.startswith("cov_")}
        features.append(_feature("Point", [row["lon_deg"], row["lat_deg"], row["height"]], {"role": "fix", **about}))
        if row["cov_ee"] is not None:
            ring = _ring(fixed, row, points)
            features.append(
                _feature("Polygon", [ring], {"role": "ellipse95", "epoch": row["epoch"], "target": row["target"]})
            )
    return {"type": "FeatureCollection", "features": features}


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def _degrees(fixed: Fixed, position: Array) -> list[list[float]]:
    lat, lon, height = fixed.loaded.problem.frame.to_geodetic(position)
    return np.stack([np.degrees(lon), np.degrees(lat), height], axis=-1).tolist()  # type: ignore[no-any-return]


def _ring(fixed: Fixed, row: dict[str, Any], points: int) -> list[list[float]]:
    """Return the closed ring, counter-clockwise, of the horizontal 95 % ellipse of a row."""
    from optloc.base.linalg import error_ellipse

    covariance = np.array([[row["cov_ee"], row["cov_en"]], [row["cov_en"], row["cov_nn"]]])
    semi_axes, directions = error_ellipse(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False) * np.sign(np.linalg.det(directions))
    plane = (np.stack([np.cos(angle), np.sin(angle)], axis=-1) * semi_axes) @ directions.T
    frame = fixed.loaded.problem.frame
    d = fixed.loaded.problem.dimension
    centre = np.array([row[axis] for axis in "xyz"[:d]])
    ring = _degrees(fixed, centre + plane @ frame.enu_axes(centre)[:2])
    return [*ring, ring[0]]

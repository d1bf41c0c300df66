"""The fixes of a file: one problem or its epochs in batches, as a long table, as JSON and as GeoJSON."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.linalg import error_ellipse
from optloc.base.types import Array, Status
from optloc.bounds.observability import Observability, observability
from optloc.cli.output import Columns, bar, covariance_columns, geodetic_columns, join_tables, records
from optloc.files import Loaded
from optloc.plot.outlines import (
    Pieces,
    earth_line,
    earth_points,
    feature,
    pieces_of,
    point_geometry,
    polygon_geometry,
    polygons,
)
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Active, Explanation, Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem

LOG = logging.getLogger("optloc.problem.fix")

CHUNK = 1024
"""Epochs that are solved at once: large enough for batched kernels, small enough for a bar that moves."""

_RATES = {"velocity": "v", "acceleration": "a"}
# Corners of an ellipse on a map, one for every 5 degrees: no edge is seen at any zoom that shows the whole.
_CORNERS = 72


@dataclass(frozen=True, slots=True)
class FileFixes:
    """All fixes of a file.

    Parameters
    ----------
    loaded : Loaded
        The file.
    fixes : tuple of Fix
        Batches of epochs in order; one fix without batch axes where the epochs share unknowns.
    columns : dict of str to array
        The long table.
    reweighted : bool
        Whether the method gave rows other weights than the file states.
    seen : Observability, optional
        What the data of a run show of its biases.
    """

    loaded: Loaded
    fixes: tuple[Fix, ...]
    columns: Columns
    reweighted: bool
    seen: Observability | None = None

    def passes(self, allow: Sequence[Status] = ()) -> bool:
        """Return whether every status is ok, or among those that are allowed."""
        return all(bool(np.isin(fix.code, [Status.OK, *allow]).all()) for fix in self.fixes)

    @property
    def problem(self) -> Problem:
        """Return what was solved: a batch of epochs where they share nothing, else the run."""
        return by_epoch(self.loaded.problem) if separable(self.loaded.problem) else self.loaded.problem

    @property
    def singles(self) -> Iterator[Fix]:
        """Yield the fixes one by one."""
        for fix in self.fixes:
            flat = fix if fix.shape else fix.flat()
            yield from (flat[i] for i in range(len(flat)))


def fix_file(loaded: Loaded, method: str, quiet: bool) -> FileFixes:
    """Return the fixes of a file; a bar moves on a terminal's standard error."""
    from optloc.solvers import solve

    apart = separable(loaded.problem)
    # Epochs that share nothing are a batch of problems; else the whole run is one.
    problem = by_epoch(loaded.problem) if apart else loaded.problem
    fixes, tables, reweighted = [], [], False
    with bar(loaded.title, loaded.problem.epochs if apart else 1, quiet) as advance:
        for first, part in _chunks(problem, loaded.problem.epochs) if apart else [(None, problem)]:
            fix = solve(part, method=method)
            _log_stages(fix)
            fixes.append(fix)
            tables.append(fix_columns(loaded, fix, first))
            # A loss or a search for suspects shows in the weights, whatever the method is called.
            reweighted |= bool((fix.weights != part.weight)[fix.answered].any())
            advance(len(fix) if apart else 1)
    seen = None if apart else _observe(problem, fixes[0])
    return FileFixes(loaded, tuple(fixes), join_tables(tables), reweighted, seen)


def _chunks(batch: Problem, count: int) -> Iterator[tuple[int, Problem]]:
    for first in range(0, count, CHUNK):
        yield first, batch.take(np.arange(first, min(first + CHUNK, count)))


def _log_stages(fix: Fix) -> None:
    for stage in fix.stages:
        LOG.info("%s: %.3g ms%s", stage.name, 1e3 * stage.seconds, f", {stage.detail}" if stage.detail else "")


def _observe(problem: Problem, fix: Fix) -> Observability | None:
    """Return what the data show of biases, at the fix or else at an alternative; None without either, or a bias."""
    points = [x for x in (fix.x, *fix.alternatives.x) if np.isfinite(x).all()]
    biased = any(slot.members for slot in fix.layout.shared)
    return observability(problem, points[0]) if biased and points else None


# The long table: one row for each target and epoch.


def fix_columns(loaded: Loaded, fix: Fix, first: int | None) -> Columns:
    """Return the table of fixes.

    Parameters
    ----------
    loaded : Loaded
        Names of epochs and targets.
    fix : Fix
        A batch (n,) of single epochs, or the fix of a whole run, without batch axes.
    first : int or None
        Epoch of the first fix of a batch; None: the fix belongs to the whole run.

    Returns
    -------
    dict of str to array (rows,)
        Metres, seconds and degrees; NaN where there is no number.
    """
    motions = loaded.problem.motions
    flat = fix if first is not None else fix.flat()
    # A file of known targets alone (a calibration) has a row for each of them all the same.
    shown = [i for i, m in enumerate(motions) if m.known is None] or range(len(motions))
    targets = [_of_target(loaded, flat, first, i, state_names(i, len(motions), motions[i].order)) for i in shown]
    return join_tables(targets)


def _of_target(loaded: Loaded, fix: Fix, first: int | None, target: int, names: Sequence[str]) -> Columns:
    """Return the rows of one target: `names` are those of its position, velocity and acceleration."""
    estimated = names[0] in {slot.name for slot in (*fix.layout.shared, *fix.layout.local)}
    position = fix.take(names[0]) if estimated else np.full((len(fix), loaded.problem.dimension), np.nan)
    n, d = len(fix), position.shape[-1]
    # A position of each epoch of a run has an axis of epochs (1, k, d), and a covariance where that was asked for.
    spread = position.ndim == 3
    count = position.shape[1] if spread else 1
    told = estimated and (not spread or fix.local is not None)
    columns = _labels(loaded, n, first, target, spread)
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
    columns |= geodetic_columns(loaded.problem.frame, position, covariance)
    semi_axes, _ = error_ellipse(covariance)
    # Longest axis first.
    columns |= {f"ellipse95_{i + 1}": semi_axes[:, d - 1 - i] for i in range(d)}
    for name, numbers in {"cost": fix.cost, "dof": fix.dof, "p_value": np.asarray(fix.p_value)}.items():
        columns[name] = np.repeat(numbers, count)
    columns["alternatives"] = np.repeat(np.isfinite(fix.alternatives.gap).sum(-1), count)
    return columns | _repeat(count, **_told_in_words(loaded, fix))


def level_covariance(columns: Columns, i: int) -> Array:
    """Return the covariance (d, d) of one row in level axes: east, north and up where there is a ground."""
    axes = "enu" if "cov_ee" in columns else "xyz"
    axes = axes[: 3 if f"cov_{2 * axes[2]}" in columns else 2]
    pairs = [[f"cov_{min(a, b, key=axes.index)}{max(a, b, key=axes.index)}" for b in axes] for a in axes]
    return np.array([[float(columns[name][i]) for name in row] for row in pairs])


def _repeat(count: int, **texts: Sequence[str]) -> Columns:
    """Return texts of each fix (n,) as columns, each so often as the fix has rows."""
    return {name: np.repeat(np.array(list(values), dtype=object), count) for name, values in texts.items()}


def _told_in_words(loaded: Loaded, fix: Fix) -> dict[str, list[str]]:
    """Return the proof of each fix, the constraints that hold it, and its suspects: "A; B" together, "A | B" either."""
    texts = {"proof": [getattr(c, "proof", "unknown") for c in fix.certificate]}
    texts["findings"] = ["; ".join(one.label for one in each) for each in fix.findings]
    texts["chart"] = [""] * len(fix) if fix.chart is None else list(fix.chart.name)
    if loaded.problem.constraints:
        held = [()] * len(fix) if fix.active is None else fix.active
        texts["active"] = ["; ".join(active.name for active in each) for each in held]
        texts["multipliers"] = ["; ".join(f"{active.multiplier:.6g}" for active in each) for each in held]
    if fix.explanations is not None:
        texts["suspects"] = [" | ".join("; ".join(e.names) for e in each) for each in fix.explanations]
    return texts


def _labels(loaded: Loaded, n: int, first: int | None, target: int, spread: bool) -> Columns:
    """Return epoch, time and target of every row."""
    k = loaded.problem.epochs
    part = slice(0, k) if first is None else slice(first, first + n)
    if first is None and not spread:
        motion = loaded.problem.motions[target]
        time = loaded.times[0] if motion.reference is None else motion.reference
        epochs, times = [loaded.epochs[0] if k == 1 else "run"], np.array([time])
    else:
        epochs, times = list(loaded.epochs[part]), loaded.times[part]
    names = list(loaded.targets[part]) if loaded.own_epochs else [loaded.targets[target]] * len(epochs)
    return {"epoch": np.array(epochs, dtype=object), "time": times, "target": np.array(names, dtype=object)}


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


# All of it for machines.


def fixes_json(found: FileFixes) -> dict[str, Any]:
    """Return all fixes of a file as one JSON value; lengths in metres, angles in degrees."""
    from optloc.uncertainty.radii import accuracy

    frame, rows = found.loaded.problem.frame, records(found.columns)
    per_fix = [_detail(fix, found) | _unnoticed(fix, found, i) for i, fix in enumerate(found.singles)]
    # One row a fix wherever it has one target and one epoch; else what belongs to the fix stands with the run.
    single = len(rows) == len(per_fix)
    if len(rows) == 1 == len(per_fix):  # of one fix: the radii take milliseconds each
        per_fix[0]["accuracy"] = asdict(accuracy(level_covariance(found.columns, 0)))
    stages = {stage.name: stage for fix in found.fixes for stage in fix.stages}
    origin = None if frame.origin is None else [*np.degrees(frame.origin[:2]).tolist(), frame.origin[2]]
    return {
        "file": found.loaded.source,
        "title": found.loaded.title,
        "frame": {"kind": frame.kind, "origin_deg": origin},
        "fixes": [row | detail for row, detail in zip(rows, per_fix, strict=True)] if single else rows,
        "runs": [] if single else per_fix,
        "stages": [{"name": s.name, "detail": s.detail} for s in stages.values()],
    }


def _detail(fix: Fix, found: FileFixes) -> dict[str, Any]:
    certificate: Any = fix.certificate[()]
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
        "weights": fix.weights if found.reweighted else None,
        "active": [{"name": a.name, "multiplier": a.multiplier} for a in active_of(fix)],
        "certificate": {part.name: getattr(certificate, part.name) for part in fields(certificate)},
        "biases": bias_records(fix, found.seen),
        "not_separable": [] if found.seen is None else list(found.seen.sentences),
        "of_each_epoch": {name: values for name, values in fix.bias.items() if not fix.layout.find(name)[1]},
    }


def _unnoticed(fix: Fix, found: FileFixes, item: int) -> dict[str, Any]:
    """Return which errors of the stations a search for suspects would not have noticed; nothing where nobody asked."""
    if fix.explanations is None or not fix.answered:
        return {}
    from optloc.cli.crlb import reliability_json, reliability_of

    problem = found.problem
    one = problem.flat().take(np.array([item])) if problem.batch_shape else problem
    return {"unnoticed": reliability_json(reliability_of(one, fix.x, fix.suspects))}


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


def geojson(found: FileFixes) -> dict[str, Any]:
    """Return stations, fixes and what holds 95 % as a GeoJSON feature collection (RFC 7946).

    An ellipse where it covers, else the outline of the region; a curved fix without one has none.
    """
    problem = found.loaded.problem
    if not problem.frame.geodetic:
        what = "GeoJSON needs positions on Earth, but the frame is cartesian"
        raise InvalidProblem(what, found.loaded.source, 'give a [frame] of kind "geodetic", "ecef" or "enu"')
    place = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    features = [
        feature(point_geometry(point), {"role": "station", "name": name})
        for name, point in zip(problem.stations.names, earth_points(problem.frame, place), strict=True)
    ]
    outlines = _outlines(found)
    skipped = {"x", "y", "z", "lat_deg", "lon_deg", "height"}
    for number, row in enumerate(records(found.columns)):
        if row["lat_deg"] is None:
            continue
        about = {name: value for name, value in row.items() if name not in skipped and not name.startswith("cov_")}
        point = np.array([row["lon_deg"], row["lat_deg"], row["height"]])
        features.append(feature(point_geometry(point), {"role": "fix", **about}))
        about = {"epoch": row["epoch"], "target": row["target"]}
        if pieces := outlines.get(number, ()):
            features.append(feature(_region(problem, row, pieces), {"role": "region95", **about}))
        elif row["cov_ee"] is not None and number not in outlines:
            features.append(feature(_ellipse(problem, row), {"role": "ellipse95", **about}))
    return {"type": "FeatureCollection", "features": features}


def _outlines(found: FileFixes) -> dict[int, Pieces]:
    """Return the convex parts of the regions of rows whose ellipses do not cover; empty where they are not known."""
    charts = [fix.chart for fix in found.fixes]
    kinds = [np.ravel(chart.kind) for chart in charts if chart is not None]
    # Fixes of one position each: a row is a fix.
    if len(kinds) != len(charts) or sum(map(len, kinds)) != len(found.columns["x"]):
        return {}
    pieces = [part for fix in found.fixes for part in pieces_of(found.loaded.problem, fix)]
    return {int(i): pieces[i] for i in np.flatnonzero(np.concatenate(kinds) != CARTESIAN)}


def _region(problem: Problem, row: dict[str, Any], pieces: Pieces) -> dict[str, Any]:
    """Return the plan of a region of convex parts as a geometry."""
    centre = np.array([row[axis] for axis in "xyz"[: problem.dimension]])
    axes = problem.frame.enu_axes(centre)[:2]
    plan = polygons([(piece - centre) @ axes.T for piece in pieces])
    return polygon_geometry([[earth_line(problem.frame, centre + line @ axes) for line in each] for each in plan])


def _ellipse(problem: Problem, row: dict[str, Any]) -> dict[str, Any]:
    """Return the horizontal 95 % ellipse of a row as a geometry, counter-clockwise."""
    covariance = np.array([[row["cov_ee"], row["cov_en"]], [row["cov_en"], row["cov_nn"]]])
    semi_axes, directions = error_ellipse(covariance)
    # Eigenvectors may be left-handed: the sign of the turn makes up for it.
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1) * np.sign(np.linalg.det(directions))
    plane = (np.stack([np.cos(angle), np.sin(angle)], axis=-1) * semi_axes) @ directions.T
    plane[-1] = plane[0]
    centre = np.array([row[axis] for axis in "xyz"[: problem.dimension]])
    return polygon_geometry([[earth_line(problem.frame, centre + plane @ problem.frame.enu_axes(centre)[:2])]])

"""Measurements of one table in SI units, still with the labels of their epochs and targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.chunk import Chunk, Context
from optloc.files.schema import MeasurementsTable
from optloc.files.sigmas import spread_of
from optloc.files.table import Table
from optloc.files.words import Units, join, kind_model, nearest
from optloc.models import Model
from optloc.types import Array
from optloc.units import Conversion


def chunks_of(
    section: MeasurementsTable, table: Table, stations: tuple[str, ...], where: str, speed: float, *, values: bool
) -> list[Chunk]:
    """Return the rows of one ``[[measurements]]`` table, one chunk for each of its kinds.

    Parameters
    ----------
    section : MeasurementsTable
        Settings.
    table : Table
        Rows.
    stations : tuple of str
        Names of the stations.
    where : str
        Place of the settings.
    speed : float
        Propagation speed, metres per second.
    values : bool
        Whether measured values are needed; without them a missing column z is NaN.
    """

    def chunk(kind: str, pick: Array) -> Chunk:
        part = Context(section, table.take(pick), stations, where, speed, values)
        return replace(_chunk(part, kind), row=pick, table=table)

    if section.kind is not None:
        return [chunk(section.kind, np.arange(table.count))]
    if not table.has("kind"):
        raise InvalidProblem("the key 'kind' is missing", where, 'write kind = "tdoa", or give the rows a column kind')
    labels = table.labels("kind")
    kinds, first = np.unique(labels.astype(str), return_index=True)
    made = []
    for kind, row in zip(kinds[np.argsort(first)].tolist(), np.sort(first).tolist(), strict=True):
        kind_model(kind, table.where("kind", row))
        made.append(chunk(kind, np.flatnonzero(labels == kind)))
    return made


def _chunk(c: Context, kind: str) -> Chunk:
    section, table = c.section, c.table
    model = kind_model(kind, join(c.where, "key 'kind'"))
    convention = section.azimuth if kind == "azimuth" else "east-counterclockwise"
    units = Units(model.quantity, c.speed, section.carrier_hz, convention)  # type: ignore[arg-type]
    _check_options(c, kind, model)
    unit = units.conversion(_unit(section, kind, c.where), join(c.where, "key 'unit'"))
    weight = _numbers(c, "weight", 1.0 if section.weight is None else section.weight)
    _check_weight(c, weight)
    z = _values(c, unit, weight)
    a, b = (_stations(c, key, needed) for key, needed in (("a", model.stations > 0), ("b", model.stations > 1)))
    if model.stations > 1:
        _check_pairs(c, kind, a, b)
    if section.positive == "b-farther" and model.stations > 1 and kind != "range_sum":
        a, b = b, a
    sigma, arrival, covariance = spread_of(c, model, units, unit, z)
    seconds = Units("time").conversion(section.time_unit, join(c.where, "key 'time_unit'")).factor
    return Chunk(
        kind, np.arange(table.count), z, a, b, weight, _correction(c, units, unit), unit,
        np.broadcast_to(unit.slope(z), z.shape), np.zeros(c.table.count),
        sigma, arrival, covariance,
        table.labels("epoch") if table.has("epoch") else None,
        table.times("time", seconds) if table.has("time") else None,
        table.labels("time") if table.has("time") else None,
        table.labels("target") if table.has("target") else None,
        section.excess and kind == "range_sum", table,
    )  # fmt: skip


def _check_options(c: Context, kind: str, model: Model) -> None:
    section = c.section
    if section.kind is None:
        return  # settings of a mixed table apply to the kinds that know them
    if section.excess and kind != "range_sum":
        raise InvalidProblem(
            f"{kind} has no excess path", join(c.where, "key 'excess'"), "leave it out; it is for range_sum"
        )
    if section.positive == "b-farther" and (model.stations < 2 or kind == "range_sum"):
        raise InvalidProblem(f"{kind} has no sign to turn", join(c.where, "key 'positive'"), "leave it out")
    if section.azimuth == "north-clockwise" and kind != "azimuth":
        raise InvalidProblem(f"{kind} is no azimuth", join(c.where, "key 'azimuth'"), "leave it out")


def _unit(section: MeasurementsTable, kind: str, where: str) -> str | None:
    if not isinstance(section.unit, dict):
        return section.unit
    if section.kind is None or kind in section.unit:
        return section.unit.get(kind)
    raise InvalidProblem(
        f"the units do not name {kind}", join(where, "key 'unit'"), nearest(kind, sorted(section.unit))
    )


def _numbers(c: Context, key: str, default: float) -> Array:
    return c.table.numbers(key) if c.table.has(key) else np.full(c.table.count, default)


def _check_weight(c: Context, weight: Array) -> None:
    bad = np.flatnonzero(~((weight >= 0.0) & (weight <= 1.0)))
    if len(bad):
        place = c.table.where("weight", int(bad[0]))
        raise InvalidProblem(
            f"the weight {weight[bad[0]]:g} is outside 0 to 1", place, "use 0 for absent, 1 for present"
        )


def _values(c: Context, unit: Conversion, weight: Array) -> Array:
    """Return z in SI: zero where a row is absent, NaN where values are not needed and not there."""
    if not (c.values or c.table.has("z") or "z" in c.table.names):
        return np.full(c.table.count, np.nan)
    raw = c.table.numbers("z", optional=bool((weight == 0.0).any()) or not c.values)
    empty = np.flatnonzero(np.isnan(raw) & (weight > 0.0))
    if len(empty) and c.values:
        c.table.numbers("z")
        raise AssertionError
    return np.where(weight > 0.0, unit.to_si(raw), 0.0)


def _stations(c: Context, key: str, needed: bool) -> Array:
    if not needed:
        return np.full(c.table.count, -1)
    single = getattr(c.section, key)
    column = c.table.has(key) or single is None
    labels = c.table.labels(key) if column else np.full(c.table.count, single, dtype=object)
    numbers = {name: i for i, name in enumerate(c.stations)}
    unknown = set(labels.tolist()) - numbers.keys()
    if unknown:
        row = int(np.flatnonzero(np.isin(labels.astype(str), list(unknown)))[0])
        place = c.table.where(key, row) if c.table.has(key) else join(c.where, f"key {key!r}")
        raise InvalidProblem(f"there is no station {labels[row]!r}", place, nearest(labels[row], list(c.stations)))
    return np.array(list(map(numbers.__getitem__, labels.tolist())), dtype=np.int64)


def _check_pairs(c: Context, kind: str, a: Array, b: Array) -> None:
    same = np.flatnonzero(a == b)
    if len(same):
        what = f"{kind} names station {c.stations[a[same[0]]]!r} twice"
        raise InvalidProblem(what, c.table.at(int(same[0])), "name two stations")


def _correction(c: Context, units: Units, unit: Conversion) -> Array:
    if c.table.has("correction"):
        return c.table.numbers("correction") * _size(unit, c)
    if c.section.correction is None:
        return np.zeros(c.table.count)
    number, own = units.amount(c.section.correction, unit, join(c.where, "key 'correction'"))
    return np.full(c.table.count, number * _size(own, c))


def _size(unit: Conversion, c: Context) -> float:
    if unit.logarithmic:
        raise InvalidProblem("a correction in dB is no sum", join(c.where, "key 'correction'"), "correct z itself")
    return unit.factor


def with_baseline(chunk: Chunk, baseline: Array) -> Chunk:
    """Return a chunk of excess paths with the distance (m,) of its stations added."""
    return replace(chunk, z=chunk.z + baseline * (chunk.weight > 0.0), baseline=baseline)

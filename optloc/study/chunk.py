"""One chunk of a plan becomes one Arrow table: a function of the chunk alone, wherever it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from optloc.errors import InvalidProblem
from optloc.study.backends import machine, versions
from optloc.study.columns import COLUMNS, DIED, arrow_schema
from optloc.study.draws import Drawn, draw
from optloc.study.methods import run
from optloc.study.plan import Cell, Chunk
from optloc.study.score import Exact, Values, exact_of, fix_values, truth_values

_warm: set[tuple[str, str]] = set()


@dataclass(frozen=True, slots=True)
class Part:
    """What a chunk gave.

    Parameters
    ----------
    key : str
        Of the chunk.
    table : pyarrow.Table
        Its rows.
    counts : dict of str to int
        How many rows have which status.
    """

    key: str
    table: Any
    counts: dict[str, int]


def compute(chunk: Chunk) -> Part:
    """Return the rows of a chunk.

    Numerical libraries work on one thread inside, so that the last digit does not depend on where it runs.

    Raises
    ------
    InvalidProblem
        Where the method cannot be run at all. Any other error of a trial becomes the status of its row.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        drawn = draw(chunk.cell.case, chunk.first, chunk.count)
        build = _warmed(chunk.cell, drawn)
        known = exact_of(drawn)
        size = chunk.cell.method.batch or chunk.count
        parts = [
            _guarded(chunk.cell, known, drawn, first, min(size, chunk.count - first))
            for first in range(0, chunk.count, size)
        ]
    values = joined([part for some in parts for part in some])
    return part_of(chunk, truth_values(chunk.cell.case, known) | values, drawn.seed, build)


def _warmed(cell: Cell, drawn: Drawn) -> float:
    """Solve one trial where that was not done in this process, and return how long it took."""
    key = (cell.case.key, cell.method.identity)
    if key in _warm:
        return 0.0
    began = perf_counter()
    try:
        run(cell.method, drawn.part(0, 1))
    except InvalidProblem:
        raise
    except Exception:  # noqa: BLE001  (it comes again with its row)
        return 0.0
    _warm.add(key)
    return perf_counter() - began


def _guarded(cell: Cell, known: Exact, drawn: Drawn, first: int, count: int) -> list[tuple[int, Values]]:
    """Return the values of some trials; where the call fails, halves are tried until the one trial is found."""
    try:
        return [(count, _values(cell, known, drawn, first, count))]
    except InvalidProblem:
        raise
    except Exception as error:  # noqa: BLE001  (a failing trial costs a row, never the study)
        if count == 1:
            return [(1, failure(f"{type(error).__name__}: {error}".splitlines()[0]))]
    half = count // 2
    return [
        *_guarded(cell, known, drawn, first, half),
        *_guarded(cell, known, drawn, first + half, count - half),
    ]


def _values(cell: Cell, known: Exact, drawn: Drawn, first: int, count: int) -> Values:
    whole = (first, count) == (0, len(drawn.truth))
    some = drawn if whole else drawn.part(first, count)
    found = run(cell.method, some)
    kept = slice(first, first + count)
    own = known if whole else Exact(some, known.bound[kept], known.cost[kept])
    values = fix_values(cell.case, own, found.fix)
    return values | {"seconds": found.seconds / count, "iterations": found.iterations / count, "batch": count}


def failure(reason: str) -> Values:
    """Return the values of a trial that failed."""
    values: Values = {column.name: np.nan for column in COLUMNS if column.kind == "float"}
    values |= {
        "status": DIED,
        "reason": reason,
        "answered": False,
        "located": False,
        "dof": 0,
        "alternatives": 0,
        "rejected": 0,
    }
    return values | {"proof": "unknown", "certificate": "", "batch": 1}


def joined(parts: list[tuple[int, Values]]) -> Values:
    """Return the columns of stretches of trials one behind the other, those of the first."""
    measured = fix_columns(parts)
    return {name: np.concatenate([spread(values[name], count) for count, values in parts]) for name in measured}


def fix_columns(parts: list[tuple[int, Values]]) -> list[str]:
    """Return the columns that every stretch has."""
    return [name for name in parts[0][1] if all(name in values for _, values in parts)]


def spread(value: Any, count: int) -> Any:
    """Return a value as an array (count,)."""
    if isinstance(value, np.ndarray):
        return value
    out = np.empty(count, dtype=object if isinstance(value, str | list) else None)
    out[:] = value
    return out


def part_of(chunk: Chunk, values: Values, seed: tuple[str, ...], build: float) -> Part:
    """Return the Arrow table of a chunk."""
    import pyarrow as pa

    case, method, n = chunk.cell.case, chunk.cell.method, chunk.count
    problem = case.template
    kinds = "+".join(rows.kind for rows in problem.rows)
    values |= {
        "key": chunk.cell.key,
        "data": case.key,
        "scenario": case.table.name,
        "method": method.name,
        "solver": method.solver,
        "noise": case.level,
        "noise_unit": case.unit,
        "noise_label": case.label,
        "sweep": case.sweep,
        "kinds": kinds,
        "dimension": problem.dimension,
        "stations": problem.stations.count,
        "rows": problem.count,
        "epochs": problem.epochs,
        "trial": chunk.first + np.arange(n),
        "seed": list(seed),
        "build": build,
        "chunk": chunk.key,
        "machine": machine(),
        "versions": versions(),
    }
    schema = arrow_schema()
    arrays = [_MAKERS[column.kind](values[column.name], n) for column in COLUMNS]
    table = pa.Table.from_arrays(arrays, schema=schema)
    status, times = np.unique(np.asarray(spread(values["status"], n), dtype=str), return_counts=True)
    return Part(chunk.key, table, dict(zip(status.tolist(), times.tolist(), strict=True)))


def _category(value: Any, count: int) -> Any:
    import pyarrow as pa

    if isinstance(value, str):
        return pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, dtype=np.int32)), pa.array([value]))
    return pa.array(value, pa.string()).dictionary_encode()


def _number(kind: Any) -> Callable[[Any, int], Any]:
    def made(value: Any, count: int) -> Any:
        import pyarrow as pa

        return pa.array(np.broadcast_to(np.asarray(value, dtype=kind), (count,)))

    return made


_MAKERS: dict[str, Callable[[Any, int], Any]] = {
    "category": _category,
    "int": _number(np.int64),
    "float": _number(np.float64),
    "bool": _number(np.bool_),
}

"""One chunk of a plan becomes one Arrow table: a function of the chunk alone, wherever it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from time import perf_counter
from typing import Any, Literal

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.study.backends import machine, versions
from optloc.study.draws import Drawn, draw
from optloc.study.methods import run
from optloc.study.plan import Cell, Chunk
from optloc.study.score import Exact, Values, exact_of, fix_values, truth_values

# The long table of a study, one row for each trial of each method: columns, units and meaning in one place.


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the table.

    Parameters
    ----------
    name : str
        Name.
    kind : "category", "int", "float" or "bool"
        Category: text, dictionary encoded.
    unit : str
        SI unit; empty where there is none.
    meaning : str
        One sentence.
    value : bool
        Whether it is the same, bit for bit, whenever and on whatever executor the study runs; False for times, the
        machine and the versions.
    """

    name: str
    kind: Literal["category", "int", "float", "bool"]
    unit: str
    meaning: str
    value: bool = True


COLUMNS: tuple[Column, ...] = (
    Column("key", "category", "", "Cell: a scenario at one noise level and one set of swept values, with one method."),
    Column("data", "category", "", "Cell without the method: equal data and trial mean equal measurements."),
    Column("scenario", "category", "", "Name of the scenario."),
    Column("method", "category", "", "Name of the method as tables show it; different settings have different names."),
    Column("solver", "category", "", "Back end that was asked for, for instance SCS; empty: the method's own."),
    Column(
        "noise", "float", "", "Noise level in the unit `noise_unit`: deviation of a row of the first kind, or factor."
    ),
    Column("noise_unit", "category", "", "m, m/s, rad or 1; x where levels are factors on the noise of a file."),
    Column("noise_label", "category", "", "The level as the study file writes it."),
    Column("sweep", "category", "", "Swept values as a JSON object of name and value; {} without a sweep."),
    Column("kinds", "category", "", "Measurement kinds of the scenario, joined by +."),
    Column("dimension", "int", "", "2 or 3."),
    Column("stations", "int", "", "Number of stations."),
    Column("rows", "int", "", "Number of measurements of a trial."),
    Column("epochs", "int", "", "Number of epochs of a trial."),
    Column("trial", "int", "", "Number of the trial, from 0."),
    Column("seed", "category", "", "Seed of the trial's block of data: study seed, data cell and block number."),
    Column("status", "category", "", "Label of the status, for instance ok; 'died' where the process died twice."),
    Column("answered", "bool", "", "Whether the status claims an answer: ok, ambiguous or searched."),
    Column("reason", "category", "", "Sentence that belongs to the status."),
    Column("located", "bool", "", "Whether there is a finite position at all, refined or not."),
    Column("outliers", "int", "", "Number of stations with a gross error."),
    Column("rejected", "int", "", "Number of rows to which the method gives less than half their weight."),
    Column("truth_x", "float", "m", "True position of the target, metres in the frame."),
    Column("truth_y", "float", "m", "As truth_x."),
    Column("truth_z", "float", "m", "As truth_x; NaN in the plane."),
    Column("error_x", "float", "m", "Estimate less truth; NaN without a position."),
    Column("error_y", "float", "m", "As error_x."),
    Column("error_z", "float", "m", "As error_x; NaN in the plane."),
    Column("error", "float", "m", "Distance of the estimate from the truth."),
    Column("error_nearest", "float", "m", "The same of the nearest of the estimate and its alternatives."),
    Column("error_velocity", "float", "m/s", "Length of the velocity's error; NaN where the target stands."),
    Column("error_bias", "float", "m", "Root mean square error of the biases in metres; NaN without such."),
    Column("crlb", "float", "m", "Root of the trace of the position's Cramer-Rao bound at the truth."),
    Column("crlb_velocity", "float", "m/s", "The same of the velocity."),
    Column("crlb_bias", "float", "m", "Root mean square bound of the biases in metres."),
    Column(
        "deviation", "float", "1", "Error in units of the bound: sqrt(e' B^-1 e), B the position's bound at the truth."
    ),
    Column("sigma", "float", "m", "Root of the trace of the position covariance that the method claims."),
    Column("nees", "float", "1", "e' C^-1 e with the claimed covariance C; its expectation is `dimension`."),
    Column("cost", "float", "1", "Maximum-likelihood cost at the estimate, also of estimates that were not refined."),
    Column("cost_truth", "float", "1", "The same cost at the truth (unknowns of single epochs at their best)."),
    Column("dof", "int", "", "Degrees of freedom of the cost."),
    Column("alternatives", "int", "", "Number of other minima that the fix lists."),
    Column("proof", "category", "", "Proof of the certificate: global, region, local or unknown."),
    Column("certificate", "category", "", "Method of the certificate."),
    Column("bound", "float", "1", "Certified lower bound of the cost; NaN without one."),
    Column(
        "iterations", "float", "1", "Iterations of solver and refinement, mean over the fixes of one call; NaN unknown."
    ),
    Column(
        "seconds", "float", "s", "Time of the solution: that of the call over the number of its fixes.", value=False
    ),
    Column(
        "build",
        "float",
        "s",
        "Time of the first fix of its kind in its process, before the others: compilation "
        "and canonicalisation; 0 where that had been done.",
        value=False,
    ),
    Column("batch", "int", "", "Number of fixes in the call."),
    Column("chunk", "category", "", "Chunk of the plan that holds the row."),
    Column("machine", "category", "", "Processor, number of cores and system of the worker.", value=False),
    Column("versions", "category", "", "Versions of optloc, Python and the libraries, as text.", value=False),
)
"""Columns of every part file, in this order."""

GAP = Column("gap", "float", "1", "Cost less the lowest cost that any method of the study found for the same data.")
"""Added when all parts are read: it needs all methods."""

DIED = "died"
"""Status of a trial that took its process down twice."""

VALUES: tuple[str, ...] = tuple(column.name for column in COLUMNS if column.value)
"""Columns that are equal bit for bit on one machine, whatever the executor."""


@cache
def arrow_schema() -> Any:
    """Return the Arrow schema of the part files; unit and meaning are metadata of the fields."""
    import pyarrow as pa

    types = {
        "category": pa.dictionary(pa.int32(), pa.string()),
        "int": pa.int64(),
        "float": pa.float64(),
        "bool": pa.bool_(),
    }
    return pa.schema(
        [pa.field(c.name, types[c.kind], metadata={"unit": c.unit, "meaning": c.meaning}) for c in COLUMNS]
    )


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

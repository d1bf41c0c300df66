"""One trial from simulated data to a row of the table: solution, errors against truth and bound, documented columns.

The rows of a chunk are one Arrow table. The table depends on the chunk only, not on the machine.

Letters in shapes: n trials, d coordinates, p unknowns that all epochs share. `size` is the length of a parameter
vector: all unknowns of a problem in the order of its layout.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from time import perf_counter
from typing import Any, Literal

import numpy as np

from optloc.bounds import crlb
from optloc.engine import TOLERANCE, covariance, eliminated, equations_at, exact, linalg, violation
from optloc.lab.study.design import Cell, Chunk, machine, versions
from optloc.lab.study.methods import Nonsense, require_program, run
from optloc.lab.study.networks import (
    KnownNetworks,
    NetworkCase,
    NetworkResult,
    Networks,
    found_columns,
    known_networks,
    true_columns,
)
from optloc.lab.study.simulation import Case, DrawnCase
from optloc.problem import PROOFS, Array, Fix, Problem, Status

# The table of a study has one row for each trial of each method; here are its columns, their units and meanings.


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
        SI unit; empty for columns without a unit.
    meaning : str
        One sentence.
    value : bool
        Whether its values are equal, bit for bit, in every run on every executor; False for times, machine and
        versions.
    """

    name: str
    kind: Literal["category", "int", "float", "bool"]
    unit: str
    meaning: str
    value: bool = True


COLUMNS: tuple[Column, ...] = (
    Column("key", "category", "", "Cell: a scenario at one noise level and one set of swept values, with one method."),
    Column("data", "category", "", "Digest of the simulated data: equal data and trial mean equal measurements."),
    Column("scenario", "category", "", "Name of the scenario."),
    Column("method", "category", "", "Name of the method as tables show it; different settings have different names."),
    Column("solver", "category", "", "Requested solver, for instance SCS; empty: the default of the method."),
    Column(
        "noise", "float", "", "Noise level in the unit `noise_unit`: deviation of a row of the first kind, or factor."
    ),
    Column("noise_unit", "category", "", "m, m/s, rad or 1; x if levels are factors on the noise of a file."),
    Column("noise_label", "category", "", "The level as written in the study file."),
    Column("sweep", "category", "", "Swept values as a JSON object of name and value; {} without a sweep."),
    Column("kinds", "category", "", "Measurement kinds of the scenario, joined by +."),
    Column("dimension", "int", "", "2 or 3."),
    Column("stations", "int", "", "Number of stations."),
    Column("rows", "int", "", "Number of measurements of a trial."),
    Column("epochs", "int", "", "Number of epochs of a trial."),
    Column("trial", "int", "", "Number of the trial, from 0."),
    Column("seed", "category", "", "Seed of the trial's block of data: study seed, data cell and block number."),
    Column(
        "status",
        "category",
        "",
        "Label of the status, for instance ok; without a fix: 'died' (an error or the end of its process), 'timeout' "
        "(over the time limit of tasks) or 'invalid' (an invalid answer).",
    ),
    Column("answered", "bool", "", "Whether the status has a position with a covariance, with or without findings."),
    Column("reason", "category", "", "Sentence that belongs to the status."),
    Column("located", "bool", "", "Whether there is a finite position at all, refined or not."),
    Column("outliers", "int", "", "Number of stations with a gross error; in a network, number of arrivals."),
    Column("rejected", "int", "", "Number of rows to which the method gives less than half their weight."),
    Column("truth_x", "float", "m", "True position of the target, metres in the frame."),
    Column("truth_y", "float", "m", "As truth_x."),
    Column("truth_z", "float", "m", "As truth_x; NaN in the plane."),
    Column("error_x", "float", "m", "Estimate less truth; NaN without a position."),
    Column("error_y", "float", "m", "As error_x."),
    Column("error_z", "float", "m", "As error_x; NaN in the plane."),
    Column(
        "error",
        "float",
        "m",
        "Distance of the estimate from the truth; of a network, rms of its stations after the best rigid motion.",
    ),
    Column("error_nearest", "float", "m", "The least error of the estimate and its alternatives."),
    Column("error_velocity", "float", "m/s", "Length of the velocity's error; NaN for a static target."),
    Column("error_bias", "float", "m", "Root mean square error of the biases in metres; NaN without any."),
    Column(
        "crlb",
        "float",
        "m",
        "Root of the trace of the position's Cramer-Rao bound at the truth; of a network, rms of its stations.",
    ),
    Column("crlb_velocity", "float", "m/s", "Root of the trace of the velocity's Cramer-Rao bound at the truth."),
    Column("crlb_bias", "float", "m", "Root mean square bound of the biases in metres."),
    Column(
        "deviation", "float", "1", "Error in units of the bound: sqrt(e' B^-1 e), B the position's bound at the truth."
    ),
    Column(
        "sigma",
        "float",
        "m",
        "Root of the trace of the position covariance that the method claims; of a network, rms of its stations.",
    ),
    Column(
        "nees",
        "float",
        "1",
        "e' C^-1 e with the claimed covariance C; its expectation is `dimension`; for networks it is scaled to this.",
    ),
    Column(
        "cost",
        "float",
        "1",
        "Maximum-likelihood cost at the estimate, refined or not; NaN if the estimate violates a constraint.",
    ),
    Column("cost_truth", "float", "1", "Likelihood cost at the truth, minimised over unknowns of single epochs."),
    Column("dof", "int", "", "Degrees of freedom of the cost."),
    Column("alternatives", "int", "", "Number of other minima, or networks, that the fix lists."),
    Column("proof", "category", "", "Proof of the certificate: global, region, local, blockwise or unknown."),
    Column("certificate", "category", "", "Method of the certificate."),
    Column("bound", "float", "1", "Certified lower bound of the cost; NaN without one."),
    Column(
        "iterations",
        "float",
        "1",
        "Iterations of solver and refinement, mean over the fixes of a call; NaN if unknown.",
    ),
    Column("evaluations", "float", "1", "Evaluations of the cost by an external minimizer; NaN if not counted."),
    Column("seconds", "float", "s", "Time of the call, divided by the number of its fixes.", value=False),
    Column(
        "processor",
        "float",
        "s",
        "Processor time of all threads of the process, divided likewise; other programs do not change it.",
        value=False,
    ),
    Column(
        "build",
        "float",
        "s",
        "Time of the first fix of the cell in its process, with compilation and canonicalisation; 0 if the process "
        "has solved the cell before.",
        value=False,
    ),
    Column("batch", "int", "", "Number of fixes in the call."),
    Column("chunk", "category", "", "Chunk of the design that contains the row."),
    Column("machine", "category", "", "Processor, number of cores and system of the worker.", value=False),
    Column("versions", "category", "", "Versions of optloc, Python and the libraries, as text.", value=False),
)
"""Columns of every part file, in this order."""

GAP = Column("gap", "float", "1", "Cost less the lowest cost that any method of the study found for the same data.")
"""Added when all parts are read, because it needs all methods."""

FAILED = DIED, LATE, INVALID = "died", "timeout", "invalid"
"""Statuses of a trial without a fix: an error or a dead process, a time limit, an invalid answer."""

VALUES: tuple[str, ...] = tuple(column.name for column in COLUMNS if column.value)
"""Columns that are equal bit for bit on one machine, with every executor."""


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


# Draw and solve a chunk, and write its rows.


@dataclass(frozen=True, slots=True)
class TrialPart:
    """Rows of a finished chunk.

    Parameters
    ----------
    key : str
        Key of the chunk.
    table : pyarrow.Table
        Its rows.
    counts : dict of str to int
        Number of rows by status.
    """

    key: str
    table: Any
    counts: dict[str, int]


@dataclass(frozen=True, slots=True)
class Lost:
    """Record of a chunk that could not be computed.

    Parameters
    ----------
    key : str
        Key of the chunk.
    status : str
        `DIED` or `LATE`.
    reason : str
        Reason of the failure.
    """

    key: str
    status: str
    reason: str


Values = dict[str, Any]
"""Columns of some trials by name: arrays (n,), or one value for all."""

# Most characters of a reason: every row has one, and the message of a library may contain a matrix.
_REASON_LENGTH = 200

# Cases and methods of which this process has solved a trial. The time of the first trial includes compilation and
# canonicalisation. So it is stored in the column `build`, and is not part of the times of other trials.
_solved_before: set[tuple[str, str]] = set()


def compute(chunk: Chunk) -> TrialPart:
    """Return the rows of a chunk.

    Numerical libraries use one thread, so that the last digit does not depend on the machine.

    Raises
    ------
    InvalidProblem
        If the requested solver solves no program of the method.
    MemoryError
        If the memory is not sufficient. All other exceptions of a method become the status of a row.
    """
    from threadpoolctl import threadpool_limits

    # Sums of BLAS depend on the number of threads.
    with threadpool_limits(1):
        drawn = chunk.cell.case.draw(chunk.first, chunk.count)
        build = _warm_up(chunk.cell, drawn)
        known = known_of(drawn)
        size = chunk.cell.method.batch or chunk.count
        parts = [
            part
            for first in range(0, chunk.count, size)
            for part in _solve_in_halves(chunk.cell, known, first, min(size, chunk.count - first))
        ]
    # A failed trial lacks some columns, so only the columns of all parts are kept.
    names = [name for name in parts[0][1] if all(name in values for _, values in parts)]
    columns = {name: np.concatenate([_as_array(values[name], count) for count, values in parts]) for name in names}
    return _part(chunk, known, columns, build)


def _warm_up(cell: Cell, drawn: DrawnCase | Networks) -> float:
    """Solve one trial of a cell that is new for this process, and return the time in seconds; 0 for other cells.

    The time is also 0 if the method fails. Raise InvalidProblem if the requested solver has solved no program.
    """
    key = (cell.case.key, cell.method.identity)
    if key in _solved_before:
        return 0.0
    began = perf_counter()
    try:
        result = run(cell.method, drawn.part(0, 1))
    except (Exception, SystemExit):  # noqa: BLE001  (the row of the trial reports the error)
        return 0.0
    require_program(cell.method, result)
    # Only after a success: a failure may come before the slow part.
    _solved_before.add(key)
    return perf_counter() - began


def _solve_in_halves(
    cell: Cell, known: KnownTrials | KnownNetworks, first: int, count: int
) -> list[tuple[int, Values]]:
    """Return the values of `count` trials, from the trial `first` on, as pairs of a number of trials and their values.

    If the call of the method fails, each half is solved separately, until only failing trials fail. These get the
    status of their failure.
    """
    try:
        return [(count, _solve(cell, known.part(first, count)))]
    except MemoryError:
        # The cause may be an earlier chunk, so another process tries again.
        raise
    except Nonsense as error:
        status, reason = INVALID, str(error)
    except (Exception, SystemExit) as error:  # noqa: BLE001  (a failing trial costs a row, never the study)
        status, reason = DIED, f"{type(error).__name__}: {error}".splitlines()[0]
    if count == 1:
        return [(1, _failure(status, reason))]
    half = count // 2
    return [*_solve_in_halves(cell, known, first, half), *_solve_in_halves(cell, known, first + half, count - half)]


def _solve(cell: Cell, known: KnownTrials | KnownNetworks) -> Values:
    """Return the values of the trials that depend on the method; all trials are solved in one call."""
    count = len(known.drawn.seed)
    result = run(cell.method, known.drawn)
    values = fix_values(cell.case, known, result.fix)
    work = {"seconds": result.seconds / count, "processor": result.processor / count, "evaluations": result.evaluations}
    return values | work | {"iterations": result.iterations / count, "batch": count}


def _failure(status: str, reason: str) -> Values:
    """Return the values of a failed trial: no position, and NaN for all numbers that the method would compute."""
    values: Values = {column.name: np.nan for column in COLUMNS if column.kind == "float"}
    values |= {"status": status, "reason": reason[:_REASON_LENGTH], "answered": False, "located": False}
    values |= dict.fromkeys(("dof", "alternatives", "rejected"), 0)
    return values | {"proof": "unknown", "certificate": "", "batch": 1}


def part_of_lost(chunk: Chunk, lost: Lost) -> TrialPart:
    """Return the part of a chunk that was not computed: all its trials have the status and the reason of `lost`."""
    columns = {name: _as_array(value, chunk.count) for name, value in _failure(lost.status, lost.reason).items()}
    return _part(chunk, known_of(chunk.cell.case.draw(chunk.first, chunk.count)), columns, 0.0)


def join_parts(chunk: Chunk, parts: list[TrialPart]) -> TrialPart:
    """Return the part of a chunk from the parts of its pieces, in the order of their trials."""
    import pyarrow as pa

    table = pa.concat_tables([part.table for part in parts]).unify_dictionaries().combine_chunks()
    name = table.schema.get_field_index("chunk")
    key = pa.array([chunk.key] * len(table)).dictionary_encode()
    counts: dict[str, int] = {}
    for part in parts:
        for status, count in part.counts.items():
            counts[status] = counts.get(status, 0) + count
    return TrialPart(chunk.key, table.set_column(name, table.schema.field(name), key), counts)


def _as_array(value: Any, count: int) -> Any:
    """Return a value as an array (count,): an array as it is, any other value repeated."""
    if isinstance(value, np.ndarray):
        return value
    # Assignment treats a list as one value for each trial, and a text as one value for all.
    array = np.empty(count, dtype=object if isinstance(value, str | list) else None)
    array[:] = value
    return array


def _part(chunk: Chunk, known: KnownTrials | KnownNetworks, solved: Values, build: float) -> TrialPart:
    """Return the part of a chunk as an Arrow table.

    `solved` are the columns that the method decides; the function adds the columns of the case, the truth and the
    machine. `build` is the time of the first fix in seconds.
    """
    import pyarrow as pa

    case, method, n = chunk.cell.case, chunk.cell.method, chunk.count
    # The values of `truth_values` replace equal names: a failed trial has NaN there, but its truth and bound are known.
    values = solved | truth_values(case, known)
    values |= {
        "key": chunk.cell.key,
        "data": list(known.drawn.digest),
        "scenario": case.table.name,
        "method": method.name,
        "solver": method.solver,
        "noise": case.level,
        "noise_unit": case.unit,
        "noise_label": case.label,
        "sweep": case.sweep,
        **case.facts,
        "trial": chunk.first + np.arange(n),
        "seed": list(known.drawn.seed),
        "build": build,
        "chunk": chunk.key,
        "machine": machine(),
        "versions": versions(),
    }
    arrays = [_arrow(column, values[column.name], n) for column in COLUMNS]
    status, number = np.unique(np.asarray(_as_array(values["status"], n), dtype=str), return_counts=True)
    counts = dict(zip(status.tolist(), number.tolist(), strict=True))
    return TrialPart(chunk.key, pa.Table.from_arrays(arrays, schema=arrow_schema()), counts)


_NUMBERS = {"int": np.int64, "float": np.float64, "bool": np.bool_}


def _arrow(column: Column, value: Any, count: int) -> Any:
    """Return a column (count,) as an Arrow array; a text for all rows is stored once."""
    import pyarrow as pa

    if column.kind != "category":
        return pa.array(np.broadcast_to(np.asarray(value, dtype=_NUMBERS[column.kind]), (count,)))
    if isinstance(value, str):
        return pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, dtype=np.int32)), pa.array([value]))
    return pa.array(value, pa.string()).dictionary_encode()


# Columns of fixes: errors against truth and bound, consistency, cost, certificate.

# A row counts as rejected below this share of its weight, as `COLUMNS` states.
_REJECTED = 0.5


@dataclass(frozen=True, slots=True)
class KnownTrials:
    """Data of trials that do not depend on the method.

    Parameters
    ----------
    drawn : DrawnCase
        The n trials.
    bound : array (n, p, p)
        Cramer-Rao bound of the shared unknowns at the truth, in squares of their SI units; NaN where the geometry is
        singular.
    cost : array (n,)
        Cost at the truth; NaN if the truth violates a constraint.
    """

    drawn: DrawnCase
    bound: Array
    cost: Array

    def part(self, first: int, count: int) -> KnownTrials:
        """Return the data of `count` trials from the trial `first` on; all trials are the same object, not a copy."""
        if (first, count) == (0, len(self.drawn.truth)):
            return self
        kept = slice(first, first + count)
        return KnownTrials(self.drawn.part(first, count), self.bound[kept], self.cost[kept])


def known_of(drawn: DrawnCase | Networks) -> KnownTrials | KnownNetworks:
    """Return the trials with their bounds and their costs at the truth."""
    if isinstance(drawn, Networks):
        return known_networks(drawn)
    problem, size = drawn.problem, len(drawn.truth)
    with np.errstate(all="ignore"):
        equations = equations_at(problem, drawn.truth)
        bound = crlb(problem, drawn.truth) if exact(problem) else covariance(equations)[0]
        cost = _nan_if_violated(problem, drawn.truth, np.broadcast_to(eliminated(equations).cost, (size,)))
    return KnownTrials(drawn, np.broadcast_to(bound, (size, *bound.shape[-2:])), cost)


def truth_values(case: Case | NetworkCase, known: KnownTrials | KnownNetworks) -> Values:
    """Return the columns of the truth and its bounds, which do not depend on the method."""
    if isinstance(case, NetworkCase) or isinstance(known, KnownNetworks):
        assert isinstance(known, KnownNetworks)
        return true_columns(known)
    problem, truth = known.drawn.problem, known.drawn.truth
    names = case.state
    position = _values_of(problem, truth, names[0])
    values: Values = {f"truth_{axis}": _component(position, i) for i, axis in enumerate("xyz")}
    values["outliers"] = known.drawn.bad
    values |= {"crlb": _root_trace(_part_of_matrix(problem, known.bound, names[0])), "cost_truth": known.cost}
    moving = len(names) > 1
    values["crlb_velocity"] = _root_trace(_part_of_matrix(problem, known.bound, names[1])) if moving else np.nan
    biases = _biases_in_metres(problem)
    variance = np.diagonal(known.bound, axis1=-2, axis2=-1)[:, biases]
    values["crlb_bias"] = np.sqrt(variance.mean(-1)) if len(biases) else np.nan
    return values


def fix_values(
    case: Case | NetworkCase, known: KnownTrials | KnownNetworks, fix: Fix | tuple[NetworkResult, ...]
) -> Values:
    """Return the columns of the fixes of n trials, or of the results for n networks; `known` are their data.

    Numbers that a trial lacks are NaN. An estimate with a number that is not finite counts as NaN in all its numbers.
    """
    if isinstance(known, KnownNetworks):
        assert isinstance(fix, tuple)
        return found_columns(known, fix)
    assert isinstance(case, Case) and isinstance(fix, Fix)  # noqa: PT018  (the types that belong to a scenario)
    problem, truth, names = known.drawn.problem, known.drawn.truth, case.state
    size = len(truth)
    x = np.where(np.isfinite(fix.x).all(-1, keepdims=True), fix.x, np.nan)
    error = _values_of(problem, x - truth, names[0])
    claimed = _part_of_matrix(problem, fix.cov, names[0])
    values: Values = {f"error_{axis}": _component(error, i) for i, axis in enumerate("xyz")}
    values |= {
        "answered": fix.answered,
        "located": np.asarray(np.isfinite(error).all(-1)),
        "error": np.linalg.norm(error, axis=-1),
        "error_nearest": _least_error(problem, fix, truth, names[0], error),
        "deviation": np.sqrt(_normalised_square(error, _part_of_matrix(problem, known.bound, names[0]))),
        "sigma": _root_trace(claimed),
        "nees": _normalised_square(error, claimed),
        "cost": _costs(problem, fix, x),
        "dof": np.broadcast_to(fix.dof, (size,)),
        "rejected": np.broadcast_to((fix.weights < _REJECTED * problem.weight).sum(-1), (size,)),
        "alternatives": np.isfinite(fix.alternatives.gap).sum(-1),
    }
    moving = len(names) > 1
    values["error_velocity"] = np.linalg.norm(_values_of(problem, x - truth, names[1]), axis=-1) if moving else np.nan
    biases = _biases_in_metres(problem)
    values["error_bias"] = np.sqrt(((x - truth)[:, biases] ** 2).mean(-1)) if len(biases) else np.nan
    # Codes index the labels, because members of Status are numbered from zero.
    labels = np.array([status.label for status in Status], dtype=object)
    values |= {"status": labels[fix.code], "reason": fix.reason}
    claims = fix.claims
    values |= {"proof": np.array(PROOFS, dtype=object)[claims.proof], "certificate": claims.method}
    values["bound"] = claims.bound
    return values


def _component(position: Array, i: int) -> Any:
    """Return the coordinate `i` of positions (n, d); NaN in the plane, where there is no third coordinate."""
    return position[:, i] if i < position.shape[-1] else np.nan


def _values_of(problem: Problem, x: Array, name: str) -> Array:
    """Return the values (n, members) of the unknown `name` from parameter vectors (n, size)."""
    return problem.layout.take(x, name)


def _part_of_matrix(problem: Problem, matrix: Array, name: str) -> Array:
    """Return the part (n, q, q) of matrices (n, p, p) that belongs to the unknown `name` with q members."""
    slot, _ = problem.layout.find(name)
    members = slice(slot.start, slot.start + slot.size)
    return np.asarray(matrix[:, members, members])


def _biases_in_metres(problem: Problem) -> Array:
    """Return the indices of the shared unknowns that are biases in metres, such as clock offsets."""
    # Scales and boresights are not included, because errors of other units cannot be averaged with metres.
    biases = [np.arange(s.start, s.start + s.size) for s in problem.layout.shared if s.members and s.unit == "m"]
    return np.concatenate([*biases, np.zeros(0, dtype=np.int64)])


def _root_trace(matrix: Array) -> Array:
    """Return the roots of the traces (n,) of covariances (n, q, q): the rms length of errors."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.trace(matrix, axis1=-2, axis2=-1)))


def _normalised_square(error: Array, matrix: Array) -> Array:
    """Return e' M^-1 e (n,) for errors e (n, d), matrices M (n, d, d); NaN for missing errors or singular matrices."""
    usable = np.asarray(np.isfinite(matrix).all((-1, -2)) & np.isfinite(error).all(-1))
    # All trials are solved at once: trials without a matrix get the identity, and their result is discarded.
    solvable = np.where(usable[:, None, None], matrix, np.eye(matrix.shape[-1]))
    solved, ok = linalg.solve(solvable, np.where(usable[:, None], error, 0.0)[..., None])
    return np.asarray(np.where(usable & ok, (error * solved[..., 0]).sum(-1), np.nan))


def _least_error(problem: Problem, fix: Fix, truth: Array, name: str, error: Array) -> Array:
    """Return the least error (n,) of each estimate and its alternatives, metres.

    `truth` are the true vectors (n, size), `name` is the unknown position, and `error` are the estimates' errors (n,
    d).
    """
    least = np.linalg.norm(error, axis=-1)
    # If two minima fit, the list should contain the right one.
    for i in range(fix.alternatives.x.shape[1]):
        with np.errstate(invalid="ignore"):
            least = np.fmin(least, np.linalg.norm(_values_of(problem, fix.alternatives.x[:, i] - truth, name), axis=-1))
    return np.asarray(least)


def _costs(problem: Problem, fix: Fix, x: Array) -> Array:
    """Return the costs (n,) of the estimates `x` (n, size); costs that the fix lacks are computed here."""
    # Starts and relaxations have no cost, and only the cost of the likelihood makes methods comparable.
    cost = np.where(np.isfinite(fix.cost), fix.cost, np.nan)
    rows = np.flatnonzero(~np.isfinite(cost) & np.isfinite(x).all(-1))
    if len(rows):
        with np.errstate(all="ignore"):
            computed = eliminated(equations_at(problem.take(rows), x[rows])).cost
        cost[rows] = np.where(np.isfinite(computed), computed, np.nan)
    return _nan_if_violated(problem, x, cost)


def _nan_if_violated(problem: Problem, x: Array, cost: Array) -> Array:
    """Return costs (n,) at vectors x (n, size), with NaN where x violates a constraint: such points do not compete."""
    if not problem.constraints:
        return cost
    rows = np.flatnonzero(np.isfinite(x).all(-1))
    result = np.array(cost)
    result[rows[violation(problem.take(rows), x[rows]) > TOLERANCE]] = np.nan
    return result

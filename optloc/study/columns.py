"""The long table of a study, one row for each trial of each method: columns, units and meaning in one place."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal


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

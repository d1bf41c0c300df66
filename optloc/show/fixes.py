"""The methods of `Fix` that make text, HTML, dictionaries, data frames and maps; `optloc` registers this module."""

from __future__ import annotations

from typing import Any

from optloc.base.errors import InvalidProblem
from optloc.base.types import Status
from optloc.model_checks.determine import determined, of_fix
from optloc.problem.determined import Determined
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.columns import fix_columns, fix_detail, plain, records, with_level_sigmas
from optloc.show.describe_fix import answer_of
from optloc.show.render import html_of_answer, text_of_answer

# Keys of the dictionary of a fix in the order of the sections of an answer: use, where, how sure, why not. The other
# keys follow in the order of the table.
_USE = ("label", "number", "epoch", "target", "status", "sentence")
_WHERE = ("lat_deg", "lon_deg", "height", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")
_SURE = ("sigma_", "cov_", "ellipse95_", "undetermined", "determined", "unchecked", "tails")
_WHY = ("reason", "findings")


def text_of(fix: Fix) -> str:
    """Return a fix as plain text."""
    return text_of_answer(answer_of(fix))


def html_of(fix: Fix) -> str:
    """Return a fix as HTML tables; all texts are escaped."""
    return html_of_answer(answer_of(fix))


def determined_of(fix: Fix) -> Determined | None:
    """Return the quantities that the data of a single fix determine; raise InvalidProblem for a batch.

    Of an `ok` fix only the intervals are stated. If another fix does not refer to its problem, the result is None.
    The first call computes the quantities, and the fix keeps them for later calls.
    """
    if fix.shape:
        advice = "select one fix: fix[i].determined"
        raise InvalidProblem(f"a batch of shape {fix.shape} has no single `determined`", "determined", advice)
    source: Any = None if fix.source is None else fix.source[()]
    if source is None or int(fix.code) == Status.OK:
        return of_fix(fix)
    if source.found is None:
        source.found = determined(source.problem.flat(), fix)
    found: Determined = source.found
    return found


def dict_of(fix: Fix) -> dict[str, Any]:
    """Return a single fix as a dictionary in JSON types; for a batch, a dictionary with the list `fixes`.

    If a fix has several states, their rows are in the list `states`.
    """
    if fix.shape:
        flat = fix.flat()
        return {"fixes": [dict_of(flat[i]) for i in range(len(flat))]}
    rows = [with_level_sigmas(row) for row in records(fix_columns(fix))]
    detail: dict[str, Any] = plain(fix_detail(fix))
    return in_order_of_answer(rows[0] | detail if len(rows) == 1 else {"states": rows} | detail)


def in_order_of_answer(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record of a fix with its keys in the order of the sections of an answer."""

    def section(key: str) -> int:
        """Return the number of the section of a key."""
        groups = (key in _USE, key in _WHERE or key == "states", key.startswith(_SURE), key in _WHY, True)
        return groups.index(True)

    def place(key: str) -> int:
        """Return the place of a key in its section."""
        order = (*_USE, *_WHERE, *_WHY)
        return order.index(key) if key in order else len(order)

    return {key: record[key] for key in sorted(record, key=lambda key: (section(key), place(key)))}


def frame_of(fix: Fix) -> Any:
    """Return fixes as a pandas data frame, with the labels of the fixes as index if there is one row for each label.

    If pandas is not installed, the function raises InvalidProblem.
    """
    try:
        import pandas as pd
    except ImportError:
        raise InvalidProblem("pandas is not installed", "to_dataframe", "pip install pandas, or use to_dict") from None
    table = pd.DataFrame(fix_columns(fix))
    # A run has several rows for each fix, so its labels cannot be an index.
    if fix.labels is None or fix.labels.size != len(table):
        return table
    index = pd.Index(fix.labels.ravel().tolist())
    if len(fix.label_names) == index.nlevels:
        index.names = list(fix.label_names)
    return table.drop(columns="label").set_index(index)


def geojson_of(fix: Fix, problem: Problem | None = None) -> dict[str, Any]:
    """Return fixes as a GeoJSON feature collection; with the problem, it also contains stations and 95 % regions."""
    from optloc.show.formats.marks import Results, geojson

    return geojson(Results(fix_columns(fix), fix.frame, (fix,), problem))

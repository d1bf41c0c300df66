"""What a study found, cell by cell and method by method."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.study.chunk import VALUES
from optloc.study.folder import read_frame
from optloc.study.score import over_bound, performance_profile, shifted_mean

if TYPE_CHECKING:
    import pandas as pd


SLACK = 0.01
"""Costs that differ by less are equal: a tenth of a standard deviation."""

PROVEN = "global"
"""Proof that claims that no better point exists anywhere."""

COLUMNS = tuple(
    "key data scenario method solver noise noise_unit noise_label sweep kinds rows stations dimension trial status "
    "answered located truth_x truth_y truth_z error crlb deviation nees cost cost_truth proof certificate bound "
    "iterations seconds build batch machine versions".split()
)
"""Columns of the study's table that a summary reads."""

CASE = ("scenario", "sweep")


def judged(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of a study with what they are worth.

    Parameters
    ----------
    frame : DataFrame
        Rows with the columns `COLUMNS` and `gap`.

    Returns
    -------
    DataFrame
        With `above` (cost less the lowest known: of all methods and of the truth), `right` (answered, and no better
        point is known), `wrong` (status ok, though a better point is known), `false` (a proof of globality that a
        better point refutes), and `case` (scenario and swept values as text).
    """
    import pandas as pd

    cost, gap, truth = (frame[name].to_numpy(dtype=float) for name in ("cost", "gap", "cost_truth"))
    best = np.fmin(cost - gap, truth)
    above = cost - best
    slack = SLACK + 1e-9 * np.abs(best)
    answered = frame["answered"].to_numpy(dtype=bool)
    with np.errstate(invalid="ignore"):
        better = ~(above <= slack)
    pairs = frame[list(CASE)].astype(str)
    names = {(a, b): case_label(a, b) for a, b in pairs.drop_duplicates().itertuples(index=False, name=None)}
    labels = [names[pair] for pair in zip(pairs["scenario"], pairs["sweep"], strict=True)]
    return frame.assign(
        above=above,
        right=answered & ~better,
        wrong=better & (frame["status"] == "ok").to_numpy(),
        false=better & (frame["proof"] == PROVEN).to_numpy(),
        case=pd.Categorical(labels, sorted(set(names.values()), key=_natural), ordered=True),
    )


def _natural(text: str) -> list[tuple[bool, float, str]]:
    """Return a key by which texts are sorted as people do: 8 before 25."""
    parts = re.split(r"(\d+\.?\d*)", text)
    return [(i % 2 == 0, 0.0 if i % 2 == 0 else float(part), part) for i, part in enumerate(parts)]


def case_label(scenario: str, sweep: str) -> str:
    """Return a scenario with its swept values as text, for instance "inside, stations 5"."""
    values: dict[str, Any] = json.loads(sweep)
    parts = [f"{name.rpartition('.')[2].replace('_', ' ')} {_text(value)}" for name, value in values.items()]
    return ", ".join([scenario, *parts])


def _text(value: Any) -> str:
    if isinstance(value, list):
        return " to ".join(map(_text, value)) if len(value) == 2 else " × ".join(map(_text, value))
    if isinstance(value, dict):
        return " and ".join(f"{k} {_text(v)}" for k, v in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)


def noise_text(label: str) -> str:
    """Return a noise level as text: the label, or one that names kinds without its braces."""
    try:
        value = json.loads(label)
    except ValueError:
        return label
    return ", ".join(f"{k} {_text(v)}" for k, v in value.items()) if isinstance(value, dict) else f"noise × {value:g}"


def cells(frame: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each case, noise level and method of judged rows, in the order of `levels` and `methods`.

    Returns
    -------
    DataFrame
        Columns: case, noise, noise_unit, noise_label, method, rows; counts trials, answered, right, wrong, proven,
        false, died; rmse and bound (m), ratio and ratio_half; median and p95 of the deviation; nees over the dimension;
        median, p10 and p90 of seconds; build (s), iterations.
    """
    import pandas as pd

    names = ["case", "noise", "noise_unit", "noise_label", "method"]
    found = [
        dict(zip(names, key, strict=True)) | _cell(part)
        for key, part in frame.groupby(names, observed=True, sort=False)
    ]
    table = pd.DataFrame(found)
    table["case"] = pd.Categorical(table["case"], frame["case"].cat.categories, ordered=True)
    order = {name: i for i, name in enumerate(methods(frame))}
    return table.sort_values(
        ["case", "noise", "noise_label", "method"],
        key=lambda c: c.map(order) if c.name == "method" else c.astype(str) if c.name == "noise_label" else c,
        kind="stable",
        ignore_index=True,
    )


def _cell(part: pd.DataFrame) -> dict[str, Any]:
    chosen = counted(part)
    error, bound, off = (part[n].to_numpy(dtype=float)[chosen] for n in ("error", "crlb", "deviation"))
    ratio, half = over_bound(error, bound)
    seconds = part["seconds"].to_numpy(dtype=float)
    nees = part["nees"].to_numpy(dtype=float)[chosen] / float(part["dimension"].iloc[0])
    good = np.isfinite(bound)
    return {
        "rows": int(part["rows"].iloc[0]),
        "trials": len(part),
        **{name: int(part[name].sum()) for name in ("answered", "right", "wrong", "false")},
        "proven": int((part["proof"] == PROVEN).sum()),
        "died": int((part["status"] == "died").sum()),
        "rmse": float(np.sqrt(np.mean(error**2))) if len(error) else np.nan,
        "bound": float(np.sqrt(np.mean(bound[good] ** 2))) if good.any() else np.nan,
        "ratio": ratio,
        "ratio_half": half,
        "deviation_median": _quantile(off, 0.5),
        "deviation_p95": _quantile(off, 0.95),
        "nees": float(np.mean(nees[np.isfinite(nees)])) if np.isfinite(nees).any() else np.nan,
        "seconds_median": _quantile(seconds, 0.5),
        "seconds_p10": _quantile(seconds, 0.1),
        "seconds_p90": _quantile(seconds, 0.9),
        "build": float(part["build"].max()),
        "iterations": float(part["iterations"].mean()),
    }


def counted(part: pd.DataFrame) -> Array:
    """Return which rows of a method say how accurate it is: its answers, or all its positions if it claims none."""
    answered = part["answered"].to_numpy(dtype=bool)
    return answered if answered.any() else part["located"].to_numpy(dtype=bool)


def _quantile(values: Array, share: float) -> float:
    good = values[np.isfinite(values)]
    return float(np.quantile(good, share)) if len(good) else float("nan")


def methods(frame: pd.DataFrame) -> list[str]:
    """Return the methods, those with the most right answers first, the faster first among equals."""
    found = frame.groupby("method", observed=True, sort=True).agg(right=("right", "mean"), t=("seconds", "median"))
    return [str(name) for name in found.sort_values(["right", "t"], ascending=[False, True], kind="stable").index]


def instances(frame: pd.DataFrame, order: list[str]) -> tuple[Array, Array, int]:
    """Return times and successes of the instances (one trial of one cell of data) that every method has seen.

    Returns
    -------
    times : array (methods, n)
        Seconds.
    solved : bool array (methods, n)
        Whether the answer is right.
    total : int
        All instances of the study, also those that some method has not seen.
    """
    numbers, names = frame["data"].astype(str), frame["method"].astype(str)
    wide = frame.assign(data=numbers, method=names).pivot_table(
        index=["data", "trial"], columns="method", values=["seconds", "right"], aggfunc="first"
    )
    common = wide.dropna()
    times, solved = (np.stack([common[what][name] for name in order]) for what in ("seconds", "right"))
    return times.astype(float), solved.astype(bool), len(wide)


def ranking(frame: pd.DataFrame, order: list[str], shift: float) -> pd.DataFrame:
    """Return the methods ranked by the shifted geometric mean of their times, slow where they fail.

    A failure counts as ten times the slowest time of any method, so that being quickly wrong is not rewarded.

    Returns
    -------
    DataFrame
        Columns: method, instances, solved, mean (s), relative (to the best), fastest (share of instances).
    """
    import pandas as pd

    times, solved, _ = instances(frame, order)
    limit = 10.0 * times.max(initial=0.0)
    mean = np.array([shifted_mean(np.where(ok, t, limit), shift) for t, ok in zip(times, solved, strict=True)])
    first = performance_profile(times, solved, np.ones(1))[:, 0]
    table = pd.DataFrame(
        {
            "method": order,
            "instances": times.shape[1],
            "solved": solved.sum(1),
            "mean": mean,
            "relative": mean / mean.min(),
            "fastest": first,
        }
    )
    return table.sort_values("mean", kind="stable", ignore_index=True)


# Two studies side by side, cell by cell.

CELL = ("scenario", "sweep", "noise_label", "method")


@dataclass(frozen=True, slots=True)
class Side:
    """What one study has in a cell.

    Parameters
    ----------
    rows : int
        Number of trials.
    answered : float
        Share with an answer.
    rmse, bound : float
        Root mean square error of the answers and of the Cramer-Rao bound there, metres.
    seconds : float
        Median time of a fix.
    """

    rows: int
    answered: float
    rmse: float
    bound: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Difference:
    """A cell of two studies.

    Parameters
    ----------
    cell : tuple of str
        Scenario, swept values, noise level, method.
    one, two : Side
        The studies.
    same_data : bool
        Whether both solved the same measurements.
    identical : bool
        Whether their values are equal bit for bit.
    z : float
        Difference of the shares of answers in standard deviations; NaN where both are certain.
    """

    cell: tuple[str, ...]
    one: Side
    two: Side
    same_data: bool
    identical: bool
    z: float


def compared(one: Path, two: Path) -> list[Difference]:
    """Return the cells that two studies have in common, by their names.

    Raises
    ------
    InvalidProblem
        Where a folder holds no study, or they have no cell in common.
    """
    frames = [dict(iter(read_frame(folder).groupby(list(CELL), observed=True, sort=False))) for folder in (one, two)]
    common = [cell for cell in frames[0] if cell in frames[1]]
    if not common:
        advice = "compare studies with the same names of scenarios and methods, and the same noise levels"
        raise InvalidProblem("the studies have no cell in common", f"{one} and {two}", advice)
    return [_difference(tuple(map(str, cell)), frames[0][cell], frames[1][cell]) for cell in common]


def _difference(cell: tuple[str, ...], a: pd.DataFrame, b: pd.DataFrame) -> Difference:
    same_data = set(a["data"]) == set(b["data"])
    one, two = _side(a), _side(b)
    pooled = (one.answered * one.rows + two.answered * two.rows) / (one.rows + two.rows)
    spread = np.sqrt(pooled * (1.0 - pooled) * (1.0 / one.rows + 1.0 / two.rows))
    z = (two.answered - one.answered) / spread if spread > 0.0 else np.nan
    return Difference(cell, one, two, same_data, same_data and _identical(a, b), float(z))


def _identical(a: pd.DataFrame, b: pd.DataFrame) -> bool:
    if len(a) != len(b):
        return False
    names = list(VALUES)
    left, right = (f[names].sort_values("trial").reset_index(drop=True).astype(object) for f in (a, b))
    return bool(left.equals(right))


def _side(frame: pd.DataFrame) -> Side:
    answered = frame["answered"].to_numpy(dtype=bool)
    error, bound = (frame[name].to_numpy(dtype=float)[answered] for name in ("error", "crlb"))
    rmse, limit = (float(np.sqrt(np.mean(v**2))) if len(v) else np.nan for v in (error, bound[np.isfinite(bound)]))
    return Side(len(frame), float(answered.mean()), rmse, limit, float(frame["seconds"].median()))

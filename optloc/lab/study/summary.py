"""Statistics of a finished study, cell by cell and method by method.

A case is a scenario with its swept values. A cell contains the trials of one case at one noise level by one method. An
instance is one trial of one case at one noise level, which every method can solve. Judged rows are rows of the study's
table with the additional columns of the function `judged`; most functions need them.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.lab.study.folder import read_frame
from optloc.lab.study.trial import FAILED, VALUES
from optloc.problem import Array, HasShortForm, InvalidProblem

if TYPE_CHECKING:
    import pandas as pd


SLACK = 0.01
"""Costs with a smaller difference count as equal. A cost of 0.01 is the square of a tenth of a standard deviation."""

# Costs of a million and more have rounding errors above SLACK; the relative error of their sums is smaller.
_RELATIVE = 1e-9

PROVEN = "global"
"""Value of the column `proof` if no better point exists anywhere."""

COLUMNS = tuple(
    "key data scenario method solver noise noise_unit noise_label sweep kinds rows stations dimension trial status "
    "answered located truth_x truth_y truth_z error crlb deviation nees cost cost_truth proof certificate bound "
    "iterations evaluations seconds processor build batch machine versions".split()
)
"""Columns of the study's table that a summary reads."""

CASE = ("scenario", "sweep")

_PENALTY = 10.0
"""Cost of a failure in multiples of the slowest time of the study, as in the score PAR10 of solver competitions."""


def judged(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of a study with five more columns, which judge the fixes by the lowest known cost of their trial.

    Parameters
    ----------
    frame : DataFrame
        Rows with the columns `COLUMNS` and `gap`.

    Returns
    -------
    DataFrame
        The rows with five more columns:

        - `above`: cost less the lowest known cost, of all methods and of the truth;
        - `right`: answered, with a cost, and no better point is known;
        - `wrong`: status ok, but a better point is known, or the row has no cost;
        - `false`: a global proof, but a better point is known, or the row has no cost;
        - `case`: scenario and swept values as text.
    """
    import pandas as pd

    above, rounding = above_least(frame)
    answered = frame["answered"].to_numpy(dtype=bool)
    with np.errstate(invalid="ignore"):
        # A row without a cost is not the best: NaN counts as worse.
        better_known = ~(above <= SLACK + rounding)
    pairs = frame[list(CASE)].astype(str)
    names = {(a, b): case_label(a, b) for a, b in pairs.drop_duplicates().itertuples(index=False, name=None)}
    labels = [names[pair] for pair in zip(pairs["scenario"], pairs["sweep"], strict=True)]
    return frame.assign(
        above=above,
        right=answered & ~better_known,
        wrong=better_known & (frame["status"] == "ok").to_numpy(),
        false=better_known & (frame["proof"] == PROVEN).to_numpy(),
        case=pd.Categorical(labels, sorted(set(names.values()), key=_natural_key), ordered=True),
    )


def above_least(frame: pd.DataFrame) -> tuple[Array, Array]:
    """Return the costs less the lowest known cost of their trial (n,), and the possible rounding errors (n,).

    The lowest known cost is the least of the costs of all methods and of the truth. Rows without a cost are NaN.
    """
    cost, gap, truth = (frame[name].to_numpy(dtype=float) for name in ("cost", "gap", "cost_truth"))
    # The truth also counts: a point with a higher cost is not the minimum.
    best = np.fmin(cost - gap, truth)
    return cost - best, _RELATIVE * np.abs(best)


def _natural_key(text: str) -> list[tuple[bool, float, str]]:
    """Return a sort key that compares the numbers in texts by value: 8 comes before 25."""
    # After the split, odd parts are numbers; 0.0 for text keeps the tuples comparable.
    parts = re.split(r"(\d+\.?\d*)", text)
    return [(i % 2 == 0, 0.0 if i % 2 == 0 else float(part), part) for i, part in enumerate(parts)]


def case_label(scenario: str, sweep: str) -> str:
    """Return a scenario with its swept values as text, for instance "inside, stations 5".

    `sweep` is a JSON object of names and values, as in the column `sweep`.
    """
    values: dict[str, Any] = json.loads(sweep)
    parts = [f"{name.rpartition('.')[2].replace('_', ' ')} {_text(value)}" for name, value in values.items()]
    return ", ".join([scenario, *parts])


def _text(value: Any) -> str:
    """Return a swept value as text: "5 to 10" for a pair, "a × b × c" for a longer list, "a 5 and b 7" for a table."""
    if isinstance(value, list):
        return " to ".join(map(_text, value)) if len(value) == 2 else " × ".join(map(_text, value))
    if isinstance(value, dict):
        return " and ".join(f"{k} {_text(v)}" for k, v in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)


def noise_text(label: str) -> str:
    """Return a noise level as text for titles: "10 m", "tdoa 10 m, azimuth 5 mrad" or "noise × 2".

    `label` is the level as in the column `noise_label`: a text with its unit, a JSON object of levels by kind, or a
    factor on the noise of the problem file.
    """
    try:
        value = json.loads(label)
    except ValueError:
        return label
    return ", ".join(f"{k} {_text(v)}" for k, v in value.items()) if isinstance(value, dict) else f"noise × {value:g}"


def cells(frame: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each case, noise level and method of judged rows, sorted in this order.

    Methods are in the order of `methods`.

    Returns
    -------
    DataFrame
        Columns:

        - case, noise, noise_unit, noise_label, method; rows: measurements of a trial;
        - trials, answered, right, wrong, proven, false: numbers of trials; died: trials that failed (`FAILED`);
        - rmse and bound: root mean square error and Cramer-Rao bound of the position, metres;
        - ratio and ratio_half: rmse over bound, and the half width of its 95 % interval;
        - deviation_median, deviation_p95: quantiles of the error in units of the bound;
        - nees: mean of the normalised squared error over the dimension;
        - seconds_median, seconds_p10, seconds_p90: quantiles of the time of a fix;
        - build: longest time of a first fix, seconds; iterations: mean number.

        Errors and bounds are computed over the rows `accuracy_rows`.
    """
    import pandas as pd

    names = ["case", "noise", "noise_unit", "noise_label", "method"]
    rows = [
        dict(zip(names, key, strict=True)) | _cell(part)
        for key, part in frame.groupby(names, observed=True, sort=False)
    ]
    table = pd.DataFrame(rows)
    table["case"] = pd.Categorical(table["case"], frame["case"].cat.categories, ordered=True)
    order = {name: i for i, name in enumerate(methods(frame))}
    return table.sort_values(
        ["case", "noise", "noise_label", "method"],
        key=lambda c: c.map(order) if c.name == "method" else c.astype(str) if c.name == "noise_label" else c,
        kind="stable",
        ignore_index=True,
    )


def _cell(part: pd.DataFrame) -> dict[str, Any]:
    """Return the statistics of the judged rows of one cell, by the column names of `cells`; NaN without a value."""
    accurate = accuracy_rows(part)
    error, bound, deviation = (part[n].to_numpy(dtype=float)[accurate] for n in ("error", "crlb", "deviation"))
    ratio, half = over_bound(error, bound)
    seconds = part["seconds"].to_numpy(dtype=float)
    nees = part["nees"].to_numpy(dtype=float)[accurate] / float(part["dimension"].iloc[0])
    # With a singular bound no error is too large: such trials count for errors, not for bounds.
    bounded = np.isfinite(bound)
    return {
        "rows": int(part["rows"].iloc[0]),
        "trials": len(part),
        **{name: int(part[name].sum()) for name in ("answered", "right", "wrong", "false")},
        "proven": int((part["proof"] == PROVEN).sum()),
        "died": int(part["status"].isin(FAILED).sum()),
        "rmse": float(np.sqrt(np.mean(error**2))) if len(error) else np.nan,
        "bound": float(np.sqrt(np.mean(bound[bounded] ** 2))) if bounded.any() else np.nan,
        "ratio": ratio,
        "ratio_half": half,
        "deviation_median": _quantile(deviation, 0.5),
        "deviation_p95": _quantile(deviation, 0.95),
        "nees": float(np.mean(nees[np.isfinite(nees)])) if np.isfinite(nees).any() else np.nan,
        "seconds_median": _quantile(seconds, 0.5),
        "seconds_p10": _quantile(seconds, 0.1),
        "seconds_p90": _quantile(seconds, 0.9),
        "build": float(part["build"].max()),
        "iterations": float(part["iterations"].mean()),
    }


def by_status(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the number of fixes by method and status, and how many of them have a better known point.

    Parameters
    ----------
    frame : DataFrame
        Judged rows.

    Returns
    -------
    DataFrame
        One row for each method (in the order of `methods`) and status (`ok` first, then the most frequent first). The
        columns are method, status, and the counts trials, right, better (a better point is known) and wrong (better,
        and the status is ok). Trials without a cost are neither right nor better.
    """
    above, rounding = above_least(frame)
    with np.errstate(invalid="ignore"):
        counted = frame.assign(better=above > SLACK + rounding, trials=1)
    pairs = {"method": counted["method"].astype(str), "status": counted["status"].astype(str)}
    table = (
        counted.assign(**pairs).groupby(["method", "status"], sort=False)[["trials", "right", "better", "wrong"]].sum()
    )
    table = table.astype(int).reset_index()
    order = {name: i for i, name in enumerate(methods(frame))}
    table = table.assign(_method=table["method"].map(order), _ok=table["status"] != "ok", _count=-table["trials"])
    table = table.sort_values(["_method", "_ok", "_count", "status"], kind="stable", ignore_index=True)
    return table.drop(columns=["_method", "_ok", "_count"])


def accuracy_rows(part: pd.DataFrame) -> Array:
    """Return the mask (n,) of the rows whose errors measure a method's accuracy.

    These rows are the answers of the method. If the method answers no trial, they are all its positions.
    """
    answered = part["answered"].to_numpy(dtype=bool)
    return answered if answered.any() else part["located"].to_numpy(dtype=bool)


def _quantile(values: Array, share: float) -> float:
    """Return the quantile `share` (0 to 1) of the finite values; NaN without finite values."""
    good = values[np.isfinite(values)]
    return float(np.quantile(good, share)) if len(good) else float("nan")


def methods(frame: pd.DataFrame) -> list[str]:
    """Return the names of the methods; the method with the largest share of right answers is first.

    If shares are equal, a method without any position is last, so that a solver that fails at once is not the best.
    Then the faster methods come first.
    """
    grouped = frame.groupby("method", observed=True, sort=True)
    found = grouped.agg(right=("right", "mean"), located=("located", "any"), t=("seconds", "median"))
    order = found.sort_values(["right", "located", "t"], ascending=[False, False, True], kind="stable")
    return [str(name) for name in order.index]


def instances(
    frame: pd.DataFrame, order: list[str], work: str = "seconds", success: str = "right"
) -> tuple[Array, Array, int]:
    """Return work and success of every method on the instances that all methods have run.

    The results compare the methods instance by instance. An instance is one trial of one case at one noise level.

    Parameters
    ----------
    frame : DataFrame
        Judged rows.
    order : list of str
        Methods, in the order of the result.
    work, success : str
        Columns of the work of a trial, and of its success.

    Returns
    -------
    times : array (methods, n)
        Values of the column `work`.
    solved : bool array (methods, n)
        Values of the column `success`.
    total : int
        Number of all instances of the study, also of those that some method has not run.
    """
    data, names = frame["data"].astype(str), frame["method"].astype(str)
    table = frame.assign(data=data, method=names).pivot_table(
        index=["data", "trial"], columns="method", values=[work, success], aggfunc="first"
    )
    # In an unfinished study, some methods have not run all trials yet: they have NaN there.
    common = table.dropna()
    times, solved = (np.stack([common[column][name] for name in order]) for column in (work, success))
    return times.astype(float), solved.astype(bool), len(table)


def ranking(frame: pd.DataFrame, order: list[str], shift: float) -> pd.DataFrame:
    """Return the methods ranked by the shifted geometric mean of their times, with a penalty for failures.

    A failure counts as ten times the slowest time of any method, so that fast wrong answers are not rewarded. `order`
    are the methods, and `shift` is the shift of the mean in seconds, see `shifted_mean`.

    Returns
    -------
    DataFrame
        Columns: method; instances: their number; solved: number of right answers; mean (s); relative: mean over the
        best mean; fastest: share of instances on which the method is the fastest right one.
    """
    import pandas as pd

    # `limit` is the time of a failure, seconds.
    times, solved, _ = instances(frame, order)
    limit = _PENALTY * times.max(initial=0.0)
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


# Comparison of two studies, cell by cell.

CELL = ("scenario", "sweep", "noise_label", "method")


@dataclass(frozen=True, slots=True)
class Side:
    """Statistics of one study in a cell.

    Parameters
    ----------
    rows : int
        Number of trials.
    answered : float
        Share of trials with an answer.
    rmse, bound : float
        Root mean square error of the answers, and root mean square Cramer-Rao bound of the answered trials, metres.
    seconds : float
        Median time of a fix.
    """

    rows: int
    answered: float
    rmse: float
    bound: float
    seconds: float


@dataclass(frozen=True, slots=True, repr=False)
class Difference(HasShortForm):
    """Difference of two studies in one cell.

    Parameters
    ----------
    cell : tuple of str
        Scenario, swept values, noise level, method.
    one, two : Side
        Statistics of the first and of the second study.
    same_data : bool
        Whether both solved the same measurements, in the trials that both have.
    identical : bool
        Whether their values are equal bit for bit.
    z : float
        Share of answers of the second study less the share of the first, in standard deviations of this difference; NaN
        if both shares are 0 or both are 1.
    """

    cell: tuple[str, ...]
    one: Side
    two: Side
    same_data: bool
    identical: bool
    z: float


def compared(one: Path, two: Path) -> list[Difference]:
    """Return the differences in the cells that two studies have in common; cells with equal names are compared.

    Raise InvalidProblem if a folder has no study, or if there is no common cell.
    """
    frames = [dict(iter(read_frame(folder).groupby(list(CELL), observed=True, sort=False))) for folder in (one, two)]
    common = [cell for cell in frames[0] if cell in frames[1]]
    if not common:
        advice = "compare studies with the same names of scenarios and methods, and the same noise levels"
        raise InvalidProblem("the studies have no cell in common", f"{one} and {two}", advice)
    return [_cell_difference(tuple(map(str, cell)), frames[0][cell], frames[1][cell]) for cell in common]


def _cell_difference(cell: tuple[str, ...], a: pd.DataFrame, b: pd.DataFrame) -> Difference:
    """Return the difference of two studies in a cell; `a` and `b` are the rows of the studies."""
    # Compare the digest of the drawn numbers, not the seed; only in the trials that both have.
    both = a[["trial", "data"]].merge(b[["trial", "data"]], on="trial")
    same_data = bool(len(both)) and bool((both["data_x"].astype(str) == both["data_y"].astype(str)).all())
    one, two = _cell_statistics(a), _cell_statistics(b)
    # Pooled variance of the two shares: the usual test of their difference.
    pooled = (one.answered * one.rows + two.answered * two.rows) / (one.rows + two.rows)
    deviation = np.sqrt(pooled * (1.0 - pooled) * (1.0 / one.rows + 1.0 / two.rows))
    z = (two.answered - one.answered) / deviation if deviation > 0.0 else np.nan
    return Difference(cell, one, two, same_data, same_data and _identical(a, b), float(z))


def _identical(a: pd.DataFrame, b: pd.DataFrame) -> bool:
    """Return whether the columns `VALUES` of two lists of trials are equal bit for bit."""
    if len(a) != len(b):
        return False
    names = list(VALUES)
    # As objects, NaN equals NaN and categories compare by their text.
    left, right = (f[names].sort_values("trial").reset_index(drop=True).astype(object) for f in (a, b))
    return bool(left.equals(right))


def _cell_statistics(frame: pd.DataFrame) -> Side:
    """Return the statistics of one study in a cell from the rows of the cell."""
    answered = frame["answered"].to_numpy(dtype=bool)
    error, bound = (frame[name].to_numpy(dtype=float)[answered] for name in ("error", "crlb"))
    rmse, bound_rms = (float(np.sqrt(np.mean(v**2))) if len(v) else np.nan for v in (error, bound[np.isfinite(bound)]))
    return Side(len(frame), float(answered.mean()), rmse, bound_rms, float(frame["seconds"].median()))


# Statistics of methods: shares with intervals, errors against the bound, profiles, shifted means.

LEVEL = 0.95
"""Confidence of all intervals, as is usual; `_NORMAL` is its quantile of the normal distribution."""

_NORMAL = 1.96

_CURVE = 200
"""Points of a distribution: more than a figure of 500 pixels resolves, and a page has hundreds of curves."""


def wilson(hits: Array | float, count: Array | float, level: float = LEVEL) -> tuple[Array, Array]:
    """Return Wilson's score interval of shares.

    Parameters
    ----------
    hits, count : array (...)
        Number of hits, and number of trials; the result is NaN for no trials.
    level : float
        Confidence.

    Returns
    -------
    low, high : array (...)
        Ends of the interval, between 0 and 1.

    References
    ----------
    E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
    """
    from scipy.special import ndtri

    z = ndtri(0.5 + level / 2.0)
    k, n = np.asarray(hits, dtype=float), np.asarray(count, dtype=float)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = k / n
        middle = share + z**2 / (2.0 * n)
        width = z * np.sqrt(share * (1.0 - share) / n + z**2 / (4.0 * n**2))
        scale = 1.0 + z**2 / n
        low, high = (middle - width) / scale, (middle + width) / scale
    # At the ends, remove rounding errors: the formula is exact there.
    return np.where(k <= 0.0, np.where(n > 0.0, 0.0, np.nan), low), np.where((k >= n) & (n > 0.0), 1.0, high)


def clopper_pearson(hits: Array | float, count: Array | float, level: float = LEVEL) -> tuple[Array, Array]:
    """Return the exact interval of shares, whose coverage is at least its level; arguments as `wilson`.

    References
    ----------
    C. J. Clopper and E. S. Pearson, "The use of confidence or fiducial limits", Biometrika 26 (1934).
    """
    from scipy.special import betaincinv

    k, n = np.asarray(hits, dtype=float), np.asarray(count, dtype=float)
    tail = (1.0 - level) / 2.0
    some = n > 0.0
    low = np.where(k > 0.0, betaincinv(np.maximum(k, 1.0), n - k + 1.0, tail), 0.0)
    high = np.where(k < n, betaincinv(k + 1.0, np.maximum(n - k, 1.0), 1.0 - tail), 1.0)
    return np.where(some, low, np.nan), np.where(some, high, np.nan)


def over_bound(error: Array, bound: Array) -> tuple[float, float]:
    """Return the root mean square error over the root mean square bound, and the half width of its 95 % interval.

    Parameters
    ----------
    error, bound : array (n,)
        Lengths of errors and roots of the traces of their bounds, metres; pairs that are not finite do not count.

    Returns
    -------
    ratio, half : float
        NaN without a finite pair. The half width is from the delta method, and NaN for a single pair.
    """
    good = np.isfinite(error) & np.isfinite(bound)
    count = int(good.sum())
    if not count:
        return float("nan"), float("nan")
    squares = error[good] ** 2 / np.mean(bound[good] ** 2)
    ratio = float(np.sqrt(squares.mean()))
    spread = float(squares.std(ddof=1)) if count > 1 else float("nan")
    # The error of a root is half the error of its square over the root. The maximum avoids a division by zero, which
    # occurs only for noise of zero.
    return ratio, _NORMAL * spread / (2.0 * max(ratio, np.finfo(float).tiny) * np.sqrt(count))


def shifted_mean(times: Array, shift: float) -> float:
    """Return the shifted geometric mean exp(mean(log(t + s))) - s of times, seconds; NaN without times.

    Large times count less than in a mean, and times far below the shift all count the same.

    References
    ----------
    T. Achterberg, "Constraint Integer Programming", thesis (2007), section A.3.
    """
    values = np.asarray(times, dtype=float)
    return float(np.exp(np.mean(np.log(values + shift))) - shift) if len(values) else float("nan")


def performance_profile(times: Array, solved: Array, ratios: Array) -> Array:
    """Return the share of instances that each method solves within a multiple of the fastest time.

    Parameters
    ----------
    times : array (methods, n)
        Seconds.
    solved : bool array (methods, n)
        Whether the method solved the instance; otherwise its time does not matter.
    ratios : array (q,)
        Multiples of the time of the fastest method that solved the instance.

    Returns
    -------
    array (methods, q)
        Shares of all n instances, including those that no method solves.

    References
    ----------
    E. D. Dolan and J. J. More, "Benchmarking optimization software with performance profiles",
    Mathematical Programming 91 (2002).
    """
    spent = np.where(solved, times, np.inf)
    if not spent.shape[-1]:
        return np.full((len(spent), len(ratios)), np.nan)
    with np.errstate(invalid="ignore"):
        slower = np.where(solved, spent / spent.min(0), np.inf)
    return np.stack([np.searchsorted(np.sort(row), ratios, side="right") / len(row) for row in slower])


def distribution(values: Array, count: int, points: int = _CURVE) -> tuple[Array, Array]:
    """Return an empirical distribution as a curve of few points.

    Parameters
    ----------
    values : array (n,)
        Values that are not finite are left out of the curve, but not out of the count.
    count : int
        Number of trials; the curve ends at the share of trials with a finite value.
    points : int
        Most points of the curve; the least and the greatest value are among them.

    Returns
    -------
    x, share : array (q,)
        Sorted values, and the share of trials that do not exceed them.
    """
    ordered = np.sort(values[np.isfinite(values)])
    if not len(ordered):
        return np.zeros(0), np.zeros(0)
    at = np.unique(np.linspace(0, len(ordered) - 1, min(points, len(ordered))).astype(int))
    return ordered[at], (at + 1.0) / count

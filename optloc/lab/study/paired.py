"""Two methods on the same trials: who is right where the other is not, and by how much errors and times differ.

All tests and intervals are exact: they assume that trials are independent, and nothing of how numbers are distributed.

Sources: Q. McNemar, "Note on the sampling error of the difference between correlated proportions", Psychometrika 12
(1947); H. A. David and H. N. Nagaraja, Order Statistics, 3rd ed., section 7.1 (2003), for the interval of a median.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optloc.problem import Array, InvalidProblem, nearest

if TYPE_CHECKING:
    import pandas as pd

LEVEL = 0.95
"""Probability with which an interval holds what it is of."""

_TRIAL = ["data", "trial"]


class Median(NamedTuple):
    """The median of differences, its interval, and the probability of such signs if either were as likely."""

    value: float
    low: float
    high: float
    p: float


@dataclass(frozen=True, slots=True)
class Pair:
    """What the same trials say of a method and another one.

    Parameters
    ----------
    case, noise : str
        Which trials.
    method, against : str
        Who is compared with whom.
    trials : int
        How many both have solved.
    alone, other_alone : int
        Trials in which only the method, and only the other one, is right.
    share, low, high : float
        Of those, the share of the method, and its interval: above one half it is the better one.
    p : float
        Probability of such a share, or one farther from one half, if both were as good.
    error : Median
        Error less that of the other one, metres, where both have a position.
    time : Median
        Time over that of the other one; its interval is that of the logarithms.
    """

    case: str
    noise: str
    method: str
    against: str
    trials: int
    alone: int
    other_alone: int
    share: float
    low: float
    high: float
    p: float
    error: Median
    time: Median


def median_of(differences: Array) -> Median:
    """Return the median of differences (n,) with an interval between two of them; infinite where they are too few."""
    from scipy.stats import binom, binomtest

    values = np.sort(differences[np.isfinite(differences)])
    n = len(values)
    if not n:
        return Median(*[float("nan")] * 4)
    # The k-th smallest and the k-th largest hold the median but for twice the probability of less than k signs.
    k = int(binom.ppf((1.0 - LEVEL) / 2.0, n, 0.5))
    low, high = (values[k - 1], values[n - k]) if k else (-np.inf, np.inf)
    above, below = int((values > 0.0).sum()), int((values < 0.0).sum())
    p = float(binomtest(above, above + below).pvalue) if above + below else 1.0
    return Median(float(np.median(values)), float(low), float(high), p)


def paired(frame: pd.DataFrame, against: str) -> list[Pair]:
    """Return every other method against one, in every case at every noise level.

    Parameters
    ----------
    frame : DataFrame
        Judged rows of a study, see `optloc.lab.study.summary.judged`.
    against : str
        Name of the method that the others are compared with.

    Raises
    ------
    InvalidProblem
        Where no method has this name.
    """
    names = [str(name) for name in frame["method"].unique()]
    if against not in names:
        raise InvalidProblem(f"no method is called {against!r}", "--against", nearest(against, names))
    found = []
    for (case, noise), part in frame.groupby(["case", "noise_label"], observed=True, sort=False):
        base = part[part["method"] == against]
        for name in (name for name in names if name != against):
            both = part[part["method"] == name].merge(base, on=_TRIAL, suffixes=("", "_other"))
            if len(both):
                found.append(_pair(both, str(case), str(noise), name, against))
    return found


def _pair(both: pd.DataFrame, case: str, noise: str, method: str, against: str) -> Pair:
    from scipy.stats import binomtest

    right, other = (both[name].to_numpy(dtype=bool) for name in ("right", "right_other"))
    alone, other_alone = int((right & ~other).sum()), int((other & ~right).sum())
    share, low, high, p = float("nan"), 0.0, 1.0, 1.0
    if alone + other_alone:
        test = binomtest(alone, alone + other_alone)
        interval = test.proportion_ci(LEVEL, method="exact")
        share, low, high, p = float(test.statistic), float(interval.low), float(interval.high), float(test.pvalue)
    error = median_of(both["error"].to_numpy(dtype=float) - both["error_other"].to_numpy(dtype=float))
    with np.errstate(divide="ignore", invalid="ignore"):
        time = median_of(np.log(both["seconds"].to_numpy(dtype=float) / both["seconds_other"].to_numpy(dtype=float)))
    ratio = Median(float(np.exp(time.value)), float(np.exp(time.low)), float(np.exp(time.high)), time.p)
    counts = (len(both), alone, other_alone)
    return Pair(case, noise, method, against, *counts, share, low, high, p, error, ratio)

"""Comparison of two methods on the same trials: right answers of only one method, differences of errors and times.

All tests and intervals are exact: they assume that trials are independent, and make no assumption on distributions.
McNemar's test compares the trials that only one method solves; the sign test compares errors and times.

Sources: Q. McNemar, "Note on the sampling error of the difference between correlated proportions", Psychometrika 12
(1947); H. A. David and H. N. Nagaraja, Order Statistics, 3rd ed., section 7.1 (2003), for the interval of a median.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optloc.problem import Array, HasShortForm, InvalidProblem, nearest

if TYPE_CHECKING:
    import pandas as pd

LEVEL = 0.95
"""Confidence of all intervals: probability with which an interval contains its value."""

_TRIAL = ["data", "trial"]


class Median(NamedTuple):
    """Median of differences, ends of its interval, and p-value of the sign test (both signs are equally likely)."""

    value: float
    low: float
    high: float
    p: float


@dataclass(frozen=True, slots=True, repr=False)
class Pair(HasShortForm):
    """Comparison of a method with another method on the same trials.

    Parameters
    ----------
    case, noise : str
        Case and noise level of the trials.
    method, against : str
        The method, and the other method.
    trials : int
        Number of trials that both have run.
    alone, other_alone : int
        Trials in which only the method, or only the other method, is right.
    share, low, high : float
        Share of `alone` in these trials, and its interval. Above one half the method is better.
    p : float
        Probability of such a share, or one farther from one half, if both methods are equally good.
    error : Median
        Error less the error of the other method, metres, over trials in which both have a position.
    time : Median
        Time over the time of the other method; the interval is computed from logarithms.
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
    """Return the median of differences (n,), its interval and its p-value; NaN and infinity are left out.

    With few differences the interval is infinite. Without differences, all values are NaN.
    """
    from scipy.stats import binom, binomtest

    values = np.sort(differences[np.isfinite(differences)])
    n = len(values)
    if not n:
        return Median(*[float("nan")] * 4)
    # The interval from the k-th smallest to the k-th largest difference can miss the median. The probability is twice
    # the probability that fewer than k of the n differences are below the median.
    k = int(binom.ppf((1.0 - LEVEL) / 2.0, n, 0.5))
    low, high = (values[k - 1], values[n - k]) if k else (-np.inf, np.inf)
    above, below = int((values > 0.0).sum()), int((values < 0.0).sum())
    p = float(binomtest(above, above + below).pvalue) if above + below else 1.0
    return Median(float(np.median(values)), float(low), float(high), p)


def paired(frame: pd.DataFrame, against: str) -> list[Pair]:
    """Return the comparison of every other method with the method `against`, in every case at every noise level.

    `frame` are judged rows of a study, see `optloc.lab.study.summary.judged`.
    Raise InvalidProblem if no method has this name.
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
    """Return the comparison of two methods over the trials that both have run.

    `both` has one row for each trial: the columns of `method`, and the columns of `against` with the suffix "_other".
    """
    from scipy.stats import binomtest

    right, other = (both[name].to_numpy(dtype=bool) for name in ("right", "right_other"))
    alone, other_alone = int((right & ~other).sum()), int((other & ~right).sum())
    # Without a trial that only one method solves, the share is unknown: it may be between 0 and 1.
    share, low, high, p = float("nan"), 0.0, 1.0, 1.0
    if alone + other_alone:
        test = binomtest(alone, alone + other_alone)
        interval = test.proportion_ci(LEVEL, method="exact")
        share, low, high, p = float(test.statistic), float(interval.low), float(interval.high), float(test.pvalue)
    # Errors are compared by differences in metres, times by the logarithm of their ratio.
    error = median_of(both["error"].to_numpy(dtype=float) - both["error_other"].to_numpy(dtype=float))
    with np.errstate(divide="ignore", invalid="ignore"):
        time = median_of(np.log(both["seconds"].to_numpy(dtype=float) / both["seconds_other"].to_numpy(dtype=float)))
    ratio = Median(float(np.exp(time.value)), float(np.exp(time.low)), float(np.exp(time.high)), time.p)
    counts = (len(both), alone, other_alone)
    return Pair(case, noise, method, against, *counts, share, low, high, p, error, ratio)

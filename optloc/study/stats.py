"""Numbers that judge methods: shares with intervals, errors against the bound, profiles, shifted means."""

from __future__ import annotations

import numpy as np

from optloc.types import Array

LEVEL = 0.95
"""Confidence of all intervals."""


def wilson(hits: Array | float, count: Array | float, level: float = LEVEL) -> tuple[Array, Array]:
    """Return Wilson's score interval of shares.

    Parameters
    ----------
    hits, count : array (...)
        How many of how many; NaN comes back where there are none.
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
    # At the ends the formula is exact, but rounding is not.
    return np.where(k <= 0.0, np.where(n > 0.0, 0.0, np.nan), low), np.where((k >= n) & (n > 0.0), 1.0, high)


def clopper_pearson(hits: Array | float, count: Array | float, level: float = LEVEL) -> tuple[Array, Array]:
    """Return the exact interval of shares, which never covers less than its level; arguments as `wilson`.

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
    """Return the root mean square error over that of the bound, and the half width of its 95 % interval.

    Parameters
    ----------
    error, bound : array (n,)
        Lengths of errors and roots of the traces of their bounds, metres; pairs that are not finite do not count.

    Returns
    -------
    ratio, half : float
        NaN where no pair counts; the half width is that of the delta method, NaN of a single pair.
    """
    good = np.isfinite(error) & np.isfinite(bound)
    count = int(good.sum())
    if not count:
        return float("nan"), float("nan")
    squares = error[good] ** 2 / np.mean(bound[good] ** 2)
    ratio = float(np.sqrt(squares.mean()))
    spread = float(squares.std(ddof=1)) if count > 1 else float("nan")
    return ratio, 1.96 * spread / (2.0 * max(ratio, 1e-300) * np.sqrt(count))


def shifted_mean(times: Array, shift: float) -> float:
    """Return the shifted geometric mean exp(mean(log(t + s))) - s of times; NaN of none.

    Large times count less than in a mean, and times far below the shift are all alike.

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
        Where the method found what was sought; elsewhere its time does not matter.
    ratios : array (q,)
        Multiples of the time of the fastest method that solved the instance.

    Returns
    -------
    array (methods, q)
        Shares of all n instances, those among them that no method solves.

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


def distribution(values: Array, count: int, points: int = 200) -> tuple[Array, Array]:
    """Return an empirical distribution as a curve of few points.

    Parameters
    ----------
    values : array (n,)
        What is not finite is left out of the curve, but not out of the count.
    count : int
        Trials, so that the curve ends at the share of those that have a value.
    points : int
        Most points of the curve; the least and the greatest value are among them.

    Returns
    -------
    x, share : array (q,)
        Values in order and the share of trials that are not above them.
    """
    ordered = np.sort(values[np.isfinite(values)])
    if not len(ordered):
        return np.zeros(0), np.zeros(0)
    at = np.unique(np.linspace(0, len(ordered) - 1, min(points, len(ordered))).astype(int))
    return ordered[at], (at + 1.0) / count

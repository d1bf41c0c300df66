"""Branch and bound over places: is any set of rows, wherever its emitter is in a region, worth its price?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array
from optloc.linear.evaluate import predict
from optloc.multi_target.set_packing import Prices
from optloc.multi_target.sets import (
    Scene,
    cheapest_rows,
    correlation,
    of_picks,
    own_variance,
    value_changes,
    values_in_balls,
)
from optloc.tracking.associate import misfits

TOLERANCE = 0.05
"""Reduced costs above minus this are as good as none: at a smaller one the boxes around every set that is taken, whose
reduced cost is zero, are halved down to rounding. The bound is lower by this much for each emitter."""

# Boxes that are bounded at once: with ten channels of ten values their options take a few megabytes.
_CHUNK = 4096
# Places that are told of at once: each becomes sets that are refined, and the best of them change all prices.
_SHOWN = 60


@dataclass(frozen=True, slots=True)
class PricedRegion:
    """A box in which emitters are sought.

    Parameters
    ----------
    lower, upper : array (d,)
        Corners, metres in the problem's frame.
    """

    lower: Array
    upper: Array


@dataclass(frozen=True, slots=True)
class PricingResult:
    """What a search found.

    Parameters
    ----------
    floor : float
        No set of rows with its place in the region has a lower reduced cost; not finite where the search was cut short
        by sets that are worth more than their price.
    places : array (q, d)
        Centres of boxes that hold, or may hold, a set that is worth more than its price; none where nothing is open.
    picks : int array (q, m)
        The rows that are the cheapest at these places.
    boxes : int
        How many boxes were looked at.
    """

    floor: float
    places: Array
    picks: Array
    boxes: int


def search(scene: Scene, prices: Prices, region: PricedRegion, most: int) -> PricingResult:
    """Return whether some set of rows has a negative reduced cost.

    At a place x the best set of independent rows takes, channel by channel, what is cheapest, so that the reduced cost
    is f(x) = penalty - v + sum_i min(missed, min_j (z_ij - h_i(x))^2 / s_i^2 + ln 2 pi s_i^2 - gain_i + u_ij):
    truncated least squares with several values. Over a box each h_i moves by no more than its enclosure says, which
    bounds every term; terms that are sure, one value being the cheapest everywhere in the box, are bounded together by
    their linear least squares. With correlated errors chi2 >= (r/s)'(r/s) / (largest eigenvalue of their correlation),
    and a determinant is at least the product of what each row has of its own.

    Parameters
    ----------
    scene : Scene
        One epoch.
    prices : Prices
        Of its rows.
    region : PricedRegion
        Where emitters are sought.
    most : int
        Boxes looked at before it gives up.
    """
    centre = 0.5 * (region.lower + region.upper)[None]
    half = 0.5 * (region.upper - region.lower)[None]
    boxes, floor = 0, -TOLERANCE
    # All open boxes of one size at a time: nothing is gained by the best first, as none may stay open.
    while len(centre):
        found = _bound_all(scene, prices, centre, half)
        boxes += len(centre)
        open_ = found.low < -TOLERANCE
        # Centres first: a set found there ends the search, and new prices make most boxes dull.
        first = centre[np.argsort(found.at, kind="stable")[:_SHOWN]]
        value, picks = _cheapest_at(scene, prices, first)
        if value.min() < -TOLERANCE:
            worth = value < -TOLERANCE
            return PricingResult(-np.inf, first[worth], picks[worth], boxes)
        # Given up: the least bound of what is open is the floor, and its places are looked at once more.
        if boxes + 2 * open_.sum() > most:
            lowest = centre[np.argsort(found.low, kind="stable")[:_SHOWN]]
            return PricingResult(float(found.low.min()), lowest, _cheapest_at(scene, prices, lowest)[1], boxes)
        centre, half = _halve(centre[open_], half[open_], found.side[open_])
    return PricingResult(floor, centre, np.zeros((0, scene.scan.count), dtype=np.int64), boxes)


def _cheapest_at(scene: Scene, prices: Prices, x: Array) -> tuple[Array, Array]:
    """Return the reduced costs (q,) of the rows (q, m) that are the cheapest one by one at places (q, d)."""
    apart = misfits(scene.scan, scene.z, predict(scene.scan, x))
    s = scene.sigma[:, None]
    option = (apart / s) ** 2 + np.log(2.0 * np.pi * s**2) - scene.gain[:, None] + prices.row
    picks = cheapest_rows(scene, option)
    used = picks >= 0
    r = np.where(used, np.take_along_axis(apart, np.maximum(picks, 0)[..., None], axis=-1)[..., 0], 0.0)
    chi2 = (_whiten(scene, used, r[..., None])[..., 0] ** 2).sum(-1)
    return chi2 + scene.constant(picks) + of_picks(prices.row, picks).sum(-1) - prices.emitter, picks


def _halve(centre: Array, half: Array, side: Array) -> tuple[Array, Array]:
    """Return both halves of boxes cut across a side each."""
    rows = np.arange(len(centre))
    half = half.copy()
    half[rows, side] *= 0.5
    move = np.zeros_like(centre)
    move[rows, side] = half[rows, side]
    return np.concatenate([centre - move, centre + move]), np.concatenate([half, half])


@dataclass(frozen=True, slots=True)
class _Bounds:
    """Of boxes: lower bounds (q,) of the reduced cost, its value at the centre (q,), and the side (q,) to halve."""

    low: Array
    at: Array
    side: Array


def _bound_all(scene: Scene, prices: Prices, centre: Array, half: Array) -> _Bounds:
    parts = [
        _bound(scene, prices, centre[first : first + _CHUNK], half[first : first + _CHUNK])
        for first in range(0, len(centre), _CHUNK)
    ]
    return _Bounds(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("low", "at", "side")))


def _bound(scene: Scene, prices: Prices, centre: Array, half: Array) -> _Bounds:
    radius = np.sqrt((half**2).sum(-1))
    value, slope, remainder = values_in_balls(scene.scan, centre, radius)
    change = value_changes(scene.scan, slope, remainder, half)
    apart = misfits(scene.scan, scene.z, value)
    s, (own, shrink, _) = scene.sigma[:, None], _errors(scene)
    # A lower bound of what a row costs beside its chi-square, whichever others are taken with it.
    base = np.log(2.0 * np.pi * own)[:, None] - scene.gain[:, None] + prices.row
    near = np.maximum(np.abs(apart) - change[..., None], 0.0) / s
    option = np.where(np.isnan(near), np.inf, near**2 / shrink + base)
    constant = scene.penalty - prices.emitter
    low = constant + np.minimum(option.min(-1), scene.missed).sum(-1)
    here = np.where(np.isnan(apart), np.inf, (apart / s) ** 2 + base)
    at = constant + np.minimum(here.min(-1), scene.missed).sum(-1)
    # The joint bound is dearer by far, and only for boxes that the sum of the single bounds leaves open.
    alive = np.flatnonzero(low < -TOLERANCE)
    if len(alive):
        worst = np.where(np.isnan(apart), np.inf, ((np.abs(apart) + change[..., None]) / s) ** 2 + base)
        picks = _sure_rows(scene, option[alive], worst[alive], low[alive])
        # With correlated errors the chi-square of the others is within that of the sure ones already.
        rest = option if scene.independent else np.where(np.isnan(near), np.inf, base)
        others = np.where(picks >= 0, 0.0, np.minimum(rest[alive].min(-1), scene.missed)).sum(-1)
        whole = _bound_jointly(scene, picks, apart[alive], slope[alive], remainder[alive])
        sure = scene.determinant(picks) + np.where(picks >= 0, -scene.gain, 0.0).sum(-1)
        paid = of_picks(prices.row, picks).sum(-1)
        low[alive] = np.maximum(low[alive], constant + whole + sure + paid + others)
    # The side that moves the rows most, in sigmas; at a station, where slopes are not finite, the longest.
    weight = np.where(np.isfinite(slope), slope / s, 1.0 / s)
    return _Bounds(low, at, ((weight**2).sum(1) * half**2).argmax(-1))


def _errors(scene: Scene) -> tuple[Array, float, float]:
    """Return each row's own variance (m,), and the largest and the least eigenvalue of the correlation of the rows."""
    if scene.independent:
        return scene.sigma**2, 1.0, 1.0
    values = np.linalg.eigvalsh(correlation(scene.R))
    return own_variance(scene.R), float(values[-1]), float(values[0])


def _sure_rows(scene: Scene, option: Array, worst: Array, low: Array) -> Array:
    """Return the values (q, m) that every set of a box has that may be worth its price, or -1 where that is open.

    Either any other choice in that channel is too dear already, or, where errors are independent, the value is the
    cheapest choice everywhere in the box.
    """
    best = option.argmin(-1)
    least = np.take_along_axis(option, best[..., None], axis=-1)[..., 0]
    most = np.take_along_axis(worst, best[..., None], axis=-1)[..., 0]
    # The second best of each channel, missing it included.
    others = option.copy()
    np.put_along_axis(others, best[..., None], np.inf, axis=-1)
    other = np.minimum(others.min(-1), scene.missed)
    sure = (least < scene.missed) & (low[:, None] - least + other >= -TOLERANCE)
    if scene.independent:
        sure |= most <= other
    return np.where(sure, best, -1)


def _bound_jointly(scene: Scene, picks: Array, apart: Array, slope: Array, remainder: Array) -> Array:
    """Return lower bounds (q,) of the chi-squares of sure rows in boxes.

    With r = z - h at the centre: |r - J s - q| >= min_s |r - J s| - |q|, all whitened, for remainders q.
    """
    used = picks >= 0
    known = used & np.isfinite(slope).all(-1) & np.isfinite(remainder)
    r = np.where(known, np.take_along_axis(apart, np.maximum(picks, 0)[..., None], axis=-1)[..., 0], 0.0)
    J, q = np.where(known[..., None], slope, 0.0), np.where(known, remainder, 0.0)
    white = _whiten(scene, known, np.concatenate([J, r[..., None]], axis=-1))
    r, J = white[..., -1], white[..., :-1]
    left = r - (J @ (np.linalg.pinv(J) @ r[..., None]))[..., 0]
    # |q| whitened is at most |q / s| over the root of the least eigenvalue of the correlation.
    blur = np.sqrt(((q / scene.sigma) ** 2).sum(-1) / _errors(scene)[2])
    return np.asarray(np.maximum(np.sqrt((left**2).sum(-1)) - blur, 0.0) ** 2)


def _whiten(scene: Scene, used: Array, columns: Array) -> Array:
    """Return columns (q, m, c) of the rows used (q, m), whitened; those of other rows are zero."""
    if scene.independent:
        return np.asarray(np.where(used[..., None], columns / scene.sigma[:, None], 0.0))
    both = used[:, :, None] & used[:, None, :]
    return np.asarray(linalg.whitening(np.where(both, scene.R, 0.0)) @ columns)

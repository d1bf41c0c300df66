"""Branch and bound over positions in a region: find all sets of rows with a negative reduced cost.

Letters: q boxes or positions, m channels with up to c values each, d coordinates. `centre` and `half` (q, d) are the
centres and half-widths of boxes, metres. `option` (q, m, c) is the cost of each value, and `picks` (q, m) the number of
the chosen value in each channel, or -1.

`scene` has the rows of one epoch, and `prices` are the prices of these rows and of an emitter.
"""

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
"""A reduced cost above minus this value counts as zero. With a smaller value, boxes around every taken set, whose
reduced cost is zero, would be halved down to rounding error. The bound is lower by this value for each emitter."""

# Number of boxes that are bounded together. With ten channels of ten values the arrays take a few megabytes.
_CHUNK = 4096
# Maximum number of positions that one search returns. Each gives sets to refine, and the best of them change all
# prices.
_SHOWN = 60


@dataclass(frozen=True, slots=True)
class PricedRegion:
    """A box that contains the emitters.

    Parameters
    ----------
    lower, upper : array (d,)
        Corners, metres in the problem's frame.
    """

    lower: Array
    upper: Array


@dataclass(frozen=True, slots=True)
class PricingResult:
    """The result of a search.

    Parameters
    ----------
    floor : float
        Lower bound of the reduced costs of all sets of rows with positions in the region. It is not finite if the
        search stopped early because it found sets with a negative reduced cost.
    places : array (q, d)
        Centres of boxes that contain, or may contain, a set with a negative reduced cost; empty if no box is open.
    picks : int array (q, m)
        The cheapest rows at these positions.
    boxes : int
        Number of boxes examined.
    """

    floor: float
    places: Array
    picks: Array
    boxes: int


def search(scene: Scene, prices: Prices, region: PricedRegion, most: int) -> PricingResult:
    """Return sets of rows with a negative reduced cost, or a lower bound of all reduced costs.

    At a position x the best set of independent rows takes the cheapest option in each channel. Its reduced cost is f(x)
    = penalty - v + sum_i min(missed, min_j (z_ij - h_i(x))^2 / s_i^2 + ln 2 pi s_i^2 - gain_i + u_ij): truncated least
    squares with several values. v is the price of an emitter and u_ij the price of value j in channel i. s_i is the
    standard deviation of the channel. The penalty, gain_i and missed are fields of `Scene`.

    In a box the change of each h_i is limited by its enclosure, which bounds every term. A term is sure if one value is
    the cheapest everywhere in the box. Sure terms are bounded together by their linear least squares. With correlated
    errors chi2 >= (r/s)'(r/s) / (largest eigenvalue of their correlation), where r are the residuals. A determinant is
    at least the product of the conditional variances of the rows.

    Parameters
    ----------
    scene : Scene
        One epoch.
    prices : Prices
        Prices of the rows of the scene.
    region : PricedRegion
        Box that contains the emitters.
    most : int
        Maximum number of boxes.
    """
    centre = 0.5 * (region.lower + region.upper)[None]
    half = 0.5 * (region.upper - region.lower)[None]
    boxes, floor = 0, -TOLERANCE
    # All open boxes of one size at a time. Searching the best first has no advantage, because no box may stay open.
    while len(centre):
        bounds = _bound_all(scene, prices, centre, half)
        boxes += len(centre)
        open_ = bounds.low < -TOLERANCE
        # First evaluate the most promising centres. A set with a negative reduced cost there ends the search early: new
        # prices exclude most boxes.
        centres_to_try = centre[np.argsort(bounds.at, kind="stable")[:_SHOWN]]
        value, picks = _cheapest_at(scene, prices, centres_to_try)
        if value.min() < -TOLERANCE:
            cheap = value < -TOLERANCE
            return PricingResult(-np.inf, centres_to_try[cheap], picks[cheap], boxes)
        # The limit is reached: the floor is the least bound of the open boxes, and their centres are returned.
        if boxes + 2 * open_.sum() > most:
            lowest = centre[np.argsort(bounds.low, kind="stable")[:_SHOWN]]
            return PricingResult(float(bounds.low.min()), lowest, _cheapest_at(scene, prices, lowest)[1], boxes)
        centre, half = _halve(centre[open_], half[open_], bounds.side[open_])
    return PricingResult(floor, centre, np.zeros((0, scene.scan.count), dtype=np.int64), boxes)


def _cheapest_at(scene: Scene, prices: Prices, x: Array) -> tuple[Array, Array]:
    """Return the reduced costs (q,) and the picks (q, m) of the cheapest rows at positions (q, d), metres.

    Rows are selected one by one, as if their errors were independent. The cost includes the correlation of the errors.
    """
    apart = misfits(scene.scan, scene.z, predict(scene.scan, x))
    s = scene.sigma[:, None]
    option = (apart / s) ** 2 + np.log(2.0 * np.pi * s**2) - scene.gain[:, None] + prices.row
    picks = cheapest_rows(scene, option)
    in_set = picks >= 0
    r = np.where(in_set, np.take_along_axis(apart, np.maximum(picks, 0)[..., None], axis=-1)[..., 0], 0.0)
    chi2 = (_whiten(scene, in_set, r[..., None])[..., 0] ** 2).sum(-1)
    return chi2 + scene.constant(picks) + of_picks(prices.row, picks).sum(-1) - prices.emitter, picks


def _halve(centre: Array, half: Array, side: Array) -> tuple[Array, Array]:
    """Return the centres and half-widths of both halves of boxes; `side` (q,) is the axis that is cut."""
    rows = np.arange(len(centre))
    half = half.copy()
    half[rows, side] *= 0.5
    move = np.zeros_like(centre)
    move[rows, side] = half[rows, side]
    return np.concatenate([centre - move, centre + move]), np.concatenate([half, half])


@dataclass(frozen=True, slots=True)
class _Bounds:
    """Bounds of q boxes.

    `low` (q,) is a lower bound of the reduced cost of all sets with positions in the box. `at` (q,) is the sum of the
    costs of single rows at the centre; centres with a small sum are tried first. `side` (q,) is the axis to halve.
    """

    low: Array
    at: Array
    side: Array


def _bound_all(scene: Scene, prices: Prices, centre: Array, half: Array) -> _Bounds:
    """Return the bounds of all boxes, in chunks that limit the memory."""
    parts = [
        _bound(scene, prices, centre[first : first + _CHUNK], half[first : first + _CHUNK])
        for first in range(0, len(centre), _CHUNK)
    ]
    return _Bounds(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("low", "at", "side")))


def _bound(scene: Scene, prices: Prices, centre: Array, half: Array) -> _Bounds:
    """Return the bounds of boxes: first from single rows, then jointly for boxes that single rows do not exclude.

    `centre` and `half` (q, d) are the centres and the half-widths of the boxes, metres.
    """
    radius = np.sqrt((half**2).sum(-1))
    value, slope, remainder = values_in_balls(scene.scan, centre, radius)
    change = value_changes(scene.scan, slope, remainder, half)
    apart = misfits(scene.scan, scene.z, value)
    s, (conditional, largest_eigenvalue, _) = scene.sigma[:, None], _errors(scene)
    # Lower bound of the cost of a row, without its chi-square, for every set that contains it.
    base = np.log(2.0 * np.pi * conditional)[:, None] - scene.gain[:, None] + prices.row
    # Least residual, in sigmas, of each value anywhere in the box. NaN is no value, so its cost is infinite.
    near = np.maximum(np.abs(apart) - change[..., None], 0.0) / s
    option = np.where(np.isnan(near), np.inf, near**2 / largest_eigenvalue + base)
    constant = scene.penalty - prices.emitter
    low = constant + np.minimum(option.min(-1), scene.missed).sum(-1)
    cost_at_centre = np.where(np.isnan(apart), np.inf, (apart / s) ** 2 + base)
    at = constant + np.minimum(cost_at_centre.min(-1), scene.missed).sum(-1)
    # The joint bound is far more expensive, so it is computed only for boxes that the sum of single bounds leaves open.
    left_open = np.flatnonzero(low < -TOLERANCE)
    if len(left_open):
        worst = np.where(np.isnan(apart), np.inf, ((np.abs(apart) + change[..., None]) / s) ** 2 + base)
        picks = _sure_rows(scene, option[left_open], worst[left_open], low[left_open])
        # With correlated errors the joint chi-square of the sure rows already includes the chi-square of the others.
        rest = option if scene.independent else np.where(np.isnan(near), np.inf, base)
        others = np.where(picks >= 0, 0.0, np.minimum(rest[left_open].min(-1), scene.missed)).sum(-1)
        joint = _bound_jointly(scene, picks, apart[left_open], slope[left_open], remainder[left_open])
        sure = scene.determinant(picks) + np.where(picks >= 0, -scene.gain, 0.0).sum(-1)
        prices_of_sure = of_picks(prices.row, picks).sum(-1)
        low[left_open] = np.maximum(low[left_open], constant + joint + sure + prices_of_sure + others)
    # Halve the side that changes the rows most, in sigmas; at a station, where slopes are not finite, the longest side.
    weight = np.where(np.isfinite(slope), slope / s, 1.0 / s)
    return _Bounds(low, at, ((weight**2).sum(1) * half**2).argmax(-1))


def _errors(scene: Scene) -> tuple[Array, float, float]:
    """Return the conditional variance (m,) of each row, and the largest and least eigenvalue of the correlation.

    The conditional variance is the variance of the error of a row, given the errors of all other rows.
    """
    if scene.independent:
        return scene.sigma**2, 1.0, 1.0
    values = np.linalg.eigvalsh(correlation(scene.R))
    return own_variance(scene.R), float(values[-1]), float(values[0])


def _sure_rows(scene: Scene, option: Array, worst: Array, low: Array) -> Array:
    """Return the values (q, m) that every set with a negative reduced cost in a box must contain; -1 if none must be.

    A value is sure if every other choice in its channel is too expensive. With independent errors it is also sure if it
    is the cheapest choice everywhere in the box. `option` and `worst` (q, m, c) are lower and upper bounds of the cost
    of each value. `low` (q,) is the lower bound of each box so far.
    """
    best = option.argmin(-1)
    least = np.take_along_axis(option, best[..., None], axis=-1)[..., 0]
    most = np.take_along_axis(worst, best[..., None], axis=-1)[..., 0]
    # Second-best option of each channel, including no detection.
    others = option.copy()
    np.put_along_axis(others, best[..., None], np.inf, axis=-1)
    second_best = np.minimum(others.min(-1), scene.missed)
    sure = (least < scene.missed) & (low[:, None] - least + second_best >= -TOLERANCE)
    if scene.independent:
        sure |= most <= second_best
    return np.where(sure, best, -1)


def _bound_jointly(scene: Scene, picks: Array, apart: Array, slope: Array, remainder: Array) -> Array:
    """Return lower bounds (q,) of the chi-squares of sure rows in boxes.

    r is z - h at the centre, J the derivatives (`slope`), s the displacement, and q the remainders of the first-order
    expansion (`remainder`). Then |r - J s - q| >= min_s |r - J s| - |q|, all whitened. `picks` (q, m) are the sure
    values, and `apart` (q, m, c) all residuals.
    """
    in_set = picks >= 0
    known = in_set & np.isfinite(slope).all(-1) & np.isfinite(remainder)
    r = np.where(known, np.take_along_axis(apart, np.maximum(picks, 0)[..., None], axis=-1)[..., 0], 0.0)
    J, q = np.where(known[..., None], slope, 0.0), np.where(known, remainder, 0.0)
    whitened = _whiten(scene, known, np.concatenate([J, r[..., None]], axis=-1))
    r, J = whitened[..., -1], whitened[..., :-1]
    unexplained = r - (J @ (np.linalg.pinv(J) @ r[..., None]))[..., 0]
    # The norm of the whitened q is at most |q / s| divided by the root of the least eigenvalue of the correlation.
    remainder_norm = np.sqrt(((q / scene.sigma) ** 2).sum(-1) / _errors(scene)[2])
    return np.asarray(np.maximum(np.sqrt((unexplained**2).sum(-1)) - remainder_norm, 0.0) ** 2)


def _whiten(scene: Scene, in_set: Array, columns: Array) -> Array:
    """Return whitened columns (q, m, c) of the rows in each set; zero for other rows. `in_set` (q, m) is a mask."""
    if scene.independent:
        return np.asarray(np.where(in_set[..., None], columns / scene.sigma[:, None], 0.0))
    both_in_set = in_set[:, :, None] & in_set[:, None, :]
    return np.asarray(linalg.whitening(np.where(both_in_set, scene.R, 0.0)) @ columns)

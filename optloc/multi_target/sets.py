"""Unlabelled rows of one epoch, and the cost of a set of rows as one emitter.

Letters: m channels with up to c values each, q sets of rows, d coordinates. The picks (q, m) of sets are the numbers of
the values that they take from each channel; -1 for none. h is the measurement function and J its derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Rows
from optloc.kernels.least_squares import refine
from optloc.linear.evaluate import differentiate
from optloc.linear.normal import covariance
from optloc.models import MODELS
from optloc.problem import noise as noises
from optloc.problem.problem import Problem
from optloc.tracking.associate import Clutter, offsets
from optloc.tracking.several_targets import candidates, channels_of
from optloc.tracking.track import State

# Minimum share of its variance that the error of a row has independently of the others. Below it the eigenvalue is
# rounding error, and the likelihood of sets of rows is unbounded.
_LEAST_INDEPENDENT = 1e-9
# Maximum number of alternations of row selection and refinement. Each lowers the truncated cost, so few are enough; the
# limit ends ties.
_PASSES = 4
# Minimum share of the worth of a row that remains for a bad fit, to avoid a division by zero in the prices.
_LEAST = 0.02


@dataclass(frozen=True, slots=True)
class Scene:
    """The measured values in each channel (a kind at its stations) of one epoch, and the cost of sets of them.

    The cost of a set T of values, at most one of each channel, as one emitter instead of false rows is ::

        c(T) = min_x chi2(T, x) + ln|2 pi R_T| - sum_T 2 ln(pd / density) - (m - |T|) 2 ln(1 - pd) + penalty.

    R_T is the covariance of the values of T, and ``|T|`` their number. pd is the probability of detection, and density
    the mean number of false rows per unit of the measurement.

    The cost is twice the negative logarithm of the generalised likelihood ratio of Deb et al. (1997), plus a penalty.
    The penalty is the worth of the d most informative rows. A position has d coordinates, and d rows always fit it, so
    only further rows are evidence of an emitter. In other words, the d rows that determine an emitter count as likely
    as false rows (Rissanen 1978: a parameter costs the logarithm of its range over its precision).

    Parameters
    ----------
    scan : Problem
        One row for each channel. The position is the only unknown.
    z : array (m, c)
        Measured values minus known corrections; NaN in unused entries.
    row : int array (m, c)
        Global row number of each value in the problem; -1 in unused entries.
    R : array (m, m)
        Covariance of one row from each channel.
    gain : array (m,)
        2 ln(pd / density) of each channel.
    missed : float
        -2 ln(1 - pd), the cost of a channel without a row of the emitter.
    penalty : float
        Cost of each emitter.

    References
    ----------
    S. Deb, M. Yeddanapudi, K. Pattipati, Y. Bar-Shalom, "A generalized S-D assignment algorithm for
    multisensor-multitarget state estimation", IEEE Trans. Aerosp. Electron. Syst. 33 (1997).
    J. Rissanen, "Modeling by shortest data description", Automatica 14 (1978).
    """

    scan: Problem
    z: Array
    row: Array
    R: Array
    gain: Array
    missed: float
    penalty: float

    @property
    def sigma(self) -> Array:
        """Return the standard deviation of each channel, (m,), SI units."""
        return np.asarray(np.sqrt(np.diagonal(self.R)))

    @property
    def periodic(self) -> Array:
        """Return a mask (m,) of the channels that are angles."""
        return np.concatenate([np.full(b.count, MODELS[b.kind].period is not None) for b in self.scan.rows])

    @property
    def independent(self) -> bool:
        """Return whether the errors of the channels are independent."""
        return not np.any(self.R - np.diag(np.diagonal(self.R)))

    @property
    def least(self) -> int:
        """Return the least number of rows that are evidence of an emitter.

        It is above the number of channels if no number of rows is enough.
        """
        # Worth of each row if it fits perfectly, the most informative first. The least number outweighs the penalty and
        # the missing rows.
        worth = np.sort(self.missed + self.gain - np.log(2.0 * np.pi * own_variance(self.R)))[::-1]
        # Least cost of an emitter with 1, 2, ... rows. An emitter is more likely than false rows if it is negative.
        best = self.penalty + self.missed * len(worth) - np.cumsum(worth)
        return int(np.argmax(best < 0.0)) + 1 if (best < 0.0).any() else len(worth) + 1

    def determinant(self, picks: Array) -> Array:
        """Return ln|2 pi R_T| (q,) of the sets with picks (q, m); R_T is the covariance of the rows of a set."""
        in_set = picks >= 0
        both_in_set = in_set[:, :, None] & in_set[:, None, :]
        # Rows outside a set are replaced by ones on the diagonal, so that one call handles sets of all sizes.
        matrix = np.where(both_in_set, 2.0 * np.pi * self.R, np.eye(len(self.R)))
        return np.asarray(np.linalg.slogdet(matrix)[1])

    def constant(self, picks: Array) -> Array:
        """Return the cost (q,) of sets with picks (q, m) without their chi-square."""
        in_set = picks >= 0
        rows = in_set @ -self.gain + self.missed * (~in_set).sum(-1)
        return np.asarray(self.determinant(picks) + rows + self.penalty)


def own_variance(R: Array) -> Array:
    """Return the conditional variance (m,) of the error of each row, given the errors of all others.

    R (m, m) is the covariance of one row from each channel.
    """
    return np.asarray(np.diagonal(R) / np.diagonal(np.linalg.inv(correlation(R))))


def correlation(R: Array) -> Array:
    """Return the correlation matrix of a covariance (m, m). Its eigenvalues do not depend on units."""
    scale = np.sqrt(np.diagonal(R))
    return np.asarray(R / scale / scale[:, None])


def scenes(problem: Problem, clutter: Clutter, penalty: float | None) -> Iterator[Scene]:
    """Yield a scene for each epoch of a problem that has channels, in order. The problem has no batch axes.

    Parameters
    ----------
    problem : Problem
        Rows of several emitters. Their target numbers are ignored.
    clutter : Clutter
        Probability of detection, and density of false rows.
    penalty : float or None
        Cost of each emitter; None for the default of `Scene`.

    Raises
    ------
    InvalidProblem
        For kinds, unknowns or noise for which sets of rows have no score.
    """
    _check(problem)
    channel_rows = candidates(problem)
    _, members = channels_of(problem)
    epoch = channel_rows.channels.epoch
    for k, (_, scan, z) in enumerate(channel_rows.scans(0)):
        if not scan.rows:
            continue
        row = np.full(z.shape, -1)
        for i, channel in enumerate(np.flatnonzero(epoch == k)):
            row[i, : len(members[channel])] = members[channel]
        yield _scene(scan, z, np.where(np.isfinite(z), row, -1), clutter, penalty)


def _scene(scan: Problem, z: Array, row: Array, clutter: Clutter, penalty: float | None) -> Scene:
    """Return the scene of one epoch; raise InvalidProblem if some rows are sums of others.

    `scan`, `z`, `row` and `penalty` are as for `Scene`, but a `penalty` of None is replaced by the default. `clutter`
    has the probability of detection and the density of false rows.
    """
    R = noises.dense(scan.noise, np.arange(scan.count))
    variance, density = np.diagonal(R), clutter.of(scan)
    if not np.linalg.eigvalsh(correlation(R))[0] > _LEAST_INDEPENDENT:
        advice = "give each row an independent error too (sigma with arrival_sigma), or leave out redundant rows"
        raise InvalidProblem("some rows of an epoch are exact sums of others", "noise", advice)
    worth = np.sort(-2.0 * np.log(density) - np.log(2.0 * np.pi * variance))[::-1]
    # A row with negative worth carries no information, so it does not add to the penalty.
    penalty_used = float(np.maximum(worth, 0.0)[: scan.dimension].sum()) if penalty is None else float(penalty)
    gain = 2.0 * np.log(clutter.detection / density)
    return Scene(scan, z, row, R, gain, -2.0 * float(np.log1p(-clutter.detection)), penalty_used)


def _check(problem: Problem) -> None:
    """Raise InvalidProblem if rows, unknowns or batch axes are not supported."""
    if problem.batch_shape:
        raise InvalidProblem("the problem has batch axes", "problem", "give its problems one by one")
    for block in problem.rows:
        if block.kind not in bounded_kinds():
            raise InvalidProblem(f"{block.kind} rows cannot be separated", "kind", f"use {', '.join(bounded_kinds())}")
    for name, given in (
        ("biases", problem.biases),
        ("priors", problem.priors),
        ("constraints", problem.constraints),
        ("fences", problem.fences),
        ("stations", bool(problem.stations.errors)),
    ):
        if given:
            advice = "leave them out: positions are the only unknowns here, and a region is a separate argument"
            raise InvalidProblem(f"{name} add unknowns or limits", name, advice)


# Sets of rows of one emitter: maximum-likelihood positions, costs, and better sets near a position.


@dataclass(frozen=True, slots=True)
class Tuples:
    """Sets of rows with their positions.

    Parameters
    ----------
    picks : int array (q, m)
        Number of the value that a set takes from each channel; -1 for none.
    x : array (q, d)
        Position of least chi-square found, metres.
    cost : array (q,)
        Cost, see `optloc.multi_target.sets.Scene`.
    """

    picks: Array
    x: Array
    cost: Array

    def take(self, index: Array) -> Tuples:
        """Return the selected sets."""
        return Tuples(self.picks[index], self.x[index], self.cost[index])

    def prices(self, price: Array) -> Array:
        """Return the sum (q,) of the prices (m, c) of the rows of each set."""
        return np.asarray(of_picks(price, self.picks).sum(-1))


def of_picks(values: Array, picks: Array) -> Array:
    """Return the values (q, m) that picks (q, m) select from values (m, c); zero for pick -1."""
    selected = values[np.arange(len(values)), np.maximum(picks, 0)]
    return np.asarray(np.where(picks >= 0, selected, 0.0))


def merge(*parts: Tuples) -> Tuples:
    """Return all sets of the parts, sorted by cost, each set once with its cheapest position."""
    picks, x, cost = (np.concatenate([getattr(part, name) for part in parts]) for name in ("picks", "x", "cost"))
    order = np.argsort(cost, kind="stable")
    # `np.unique` keeps the first of equal sets, which is the cheapest after sorting.
    _, first = np.unique(picks[order], axis=0, return_index=True)
    kept = order[np.sort(first)]
    return Tuples(picks[kept], x[kept], cost[kept])


def no_sets(scene: Scene) -> Tuples:
    """Return an empty list of sets."""
    return Tuples(np.zeros((0, scene.scan.count), dtype=np.int64), np.zeros((0, scene.scan.dimension)), np.zeros(0))


def refine_sets(scene: Scene, picks: Array, start: Array) -> tuple[Tuples, Array]:
    """Return sets with picks (q, m), refined from starts (q, d), and the position covariances (q, d, d), m^2.

    A set that does not converge has infinite cost.
    """
    if not len(picks):
        return no_sets(scene), np.zeros((0, scene.scan.dimension, scene.scan.dimension))
    problem = scene.scan.with_rows(z=of_picks(scene.z, picks), weight=(picks >= 0).astype(float))
    result = refine(problem, start)
    # A set that does not converge has no position, so its cost is infinite.
    cost = np.where(np.isfinite(result.cost), result.cost, np.inf) + scene.constant(picks)
    return Tuples(picks, result.x, cost), covariance(result.equations)[0]


def sets_near(scene: Scene, x: Array, cov: Array, price: Array) -> Tuples:
    """Return the best sets of rows near positions, by alternating selection of rows and refinement.

    Rows are first selected by their distance from the prediction, with the uncertainty of the position. They are then
    selected without this uncertainty until the selection is stable. Each pass lowers the truncated cost sum_i
    min(row_i, missed).

    Parameters
    ----------
    scene : Scene
        One epoch.
    x : array (q, d)
        Positions, metres.
    cov : array (q, d, d)
        Covariance of the positions, square metres; zero for exact positions.
    price : array (m, c)
        Additional cost of each row.
    """
    sets = [no_sets(scene)]
    for with_uncertainty in (1.0, 0.0):
        last = None
        for _ in range(_PASSES):
            picks = _choose(scene, x, with_uncertainty * cov, price)
            if last is not None and np.array_equal(picks, last):
                break
            # Fewer rows than coordinates do not determine a position.
            enough = (picks >= 0).sum(-1) >= scene.scan.dimension
            picks, x, cov = picks[enough], x[enough], cov[enough]
            if not len(picks):
                break
            tuples, cov = refine_sets(scene, picks, x)
            good = np.isfinite(cov).all((-1, -2)) & np.isfinite(tuples.cost)
            tuples, cov = tuples.take(good), cov[good]
            sets.append(tuples)
            x, last = tuples.x, tuples.picks
    return merge(*sets)


def _choose(scene: Scene, x: Array, cov: Array, price: Array) -> Array:
    """Return the picks (q, m) that fit best at positions x (q, d) with covariances (q, d, d), channel by channel.

    `price` (m, c) is an additional cost of each value.
    """
    if not len(x):
        return np.zeros((0, scene.scan.count), dtype=np.int64)
    # A position with a covariance is a predicted target, so the gates are the same as in a tracker.
    apart, S = offsets(scene.scan, State(0.0, x, cov), scene.z)
    s = np.diagonal(S, axis1=-2, axis2=-1)[..., None]
    with np.errstate(invalid="ignore"):
        value = apart**2 / s + np.log(2.0 * np.pi * s) - scene.gain[:, None] + price
    return cheapest_rows(scene, value)


def cheapest_rows(scene: Scene, option: Array) -> Array:
    """Return picks (q, m): the cheapest option (q, m, c) of each channel, or -1 if no detection costs less."""
    option = np.where(np.isnan(option), np.inf, option)
    best = option.argmin(-1)
    detected = np.take_along_axis(option, best[..., None], axis=-1)[..., 0] < scene.missed
    return np.where(detected, best, -1)


def without_one_row(scene: Scene, tuples: Tuples) -> Tuples:
    """Return the sets that result from leaving out one row of each given set."""
    which, channel = np.nonzero(tuples.picks >= 0)
    picks = tuples.picks[which]
    picks[np.arange(len(which)), channel] = -1
    enough = (picks >= 0).sum(-1) > scene.scan.dimension
    return refine_sets(scene, picks[enough], tuples.x[which[enough]])[0]


def row_worth(scene: Scene, tuples: Tuples) -> Array:
    """Return the decrease (m, c) of the cost of its set due to each row; 1 for rows without a set.

    The prices of the rows of a set are shared in proportion to these numbers, so they are above 0.
    """
    out = np.ones_like(scene.z)
    variance = scene.sigma**2
    most = scene.missed + scene.gain - np.log(2.0 * np.pi * variance)
    for picks, x in zip(tuples.picks, tuples.x, strict=True):
        channels = np.flatnonzero(picks >= 0)
        residuals = offsets(scene.scan, State(0.0, x[None], np.zeros((1, len(x), len(x)))), scene.z)[0][0]
        decrease = most[channels] - residuals[channels, picks[channels]] ** 2 / variance[channels]
        out[channels, picks[channels]] = np.maximum(decrease, _LEAST * np.maximum(most[channels], 1.0))
    return out


# Bounds of the change of measurements within a box of positions, relative to the centre.


def values_in_balls(scan: Problem, centre: Array, radius: Array) -> tuple[Array, Array, Array]:
    """Return values, derivatives and remainders of the rows of a scan in balls.

    In the ball |h(x) - h - J (x - centre)| <= remainder. The remainder is half the squared radius times a bound of the
    second derivatives. This bound is 1/r for a range, 1/r_h^2 for an azimuth and 1/(r r_h) for an elevation. Here r is
    the distance from the station, and r_h the distance from the vertical line through the station.

    Parameters
    ----------
    scan : Problem
        Rows of the kinds of `bounded_kinds`, with the position as the only unknown.
    centre : array (q, d)
        Centres, metres.
    radius : array (q,)
        Radii, metres.

    Returns
    -------
    value : array (q, m)
        h at the centres.
    slope : array (q, m, d)
        J; not finite if the centre is at a station.
    remainder : array (q, m)
        Infinite if the ball contains a station.
    """
    # At a station the derivatives are not finite. The bounds are then infinite, and the box is halved.
    with np.errstate(all="ignore"):
        # With measurements of zero, the residual z - h is -h.
        residual, slope = differentiate(scan.with_rows(z=np.zeros(scan.count)), centre)
        value, steep = -residual, np.sqrt((slope**2).sum(-1))
        parts = []
        for block, start in zip(scan.rows, scan.starts, strict=True):
            part = slice(start, start + block.count)
            parts.append(_curvature(scan, block, centre, radius, value[:, part], steep[:, part]))
        bend = np.concatenate(parts, axis=-1)
        remainder = 0.5 * bend * radius[:, None] ** 2
    return value, slope, np.where(np.isnan(remainder), np.inf, remainder)


def value_changes(scan: Problem, slope: Array, remainder: Array, half: Array) -> Array:
    """Return the greatest change (q, m) of the rows in boxes, relative to their values at the centres.

    Parameters
    ----------
    scan : Problem
        The scan of `values_in_balls`.
    slope, remainder : array (q, m, d) and (q, m)
        Results of `values_in_balls` for the balls around the boxes.
    half : array (q, d)
        Half-widths of the boxes.
    """
    radius = np.sqrt((half**2).sum(-1))
    most = np.concatenate([_greatest_change(block, radius) for block in scan.rows], axis=-1)
    with np.errstate(invalid="ignore"):
        # The smaller of two bounds: linear change plus remainder, and the greatest change of this kind of row.
        first = (np.abs(slope) * half[:, None, :]).sum(-1) + remainder
    return np.asarray(np.where(first < most, first, most))


def _greatest_change(block: Rows, radius: Array) -> Array:
    """Return a bound (q, m) of the change of the rows of a block in balls of `radius` (q,), without derivatives."""
    ranges = MODELS[block.kind].ranges
    # A range changes at most by the displacement of the target. An angle changes at most by half a turn.
    limit = sum(map(abs, ranges)) * radius if ranges is not None else np.full(len(radius), np.pi)
    return np.repeat(limit[:, None], block.count, axis=-1)


def _curvature(scan: Problem, block: Rows, centre: Array, radius: Array, value: Array, steep: Array) -> Array:
    """Return a bound (q, m) of the second derivatives of the rows of a block in balls.

    `centre` (q, d) and `radius` (q,) are the balls, metres. `value` (q, m) are the measurements at the centres, and
    `steep` (q, m) the lengths of their gradients.
    """
    ranges = MODELS[block.kind].ranges
    if ranges is None:
        return _ANGLES[block.kind].bend(value, steep, radius[:, None])
    bend = np.zeros(value.shape)
    for index, share in zip((block.a, block.b), ranges, strict=True):
        if share:
            distance = np.sqrt(((centre[:, None, :] - scan.stations.position[0][index]) ** 2).sum(-1))
            bend = bend + abs(share) / np.maximum(distance - radius[:, None], 0.0)
    return bend


@dataclass(frozen=True, slots=True)
class Angle:
    """Properties of a kind of angle.

    Parameters
    ----------
    width : float
        Length of the interval of its values, radians.
    bend : callable
        Returns a bound (q, m) of its second derivatives in balls, from values and slopes at the centres (q, m) and the
        radii (q, 1). The slope of an azimuth is 1/r_h, the slope of an elevation 1/r.
    """

    width: float
    bend: Callable[[Array, Array, Array], Array]


# Azimuths cover a full circle, elevations half a circle. 1/r_h^2 and 1/(r r_h) bound their second derivatives.
_ANGLES = {
    "azimuth": Angle(2.0 * np.pi, lambda value, steep, radius: 1.0 / np.maximum(1.0 / steep - radius, 0.0) ** 2),
    "elevation": Angle(
        np.pi,
        lambda value, steep, radius: (
            1.0 / (np.maximum(1.0 / steep - radius, 0.0) * np.maximum(np.cos(value) / steep - radius, 0.0))
        ),
    ),
}


def value_width(problem: Problem, block: Rows) -> Array | None:
    """Return the length of the interval of possible values of each row, metres or radians; None if it is unbounded."""
    if block.kind in _ANGLES:
        return np.asarray(_ANGLES[block.kind].width)
    if sum(MODELS[block.kind].ranges or (1,)):
        return None
    # A range difference is between plus and minus the distance of its stations.
    position = problem.stations.position[..., 0, :, :]
    baseline = position[..., block.a, :] - position[..., block.b, :]
    return np.asarray(2.0 * np.sqrt((baseline**2).sum(-1)))


def bounded_kinds() -> list[str]:
    """Return the supported kinds: sums of ranges without an emission time, and the two angles."""
    sums = [kind for kind, model in MODELS.items() if model.ranges is not None and not model.emission]
    return [*sums, *_ANGLES]

"""One epoch of rows that do not say whose they are, and what a set of them costs as one emitter."""

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

# Share of its variance that a row must have of its own, or the likelihood of sets of rows is endless; below it the
# eigenvalue is rounding.
_OWN = 1e-9
# Turns of choosing rows and refining: each lowers the truncated cost, so few are needed; the number ends ties.
_PASSES = 4
# Share of what a row is worth that it keeps however badly it fits: a price that is zero would divide by nothing.
_LEAST = 0.02


@dataclass(frozen=True, slots=True)
class Scene:
    """The values measured in each channel (a kind at its stations) of one epoch, and the prices of sets of them.

    A set T of values, one or none of each channel, costs as one emitter, against all of them being false, ::

        c(T) = min_x chi2(T, x) + ln|2 pi R_T| - sum_T 2 ln(pd / density) - (m - |T|) 2 ln(1 - pd) + penalty,

    twice the negative logarithm of the generalised likelihood ratio of Deb et al. (1997), and a penalty.
    The penalty is what the d most telling rows are worth: a position is stated by d numbers, and d rows fit it
    whatever they read, so that only rows beyond them speak for an emitter. In other words, the d rows that place an
    emitter are taken to read anything as readily as false ones do (Rissanen 1978: a parameter costs the logarithm of
    its range over its precision).

    Parameters
    ----------
    scan : Problem
        One row for each channel; the only unknown is the position.
    z : array (m, c)
        Values, known corrections taken off; NaN where there are fewer than c.
    row : int array (m, c)
        Global row of each value in the problem; -1 where there is none.
    R : array (m, m)
        Covariance of one row of each channel.
    gain : array (m,)
        2 ln(pd / density) of each channel.
    missed : float
        -2 ln(1 - pd), what an emitter pays for a channel without it.
    penalty : float
        What an emitter pays for being one.

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
        """Return the standard deviation of each channel, (m,)."""
        return np.asarray(np.sqrt(np.diagonal(self.R)))

    @property
    def periodic(self) -> Array:
        """Return which channels are angles, (m,)."""
        return np.concatenate([np.full(b.count, MODELS[b.kind].period is not None) for b in self.scan.rows])

    @property
    def independent(self) -> bool:
        """Return whether the errors of the channels are independent."""
        return not np.any(self.R - np.diag(np.diagonal(self.R)))

    @property
    def least(self) -> int:
        """Return the least number of rows that can speak for an emitter, more than there are channels if none can."""
        # What each row says for an emitter where it fits perfectly, the most telling first: as many as outweigh the
        # rest.
        worth = np.sort(self.missed + self.gain - np.log(2.0 * np.pi * own_variance(self.R)))[::-1]
        best = self.penalty + self.missed * len(worth) - np.cumsum(worth)
        return int(np.argmax(best < 0.0)) + 1 if (best < 0.0).any() else len(worth) + 1

    def determinant(self, picks: Array) -> Array:
        """Return ln|2 pi R_T| (q,) of the sets of given picks (q, m)."""
        used = picks >= 0
        both = used[:, :, None] & used[:, None, :]
        # Rows that are not in a set stand as ones on the diagonal: one call for sets of all sizes.
        matrix = np.where(both, 2.0 * np.pi * self.R, np.eye(len(self.R)))
        return np.asarray(np.linalg.slogdet(matrix)[1])

    def constant(self, picks: Array) -> Array:
        """Return what sets (q, m) cost beyond their chi-square, (q,)."""
        used = picks >= 0
        rows = used @ -self.gain + self.missed * (~used).sum(-1)
        return np.asarray(self.determinant(picks) + rows + self.penalty)


def own_variance(R: Array) -> Array:
    """Return the variance (m,) that each row has of its own once all others are known."""
    return np.asarray(np.diagonal(R) / np.diagonal(np.linalg.inv(correlation(R))))


def correlation(R: Array) -> Array:
    """Return the correlation of a covariance (m, m): its eigenvalues do not depend on units."""
    scale = np.sqrt(np.diagonal(R))
    return np.asarray(R / scale / scale[:, None])


def scenes(problem: Problem, clutter: Clutter, penalty: float | None) -> Iterator[Scene]:
    """Yield the epochs of a problem without batch axes that have channels, in their order.

    Parameters
    ----------
    problem : Problem
        Rows of several emitters; whose they are said to be does not matter.
    clutter : Clutter
        Detection and false rows.
    penalty : float or None
        See `Scene`; None for the value told there.

    Raises
    ------
    InvalidProblem
        For kinds, unknowns or noise that sets of rows cannot be scored with.
    """
    _check(problem)
    given = candidates(problem)
    _, members = channels_of(problem)
    epoch = given.channels.epoch
    for k, (_, scan, z) in enumerate(given.scans(0)):
        if not scan.rows:
            continue
        row = np.full(z.shape, -1)
        for i, channel in enumerate(np.flatnonzero(epoch == k)):
            row[i, : len(members[channel])] = members[channel]
        yield _scene(scan, z, np.where(np.isfinite(z), row, -1), clutter, penalty)


def _scene(scan: Problem, z: Array, row: Array, clutter: Clutter, penalty: float | None) -> Scene:
    R = noises.dense(scan.noise, np.arange(scan.count))
    variance, density = np.diagonal(R), clutter.of(scan)
    if not np.linalg.eigvalsh(correlation(R))[0] > _OWN:
        advice = "give each row an error of its own as well (sigma beside arrival_sigma), or leave out rows that repeat"
        raise InvalidProblem("some rows of an epoch are exact sums of others", "noise", advice)
    worth = np.sort(-2.0 * np.log(density) - np.log(2.0 * np.pi * variance))[::-1]
    # A row that says nothing (worth below zero) places an emitter for nothing.
    own = float(np.maximum(worth, 0.0)[: scan.dimension].sum()) if penalty is None else float(penalty)
    gain = 2.0 * np.log(clutter.detection / density)
    return Scene(scan, z, row, R, gain, -2.0 * float(np.log1p(-clutter.detection)), own)


def _check(problem: Problem) -> None:
    if problem.batch_shape:
        raise InvalidProblem("the problem has batch axes", "problem", "give its problems one by one")
    for block in problem.rows:
        if block.kind not in bounded_kinds():
            raise InvalidProblem(f"{block.kind} rows cannot be told apart", "kind", f"use {', '.join(bounded_kinds())}")
    for name, given in (
        ("biases", problem.biases),
        ("priors", problem.priors),
        ("constraints", problem.constraints),
        ("stations", bool(problem.stations.errors)),
    ):
        if given:
            advice = "leave them out: here positions are all that is unknown, and a region is given beside the problem"
            raise InvalidProblem(f"{name} with unknowns or limits of their own", name, advice)


# Sets of rows of one emitter: their maximum-likelihood places, what they cost, and better ones near a place.


@dataclass(frozen=True, slots=True)
class Tuples:
    """Sets of rows with their places.

    Parameters
    ----------
    picks : int array (q, m)
        Which value of each channel a set holds, or -1.
    x : array (q, d)
        Place of least chi-square found, metres.
    cost : array (q,)
        See `optloc.multi_target.sets.Scene`.
    """

    picks: Array
    x: Array
    cost: Array

    def take(self, index: Array) -> Tuples:
        """Return some of the sets."""
        return Tuples(self.picks[index], self.x[index], self.cost[index])

    def prices(self, price: Array) -> Array:
        """Return the sum (q,) of the prices (m, c) of each set's rows."""
        return np.asarray(of_picks(price, self.picks).sum(-1))


def of_picks(values: Array, picks: Array) -> Array:
    """Return the values (..., m, c) that picks (q, m) take, (q, m); zero where they take none."""
    found = values[np.arange(len(values)), np.maximum(picks, 0)]
    return np.asarray(np.where(picks >= 0, found, 0.0))


def merge(*parts: Tuples) -> Tuples:
    """Return all sets, the cheapest first, each once, at the cheapest of its places."""
    picks, x, cost = (np.concatenate([getattr(part, name) for part in parts]) for name in ("picks", "x", "cost"))
    order = np.argsort(cost, kind="stable")
    # unique keeps the first of equal sets, which after sorting is the cheapest.
    _, first = np.unique(picks[order], axis=0, return_index=True)
    kept = order[np.sort(first)]
    return Tuples(picks[kept], x[kept], cost[kept])


def no_sets(scene: Scene) -> Tuples:
    """Return no sets."""
    return Tuples(np.zeros((0, scene.scan.count), dtype=np.int64), np.zeros((0, scene.scan.dimension)), np.zeros(0))


def refine_sets(scene: Scene, picks: Array, start: Array) -> tuple[Tuples, Array]:
    """Return sets (q, m) refined from starts (q, d), and the covariances (q, d, d) of their places."""
    if not len(picks):
        return no_sets(scene), np.zeros((0, scene.scan.dimension, scene.scan.dimension))
    problem = scene.scan.with_rows(z=of_picks(scene.z, picks), weight=(picks >= 0).astype(float))
    done = refine(problem, start)
    # A set that does not converge has no place, so no cost that an assignment could pay.
    cost = np.where(np.isfinite(done.cost), done.cost, np.inf) + scene.constant(picks)
    return Tuples(picks, done.x, cost), covariance(done.equations)[0]


def sets_near(scene: Scene, x: Array, cov: Array, price: Array) -> Tuples:
    """Return the best sets of rows near places, found by turns of choosing rows and refining.

    A row is chosen by its distance from what is expected at a place with an error of its own, and after that once more
    at the place as it is, until the choice stays: each turn lowers the truncated cost sum_i min(row_i, missed).

    Parameters
    ----------
    scene : Scene
        One epoch.
    x : array (q, d)
        Places, metres.
    cov : array (q, d, d)
        How uncertain they are; zero for not at all.
    price : array (m, c)
        What each row costs beyond its likelihood.
    """
    found = [no_sets(scene)]
    for blur in (1.0, 0.0):
        last = None
        for _ in range(_PASSES):
            picks = _choose(scene, x, blur * cov, price)
            if last is not None and np.array_equal(picks, last):
                break
            # Fewer rows than coordinates have no place of their own.
            enough = (picks >= 0).sum(-1) >= scene.scan.dimension
            picks, x, cov = picks[enough], x[enough], cov[enough]
            if not len(picks):
                break
            tuples, cov = refine_sets(scene, picks, x)
            good = np.isfinite(cov).all((-1, -2)) & np.isfinite(tuples.cost)
            tuples, cov = tuples.take(good), cov[good]
            found.append(tuples)
            x, last = tuples.x, tuples.picks
    return merge(*found)


def _choose(scene: Scene, x: Array, cov: Array, price: Array) -> Array:
    """Return the picks (q, m) that fit best at places x (q, d) of covariance (q, d, d), channel by channel."""
    if not len(x):
        return np.zeros((0, scene.scan.count), dtype=np.int64)
    # A place with a covariance is a predicted target: the same gates as in a track.
    apart, S = offsets(scene.scan, State(0.0, x, cov), scene.z)
    s = np.diagonal(S, axis1=-2, axis2=-1)[..., None]
    with np.errstate(invalid="ignore"):
        value = apart**2 / s + np.log(2.0 * np.pi * s) - scene.gain[:, None] + price
    return cheapest_rows(scene, value)


def cheapest_rows(scene: Scene, option: Array) -> Array:
    """Return picks (q, m): of each channel the cheapest of options (q, m, c), none where missing it costs less."""
    option = np.where(np.isnan(option), np.inf, option)
    best = option.argmin(-1)
    seen = np.take_along_axis(option, best[..., None], axis=-1)[..., 0] < scene.missed
    return np.where(seen, best, -1)


def without_one_row(scene: Scene, tuples: Tuples) -> Tuples:
    """Return sets with each one of their rows left out."""
    which, channel = np.nonzero(tuples.picks >= 0)
    picks = tuples.picks[which]
    picks[np.arange(len(which)), channel] = -1
    enough = (picks >= 0).sum(-1) > scene.scan.dimension
    return refine_sets(scene, picks[enough], tuples.x[which[enough]])[0]


def row_worth(scene: Scene, tuples: Tuples) -> Array:
    """Return by how much each row (m, c) lowers the cost of its set, at its place; 1 for rows of no set."""
    out = np.ones_like(scene.z)
    variance = scene.sigma**2
    most = scene.missed + scene.gain - np.log(2.0 * np.pi * variance)
    for picks, x in zip(tuples.picks, tuples.x, strict=True):
        used = np.flatnonzero(picks >= 0)
        apart = offsets(scene.scan, State(0.0, x[None], np.zeros((1, len(x), len(x)))), scene.z)[0][0]
        lost = most[used] - apart[used, picks[used]] ** 2 / variance[used]
        out[used, picks[used]] = np.maximum(lost, _LEAST * np.maximum(most[used], 1.0))
    return out


# How far measurements can be from their values at the centre of a box of positions.


def values_in_balls(scan: Problem, centre: Array, radius: Array) -> tuple[Array, Array, Array]:
    """Return values, derivatives and remainders of the rows of a scan in balls.

    Within the ball |h(x) - h - J (x - centre)| <= remainder: half the squared radius times a bound of the second
    derivatives there, which are 1/r for a range, 1/r_h^2 for an azimuth and 1/(r r_h) for an elevation, with r_h the
    distance from the station's vertical.

    Parameters
    ----------
    scan : Problem
        Kinds of `served`; the position is all that is unknown.
    centre : array (q, d)
        Centres, metres.
    radius : array (q,)
        Radii, metres.

    Returns
    -------
    value : array (q, m)
        h at the centres.
    slope : array (q, m, d)
        J; not finite at a station.
    remainder : array (q, m)
        Infinite where the ball holds a station.
    """
    # At a station itself derivatives are not finite: bounds are infinite, and the box is halved.
    with np.errstate(all="ignore"):
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
    """Return how far the rows can be from their values at the centres of boxes, (q, m).

    Parameters
    ----------
    scan : Problem
        Of `around`.
    slope, remainder : array (q, m, d) and (q, m)
        From `around`, for the balls about the boxes.
    half : array (q, d)
        Half-widths of the boxes.
    """
    radius = np.sqrt((half**2).sum(-1))
    most = np.concatenate([_most(block, radius) for block in scan.rows], axis=-1)
    with np.errstate(invalid="ignore"):
        # Whichever is less: the linear change with its remainder, or what such rows can change at all.
        first = (np.abs(slope) * half[:, None, :]).sum(-1) + remainder
    return np.asarray(np.where(first < most, first, most))


def _most(block: Rows, radius: Array) -> Array:
    """Return how far the rows of one block can be from their values at the centres of balls in any case, (q, m)."""
    ranges = MODELS[block.kind].ranges
    # A range changes by no more than the target moves; an angle is half a turn away at most.
    limit = sum(map(abs, ranges)) * radius if ranges is not None else np.full(len(radius), np.pi)
    return np.repeat(limit[:, None], block.count, axis=-1)


def _curvature(scan: Problem, block: Rows, centre: Array, radius: Array, value: Array, steep: Array) -> Array:
    """Return a bound (q, m) of the second derivatives of one block within balls."""
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
    """What is known of an angle.

    Parameters
    ----------
    width : float
        Length of the interval of its values.
    bend : callable
        Bound (q, m) of its second derivatives in balls, from values and slopes at their centres (q, m) and the radii
        (q, 1). The slope of an azimuth is 1/r_h, that of an elevation 1/r.
    """

    width: float
    bend: Callable[[Array, Array, Array], Array]


# An azimuth is anywhere on a circle, an elevation on half of one; 1/r_h^2 and 1/(r r_h) bound how they bend.
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
    """Return the length of the interval of possible values of each row, None where it has no end."""
    if block.kind in _ANGLES:
        return np.asarray(_ANGLES[block.kind].width)
    if sum(MODELS[block.kind].ranges or (1,)):
        return None
    # A difference of ranges lies between plus and minus the distance of its stations.
    place = problem.stations.position[..., 0, :, :]
    apart = place[..., block.a, :] - place[..., block.b, :]
    return np.asarray(2.0 * np.sqrt((apart**2).sum(-1)))


def bounded_kinds() -> list[str]:
    """Return the kinds whose curvature is bounded here: sums of ranges without an emission time, and the two angles."""
    sums = [kind for kind, model in MODELS.items() if model.ranges is not None and not model.emission]
    return [*sums, *_ANGLES]

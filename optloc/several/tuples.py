"""Sets of rows of one emitter: their maximum-likelihood places, what they cost, and better ones near a place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.normal import covariance
from optloc.several.scene import Scene
from optloc.solve.refine import refine
from optloc.track.sets import offsets
from optloc.track.track import State
from optloc.types import Array

_PASSES = 4
# Share of what a row is worth that it keeps however badly it fits.
_LEAST = 0.02


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
        See `optloc.several.scene.Scene`.
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


def together(*parts: Tuples) -> Tuples:
    """Return all sets, the cheapest first, each once, at the cheapest of its places."""
    picks, x, cost = (np.concatenate([getattr(part, name) for part in parts]) for name in ("picks", "x", "cost"))
    order = np.argsort(cost, kind="stable")
    _, first = np.unique(picks[order], axis=0, return_index=True)
    kept = order[np.sort(first)]
    return Tuples(picks[kept], x[kept], cost[kept])


def nothing(scene: Scene) -> Tuples:
    """Return no sets."""
    return Tuples(np.zeros((0, scene.scan.count), dtype=np.int64), np.zeros((0, scene.scan.dimension)), np.zeros(0))


def fitted(scene: Scene, picks: Array, start: Array) -> tuple[Tuples, Array]:
    """Return sets (q, m) refined from starts (q, d), and the covariances (q, d, d) of their places."""
    if not len(picks):
        return nothing(scene), np.zeros((0, scene.scan.dimension, scene.scan.dimension))
    problem = scene.scan.with_rows(z=of_picks(scene.z, picks), weight=(picks >= 0).astype(float))
    done = refine(problem, start)
    cost = np.where(np.isfinite(done.cost), done.cost, np.inf) + scene.constant(picks)
    return Tuples(picks, done.x, cost), covariance(done.equations)[0]


def nearby(scene: Scene, x: Array, cov: Array, price: Array) -> Tuples:
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
    found = [nothing(scene)]
    for blur in (1.0, 0.0):
        last = None
        for _ in range(_PASSES):
            picks = _chosen(scene, x, blur * cov, price)
            if last is not None and np.array_equal(picks, last):
                break
            enough = (picks >= 0).sum(-1) >= scene.scan.dimension
            picks, x, cov = picks[enough], x[enough], cov[enough]
            if not len(picks):
                break
            tuples, cov = fitted(scene, picks, x)
            good = np.isfinite(cov).all((-1, -2)) & np.isfinite(tuples.cost)
            tuples, cov = tuples.take(good), cov[good]
            found.append(tuples)
            x, last = tuples.x, tuples.picks
    return together(*found)


def _chosen(scene: Scene, x: Array, cov: Array, price: Array) -> Array:
    """Return the picks (q, m) that fit best at places x (q, d) of covariance (q, d, d), channel by channel."""
    if not len(x):
        return np.zeros((0, scene.scan.count), dtype=np.int64)
    apart, S = offsets(scene.scan, State(0.0, x, cov), scene.z)
    s = np.diagonal(S, axis1=-2, axis2=-1)[..., None]
    with np.errstate(invalid="ignore"):
        value = apart**2 / s + np.log(2.0 * np.pi * s) - scene.gain[:, None] + price
    value = np.where(np.isnan(value), np.inf, value)
    best = value.argmin(-1)
    seen = np.take_along_axis(value, best[..., None], axis=-1)[..., 0] < scene.missed
    return np.where(seen, best, -1)


def thinned(scene: Scene, tuples: Tuples) -> Tuples:
    """Return sets with each one of their rows left out."""
    which, channel = np.nonzero(tuples.picks >= 0)
    picks = tuples.picks[which]
    picks[np.arange(len(which)), channel] = -1
    enough = (picks >= 0).sum(-1) > scene.scan.dimension
    return fitted(scene, picks[enough], tuples.x[which[enough]])[0]


def worth(scene: Scene, tuples: Tuples) -> Array:
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

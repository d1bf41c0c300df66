"""The global maximum-likelihood point by brute force: many starts, one batched Levenberg-Marquardt iteration.

Written from scratch, with derivatives by hand: it shares nothing with the package it judges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray
TIE = 1e-6
# Sizes of the array: by then a wave front is flat to far below any noise here, and ranges still hold their digits.
FAR = 1e6


@dataclass(frozen=True)
class Model:
    """What N trials measure, one static emitter each.

    Parameters
    ----------
    stations : array (N, s, d)
        Metres.
    combine : array (m, s), optional
        Rows as sums of ranges; None: azimuth and elevation at every station.
    white : array (q, m)
        Whitening matrix: white' white is the inverse covariance. Unknowns in which the rows are linear (an emission
        time) are projected out of it.
    """

    stations: Array
    combine: Array | None
    white: Array

    def exact(self, x: Array) -> Array:
        """Return the noiseless rows (N, m) of emitters x (N, d)."""
        return self.rows(x, np.arange(len(x)))[0]

    def rows(self, x: Array, item: Array) -> tuple[Array, Array]:
        """Return rows (K, m) and their Jacobian (K, m, d) for points x (K, d) of trials `item`."""
        apart = x[:, None] - self.stations[item]
        r = np.linalg.norm(apart, axis=-1)
        if self.combine is not None:
            return r @ self.combine.T, self.combine @ (apart / r[..., None])
        east, north, up = np.moveaxis(apart, -1, 0)
        flat = np.hypot(east, north)
        turn = np.stack([-north / flat**2, east / flat**2, 0.0 * up], axis=-1)
        lift = np.stack([-east * up / flat, -north * up / flat, flat], axis=-1) / r[..., None] ** 2
        angles = np.concatenate([np.arctan2(north, east), np.arctan2(up, flat)], axis=-1)
        return angles, np.concatenate([turn, lift], axis=-2)

    def residual(self, x: Array, z: Array, item: Array) -> tuple[Array, Array]:
        """Return whitened residuals (K, q) and the whitened Jacobian (K, q, d)."""
        rows, jacobian = self.rows(x, item)
        apart = z[item] - rows
        if self.combine is None:
            apart = (apart + np.pi) % (2.0 * np.pi) - np.pi
        return apart @ self.white.T, self.white @ jacobian

    def cost(self, x: Array, z: Array) -> Array:
        """Return the weighted sum of squares (N, ...) at points x (N, ..., d), infinite where x is not a number."""
        flat = x.reshape(-1, x.shape[-1])
        item = np.repeat(np.arange(len(x)), len(flat) // max(len(x), 1))
        with np.errstate(all="ignore"):
            cost = (self.residual(flat, z, item)[0] ** 2).sum(-1)
        return np.where(np.isfinite(cost), cost, np.inf).reshape(x.shape[:-1])

    def decrement(self, x: Array, z: Array) -> Array:
        """Return g' (J'J)^-1 g, (N,): the squared length of the next Gauss-Newton step in standard deviations."""
        w, J = self.residual(x, z, np.arange(len(x)))
        g = np.swapaxes(J, 1, 2) @ w[..., None]
        return (g[..., 0] * (np.linalg.pinv(np.swapaxes(J, 1, 2) @ J, rcond=1e-12) @ g)[..., 0]).sum(-1)


@dataclass(frozen=True)
class Minimum:
    """The best point found for each trial.

    Parameters
    ----------
    x : array (N, d)
        The lowest minimum.
    cost : array (N,)
        Its cost.
    infimum : array (N,)
        The lowest cost seen anywhere, also by iterations that ran away: below `cost` where the likelihood keeps
        rising towards infinity.
    """

    x: Array
    cost: Array
    infimum: Array

    @property
    def at_infinity(self) -> Array:
        """Return where no finite point is the best one, (N,)."""
        return self.infimum * (1.0 + TIE) + TIE < self.cost


def global_minimum(model: Model, z: Array, truth: Array, seed: np.random.SeedSequence, spread: int = 20) -> Minimum:
    """Return the lowest of the minima next to the truth and next to `spread` points at all distances and bearings."""
    rng = np.random.default_rng(seed)
    count, d = truth.shape
    centre = model.stations.mean(1)
    size = np.linalg.norm(model.stations - centre[:, None], axis=-1).max(1)
    way = rng.standard_normal((count, spread, d))
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    far = 10.0 ** rng.uniform(-1.0, 1.7, (count, spread, 1))
    starts = np.concatenate([truth[:, None], centre[:, None] + way * far * size[:, None, None]], axis=1)
    item = np.repeat(np.arange(count), spread + 1)
    x, cost, done = descend(model, z, starts.reshape(-1, d), item, centre, FAR * size)
    x, cost, done = (array.reshape(count, spread + 1, *array.shape[1:]) for array in (x, cost, done))
    settled = np.where(done, cost, np.inf)
    best = settled.argmin(1)[:, None]
    return Minimum(
        np.take_along_axis(x, best[..., None], 1)[:, 0], np.take_along_axis(settled, best, 1)[:, 0], cost.min(1)
    )


def descend(
    model: Model, z: Array, start: Array, item: Array, centre: Array, radius: Array, limit: int = 300
) -> tuple[Array, Array, Array]:
    """Return where Levenberg-Marquardt iterations end: points (K, d), costs, and which of them came to rest.

    Iterations that leave the radius (N,) about the centre (N, d) are stopped there.
    """
    x, now = np.array(start), np.arange(len(start))
    with np.errstate(all="ignore"):
        w, J = model.residual(x, z, item)
        cost = (w**2).sum(-1)
        value, damping, done = np.array(cost), np.full(len(x), 1e-3), np.zeros(len(x), dtype=bool)
        for _ in range(limit):
            if not len(now):
                break
            move, gain = _step(w, J, damping)
            point = x[now] + move
            after, slope = model.residual(point, z, item[now])
            value = (after**2).sum(-1)
            better = value <= cost[now]
            to = now[better]
            x[to], cost[to], w[better], J[better] = point[better], value[better], after[better], slope[better]
            damping = np.where(better, np.maximum(damping / 8.0, 1e-14), damping * 5.0)
            # At the rounding floor no step is better; the undamped step says how little is left.
            done[now] = gain < 1e-11 * (1.0 + 1e-2 * cost[now])
            away = np.linalg.norm(x[now] - centre[item[now]], axis=-1) > radius[item[now]]
            going = ~done[now] & (damping < 1e12) & ~away
            done[now[away]] = False
            now, w, J, damping = now[going], w[going], J[going], damping[going]
    return x, np.where(np.isfinite(cost), cost, np.inf), done


def _step(w: Array, J: Array, damping: Array) -> tuple[Array, Array]:
    """Return the damped steps and the decrease that undamped ones promise."""
    turned = np.swapaxes(J, 1, 2)
    normal, g = turned @ J, (turned @ w[..., None])[..., 0]
    scale = np.sqrt(np.diagonal(normal, axis1=1, axis2=2)) + 1e-150
    g, normal = g / scale, normal / (scale[:, :, None] * scale[:, None, :])
    usable = np.isfinite(normal).all((1, 2)) & np.isfinite(g).all(1)
    normal, g = np.where(usable[:, None, None], normal, np.eye(J.shape[-1])), np.where(usable[:, None], g, 0.0)
    # The floor keeps every matrix of the batch regular.
    added = np.stack([damping, np.zeros(len(w))]) + 1e-13
    move = np.linalg.solve(normal + added[..., None, None] * np.eye(J.shape[-1]), np.stack([g, g])[..., None])[..., 0]
    return move[0] / scale, np.where(usable, (move[1] * g).sum(-1), np.inf)

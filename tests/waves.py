"""Arrivals of waves whose speed is unknown: plates, rocks and scenes in air, with costs by formulas of their own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, nnls

from optloc import Problem, assemble, measured, with_bias

Array = np.ndarray


@dataclass(frozen=True)
class Scene:
    """Arrivals of one wave: sensors (n, d), times as ranges (n,), their noise, and the prior on the scale or None."""

    place: Array
    z: Array
    sigma: float
    prior: float | None
    truth: Array

    @property
    def problem(self) -> Problem:
        """Return the problem of the arrivals."""
        n = len(self.place)
        found = assemble(self.place, measured("toa", a=np.arange(n), z=self.z, sigma=self.sigma))
        return with_bias(found, "speed", form="scale", per="kind", sigma=self.prior)

    def residual(self, x: Array) -> Array:
        """Return whitened residuals at x = (position, scale, emission)."""
        d = self.place.shape[1]
        own = ((1.0 + x[d]) * np.linalg.norm(self.place - x[:d], axis=1) + x[d + 1] - self.z) / self.sigma
        return own if self.prior is None else np.append(own, x[d] / self.prior)

    def minima(self, rng: np.random.Generator, count: int) -> list[tuple[float, Array]]:
        """Return costs and places of minima with a wave that runs forwards, the least first, from random starts."""
        d = self.place.shape[1]
        size, middle = np.ptp(self.place, axis=0).max(), self.place.mean(0)
        found: list[tuple[float, Array]] = []
        for _ in range(count):
            way = rng.standard_normal(d)
            start = middle + size * 10.0 ** rng.uniform(-1.0, 1.0) * way / np.linalg.norm(way)
            scale = 0.3 * rng.standard_normal()
            shift = np.mean(self.z - (1.0 + scale) * np.linalg.norm(self.place - start, axis=1))
            one = least_squares(
                self.residual,
                np.r_[start, scale, shift],
                x_scale=np.r_[np.full(d, size), 0.1, size],
                method="lm",
                xtol=1e-12,
            )
            cost = 2.0 * one.cost
            if one.x[d] <= -1.0 or np.linalg.norm(one.x[:d] - middle) > 1e3 * size or not one.success:
                continue
            if np.abs(one.grad).max() > 1e-3 * (1.0 + np.abs(one.jac).max()):
                continue
            if not any(np.linalg.norm(one.x[:d] - x[:d]) < 1e-3 * size for _, x in found):
                found.append((cost, one.x))
        return sorted(found, key=lambda pair: pair[0])

    def plane_wave(self) -> float:
        """Return the least cost of plane waves, their factor positive."""
        d = self.place.shape[1]
        turn = np.linspace(0.0, 2.0 * np.pi, 721)
        if d == 2:
            ways = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        else:
            number = np.arange(4000) + 0.5
            up, around = 1.0 - 2.0 * number / 4000, np.pi * (1.0 + np.sqrt(5.0)) * number
            ways = np.stack([np.sqrt(1 - up**2) * np.cos(around), np.sqrt(1 - up**2) * np.sin(around), up], axis=-1)
        costs = [self._along(way) for way in ways]
        best = np.inf
        for k in np.argsort(costs)[:4]:
            best = min(best, costs[k], 2.0 * least_squares(self._wave, self._vector(ways[k]), x_scale="jac").cost)
        return best

    def _wave(self, y: Array) -> Array:
        d = self.place.shape[1]
        own = (y[d] - self.place @ y[:d] - self.z) / self.sigma
        return own if self.prior is None else np.append(own, (np.linalg.norm(y[:d]) - 1.0) / self.prior)

    def _system(self, way: Array) -> tuple[Array, Array]:
        A = np.column_stack([-(self.place @ way), np.ones(len(self.z)), -np.ones(len(self.z))]) / self.sigma
        b = self.z / self.sigma
        if self.prior is not None:
            A, b = np.vstack([A, [1.0 / self.prior, 0.0, 0.0]]), np.append(b, 1.0 / self.prior)
        return A, b

    def _along(self, way: Array) -> float:
        return float(nnls(*self._system(way))[1] ** 2)

    def _vector(self, way: Array) -> Array:
        k, up, down = nnls(*self._system(way))[0]
        return np.append(max(k, 1e-6) * way, up - down)

    def paraboloid(self) -> float:
        """Return the least cost where speed and distance grow together, infinite where the stations forbid it."""
        if self.prior is not None:
            return np.inf
        centred = self.place - self.place.mean(0)
        _, size, axes = np.linalg.svd(centred)
        d = self.place.shape[1]
        if len(size) == d and size[-1] > 1e-9 * size[0]:
            return np.inf
        flat = centred @ axes[: d - 1].T
        columns = [np.ones(len(flat)), *flat.T]
        A = np.column_stack([*columns, *(-one for one in columns), (flat**2).sum(1)]) / self.sigma
        return float(nnls(A, self.z / self.sigma)[1] ** 2)


def plate(rng: np.random.Generator, d: int, n: int, prior: float | None, *, flat: bool = False) -> Scene:
    """Return a scene of acoustic emission: sensors on a plate or a rock, stated speed 4500 m/s, true 5200 m/s."""
    high = np.array([0.4, 0.3, 0.2])[:d]
    place, truth = rng.uniform(0.0, high, (n, d)), rng.uniform(0.0, high)
    if flat:
        place[:, -1] = 0.0
    stated, speed, error = 4500.0, 5200.0, 5e-7
    times = np.linalg.norm(place - truth, axis=1) / speed + 1e-3 + error * rng.standard_normal(n)
    return Scene(place, stated * times, stated * error, prior, truth)


def air(rng: np.random.Generator, d: int, n: int, prior: float | None) -> Scene:
    """Return a scene in air: microphones within 20 m, arrivals to 0.1 ms, and a speed that the prior is about."""
    high = np.array([20.0, 20.0, 6.0])[:d]
    place, truth = rng.uniform(0.0, high, (n, d)), rng.uniform(-0.5 * high, 1.5 * high)
    speed = 343.0 / (1.0 + (prior or 0.05) * np.clip(rng.standard_normal(), -2.5, 2.5))
    times = np.linalg.norm(place - truth, axis=1) / speed + 0.01 + 1e-4 * rng.standard_normal(n)
    return Scene(place, 343.0 * times, 343.0 * 1e-4, prior, truth)

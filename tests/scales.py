"""Differences of ranges and of levels with several unknown scales, with costs by formulas of their own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, minimize_scalar, nnls

from optloc import Problem, assemble, measured
from optloc.base.types import Bias

Array = np.ndarray
# Decibels of a unit of the logarithm of a range in free space.
DECIBELS = 20.0 / np.log(10.0)


@dataclass(frozen=True)
class Group:
    """Rows with one scale: differences to the first station (n - 1,), noise, and the prior; `known`: no scale."""

    z: Array
    sigma: float
    prior: float | None
    known: bool = False


@dataclass(frozen=True)
class Scales:
    """Stations (n, d), groups of rows with a scale each, whether rows are levels, and the truth."""

    place: Array
    groups: tuple[Group, ...]
    levels: bool
    truth: Array

    @property
    def problem(self) -> Problem:
        """Return the problem of all rows."""
        n, kind = len(self.place), "rss_difference" if self.levels else "tdoa"
        first, each = np.zeros(n - 1, dtype=int), np.arange(1, n)
        rows = [measured(kind, a=each, b=first, z=one.z, sigma=one.sigma) for one in self.groups]
        found, biases = assemble(self.place, *rows), []
        for i, one in enumerate(self.groups):
            if not one.known:
                sigma = None if one.prior is None else np.array([one.prior])
                row, name = np.arange(i * (n - 1), (i + 1) * (n - 1)), f"scale{i}"
                biases.append(Bias(name, (name,), row, 0 * row, np.ones(n - 1), "scale", np.zeros(1), sigma))
        return replace(found, biases=tuple(biases))

    @property
    def free(self) -> list[Group]:
        """Return the groups with a scale."""
        return [one for one in self.groups if not one.known]

    def measured_at(self, x: Array) -> Array:
        """Return the differences (n - 1,) at a position without scales."""
        r = np.linalg.norm(self.place - x, axis=1)
        phi = -DECIBELS * np.log(r) if self.levels else r
        return np.asarray(phi[1:] - phi[0])

    def system(self, h: Array) -> tuple[Array, Array]:
        """Return rows (m, G) and right sides (m,) of the factors for differences h, priors among them."""
        A, b, at = [], [], 0
        for one in self.groups:
            rows = np.zeros((len(h) + (one.prior is not None), len(self.free)))
            right = (one.z - h if one.known else one.z) / one.sigma
            if not one.known:
                rows[: len(h), at] = h / one.sigma
                if one.prior is not None:
                    rows[-1, at], right = 1.0 / one.prior, np.append(right, 1.0 / one.prior)
                at += 1
            A.append(rows[: len(right)])
            b.append(right)
        return np.concatenate(A), np.concatenate(b)

    def profiled(self, x: Array) -> tuple[Array, Array]:
        """Return the least costs (n,) at positions (n, d), and their factors (n, G), which are not negative."""
        best = [nnls(*self.system(self.measured_at(one))) for one in x]
        return np.array([norm**2 for _, norm in best]), np.array([k for k, _ in best])

    def cost(self, x: Array, k: Array) -> float:
        """Return the cost at a position and factors."""
        A, b = self.system(self.measured_at(x))
        return float(((A @ k - b) ** 2).sum())

    def minima(self, rng: np.random.Generator, count: int) -> list[tuple[float, Array]]:
        """Return costs and vectors (position, scales) of minima, the least first, from random starts."""
        d, size, middle = self.place.shape[1], np.ptp(self.place, axis=0).max(), self.place.mean(0)
        found: list[tuple[float, Array]] = []

        def residual(y: Array) -> Array:
            A, b = self.system(self.measured_at(y[:d]))
            return np.asarray(A @ (1.0 + y[d:]) - b)

        for _ in range(count):
            way = rng.standard_normal(d)
            start = middle + size * 10.0 ** rng.uniform(-1.0, 1.0) * way / np.linalg.norm(way)
            one = least_squares(residual, np.r_[start, 0.2 * rng.standard_normal(len(self.free))], method="lm")
            away = np.linalg.norm(one.x[:d] - middle)
            if (one.x[d:] <= -1.0).any() or away > 1e3 * size or np.abs(one.grad).max() > 1e-3 * np.abs(one.jac).max():
                continue
            found.append((2.0 * one.cost, one.x))
        return sorted(found, key=lambda pair: pair[0])

    def infinity(self) -> float:
        """Return the least cost of infinity in the plane, of levels with one scale: a constant, or a linear field."""
        along = self.place[1:] - self.place[0]
        if self.levels:
            (one,) = self.groups
            field = along / one.sigma if one.prior is None else np.zeros_like(along)
            left = one.z / one.sigma - field @ np.linalg.lstsq(field, one.z / one.sigma, rcond=None)[0]
            return float((left**2).sum())

        def wave(turn: float) -> float:
            return float(nnls(*self.system(-along @ np.array([np.cos(turn), np.sin(turn)])))[1] ** 2)

        turns = np.linspace(0.0, 2.0 * np.pi, 181)
        best = turns[int(np.argmin([wave(turn) for turn in turns]))]
        return float(minimize_scalar(wave, bounds=(best - 0.05, best + 0.05), method="bounded").fun)


def scales(rng: np.random.Generator, d: int, n: int, priors: tuple[float | str | None, ...], levels: bool) -> Scales:
    """Return stations within 10 m and a target around, rows of 5 cm or 1 dB; a prior "known" stands for no scale."""
    place, truth = rng.uniform(0.0, 10.0, (n, d)), rng.uniform(-3.0, 13.0, d)
    sigma, groups = 1.0 if levels else 0.05, []
    bare = Scales(place, (), levels, truth).measured_at(truth)
    for prior in priors:
        known = prior == "known"
        spread = 0.0 if known else 0.1 if prior is None else float(prior)
        z = (1.0 + spread * np.clip(rng.standard_normal(), -2.0, 2.0)) * bare + sigma * rng.standard_normal(n - 1)
        groups.append(Group(z, sigma, None if known else prior, known))
    return Scales(place, tuple(groups), levels, truth)

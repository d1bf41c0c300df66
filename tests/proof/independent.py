"""Minima by SciPy from many starts: formulas and derivatives of its own, one trial at a time."""

from __future__ import annotations

import numpy as np
from descent import EXACT, levenberg
from scipy.optimize import least_squares

from optloc import Problem

Array = np.ndarray


class Trial:
    """The whitened residuals of one trial of a problem of `proof.layouts`, and its starts."""

    def __init__(self, problem: Problem, item: int) -> None:
        def own(array: Array, core: int) -> Array:
            return array[item] if array.ndim > core else array

        self.place = own(problem.stations.position, 3)[0]
        self.rows = [(r.kind, r.a, r.b, own(r.z, 1)) for r in problem.rows]
        m = problem.count
        full = np.zeros((m, m))
        for block in problem.noise.blocks:
            covariance = own(block.covariance, 3)
            for g, members in enumerate(block.row):
                full[np.ix_(members, members)] = covariance[g if len(covariance) > 1 else 0]
        white = np.linalg.inv(np.linalg.cholesky(full))
        late = np.concatenate([np.full(len(r.a), r.kind == "toa", dtype=float) for r in problem.rows])
        if late.any():  # the emission time at its best: the component along it is taken off
            q = white @ late / np.linalg.norm(white @ late)
            white = white - np.outer(q, q @ white)
        self.white = white

    def residual(self, x: Array) -> Array:
        apart = x - self.place
        r = np.sqrt((apart**2).sum(-1))
        out = []
        for kind, a, b, z in self.rows:
            if kind in ("azimuth", "elevation"):
                level = np.hypot(apart[a, 0], apart[a, 1])
                angle = np.arctan2(apart[a, 1], apart[a, 0]) if kind == "azimuth" else np.arctan2(apart[a, 2], level)
                out.append((angle - z + np.pi) % (2.0 * np.pi) - np.pi)
                continue
            if kind == "rss_difference":
                out.append(20.0 * np.log10(r[b] / r[a]) - z)
                continue
            value = r[a] / r[b] if kind == "groa" else r[a] + {"tdoa": -1.0, "range_sum": 1.0}.get(kind, 0.0) * r[b]
            out.append(value - z)
        return self.white @ np.concatenate(out)

    def slope(self, x: Array) -> Array:
        apart = x - self.place
        r = np.sqrt((apart**2).sum(-1))
        u, out = apart / r[:, None], []
        for kind, a, b, _ in self.rows:
            if kind == "azimuth":
                flat = (apart[a, :2] ** 2).sum(-1)[:, None]
                row = np.zeros((len(a), len(x)))
                row[:, :2] = np.stack([-apart[a, 1], apart[a, 0]], axis=-1) / flat
            elif kind == "elevation":
                level = np.hypot(apart[a, 0], apart[a, 1])
                row = np.column_stack([-apart[a, 2:] * apart[a, :2] / level[:, None], level]) / (r[a] ** 2)[:, None]
            elif kind == "rss_difference":
                row = 20.0 / np.log(10.0) * (u[b] / r[b][:, None] - u[a] / r[a][:, None])
            elif kind == "groa":
                row = u[a] / r[b][:, None] - (r[a] / r[b] ** 2)[:, None] * u[b]
            else:
                sign = {"tdoa": -1.0, "range_sum": 1.0}.get(kind, 0.0)
                row = u[a] + sign * u[b]
            out.append(row)
        return self.white @ np.concatenate(out)

    def cost(self, x: Array) -> float:
        return float((self.residual(x) ** 2).sum())

    def descended(self, start: Array) -> tuple[Array, float, float]:
        """Return the minimum next to a start, its cost and the largest component of its gradient in sigma."""
        scale = np.abs(self.place - self.place.mean(0)).max()
        middle = self.place.mean(0)
        with np.errstate(all="ignore"):
            steps = (
                lambda y: self.residual(middle + scale * y),
                (start - middle) / scale,
                lambda y: self.slope(middle + scale * y) * scale,
            )
            # Levenberg's method is not for fewer rows than unknowns
            done = levenberg(*steps) if len(self.white) >= len(start) else least_squares(*steps, **EXACT)
            J = done.jac
            if not (np.isfinite(J).all() and np.isfinite(done.fun).all()):  # on a station, or far out
                return middle + scale * done.x, np.inf, np.inf
            step = np.linalg.lstsq(J, done.fun, rcond=None)[0]
        return middle + scale * done.x, 2.0 * done.cost, float(np.linalg.norm(J @ step))

    def minima(self, truth: Array, rng: np.random.Generator, count: int) -> list[tuple[Array, float, float]]:
        """Return where `count` descents end: from the truth and from places at all distances and bearings."""
        d = len(truth)
        way = rng.standard_normal((count - 1, d))
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        middle = self.place.mean(0)
        size = np.linalg.norm(self.place - middle, axis=-1).max()
        size = size if size > 0.0 else 1e4
        starts = middle + way * size * 10.0 ** rng.uniform(-1.0, 1.2, (count - 1, 1))
        return [self.descended(start) for start in (truth, *starts)]

"""Least squares of the rows of a file over positions, emission times and the parameters of one change of the file."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from advice.scene import Array, Data, predicted

# Steps of least squares, starts for each epoch, and relative change of the cost at which the steps end.
_STEPS, _STARTS, _DONE = 30, 2, 1e-5
# Steps after which a start is dropped if its cost is still so many times the cost of interest.
_TRIED, _HOPELESS = 8, 100.0


@dataclass(frozen=True)
class Change:
    """A file after a change, with free parameters that least squares estimates.

    - columns (q, E, R): rows per unit of each additive parameter.
    - form: "add", "scale" (factor 1 + s of the predictions of the rows in columns), "move" (of station `who`),
      "slant" (square of a height above the plane), "level" (height of all targets) or "late" (a mixture).
    - offset: -2 log of the change of the density by a transformation of the values.
    """

    cause: str
    stations: tuple[int, ...]
    data: Data
    price: float
    columns: Array | None = None
    form: str = "add"
    who: int = -1
    offset: float = 0.0
    rows: tuple[int, ...] = ()
    limit: float = np.inf


def _whitening(data: Data) -> Array:
    """Return the matrix (R, R) that whitens the rows of an epoch."""
    out = np.diag(1.0 / data.sigma)
    mine = np.flatnonzero(data.of("tdoa"))
    if len(mine):
        a, b, s = data.a[mine], data.b[mine], data.sigma[mine]
        shared = (b[:, None] == b) * 1.0 + (a[:, None] == a) - (a[:, None] == b) - (b[:, None] == a)
        # a row of a station against itself has no noise of its own
        shared += np.diag(np.where(a == b, 1.0, 0.0))
        out[np.ix_(mine, mine)] = np.linalg.inv(np.linalg.cholesky(shared * s[:, None] * s))
    return out


class Fit:
    """Least squares of one change from several starts at once."""

    def __init__(self, change: Change, used: Array | None = None, interest: float = np.inf):
        """Prepare the fit; `used` (E, R) are the rows with weight; costs far above `interest` need no accuracy."""
        self.interest = interest
        self.change, self.data = change, change.data
        self.white = _whitening(change.data)
        self.used = np.ones(self.data.z.shape, bool) if used is None else used
        self.angles = np.array([kind == "azimuth" for kind in self.data.kind])
        self.has_angles = bool(self.angles.any())
        self.toa = self.data.of("toa")
        self.d = self.data.place.shape[1]
        self.free = self.d - (self.data.level is not None or change.form == "level")
        self.emission = "toa" in self.data.kind
        self.q = {"add": 0 if change.columns is None else len(change.columns), "move": self.d}.get(change.form, 1)
        self.span = float(np.sqrt(((self.data.place - self.data.place.mean(0)) ** 2).sum(1)).max())

    def residual(self, x: Array, theta: Array) -> Array:
        """Return the residuals (B, E, R) at positions (B, E, d) and parameters (B, q), before whitening."""
        change, data = self.change, self.data
        place = data.place
        if change.form == "move":
            place = np.repeat(place[None], len(x), 0)
            place[:, change.who] += theta
        if change.form == "slant":
            height = np.sqrt(np.maximum(theta[:, 0], 0.0))
            flat = np.concatenate([data.place, np.zeros((data.stations, 1))], 1)
            up = np.broadcast_to(height[:, None, None], (*x.shape[:-1], 1))
            model = predicted(replace(data, place=flat), np.concatenate([x, up], -1))
        else:
            model = predicted(data, x, place)
        if change.form == "scale":
            model = model * (1.0 + theta[:, 0, None, None] * change.columns[0])
        elif change.form == "add" and change.columns is not None:
            model = model + (theta[:, :, None, None] * change.columns).sum(1)
        return np.where(self.used, self._turned(data.z - model), 0.0)

    def whitened(self, x: Array, theta: Array) -> Array:
        """Return the white residuals (B, E, R) with the emission times eliminated."""
        return self.projected(self.residual(x, theta) @ self.white.T)

    def projected(self, r: Array) -> Array:
        if not self.emission:
            return r
        one = (self.used * np.diag(self.white)) * self.toa
        total = np.maximum((one**2).sum(-1, keepdims=True), 1e-300)
        return r - one * ((one * r).sum(-1, keepdims=True) / total)

    def run(self, x: Array, theta: Array, steps: int = _STEPS) -> tuple[Array, Array, Array]:
        """Return positions, parameters and costs (B,) after damped Gauss-Newton steps.

        Without parameters the epochs share nothing, and each has its own damping.
        """
        r = self.whitened(x, theta)
        cost = self._costs(r)
        damping = np.full(cost.shape, 1e-3)
        for number in range(steps):
            dx, dt = self._step(*self.derivatives(x, theta, r), r, damping)
            step = np.zeros_like(x)
            step[..., : self.free] = dx
            new_t = np.clip(theta + dt, -self.change.limit, self.change.limit)
            new_x = x + step
            if self.change.form == "level":
                new_x[..., self.d - 1] = new_t[:, 0, None]
            new_r = self.whitened(new_x, new_t)
            new = self._costs(new_r)
            better = new < cost
            done = cost - np.where(better, new, cost) <= _DONE * cost + 1e-4
            x, r = np.where(better[..., None], new_x, x), np.where(better[..., None], new_r, r)
            theta, cost = np.where(better[:, :1], new_t, theta), np.where(better, new, cost)
            damping = np.clip(np.where(better, damping / 5.0, damping * 8.0), 1e-12, 1e12)
            if (done & (better | (damping > 1e6))).all():
                break
            if number == _TRIED and (r**2).sum((1, 2)).min() > _HOPELESS * max(self.interest, 100.0):
                break
        return x, theta, (r**2).sum((1, 2))

    def _costs(self, r: Array) -> Array:
        """Return the costs (B, E) that decide about a step: of each epoch, or of all epochs if parameters join them."""
        cost = (r**2).sum(-1)
        return np.repeat(cost.sum(-1, keepdims=True), cost.shape[-1], -1) if self.q else cost

    def _step(self, jx: Array, jt: Array, r: Array, damping: Array) -> tuple[Array, Array]:
        """Return the damped steps of the positions (B, E, k) and of the parameters (B, q)."""
        a = np.einsum("berk,berl->bekl", jx, jx)
        g = np.einsum("berk,ber->bek", jx, r)
        scale = np.einsum("bekk->bek", a)
        # the last terms keep matrices of positions without information invertible
        a = a + (damping[..., None] * scale + 1e-300 + 1e-12 * scale.max(-1, keepdims=True))[..., None] * np.eye(
            self.free
        )
        if not self.q:
            return np.linalg.solve(a, g[..., None])[..., 0], np.zeros((len(r), 0))
        c = np.einsum("berk,berq->bekq", jx, jt)
        both = np.linalg.solve(a, np.concatenate([g[..., None], c], -1))
        s = np.einsum("berp,berq->bpq", jt, jt) * (1.0 + damping[:, :1, None] * np.eye(self.q))
        s = s - np.einsum("bekp,bekq->bpq", c, both[..., 1:])
        h = np.einsum("berq,ber->bq", jt, r) - np.einsum("bekq,bek->bq", c, both[..., 0])
        s = s + (1e-300 + 1e-12 * np.einsum("bqq->bq", s).max(-1))[:, None, None] * np.eye(self.q)
        dt = np.linalg.solve(s, h[..., None])[..., 0]
        return both[..., 0] - np.einsum("bekq,bq->bek", both[..., 1:], dt), dt

    def derivatives(self, x: Array, theta: Array, r: Array) -> tuple[Array, Array]:
        """Return the derivatives of the predictions: by positions (B, E, R, d) and by parameters (B, E, R, q)."""
        step, k = 1e-6 * self.span, self.free
        shift = step * np.eye(k, self.d)[:, None, None, :]
        both = np.concatenate([x + shift, x - shift]).reshape(-1, *x.shape[1:])
        values = self.residual(both, np.tile(theta, (2 * k, 1))).reshape(2, k, *r.shape)
        change = self._turned(values[1] - values[0])
        jx = np.moveaxis(self.projected(change @ self.white.T), 0, -1) / (2.0 * step)
        jt = np.empty((*r.shape, self.q))
        for k in range(self.q):
            step_t = self._parameter_step(theta[:, k], k)
            shift = np.zeros_like(theta)
            shift[:, k] = step_t
            y = z = x
            if self.change.form == "level":
                y, z = x.copy(), x.copy()
                y[..., self.d - 1] += step_t[:, None]
                z[..., self.d - 1] -= step_t[:, None]
            jt[..., k] = self._difference(y, theta + shift, z, theta - shift) / (2.0 * step_t[:, None, None])
        return jx, jt

    def _difference(self, x: Array, t: Array, y: Array, u: Array) -> Array:
        """Return the white change of the predictions between two points."""
        return self.projected(self._turned(self.residual(y, u) - self.residual(x, t)) @ self.white.T)

    def _turned(self, change: Array) -> Array:
        """Return differences of rows with angles between -pi and pi."""
        if self.has_angles:
            turn = change[..., self.angles]
            change[..., self.angles] = np.arctan2(np.sin(turn), np.cos(turn))
        return change

    def _parameter_step(self, theta: Array, k: int) -> Array:
        """Return the steps (B,) of the difference quotient of a parameter."""
        form, size = self.change.form, float(np.median(self.data.sigma))
        if form in ("move", "level"):
            return np.full(len(theta), 1e-6 * self.span)
        if form == "slant":
            return np.maximum(1e-6 * self.span**2, 1e-6 * np.abs(theta))
        if form == "scale":
            return np.full(len(theta), 1e-6)
        column = float(np.abs(self.change.columns[k]).max())
        return np.full(len(theta), 0.01 * size / max(column, 1e-300))


def _grid(data: Data) -> Array:
    """Return positions (G, d) where a target may be, without any use of the truth."""
    centre = data.place.mean(0)
    d, extent = data.place.shape[1], np.abs(data.place - centre).max()
    if d == 2:
        axis = np.linspace(-2.0, 2.0, 15)
        points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
        angle = np.arange(16) * np.pi / 8.0
        far = 10.0 * np.stack([np.cos(angle), np.sin(angle)], -1)
        return centre + extent * np.concatenate([points, far])
    axis = np.linspace(-1.5, 1.5, 7)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    out = centre + extent * np.concatenate([points, 5.0 * points[np.abs(points).max(1) > 1.4][::7]])
    if np.sqrt((data.place[0] ** 2).sum()) > 6e6:
        # around the Earth, and above the receivers
        k = np.arange(200)
        z = 1.0 - (2.0 * k + 1.0) / 200.0
        angle = k * np.pi * (3.0 - np.sqrt(5.0))
        ball = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], -1)
        up = centre / np.sqrt((centre**2).sum())
        near = points[points[:, 2] == 0.0] * extent + centre + 9e3 * up
        out = np.concatenate([out, 6.378e6 * ball, near])
    if data.level is not None:
        out[:, 2] = data.level
    return out


def starts_of(fit: Fit, truth: Array) -> Array:
    """Return starts (B, E, d): the truth, and the best points of a grid for each epoch."""
    grid, e = _grid(fit.data), len(fit.data.z)
    points = np.repeat(grid[:, None], e, 1)
    theta = np.zeros((len(grid), fit.q))
    cost = (fit.whitened(points, theta) ** 2).sum(-1)
    order = np.argsort(cost, axis=0, kind="stable")[: 4 * _STARTS : 2]
    starts = np.concatenate([truth[None], grid[order]])[: 1 + _STARTS * 2]
    if fit.data.level is not None:
        starts[..., -1] = fit.data.level
    return starts


def best_epochs(fit: Fit, starts: Array) -> Array:
    """Return the best positions (1, E, d) of least squares of each epoch alone, and its runner-up, (2, E, d)."""
    x, _, _ = fit.run(starts, np.zeros((len(starts), fit.q)))
    cost = (fit.whitened(x, np.zeros((len(x), fit.q))) ** 2).sum(-1)
    order = np.argsort(cost, axis=0, kind="stable")[:2]
    return np.take_along_axis(x, order[..., None], 0)

"""Costs of ranges and linear forms for tests of the proof, with their own formulas for values and derivatives."""

from dataclasses import dataclass

import numpy as np

from optloc.proof.nodes.dispatch import NODES
from optloc.proof.nodes.node import LINEAR, RANGE
from optloc.proof.position_costs import PositionCosts
from optloc.proof.search_space import KnownMinima, cost_of, empty_box

Array = np.ndarray


def beside(points, d=3, hidden=0):
    """Return other minima (P, d) as a proof wants them."""
    return KnownMinima(np.array(points, dtype=float).reshape(-1, d), hidden, np.zeros((0, 3)), np.zeros(0))


def down_from(kappa):
    """Return the gaps to prove from one asked for down to the value alone."""
    return np.array([kappa, 0.0] if kappa > 0.0 else [0.0])


def no_rivals(d=3):
    """Return no room for minima that a proof meets: it ends at the first."""
    return np.zeros((0, d))


NO_REGION = np.full(3, np.nan)
# How many numbers any shipped node has at most.
WIDTH = max(node.width for node in NODES)


@dataclass(frozen=True)
class Case:
    """The cost |K phi(x) - w|^2 of ranges to `stations` (M, d) and, behind them, the d coordinates if K has columns."""

    stations: Array
    K: Array
    w: Array

    @property
    def d(self):
        return self.stations.shape[1]

    @property
    def tables(self):
        """Return the cost as the proof takes it, and a box with room for its nodes."""
        return cost_of(self.kinds, self.data, self.K, self.w), empty_box(*self.K.shape)

    @property
    def batch(self):
        """Return the cost as a batch of one."""
        return PositionCosts(self.kinds, self.data[None], self.K[None], self.w[None], np.full(1, np.inf))

    @property
    def kinds(self):
        extra = self.K.shape[1] - len(self.stations)
        return np.array([RANGE] * len(self.stations) + [LINEAR] * extra, dtype=np.int64)

    @property
    def data(self):
        numbers = np.zeros((self.K.shape[1], WIDTH))
        numbers[: len(self.stations), : self.d] = self.stations
        for k in range(self.K.shape[1] - len(self.stations)):
            numbers[len(self.stations) + k, 3 + k] = 1.0
        return numbers

    def residual(self, x):
        """Return residuals (..., q) at positions (..., d)."""
        phi = np.linalg.norm(x[..., None, :] - self.stations, axis=-1)
        if self.K.shape[1] > len(self.stations):
            phi = np.concatenate([phi, x], axis=-1)
        return phi @ self.K.T - self.w

    def cost(self, x):
        return (self.residual(x) ** 2).sum(-1)

    def derivatives(self, x):
        """Return gradient (..., d) and Hessian (..., d, d) of f/2."""
        line = x[..., None, :] - self.stations
        r = np.linalg.norm(line, axis=-1)[..., None]
        u, eye = line / r, np.eye(self.d)
        slope = u
        if self.K.shape[1] > len(self.stations):
            slope = np.concatenate([u, np.broadcast_to(eye, (*x.shape[:-1], self.d, self.d))], axis=-2)
        force = self.residual(x) @ self.K
        gradient = (np.swapaxes(slope, -1, -2) @ force[..., None])[..., 0]
        J = self.K @ slope
        own = force[..., : len(self.stations), None, None] / r[..., None]
        bend = (own * (eye - u[..., :, None] * u[..., None, :])).sum(-3)
        return gradient, np.swapaxes(J, -1, -2) @ J + bend

    def minimum(self, start):
        """Return the points (..., d) at which damped Newton steps from `start` end."""
        x = np.array(start)
        damping = np.full(x.shape[:-1], 1e-3)
        for _ in range(80):
            gradient, hessian = self.derivatives(x)
            floor = np.linalg.eigvalsh(hessian)[..., 0]
            lift = np.maximum(-2.0 * floor, 0.0) + damping * np.abs(np.trace(hessian, axis1=-2, axis2=-1))
            move = np.linalg.solve(hessian + lift[..., None, None] * np.eye(self.d), -gradient[..., None])[..., 0]
            better = self.cost(x + move) <= self.cost(x)
            x = np.where(better[..., None], x + move, x)
            damping = np.where(better, np.maximum(damping / 10.0, 1e-15), damping * 10.0)
        return x

    def minima(self, rng, starts=40, around=20e3):
        """Return the distinct minima (n, d) found from many starts, the least first."""
        x = self.minimum(self.stations.mean(0) + around * rng.standard_normal((starts, self.d)))
        gradient, hessian = self.derivatives(x)
        with np.errstate(all="ignore"):
            step = np.linalg.norm(np.linalg.solve(hessian, gradient[..., None])[..., 0], axis=-1)
        x = x[(np.linalg.eigvalsh(hessian)[:, 0] > 0.0) & (step < 1e-3)]
        x = x[np.argsort(self.cost(x))]
        kept = []
        for point in x:
            if all(np.linalg.norm(point - other) > 1.0 for other in kept):
                kept.append(point)
        return np.array(kept).reshape(-1, self.d)


def differences(stations, truth, sigma, rng):
    """Return range differences to the first station, of independent arrival times."""
    m = len(stations)
    C = np.hstack([-np.ones((m - 1, 1)), np.eye(m - 1)])
    return combined(stations, C, sigma**2 * C @ C.T, truth, rng)


def combined(stations, C, R, truth, rng, prior=0.0):
    """Return rows C r with covariance R and, with a prior, the coordinates of the truth to within its deviation."""
    L = np.linalg.cholesky(R)
    z = C @ np.linalg.norm(truth - stations, axis=-1) + L @ rng.standard_normal(len(C))
    K, w = np.linalg.solve(L, C), np.linalg.solve(L, z)
    if not prior:
        return Case(stations, K, w)
    d = stations.shape[1]
    mean = truth + prior * rng.standard_normal(d)
    K = np.block([[K, np.zeros((len(K), d))], [np.zeros((d, K.shape[1])), np.eye(d) / prior]])
    return Case(stations, K, np.concatenate([w, mean / prior]))


def random_case(rng, d, m=None, sigma=10.0, outside=False, kind="tdoa", flat=1.0):
    """Return a case in a box of 10 x 10 x 6 km, and its truth."""
    m = d + 3 if m is None else m
    size = np.array([10e3, 10e3, 6e3 * flat])[:d]
    stations = rng.uniform(-0.5, 0.5, (m, d)) * size
    truth = rng.uniform(-0.5, 0.5, d) * size
    if outside:
        way = rng.standard_normal(d)
        truth = way / np.linalg.norm(way) * rng.uniform(10e3, 30e3)
    if kind == "tdoa":
        return differences(stations, truth, sigma, rng), truth
    if kind == "sum":
        C = np.hstack([np.ones((m - 1, 1)), np.eye(m - 1)])
        return combined(stations, C, sigma**2 * np.eye(m - 1), truth, rng), truth
    return combined(stations, np.eye(m), sigma**2 * np.eye(m), truth, rng, prior=5e3 if kind == "prior" else 0.0), truth

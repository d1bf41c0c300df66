"""Averaged range differences with biases, shifted and scaled; their cost with the biases eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Windows:
    """Data of K windows about the stations' mean, in units of the stations' extent.

    Parameters
    ----------
    station : Array, shape (K, S, d)
        Positions, the reference first.
    z : Array, shape (K, S - 1)
        Range differences less the biases' prior means.
    gram : Array, shape (K, S - 1, S - 1)
        Inverse covariance of the rows, in the fine unit.
    design : Array, shape (S - 1, b)
        Biases to rows.
    prior : Array, shape (b,)
        Inverse prior variances of the biases, in the fine unit.
    mean : Array, shape (b,)
        Prior means as given.
    power : Array, shape (K, 1) or (K, 2)
        Powers of time that carry the target's unknowns, time about its middle in half spans.
    unit : float
        The fine unit, of biases and what the geometry leaves over.
    origin, scale, clock
        The shift, the unit of length, and middle and half span of time.
    """

    station: Array
    z: Array
    gram: Array
    design: Array
    prior: Array
    mean: Array
    power: Array
    unit: float
    origin: Array
    scale: float
    clock: tuple[float, float]

    @classmethod
    def of(
        cls,
        station: ArrayLike,
        z: ArrayLike,
        whiten: ArrayLike,
        sigma: ArrayLike,
        design: ArrayLike | None,
        mean: ArrayLike,
        time: ArrayLike | None,
    ) -> Windows:
        """Shift and scale; arguments as in `formulations.registration_sdp.registration`."""
        s, rows, W, spread = (np.asarray(a, dtype=np.float64) for a in (station, z, whiten, sigma))
        if not (np.isfinite(spread) & (spread > 0)).all():
            raise ValueError("every bias needs a prior standard deviation that is positive and finite")
        K, C = rows.shape
        E = np.eye(C) if design is None else np.asarray(design, dtype=np.float64)
        mu = np.broadcast_to(np.asarray(mean, dtype=np.float64), spread.shape)
        gram = np.broadcast_to(np.swapaxes(W, -1, -2) @ W, (K, C, C))
        origin = s.mean(axis=(0, 1))
        scale = float(np.sqrt(((s - origin) ** 2).sum(axis=-1).mean()))
        noise = 1.0 / np.einsum("kii->ki", gram).mean()
        fine = float(np.sqrt(((E * spread) ** 2).sum(axis=1).mean() + noise))
        clock, power = (0.0, 1.0), np.ones((K, 1))
        if time is not None:
            t = np.asarray(time, dtype=np.float64)
            clock = float(t.mean()), float(np.ptp(t)) / 2 or np.nan
            power = np.stack([np.ones(K), (t - clock[0]) / clock[1]], axis=1)
        place, seen, prior = (s - origin) / scale, (rows - E @ mu) / scale, (fine / spread) ** 2
        return cls(place, seen, gram * fine**2, E, prior, mu, power, fine / scale, origin, scale, clock)

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite and the times, where they count, differ."""
        return all(np.isfinite(part).all() for part in (self.station, self.z, self.gram, self.power))

    def form(self) -> Array:
        """Return M of the cost f'Mf of leftovers f (K (S - 1),): the rows' information less what biases explain."""
        K, C, _ = self.gram.shape
        along = (self.gram @ self.design).reshape(K * C, -1)
        blocks = np.zeros((K, C, K, C))
        blocks[np.arange(K), :, np.arange(K)] = self.gram
        return np.asarray(blocks.reshape(K * C, K * C) - along @ np.linalg.solve(self._total(), along.T))

    def cost(self, target: Array) -> tuple[float, Array]:
        """Return the cost at a scaled target (n,), and the shifts (b,) of the biases from their means that fit best."""
        away = np.linalg.norm((self.power @ target.reshape(-1, len(self.origin)))[:, None] - self.station, axis=-1)
        left = (self.z - away[:, 1:] + away[:, :1]) / self.unit
        shift = np.linalg.solve(self._total(), self.design.T @ np.einsum("kij,kj->i", self.gram, left))
        rest = left - self.design @ shift
        return float(np.einsum("ki,kij,kj", rest, self.gram, rest) + self.prior @ shift**2), shift

    def place(self, target: Array) -> Array:
        """Return position at time zero, and velocity of a moving target, (1 or 2, d) as given."""
        found = self.scale * target.reshape(-1, len(self.origin))
        if len(found) == 2:
            found[1] /= self.clock[1]
            found[0] -= self.clock[0] * found[1]
        found[0] += self.origin
        return np.asarray(found)

    def _total(self) -> Array:
        return np.asarray(self.design.T @ self.gram.sum(axis=0) @ self.design + np.diag(self.prior))

"""Networks at random with an emitter each, for tests of the engine; residuals are written in plain NumPy."""

from dataclasses import dataclass

import numpy as np

from optloc import assemble, measured
from optloc.base.types import Array
from optloc.engine.plan import plan_of

SIGMA = 10.0


@dataclass(frozen=True)
class Scene:
    """Networks (N, s, d) at random, an emitter each, and residuals of plain NumPy."""

    place: Array
    truth: Array
    z: Array
    kind: str

    @property
    def problem(self):
        a = np.arange(self.place.shape[1])
        if self.kind == "range":
            return assemble(self.place[:, None], measured("range", self.z, a=a, sigma=SIGMA))
        rows = measured("tdoa", self.z, a=a[1:], b=np.zeros(len(a) - 1, dtype=int), arrival_sigma=SIGMA)
        return assemble(self.place[:, None], rows)

    def residuals(self, i, x):
        """Whitened residuals (..., m) of positions (..., d) of network i."""
        r = np.sqrt(((x[..., None, :] - self.place[i]) ** 2).sum(-1))
        if self.kind == "range":
            return (self.z[i] - r) / SIGMA
        s = len(self.place[i])
        # one arrival is common to all differences
        white = np.linalg.inv(np.linalg.cholesky(np.eye(s - 1) + 1.0)) / SIGMA
        return (self.z[i] - (r[..., 1:] - r[..., :1])) @ white.T

    def cost(self, i, x):
        return (self.residuals(i, x) ** 2).sum(-1)

    def information(self, i, x):
        step = 1e-3 * np.eye(len(x))  # a millimetre: differences of lines that are straight over it
        J = (self.residuals(i, x + step) - self.residuals(i, x - step)).T / 2e-3
        return J.T @ J

    def answer(self):
        plan = plan_of(self.problem)
        return plan.run(plan.load(self.problem), self.z)[0]


def scene(kind, place, truth, seed):
    r = np.sqrt(((place - truth[:, None]) ** 2).sum(-1))
    noisy = r + SIGMA * np.random.default_rng(seed).standard_normal(r.shape)
    return Scene(place, truth, noisy if kind == "range" else noisy[:, 1:] - noisy[:, :1], kind)


def around(kind, d, s, far, count, seed=0):
    """Stations in 10 x 10 (x 10) km, emitters at so many powers of ten metres."""
    rng = np.random.default_rng([seed, d, s])
    direction = rng.standard_normal((count, d))
    direction /= np.sqrt((direction**2).sum(-1, keepdims=True))
    truth = direction * 10.0 ** rng.uniform(*far, (count, 1))
    return scene(kind, rng.uniform(-5e3, 5e3, (count, s, d)), truth, seed)


def flat(kind, s, height, count, seed=0):
    """Receivers in 6 x 6 km whose heights differ little, and an emitter 9 km high."""
    rng = np.random.default_rng([seed, s, height])
    place = np.concatenate([rng.uniform(-3e3, 3e3, (count, s, 2)), height * rng.standard_normal((count, s, 1))], -1)
    truth = np.concatenate([rng.uniform(-3e3, 3e3, (count, 2)), np.full((count, 1), 9e3)], -1)
    return scene(kind, place, truth, seed)

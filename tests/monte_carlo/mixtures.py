"""Mixtures of kinds: their own formulas and derivatives for the reference, and the package's problems beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from zlib import crc32

import numpy as np
import pymap3d
from monte_carlo.layouts import SEED
from monte_carlo.reference import Model

from optloc import Frame, Problem, Stations, assemble, measured

Array = np.ndarray
PLACES = 1e3 * np.array([[0, 0, 0], [10, 0, 6], [0, 10, 3], [10, 10, 0], [5, 5, 6], [2, 7, 1.0]])
RATES = np.array([[90, 20, 0], [-40, 80, 5], [10, -110, 0], [60, 60, -5], [-70, -10, 0], [0, 100, 5.0]])
ORIGIN = (47.0, 11.0, 0.0)
FRAME = Frame.enu(lat_deg=ORIGIN[0], lon_deg=ORIGIN[1])


def _range(x: Array, a: int) -> Array:
    return np.sqrt(((x - PLACES[a]) ** 2).sum(-1))


def _tdoa(a: int, b: int = 0) -> Callable[[Array], Array]:
    return lambda x: _range(x, a) - _range(x, b)


def _groa(a: int, b: int = 0) -> Callable[[Array], Array]:
    return lambda x: _range(x, a) / _range(x, b)


def _azimuth(a: int) -> Callable[[Array], Array]:
    return lambda x: np.arctan2(x[:, 1] - PLACES[a, 1], x[:, 0] - PLACES[a, 0])


def _elevation(a: int) -> Callable[[Array], Array]:
    return lambda x: np.arcsin((x[:, 2] - PLACES[a, 2]) / _range(x, a))


def _fdoa(a: int, b: int = 0) -> Callable[[Array], Array]:
    def rate(x: Array, s: int) -> Array:
        return -((x - PLACES[s]) * RATES[s]).sum(-1) / _range(x, s)

    return lambda x: rate(x, a) - rate(x, b)


def _height(x: Array) -> Array:
    return np.asarray(pymap3d.enu2geodetic(x[:, 0], x[:, 1], x[:, 2], *ORIGIN)[2])


@dataclass(frozen=True)
class Row:
    """One row: its formula, its noise, and how the package is told."""

    formula: Callable[[Array], Array]
    sigma: float
    kind: str
    a: int | None = None
    b: int | None = None


def tdoa(sigma: float, *stations: int) -> list[Row]:
    return [Row(_tdoa(a), sigma, "tdoa", a, 0) for a in stations]


def angles(sigma: float, *stations: int) -> list[Row]:
    azimuth = [Row(_azimuth(a), sigma, "azimuth", a) for a in stations]
    return azimuth + [Row(_elevation(a), sigma, "elevation", a) for a in stations]


MIXTURES: dict[str, list[Row]] = {
    "TDOA + AOA": [*tdoa(10.0, 1, 2, 3), *angles(0.01, 0)],
    "TDOA + GROA": [*tdoa(10.0, 1, 2, 3), *(Row(_groa(a), 0.01, "groa", a, 0) for a in (1, 2, 3))],
    "AOA + range": [*angles(0.01, 0, 1), Row(lambda x: _range(x, 2), 10.0, "range", 2)],
    "TDOA + height": [*tdoa(10.0, 1, 2, 3), Row(_height, 30.0, "height")],
    "FDOA + TDOA": [*tdoa(10.0, 1, 2, 3), *(Row(_fdoa(a), 0.2, "fdoa", a, 0) for a in (1, 2, 3))],
    "AOA 2 stations, 5 mrad": angles(0.005, 0, 1),
    "AOA 2 stations, 20 mrad": angles(0.02, 0, 1),
    "AOA 2 stations, 50 mrad": angles(0.05, 0, 1),
    "AOA 4 stations, 50 mrad": angles(0.05, 0, 1, 2, 3),
}


@dataclass(frozen=True)
class Mixed(Model):
    """The reference's model of a mixture; derivatives are central differences."""

    formulas: tuple[Callable[[Array], Array], ...] = ()
    wrapped: Array | None = None

    def rows(self, x: Array, item: Array) -> tuple[Array, Array]:
        def h(points: Array) -> Array:
            return np.stack([formula(points) for formula in self.formulas], axis=-1)

        size = 1e-6 * (1.0 + np.abs(x).max(-1, keepdims=True))
        slopes = [(h(x + size * e) - h(x - size * e)) / (2.0 * size) for e in np.eye(x.shape[-1])]
        return h(x), np.stack(slopes, axis=-1)

    def residual(self, x: Array, z: Array, item: Array) -> tuple[Array, Array]:
        rows, jacobian = self.rows(x, item)
        apart = z[item] - rows
        apart = np.where(self.wrapped, (apart + np.pi) % (2.0 * np.pi) - np.pi, apart)
        return apart @ self.white.T, self.white @ jacobian


def drawn(name: str, count: int) -> tuple[Mixed, Array, Array, Problem, np.random.SeedSequence]:
    """Return model, truth, measurements, problem and the seed of the search of a mixture."""
    rows = MIXTURES[name]
    draw, search = np.random.SeedSequence([SEED, crc32(name.encode())]).spawn(2)
    rng = np.random.default_rng(draw)
    truth = np.stack([rng.uniform(-20e3, 30e3, count), rng.uniform(-20e3, 30e3, count), rng.uniform(0, 6e3, count)], -1)
    sigma = np.array([row.sigma for row in rows])
    wrapped = np.array([row.kind in ("azimuth", "elevation") for row in rows])
    places = np.broadcast_to(PLACES, (count, *PLACES.shape))
    model = Mixed(places, None, np.diag(1.0 / sigma), tuple(row.formula for row in rows), wrapped)
    z = model.exact(truth) + sigma * rng.standard_normal((count, len(rows)))
    return model, truth, z, _problem(rows, z), search


def _problem(rows: list[Row], z: Array) -> Problem:
    parts = []
    for kind in dict.fromkeys(row.kind for row in rows):
        own = [i for i, row in enumerate(rows) if row.kind == kind]
        a, b = ([getattr(rows[i], name) for i in own] for name in "ab")
        ends = {name: v for name, v in (("a", a), ("b", b)) if v[0] is not None}
        parts.append(measured(kind, z[:, own], sigma=[rows[i].sigma for i in own], **ends))
    stations = Stations(PLACES[None], tuple("ABCDEF"), velocity=RATES[None])
    return assemble(stations, *parts, frame=FRAME)

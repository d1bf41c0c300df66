"""Random scenes of all kinds, and their costs written down plainly: nothing of the package but its input is used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc import Problem, assemble, constraints, measured

Array = np.ndarray

# What is drawn: kinds in the plane and in space, and mixtures of them.
KINDS = {
    2: ("tdoa", "range", "toa", "groa", "range_sum", "azimuth", "tdoa+azimuth", "range+azimuth", "tdoa+groa"),
    3: ("tdoa", "range", "toa", "groa", "range_sum", "angles", "tdoa+angles", "range+tdoa", "tdoa+azimuth"),
}
ANGLES = ("azimuth", "elevation")


@dataclass(frozen=True)
class Scene:
    """One problem with its truth, and all that a plain cost needs.

    Parameters
    ----------
    name : str
        What was drawn, in words.
    problem : Problem
        As the package takes it.
    truth : array (d,)
        Metres.
    stations : array (s, d)
        Metres.
    rows : tuple of (kind, a, b)
        One for each measurement.
    z : array (m,)
        Measured.
    root : array (m, m)
        Whitens residuals: ``root @ covariance @ root.T`` is the identity.
    level : float, optional
        Known last coordinate.
    corners : array (2, d), optional
        Region.
    """

    name: str
    problem: Problem
    truth: Array
    stations: Array
    rows: tuple[tuple[str, int, int], ...]
    z: Array
    root: Array
    level: float | None = None
    corners: Array | None = None

    @property
    def centre(self) -> Array:
        return self.stations.mean(0)

    @property
    def size(self) -> float:
        return float(np.abs(self.stations - self.centre).max())

    @property
    def late(self) -> Array:
        """Which rows have an emission time, (m,)."""
        return np.array([kind == "toa" for kind, _, _ in self.rows])

    def residual(self, x: Array) -> Array:
        """Return whitened residuals (m,) at a position (d,), the emission time where it fits best."""
        miss = self.z - model(self.rows, self.stations, x)
        angular = np.array([kind in ANGLES for kind, _, _ in self.rows])
        miss[angular] = np.arctan2(np.sin(miss[angular]), np.cos(miss[angular]))
        return self._without_time(self.root @ miss)

    def slope(self, x: Array) -> Array:
        """Return the derivatives (m, d) of the whitened residuals."""
        return self._without_time(-self.root @ derivatives(self.rows, self.stations, x))

    def _without_time(self, white: Array) -> Array:
        """Return whitened rows (m, ...) less what the emission time explains."""
        if not self.late.any():
            return white
        own = self.root @ self.late.astype(float)
        return white - np.multiply.outer(own, own @ white) / (own @ own)

    def cost(self, x: Array) -> float:
        return float((self.residual(x) ** 2).sum())


def model(rows: tuple[tuple[str, int, int], ...], stations: Array, x: Array) -> Array:
    """Return what the rows measure of a position, without noise: the textbook formulas, row by row."""
    out = []
    for kind, a, b in rows:
        there = x - stations[a]
        r_a = np.sqrt((there**2).sum())
        r_b = np.sqrt(((x - stations[b]) ** 2).sum()) if b >= 0 else np.nan
        value = {
            "tdoa": r_a - r_b,
            "range": r_a,
            "toa": r_a,
            "groa": r_a / r_b if b >= 0 else np.nan,
            "range_sum": r_a + r_b,
            "azimuth": np.arctan2(there[1], there[0]),
            "elevation": np.arctan2(there[-1], np.hypot(there[0], there[1])),
        }[kind]
        out.append(value)
    return np.array(out)


def derivatives(rows: tuple[tuple[str, int, int], ...], stations: Array, x: Array) -> Array:
    """Return the derivatives (m, d) of what the rows measure by the position, row by row."""
    away = x - stations
    reach = np.sqrt((away**2).sum(1))
    line, out = away / reach[:, None], np.zeros((len(rows), len(x)))
    for i, (kind, a, b) in enumerate(rows):
        if kind == "azimuth":
            out[i, :2] = np.array([-away[a, 1], away[a, 0]]) / (away[a, :2] @ away[a, :2])
        elif kind == "elevation":
            level = np.hypot(away[a, 0], away[a, 1])
            out[i] = np.array([*(-away[a, 2] * away[a, :2] / level), level]) / reach[a] ** 2
        elif kind == "groa":
            out[i] = (line[a] - reach[a] / reach[b] * line[b]) / reach[b]
        else:
            out[i] = line[a] + {"tdoa": -1.0, "range_sum": 1.0}.get(kind, 0.0) * line[b]
    return out


def draw(rng: np.random.Generator) -> Scene:
    """Return a random scene: kind, scale, place, geometry, noise and constraints are all drawn."""
    d = int(rng.integers(2, 4))
    kind = str(rng.choice(KINDS[d]))
    size = 10.0 ** rng.uniform(-3.0, 9.0)
    # so far from the origin that coordinates keep six digits more than the noise needs
    offset = rng.standard_normal(d) * min(4e8, 1e5 * size) * rng.choice([0.0, 1.0])
    count = int(rng.integers(d + 1, d + 6))
    stations, shape = _stations(rng, count, d)
    truth = _truth(rng, d)
    share = 10.0 ** rng.uniform(-5.0, -1.5)
    coarse = 10.0 ** rng.uniform(-4.0, -0.3)
    rows = _rows(kind, count)
    stations, truth = stations * size + offset, truth * size + offset
    sigma = np.array([coarse if k in ANGLES else share if k == "groa" else share * size for k, _, _ in rows])
    covariance, dense = _covariance(rng, sigma, rows)
    factor = np.linalg.cholesky(covariance / sigma[:, None] / sigma)
    z = model(rows, stations, truth) + sigma * (factor @ rng.standard_normal(len(rows)))
    late = np.array([k == "toa" for k, _, _ in rows])
    z[late] += size * rng.uniform(-10.0, 10.0)
    root = np.linalg.inv(factor) / sigma
    level, corners, held = _constraint(rng, kind, truth, size)
    problem = _problem(rows, stations, z, covariance, level, corners)
    words = f"{kind} {d}-D, {count} stations {shape}, size {size:.1g} m, noise {share:.1g}, angles {coarse:.1g}"
    return Scene(words + dense + held, problem, truth, stations, rows, z, root, level, corners)


def _stations(rng: np.random.Generator, count: int, d: int) -> tuple[Array, str]:
    """Return places of size one: anywhere, nearly in one plane, or nearly on one line."""
    place = rng.uniform(-1.0, 1.0, (count, d))
    shape = str(rng.choice(["anywhere", "flat", "line"], p=[0.5, 0.35, 0.15]))
    thin = 10.0 ** rng.uniform(-4.0, -0.5)
    if shape == "flat":
        place[:, -1] = thin * rng.standard_normal(count)
    if shape == "line":
        place[:, 1:] = thin * rng.standard_normal((count, d - 1))
    turn, _ = np.linalg.qr(rng.standard_normal((d, d)))
    return place @ turn.T, f"{shape} {thin:.1g}" if shape != "anywhere" else shape


def _truth(rng: np.random.Generator, d: int) -> Array:
    """Return a place among stations of size one, or up to a hundred times farther off."""
    if rng.random() < 0.5:
        return rng.uniform(-1.0, 1.0, d)
    ahead = rng.standard_normal(d)
    return ahead / np.linalg.norm(ahead) * 10.0 ** rng.uniform(-0.5, 2.0)


def _rows(kind: str, count: int) -> tuple[tuple[str, int, int], ...]:
    """Return the rows of a kind or of a mixture; the stations take turns."""
    rows: list[tuple[str, int, int]] = []
    parts = kind.split("+")
    for i, part in enumerate(parts):
        own = range(count) if i == 0 else range(min(2, count))  # of the second kind two stations
        if part in ("tdoa", "groa", "range_sum"):
            rows += [(part, a, 0) for a in range(1, count)]
        elif part == "angles":
            rows += [(name, a, -1) for name in ANGLES for a in own]
        else:
            rows += [(part, a, -1) for a in own]
    return tuple(rows)


def _covariance(rng: np.random.Generator, sigma: Array, rows: tuple[tuple[str, int, int], ...]) -> tuple[Array, str]:
    """Return independent noise, or noise that rows of a kind share in part."""
    if rng.random() < 0.6:
        return np.diag(sigma**2), ""
    kinds = np.array([kind for kind, _, _ in rows])
    tied = (kinds[:, None] == kinds) * rng.uniform(0.1, 0.8)
    np.fill_diagonal(tied, 1.0)
    return sigma[:, None] * tied * sigma, ", dense"


def _constraint(
    rng: np.random.Generator, kind: str, truth: Array, size: float
) -> tuple[float | None, Array | None, str]:
    """Return a known last coordinate, or a region, or neither."""
    chance = rng.random()
    if chance < 0.08 and len(truth) == 3 and "+" not in kind:
        return float(truth[-1]), None, ", level known"
    if chance > 0.92:
        half = size * 10.0 ** rng.uniform(0.0, 1.5)
        middle = truth + rng.uniform(-0.5, 0.5, len(truth)) * half
        return None, np.stack([middle - half, middle + half]), ", region"
    return None, None, ""


def _problem(
    rows: tuple[tuple[str, int, int], ...],
    stations: Array,
    z: Array,
    covariance: Array,
    level: float | None,
    corners: Array | None,
) -> Problem:
    """Return the scene as the package takes it."""
    parts, kinds = [], list(dict.fromkeys(kind for kind, _, _ in rows))
    for kind in kinds:
        own = np.array([i for i, row in enumerate(rows) if row[0] == kind])
        ends = {"a": [rows[i][1] for i in own]}
        if rows[own[0]][2] >= 0:
            ends["b"] = [rows[i][2] for i in own]
        parts.append(measured(kind, z[own], covariance=covariance[np.ix_(own, own)], **ends))
    bounds: tuple = ()
    if level is not None:
        bounds = constraints.box([-np.inf, -np.inf, level], [np.inf, np.inf, level])
    elif corners is not None:
        bounds = constraints.box(*corners)
    return assemble(stations, *parts, constraints=bounds)

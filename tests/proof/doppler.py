"""Scenes of Doppler rows and mixtures, and their minima by SciPy: formulas, derivatives and projections of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from zlib import crc32

import numpy as np
from descent import EXACT, levenberg
from proof.layouts import SEED
from scipy.ndimage import minimum_filter
from scipy.optimize import least_squares

from optloc import Frame, Problem, Stations, assemble, measured, with_bias
from optloc.linear.constraints import height
from optloc.problem import ECEF

Array = np.ndarray
Rng = np.random.Generator
C = 299_792_458.0
# WGS 84, and the satellite that is simulated: at the height of Iridium, on a circle.
AXIS, SQUARED = 6378137.0, 6.694379990141317e-3
ORBIT, PULL, TURN = AXIS + 780e3, 3.986004418e14, 7.2921159e-5
# Metres per second for a hertz of Iridium.
HERTZ = C / 1626.27e6
SIGNS = {"tdoa": -1.0, "fdoa": -1.0}
UNITS = {"azimuth": np.pi, "elevation": np.pi}


@dataclass(frozen=True)
class Part:
    """Rows of one kind: stations, epochs, sigma of each row or of what each station measures by itself."""

    kind: str
    a: Sequence[int]
    sigma: float
    b: Sequence[int] | None = None
    epoch: Sequence[int] | None = None
    by_arrival: bool = False

    @property
    def ends(self) -> tuple[Array, Array, Array]:
        """Return both stations of each row, -1 where there is none, and the epochs."""
        a = np.asarray(self.a)
        b = np.full(len(a), -1) if self.b is None else np.asarray(self.b)
        return a, b, np.zeros(len(a), dtype=int) if self.epoch is None else np.asarray(self.epoch)

    @property
    def covariance(self) -> Array:
        """Return the covariance (m, m) of the rows: those that share a station at an epoch are tied."""
        if not self.by_arrival:
            return self.sigma**2 * np.eye(len(self.a))
        a, b, epoch = self.ends
        same = epoch[:, None] == epoch
        tie = (a[:, None] == a) * 1.0 + (b[:, None] == b) - (a[:, None] == b) - (b[:, None] == a)
        return self.sigma**2 * tie * same

    def told(self, z: Array):
        """Return the rows as the package takes them."""
        a, b, epoch = self.ends
        noise = {"arrival_sigma" if self.by_arrival else "sigma": self.sigma}
        return measured(self.kind, z, a=a, b=None if self.b is None else b, epoch=epoch, **noise)


@dataclass(frozen=True)
class Scenes:
    """N trials of one structure: what the package is given, and what it is made of."""

    parts: Sequence[Part]
    place: Array  # (N, k, s, d)
    velocity: Array
    truth: Array  # (N, d)
    z: Array  # (N, m)
    offset: bool = False
    # Stations whose clocks are off by an unknown offset, and, with times, by a drift.
    clocks: Sequence[int] = ()
    times: Array | None = None
    height: float | None = None
    frame: Frame = field(default_factory=lambda: Frame("cartesian"))

    @cached_property
    def problem(self) -> Problem:
        ends = np.cumsum([len(part.a) for part in self.parts])[:-1]
        told = [part.told(z) for part, z in zip(self.parts, np.split(self.z, ends, axis=1), strict=True)]
        names = tuple("ABCDEFGHI"[: self.place.shape[2]])
        limits = () if self.height is None else height(exactly=self.height)
        stations = Stations(self.place, names, velocity=self.velocity)
        made = assemble(stations, *told, frame=self.frame, constraints=limits, times=self.times)
        late = [names[s] for s in self.clocks]
        if late:
            made = with_bias(made, "clock", members=late)
        if late and self.times is not None:
            made = with_bias(made, "drift", form="drift", members=late)
        return with_bias(made, "frequency", per="kind") if self.offset else made


class Trial:
    """The whitened residuals of one trial, the best offset taken off, and descents to its minima."""

    def __init__(self, scenes: Scenes, item: int) -> None:
        self.scenes, self.d = scenes, scenes.truth.shape[1]
        ends = [part.ends for part in scenes.parts]
        a, b, epoch = (np.concatenate([end[k] for end in ends]) for k in range(3))
        self.kind = np.concatenate([[part.kind] * len(part.a) for part in scenes.parts])
        self.sign = np.array([SIGNS.get(kind, 0.0) for kind in self.kind])
        place, speed = scenes.place[item], scenes.velocity[item]
        self.a, self.v = place[epoch, a], speed[epoch, a]
        self.b, self.w = place[epoch, b], speed[epoch, b]
        self.z, self.truth = scenes.z[item], scenes.truth[item]
        self.white = np.linalg.inv(np.linalg.cholesky(_blocks([part.covariance for part in scenes.parts])))
        late = [(a == s) * 1.0 - (b == s) for s in scenes.clocks]
        if scenes.times is not None:
            late += [column * scenes.times[epoch] for column in late]
        late += [np.ones(len(a))] * scenes.offset
        if late:
            q, _ = np.linalg.qr(self.white @ np.stack(late, axis=1))
            self.white = self.white - q @ (q.T @ self.white)
        self.middle = place.reshape(-1, self.d).mean(0)
        self.size = np.linalg.norm(place - self.middle, axis=-1).max()

    def is_of(self, *kinds: str) -> Array:
        return np.isin(self.kind, kinds)

    def values(self, x: Array) -> Array:
        """Return what the rows say at places (..., d)."""
        p, q = x[..., None, :] - self.a, x[..., None, :] - self.b
        r, s = np.sqrt((p**2).sum(-1)), np.sqrt((q**2).sum(-1))
        out, sign = r + self.sign * s, self.sign
        for chosen in filter(np.any, [self.is_of("range_rate", "fdoa")]):
            ours, others = -(p * self.v).sum(-1) / r, -(q * self.w).sum(-1) / s
            out = np.where(chosen, ours + np.where(sign == 0.0, 0.0, sign * others), out)
        out = np.where(self.is_of("groa"), r / s, out)
        out = np.where(self.is_of("azimuth"), np.arctan2(p[..., 1], p[..., 0]), out)
        return np.where(self.is_of("elevation"), np.arcsin(p[..., -1] / r), out)

    def residual(self, x: Array) -> Array:
        apart = self.values(x) - self.z
        angle = self.is_of("azimuth", "elevation")
        return np.where(angle, (apart + np.pi) % (2.0 * np.pi) - np.pi, apart) @ self.white.T

    def cost(self, x: Array) -> Array:
        with np.errstate(all="ignore"):
            return (self.residual(x) ** 2).sum(-1)

    def slope(self, x: Array) -> Array:
        """Return the derivatives (m, d) of the whitened residuals at a place."""
        p, q = x - self.a, x - self.b
        r, s = np.sqrt((p**2).sum(-1, keepdims=True)), np.sqrt((q**2).sum(-1, keepdims=True))
        u, w, sign = p / r, q / s, self.sign[:, None]
        out = u + sign * w
        ours = -(self.v - (u * self.v).sum(-1, keepdims=True) * u) / r
        others = -(self.w - (w * self.w).sum(-1, keepdims=True) * w) / s
        out = np.where(self.is_of("range_rate", "fdoa")[:, None], ours + np.where(sign == 0.0, 0.0, sign * others), out)
        out = np.where(self.is_of("groa")[:, None], u / s - r / s**2 * w, out)
        level = (p[:, :2] ** 2).sum(-1, keepdims=True)
        turned = np.zeros_like(p)
        turned[:, 0], turned[:, 1] = -p[:, 1], p[:, 0]
        out = np.where(self.is_of("azimuth")[:, None], turned / level, out)
        if self.d == 3:
            up = np.array([0.0, 0.0, 1.0])
            out = np.where(self.is_of("elevation")[:, None], (up - u * u[:, 2:]) / np.sqrt(level), out)
        return self.white @ out

    # Places are searched in metres around the stations over their size, or in latitude and longitude.

    @property
    def known_height(self) -> bool:
        return self.scenes.height is not None

    def to_place(self, y: Array) -> Array:
        if not self.known_height:
            return self.middle + self.size * y
        lat, lon, level = y[..., 0], y[..., 1], self.scenes.height
        across = AXIS / np.sqrt(1.0 - SQUARED * np.sin(lat) ** 2)
        flat = (across + level) * np.cos(lat)
        up = (across * (1.0 - SQUARED) + level) * np.sin(lat)
        return np.stack([flat * np.cos(lon), flat * np.sin(lon), up], axis=-1)

    def stretch(self, y: Array) -> Array:
        """Return the derivative (d, n) of a place."""
        if not self.known_height:
            return self.size * np.eye(self.d)
        (lat, lon), level = y, self.scenes.height
        root = 1.0 - SQUARED * np.sin(lat) ** 2
        north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
        east = np.array([-np.sin(lon), np.cos(lon), 0.0])
        return np.stack(
            [north * (AXIS * (1 - SQUARED) / root**1.5 + level), east * (AXIS / root**0.5 + level) * np.cos(lat)], -1
        )

    def grid(self) -> list[Array]:
        """Return the best places of a grid that reaches far: those that are cheaper than all around them."""
        if self.known_height:
            axes = [np.radians(np.arange(-89.0, 90.0, 2.0)), np.radians(np.arange(-180.0, 180.0, 2.0))]
        else:  # to thirty sizes, and as close as an eighth of one
            axes = [np.sinh(np.linspace(-4.1, 4.1, 61 if self.d == 2 else 23))] * self.d
        y = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        cost = np.nan_to_num(self.cost(self.to_place(y)), nan=np.inf)
        low = np.flatnonzero((minimum_filter(cost, size=3) == cost).ravel())
        return list(y.reshape(-1, y.shape[-1])[low[np.argsort(cost.ravel()[low])[:12]]])

    def anywhere(self, rng: Rng, count: int) -> list[Array]:
        """Return random places at all distances and bearings."""
        if self.known_height:
            lat, lon = np.arcsin(rng.uniform(-1.0, 1.0, count)), rng.uniform(-np.pi, np.pi, count)
            return list(np.stack([lat, lon], axis=-1))
        way = rng.standard_normal((count, self.d))
        return list(way / np.linalg.norm(way, axis=-1, keepdims=True) * 10.0 ** rng.uniform(-1.5, 2.0, (count, 1)))

    def at_truth(self) -> Array:
        if not self.known_height:
            return (self.truth - self.middle) / self.size
        return np.array(ECEF.to_geodetic(self.truth)[:2])

    def descended(self, start: Array) -> tuple[Array, float, float]:
        """Return the minimum next to a start, its cost and how many sigma a step along its slope would still change."""
        with np.errstate(all="ignore"):
            steps = (
                lambda y: np.nan_to_num(self.residual(self.to_place(y)), nan=1e9),
                start,
                lambda y: np.nan_to_num(self.slope(self.to_place(y)) @ self.stretch(y)),
            )
            done = levenberg(*steps) if len(self.z) >= len(start) else least_squares(*steps, **EXACT)
            x = self.to_place(done.x)
            if not (np.isfinite(done.jac).all() and np.isfinite(self.cost(x))):
                return x, np.inf, np.inf
            step = np.linalg.lstsq(done.jac, done.fun, rcond=None)[0]
        return x, float(2.0 * done.cost), float(np.linalg.norm(done.jac @ step))

    def minima(self, rng: Rng, count: int) -> list[tuple[Array, float, float]]:
        """Return where descents end: from the truth, from the best places of a grid and from so many random ones."""
        return [self.descended(start) for start in (self.at_truth(), *self.grid(), *self.anywhere(rng, count))]


def _blocks(parts: Sequence[Array]) -> Array:
    out, at = np.zeros((sum(map(len, parts)),) * 2), 0
    for part in parts:
        out[at : at + len(part), at : at + len(part)] = part
        at += len(part)
    return out


def drawn(parts: Sequence[Part], place: Array, velocity: Array, truth: Array, rng: Rng, **more) -> Scenes:
    """Return trials with measurements of their own noise; with an unknown offset, one of some 100 m/s."""
    blank = Scenes(parts, place, velocity, truth, np.zeros((len(truth), sum(len(p.a) for p in parts))), **more)
    exact = np.stack([Trial(blank, i).values(x) for i, x in enumerate(truth)])
    noise = rng.standard_normal(exact.shape) @ np.linalg.cholesky(_blocks([p.covariance for p in parts])).T
    late = rng.uniform(-300.0, 300.0, (len(truth), 1)) if blank.offset else 0.0
    return Scenes(parts, place, velocity, truth, exact + noise + late, **more)


# Families. Velocities are those of aircraft, accuracies those of the tables of the literature.


def moving(rng: Rng, n: int, s: int, d: int = 2, reach: float = 20e3) -> tuple[Array, Array]:
    """Return places (n, 1, s, d) of stations in a box, and their velocities of about 150 m/s."""
    flat = np.array([1.0, 1.0, 0.3])[:d]
    return rng.uniform(-reach, reach, (n, 1, s, d)) * flat, rng.normal(0.0, 100.0, (n, 1, s, d)) * flat


def four_receivers(rng: Rng, n: int) -> Scenes:
    """Frequency differences of four moving receivers in the plane, 0.3 Hz each at 1 GHz."""
    fdoa = Part("fdoa", [1, 2, 3], 0.3 * C / 1e9, [0, 0, 0], by_arrival=True)
    return drawn([fdoa], *moving(rng, n, 4), rng.uniform(-40e3, 40e3, (n, 2)), rng)


def pair(rng: Rng, n: int, offset: bool) -> Scenes:
    """Ten epochs, ten seconds apart, of two aircraft on straight courses."""
    place, velocity = moving(rng, n, 2)
    place = place + velocity * 10.0 * np.arange(10)[:, None, None]
    fdoa = Part("fdoa", [1] * 10, 0.3 * C / 1e9, [0] * 10, range(10), by_arrival=True)
    truth = rng.uniform(-40e3, 40e3, (n, 2))
    return drawn([fdoa], place, np.broadcast_to(velocity, place.shape), truth, rng, offset=offset)


def hybrid(rng: Rng, n: int, bearing: float) -> Scenes:
    """A bearing, a time difference to 100 ns and a frequency difference to 3 Hz at 1 GHz in the plane."""
    parts = [
        Part("azimuth", [0], bearing),
        Part("tdoa", [1], 100e-9 * C, [2]),
        Part("fdoa", [1], 3.0 * C / 1e9, [2]),
    ]
    return drawn(parts, *moving(rng, n, 3), rng.uniform(-40e3, 40e3, (n, 2)), rng)


def orbits(rng: Rng, site: Array, seconds: Array, least: float) -> tuple[Array, Array]:
    """Return places and velocities (k, 3) over the turning Earth of a satellite that stays above an elevation, rad."""
    up, rate = site / np.linalg.norm(site), np.sqrt(PULL / ORBIT**3)
    while True:
        aside = rng.normal(size=3)
        aside -= aside @ up * up
        off = rng.uniform(0.02, 0.3)  # of the track from the site, radians
        first = np.cos(off) * up + np.sin(off) * aside / np.linalg.norm(aside)
        then = np.cross(first, rng.normal(size=3))
        then /= np.linalg.norm(then)
        phase = ((seconds - seconds.mean()) * rate + rng.uniform(-0.1, 0.1))[:, None]
        place = ORBIT * (np.cos(phase) * first + np.sin(phase) * then)
        velocity = ORBIT * rate * (-np.sin(phase) * first + np.cos(phase) * then)
        cosine, sine = np.cos(TURN * seconds), np.sin(TURN * seconds)
        back = np.zeros((len(seconds), 3, 3))
        back[:, 0, 0], back[:, 0, 1], back[:, 1, 0], back[:, 1, 1], back[:, 2, 2] = cosine, sine, -sine, cosine, 1.0
        place, velocity = np.einsum("kij,kj->ki", back, place), np.einsum("kij,kj->ki", back, velocity)
        velocity = velocity - np.cross([0.0, 0.0, TURN], place)
        line = place - site
        if (line @ up > np.sin(least) * np.linalg.norm(line, axis=-1)).all():
            return place, velocity


def sites(rng: Rng, n: int, level: float) -> Array:
    lat, lon = np.radians(rng.uniform(-60.0, 60.0, n)), rng.uniform(-np.pi, np.pi, n)
    return ECEF.from_geodetic(lat, lon, np.full(n, level))


def passes(rng: Rng, n: int) -> Scenes:
    """One satellite over 60 to 240 s, heard 13 times to 1 Hz; height known, frequency not."""
    level = float(rng.uniform(0.0, 2000.0))
    truth = sites(rng, n, level)
    tracks = [orbits(rng, x, np.linspace(0.0, rng.uniform(60.0, 240.0), 13), np.radians(8.0)) for x in truth]
    place, velocity = (np.stack([track[k] for track in tracks])[:, :, None] for k in (0, 1))
    rate = Part("range_rate", [0] * 13, HERTZ, epoch=range(13))
    return drawn([rate], place, velocity, truth, rng, offset=True, height=level, frame=ECEF)


def constellation(rng: Rng, n: int, rows: int = 400, count: int = 9) -> Scenes:
    """Passes of several satellites one after the other over ten minutes, to 1 Hz; height known, frequency not."""
    level, seconds = float(rng.uniform(0.0, 2000.0)), np.linspace(0.0, 600.0, rows)
    truth, heard = sites(rng, n, level), np.arange(rows) * count // rows
    place, velocity = np.zeros((2, n, rows, count, 3))
    for i, x in enumerate(truth):
        for s in range(count):
            own = heard == s
            track = orbits(rng, x, seconds[own], np.radians(8.0))
            for array, values in zip((place, velocity), track, strict=True):
                array[i, :, s] = values[0]  # wherever it is while it is not heard
                array[i, own, s] = values
    rate = Part("range_rate", heard, HERTZ, epoch=range(rows))
    return drawn([rate], place, velocity, truth, rng, offset=True, height=level, frame=ECEF)


def satellites(rng: Rng, n: int) -> Scenes:
    """Time and frequency differences of three low satellites to an emitter on the ground: 100 ns and 1 Hz at 8 GHz."""
    truth = sites(rng, n, 0.0)
    tracks = [[orbits(rng, x, np.zeros(1), np.radians(10.0)) for _ in range(3)] for x in truth]
    place, velocity = (np.array([[sat[k][0] for sat in scene] for scene in tracks])[:, None] for k in (0, 1))
    parts = [
        Part("tdoa", [1, 2], 100e-9 * C, [0, 0], by_arrival=True),
        Part("fdoa", [1, 2], C / 8e9, [0, 0], by_arrival=True),
    ]
    return drawn(parts, place, velocity, truth, rng, height=0.0, frame=ECEF)


def registration(rng: Rng, n: int, d: int, epochs: int, drift: bool, span: float = 600.0) -> Scenes:
    """Time differences of four to six aircraft with clocks of their own, to an emitter near or far: ten minutes."""
    s, times = int(rng.integers(4, 7)), np.linspace(0.0, span, epochs)
    place, velocity = moving(rng, n, s, d)
    place = place + velocity * times[:, None, None]
    a = np.tile(np.arange(1, s), epochs)
    epoch = np.repeat(np.arange(epochs), s - 1)
    tdoa = Part("tdoa", a, 3.0, np.zeros(len(a), dtype=int), epoch, by_arrival=True)
    way = rng.standard_normal((n, d)) * np.array([1.0, 1.0, 0.1])[:d]
    truth = way / np.linalg.norm(way, axis=-1, keepdims=True) * 10.0 ** rng.uniform(4.0, 5.5, (n, 1))
    more = {"clocks": range(1, s), "times": times if drift else None}
    return drawn([tdoa], place, np.broadcast_to(velocity, place.shape), truth, rng, **more)


# Accuracies that mixtures are drawn from: sharp, and so coarse that minima lie all over the place.
SIGMAS = {
    "range": (3.0, 100.0),
    "tdoa": (3.0, 100.0),
    "range_rate": (0.1, 3.0),
    "fdoa": (0.1, 3.0),
    "azimuth": (5e-3, 0.1, 0.5),
    "elevation": (5e-3, 0.1),
    "groa": (2e-3, 0.05),
}


def mixture(rng: Rng, n: int, d: int) -> Scenes:
    """Rows of two to four kinds, one of them of Doppler, at moving stations: one or two more than unknowns or so."""
    others = [kind for kind in SIGMAS if kind not in ("range_rate", "fdoa") and (d == 3 or kind != "elevation")]
    kinds = [str(rng.choice(["range_rate", "fdoa"])), *rng.choice(others, size=int(rng.integers(1, 4)), replace=False)]
    s = int(rng.integers(2, 6))
    counts = np.ones(len(kinds), dtype=int)
    while counts.sum() < d + int(rng.integers(1, 4)):
        counts[rng.integers(len(kinds))] += 1
    parts = []
    for kind, count in zip(kinds, counts, strict=True):
        two = kind in ("tdoa", "fdoa", "groa")
        most = s - 1 if two else s
        epoch, a = np.divmod(np.arange(count), most)  # what stations are too few for is heard at later epochs
        sigma, by_arrival = float(rng.choice(SIGMAS[kind])), two and kind != "groa" and bool(rng.integers(2))
        parts.append(Part(kind, a + two, sigma, np.zeros(count, dtype=int) if two else None, epoch, by_arrival))
    place, velocity = moving(rng, n, s, d)
    place = place + velocity * 20.0 * np.arange(1 + max(part.ends[2].max() for part in parts))[:, None, None]
    way = rng.standard_normal((n, d))
    truth = way / np.linalg.norm(way, axis=-1, keepdims=True) * 10.0 ** rng.uniform(3.5, 4.8, (n, 1))
    return drawn(parts, place, np.broadcast_to(velocity, place.shape), truth, rng)


FAMILIES: dict[str, Callable[[Rng, int], Scenes]] = {
    "four receivers in the plane": four_receivers,
    "moving pair, known offset": lambda rng, n: pair(rng, n, offset=False),
    "moving pair, unknown offset": lambda rng, n: pair(rng, n, offset=True),
    "bearing of 0.6 rad + TDOA + FDOA": lambda rng, n: hybrid(rng, n, 0.6),
    "bearing of 0.2 rad + TDOA + FDOA": lambda rng, n: hybrid(rng, n, 0.2),
    "bearing of 0.06 rad + TDOA + FDOA": lambda rng, n: hybrid(rng, n, 0.06),
    "three satellites, TDOA + FDOA": satellites,
    "one pass of a satellite": passes,
    "passes of nine satellites": constellation,
    "registration of 20 epochs in the plane": lambda rng, n: registration(rng, n, 2, 20, drift=False),
    "registration of 40 epochs in space": lambda rng, n: registration(rng, n, 3, 40, drift=False),
    "registration of 100 epochs in space": lambda rng, n: registration(rng, n, 3, 100, drift=False),
    "registration of 60 epochs with drifts": lambda rng, n: registration(rng, n, 3, 60, drift=True),
    "mixtures in the plane": lambda rng, n: mixture(rng, n, 2),
    "mixtures in space": lambda rng, n: mixture(rng, n, 3),
}


def scenes_of(name: str, n: int, seed: int, more: int = 0) -> Scenes:
    """Return trials of a family; `seed` and `more` ask for other ones, and for mixtures of other kinds."""
    return FAMILIES[name](np.random.default_rng([SEED + seed, crc32(name.encode()), more]), n)

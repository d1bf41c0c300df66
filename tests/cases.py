"""Tables of small problems with known truth: one for every kind and dimension of MODELS, and mixtures.

Everything here that predicts measurements is written a second time, plainly, so that the package is not its own judge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import factorial

import numpy as np
import pymap3d

from optloc import Frame, Motion, Problem, Stations, assemble, measured, simulate, station_array
from optloc.models import MODELS
from optloc.problem import Bias

STATIONS = {
    2: np.array([[0.0, 0.0], [9e3, 1e3], [10e3, 9e3], [1e3, 10e3], [4.5e3, -2e3], [-2e3, 5e3]]),
    3: np.array(
        [
            [0.0, 0.0, 0.0],
            [10e3, 500.0, 3e3],
            [9e3, 10e3, 200.0],
            [-400.0, 9e3, 6e3],
            [5e3, -1e3, 5e3],
            [4e3, 5e3, -800.0],
            [-3e3, 3e3, 2e3],
        ]
    ),
}
TARGET = {2: np.array([3.1e3, 6.2e3]), 3: np.array([3.1e3, 6.2e3, 2.4e3])}
RATE = {2: np.array([60.0, -110.0]), 3: np.array([60.0, -110.0, 15.0])}
ENU = Frame.enu(lat_deg=47.3, lon_deg=8.5, height=420.0)


@dataclass(frozen=True)
class Case:
    """A problem with simulated measurements, and the parameter vector that made them.

    `start` says whether a closed form starts it, so that ``solve`` needs no guess.
    """

    name: str
    problem: Problem
    truth: np.ndarray
    start: bool = True


def turned(seed: int, d: int, count: int) -> np.ndarray:
    """Return proper rotations (1, count, d, d)."""
    q = np.random.default_rng(seed).standard_normal((count, d, d))
    # By Gram and Schmidt in plain sums: a QR of LAPACK has the last bit of its BLAS, and with it the measurements.
    for j in range(d):
        for i in range(j):
            q[..., j] -= (q[..., i] * q[..., j]).sum(-1, keepdims=True) * q[..., i]
        q[..., j] /= np.linalg.norm(q[..., j], axis=-1, keepdims=True)
    q[np.linalg.det(q) < 0, 0] *= -1.0
    return q[None]


def stations(d: int, **more: object) -> Stations:
    """Return the stations of the table with names, and with velocities, axes or covariances given."""
    base = station_array(STATIONS[d])
    return Stations(base.position, base.names, **more)


def pairs(d: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the stations a, b of differences to station 0."""
    a = np.arange(1, len(STATIONS[d]))
    return a, np.zeros_like(a)


def _tdoa(d: int) -> Problem:
    a, b = pairs(d)
    return assemble(STATIONS[d], measured("tdoa", a=a, b=b, arrival_sigma=5.0))


def _groa(d: int) -> Problem:
    a, b = pairs(d)
    return assemble(STATIONS[d], measured("groa", a=a, b=b, sigma=0.002))


def _rss_difference(d: int) -> Problem:
    a, b = pairs(d)
    return assemble(STATIONS[d], measured("rss_difference", a=a, b=b, sigma=0.02))


def _range(d: int) -> Problem:
    return assemble(STATIONS[d], measured("range", a=np.arange(len(STATIONS[d])), sigma=5.0))


def _toa(d: int) -> Problem:
    return assemble(STATIONS[d], measured("toa", a=np.arange(len(STATIONS[d])), sigma=5.0))


def _range_sum(d: int) -> Problem:
    a, b = pairs(d)
    return assemble(STATIONS[d], measured("range_sum", a=a, b=b, sigma=8.0))


def _angle(kind: str) -> Callable[[int], Problem]:
    def build(d: int) -> Problem:
        count = len(STATIONS[d])
        own = stations(d, axes=turned(7, d, count))
        return assemble(own, measured(kind, a=np.arange(count), sigma=0.002))

    return build


def _height(d: int) -> Problem:
    a = np.arange(4)
    return assemble(STATIONS[d], measured("range", a=a, sigma=5.0), measured("height", sigma=10.0), frame=ENU)


def _fdoa(d: int) -> Problem:
    count = len(STATIONS[d])
    rate = np.random.default_rng(3).normal(0.0, 150.0, (1, count, d))
    a, b = pairs(d)
    known = Motion(0)
    return assemble(stations(d, velocity=rate), measured("fdoa", a=a, b=b, sigma=0.05), motions=(known,))


def _range_rate(d: int) -> Problem:
    count = len(STATIONS[d])
    rate = np.random.default_rng(3).normal(0.0, 150.0, (1, count, d))
    return assemble(stations(d, velocity=rate), measured("range_rate", a=np.arange(count), sigma=0.05))


# How to measure with each kind alone (a height with the ranges it needs): a kind without a line here has no case.
BUILD: dict[str, Callable[[int], Problem]] = {
    "tdoa": _tdoa,
    "groa": _groa,
    "rss_difference": _rss_difference,
    "range": _range,
    "toa": _toa,
    "range_sum": _range_sum,
    "azimuth": _angle("azimuth"),
    "elevation": _angle("elevation"),
    "height": _height,
    "range_rate": _range_rate,
    "fdoa": _fdoa,
}


def _mix_tdoa_azimuth(d: int) -> Problem:
    a, b = pairs(d)
    return assemble(
        STATIONS[d], measured("tdoa", a=a, b=b, arrival_sigma=5.0), measured("azimuth", a=[0, 2], sigma=0.003)
    )


def _mix_range_range_sum(d: int) -> Problem:
    a, b = pairs(d)
    return assemble(
        STATIONS[d], measured("range", a=[1, 3], sigma=4.0), measured("range_sum", a=a[1:], b=b[1:], sigma=8.0)
    )


def _mix_toa_tdoa(d: int) -> Problem:
    a, b = pairs(d)
    return assemble(
        STATIONS[d],
        measured("toa", a=[0, 1, 2], sigma=4.0),
        measured("tdoa", a=a[2:], b=b[2:], arrival_sigma=6.0),
    )


def _mix_groa_tdoa(d: int) -> Problem:
    """Correlated across kinds: one covariance for all rows."""
    a, b = pairs(d)
    n = len(a)
    sigma = np.r_[np.full(n, 7.0), np.full(n, 2e-3)]
    mixing = np.eye(2 * n) + 0.5 + np.diag(np.full(n, 0.3), n) + np.diag(np.full(n, 0.3), -n)
    return assemble(
        STATIONS[d],
        measured("tdoa", a=a, b=b, sigma=1.0),
        measured("groa", a=a, b=b, sigma=1.0),
        covariance=sigma[:, None] * mixing * sigma / 1.5,
    )


def _mix_angles(d: int) -> Problem:
    count = len(STATIONS[d])
    own = stations(d, axes=turned(11, d, count))
    rows = [measured("azimuth", a=np.arange(4), sigma=0.002)]
    rows += [measured("elevation", a=np.arange(4), sigma=0.002)] if d == 3 else []
    return assemble(own, *rows)


def _mix_range_azimuth(d: int) -> Problem:
    rows = [measured("range", a=[0, 4], sigma=5.0), measured("azimuth", a=[1, 2], sigma=0.002)]
    return assemble(STATIONS[d], *rows, *([measured("elevation", a=[1], sigma=0.002)] if d == 3 else []))


def _mix_tdoa_fdoa(d: int) -> Problem:
    count = len(STATIONS[d])
    rate = np.random.default_rng(3).normal(0.0, 150.0, (1, count, d))
    a, b = pairs(d)
    return assemble(
        stations(d, velocity=rate),
        measured("tdoa", a=a, b=b, arrival_sigma=5.0),
        measured("fdoa", a=a, b=b, sigma=0.05),
        motions=(Motion(1),),
    )


def _mix_tdoa_height(d: int) -> Problem:
    a, b = pairs(d)
    return assemble(
        STATIONS[d],
        measured("tdoa", a=a[:4], b=b[:4], arrival_sigma=5.0),
        measured("height", sigma=10.0),
        frame=ENU,
    )


MIXTURES: dict[str, tuple[Callable[[int], Problem], tuple[int, ...]]] = {
    "tdoa+azimuth": (_mix_tdoa_azimuth, (2, 3)),
    "range+range_sum": (_mix_range_range_sum, (2, 3)),
    "toa+tdoa": (_mix_toa_tdoa, (2, 3)),
    "tdoa~groa": (_mix_groa_tdoa, (2, 3)),
    "angles": (_mix_angles, (2, 3)),
    "range+azimuth": (_mix_range_azimuth, (2, 3)),
    "tdoa+fdoa": (_mix_tdoa_fdoa, (2, 3)),
    "tdoa+height": (_mix_tdoa_height, (3,)),
}


def truth_of(problem: Problem) -> np.ndarray:
    """Return the table's target (and rate, and an emission 1234 m early) in the order of a problem's layout."""
    d = problem.dimension
    parts = {"position": TARGET[d], "velocity": RATE[d], "emission": np.array([-1234.0])}
    return np.concatenate([parts[slot.name] for slot in (*problem.layout.shared, *problem.layout.local)])


def _case(name: str, build: Callable[[int], Problem], d: int) -> Case:
    problem = build(d)
    truth = truth_of(problem)
    kinds = {rows.kind for rows in problem.rows}
    seed = [d, *(ord(letter) for letter in name)]
    start = kinds not in ({"range_rate"}, {"fdoa"}, {"elevation"})  # none lifts to rows without ranges of their own
    return Case(name, simulate(problem, truth, np.random.SeedSequence(seed)), truth, start)


def _table() -> dict[str, Case]:
    missing = sorted(set(MODELS) - set(BUILD))
    if missing:
        raise LookupError(f"tests/cases.py has no case for {', '.join(missing)}: add a line to BUILD")
    single = [(f"{kind}-{d}d", BUILD[kind], d) for kind, model in MODELS.items() for d in model.dimensions]
    mixed = [(f"{name}-{d}d", build, d) for name, (build, dims) in MIXTURES.items() for d in dims]
    return {name: _case(name, build, d) for name, build, d in single + mixed}


CASES = _table()


# ---------------------------------------------------------------------------------------------- a second opinion
def plain_h(kind: str, p, v, sa, va, sb, vb, axes, frame=None):
    """Return one kind's measurement by the textbook, for one row: points are vectors, `axes` a matrix or None."""
    ra = np.linalg.norm(p - sa) if sa is not None else None
    rb = np.linalg.norm(p - sb) if sb is not None else None
    if kind == "tdoa":
        return ra - rb
    if kind == "groa":
        return ra / rb
    if kind == "rss_difference":
        return -20.0 * np.log10(ra / rb)
    if kind in ("range", "toa"):
        return ra
    if kind == "range_sum":
        return ra + rb
    if kind == "azimuth":
        line = p - sa if axes is None else axes @ (p - sa)
        return np.arctan2(line[1], line[0])
    if kind == "elevation":
        line = p - sa if axes is None else axes @ (p - sa)
        return np.arcsin(line[2] / ra)
    if kind == "height":
        if frame.kind == "ecef":
            return pymap3d.ecef2geodetic(*p)[2]
        lat, lon, height = frame.origin
        return pymap3d.enu2geodetic(*p, np.degrees(lat), np.degrees(lon), height)[2]
    if kind == "range_rate":
        return (p - sa) @ (v - va) / ra
    if kind == "fdoa":
        return (p - sa) @ (v - va) / ra - (p - sb) @ (v - vb) / rb
    raise LookupError(kind)


def turn_matrix(turn: np.ndarray) -> np.ndarray:
    """Return the matrix that takes coordinates in some axes to coordinates in the axes turned by a rotation vector."""
    if len(turn) == 1:
        half = 2.0 * np.arctan(0.5 * turn[0])
        return np.array([[np.cos(half), np.sin(half)], [-np.sin(half), np.cos(half)]])
    size = np.linalg.norm(turn)
    if size == 0.0:
        return np.eye(3)
    angle, (x, y, z) = 2.0 * np.arctan(0.5 * size), turn / size
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K).T  # Rodrigues


def _at(array: np.ndarray, epoch: int) -> np.ndarray:
    return array[epoch if len(array) > 1 else 0]


def plain_predict(problem: Problem, x: np.ndarray) -> np.ndarray:
    """Return the modelled measurements of one unbatched problem, row by row, from the words of the data types."""
    out, number, s, d = [], 0, problem.stations, problem.dimension
    take = {slot.name: problem.layout.take(x, slot.name) for slot in (*problem.layout.shared, *problem.layout.local)}
    shared = {slot.name for slot in problem.layout.shared}

    def unknown(name: str, epoch: int) -> np.ndarray:
        return take[name] if name in shared else take[name][epoch]

    def state(target: int, epoch: int) -> tuple[np.ndarray, np.ndarray]:
        motion, suffix = problem.motions[target], f"[{target}]" if len(problem.motions) > 1 else ""
        if motion.known is not None:
            known = _at(motion.known, epoch)
            return known[0], known[1] if len(known) > 1 else np.zeros(d)
        names = ("position", "velocity", "acceleration")[: motion.order + 1]
        derivatives = [unknown(name + suffix, epoch) for name in names]
        since = 0.0
        if motion.span == "run":
            since = problem.times[epoch] - (problem.times[0] if motion.reference is None else motion.reference)
        p = sum(c * since**j / factorial(j) for j, c in enumerate(derivatives))
        v = sum((c * since ** (j - 1) / factorial(j - 1) for j, c in enumerate(derivatives) if j), np.zeros(d))
        return p, v

    for rows in problem.rows:
        model = MODELS[rows.kind]
        for i in range(rows.count):
            epoch, target = int(rows.epoch[i]), int(rows.target[i])
            offsets = unknown("stations", epoch).reshape(-1, d) if s.covariance is not None else np.zeros((s.count, d))
            p, v = state(target, epoch)
            places, rates = [], []
            for index in (rows.a[i], rows.b[i])[: model.stations]:
                places.append(_at(s.position, epoch)[index] + offsets[index])
                rates.append(np.zeros(d) if s.velocity is None else _at(s.velocity, epoch)[index])
            places, rates = places + [None] * (2 - len(places)), rates + [None] * (2 - len(rates))
            axes = None if s.axes is None or not model.stations else _at(s.axes, epoch)[rows.a[i]]
            gain, added = 1.0, 0.0
            for bias in problem.biases:
                for touch in np.flatnonzero(bias.row == number):
                    member, coefficient = bias.member[touch], bias.coefficient[touch]
                    value = take[bias.name].reshape(len(bias.members), -1)[member] * coefficient
                    if bias.form == "rotation":
                        axes = turn_matrix(value) @ (np.eye(d) if axes is None else axes)
                    elif bias.form == "scale":
                        gain += value[0]
                    else:
                        since = problem.times[epoch] - problem.times[0] if bias.form == "drift" else 1.0
                        added += value[0] * since
            if model.emission:
                name = f"emission[{target}]" if len(problem.motions) > 1 else "emission"
                added += unknown(name, epoch)[0]
            h = plain_h(rows.kind, p, v, places[0], rates[0], places[1], rates[1], axes, problem.frame)
            out.append(gain * h + added)
            number += 1
    return np.array(out)


def dense_covariance(problem: Problem) -> np.ndarray:
    """Return the covariance of all rows of one unbatched problem as one matrix."""
    full = np.zeros((problem.count, problem.count))
    for block in problem.noise.blocks:
        for g, rows in enumerate(block.row):
            full[np.ix_(rows, rows)] = block.covariance[g if len(block.covariance) > 1 else 0]
    return full


def wrapped(problem: Problem, residual: np.ndarray) -> np.ndarray:
    """Return residuals (..., m) with those of angles wrapped to [-pi, pi)."""
    periodic = np.concatenate([np.full(rows.count, MODELS[rows.kind].period is not None) for rows in problem.rows])
    return np.where(periodic, (residual + np.pi) % (2.0 * np.pi) - np.pi, residual)


def plain_cost(problem: Problem, x: np.ndarray) -> float:
    """Return the weighted sum of squared residuals of one unbatched problem with all rows present."""
    residual = wrapped(problem, problem.observed - plain_predict(problem, x))
    return float(residual @ np.linalg.pinv(dense_covariance(problem), rcond=1e-12, hermitian=True) @ residual)


# ------------------------------------------------------------------------------------ everything in one problem
def kitchen_sink(d: int, span: str = "epoch", seed: int = 5) -> Problem:
    """Return three targets over three epochs (steady, accelerating, known) with all forms of shared bias."""
    rng = np.random.default_rng(seed)
    count, k, times = len(STATIONS[d]), 3, np.array([10.0, 12.5, 14.0])
    moving = STATIONS[d] + rng.normal(0.0, 300.0, (k, count, d))
    spread = np.array([np.diag(rng.uniform(1.0, 9.0, d)) for _ in range(count)])
    axes = np.concatenate([turned(seed + i, d, count) for i in range(k)])
    own = Stations(
        moving, tuple(f"N{i}" for i in range(count)), rng.normal(0, 100.0, (k, count, d)), axes, spread, span
    )
    known = np.stack([np.stack([TARGET[d] + 500.0 * i, RATE[d]]) for i in range(k)])
    motions = (Motion(1), Motion(2, reference=11.0), Motion(1, known=known))
    kinds = ["tdoa", "groa", "range", "toa", "range_sum", "azimuth", "fdoa"] + (["elevation"] if d == 3 else [])
    kinds.append("range_rate")
    parts, sizes = [], {}
    for kind in kinds:
        a = rng.integers(0, count, 11)
        b = (a + rng.integers(1, count, 11)) % count
        sizes[kind] = (sum(size for _, size in sizes.values()), 11)
        sigma = rng.uniform(1.0, 3.0, 11) * (1e-3 if kind in ("groa", "azimuth", "elevation") else 1.0)
        parts.append(measured(kind, a=a, b=b, sigma=sigma, epoch=rng.integers(0, k, 11), target=rng.integers(0, 3, 11)))

    def rows(kind: str) -> np.ndarray:
        start, size = sizes[kind]
        return np.arange(start, start + size)

    tdoa, ranges, sums = parts[0].rows, rows("range"), rows("range_sum")
    members = tuple(own.names)
    angles = np.concatenate([rows(kind) for kind in kinds if kind in ("azimuth", "elevation")])
    mounts = np.concatenate([p.rows.a for p in parts if p.rows.kind in ("azimuth", "elevation")])
    clock = Bias(
        "clock",
        members,
        np.r_[rows("tdoa"), rows("tdoa")],
        np.r_[tdoa.a, tdoa.b],
        np.r_[np.ones(11), -np.ones(11)],
    )
    scale = Bias("scale", ("all",), np.r_[ranges, sums], np.zeros(22, int), np.ones(22), "scale")
    drift = Bias("drift", ("even", "odd"), ranges, np.arange(11) % 2, np.linspace(0.5, 2.0, 11), "drift")
    boresight = Bias("boresight", members, angles, mounts, np.ones(len(angles)), "rotation")
    return assemble(own, *parts, times=times, motions=motions, biases=(clock, scale, drift, boresight))


def random_vector(problem: Problem, seed: int = 9) -> np.ndarray:
    """Return a parameter vector of sensible sizes in the order of a problem's layout."""
    rng, d = np.random.default_rng(seed), problem.dimension
    size = {"velocity": 50.0, "acceleration": 3.0, "emission": 1e3, "stations": 3.0, "clock": 20.0, "scale": 1e-3}
    size |= {"drift": 2.0, "boresight": 0.05}
    parts = []
    for slots, repeat in ((problem.layout.shared, 1), (problem.layout.local, problem.epochs)):
        for _ in range(repeat):
            for slot in slots:
                name = slot.name.partition("[")[0]
                if name == "position":
                    parts.append(TARGET[d] + rng.normal(0.0, 700.0, d))
                else:
                    parts.append(rng.normal(0.0, size[name], slot.size))
    return np.concatenate(parts)


def quick(problem: Problem) -> Callable[[np.ndarray], np.ndarray]:
    """Return whitened residuals as a function of the vector: one target, one epoch, no unknown but emission."""
    s, d, full = problem.stations, problem.dimension, dense_covariance(problem)
    place = s.position[0]
    rate = np.zeros_like(place) if s.velocity is None else s.velocity[0]
    values, vectors = np.linalg.eigh(full)
    kept = values > 1e-10 * values[-1]
    W = (vectors[:, kept] / np.sqrt(values[kept])).T
    z, order = problem.observed, problem.motions[0].order

    def residual(x: np.ndarray) -> np.ndarray:
        line = x[:d] - place
        r = np.sqrt((line * line).sum(1))
        out = []
        for rows in problem.rows:
            a, b = rows.a, rows.b
            if rows.kind == "rss_difference":
                out.append(20.0 * (np.log10(r[b]) - np.log10(r[a])))
            elif rows.kind in ("tdoa", "groa", "range", "toa", "range_sum"):
                two = {"tdoa": np.subtract, "groa": np.divide, "range_sum": np.add}.get(rows.kind)
                one = r[a] + (x[-1] if rows.kind == "toa" else 0.0)
                out.append(one if two is None else two(r[a], r[b]))
            elif rows.kind == "height":
                out.append([plain_h("height", x[:d], None, None, None, None, None, None, problem.frame)])
            elif rows.kind in ("range_rate", "fdoa"):
                v = x[d : 2 * d] if order else np.zeros(d)
                slope = (line * (v - rate)).sum(1) / r
                out.append(slope[a] - slope[b] if rows.kind == "fdoa" else slope[a])
            elif rows.kind in ("azimuth", "elevation"):
                own = line[a] if s.axes is None else np.einsum("mij,mj->mi", s.axes[0][a], line[a])
                out.append(np.arctan2(own[:, 1], own[:, 0]) if rows.kind == "azimuth" else np.arcsin(own[:, 2] / r[a]))
            else:
                raise LookupError(rows.kind)
        return W @ wrapped(problem, z - np.concatenate(out))

    return residual

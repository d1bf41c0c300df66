"""Random scenes of exact measurements, of all kinds, whose stated noise can be made as small as one likes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc import Frame, Motion, Problem, Stations, assemble, constraints, measured, with_bias
from optloc.linear.constraints import exact, restore
from optloc.linear.evaluate import predict
from optloc.models import MODELS
from optloc.problem import Prior
from optloc.problem.noise import variances

Array = np.ndarray
Rng = np.random.Generator

# Of moving stations and targets, metres per second.
_SPEED = 200.0
# Radii of orbits of satellites, metres: low, medium and geostationary.
_ORBITS = (7.2e6, 26.56e6, 42.16e6)


@dataclass(frozen=True)
class Scene:
    """One scene.

    Parameters
    ----------
    name : str
        What was drawn, in words.
    build : callable
        From sigma over range to the problem, whose measurements do not matter.
    truth : array (n,)
        First entries of the parameter vector; the others are zero.
    """

    name: str
    build: Callable[[float], Problem]
    truth: Array

    def problem(self, share: float) -> Problem:
        """Return the problem of exact measurements with a sigma that is so small a share of the ranges."""
        made = self.build(share)
        x = np.concatenate([self.truth, np.zeros(made.layout.size - len(self.truth))])
        return made.with_rows(z=predict(made, x))


def rows_of(kind: str, count: int, share: float, size: float, epoch: Array | int = 0) -> list[Any]:
    """Return rows of a kind at all stations, with a sigma for a size of the scene, at one or several epochs."""
    epochs = np.atleast_1d(epoch)
    sigma = {"length": share * size, "speed": share * _SPEED}.get(MODELS[kind].quantity, share)
    pairs = MODELS[kind].stations == 2
    own = np.arange(1 if pairs else 0, count)
    ends = {"a": np.tile(own, len(epochs)), "epoch": np.repeat(epochs, len(own))}
    if pairs:
        ends["b"] = 0
    return [measured(kind, sigma=sigma, **ends)]


# Kinds by dimension, each alone and in mixtures.
FLAT = ("tdoa", "range", "toa", "groa", "range_sum", "azimuth", "rss_difference", "tdoa+azimuth", "range+azimuth")
SPACE = ("tdoa", "range", "toa", "groa", "range_sum", "azimuth+elevation", "rss_difference", "tdoa+elevation")
RATES = ("fdoa", "range_rate", "tdoa+fdoa", "range+range_rate", "azimuth+range_rate")


def ground(rng: Rng) -> Scene:
    """Stations and target in a box, anywhere from metres to a million kilometres wide; some with more to it."""
    d = int(rng.integers(2, 4))
    kind = str(rng.choice((FLAT, SPACE)[d - 2]))
    size, offset = 10.0 ** rng.uniform(0.5, 9.0), rng.choice([0.0, 1.0, 10.0])
    middle = offset * size * rng.standard_normal(d)
    count = int(rng.integers(d + 1, d + 5))
    place = middle + size * rng.uniform(-1.0, 1.0, (count, d))
    truth = middle + size * rng.uniform(-1.0, 1.0, d) * rng.choice([0.5, 1.0, 3.0])
    more = str(rng.choice(["", "", "prior", "bias", "box", "plane", "dense"]))
    spread = size * 10.0 ** rng.uniform(-3.0, 0.0)

    def build(share: float) -> Problem:
        rows = [row for part in kind.split("+") for row in rows_of(part, count, share, size)]
        held: tuple[Any, ...] = ()
        if more == "box":
            held = constraints.box(truth - 2.0 * size, truth + 3.0 * size)
        if more == "plane" and d == 3:
            held = constraints.box([-np.inf, -np.inf, truth[2]], [np.inf, np.inf, truth[2]])
        priors = [Prior("position", truth, spread**2 * np.eye(d))] if more == "prior" else []
        made = assemble(place, *rows, constraints=held, priors=priors)
        if more == "dense":
            m = made.count
            sigma = np.sqrt(variances(made.noise, m))
            covariance = sigma[:, None] * (0.4 + 0.6 * np.eye(m)) * sigma
            made = assemble(place, *rows, covariance=covariance, constraints=held, priors=priors)
        first = kind.partition("+")[0]
        if more == "bias" and MODELS[first].quantity == "length":
            made = with_bias(made, "late", kind=first, members=["S1"], sigma=share * size * 10.0)
        return made

    return Scene(f"{kind} {d}-D, {count} stations, size {size:.2g} {more}", build, truth)


def rates(rng: Rng) -> Scene:
    """Range rates of a target that stays, at stations that move."""
    d, kind = int(rng.integers(2, 4)), str(rng.choice(RATES))
    kind = kind.replace("azimuth", "azimuth+elevation") if d == 3 else kind
    size, count = 10.0 ** rng.uniform(3.0, 6.0), int(rng.integers(d + 1, d + 4))
    place, truth = size * rng.uniform(-1.0, 1.0, (count, d)), size * rng.uniform(-1.5, 1.5, d)
    velocity = _SPEED * rng.standard_normal((count, d))
    stations = Stations(place[None], tuple(f"S{i}" for i in range(count)), velocity=velocity[None])

    def build(share: float) -> Problem:
        return assemble(stations, *(row for part in kind.split("+") for row in rows_of(part, count, share, size)))

    return Scene(f"{kind} {d}-D, {count} moving stations, size {size:.2g}", build, truth)


def satellites(rng: Rng) -> Scene:
    """Satellites above the horizon of a target whose height is known, measured or open."""
    kind, radius = str(rng.choice(["tdoa", "range", "toa", "range_sum"])), float(rng.choice(_ORBITS))
    known = str(rng.choice(["exact", "exact", "measured", "open"]))
    least = {"tdoa": 3, "toa": 3, "range": 2, "range_sum": 3}[kind] + (known == "open")
    count, level = least + int(rng.integers(0, 3)), float(rng.choice([0.0, 46.5, 1e4]))
    frame, truth = above_ground(rng, level)
    up, place = truth / np.linalg.norm(truth), np.zeros((count, 3))
    for i in range(count):
        while True:
            way = rng.standard_normal(3)
            place[i] = radius * way / np.linalg.norm(way)
            line = place[i] - truth
            if line @ up > np.sin(np.radians(10.0)) * np.linalg.norm(line):
                break

    def build(share: float) -> Problem:
        rows = rows_of(kind, count, share, radius)
        if known == "measured":
            rows.append(measured("height", sigma=share * radius))
        held = constraints.height(exactly=level) if known == "exact" else ()
        return assemble(place, *rows, frame=frame, constraints=held)

    return Scene(f"{kind}, {count} satellites at {radius:.3g}, height {known} {level:g}", build, truth)


def above_ground(rng: Rng, level: float) -> tuple[Frame, Array]:
    """Return the Earth-centred frame and a place at a height."""
    frame = Frame("ecef")
    place = frame.from_geodetic(np.arcsin(rng.uniform(-1.0, 1.0)), rng.uniform(-np.pi, np.pi), level)
    return frame, np.asarray(place)


def airspace(rng: Rng) -> Scene:
    """A network on the ground and an aircraft at a known height, in local coordinates or Earth-centred ones."""
    kind = str(rng.choice(["tdoa", "range", "toa", "azimuth", "tdoa+azimuth", "groa", "range_sum"]))
    count, reach = int(rng.integers(3, 7)), 10.0 ** rng.uniform(3.5, 5.5)
    if kind in ("groa", "tdoa", "toa", "range_sum"):
        count = max(count, 4)
    level = rng.uniform(100.0, 12e3)
    frame = Frame.enu(lat_deg=rng.uniform(-80.0, 80.0), lon_deg=rng.uniform(-180.0, 180.0))
    place = np.column_stack([rng.uniform(-reach, reach, (count, 2)), rng.uniform(0.0, 500.0, count)])
    truth = np.array([*rng.uniform(-1.5 * reach, 1.5 * reach, 2), level])
    lat, lon, _ = frame.to_geodetic(truth)
    truth = np.asarray(frame.from_geodetic(lat, lon, level))
    if kind in ("tdoa", "range", "toa") and rng.random() < 0.4:
        turn, origin = frame.rotation_to_ecef(), frame.origin_ecef()
        place, truth, frame = place @ turn.T + origin, turn @ truth + origin, Frame("ecef")

    def build(share: float) -> Problem:
        rows = [row for part in kind.split("+") for row in rows_of(part, count, share, reach)]
        return assemble(place, *rows, frame=frame, constraints=constraints.height(exactly=level))

    return Scene(f"{kind}, {count} stations, reach {reach:.2g}, height {level:.0f}, {frame.kind}", build, truth)


def courses(rng: Rng) -> Scene:
    """A target in uniform motion within a box and a speed."""
    kind = str(rng.choice(["tdoa", "range", "azimuth", "toa"]))
    epochs, count, size = int(rng.integers(5, 9)), 4, 10.0 ** rng.uniform(3.5, 4.8)
    times = np.linspace(0.0, size / 500.0, epochs)
    place = size * rng.uniform(-1.0, 1.0, (count, 2))
    truth = np.concatenate([size * rng.uniform(-1.0, 1.0, 2), 0.5 * _SPEED * rng.uniform(-1.0, 1.0, 2)])
    limits = (*constraints.box([-5.0 * size] * 2, [5.0 * size] * 2), *constraints.speed(400.0))

    def build(share: float) -> Problem:
        rows = rows_of(kind, count, share, size, np.arange(epochs))
        motion = Motion(1, reference=float(times.mean()))
        return assemble(place, *rows, times=times, motions=(motion,), constraints=limits)

    return Scene(f"{kind}, moving target, {epochs} epochs, size {size:.2g}", build, truth)


def over_ground(rng: Rng) -> Scene:
    """An aircraft that keeps a known height over the Earth, seen by a network for some minutes."""
    kind = str(rng.choice(["tdoa", "range", "azimuth"]))
    epochs, count, reach = int(rng.integers(4, 7)), 5, 10.0 ** rng.uniform(4.3, 5.3)
    times = np.linspace(0.0, reach / 300.0, epochs)
    place = np.column_stack([rng.uniform(-reach, reach, (count, 2)), rng.uniform(0.0, 500.0, count)])
    frame = Frame.enu(lat_deg=rng.uniform(-80.0, 80.0), lon_deg=rng.uniform(-180.0, 180.0))
    level = float(rng.uniform(100.0, 12e3))
    start = np.array([*rng.uniform(-reach, reach, 2), level, *rng.uniform(-100.0, 100.0, 2), 0.0])
    held = constraints.height(exactly=level)
    sides = constraints.box([-3.0 * reach, -3.0 * reach, -np.inf], [3.0 * reach, 3.0 * reach, np.inf])
    limits = (*sides, *constraints.speed(400.0), *held)

    def build(share: float) -> Problem:
        rows = rows_of(kind, count, share, reach, np.arange(epochs))
        motion = Motion(1, reference=float(times.mean()), over="ground")
        return assemble(place, *rows, times=times, frame=frame, motions=(motion,), constraints=limits)

    made = build(1e-3).flat()
    truth = restore(made, exact(made), start[None])[0]
    return Scene(f"{kind}, course over ground, {epochs} epochs, reach {reach:.2g}", build, truth)


COUNT = 50
"""Scenes of one seed of a test in full."""
FAMILIES = (ground, ground, ground, satellites, satellites, airspace, rates, courses, over_ground)


def draw(seed: int) -> Scene:
    """Return the scene of a seed."""
    rng = np.random.default_rng([20261128, seed])
    return FAMILIES[seed % len(FAMILIES)](rng)

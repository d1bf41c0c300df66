"""From scenarios of a study file to cases: one geometry at one noise level with one set of swept values."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import as_file, files
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import Frame
from optloc.base.types import Array, Stations
from optloc.base.units import SI_UNIT
from optloc.files import read
from optloc.files.schema import fitted
from optloc.files.words import Units, join, kind_model
from optloc.models import MODELS
from optloc.problem.bias import with_bias
from optloc.problem.build import assemble, measured
from optloc.problem.epochs import separable
from optloc.problem.layout import state_names
from optloc.problem.noise import Block, Noise, variances
from optloc.problem.problem import Problem
from optloc.study.document import Amount, LayoutTable, Level, ScenarioTable, TruthTable, sigma_of

# Where stations and targets of a trial are: rules of a study file turned into positions.

Rng = np.random.Generator


def metres(values: list[Amount], where: str, count: int | None = None) -> Array:
    """Return amounts of length as an array; raise InvalidProblem where their number is not `count`."""
    if count is not None and len(values) != count:
        raise InvalidProblem(f"{len(values)} numbers do not fit {count} dimensions", where, "give one for each")
    return np.array([Units("length").plain(value, "m", where) for value in values])


def placed(layout: LayoutTable, where: str, rng: Rng, count: int) -> Array:
    """Return the stations of trials.

    Parameters
    ----------
    layout : LayoutTable
        The rule.
    where : str
        Place to name.
    rng : Generator
        Used where they are random.
    count : int
        Number of draws.

    Returns
    -------
    array (count, s, d)
        Metres; of rules without a draw all are equal.
    """
    s, d = layout.stations, layout.dimension
    if layout.placement == "given":
        return np.broadcast_to(_given(layout, where), (count, s, d))
    box = metres(layout.box[:d], join(where, "box"), d)
    if layout.placement in ("random", "frozen"):
        return rng.uniform(-0.5, 0.5, (count, s, d)) * box
    centre = int(layout.placement == "star")
    angle = 2.0 * np.pi * np.arange(s - centre) / max(s - centre, 1)
    unit = np.stack([np.cos(angle), np.sin(angle), (-1.0) ** np.arange(s - centre)], axis=-1)[:, :d]
    ring = np.concatenate([np.zeros((centre, d)), 0.5 * unit * box])
    return np.broadcast_to(ring, (count, s, d))


def _given(layout: LayoutTable, where: str) -> Array:
    place = join(where, "places")
    if layout.places is None or len(layout.places) != layout.stations:
        found = 0 if layout.places is None else len(layout.places)
        raise InvalidProblem(f"{found} places do not fit {layout.stations} stations", place, "give one for each")
    if any(len(point) != layout.dimension for point in layout.places):
        raise InvalidProblem(f"a place has not {layout.dimension} coordinates", place, "give metres")
    return np.array(layout.places, dtype=float)


_KEYS = {
    "fixed": ("at", "at_deg"),
    "box": ("box", "centre"),
    "shell": ("distance", "elevation_deg"),
    "hull": (),
    "area": ("lat_deg", "lon_deg", "height"),
}
_ANY = {"kind", "speed", "velocity"}


def check_truth(truth: TruthTable, frame: Frame, dimension: int, where: str) -> None:
    """Refuse a truth whose keys do not belong to its kind, or that the frame cannot hold."""
    foreign = sorted(truth.model_fields_set - _ANY - set(_KEYS[truth.kind]))
    if foreign:
        advice = f"it takes {', '.join(_KEYS[truth.kind])}" if _KEYS[truth.kind] else "it takes none"
        raise InvalidProblem(f"a truth of kind {truth.kind!r} has no key {foreign[0]!r}", where, advice)
    needed = {"fixed": (), "box": ("box",), "shell": ("distance",), "hull": (), "area": ("lat_deg", "lon_deg")}
    for key in needed[truth.kind]:
        if getattr(truth, key) is None:
            raise InvalidProblem(f"a truth of kind {truth.kind!r} needs the key {key!r}", where, "add it")
    if truth.kind == "fixed" and (truth.at is None) == (truth.at_deg is None):
        raise InvalidProblem("a fixed truth has one place", where, "give at, or at_deg on Earth")
    if (truth.at_deg is not None or truth.kind == "area") and not (frame.geodetic and dimension == 3):
        advice = "give a frame of the Earth, or metres"
        raise InvalidProblem("latitude and longitude need a frame on Earth in three dimensions", where, advice)
    places(truth, frame, np.zeros((1, 2, dimension)) + 1.0, where, np.random.default_rng(0))


def places(truth: TruthTable, frame: Frame, stations: Array, where: str, rng: Rng) -> Array:
    """Return true positions of targets.

    Parameters
    ----------
    truth : TruthTable
        The rule.
    frame : Frame
        Of the positions.
    stations : array (count, s, d)
        Stations of each trial, metres.
    where : str
        Place to name.
    rng : Generator
        Used where the place is random.

    Returns
    -------
    array (count, d)
        Metres in the frame.
    """
    count, d = len(stations), stations.shape[-1]
    centre = stations.mean(1)
    if truth.kind == "hull":
        share = rng.dirichlet(np.ones(stations.shape[1]), count)
        return np.asarray((share[..., None] * stations).sum(1))
    if truth.kind == "fixed":
        return np.broadcast_to(_fixed(truth, frame, d, where), (count, d))
    if truth.kind == "area":
        spans = [np.array(span) for span in (truth.lat_deg, truth.lon_deg) if span]
        lat, lon = (np.radians(rng.uniform(span[0], span[1], count)) for span in spans)
        height = metres([truth.height], join(where, "height"))[0]
        return np.asarray(frame.from_geodetic(lat, lon, np.full(count, height)))
    if truth.kind == "box":
        assert truth.box is not None
        box = metres(truth.box, join(where, "box"), d)
        middle = centre if truth.centre is None else metres(truth.centre, join(where, "centre"), d)
        return np.asarray(middle + _turned(frame, centre, rng.uniform(-0.5, 0.5, (count, d)) * box))
    assert truth.distance is not None
    low, high = metres(truth.distance, join(where, "distance"))
    away = _directions(truth, d, count, rng) * rng.uniform(low, high, (count, 1))
    return np.asarray(centre + _turned(frame, centre, away))


def _fixed(truth: TruthTable, frame: Frame, dimension: int, where: str) -> Array:
    if truth.at is not None:
        return metres(truth.at, join(where, "at"), dimension)
    assert truth.at_deg is not None
    if len(truth.at_deg) != 3:
        raise InvalidProblem("a place on Earth has three numbers", join(where, "at_deg"), "add the height in metres")
    lat, lon, height = truth.at_deg
    return np.asarray(frame.from_geodetic(np.radians(lat), np.radians(lon), height))


def _turned(frame: Frame, at: Array, local: Array) -> Array:
    """Return vectors (count, d) along east, north and up at points as vectors of the frame."""
    return np.asarray((local[:, None, :] @ frame.enu_axes(at))[:, 0]) if frame.geodetic else local


def _directions(truth: TruthTable, d: int, count: int, rng: Rng) -> Array:
    """Return unit vectors (count, d), even on the circle, the sphere or a band of elevations of it."""
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    flat = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    if d == 2:
        return flat
    low, high = truth.elevation_deg or (-90.0, 90.0)
    sine = rng.uniform(np.sin(np.radians(low)), np.sin(np.radians(high)), count)
    return np.concatenate([flat * np.sqrt(1.0 - sine[:, None] ** 2), sine[:, None]], axis=-1)


def velocities(truth: TruthTable, dimension: int, where: str, rng: Rng, count: int) -> Array:
    """Return true velocities (count, d), metres per second."""
    units = Units("speed")
    if truth.velocity is not None:
        if len(truth.velocity) != dimension:
            raise InvalidProblem(f"the velocity has not {dimension} components", join(where, "velocity"), "give each")
        given = [units.plain(value, "m/s", join(where, "velocity")) for value in truth.velocity]
        return np.broadcast_to(np.array(given), (count, dimension))
    way = rng.standard_normal((count, dimension))
    speed = 0.0 if truth.speed is None else units.plain(truth.speed, "m/s", join(where, "speed"))
    return np.asarray(speed * way / np.linalg.norm(way, axis=-1, keepdims=True))


# Errors that measurements suffer and no method is told: constant ones of every station, gross ones of a few.


@dataclass(frozen=True, slots=True)
class Flaw:
    """Errors of the stations in rows of one kind.

    Parameters
    ----------
    name : str
        Name of the unknown that holds them.
    size : float
        Their standard deviation; of gross ones how large they are.
    share : float, optional
        Probability that a station has a gross error; None: every station has a small one.
    late : bool
        Whether gross errors are positive.
    """

    name: str
    size: float
    share: float | None = None
    late: bool = False


def flawed(problem: Problem, table: ScenarioTable, where: str) -> tuple[Problem, tuple[Flaw, ...]]:
    """Return the problem as it really is, with the errors that no method is told, and what they are.

    Parameters
    ----------
    problem : Problem
        As methods get it.
    table : ScenarioTable
        The scenario.
    where : str
        Its place, for complaints.

    Raises
    ------
    InvalidProblem
        For a kind that the problem lacks, or a size that is not positive.
    """
    place, found = join(where, "error"), []
    offset, outliers = table.error.offset, table.error.outliers
    if offset is not None:
        sizes = _sizes(problem, offset, join(place, "offset"))
        found += [Flaw(f"unmodelled {kind}", size) for kind, size in sizes.items()]
    if outliers is not None:
        sizes = _sizes(problem, outliers.size, join(place, "outliers"))
        found += [Flaw(f"gross {kind}", size, outliers.share, outliers.late) for kind, size in sizes.items()]
    for flaw in found:
        problem = with_bias(problem, flaw.name, kind=flaw.name.partition(" ")[2])
    return problem, tuple(found)


def errors_of(
    flaws: tuple[Flaw, ...], lengths: dict[str, int], rng: np.random.Generator, size: int
) -> dict[str, Array]:
    """Return the errors (size, stations) of each flaw; a station that is off is off in all kinds.

    Parameters
    ----------
    flaws : tuple of Flaw
        From `flawed`.
    lengths : dict of str to int
        Number of stations in each.
    rng : Generator
        Decides the draw.
    size : int
        Number of trials.
    """
    small = [flaw for flaw in flaws if flaw.share is None]
    drawn: dict[str, Array] = {f.name: f.size * rng.standard_normal((size, lengths[f.name])) for f in small}
    most = max(lengths.values(), default=0)
    chance, sign = rng.random((size, most)), np.where(rng.random((size, most)) < 0.5, -1.0, 1.0)
    for flaw in flaws:
        if flaw.share is not None:
            off = (chance < flaw.share) * (1.0 if flaw.late else sign) * flaw.size
            drawn[flaw.name] = off[:, : lengths[flaw.name]]
    return drawn


def _sizes(problem: Problem, given: Amount | dict[str, Amount], where: str) -> dict[str, float]:
    """Return sizes in SI units by kind."""
    kinds = [rows.kind for rows in problem.rows]
    named = given if isinstance(given, dict) else dict.fromkeys(kinds, given)
    for kind in named:
        if kind not in kinds:
            raise InvalidProblem(f"no rows are of kind {kind!r}", where, nearest(kind, kinds))
    return {kind: sigma_of(kind, amount, where) for kind, amount in named.items()}


@dataclass(frozen=True)
class Case:
    """What all trials of one data cell share; it holds data only, so that it travels to workers.

    Parameters
    ----------
    table : ScenarioTable
        The scenario with its swept values in place.
    sweep : str
        The swept values as JSON.
    label, unit : str
        The noise level as it is written, and the unit of `level`.
    level : float
        The noise level as a number.
    template : Problem
        Stations, rows and noise; the measurements are NaN.
    seed : int
        Of the study.
    trials : int
        Number of trials.
    """

    table: ScenarioTable
    sweep: str
    label: str
    unit: str
    level: float
    template: Problem
    seed: int
    trials: int

    @cached_property
    def key(self) -> str:
        """Return what the data of a trial depend on beside its number, as 16 hexadecimal digits."""
        problem, text = self.template, self.table.model_dump_json(exclude={"noise", "sweep", "trials"})
        made = hashlib.blake2b(f"{self.seed} {self.label} {self.sweep} {text} {problem.frame}".encode(), digest_size=8)
        made.update(repr(problem.structure).encode())
        for array in (
            problem.stations.position,
            problem.stations.covariance,
            problem.weight,
            *(rows.correction for rows in problem.rows),
            *(block.covariance for block in problem.noise.blocks),
            *(part for bias in problem.biases for part in (bias.mean, bias.sigma)),
        ):
            made.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
        return made.hexdigest()

    @property
    def where(self) -> str:
        """Return the place that complaints name."""
        return f"scenario {self.table.name!r}"

    @property
    def state(self) -> tuple[str, ...]:
        """Return the names of position, velocity and acceleration of the target that is sought."""
        motions = self.template.motions
        i = next(i for i, motion in enumerate(motions) if motion.known is None)
        return state_names(i, len(motions), motions[i].order)


def cases_of(table: ScenarioTable, folder: Path, seed: int, trials: int) -> Iterator[Case]:
    """Yield the cases of a scenario: swept values outside, noise levels inside.

    Parameters
    ----------
    table : ScenarioTable
        The scenario.
    folder : Path
        Where its problem file is.
    seed, trials : int
        Of the study.

    Raises
    ------
    InvalidProblem
        Naming the scenario and what cannot be right.
    """
    for swept, chosen in _swept(table):
        where = f"scenario {table.name!r}"
        base = _template(chosen, folder, where, seed)
        _check(base, chosen, where)
        for level in chosen.noise:
            noise, value, unit = _noise(base, level, chosen.layout is None, join(where, "noise"))
            label = level if isinstance(level, str) else json.dumps(level)
            named = (json.dumps(swept, sort_keys=True), label, unit, value)
            yield Case(chosen, *named, replace(base, noise=noise), seed, chosen.trials or trials)


def _swept(table: ScenarioTable) -> Iterator[tuple[dict[str, Any], ScenarioTable]]:
    where = f"scenario {table.name!r}"
    for name, values in table.sweep.items():
        if not values or name in ("name", "sweep", "noise", "trials"):
            what = "has no values" if not values else "cannot be swept"
            raise InvalidProblem(f"{name!r} {what}", join(where, "sweep"), "give a list; noise has levels of its own")
    for chosen in product(*table.sweep.values()):
        swept = dict(zip(table.sweep, chosen, strict=True))
        data = table.model_dump(exclude_unset=True, exclude={"sweep"})
        for name, value in swept.items():
            *path, last = name.split(".")
            at = data
            for part in path:
                at = at.setdefault(part, {})
                if not isinstance(at, dict):
                    raise InvalidProblem(f"{name!r} names no key", join(where, "sweep"), "write table.key")
            at[last] = value
        yield swept, fitted(ScenarioTable, data, where) if swept else table


def _template(table: ScenarioTable, folder: Path, where: str, seed: int) -> Problem:
    if (table.problem is None) == (table.layout is None):
        raise InvalidProblem("a scenario has one geometry", where, "give either problem or [scenario.layout]")
    if table.layout is not None:
        return _laid(table, where, seed)
    assert table.problem is not None
    shipped = files("optloc") / "scenarios"
    names = sorted(entry.name.removesuffix(".toml") for entry in shipped.iterdir() if entry.name.endswith(".toml"))
    path = folder / table.problem
    if path.suffix == "" and not path.exists():
        if table.problem not in names:
            advice = nearest(table.problem, names) + ", or the path of a problem file"
            raise InvalidProblem(f"unknown problem {table.problem!r}", where, advice)
        with as_file(shipped) as place:
            return read(place / f"{table.problem}.toml", values=False).problem
    return read(path, values=False).problem


def _laid(table: ScenarioTable, where: str, seed: int) -> Problem:
    """Return the problem of a layout with noise of one, in which only the stations of a trial are still to be put."""
    layout = table.layout
    assert layout is not None
    where, s = join(where, "layout"), layout.stations
    rng = np.random.default_rng([seed, s, layout.dimension])
    pairs = list(combinations(range(s), 2)) if layout.pairs == "all" else [(0, i) for i in range(1, s)]
    rows = []
    for kind in layout.kinds:
        model = kind_model(kind, join(where, "kinds"))
        if model.stations == 0 or model.velocity:
            what = f"{kind!r} needs more than stations at rest and a target"
            raise InvalidProblem(what, join(where, "kinds"), "write a problem file, and name it in 'problem'")
        if model.stations == 2 and s < 2:
            raise InvalidProblem(f"{kind!r} needs two stations", join(where, "stations"), "give more")
        a, b = (np.arange(s), None) if model.stations == 1 else (np.array([p[1] for p in pairs]), [p[0] for p in pairs])
        shared = model.stations == 2 and model.ranges is not None and not layout.independent
        rows.append(measured(kind, a=a, b=b, **({"arrival_sigma" if shared else "sigma": 1.0})))
    survey = None if layout.survey is None else metres([layout.survey], join(where, "survey"))[0] ** 2
    spread = None if survey is None else np.tile(survey * np.eye(layout.dimension), (s, 1, 1))
    place = placed(layout, where, rng, 1)
    names = tuple(f"S{i + 1}" for i in range(s))
    return assemble(Stations(np.array(place), names, covariance=spread, span="noise"), *rows)


def _check(problem: Problem, table: ScenarioTable, where: str) -> None:
    """Refuse what has no single position to compare, and truths, biases and errors that do not fit."""
    if separable(problem):
        what = f"its {problem.epochs} epochs are problems of their own"
        raise InvalidProblem(what, where, "leave one epoch in the file: the trials are draws of it")
    sought = [motion for motion in problem.motions if motion.known is None]
    if len(sought) != 1 or sought[0].span != "run":
        raise InvalidProblem(f"{len(sought)} targets are sought", where, "give one static or moving target")
    moving = sought[0].order > 0
    if not moving and (table.truth.speed is not None or table.truth.velocity is not None):
        raise InvalidProblem("its target does not move", join(where, "truth"), "leave the velocity out")
    check_truth(table.truth, problem.frame, problem.dimension, join(where, "truth"))
    known = [bias.name for bias in problem.biases]
    for name in table.bias:
        if name not in known:
            advice = nearest(name, known) if known else "the problem has none"
            raise InvalidProblem(f"unknown bias {name!r}", join(where, "bias"), advice)
    flawed(problem, table, where)


def _noise(problem: Problem, level: Level, from_file: bool, where: str) -> tuple[Noise, float, str]:
    """Return the noise of a level, its number and its unit."""
    kinds = [rows.kind for rows in problem.rows]
    if isinstance(level, int | float):
        if not from_file:
            advice = f'write its unit, such as "10 {SI_UNIT[MODELS[kinds[0]].quantity]}"'  # type: ignore[index]
            raise InvalidProblem(f"the level {level:g} has no unit", where, advice)
        if not level > 0.0:
            raise InvalidProblem(f"the factor {level:g} is not positive", where, "give a positive one")
        return _scaled(problem.noise, np.full(problem.count, float(level))), float(level), "x"
    if isinstance(level, str):
        level = dict.fromkeys(kinds, level)
    if set(level) != set(kinds):
        odd = min(set(level) ^ set(kinds))
        raise InvalidProblem(f"the levels do not fit the kinds: {odd!r}", where, f"name {', '.join(kinds)}")
    wanted = {kind: sigma_of(kind, amount, where) for kind, amount in level.items()}
    own = np.sqrt(variances(problem.noise, problem.count))
    sigma = np.concatenate([np.full(rows.count, wanted[rows.kind]) for rows in problem.rows])
    unit = SI_UNIT[MODELS[kinds[0]].quantity]  # type: ignore[index]  # models hold known quantities only
    return _scaled(problem.noise, sigma / own), wanted[kinds[0]], unit


def _scaled(noise: Noise, factor: Array) -> Noise:
    """Return noise whose rows have standard deviations times a factor (m,)."""
    blocks = []
    for block in noise.blocks:
        own = factor[block.row]
        blocks.append(Block(block.row, block.covariance * own[:, :, None] * own[:, None, :]))
    return Noise(tuple(blocks))

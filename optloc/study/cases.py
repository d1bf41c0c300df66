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

from optloc.build import assemble, measured
from optloc.epochs import separable
from optloc.errors import InvalidProblem
from optloc.files import read
from optloc.files.document import fitted
from optloc.files.words import join, kind_model, nearest
from optloc.layout import state_names
from optloc.models import MODELS
from optloc.noise import Block, Noise, variances
from optloc.problem import Problem
from optloc.study.amounts import sigma_of
from optloc.study.document import Level, ScenarioTable
from optloc.study.flaws import flawed
from optloc.study.geometry import check_truth, metres, placed
from optloc.types import Array, Stations
from optloc.units import SI_UNIT


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

"""Experimental design of a study: the list of all trials and methods, divided into tasks.

A case is one geometry at one noise level with one set of swept values. A cell is a case with a method. A chunk is some
consecutive trials of a cell: one task computes it, and one part file contains its rows.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from itertools import combinations, product
from math import prod
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from optloc.files import access, join, kind_model, parse_toml, read, read_text, validated, within
from optloc.lab.study.document import Level, NetworkTable, ScenarioTable, StudyFile, sigma_of
from optloc.lab.study.methods import StudyMethod, methods_of, version_of
from optloc.lab.study.networks import NetworkCase, check_network, noise_of
from optloc.lab.study.simulation import Case, add_injected_errors, check_truth, metres, place_stations
from optloc.models import MODELS
from optloc.problem import (
    SI_UNIT,
    Array,
    Block,
    HasShortForm,
    InvalidProblem,
    Noise,
    Problem,
    Stations,
    assemble,
    measured,
    nearest,
    separable,
    variances,
)

# Most trials of a chunk, for fast and for slow methods: a part should take seconds. In shorter parts, files and tasks
# take as long as fixes; with longer parts, a stopped run loses minutes. A fast fix takes about 0.1 ms with all overhead
# (tests/benchmarks/test_study.py requires a million in two minutes), a slow one 1 to 100 ms. Other values make another
# design, so existing studies could not continue.
_FAST, _SLOW = 10_000, 250
# Fewest trials of a chunk of a slow and of a fast method. The latter is the largest block of draws, as a block is
# always drawn whole.
_LEAST, _LEAST_FAST = 10, 500
# Most measurements of a chunk: large problems have fewer trials in it, and twenty times fewer if solved one by one.
_NUMBERS, _SLOWER = 100_000, 20
# Chunks of a cell, unless they become too small: this number of workers can share a cell.
_LEAST_CHUNKS = 8


@dataclass(frozen=True)
class Cell:
    """A case with a method.

    Parameters
    ----------
    case : Case or NetworkCase
        Geometry, truth, noise.
    method : StudyMethod
        Method that solves the case.
    """

    case: Case | NetworkCase
    method: StudyMethod

    @property
    def key(self) -> str:
        """Return 16 hexadecimal digits that identify the case and the settings of the method."""
        return hashlib.blake2b(f"{self.case.key} {self.method.identity}".encode(), digest_size=8).hexdigest()

    @property
    def stretch(self) -> int:
        """Return the number of trials of a chunk.

        A chunk should take seconds, and several workers should be able to share the cell. A setting of the method
        replaces the number.
        """
        method, case = self.method, self.case
        if method.chunk is not None:
            return method.chunk
        # Most trials, most measurements, and fewest trials of a chunk.
        longest, numbers, least = (
            (_SLOW, _NUMBERS // _SLOWER, _LEAST) if method.slow else (_FAST, _NUMBERS, _LEAST_FAST)
        )
        most = max(_LEAST, min(longest, numbers // case.numbers))
        return int(np.clip(-(-case.trials // _LEAST_CHUNKS), min(least, most), most))


@dataclass(frozen=True)
class Chunk:
    """Some consecutive trials of a cell: one task computes them, and one part file contains them.

    Parameters
    ----------
    cell : Cell
        Cell of the trials.
    first, count : int
        Number of the first trial, and number of trials.
    """

    cell: Cell
    first: int
    count: int

    @property
    def key(self) -> str:
        """Return the name of the part file, without its suffix."""
        return f"{self.cell.key}-{self.first:09d}-{self.count}"


@dataclass(frozen=True, repr=False)
class StudyDesign(HasShortForm):
    """The experimental design of a study, ready to run.

    Parameters
    ----------
    study : StudyFile
        Content of the study file.
    text : str
        Text of the study file.
    cells : tuple of Cell
        Every case with every method, in the order of the file.
    folder : str
        Folder of the problem files.
    files : tuple of Path
        The problem files and their tables, with links resolved.
    """

    study: StudyFile
    text: str
    cells: tuple[Cell, ...]
    folder: str = ""
    files: tuple[Path, ...] = ()

    @property
    def chunks(self) -> Iterator[Chunk]:
        """Yield the chunks in the order of computation: the first of every cell, then the second of every cell, etc."""
        by_cell = [
            [Chunk(cell, first, min(n, cell.case.trials - first)) for first in range(0, cell.case.trials, n)]
            for cell, n in ((cell, cell.stretch) for cell in self.cells)
        ]
        # If a study is stopped early, each cell has some trials, so the report shows all methods.
        for number in range(max(len(chunks) for chunks in by_cell)):
            yield from (chunks[number] for chunks in by_cell if number < len(chunks))

    @property
    def rows(self) -> int:
        """Return the number of rows of the finished table: the trials of all cells."""
        return sum(cell.case.trials for cell in self.cells)

    @property
    def fingerprint(self) -> str:
        """Return hexadecimal digits that identify the data and the methods; remarks in the file do not change them."""
        # Without remarks, titles and the order of keys, so that a study continues in its folder after such edits.
        return _digest(f"{cell.key}:{cell.case.trials}:{cell.stretch}" for cell in self.cells)

    @property
    def data(self) -> str:
        """Return hexadecimal digits that identify the data; methods do not change them."""
        return _digest(dict.fromkeys(f"{cell.case.key}:{cell.case.trials}" for cell in self.cells))


def _digest(words: Iterable[str]) -> str:
    """Return 32 hexadecimal digits that identify a sequence of texts."""
    return hashlib.blake2b(" ".join(words).encode(), digest_size=16).hexdigest()


def shipped() -> dict[str, Traversable]:
    """Return the shipped study files by name."""
    folder = files("optloc.lab") / "studies"
    if not folder.is_dir():
        return {}
    found = {entry.name.removesuffix(".toml"): entry for entry in folder.iterdir() if entry.name.endswith(".toml")}
    return dict(sorted(found.items()))


# Most cases, whose problems are all in memory, and most part files of a folder. Larger numbers are typing errors.
_CASES, _PARTS = 10_000, 1_000_000


def design_of(
    file: Path, *, trials: int | None = None, seed: int | None = None, more: Sequence[StudyMethod] = ()
) -> StudyDesign:
    """Return the design of a study file, or of a shipped study by its name.

    Parameters
    ----------
    file : Path
        A TOML file with ``format = 1``.
    trials, seed : int, optional
        Replace the values of the file; `trials` also replaces the values of single scenarios.
    more : sequence of StudyMethod
        Methods in addition to the methods of the file.

    Raises
    ------
    InvalidProblem
        If the file is invalid; the message names the file, the scenario or the method, and the error.
    """
    if file.suffix == "" and not file.exists():
        known = shipped()
        if str(file) not in known:
            advice = f"{nearest(str(file), known)}, or give the path of a study file"
            raise InvalidProblem(f"there is no study {str(file)!r}", "study", advice)
        with as_file(known[str(file)]) as path:
            return design_of_text(read_text(path), path.name, path.parent, trials=trials, seed=seed, more=more)
    return design_of_text(read_text(file), file.name, file.parent, trials=trials, seed=seed, more=more)


def design_of_text(
    text: str,
    source: str,
    folder: Path,
    *,
    trials: int | None = None,
    seed: int | None = None,
    more: Sequence[StudyMethod] = (),
) -> StudyDesign:
    """Return the design of a study file's text; `source` names it in messages, `folder` contains its problem files.

    `trials` and `seed` replace the numbers of the file, if they are not None. `more` are methods that are added to the
    methods of the file.
    """
    study = validated(StudyFile, parse_toml(text, source), source)
    new = {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    study = study.model_copy(update=new)
    try:
        methods = [method for i, table in enumerate(study.method) for method in methods_of(table, i + 1)]
        methods += more
        _check_methods_fit(study, methods)
        # Trials of the command line also replace the numbers of single scenarios.
        override = {} if trials is None else {"trials": None}
        cases: list[Case | NetworkCase] = []
        with access() as outer:
            # An empty record, so that it has the files of this study only.
            with access(outside=outer.outside, budget=outer.budget, anew=True) as found:
                for scenario in study.scenario:
                    cases += cases_of(scenario.model_copy(update=override), folder, study.seed, study.trials)
            outer.read.update(found.read)
        for network in study.network:
            cases += network_cases(network.model_copy(update=override), study.seed, study.trials)
    except InvalidProblem as error:
        where = ", ".join(part for part in (source, error.where) if part)
        raise InvalidProblem(error.what, where, error.advice) from None
    # Each cell has at least one part, so too many cells are found without the sum.
    parts = len(cases) * len(methods)
    if parts <= _PARTS:
        parts = sum(-(-case.trials // Cell(case, method).stretch) for case in cases for method in methods)
    if parts > _PARTS:
        advice = "use fewer trials or cases, or a larger chunk in [[method]]"
        raise InvalidProblem(f"the study has {parts} parts, more than {_PARTS}", source, advice)
    _check_names_differ([method.name for method in methods], source, "method")
    _check_names_differ([table.name for table in study.scenario], source, "scenario")
    _check_names_differ([table.name for table in study.network], source, "network")
    cells = tuple(Cell(case, method) for case in cases for method in methods)
    return StudyDesign(study, text, cells, str(folder.resolve()), tuple(sorted(found.read)))


def _check_methods_fit(study: StudyFile, methods: list[StudyMethod]) -> None:
    """Raise InvalidProblem unless the study has either scenarios or networks, and every method can solve them."""
    if bool(study.scenario) == bool(study.network):
        what = "there are both scenarios and networks" if study.scenario else "there is no scenario and no network"
        raise InvalidProblem(what, "[[scenario]]", "give either [[scenario]] or [[network]] tables")
    for method in methods:
        if study.network and not method.networked:
            advice = 'use method = "calibrate", or a baseline of networks: optloc list baselines'
            raise InvalidProblem("it cannot solve networks", f"method {method.name!r}", advice)
        if study.scenario and not method.fixes:
            raise InvalidProblem("it solves networks only", f"method {method.name!r}", "give [[network]] tables")


def _check_names_differ(names: list[str], source: str, what: str) -> None:
    """Raise InvalidProblem if two of the names are equal; `what` is the type of the tables for the message."""
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise InvalidProblem(f"there are two {what}s {twice[0]!r}", source, f"give each {what} a different name")


# From a scenario to its cases.


def cases_of(table: ScenarioTable, folder: Path, seed: int, trials: int) -> Iterator[Case]:
    """Yield the cases of a scenario: swept values in the outer loop, noise levels in the inner one.

    `folder` contains its problem file; `seed` and `trials` are the values of the study. Raise InvalidProblem with the
    name of the scenario if it is invalid.
    """
    where = f"scenario {table.name!r}"
    for swept, chosen in _sweep(table, where):
        base = _template(chosen, folder, where, seed)
        _check(base, chosen, where)
        for level in chosen.noise:
            # The number is for axes and sorting. The label is for people, and is part of the key of the data.
            noise, value, unit = _noise(base, level, chosen.layout is None, join(where, "noise"))
            label = level if isinstance(level, str) else json.dumps(level)
            level_columns = (json.dumps(swept, sort_keys=True), label, unit, value)
            yield Case(chosen, *level_columns, replace(base, noise=noise), seed, chosen.trials or trials)


def network_cases(table: NetworkTable, seed: int, trials: int) -> Iterator[NetworkCase]:
    """Yield the cases of a table of networks: swept values in the outer loop, noise levels in the inner one.

    `seed` and `trials` are the values of the study. Raise InvalidProblem with the name of the network if it is invalid.
    """
    where = f"network {table.name!r}"
    for swept, chosen in _sweep(table, where):
        check_network(chosen, where)
        for level in chosen.noise:
            label = level if isinstance(level, str) else json.dumps(level)
            value = noise_of(level, join(where, "noise"))
            yield NetworkCase(chosen, json.dumps(swept, sort_keys=True), label, value, seed, chosen.trials or trials)


_Table = TypeVar("_Table", ScenarioTable, NetworkTable)


def _sweep(table: _Table, where: str) -> Iterator[tuple[dict[str, Any], _Table]]:
    """Yield the swept values by name and the table with these values, for each combination of the swept lists.

    A name with dots, such as `layout.stations`, is a key of a table in the table. `where` is the location for error
    messages.
    """
    for name, values in table.sweep.items():
        if not values or name in ("name", "sweep", "noise", "trials"):
            what = "has no values" if not values else "cannot be swept"
            raise InvalidProblem(
                f"{name!r} {what}", join(where, "sweep"), "give a list of values; noise levels are in 'noise'"
            )
    if (count := prod(map(len, table.sweep.values()))) > _CASES:
        what = f"its lists make {count} cases, more than {_CASES}"
        raise InvalidProblem(what, join(where, "sweep"), "sweep fewer values, or write several studies")
    for chosen in product(*table.sweep.values()):
        swept = dict(zip(table.sweep, chosen, strict=True))
        # Swept values are put into the table of the file, which is then validated again like a written one.
        data = table.model_dump(exclude_unset=True, exclude={"sweep"})
        for name, value in swept.items():
            *path, last = name.split(".")
            at = data
            for part in path:
                at = at.setdefault(part, {})
                if not isinstance(at, dict):
                    raise InvalidProblem(f"there is no key {name!r}", join(where, "sweep"), "write table.key")
            at[last] = value
        yield swept, validated(type(table), data, where) if swept else table


def _template(table: ScenarioTable, folder: Path, where: str, seed: int) -> Problem:
    """Return the problem of a scenario without measurements, from its file or its layout."""
    if (table.problem is None) == (table.layout is None):
        raise InvalidProblem("a scenario has one geometry", where, "give either problem or [scenario.layout]")
    if table.layout is not None:
        return _problem_of_layout(table, where, seed)
    assert table.problem is not None
    # With values=False, the problem file needs no measured values.
    shipped = files("optloc") / "scenarios"
    names = sorted(entry.name.removesuffix(".toml") for entry in shipped.iterdir() if entry.name.endswith(".toml"))
    path = within(folder, table.problem, join(where, "problem"))
    if path.suffix == "" and not path.exists():
        if table.problem not in names:
            advice = nearest(table.problem, names) + ", or the path of a problem file"
            raise InvalidProblem(f"unknown problem {table.problem!r}", where, advice)
        with as_file(shipped) as place:
            return read(place / f"{table.problem}.toml", values=False).problem
    return read(path, values=False).problem


def _problem_of_layout(table: ScenarioTable, where: str, seed: int) -> Problem:
    """Return the problem of a layout: stations and rows, where each row or arrival has the standard deviation 1.

    The levels of the study scale the noise later. Only random stations still have to be drawn for each trial. `seed` is
    the seed of the study.
    """
    layout = table.layout
    assert layout is not None
    where, s = join(where, "layout"), layout.stations
    # Frozen stations depend on seed, number and dimension only: scenarios that share these share their stations.
    rng = np.random.default_rng([seed, s, layout.dimension])
    pairs = list(combinations(range(s), 2)) if layout.pairs == "all" else [(0, i) for i in range(1, s)]
    rows = []
    for kind in layout.kinds:
        model = kind_model(kind, join(where, "kinds"))
        if model.stations == 0 or model.velocity:
            what = f"a layout has fixed stations only, which do not measure {kind!r}"
            raise InvalidProblem(what, join(where, "kinds"), "write a problem file, and name it in 'problem'")
        if model.stations == 2 and s < 2:
            raise InvalidProblem(f"{kind!r} needs two stations", join(where, "stations"), "give more")
        a, b = (np.arange(s), None) if model.stations == 1 else (np.array([p[1] for p in pairs]), [p[0] for p in pairs])
        # Differences share the arrival at a station, and so half of their variance, unless the file makes them
        # independent.
        shared = model.stations == 2 and model.ranges is not None and not layout.independent
        rows.append(measured(kind, a=a, b=b, arrival_sigma=1.0) if shared else measured(kind, a=a, b=b, sigma=1.0))
    survey = None if layout.survey is None else metres([layout.survey], join(where, "survey"))[0] ** 2
    spread = None if survey is None else np.tile(survey * np.eye(layout.dimension), (s, 1, 1))
    position = place_stations(layout, where, rng, 1)
    names = tuple(f"S{i + 1}" for i in range(s))
    # With span="noise", each station has a new position error at each epoch.
    return assemble(Stations(np.array(position), names, covariance=spread, span="noise"), *rows)


def _check(problem: Problem, table: ScenarioTable, where: str) -> None:
    """Raise InvalidProblem unless the problem has one unknown target, and truth, biases and errors fit the problem."""
    # A trial is one problem. Epochs that share no unknown would be separate trials without a number.
    if separable(problem):
        what = f"its {problem.epochs} epochs are separate problems"
        raise InvalidProblem(what, where, "keep one epoch in the file: every trial simulates it")
    sought = [motion for motion in problem.motions if motion.known is None]
    if len(sought) != 1 or sought[0].span != "run":
        raise InvalidProblem(f"it has {len(sought)} unknown targets", where, "give one static or moving target")
    moving = sought[0].order > 0
    if not moving and (table.truth.speed is not None or table.truth.velocity is not None):
        raise InvalidProblem("its target does not move", join(where, "truth"), "remove the velocity")
    check_truth(table.truth, problem.frame, problem.dimension, join(where, "truth"))
    known = [bias.name for bias in problem.biases]
    for name in table.bias:
        if name not in known:
            advice = nearest(name, known) if known else "the problem has none"
            raise InvalidProblem(f"unknown bias {name!r}", join(where, "bias"), advice)
    add_injected_errors(problem, table, where)


def _noise(problem: Problem, level: Level, from_file: bool, where: str) -> tuple[Noise, float, str]:
    """Return the noise of a problem at a level, the level as a number, and its unit.

    `from_file` is True if the problem has its noise from a problem file. Then a bare number is a factor on this noise,
    with the unit "x". Otherwise the number is the standard deviation of the first kind, in its SI unit. `level` is a
    number, a text with its unit for all kinds, or such texts by kind.
    """
    kinds = [rows.kind for rows in problem.rows]
    if isinstance(level, int | float):
        if not from_file:
            advice = f'write its unit, such as "10 {SI_UNIT[MODELS[kinds[0]].quantity]}"'  # type: ignore[index]
            raise InvalidProblem(f"the level {level:g} has no unit", where, advice)
        if not level > 0.0:
            raise InvalidProblem(f"the factor {level:g} is not positive", where, "give a positive one")
        return _scale(problem.noise, np.full(problem.count, float(level))), float(level), "x"
    if isinstance(level, str):
        level = dict.fromkeys(kinds, level)
    if set(level) != set(kinds):
        unmatched = min(set(level) ^ set(kinds))
        raise InvalidProblem(f"the levels do not fit the kinds: {unmatched!r}", where, f"name {', '.join(kinds)}")
    sigmas = {kind: sigma_of(kind, amount, where) for kind, amount in level.items()}
    # Only standard deviations change: the correlations of the file or the layout stay.
    before = np.sqrt(variances(problem.noise, problem.count))
    sigma = np.concatenate([np.full(rows.count, sigmas[rows.kind]) for rows in problem.rows])
    unit = SI_UNIT[MODELS[kinds[0]].quantity]  # type: ignore[index]  # models hold known quantities only
    return _scale(problem.noise, sigma / before), sigmas[kinds[0]], unit


def _scale(noise: Noise, factor: Array) -> Noise:
    """Return noise whose standard deviations are multiplied by `factor` (m,), one factor for each of the m rows."""
    blocks = []
    for block in noise.blocks:
        size = factor[block.row]
        blocks.append(Block(block.row, block.covariance * size[:, :, None] * size[:, None, :]))
    return Noise(tuple(blocks))


def workers() -> int:
    """Return the number of processes that this machine can run at a time."""
    # Containers and schedulers may allow fewer processors than the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def versions() -> str:
    """Return the versions of optloc, Python and the libraries that affect numbers, as one line."""
    names = ("optloc", "numpy", "scipy", "numba", "cvxpy", "clarabel", "casadi", "pyarrow")
    return "; ".join([f"Python {platform.python_version()}", *(f"{name} {version_of(name)}" for name in names)])


@cache
def machine() -> str:
    """Return the processor, the number of its cores and the system of this machine as one line."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    except OSError:
        pass
    return f"{name}, {os.cpu_count()} cores, {platform.system()}"

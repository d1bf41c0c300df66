"""The data of trials: a function of study seed, case and trial number alone, drawn in blocks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Bias
from optloc.files.words import Units, join
from optloc.linear.simulate import simulate
from optloc.problem.problem import Problem
from optloc.study.cases import Case, errors_of, flawed, placed, places, velocities
from optloc.study.document import sigma_of

_NUMBERS = 25_000
"""Measurements in a block of trials, about; a block is what one seed decides."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """Trials of a case.

    Parameters
    ----------
    problem : Problem
        As methods get it, with leading axis (n,).
    truth : array (n, size)
        True parameter vectors in the order of its layout.
    wild : array (n, d)
        A place in the unit cube around zero for each: where methods begin that need a guess.
    seed : tuple of n str
        Names of the seeds of the trials.
    bad : int array (n,)
        How many stations have a gross error.
    position : str
        Name of the position that is sought.
    """

    problem: Problem
    truth: Array
    wild: Array
    seed: tuple[str, ...]
    bad: Array
    position: str = "position"

    def part(self, first: int, count: int) -> Drawn:
        """Return some of the trials."""
        kept = slice(first, first + count)
        problem = self.problem.take(np.arange(first, first + count))
        return Drawn(problem, self.truth[kept], self.wild[kept], self.seed[kept], self.bad[kept], self.position)


def block_size(case: Case) -> int:
    """Return how many trials one seed decides."""
    return int(np.clip(_NUMBERS // case.template.count, 1, 500))


def draw(case: Case, first: int, count: int) -> Drawn:
    """Return trials `first` to ``first + count`` of a case; they do not depend on what else is drawn.

    Parameters
    ----------
    case : Case
        Geometry, truth, noise.
    first, count : int
        Numbers of the trials.
    """
    size = block_size(case)
    blocks = range(first // size, -(-(first + count) // size))
    parts = [_block(case, number, size) for number in blocks]
    kept = slice(first - blocks[0] * size, first - blocks[0] * size + count)
    stations, truth, wild, z, bad = (np.concatenate(arrays)[kept] for arrays in zip(*parts, strict=True))
    problem = case.template
    if case.table.layout is not None:
        problem = replace(problem, stations=replace(problem.stations, position=stations[:, None]))
    names = [f"{case.seed}:{case.key}:{number}" for number in blocks]
    seed = tuple(names[trial // size - blocks[0]] for trial in range(first, first + count))
    return Drawn(problem.with_rows(z=z), truth, wild, seed, bad, case.state[0])


def _block(case: Case, number: int, size: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return stations, truth, wild places, measurements and numbers of stations that are off, of one block."""
    key = [int(case.key[:8], 16), int(case.key[8:], 16)]
    geometry, noise, guess = np.random.SeedSequence([case.seed, *key], spawn_key=(number,)).spawn(3)
    rng, problem, table = np.random.default_rng(geometry), case.template, case.table
    stations = np.broadcast_to(problem.stations.position.mean(0), (size, *problem.stations.position.shape[-2:]))
    if table.layout is not None:
        if table.layout.placement != "frozen":
            stations = placed(table.layout, case.where, rng, size)
        problem = replace(problem, stations=replace(problem.stations, position=stations[:, None]))
    real, flaws = flawed(problem, table, case.where)
    names = case.state
    where = join(case.where, "truth")
    values = {names[0]: places(table.truth, problem.frame, stations, where, rng)}
    if len(names) > 1:
        values[names[1]] = velocities(table.truth, problem.dimension, where, rng, size)
    values |= {bias.name: _biases(case, bias, rng, size) for bias in problem.biases}
    errors = errors_of(flaws, {flaw.name: _length(real, flaw.name) for flaw in flaws}, rng, size)
    values |= errors
    off = [errors[flaw.name] != 0.0 for flaw in flaws if flaw.share is not None]
    bad = np.any(off, axis=0).sum(-1) if off else np.zeros(size, dtype=int)
    drawn = simulate(real, _vector(real, values, size), noise)
    z = np.broadcast_to(drawn.z, (size, problem.count))
    wild = np.random.default_rng(guess).uniform(-0.5, 0.5, (size, problem.dimension))
    return stations, _vector(problem, values, size), wild, z, bad


def _vector(problem: Problem, values: dict[str, Array], size: int) -> Array:
    """Return parameter vectors (size, n) with named values; what has none is zero."""
    layout = problem.layout
    shared = np.zeros((size, layout.n_shared))
    for slot in layout.shared:
        if slot.name in values:
            shared[:, slot.start : slot.start + slot.size] = values[slot.name]
    return np.concatenate([shared, np.zeros((size, layout.size - layout.n_shared))], axis=1)


def _length(problem: Problem, name: str) -> int:
    return problem.layout.find(name)[0].size


def _biases(case: Case, bias: Bias, rng: np.random.Generator, size: int) -> Array:
    """Return true values (size, q) of a bias of the file."""
    q = _length(case.template, bias.name)
    mean = np.broadcast_to(np.ravel(bias.mean), (q,))
    given = case.table.bias.get(bias.name)
    if given is None:
        return np.broadcast_to(mean, (size, q))
    where = join(case.where, f"bias {bias.name!r}")
    if isinstance(given, list):
        if len(given) != q:
            raise InvalidProblem(f"{len(given)} values do not fit {q} members", where, "give one for each")
        return np.broadcast_to(np.array([_amount(case, bias, value, where) for value in given]), (size, q))
    return np.asarray(mean + _amount(case, bias, given, where) * rng.standard_normal((size, q)))


def _amount(case: Case, bias: Bias, value: float | str, where: str) -> float:
    if isinstance(value, int | float):
        return float(value)
    if bias.form == "offset":
        starts = np.array(case.template.starts)
        kind = case.template.rows[int(np.searchsorted(starts, bias.row[0], side="right")) - 1].kind
        text = value.strip()
        sign = -1.0 if text.startswith("-") else 1.0
        return sign * sigma_of(kind, text.lstrip("-"), where)
    quantity = "angle" if bias.form == "rotation" else "plain"
    return Units(quantity).plain(value, None, where)  # type: ignore[arg-type]

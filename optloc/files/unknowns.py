"""Motions, biases and priors of a problem file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from optloc.bias import family
from optloc.errors import InvalidProblem
from optloc.files.epochs import Epochs
from optloc.files.schema import BiasTable, PriorTable, ProblemFile, TargetTable
from optloc.files.words import Units, join, nearest
from optloc.models import MODELS
from optloc.types import Array, Bias, Motion, Prior, Rows
from optloc.units import Quantity

_ORDERS = {"static": 0, "free": 0, "constant_velocity": 1, "constant_acceleration": 2}
_STATES: dict[str, tuple[Quantity, str]] = {
    "position": ("length", "m"),
    "velocity": ("speed", "m/s"),
    "acceleration": ("plain", "1"),
    "emission": ("length", "m"),
}


def motions_of(file: ProblemFile, epochs: Epochs, known: Mapping[str, Array], source: str) -> tuple[Motion, ...]:
    """Return the motion of each target; `known` holds the states of those that are given."""
    names = ("target",) if epochs.own else epochs.targets
    unknown = [name for name in file.targets if name not in epochs.targets]
    if unknown:
        raise InvalidProblem(
            f"no row has the target {unknown[0]!r}",
            join(source, "[targets]"),
            nearest(unknown[0], sorted(set(epochs.targets))),
        )
    return tuple(_motion(file.targets.get(name, file.target), epochs.count, known.get(name)) for name in names)


def _motion(table: TargetTable, count: int, known: Array | None) -> Motion:
    if known is not None:
        return Motion(known.shape[-2] - 1, "epoch" if count > 1 else "run", known)
    motion = table.motion or ("static" if count == 1 else "free")
    return Motion(_ORDERS[motion], "epoch" if motion == "free" and count > 1 else "run", reference=table.reference)


def needs_clock(motions: Sequence[Motion], biases: Sequence[BiasTable]) -> str | None:
    """Return why the times of the epochs matter, or None."""
    if any(motion.order > 0 and motion.known is None for motion in motions):
        return "a moving target"
    return "a drift" if any(bias.form == "drift" for bias in biases) else None


def bias_of(
    table: BiasTable, rows: Sequence[Rows], stations: Sequence[str], dimension: int, speed: float, source: str
) -> Bias:
    """Return a family of biases over the rows of a problem."""
    where = join(source, f"[[biases]] {table.name!r}")
    bias = family(
        rows,
        stations,
        table.name,
        per=table.per,
        form=table.form,
        kind=table.kind,
        members=table.members,
        where=where,
    )
    ends = np.cumsum([block.count for block in rows])
    block = rows[int(np.searchsorted(ends, bias.row[0], side="right"))]
    quantity: Quantity = MODELS[block.kind].quantity  # type: ignore[assignment]  # the table holds known quantities only
    turns = (3,) if table.form == "rotation" and dimension == 3 else ()
    mean, sigma = _prior(table, quantity, speed, (len(bias.members), *turns), where)
    return replace(bias, mean=mean, sigma=sigma)


def _prior(
    table: BiasTable, quantity: Quantity, speed: float, shape: tuple[int, ...], where: str
) -> tuple[Array, Array | None]:
    own: dict[str, Quantity] = {"scale": "plain", "rotation": "angle"}
    units = Units(own.get(table.form, quantity), speed)

    def si(value: float | str, key: str) -> float:
        place, text = join(where, f"key {key!r}"), value
        bare = "1" if units.quantity in {"plain", "ratio"} and table.form != "drift" else None
        if table.form == "drift":
            number, _, unit = str(value).strip().partition(" ")
            amount, slash, _ = unit.replace("^2", "/s").rpartition("/s")
            if not slash:
                example = f'"{number} {units.name(None)}/s"'
                raise InvalidProblem(f"{value!r} is no drift", place, f"write its unit, such as {example}")
            text = f"{number} {amount}"
        return units.plain(text, bare, place)

    mean = np.full(shape, 0.0 if table.mean is None else si(table.mean, "mean"))
    if table.sigma is None:
        return mean, None
    sigma = si(table.sigma, "sigma")
    if sigma <= 0.0:
        raise InvalidProblem(
            "the standard deviation is not positive", join(where, "key 'sigma'"), "leave it out if unknown"
        )
    return mean, np.full(shape, sigma)


def prior_of(table: PriorTable, dimension: int, source: str) -> Prior:
    """Return prior knowledge of a state."""
    where = join(source, f"[[priors]] {table.name!r}")
    base = table.name.partition("[")[0]
    if base not in _STATES:
        raise InvalidProblem(
            "there is no such unknown", where, f"{nearest(base, list(_STATES))}; those of biases stand with the bias"
        )
    quantity, default = _STATES[base]
    units, unit = Units(quantity), table.unit or default
    size = 1 if base == "emission" else dimension
    if len(table.mean) != size:
        raise InvalidProblem(f"the mean has {len(table.mean)} coordinates, not {size}", where, "give one each")
    spread = table.sigma if isinstance(table.sigma, list) else [units.plain(table.sigma, unit, where)] * size
    sigma = np.array(spread) * (units.conversion(unit, where).factor if isinstance(table.sigma, list) else 1.0)
    if len(sigma) != size or (sigma <= 0.0).any():
        raise InvalidProblem(f"sigma is not {size} positive numbers", where, "give one each")
    return Prior(table.name, units.conversion(unit, where).factor * np.array(table.mean), np.diag(sigma**2))

"""Constraints of problem files, of the command line and of Python arguments, and the motions that can keep them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import Frame
from optloc.base.types import AnyOf, Array, Band, Constraint, Fence, Motion, Polygon, Stations
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files.constraint_files import StatedConstraint, stated
from optloc.files.constraint_kinds import ConstraintKind, check_keys, heights_of, kind_of, moves
from optloc.files.constraint_table import ConstraintTable, constraint_table
from optloc.files.constraint_values import ConstraintValues
from optloc.files.schema import ProblemFile
from optloc.files.settings import join
from optloc.linear.constraints import for_target
from optloc.problem.constraint_checks import bands_by_quantity

Limit = Constraint | Fence
"""A constraint, or a half-plane with an uncertain boundary."""
Demand = StatedConstraint | Sequence[Limit]
"""A table with the contents of its file, or finished constraints."""


StatedConstraints: TypeAlias = "Sequence[Mapping[str, object] | Limit | Sequence[Limit]]"
"""Constraints as a Python argument: tables as in problem files, constraints of `optloc.constraints`, or a mixture."""


def limits_of(file: ProblemFile, folder: Path | None, source: str) -> dict[str, StatedConstraint]:
    """Return the constraints of a problem file with the contents of their files, by their place for messages.

    `folder` is the folder of the problem file; None allows any file. `source` is the name of the problem file.
    """
    places = [join(source, f"[[constraints]] {i + 1}") for i in range(len(file.constraints))]
    return {place: stated(table, folder, place) for place, table in zip(places, file.constraints, strict=True)}


def demands_of(tables: Mapping[str, ConstraintTable]) -> dict[str, StatedConstraint]:
    """Return tables that a user states, by their place for messages, with the contents of the files that they name."""
    return {where: stated(table, None, where) for where, table in tables.items()}


def stated_arguments(given: StatedConstraints) -> dict[str, Demand]:
    """Return the constraints of a Python argument by their place for messages.

    Raises
    ------
    InvalidProblem
        For an argument that is neither a table nor a constraint, or for a table with unknown keys.
    """
    if isinstance(given, Mapping) or not isinstance(given, Sequence):
        given = [given]
    found: dict[str, Demand] = {}
    for i, each in enumerate(given):
        where = f"constraints[{i}]"
        parts = each if isinstance(each, tuple | list) else [each]
        if isinstance(each, Mapping):
            found[where] = stated(constraint_table(each, where), None, where)
        elif all(isinstance(part, Band | Polygon | AnyOf | Fence) for part in parts):
            found[where] = [part for part in parts if isinstance(part, Band | Polygon | AnyOf | Fence)]
        else:
            advice = 'give optloc.constraints.disc(...), or a table such as {"kind": "box", "min": [0.0, 0.0]}'
            raise InvalidProblem(f"{type(each).__name__} is no constraint", where, advice)
    return found


def constraints_of(
    demands: Mapping[str, Demand],
    stations: Stations,
    frame: Frame,
    motions: Sequence[Motion],
    names: Sequence[str],
    times: Array,
    speed: float = SPEED_OF_LIGHT,
) -> tuple[tuple[Limit, ...], tuple[Motion, ...]]:
    """Return the constraints of tables, and motions that can satisfy them.

    Constraints on one quantity of one target are joined. If a height holds along a course, all moving targets follow
    the Earth.

    Parameters
    ----------
    demands : mapping of str to StatedConstraint or sequence of constraints
        Tables by their place for messages; a table without a target applies to all estimated targets. Finished
        constraints are added unchanged.
    stations : Stations
        Stations of the problem.
    frame : Frame
        Frame of the coordinates.
    motions : sequence of Motion
        Motion of each target.
    names : sequence of str
        Name of each target; several names for one motion are free targets of separate epochs.
    times : array (k,)
        Seconds of the epochs.
    speed : float
        Propagation speed, m/s, for lengths that are given as times.

    Raises
    ------
    InvalidProblem
        The message has the place of the table, the key and a next step.
    """
    found: list[Limit] = []
    motions = list(motions)
    for where, demand in demands.items():
        if not isinstance(demand, StatedConstraint):
            found += demand
            continue
        table = demand.table
        check_keys(table.kind, table.given, where)
        kind, given = kind_of(table.kind), demand.keys(frame.geodetic)
        assert kind is not None  # the schema has checked the name
        # A constraint without a target becomes one constraint for each estimated target, with its name.
        for target in _targets(table, motions, names, where):
            values = ConstraintValues(
                table.kind, given, stations, frame, motions[target], times, tuple(names), target, where, speed
            )
            made = _made(kind, values)
            if isinstance(made, tuple) and made and isinstance(made[0], Motion):
                motions[target], made = made
            suffix = f" of {names[target]}" if len(motions) > 1 else ""
            found += made if table.kind == "separation" else [_of_target(each, target, suffix) for each in made]
    if any(motion.over == "ground" for motion in motions):
        motions = [replace(m, over="ground") if moves(m) else m for m in motions]
    return tuple(_merge(found)), tuple(motions)


def divided(limits: Sequence[Limit]) -> dict[str, Any]:
    """Return the arguments `constraints` and `fences` of a `Problem`."""
    fences = tuple(limit for limit in limits if isinstance(limit, Fence))
    return {"constraints": tuple(limit for limit in limits if not isinstance(limit, Fence)), "fences": fences}


def floors_of(demands: Mapping[str, Demand], motions: Sequence[Motion]) -> tuple[float, ...]:
    """Return the heights, metres, of the constraint that lists heights; empty without such a constraint.

    `motions` are the motions of the targets. Raise InvalidProblem for two lists, or for several targets.
    """
    lists = {w: d.table for w, d in demands.items() if isinstance(d, StatedConstraint) and d.table.one_of is not None}
    if not lists:
        return ()
    where = [*lists][-1]
    if len(lists) > 1:
        raise InvalidProblem("the heights are listed twice", where, "remove one list")
    if len(motions) > 1:
        raise InvalidProblem("a list of heights is for one target", where, "give each target one height, or a band")
    table = lists[where]
    return heights_of(table.one_of or (), table.unit, where)


def _made(kind: ConstraintKind, values: ConstraintValues) -> Any:
    """Return the constraints that a kind makes of its values; an error gets the place of the table."""
    try:
        return kind.make(values)
    except InvalidProblem as error:
        if (error.where or "").startswith(values.where):
            raise
        raise InvalidProblem(error.what, values.where, error.advice) from None


def _of_target(constraint: Limit, target: int, suffix: str) -> Limit:
    """Return a constraint with the number of its target, and with an ending of its name."""
    name = constraint.name + suffix
    if isinstance(constraint, Fence):
        return replace(constraint, target=target, name=name)
    return replace(for_target(constraint, target), name=name)


def _targets(table: ConstraintTable, motions: Sequence[Motion], names: Sequence[str], where: str) -> list[int]:
    """Return the numbers of the targets that a constraint applies to; by default all targets with unknown positions.

    `names` are the names of the targets.
    """
    if table.kind == "separation":
        if table.target is not None:
            raise InvalidProblem("a separation has no target", where, "remove the key, and give between")
        if len(motions) < 2:
            advice = "give both targets in one file, with a motion"
            raise InvalidProblem("a separation needs two targets that are fixed together", where, advice)
        return [0]
    if table.target is None:
        free = [i for i, motion in enumerate(motions) if motion.known is None]
        if not free:
            raise InvalidProblem("the motion of each target is known", where, "remove the constraint")
        return free
    place = join(where, "key 'target'")
    if table.target not in names:
        raise InvalidProblem(
            f"no row has the target {table.target!r}", place, nearest(table.target, sorted(set(names)))
        )
    if len(motions) == 1 and len(set(names)) > 1:
        advice = "remove the key, or write one file for each target"
        raise InvalidProblem("free targets are fixed separately, and a constraint applies to all", place, advice)
    return [list(names).index(table.target) if len(motions) > 1 else 0]


def _acting(bands: Sequence[Band], lower: Array, upper: Array) -> Iterator[Band]:
    """Yield bands on one quantity with its greatest `lower` and least `upper` bound, each under its own name."""
    below = next(band for band in bands if band.lower == lower)
    above = next(band for band in bands if band.upper == upper)
    if not np.isfinite(lower) or not np.isfinite(upper) or below.name == above.name:
        yield replace(below if np.isfinite(lower) else above, lower=lower, upper=upper)
        return
    yield replace(below, upper=np.array(np.inf))
    yield replace(above, lower=np.array(-np.inf))


def _merge(limits: Sequence[Limit]) -> Iterator[Limit]:
    """Yield the bounds that act on each quantity, each polygon and each union once, and all fences."""
    constraints = [limit for limit in limits if not isinstance(limit, Fence)]
    # Keep two bands that contradict each other: the check of the problem reports them.
    for bands in bands_by_quantity(constraints):
        if any(np.ndim(bound) for band in bands for bound in (band.lower, band.upper)):
            yield from bands  # a batch of bounds, which a Python argument can state
            continue
        lower, upper = np.max([band.lower for band in bands], axis=0), np.min([band.upper for band in bands], axis=0)
        if np.isnan([lower, upper]).any() or lower >= upper:
            yield replace(bands[0], lower=lower, upper=upper)
        elif np.isfinite(lower) or np.isfinite(upper):
            yield from _acting(bands, lower, upper)
    yield from {(c.target, c.outside, c.vertices.tobytes()): c for c in constraints if isinstance(c, Polygon)}.values()
    yield from {(c.target, str(c.members)): c for c in constraints if isinstance(c, AnyOf)}.values()
    yield from (limit for limit in limits if isinstance(limit, Fence))

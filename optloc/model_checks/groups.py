"""Groups of rows, priors and offsets that can be wrong together, for the search for suspects.

A group is one of four: all rows of a station, one measurement, one prior, or a common offset of all lengths of a kind.
Each group has a penalty, the decrease of the cost that justifies its exclusion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Array, Bias
from optloc.models import MODELS
from optloc.problem.bias import family
from optloc.problem.explanations import GroupKind
from optloc.problem.problem import Problem

KINDS: tuple[GroupKind, ...] = ("station", "row", "prior", "offset")

_GROUP_PENALTY, _COMPONENT_PENALTY = 9.0, 7.0
"""Parts of the penalty of an exclusion: twice the logarithm of odds.

The first part is for the group: odds of a hundred to one that a group has no error. The second part is for each
component of its error: the error is anywhere within a hundred sigma, not at zero (100 / sqrt(2 pi))."""
ROW_PRICE = _GROUP_PENALTY + _COMPONENT_PENALTY
"""Penalty for the exclusion of one row."""


@dataclass(frozen=True, slots=True)
class Group:
    """A set of measurements, a prior or an offset that can be wrong together.

    - name: description for messages.
    - kind: "station", "row", "prior" or "offset".
    - rows: numbers of the present rows of the group; empty for a prior and an offset.
    - prior: number of the prior; -1 for other groups.
    - offset: additional unknown that all lengths of a kind share; no row is excluded then.
    - size: number of components of the error.
    """

    name: str
    kind: GroupKind
    rows: tuple[int, ...]
    prior: int = -1
    offset: Bias | None = None
    size: int = 1

    @property
    def price(self) -> float:
        """Return the penalty: the decrease of the cost at which an error of this group is as likely as no error."""
        return _GROUP_PENALTY + _COMPONENT_PENALTY * self.size


@dataclass(frozen=True, slots=True)
class _Columns:
    """Kind, stations, epoch and target of each of m rows, for the names of rows.

    - kind: kind of each row.
    - a, b (m,): numbers of the stations; -1 if the kind of the row has no station there.
    - epoch, target (m,): numbers of epoch and target.
    - place (m,): number of the row among the rows with equal columns, from 0.
    - alike (m,): number of rows with equal columns.
    """

    kind: list[str]
    a: Array
    b: Array
    epoch: Array
    target: Array
    place: Array
    alike: Array

    @classmethod
    def of(cls, problem: Problem) -> _Columns:
        """Return the columns of all rows of a problem."""
        station_count = [MODELS[rows.kind].stations for rows in problem.rows]
        absent = [np.full(rows.count, -1) for rows in problem.rows]
        kind = [rows.kind for rows in problem.rows for _ in range(rows.count)]
        a = np.concatenate(
            [r.a if n > 0 else missing for r, n, missing in zip(problem.rows, station_count, absent, strict=True)]
        )
        b = np.concatenate(
            [r.b if n > 1 else missing for r, n, missing in zip(problem.rows, station_count, absent, strict=True)]
        )
        epoch, target = problem.epoch, np.concatenate([rows.target for rows in problem.rows])
        kind_number = np.unique(kind, return_inverse=True)[1]
        _, label = np.unique(np.column_stack([kind_number, a, b, epoch, target]), axis=0, return_inverse=True)
        # place: the number of a row among rows with equal columns, so that their names differ
        label, place = label.reshape(-1), np.empty(len(a), dtype=np.int64)
        order, sizes = np.argsort(label, kind="stable"), np.bincount(label)
        # position in the sorted order minus the position of the first equal row
        place[order] = np.arange(len(a)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return cls(kind, a, b, epoch, target, place, sizes[label])


def groups_of(problem: Problem, present: Array, by: Sequence[GroupKind] = KINDS) -> tuple[Group, ...]:
    """Return the groups that can be wrong together, each set of rows once: stations first, then rows, then priors.

    The rows of one target at one epoch by the same stations also form a group, for instance an azimuth and an
    elevation. Common offsets come last. A prior forms a group only if it is on an unknown that all epochs share. A
    station with all rows forms no group: without it no row would remain. `present` (m,) marks the rows that are
    present, and `by` lists the kinds of groups.
    """
    columns, found = _Columns.of(problem), dict[tuple[int, ...], Group]()
    if "station" in by:
        for i, name in enumerate(problem.stations.names):
            rows = _numbers(present & ((columns.a == i) | (columns.b == i)))
            # setdefault: if two groups have the same rows, only the first group is listed
            if rows and len(rows) < present.sum():
                found.setdefault(rows, Group(f"station {name}", "station", rows, size=len(rows)))
    if "row" in by:
        for rows in [*((int(i),) for i in np.flatnonzero(present)), *_sightings(columns, present)]:
            found.setdefault(rows, Group(_row_name(problem, columns, rows), "row", rows, size=len(rows)))
    groups = list(found.values())
    if "prior" in by:
        for j, prior in enumerate(problem.priors):
            slot, shared = problem.layout.find(prior.name)
            if shared:
                groups.append(Group(f"prior of {prior.name}", "prior", (), j, size=slot.size))
    return (*groups, *(_offsets(problem, present) if "offset" in by else ()))


def _offsets(problem: Problem, present: Array) -> Iterator[Group]:
    """Yield a common offset for each kind of length without an emission time and without a bias.

    `present` (m,) marks the present rows; a kind needs more than one of them.
    """
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        own, model = slice(start, start + rows.count), MODELS[rows.kind]
        # differences have no common offset, and rows with a bias already have an offset
        alike = model.ranges is not None and sum(model.ranges) != 0 and not model.emission
        touched = any(np.isin(bias.row, np.arange(start, start + rows.count)).any() for bias in problem.biases)
        if alike and not touched and present[own].sum() > 1:
            name = f"common offset of {rows.kind}"
            yield Group(
                name,
                "offset",
                (),
                offset=family(problem.rows, problem.stations.names, name, per="kind", kind=rows.kind),
            )


def check_kinds(by: str | Sequence[str]) -> tuple[GroupKind, ...]:
    """Return the kinds of groups; raise InvalidProblem if a kind is unknown."""
    wanted = (by,) if isinstance(by, str) else tuple(by)
    for name in wanted:
        if name not in KINDS:
            raise InvalidProblem(f"unknown kind of group {name!r}", "by", nearest(str(name), KINDS))
    if not wanted:
        raise InvalidProblem("no kind of group is given", "by", f"name at least one of {', '.join(KINDS)}")
    return tuple(kind for kind in KINDS if kind in wanted)


def leave_out(problem: Problem, left: Array, others: Sequence[Group] = ()) -> Problem:
    """Return a flat batch of N problems without the rows that `left` (N, m) marks.

    For each group in `others`, the problems lose its prior, or get its offset as an additional unknown.
    """
    weight = np.where(left, 0.0, np.broadcast_to(problem.weight, left.shape))
    dropped = {group.prior for group in others}
    priors = tuple(prior for j, prior in enumerate(problem.priors) if j not in dropped)
    offsets = (group.offset for group in others if group.offset is not None)
    return replace(problem, priors=priors, biases=(*problem.biases, *offsets)).with_rows(weight=weight)


def mark_rows(groups: Sequence[Group], count: int) -> Array:
    """Return a mask (count,) of the rows of some groups."""
    out = np.zeros(count, dtype=bool)
    for group in groups:
        out[list(group.rows)] = True
    return out


def _sightings(columns: _Columns, present: Array) -> list[tuple[int, ...]]:
    """Return sets of several row numbers: rows that the same stations measured of one target at one epoch."""
    keys = np.column_stack([columns.a, columns.b, columns.epoch, columns.target])
    seen = (columns.a >= 0) & present
    _, label = np.unique(keys, axis=0, return_inverse=True)
    order = np.flatnonzero(seen)[np.argsort(label.reshape(-1)[seen], kind="stable")]
    # rows of one label are adjacent now: split where the label changes
    cuts = np.flatnonzero(np.diff(label.reshape(-1)[order])) + 1
    return [tuple(part.tolist()) for part in np.split(order, cuts) if len(part) > 1]


def _row_name(problem: Problem, columns: _Columns, rows: tuple[int, ...]) -> str:
    """Return the description of the rows with the numbers `rows`: kinds, stations, target and epoch.

    All rows are of the same stations. `columns` are the columns of all rows of the problem.
    """
    first, names = rows[0], problem.stations.names
    kinds = " and ".join(dict.fromkeys(columns.kind[i] for i in rows))
    stations = " and ".join(names[int(s)] for s in (columns.a[first], columns.b[first]) if s >= 0)
    name = f"{kinds} of {stations}" if stations else kinds
    if len(rows) == 1 and columns.alike[first] > 1:
        name += f" ({columns.place[first] + 1} of {columns.alike[first]})"
    name += f", target {columns.target[first]}" if len(problem.motions) > 1 else ""
    return name + (f", epoch {columns.epoch[first]}" if problem.epochs > 1 else "")


def _numbers(inside: Array) -> tuple[int, ...]:
    """Return the indices at which a mask is True."""
    return tuple(np.flatnonzero(inside).tolist())

"""The order in which rows are evaluated, and the unknowns that each group of them touches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.kernels.trace import Traced
from optloc.plan import Plan, Terms
from optloc.problem import Problem
from optloc.types import Array

# Rows whose derivatives are at hand together: about this many numbers a lane, so that they stay in the cache.
_NUMBERS, _MOST, _LEAST = 512, 128, 8


def starts(counts: Any) -> Array:
    """Return where each of several parts of given lengths begins, and the end."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Groups:
    """Groups of correlated rows in the order of their epochs.

    Parameters
    ----------
    of : int array (m,)
        Group of each row of the problem.
    member : int array (m,)
        Its place in the group.
    size, epoch : int array (g,)
        Rows of each group, and the epoch of its first.
    number : int array (g,)
        Which of the groups handed in each is, counted through all of them.
    """

    of: Array
    member: Array
    size: Array
    epoch: Array
    number: Array

    @classmethod
    def sorted(cls, problem: Problem, groups: tuple[Array, ...]) -> Groups:
        """Return the groups (g, r) of a problem, sorted."""
        rows = np.concatenate([group.ravel() for group in groups])
        size = np.concatenate([np.full(len(group), group.shape[1]) for group in groups])
        head = starts(size)[:-1]
        epoch = problem.epoch[rows[head]]
        number = np.argsort(epoch, kind="stable")
        rank = np.empty_like(number)
        rank[number] = np.arange(len(number))
        of, member = np.full(problem.count, -1), np.zeros(problem.count, dtype=np.int64)
        of[rows] = np.repeat(rank, size)
        member[rows] = np.arange(len(rows)) - np.repeat(head, size)
        return cls(of, member, size[number], epoch[number], number)


@dataclass(frozen=True, slots=True)
class Entries:
    """Which unknown moves what: one entry for each, rows counted through the problem.

    Parameters
    ----------
    row, column : int array (n,)
        Row, and column of the full parameter vector.
    factor : array (n,)
        How strongly.
    place : int array (n,)
        Which input of the row's kind; zero where it acts on the measurement itself.
    """

    row: Array
    column: Array
    factor: Array
    place: Array

    @classmethod
    def joined(cls, parts: list[Entries]) -> Entries:
        """Return the entries of several."""
        none = np.zeros(0, dtype=np.int64)
        parts = [cls(none, none, np.zeros(0), none), *parts]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__))

    @classmethod
    def terms(cls, terms: Terms, start: int) -> Entries:
        """Return those of linear terms of a block whose first row has a given number."""
        return cls(start + terms.row, terms.column, terms.coefficient, np.zeros_like(terms.row))

    @classmethod
    def feeds(cls, plan: Plan, trace: Traced, start: int) -> Entries:
        """Return those of the inputs of a block that its function needs."""
        place, parts = {seed: i for i, (seed, _) in enumerate(trace.tape.inputs)}, []
        for feed in plan.feeds:
            if feed.seed in place:
                rows = np.arange(plan.block.count)[feed.rows]
                gain = np.broadcast_to(np.asarray(feed.gain, dtype=float), rows.shape)
                parts.append(cls(start + rows, feed.column, gain, np.full(rows.shape, place[feed.seed])))
        return cls.joined(parts)


@dataclass(frozen=True, slots=True)
class Columns:
    """The unknowns that each group touches: shared ones, then the local ones of its epoch.

    Parameters
    ----------
    column : int array (c,)
        Of all groups, one after the other, ascending in each.
    at : int array (g + 1,)
        Where each group begins.
    """

    column: Array
    at: Array

    @classmethod
    def of(cls, problem: Problem, groups: Groups, entries: list[Entries]) -> tuple[Columns, list[Array]]:
        """Return the columns, and the place of each entry among those of its group."""
        n, length = problem.layout.n_shared, problem.layout.n_local
        keys = []
        for part in entries:
            folded = np.where(part.column < n, part.column, n + (part.column - n) % max(length, 1))
            keys.append(groups.of[part.row] * (n + length) + folded)
        found, place = np.unique(np.concatenate(keys), return_inverse=True)
        at = np.searchsorted(found, np.arange(len(groups.size) + 1) * (n + length))
        slots = place - at[np.concatenate(keys) // (n + length)]
        return cls(found % (n + length), at), np.split(slots, starts([len(key) for key in keys])[1:-1])


@dataclass(frozen=True, slots=True)
class Order:
    """The order of evaluation: packets of groups, and in each packet its rows kind by kind.

    Parameters
    ----------
    row : int array (m,)
        Number in the problem of each row evaluated.
    at : int array (m,)
        When each row of the problem is evaluated.
    place : int array (m,)
        Place of each row evaluated among those of its packet; rows of a group follow each other there.
    packet_group : int array (p + 1,)
        First group of each packet.
    packet_row : int array (p, q + 1)
        First row evaluated of each kind in each packet.
    """

    row: Array
    at: Array
    place: Array
    packet_group: Array
    packet_row: Array

    @classmethod
    def of(cls, problem: Problem, groups: Groups, width: int) -> Order:
        """Return the order for groups whose rows have a number of columns at most."""
        limit = int(np.clip(_NUMBERS // width, _LEAST, _MOST))
        first = starts(groups.size)
        packet = np.unique(first[:-1] // limit, return_inverse=True)[1]
        packets, kinds = int(packet[-1]) + 1, len(problem.rows)
        packet_group = np.searchsorted(packet, np.arange(packets + 1))
        kind = np.repeat(np.arange(kinds), [rows.count for rows in problem.rows])
        place = first[groups.of] + groups.member
        mine = packet[groups.of]
        row = np.lexsort((place, kind, mine))
        at = np.empty_like(row)
        at[row] = np.arange(len(row))
        counts = np.bincount(mine * kinds + kind, minlength=packets * kinds)
        begin = starts(counts)[np.arange(packets)[:, None] * kinds + np.arange(kinds + 1)]
        return cls(row, at, (place - first[packet_group[mine]])[row], packet_group, begin)

"""Least-squares ranges: a sufficient statistic of all rows that are linear in ranges.

Rows z = D r + n (range, tdoa, toa, range_sum; D contains 0 and +-1) connect stations into a graph. In each connected
group, the ranges that fit best are r = c + sign * t: known (t = 0), or known up to one unknown t, the range to a
reference station. c and its covariance contain all information of these rows.

A *node* is an unknown of the rows: the range to a station at an epoch, or an emission time. Letters: N problems, m
rows, q nodes, the first s of which are ranges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Rows
from optloc.models import MODELS
from optloc.problem.noise import Block, Noise, whiten
from optloc.problem.problem import Problem

# Eigenvalue, as a share of the largest, that counts as zero. D contains 0 and +-1, so that the least eigenvalue on a
# chain of s stations is about 1 / s^2, and rounding is 1e-15.
_SINGULAR = 1e-9
# Number of cached graphs, of some kilobytes each: a batch repeats the graph for each set of rows that is left out.
_GRAPHS = 4096


@dataclass(frozen=True, slots=True)
class Graph:
    """The connections of stations by the present range rows.

    Parameters
    ----------
    members : tuple of int array
        Stations of each connected group, as nodes; nodes are (station, epoch), then emission times.
    inside : bool array (s,)
        Whether a node belongs to the main group, which has the most stations.
    sign : int array (s,)
        Sign of the range to the reference in a node's range; 0 if the node's range is determined.
    reference : int
        First node of the main group; 0 if there is none.
    pinned : bool array (q,)
        Nodes that are not unknowns of the least-squares problem: absent nodes, and one node of each free group.
    """

    members: tuple[Array, ...]
    inside: Array
    sign: Array
    reference: int
    pinned: Array


@dataclass(frozen=True, slots=True)
class Ranges:
    """Least-squares ranges of a flat batch of problems, r = c + sign * t in the main group of each problem.

    Parameters
    ----------
    station, epoch : int array (s,)
        Station and epoch of each node; the epoch is 0 if stations do not move.
    inside : bool array (N, s)
        Whether a node belongs to the main group of its problem.
    sign : int array (N, s)
        +1, -1, or 0 if the range is determined.
    reference : int array (N,)
        Node whose range is t.
    offset : array (N, s)
        c, metres.
    covariance : array (N or 1, s, s)
        Covariance of c, m^2; identity rows for nodes without a range.
    cost : array (N,)
        Weighted squared misfit of the loops: chi-square of redundant rows.
    groups : tuple of tuple of tuple of int
        The stations of each group, for each distinct pattern of present rows.
    pattern : int array (N,)
        Pattern of each problem.
    """

    station: Array
    epoch: Array
    inside: Array
    sign: Array
    reference: Array
    offset: Array
    covariance: Array
    cost: Array
    groups: tuple[tuple[tuple[int, ...], ...], ...]
    pattern: Array

    @property
    def free(self) -> Array:
        """Return whether the ranges of a problem are known only up to their common unknown, (N,)."""
        return np.asarray((self.sign != 0).any(-1))


def ranges(problem: Problem) -> Ranges | None:
    """Return the least-squares ranges of a flat batch of problems, or None if no row is linear in ranges.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems with one target.
    """
    design, station, epoch = _design(problem)
    if not len(station):
        return None
    weight = np.broadcast_to(problem.weight, (*problem.batch_shape, problem.count))
    # rows of other kinds are not in D
    used = np.any(design != 0.0, axis=1)
    present = weight[:, used] > 0.0
    patterns, pattern = _patterns(present)
    rows, count = design[used], len(station)
    graphs = [_graph(rows[own].tobytes(), rows.shape[1], count) for own in patterns]
    parts = ("inside", "sign", "reference", "pinned")
    inside, sign, reference, pinned = (np.array([getattr(g, part) for g in graphs])[pattern] for part in parts)
    groups = tuple(tuple(tuple(int(station[n]) for n in nodes) for nodes in graph.members) for graph in graphs)
    offset, covariance, cost = _least_squares(problem, design, pinned)
    s = len(station)
    # emission times are the nodes after the stations, and are not part of the result
    known = covariance[:, :s, :s]
    return Ranges(station, epoch, inside, sign, reference, offset[:, :s], known, cost, groups, pattern)


def reduce(problem: Problem) -> Problem:
    """Return the problem with all rows that are linear in ranges replaced by their sufficient statistic.

    Redundant differences around a ring of s stations become s - 1 differences to one reference with their full
    covariance. The same applies to range sums and arrival times. Rows that determine the ranges become ranges. The fix
    is the same.

    Parameters
    ----------
    problem : Problem
        One target, without biases; one epoch, or target and stations at rest.

    Returns
    -------
    Problem
        First the reduced rows, then the unchanged rows of other kinds.

    Raises
    ------
    InvalidProblem
        If the rows form groups without a common station, or different problems have different present rows. Also if
        rows belong to several targets or to a bias, or if their noise is correlated with other kinds.
    """
    _check(problem)
    found = ranges(problem.flat())
    if found is None:
        return problem
    if len(found.groups) > 1 or len(found.groups[0]) > 1:
        raise InvalidProblem(
            "the range rows do not form one connected set", "reduce", "reduce connected problems one by one"
        )
    kept = [i for i, rows in enumerate(problem.rows) if MODELS[rows.kind].ranges is None]
    parts = [np.arange(start, start + rows.count) for rows, start in zip(problem.rows, problem.starts, strict=True)]
    others = np.concatenate([parts[i] for i in kept] or [np.zeros(0, dtype=np.int64)])
    blocks = _keep_noise(problem.noise, others)
    rows, covariance = _reduced_rows(found, problem.batch_shape)
    count = sum(r.count for r in rows)
    shift = np.full(problem.count, -1)
    shift[others] = count + np.arange(len(others))
    noise = Noise((Block(np.arange(count)[None], covariance), *(Block(shift[b.row], b.covariance) for b in blocks)))
    return replace(problem, rows=(*rows, *(problem.rows[i] for i in kept)), noise=noise)


def _check(problem: Problem) -> None:
    """Raise `InvalidProblem` if the rows cannot be reduced: several targets, or biases."""
    if len(problem.motions) > 1:
        raise InvalidProblem("there are several targets", "reduce", "reduce the rows of one target")
    if problem.biases:
        name = problem.biases[0].name
        raise InvalidProblem(
            f"the bias {name!r} belongs to range rows, which reduce replaces", "reduce", "solve the problem unreduced"
        )


def _keep_noise(noise: Noise, others: Array) -> list[Block]:
    """Return the noise blocks of the rows `others`, which stay.

    `InvalidProblem` is raised if noise correlates them with range rows.
    """
    blocks = []
    for block in noise.blocks:
        stays = np.isin(block.row, others)
        whole = stays.all(1)
        if (stays.any(1) != whole).any():
            raise InvalidProblem("range rows are correlated with other kinds", "reduce", "solve the problem unreduced")
        if whole.any():
            covariance = block.covariance[..., whole, :, :] if block.covariance.shape[-3] > 1 else block.covariance
            blocks.append(Block(block.row[whole], covariance))
    return blocks


def _reduced_rows(found: Ranges, shape: tuple[int, ...]) -> tuple[list[Rows], Array]:
    """Return range, tdoa and range_sum rows with the ranges in `found`, and their joint covariance.

    `shape` contains the batch axes of the rows. The kind depends on the sign of t: a range without t, a difference for
    a plus, and a sum for a minus.
    """
    free, reference = bool(found.free[0]), int(found.reference[0])
    nodes = [n for n in np.flatnonzero(found.inside[0]) if not (free and n == reference)]
    # r_i = c_i + t is a difference to the reference, r_i = c_i - t a sum with the reference
    kinds = ["range" if not free else "tdoa" if found.sign[0, n] > 0 else "range_sum" for n in nodes]
    order, rows = [], []
    for kind in dict.fromkeys(kinds):
        own = np.array([n for n, k in zip(nodes, kinds, strict=True) if k == kind])
        order.extend(own.tolist())
        other = np.full(len(own), found.station[reference]) if free else np.full(len(own), -1)
        z = found.offset[:, own].reshape(*shape, len(own))
        one = np.ones(len(own))
        rows.append(Rows(kind, z, found.station[own], other, found.epoch[own], np.zeros_like(own), one, 0.0 * one))
    covariance = found.covariance[:, None, order][..., order]
    return rows, covariance[0] if len(covariance) == 1 else covariance.reshape(*shape, *covariance.shape[1:])


def _patterns(present: Array) -> tuple[Array, Array]:
    """Return the distinct rows of a mask (N, m), and for each problem (N,) the number of its row."""
    # the usual case of one pattern needs no sort
    if present.all() or (present == present[:1]).all():
        return present[:1], np.zeros(len(present), dtype=int)
    patterns, pattern = np.unique(present, axis=0, return_inverse=True)
    return patterns, pattern.reshape(-1)


def _stays(problem: Problem) -> bool:
    """Return whether all targets are at rest for the run."""
    return all(motion.order == 0 and motion.span == "run" for motion in problem.motions)


def _design(problem: Problem) -> tuple[Array, Array, Array]:
    """Return D (m, q), and station and epoch (s,) of the nodes that are ranges."""
    moving = problem.stations.position.shape[-3] > 1 or (problem.epochs > 1 and not _stays(problem))
    # (row, node, coefficient); a node is (0, station, epoch) for a range, or (1, target, epoch) for an emission time,
    # so that the sort below puts the ranges first
    entries: list[tuple[int, tuple[int, int, int], float]] = []
    coefficient: float
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        model = MODELS[rows.kind]
        if model.ranges is None:
            continue
        # between stations and a target at rest, the range is the same at all epochs
        when = rows.epoch if moving else np.zeros_like(rows.epoch)
        for i in range(rows.count):
            for index, coefficient in zip((rows.a[i], rows.b[i]), model.ranges, strict=True):
                if coefficient:
                    entries.append((start + i, (0, int(index), int(when[i])), coefficient))
            if model.emission:
                entries.append((start + i, (1, int(rows.target[i]), int(rows.epoch[i])), 1.0))
    nodes = sorted({node for _, node, _ in entries})
    place = {node: i for i, node in enumerate(nodes)}
    design = np.zeros((problem.count, len(nodes)))
    for row, node, coefficient in entries:
        design[row, place[node]] += coefficient
    stations = [node for node in nodes if node[0] == 0]
    return design, np.array([n[1] for n in stations], dtype=int), np.array([n[2] for n in stations], dtype=int)


@lru_cache(maxsize=_GRAPHS)
def _graph(rows: bytes, count: int, stations: int) -> Graph:
    """Return the graph of the nodes.

    `rows` are the bytes of the present rows of D. `count` is the number q of nodes; the first `stations` nodes are
    ranges. Bytes are hashable, so that graphs are cached.
    """
    group, sign = _connect(np.frombuffer(rows).reshape(-1, count))
    names = np.unique(group[group >= 0])  # numbers of the groups
    members = tuple(np.flatnonzero(group[:stations] == name) for name in names)
    # The group with most stations; of equal groups the first, so that the same rows always give the same group.
    main = max(range(len(names)), key=lambda i: (len(members[i]), -i)) if len(names) else -1
    inside = (group == names[main])[:stations] if len(names) else np.zeros(stations, dtype=bool)
    reference = int(np.flatnonzero(inside)[0]) if inside.any() else 0
    pinned = group < 0
    for name in np.unique(group[sign != 0]):
        nodes = np.flatnonzero(group == name)
        pinned[reference if main >= 0 and name == names[main] and group[reference] == name else nodes[0]] = True
    # the sign of the reference itself is plus
    own = np.where(inside, sign[:stations], 0)
    return Graph(members, inside, own * (own[reference] or 1), reference, pinned)


def _connect(design: Array) -> tuple[Array, Array]:
    """Return the group of each node (q,), and the sign (q,) of the group's unknown t in the node's value.

    The group is the number of its first node. It is -1 for nodes without rows, and q for all nodes whose values are
    determined. The sign of these nodes is 0. `design` (rows, q) is D.
    """
    count = design.shape[1]
    # nodes that share a row; signs do not matter
    linked = (np.abs(design).T @ np.abs(design)) > 0.0
    group = np.full(count, -1)
    for node in range(count):
        if group[node] < 0 and linked[node, node]:
            reach = np.zeros(count, dtype=bool)
            reach[node] = True
            while True:
                wider = np.asarray(linked[reach].any(0))
                if (wider == reach).all():
                    break
                reach = wider
            group[reach] = node
    sign, determined = np.zeros(count, dtype=int), np.zeros(count, dtype=bool)
    for name in np.unique(group[group >= 0]):
        nodes = np.flatnonzero(group == name)
        # the null vector of the rows of a group is its unknown t; the graph is connected, so there is at most one
        inner = design[:, nodes]
        values, vectors = np.linalg.eigh(inner.T @ inner)
        if values[0] < _SINGULAR * max(values[-1], 1.0):
            # the null vector contains +-1 / sqrt(n); signs are relative to the largest entry, because of rounding
            sign[nodes] = np.sign(vectors[:, 0] * vectors[np.argmax(np.abs(vectors[:, 0])), 0]).astype(int)
        else:
            determined[nodes] = True
    group[determined] = count  # known ranges form one group, whether connected or not
    return group, sign


def _least_squares(problem: Problem, design: Array, pinned: Array) -> tuple[Array, Array, Array]:
    """Return the values of all nodes (N, q), metres, their covariance (N or 1, q, q), m^2, and the misfit (N,).

    `design` (m, q) is D; rows of other kinds are zero there and are not used. `pinned` (N, q) marks nodes whose value
    is set to zero. The misfit is the chi-square of the redundant rows.
    """
    q = design.shape[1]
    used = np.any(design != 0.0, axis=1)
    z = np.where(used & (problem.weight > 0.0), problem.observed, 0.0)[..., None]
    information, vector, total = np.zeros((1, q, q)), np.zeros((1, q, 1)), np.zeros((1, 1, 1))
    for whitener in whiten(problem.noise, problem.weight):
        white, seen = whitener.apply(design), whitener.apply(z)
        transposed = np.swapaxes(white, -1, -2)
        information = information + transposed @ white
        vector = vector + transposed @ seen
        total = total + np.swapaxes(seen, -1, -2) @ seen
    # one pattern of present rows: one inverse is enough for the batch
    held = pinned[:1] if (pinned == pinned[:1]).all() else pinned
    # pinned nodes have 1 on the diagonal, so that their value is zero and the other nodes are inverted without them
    information = np.where(held[:, :, None] | held[:, None, :], 0.0, information) + held[:, :, None] * np.eye(q)
    covariance, _ = linalg.inverse(information)
    offset = (covariance @ np.where(held[..., None], 0.0, vector))[..., 0]
    cost = total[..., 0, 0] - (offset * vector[..., 0]).sum(-1)
    return np.broadcast_to(offset, (len(pinned), q)), covariance, np.broadcast_to(cost, (len(pinned),))

"""The errors and offsets of many small problems, linearised at their fixes and packed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Array
from optloc.linear.constraints import exact, tangent_at
from optloc.linear.evaluate import differentiate
from optloc.linear.normal import prior_parts, with_station_noise
from optloc.models import MODELS
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.layout import emission_name
from optloc.problem.noise import Block, gathered, variances
from optloc.problem.problem import Problem

By = Literal["station", "pair", "kind"]
GROUPINGS = ("station", "pair", "kind")
# Difference of two covariances, as a share of the largest entry, below which they are the same: files round theirs.
_FITS = 1e-6
# Rows of one problem that can be handled: their m x m matrices take 32 MB each at this number.
_LARGEST = 2000
# Problems that are linearised at once, so that the matrices of a part, most with tens of rows, fit into memory.
_PART = 2000
# Eigenvalue of the normal matrix of variances, as a share of the largest, below which a combination of them is not
# seen.
_UNSEEN = 1e-10


@dataclass(frozen=True, slots=True)
class Elements:
    """N linearised problems with their rows, errors and offsets packed; whatever is not there is zero.

    Parameters
    ----------
    names : tuple of G str
        Groups.
    residual : array (N, m)
        Measured less modelled.
    jacobian : array (N, m, p)
        Derivative with respect to the unknowns.
    effect : array (N, m, q)
        B: effect of each error of unit variance, in the rows' units.
    offset : array (N, m, c)
        E: effect of an offset of each group.
    fixed : array (N, m, m)
        C: covariance that belongs to no group.
    sigma : array (N, q)
        Stated standard deviation of each error, in the rows' units.
    of_effect, of_offset : int array (N, q), (N, c)
        Groups; -1 for none.
    path : array (N, c)
        Length of the path to a station, metres, on average over the rows of an offset; NaN where it is not one.
    """

    names: tuple[str, ...]
    residual: Array
    jacobian: Array
    effect: Array
    offset: Array
    fixed: Array
    sigma: Array
    of_effect: Array
    of_offset: Array
    path: Array

    @property
    def common(self) -> Array:
        """Return which groups (G + 1,) are what rows have in common; the last stands for none."""
        shared = [common_name(name) for name in self.names]
        return np.append(np.isin(np.array(self.names, dtype=object), shared), False)

    def take(self, index: Any) -> Elements:
        """Return some of the problems."""
        arrays = ("residual", "jacobian", "effect", "offset", "fixed", "sigma", "of_effect", "of_offset", "path")
        return replace(self, **{name: getattr(self, name)[index] for name in arrays})


def batch_of(problem: Problem) -> Problem:
    """Return the independent problems that a problem consists of as a flat batch, station errors of epochs as noise.

    Raises
    ------
    InvalidProblem
        Where more rows than can be handled share unknowns.
    """
    problem = replace(problem, stations=problem.stations.with_noise())
    flat = (by_epoch(problem) if separable(problem) else problem).flat()
    if flat.count > _LARGEST and flat.epochs > 1:
        what = f"{flat.count} rows share unknowns"
        raise InvalidProblem(what, "noise", f"use at most {_LARGEST}, or epochs that are fixed one by one")
    return flat


def elements(problem: Problem, x: Array, by: By, common: By | None = None) -> Elements:
    """Return the elements of a flat batch of problems at parameter vectors.

    Parameters
    ----------
    problem : Problem
        N problems, of `batch_of`.
    x : array (N, size)
        Their fixes, finite.
    by : "station", "pair" or "kind"
        What makes a group.
    common : "station", "pair" or "kind", optional
        Whose rows have an error in common in every epoch besides: a group of its own, named as `common_name` says, of
        which the noise states nothing; its sigma is that of `typical_sigma`.
    """
    ends = ends_of(problem, by)
    names = sorted({*ends.name.ravel().tolist()} - {""})
    size = typical_sigma(problem, common) if common else {}
    parts = []
    for first in range(0, len(x), _PART):
        items = np.arange(first, min(first + _PART, len(x)))
        parts.append(_part(problem.take(items), x[items], by, (common, size)))
    more = sorted({name for part in parts for name in part.names} - set(names))
    return _join((*names, *more), parts)


def _part(problem: Problem, x: Array, by: By, common: tuple[By | None, dict[str, float]]) -> Elements:
    count, rows = len(x), problem.count
    present = np.broadcast_to(problem.weight > 0.0, (count, rows))
    residual, jacobian = _linearise(problem, x)
    effect, error_names, sigma = _effects(problem, by, present)
    shared_by, sizes = common
    if shared_by:
        more, more_names, size = common_effects(problem, shared_by, sizes)
        effect = np.concatenate([effect, np.broadcast_to(more, (count, *more.shape))], axis=-1)
        sigma = np.concatenate([sigma, np.broadcast_to(size, (count, len(size)))], axis=-1)
        error_names = np.concatenate([error_names, more_names])
    offset, offset_names = _offsets(problem, by)
    names = tuple(sorted({*error_names.tolist(), *offset_names.tolist()} - {""}))
    number = {name: i for i, name in enumerate(names)} | {"": -1}
    path = np.broadcast_to(_paths(problem, x, residual), present.shape)
    # Absent rows go: problems of one station less do not need the room of all stations.
    kept = _present_first(present)
    residual, present_packed = (np.take_along_axis(a, kept, 1) for a in (residual, present))
    jacobian, effect, offset = (
        np.take_along_axis(a, kept[..., None], 1) * present_packed[..., None]
        for a in (jacobian, effect, np.broadcast_to(offset, (count, *offset.shape)))
    )
    fixed = _ungrouped_noise(problem, x)
    fixed = np.take_along_axis(np.take_along_axis(fixed, kept[..., None], 1), kept[:, None], 2)
    fixed = fixed * (present_packed[..., :, None] & present_packed[..., None, :])
    effect, of_effect, chosen = _pack(effect, np.array([number[n] for n in error_names], dtype=np.int64))
    sigma = np.take_along_axis(sigma, chosen, 1)
    offset, of_offset, _ = _pack(offset, np.array([number[n] for n in offset_names], dtype=np.int64))
    path = np.take_along_axis(path, kept, 1)[..., None]
    # The growth of an offset is told per metre of path: of several rows their mean path.
    mean = np.where(offset != 0.0, path, 0.0).sum(1) / np.maximum((offset != 0.0).sum(1), 1)
    made = Elements(
        names, residual * present_packed, jacobian, effect, offset, fixed, sigma, of_effect, of_offset, mean
    )
    return _with_priors(problem, x, made)


def _linearise(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return residuals (N, m) and Jacobians (N, m, p) along what equality constraints leave free."""
    residual, jacobian = differentiate(problem, x)
    if problem.epochs > 1 and problem.layout.n_local:
        n, length = problem.layout.n_shared, problem.layout.n_local
        # Jacobians come with the local unknowns of their own epoch only; here each epoch has columns of its own.
        spread = np.zeros((*residual.shape, problem.layout.size))
        spread[..., :n] = jacobian[..., :n]
        rows = np.arange(problem.count)[:, None]
        columns = n + problem.epoch[:, None] * length + np.arange(length)
        spread[..., rows, columns] = jacobian[..., n:]
        jacobian = spread
    face = exact(problem)
    if face:
        # What an equality holds is no unknown: one column less for each.
        along, n = tangent_at(problem, face, x), problem.layout.n_shared
        jacobian = np.concatenate([jacobian[..., :n] @ along, jacobian[..., n:]], axis=-1)
    return residual, jacobian


def _paths(problem: Problem, x: Array, residual: Array) -> Array:
    """Return the modelled path (N, m) from target to station of rows that measure one; NaN of others."""
    parts, start = [], 0
    for rows in problem.rows:
        model = MODELS[rows.kind]
        # What is modelled is what was measured less the residual: h need not be evaluated again.
        path = rows.z - rows.correction - residual[..., start : start + rows.count]
        if model.ranges != (1, 0):
            path = np.full_like(path, np.nan)
        elif model.emission:
            late = [
                problem.layout.take(x, emission_name(int(t), len(problem.motions)))[:, :, 0] for t in problem.emitting
            ]
            place = np.searchsorted(problem.emitting, rows.target)
            path = path - np.stack(late, axis=1)[:, place, rows.epoch]
        parts.append(path)
        start += rows.count
    return np.concatenate(parts, axis=-1)


def _effects(problem: Problem, by: By, present: Array) -> tuple[Array, Array, Array]:
    """Return the effects (N, m, Q) of all errors, their groups (Q,) and standard deviations (N, Q)."""
    count, rows = present.shape
    effects, names, sigmas = [], [], []
    for block in problem.noise.blocks:
        own, name, sigma = split(problem, block, by, present)
        own = np.broadcast_to(own, (count, len(block.row), *own.shape[-2:]))
        g, _r, q = own.shape[1:]
        # Blocks stand side by side: each group of a block has columns of its own over all rows.
        wide = np.zeros((count, rows, g, q))
        wide[:, block.row, np.arange(g)[:, None]] = own
        effects.append(wide.reshape(count, rows, g * q))
        names.append(name.reshape(-1))
        sigmas.append(np.broadcast_to(sigma, (count, g, q)).reshape(count, g * q))
    return np.concatenate(effects, axis=-1), np.concatenate(names), np.concatenate(sigmas, axis=-1)


def _offsets(problem: Problem, by: By) -> tuple[Array, Array]:
    """Return the effects (m, c) of offsets of groups, and their names (c,)."""
    ends = ends_of(problem, by)
    names = np.array(sorted({*ends.name.ravel().tolist()} - {""}), dtype=object)
    return ((ends.name[..., None] == names) * ends.sign[..., None]).sum(1), names


def common_name(name: str) -> str:
    """Return the name of the error that all rows of a group have in common in an epoch."""
    return f"{name} common"


def typical_sigma(problem: Problem, by: By) -> dict[str, float]:
    """Return the stated standard deviation of the rows of each group, root mean square over all problems."""
    variance = np.broadcast_to(variances(problem.noise, problem.count), (problem.batch_shape[0], problem.count))
    weight, ends = np.broadcast_to(problem.weight > 0.0, variance.shape), ends_of(problem, by).name
    found = {}
    for name in sorted({*ends.ravel().tolist()} - {""}):
        own = weight & (ends == name).any(1)
        if own.any():
            found[name] = float(np.sqrt(variance[own].mean()))
    return found


def common_effects(problem: Problem, by: By, size: dict[str, float]) -> tuple[Array, Array, Array]:
    """Return the effects (m, c) of errors that the rows of a group have in common in an epoch, names and sizes (c,)."""
    ends, epoch = ends_of(problem, by), problem.epoch
    columns, names = [], []
    for name, own in size.items():
        sign = np.where(ends.name == name, ends.sign, 0.0).sum(1)
        for k in np.unique(epoch[sign != 0.0]):
            columns.append(np.where(epoch == k, sign, 0.0) * own)
            names.append(name)
    sizes = np.array([size[name] for name in names])
    return np.stack(columns, axis=-1), np.array([common_name(name) for name in names], dtype=object), sizes


def _ungrouped_noise(problem: Problem, x: Array) -> Array:
    """Return the covariance (N, m, m) that station errors and weights between 0 and 1 add to the noise."""
    rows = np.arange(problem.count)[None]
    stated = gathered(problem.noise, rows)[..., 0, :, :]
    whole = gathered(with_station_noise(problem, x).noise, rows)[..., 0, :, :]
    weight = np.where(problem.weight > 0.0, problem.weight, 1.0)
    # A row of weight w has 1/w of its variance: the rest belongs to no group.
    own = (1.0 / weight - 1.0) * np.diagonal(whole, axis1=-2, axis2=-1)
    added = whole - stated + own[..., None] * np.eye(problem.count)
    return np.broadcast_to(added, (len(x), *added.shape[-2:]))


def _present_first(present: Array) -> Array:
    """Return the rows (N, most) of each problem, those that are present first."""
    most = max(1, int(present.sum(1).max(initial=0)))
    return np.argsort(~present, axis=1, kind="stable")[:, :most]


def _pack(columns: Array, number: Array) -> tuple[Array, Array, Array]:
    """Return the columns (N, m, q) that are not zero, their groups (N, q), -1 for zeros, and which they are (N, q)."""
    used = (columns != 0.0).any(1)
    kept = _present_first(used)
    group = np.where(np.take_along_axis(used, kept, 1), number[kept], -1)
    return np.take_along_axis(columns, kept[:, None], 2), group, kept


def _with_priors(problem: Problem, x: Array, made: Elements) -> Elements:
    """Return the elements with the priors of a problem as rows that belong to no group."""
    # On a tangent space the columns of the prior are not unit vectors; the equality says more than it, too.
    parts = [] if exact(problem) else prior_parts(problem)
    for name, mean, precision in parts:
        slot, shared = problem.layout.find(name)
        start = slot.start if shared else problem.layout.n_shared + slot.start
        columns = start + np.arange(slot.size)
        more = np.zeros((len(x), slot.size, made.jacobian.shape[-1]))
        more[:, np.arange(slot.size), columns] = 1.0
        covariance, _ = linalg.inverse(np.broadcast_to(precision, (len(x), slot.size, slot.size)))
        error = np.broadcast_to(mean, (len(x), slot.size)) - x[:, columns]
        n, m = made.residual.shape
        fixed = np.zeros((n, m + slot.size, m + slot.size))
        fixed[:, :m, :m], fixed[:, m:, m:] = made.fixed, covariance
        # A prior has no errors of a group and no offsets: its rows are zero there.
        below = ((0, 0), (0, slot.size), (0, 0))
        made = replace(
            made,
            residual=np.concatenate([made.residual, error], axis=1),
            jacobian=np.concatenate([made.jacobian, more], axis=1),
            effect=np.pad(made.effect, below),
            offset=np.pad(made.offset, below),
            fixed=fixed,
        )
    return made


def _join(names: tuple[str, ...], parts: list[Elements]) -> Elements:
    """Return parts as one, with groups numbered alike and arrays padded to one size."""
    renamed = []
    for part in parts:
        # -1, no group, stays -1: it is the last entry.
        number = np.array([*(names.index(name) for name in part.names), -1])
        renamed.append(replace(part, of_effect=number[part.of_effect], of_offset=number[part.of_offset]))

    def stack(name: str, fill: float = 0.0) -> Array:
        arrays = [getattr(part, name) for part in renamed]
        shape = np.max([a.shape for a in arrays], axis=0)
        room = [[(0, 0), *((0, int(n) - k) for n, k in zip(shape[1:], a.shape[1:], strict=True))] for a in arrays]
        return np.concatenate([np.pad(a, gap, constant_values=fill) for a, gap in zip(arrays, room, strict=True)])

    joined = {name: stack(name) for name in ("residual", "jacobian", "effect", "offset", "fixed", "sigma", "path")}
    return Elements(names, **joined, of_effect=stack("of_effect", -1), of_offset=stack("of_offset", -1))


# Which group of errors each row belongs to, and its noise as independent errors of such groups.


@dataclass(frozen=True, slots=True)
class Ends:
    """The groups that each row belongs to: one, or one at either of its stations.

    Parameters
    ----------
    name : object array (m, 2)
        Names of the groups; empty where there is none.
    sign : array (m, 2)
        Sign with which an offset of the group enters the row; 0 where there is none.
    """

    name: Array
    sign: Array


def ends_of(problem: Problem, by: By) -> Ends:
    """Return the groups of the rows of a problem.

    Parameters
    ----------
    problem : Problem
        Rows and names of stations.
    by : "station", "pair" or "kind"
        A group is a station (with a kind where stations measure several), a pair of stations, or a kind of rows.

    Raises
    ------
    InvalidProblem
        For an unknown grouping.
    """
    if by not in GROUPINGS:
        raise InvalidProblem(f"unknown grouping {by!r}", "by", nearest(str(by), GROUPINGS))
    parts = [_ends(problem, rows.kind, rows.a, rows.b, by) for rows in problem.rows]
    # Errors of compass bearings are clockwise; those of a group that is read both ways are anticlockwise.
    blocks = list(zip(problem.rows, parts, strict=True))
    others = [name for rows, (name, _) in blocks if rows.kind == "azimuth" and rows.sense > 0.0]
    both = list({text for name in others for text in name.ravel().tolist()})
    parts = [(name, np.where(np.isin(name, both), sign, rows.sense * sign)) for rows, (name, sign) in blocks]
    return Ends(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _ends(problem: Problem, kind: str, a: Array, b: Array, by: By) -> tuple[Array, Array]:
    name, sign = np.full((len(a), 2), "", dtype=object), np.zeros((len(a), 2))
    model = MODELS[kind]
    if by == "kind" or model.stations == 0:
        name[:, 0], sign[:, 0] = kind, 1.0
    elif by == "pair" and model.stations == 2:
        # A-B and B-A are one pair, with the sign of its offset turned; names as the file has them where that is not
        # needed.
        turned = (a > b) if _both_ways(a, b) else np.zeros(len(a), dtype=bool)
        one, two = np.where(turned, b, a), np.where(turned, a, b)
        labels = np.array(problem.stations.names, dtype=object)
        name[:, 0] = labels[one] + "-" + labels[two] + _suffix(problem, kind)
        sign[:, 0] = np.where(turned & (sum(model.ranges or (1, -1)) == 0), -1.0, 1.0)
    else:
        labels = station_names(problem, kind)
        for end, (station, own) in enumerate(zip((a, b), model.ranges or (1, -1), strict=True)):
            if end < model.stations and own:
                name[:, end], sign[:, end] = labels[station], own
    return name, sign


def _both_ways(a: Array, b: Array) -> bool:
    """Return whether some pair of stations occurs in either order."""
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    return any((two, one) in pairs for one, two in pairs)


def station_names(problem: Problem, kind: str) -> Array:
    """Return the name (s,) of the group that each station makes with a kind."""
    return np.array(problem.stations.names, dtype=object) + _suffix(problem, kind)


def _suffix(problem: Problem, kind: str) -> str:
    several = sum(MODELS[rows.kind].stations > 0 for rows in problem.rows) > 1
    return f" {kind}" if several else ""


def kinds_of(problem: Problem) -> Array:
    """Return the kind of every row, object array (m,)."""
    return np.concatenate([np.full(rows.count, rows.kind, dtype=object) for rows in problem.rows])


def split(problem: Problem, block: Block, by: By, present: Array) -> tuple[Array, Array, Array]:
    """Return the noise of a block as independent errors of unit variance, each of one group.

    Independent rows are errors of their own; one that belongs to two stations is half of each. Rows that combine
    arrivals, R = D diag(v) D', are made of the arrivals at their stations, and of errors of the single rows if R has a
    multiple of the unit matrix besides. Other correlated rows are one group.

    Parameters
    ----------
    problem : Problem
        Batch (...).
    block : Block
        One of its blocks, g groups of r rows.
    by : "station", "pair" or "kind"
        As in `ends_of`.
    present : bool array (..., m)
        Rows that count.

    Returns
    -------
    effect : array (..., g, r, q)
        ``effect @ effect'`` is the covariance of the rows that are present; in the rows' units.
    name : object array (g, q)
        Group of each error.
    sigma : array (..., g, q)
        Its stated standard deviation, in the rows' units.
    """
    _g, r = block.row.shape
    if r == 1:
        name = ends_of(problem, by).name[block.row[:, 0]]
        # Half of the variance each, so the root of a half of the effect.
        share = np.where(name == "", 0.0, np.where((name != "").all(1)[:, None], np.sqrt(0.5), 1.0))
        effect = np.sqrt(block.covariance) * share[:, None]
        return effect, name, effect[..., 0, :]
    # Absent rows are no errors: their rows and columns of the covariance are zero.
    here = present[..., block.row]
    covariance = np.where(here[..., :, None] & here[..., None, :], block.covariance, 0.0)
    kinds = kinds_of(problem)[block.row]
    same = (kinds == kinds[:, :1]).all() and (kinds == kinds[0, 0]).all()
    if same and MODELS[kinds[0, 0]].ranges is not None and by != "pair":
        found = _arrivals(problem, block.row, covariance, here, by)
        if found is not None:
            return found
    # Any other correlation: the axes of the covariance are errors of one group, in the size of the mean variance.
    whole = np.array([" + ".join(dict.fromkeys(row)) for row in kinds], dtype=object)
    values, vectors = np.linalg.eigh(covariance)
    mean = values.sum(-1, keepdims=True) / np.maximum(here.sum(-1, keepdims=True), 1)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return root, np.repeat(whole[:, None], r, axis=1), np.broadcast_to(np.sqrt(mean), values.shape)


def _arrivals(
    problem: Problem, row: Array, covariance: Array, here: Array, by: By
) -> tuple[Array, Array, Array] | None:
    """Return the noise of groups of rows (g, r) as arrivals, with errors of the rows if need be; None if it is not."""
    ends = ends_of(problem, "station")
    kind = str(kinds_of(problem)[row[0, 0]])
    labels = station_names(problem, kind)
    # D: signs with which the arrivals at each station (columns) enter each row.
    design = ((ends.name[row][..., None] == labels) * ends.sign[row][..., None]).sum(-2) * here[..., None]
    own = np.eye(row.shape[1]) * here[..., None]
    groups = labels if by == "station" else np.full(len(labels), kind, dtype=object)
    # First arrivals alone, then with errors of the rows besides; what neither makes is another correlation.
    for parts, names in (
        ([design], groups),
        ([design, own], np.concatenate([groups, np.full(row.shape[1], f"{kind} rows", dtype=object)])),
    ):
        variance = _variances(parts, covariance)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        effect = np.concatenate(parts, axis=-1) * sigma[..., None, :]
        made = effect @ np.swapaxes(effect, -1, -2)
        size = np.abs(covariance).max()
        if np.allclose(made, covariance, rtol=0.0, atol=_FITS * size):
            return effect, np.broadcast_to(names, (len(row), len(names))), sigma
    return None


def _variances(parts: list[Array], covariance: Array) -> Array:
    """Return variances (..., q) of errors whose covariance is nearest to a given one; rows' own errors share theirs.

    With the columns d of the parts, sum v_i d_i d_i' = R in least squares: the normal matrix is (d_i' d_j)^2.
    """
    design = np.concatenate(parts, axis=-1)
    gram = (np.swapaxes(design, -1, -2) @ design) ** 2
    right = np.einsum("...rq,...rp,...pq->...q", design, covariance, design)
    # Each arrival has a variance of its own; all errors of single rows share one.
    widths = [parts[0].shape[-1], *(1 for _ in parts[1:])]
    merge = np.zeros((design.shape[-1], sum(widths)))
    merge[np.arange(widths[0]), np.arange(widths[0])] = 1.0
    merge[widths[0] :, widths[0] :] = 1.0
    found = np.linalg.pinv(merge.T @ gram @ merge, rcond=_UNSEEN, hermitian=True) @ (right @ merge)[..., None]
    return np.asarray((merge @ found)[..., 0])

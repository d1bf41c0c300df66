"""Linearised residuals, errors and offsets of many small problems at their fixes, packed into arrays.

`variance_components` and `noise_level` estimate noise levels from these arrays. Rows share a noise level in groups: one
group per station, per pair of stations or per kind of row. The noise is a sum of independent errors, each in one group.
An offset is a constant that a group adds to its rows.

Arrays have N problems, m rows, p unknowns, q errors and c offsets.
"""

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
# Two covariances are equal if they differ by less than this share of the largest entry: files contain rounded values.
_ROUNDED = 1e-6
# Largest number of rows of one problem: each m x m matrix then needs 32 MB.
_MAX_ROWS = 2000
# Number of problems that are linearised together: their matrices, most with tens of rows, then fit into memory.
_BATCH = 2000
# Relative eigenvalue of the normal matrix of variances below which a combination of variances is not determined.
_RANK_TOLERANCE = 1e-10


@dataclass(frozen=True, slots=True)
class Elements:
    """N linearised problems with packed rows, errors and offsets; missing entries are zero.

    - names: names of the G groups.
    - residual (N, m): measured minus modelled value, SI units.
    - jacobian (N, m, p): derivative with respect to the unknowns.
    - effect (N, m, q): B, the effect of each error of unit variance, in the units of the rows.
    - offset (N, m, c): E, the effect of an offset of each group.
    - fixed (N, m, m): C, the covariance that belongs to no group.
    - sigma (N, q): stated standard deviation of each error, in the units of the rows.
    - of_effect (N, q), of_offset (N, c): group number of each error and each offset; -1 for no group.
    - path (N, c): mean length of the signal path to the station over the rows of an offset, m; NaN if the row measures
      no single path.
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
        """Return a mask (G + 1,) of the groups of shared errors; the last entry, for no group, is False.

        It is indexed by `of_effect`, where -1 selects the last entry.
        """
        shared = [common_name(name) for name in self.names]
        return np.append(np.isin(np.array(self.names, dtype=object), shared), False)

    def take(self, index: Any) -> Elements:
        """Return the elements of the problems that `index` selects."""
        arrays = ("residual", "jacobian", "effect", "offset", "fixed", "sigma", "of_effect", "of_offset", "path")
        return replace(self, **{name: getattr(self, name)[index] for name in arrays})


def batch_of(problem: Problem) -> Problem:
    """Return a flat batch of the independent problems of a problem, with the station errors of epochs as noise.

    Raises
    ------
    InvalidProblem
        If more rows share unknowns than `_MAX_ROWS`.
    """
    problem = replace(problem, stations=problem.stations.with_noise())
    flat = (by_epoch(problem) if separable(problem) else problem).flat()
    if flat.count > _MAX_ROWS and flat.epochs > 1:
        what = f"{flat.count} rows share unknowns, too many for variance components"
        raise InvalidProblem(what, "noise", f"use at most {_MAX_ROWS}, or epochs that share no unknowns")
    return flat


def elements(problem: Problem, x: Array, by: By, common: By | None = None) -> Elements:
    """Return the elements of a flat batch of N problems, from `batch_of`, at the fixes `x` (N, size).

    `by` selects the groups: one per station, pair of stations, or kind. `common` adds a shared error per epoch for each
    station, pair or kind. Each shared error has a separate group (see `common_name`). The noise of the problem does not
    state its size, so its sigma comes from `typical_sigma`.
    """
    ends = ends_of(problem, by)
    names = sorted({*ends.name.ravel().tolist()} - {""})
    # one sigma for all parts, so that the size of a shared error does not depend on the division into parts
    size = typical_sigma(problem, common) if common else {}
    parts = []
    for first in range(0, len(x), _BATCH):
        items = np.arange(first, min(first + _BATCH, len(x)))
        parts.append(_part(problem.take(items), x[items], by, (common, size)))
    # groups of shared errors, and groups of correlated rows, come after the groups of single rows
    more = sorted({name for part in parts for name in part.names} - set(names))
    return _join((*names, *more), parts)


def _part(problem: Problem, x: Array, by: By, common: tuple[By | None, dict[str, float]]) -> Elements:
    """Return the elements of a part of a batch at the fixes `x` (n, size).

    `common` is the grouping of the shared errors, or None, and the sigma of each group (see `elements`). `by` selects
    the groups, see `ends_of`.
    """
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
    # the empty name, for no group, has the number -1
    offset, offset_names = _offsets(problem, by)
    names = tuple(sorted({*error_names.tolist(), *offset_names.tolist()} - {""}))
    number = {name: i for i, name in enumerate(names)} | {"": -1}
    path = np.broadcast_to(_paths(problem, x, residual), present.shape)
    # Remove absent rows: problems with one station fewer then need less memory.
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
    # The growth of an offset is stated per metre of path; for several rows it is the mean path.
    mean = np.where(offset != 0.0, path, 0.0).sum(1) / np.maximum((offset != 0.0).sum(1), 1)
    packed = Elements(
        names, residual * present_packed, jacobian, effect, offset, fixed, sigma, of_effect, of_offset, mean
    )
    return _with_priors(problem, x, packed)


def _linearise(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return residuals (N, m) and Jacobians (N, m, p) at the vectors `x` (N, size).

    The columns of a Jacobian are all shared unknowns and the local unknowns of each epoch. With equality constraints,
    columns along the constraints replace the columns of the shared unknowns.
    """
    residual, jacobian = differentiate(problem, x)
    if problem.epochs > 1 and problem.layout.n_local:
        n, length = problem.layout.n_shared, problem.layout.n_local
        # The Jacobian has columns for the local unknowns of one epoch only; here each epoch gets separate columns.
        spread = np.zeros((*residual.shape, problem.layout.size))
        spread[..., :n] = jacobian[..., :n]
        rows = np.arange(problem.count)[:, None]
        columns = n + problem.epoch[:, None] * length + np.arange(length)
        spread[..., rows, columns] = jacobian[..., n:]
        jacobian = spread
    face = exact(problem)
    if face:
        # Each equality constraint removes one unknown, so it removes one column.
        along, n = tangent_at(problem, face, x), problem.layout.n_shared
        jacobian = np.concatenate([jacobian[..., :n] @ along, jacobian[..., n:]], axis=-1)
    return residual, jacobian


def _paths(problem: Problem, x: Array, residual: Array) -> Array:
    """Return the modelled path (N, m) from target to station, m; NaN for a row that does not measure a single path.

    `residual` (N, m) are the residuals at the fixes `x` (N, size).
    """
    parts, start = [], 0
    for rows in problem.rows:
        model = MODELS[rows.kind]
        # The modelled value is the measurement minus the residual, so h need not be evaluated again.
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
    """Return the effects (N, m, q) of all errors, the group names (q,) and the standard deviations (N, q).

    `present` (N, m) marks rows with a weight above zero. Effects and deviations are in the units of the rows. `by`
    selects the groups, see `ends_of`.
    """
    count, rows = present.shape
    effects, names, sigmas = [], [], []
    for block in problem.noise.blocks:
        block_effect, name, sigma = split(problem, block, by, present)
        block_effect = np.broadcast_to(block_effect, (count, len(block.row), *block_effect.shape[-2:]))
        g, _r, q = block_effect.shape[1:]
        # Each group of a block gets separate columns over all rows.
        placed = np.zeros((count, rows, g, q))
        placed[:, block.row, np.arange(g)[:, None]] = block_effect
        effects.append(placed.reshape(count, rows, g * q))
        names.append(name.reshape(-1))
        sigmas.append(np.broadcast_to(sigma, (count, g, q)).reshape(count, g * q))
    return np.concatenate(effects, axis=-1), np.concatenate(names), np.concatenate(sigmas, axis=-1)


def _offsets(problem: Problem, by: By) -> tuple[Array, Array]:
    """Return the effects (m, c) of the offsets of the groups, 1, -1 or 0, and the names (c,) of the groups."""
    ends = ends_of(problem, by)
    names = np.array(sorted({*ends.name.ravel().tolist()} - {""}), dtype=object)
    return ((ends.name[..., None] == names) * ends.sign[..., None]).sum(1), names


def common_name(name: str) -> str:
    """Return the name of the error that all rows of a group share in an epoch."""
    return f"{name} common"


def typical_sigma(problem: Problem, by: By) -> dict[str, float]:
    """Return the stated standard deviation of the rows of each group: the root mean square over all problems.

    The result is a dictionary by the name of the group, in the units of the rows. A group without present rows is
    omitted.
    """
    variance = np.broadcast_to(variances(problem.noise, problem.count), (problem.batch_shape[0], problem.count))
    weight, ends = np.broadcast_to(problem.weight > 0.0, variance.shape), ends_of(problem, by).name
    found = {}
    for name in sorted({*ends.ravel().tolist()} - {""}):
        inside = weight & (ends == name).any(1)
        if inside.any():
            found[name] = float(np.sqrt(variance[inside].mean()))
    return found


def common_effects(problem: Problem, by: By, size: dict[str, float]) -> tuple[Array, Array, Array]:
    """Return the effects (m, c) of the errors that the rows of a group share in an epoch, their names and sizes (c,).

    There is one column for each group and epoch. `size` holds the standard deviation of a shared error by group name.
    An effect is this deviation or its negative value in the rows of the group and epoch, in the units of the rows, else
    0.
    """
    ends, epoch = ends_of(problem, by), problem.epoch
    columns, names = [], []
    for name, sigma in size.items():
        sign = np.where(ends.name == name, ends.sign, 0.0).sum(1)
        for k in np.unique(epoch[sign != 0.0]):
            columns.append(np.where(epoch == k, sign, 0.0) * sigma)
            names.append(name)
    sizes = np.array([size[name] for name in names])
    return np.stack(columns, axis=-1), np.array([common_name(name) for name in names], dtype=object), sizes


def _ungrouped_noise(problem: Problem, x: Array) -> Array:
    """Return the covariance (N, m, m) that station errors and weights between 0 and 1 add to the noise.

    The effect of station errors is computed at the fixes `x` (N, size).
    """
    rows = np.arange(problem.count)[None]
    stated = gathered(problem.noise, rows)[..., 0, :, :]
    whole = gathered(with_station_noise(problem, x).noise, rows)[..., 0, :, :]
    weight = np.where(problem.weight > 0.0, problem.weight, 1.0)
    # A row of weight w has 1/w times its variance: the difference belongs to no group.
    extra = (1.0 / weight - 1.0) * np.diagonal(whole, axis1=-2, axis2=-1)
    added = whole - stated + extra[..., None] * np.eye(problem.count)
    return np.broadcast_to(added, (len(x), *added.shape[-2:]))


def _present_first(present: Array) -> Array:
    """Return the column numbers (N, most) of each problem with the present columns first.

    `present` (N, m) is a mask. `most` is the largest number of present columns of a problem; absent columns fill the
    rest.
    """
    most = max(1, int(present.sum(1).max(initial=0)))
    return np.argsort(~present, axis=1, kind="stable")[:, :most]


def _pack(columns: Array, number: Array) -> tuple[Array, Array, Array]:
    """Return the nonzero columns (N, m, q), their groups (N, q) with -1 for zero columns, and their numbers (N, q).

    `columns` (N, m, Q) are all columns and `number` (Q,) their groups; q is the largest count of nonzero columns.
    """
    used = (columns != 0.0).any(1)
    kept = _present_first(used)
    group = np.where(np.take_along_axis(used, kept, 1), number[kept], -1)
    return np.take_along_axis(columns, kept[:, None], 2), group, kept


def _with_priors(problem: Problem, x: Array, packed: Elements) -> Elements:
    """Return the elements with additional rows for the priors of the problem; these rows belong to no group.

    `x` (N, size) are the fixes. An additional row is the mean of a prior minus the unknown at the fix. With equality
    constraints, no rows are added.
    """
    # With equality constraints, priors are omitted: their columns on the tangent space are not unit vectors, and the
    # constraint is stronger than the prior.
    parts = [] if exact(problem) else prior_parts(problem)
    for name, mean, precision in parts:
        slot, shared = problem.layout.find(name)
        start = slot.start if shared else problem.layout.n_shared + slot.start
        # a prior is a row that measures its unknowns directly
        columns = start + np.arange(slot.size)
        more = np.zeros((len(x), slot.size, packed.jacobian.shape[-1]))
        more[:, np.arange(slot.size), columns] = 1.0
        covariance, _ = linalg.inverse(np.broadcast_to(precision, (len(x), slot.size, slot.size)))
        error = np.broadcast_to(mean, (len(x), slot.size)) - x[:, columns]
        n, m = packed.residual.shape
        fixed = np.zeros((n, m + slot.size, m + slot.size))
        fixed[:, :m, :m], fixed[:, m:, m:] = packed.fixed, covariance
        # A prior has no grouped errors and no offsets: its rows are zero in both arrays.
        below = ((0, 0), (0, slot.size), (0, 0))
        packed = replace(
            packed,
            residual=np.concatenate([packed.residual, error], axis=1),
            jacobian=np.concatenate([packed.jacobian, more], axis=1),
            effect=np.pad(packed.effect, below),
            offset=np.pad(packed.offset, below),
            fixed=fixed,
        )
    return packed


def _join(names: tuple[str, ...], parts: list[Elements]) -> Elements:
    """Return the parts joined into one, with common group numbers and with arrays padded to one size.

    `names` are the names of all groups of the result.
    """
    renamed = []
    for part in parts:
        # The number -1, for no group, selects the last entry, which is -1.
        number = np.array([*(names.index(name) for name in part.names), -1])
        renamed.append(replace(part, of_effect=number[part.of_effect], of_offset=number[part.of_offset]))

    def stack(name: str, fill: float = 0.0) -> Array:
        arrays = [getattr(part, name) for part in renamed]
        shape = np.max([a.shape for a in arrays], axis=0)
        padding = [[(0, 0), *((0, int(n) - k) for n, k in zip(shape[1:], a.shape[1:], strict=True))] for a in arrays]
        return np.concatenate([np.pad(a, gap, constant_values=fill) for a, gap in zip(arrays, padding, strict=True)])

    joined = {name: stack(name) for name in ("residual", "jacobian", "effect", "offset", "fixed", "sigma", "path")}
    return Elements(names, **joined, of_effect=stack("of_effect", -1), of_offset=stack("of_offset", -1))


# The groups of the errors of each row, and the noise as independent errors of these groups.


@dataclass(frozen=True, slots=True)
class Ends:
    """Groups of each row: one group, or one group per station of the row.

    - name (m, 2): names of the groups; empty for no group.
    - sign (m, 2): sign with which an offset of the group enters the row; 0 for no group.
    """

    name: Array
    sign: Array


def ends_of(problem: Problem, by: By) -> Ends:
    """Return the groups of the rows of a problem.

    With `by` = "station", a group is a station, or a station with a kind if stations measure several kinds. With
    "pair", a group is a pair of stations; with "kind", a kind of rows.

    Raises
    ------
    InvalidProblem
        If the grouping is unknown.
    """
    if by not in GROUPINGS:
        raise InvalidProblem(f"unknown grouping {by!r}", "by", nearest(str(by), GROUPINGS))
    parts = [_ends(problem, rows.kind, rows.a, rows.b, by) for rows in problem.rows]
    # Errors of compass bearings are clockwise. If a group has rows of both senses, its errors are anticlockwise.
    blocks = list(zip(problem.rows, parts, strict=True))
    others = [name for rows, (name, _) in blocks if rows.kind == "azimuth" and rows.sense > 0.0]
    both = list({text for name in others for text in name.ravel().tolist()})
    parts = [(name, np.where(np.isin(name, both), sign, rows.sense * sign)) for rows, (name, sign) in blocks]
    return Ends(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _ends(problem: Problem, kind: str, a: Array, b: Array, by: By) -> tuple[Array, Array]:
    """Return the group names and signs (m, 2) of rows of one kind with the station numbers `a` and `b` (m,).

    The signs are as in `Ends`, before the sense of compass bearings is applied. `by` selects the groups, see `ends_of`.
    """
    name, sign = np.full((len(a), 2), "", dtype=object), np.zeros((len(a), 2))
    model = MODELS[kind]
    if by == "kind" or model.stations == 0:
        name[:, 0], sign[:, 0] = kind, 1.0
    elif by == "pair" and model.stations == 2:
        # A-B and B-A are one pair; the sign of the offset changes with the order. If each pair occurs in one order
        # only, the names keep the order of the file.
        turned = (a > b) if _both_ways(a, b) else np.zeros(len(a), dtype=bool)
        one, two = np.where(turned, b, a), np.where(turned, a, b)
        labels = np.array(problem.stations.names, dtype=object)
        name[:, 0] = labels[one] + "-" + labels[two] + _suffix(problem, kind)
        sign[:, 0] = np.where(turned & (sum(model.ranges or (1, -1)) == 0), -1.0, 1.0)
    else:
        labels = station_names(problem, kind)
        for end, (station, factor) in enumerate(zip((a, b), model.ranges or (1, -1), strict=True)):
            if end < model.stations and factor:
                name[:, end], sign[:, end] = labels[station], factor
    return name, sign


def _both_ways(a: Array, b: Array) -> bool:
    """Return whether a pair of stations occurs in both orders, as A-B and as B-A."""
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    return any((two, one) in pairs for one, two in pairs)


def station_names(problem: Problem, kind: str) -> Array:
    """Return the name (s,) of the group of each station for rows of a kind."""
    return np.array(problem.stations.names, dtype=object) + _suffix(problem, kind)


def _suffix(problem: Problem, kind: str) -> str:
    """Return the suffix " kind" of the names of groups if stations measure several kinds, else an empty text."""
    several = sum(MODELS[rows.kind].stations > 0 for rows in problem.rows) > 1
    return f" {kind}" if several else ""


def kinds_of(problem: Problem) -> Array:
    """Return the kind of every row, object array (m,)."""
    return np.concatenate([np.full(rows.count, rows.kind, dtype=object) for rows in problem.rows])


def split(problem: Problem, block: Block, by: By, present: Array) -> tuple[Array, Array, Array]:
    """Return the noise of a block as independent errors of unit variance, each in one group.

    An independent row is one error; if the row belongs to two stations, each station has half of its variance. Rows
    that combine arrivals have R = D diag(v) D'. They become errors of the arrivals at their stations, plus errors of
    single rows if R also contains a multiple of the unit matrix. Other correlated rows form one group.

    The block has g groups of r rows; `present` (..., m) marks rows with a weight above zero. The results are the
    effects (..., g, r, q), the names (g, q) of the groups, and the stated standard deviations (..., g, q). Effects and
    deviations are in the units of the rows, and ``effect @ effect'`` is the covariance of the present rows. `by`
    selects the groups, see `ends_of`.
    """
    _g, r = block.row.shape
    if r == 1:
        name = ends_of(problem, by).name[block.row[:, 0]]
        # Each of two stations has half of the variance, so the effect is multiplied by the square root of one half.
        share = np.where(name == "", 0.0, np.where((name != "").all(1)[:, None], np.sqrt(0.5), 1.0))
        effect = np.sqrt(block.covariance) * share[:, None]
        return effect, name, effect[..., 0, :]
    # Absent rows have no errors: their rows and columns of the covariance are zero.
    here = present[..., block.row]
    covariance = np.where(here[..., :, None] & here[..., None, :], block.covariance, 0.0)
    kinds = kinds_of(problem)[block.row]
    same = (kinds == kinds[:, :1]).all() and (kinds == kinds[0, 0]).all()
    if same and MODELS[kinds[0, 0]].ranges is not None and by != "pair":
        found = _arrivals(problem, block.row, covariance, here, by)
        if found is not None:
            return found
    # Any other correlation: the eigenvectors of the covariance are errors of one group. Their sigma is the square root
    # of the mean variance.
    whole = np.array([" + ".join(dict.fromkeys(row)) for row in kinds], dtype=object)
    values, vectors = np.linalg.eigh(covariance)
    mean = values.sum(-1, keepdims=True) / np.maximum(here.sum(-1, keepdims=True), 1)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return root, np.repeat(whole[:, None], r, axis=1), np.broadcast_to(np.sqrt(mean), values.shape)


def _arrivals(
    problem: Problem, row: Array, covariance: Array, here: Array, by: By
) -> tuple[Array, Array, Array] | None:
    """Return the noise of groups of rows (g, r) as errors of arrivals, plus errors of the rows if necessary.

    `row` are the row numbers, `covariance` (..., g, r, r) the noise, and `here` (..., g, r) marks present rows. The
    results are as in `split`. Return None if the covariance does not have this form. `by` selects the groups, see
    `ends_of`.
    """
    ends = ends_of(problem, "station")
    kind = str(kinds_of(problem)[row[0, 0]])
    labels = station_names(problem, kind)
    # D: the sign with which the arrival at each station (columns) enters each row.
    design = ((ends.name[row][..., None] == labels) * ends.sign[row][..., None]).sum(-2) * here[..., None]
    single = np.eye(row.shape[1]) * here[..., None]
    # the group of each arrival: its station, or the kind of the rows
    groups = labels if by == "station" else np.full(len(labels), kind, dtype=object)
    # Try arrivals alone first, then arrivals and errors of the rows. If neither fits, the correlation has another form.
    for parts, names in (
        ([design], groups),
        ([design, single], np.concatenate([groups, np.full(row.shape[1], f"{kind} rows", dtype=object)])),
    ):
        variance = _variances(parts, covariance)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        effect = np.concatenate(parts, axis=-1) * sigma[..., None, :]
        made = effect @ np.swapaxes(effect, -1, -2)
        size = np.abs(covariance).max()
        if np.allclose(made, covariance, rtol=0.0, atol=_ROUNDED * size):
            return effect, np.broadcast_to(names, (len(row), len(names))), sigma
    return None


def _variances(parts: list[Array], covariance: Array) -> Array:
    """Return the variances (..., q) of errors whose covariance is nearest to a given covariance R (..., r, r).

    The fit is sum v_i d_i d_i' = R in least squares. The columns d_i are the columns of all `parts` (..., r, n). The
    normal matrix has the entries (d_i' d_j)^2. The columns of the first part have separate variances; all columns of
    the second part, the errors of single rows, have one variance.
    """
    design = np.concatenate(parts, axis=-1)
    gram = (np.swapaxes(design, -1, -2) @ design) ** 2
    right = np.einsum("...rq,...rp,...pq->...q", design, covariance, design)
    # Each arrival has a separate variance; all errors of single rows share one variance.
    widths = [parts[0].shape[-1], *(1 for _ in parts[1:])]
    merge = np.zeros((design.shape[-1], sum(widths)))
    merge[np.arange(widths[0]), np.arange(widths[0])] = 1.0
    merge[widths[0] :, widths[0] :] = 1.0
    found = np.linalg.pinv(merge.T @ gram @ merge, rcond=_RANK_TOLERANCE, hermitian=True) @ (right @ merge)[..., None]
    return np.asarray((merge @ found)[..., 0])

"""Proofs of the fix of one target in a file that also has targets at known positions, such as a beacon.

The rows of a known target are linear in the biases b that it shares with the unknown target. Their part of the cost is

    |A b + E e - v|^2 + |R (b - mean)|^2,

with whitened rows A and E. R are the rows of the prior, and e are emission times of the known targets. Minimised over
e, it is a constant plus ``|L (b - b0)|^2``: a joint Gaussian prior of the biases. Its eigenvectors are combinations of
biases that are independent a priori. The lone problem has the rows of the unknown target, with these combinations as
offsets. Its cost and the cost of the whole problem differ by the constant, so a claim is valid for both.

Letters: N problems, m rows, b biases, q combinations, `size` numbers of a parameter vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from optloc.base.linalg import project_out
from optloc.base.records import overwrite, take
from optloc.base.types import Array, Bias, Motion, Rows
from optloc.linear.constraints import for_target, is_of_one_target
from optloc.linear.evaluate import differentiate
from optloc.linear.normal import prior_parts
from optloc.models import MODELS
from optloc.problem.claims import Claims
from optloc.problem.epochs import has_correlated_epochs, some_epochs
from optloc.problem.fix import Fix
from optloc.problem.forms import form_of
from optloc.problem.layout import Layout, emission_name, state_names
from optloc.problem.noise import Block, Noise, whiten, whiten_rows
from optloc.problem.problem import Problem
from optloc.solvers.certificates.branch_and_bound import (
    certify_stage,
    claims_before,
    fixes_to_prove,
    keep_evidence,
)
from optloc.solvers.certificates.mapped_claims import claims_so_far, drop_lost, improved
from optloc.solvers.pool import Pool, offer
from optloc.solvers.stages import lsr
from optloc.solvers.verdict.judge import judge

Prove = Callable[[Problem, Pool, Array | None, float, float], Pool]

# Share of the largest precision below which the known rows do not determine a combination of biases. The digits below
# it are rounding of whitened rows. Without its prior, the cost of a combination is lower, so that a bound stays valid.
_OPEN = 1e-12
# Coefficients below this share of the largest one are rounding.
_ZERO = 1e-14


def has_known_target(problem: Problem) -> bool:
    """Return whether one of several targets is unknown, and the map to a problem of this target alone applies."""
    unknown = [i for i, motion in enumerate(problem.motions) if motion.known is None]
    if len(problem.motions) < 2 or len(unknown) != 1 or problem.motions[unknown[0]].span != "run":
        return False
    target = unknown[0]
    stations = problem.stations
    if problem.fences or stations.unknown_for or has_correlated_epochs(problem):
        return False
    known = np.concatenate([rows.target != target for rows in problem.rows])
    # The residual of an angle is wrapped, so it is not linear in a bias.
    if any(MODELS[rows.kind].period is not None and (rows.target != target).any() for rows in problem.rows):
        return False
    if any(form_of(bias).enters != "adds" or form_of(bias).steps is not None for bias in problem.biases):
        return False
    names = {bias.name for bias in problem.biases}
    names |= set(state_names(target, len(problem.motions), problem.motions[target].order))
    alike = all((known[block.row] == known[block.row[:, :1]]).all() for block in problem.noise.blocks)
    return (
        alike
        and bool(known.any() and not known.all())
        and all(name in names for name, _, _ in prior_parts(problem))
        and all(is_of_one_target(c) for c in problem.constraints)
    )


@dataclass(frozen=True, slots=True)
class LoneProblem:
    """The problem of the unknown target alone, with the cost of a problem that has known targets too.

    Parameters
    ----------
    problem : Problem
        A flat batch of one problem.
    constant : float
        Cost of the whole problem minus the cost of this problem.
    combine : array (b, q)
        Biases of each combination.
    split : array (q, b)
        Combinations of each bias: the inverse.
    biases : int array (b,)
        Columns of the biases in the whole problem.
    combinations : int array (q,)
        Columns of the combinations in this problem.
    here, there : int array (s,)
        Columns of the state and the emission times of the target in this problem, and in the whole problem.
    """

    problem: Problem
    constant: float
    combine: Array
    split: Array
    biases: Array
    combinations: Array
    here: Array
    there: Array

    def alone(self, x: Array) -> Array:
        """Return vectors (..., size) of this problem for vectors of the whole problem."""
        out = np.zeros((*x.shape[:-1], self.problem.layout.size))
        out[..., self.here] = x[..., self.there]
        out[..., self.combinations] = x[..., self.biases] @ self.split.T
        return out

    def together(self, x: Array, like: Array) -> Array:
        """Return vectors (..., size) of the whole problem for vectors of this problem; `like` (size,) has the rest."""
        out = np.broadcast_to(like, (*x.shape[:-1], len(like))).copy()
        out[..., self.there] = x[..., self.here]
        out[..., self.biases] = x[..., self.combinations] @ self.combine.T
        return out


def lone_problem(problem: Problem, x: Array) -> LoneProblem:
    """Return the problem of the unknown target alone, for a flat batch of one problem in the scope of this module.

    `x` (size,) is any finite parameter vector: the known rows are linear in the unknowns that they depend on.
    """
    count = len(problem.motions)
    target = next(i for i, motion in enumerate(problem.motions) if motion.known is None)
    motion = problem.motions[target]
    known = np.concatenate([rows.target != target for rows in problem.rows])
    layout = problem.layout
    shared = _shared_columns(layout, {bias.name for bias in problem.biases})
    combine, centre, precision, constant = _joint_prior(problem, x, known, shared, target)
    design = _dense(problem, x)[1][~known][:, shared] @ combine
    part = _of_target(problem, target, ~known)
    biases = _combinations(part, design, centre, precision)
    lone = replace(part, biases=biases)
    used = np.unique(lone.epoch)
    lone = lone if len(used) == lone.epochs else some_epochs(lone, used)
    order = _order_of(precision)
    names = zip(state_names(0, 1, motion.order), state_names(target, count, motion.order), strict=True)
    here, there = list[int](), list[int]()
    for one, two in names:
        here += _shared_columns(lone.layout, {one}).tolist()
        there += _shared_columns(layout, {two}).tolist()
    if lone.emitting:
        here += _local_columns(lone.layout, "emission", np.arange(lone.epochs))
        there += _local_columns(layout, emission_name(target, count), used)
    columns = _shared_columns(lone.layout, {bias.name for bias in biases})
    split = np.linalg.inv(combine)[order]
    return LoneProblem(lone, constant, combine[:, order], split, shared, columns, np.array(here), np.array(there))


def _joint_prior(
    problem: Problem, x: Array, known: Array, shared: Array, target: int
) -> tuple[Array, Array, Array, float]:
    """Return the joint prior of the biases from the known rows: combinations, means, precisions, and the constant.

    The combinations (b, b) are columns, independent a priori. Means and precisions are (b,); a precision of zero means
    no prior. `known` (m,) flags the known rows, and `shared` (b,) are the columns of the biases. `target` is the number
    of the unknown target.
    """
    residual, jacobian = _dense(problem, x)
    white = whiten(problem.noise, problem.weight)
    emissions = [name for name in (slot.name for slot in problem.layout.local) if name.startswith("emission")]
    others = [n for n in emissions if n != emission_name(target, len(problem.motions))]
    nuisance = [c for name in others for c in _local_columns(problem.layout, name, np.arange(problem.epochs))]
    columns = np.concatenate([jacobian[:, [*shared, *nuisance]], (residual + jacobian @ x)[:, None]], axis=1)
    columns[~known] = 0.0
    rows = whiten_rows(white, columns)
    rows = rows[0] if rows.ndim == 3 else rows
    b = len(shared)
    own, centre = _prior_rows(problem, shared)
    rows = np.concatenate([rows, np.concatenate([own, np.zeros((b, len(nuisance))), (own @ centre)[:, None]], axis=1)])
    kept = np.concatenate([rows[:, :b], rows[:, -1:]], axis=1)
    used = rows[:, b:-1].any(0)
    kept = project_out(rows[:, b:-1][:, used], kept) if used.any() else kept
    A, v = kept[:, :b], kept[:, -1]
    # Rows of the unknown target set the scale of biases that the known rows do not contain.
    size = np.linalg.norm(np.concatenate([A, jacobian[:, shared]]), axis=0)
    size = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh((A / size).T @ (A / size))
    values = np.where(values > _OPEN * values.max(initial=_OPEN), values, 0.0)
    combine = vectors / size[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(values > 0.0, (combine.T @ (A.T @ v)) / values, 0.0)
    constant = float(((v - A @ (combine @ mean)) ** 2).sum())
    return combine, mean, values, constant


def _dense(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return residuals (m,) and derivatives (m, size) of a flat batch of one problem at a vector (size,)."""
    residual, jacobian = differentiate(problem, x[None])
    layout = problem.layout
    out = np.zeros((problem.count, layout.size))
    out[:, : layout.n_shared] = jacobian[0, :, : layout.n_shared]
    if layout.n_local:
        place = layout.n_shared + problem.epoch[:, None] * layout.n_local + np.arange(layout.n_local)
        np.put_along_axis(out, place, jacobian[0, :, layout.n_shared :], axis=1)
    return residual[0], out


def _prior_rows(problem: Problem, shared: Array) -> tuple[Array, Array]:
    """Return the prior of the biases as whitened rows (b, b), and its mean (b,); `shared` are the bias columns."""
    precision, mean = np.zeros((problem.layout.size,) * 2), np.zeros(problem.layout.size)
    names = {bias.name for bias in problem.biases}
    for name, centre, information in prior_parts(problem):
        if name in names:
            place = _shared_columns(problem.layout, {name})
            precision[np.ix_(place, place)] += information.reshape(len(place), len(place))
            mean[place] = np.ravel(centre)
    values, vectors = np.linalg.eigh(precision[np.ix_(shared, shared)])
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T, mean[shared]


def _shared_columns(layout: Layout, names: set[str]) -> Array:
    """Return the columns of named shared unknowns in parameter vectors."""
    found = [np.arange(slot.start, slot.start + slot.size) for slot in layout.shared if slot.name in names]
    return np.concatenate([np.zeros(0, dtype=int), *found])


def _local_columns(layout: Layout, name: str, epochs: Array) -> list[int]:
    """Return the columns of a local unknown of one number at some epochs."""
    slot, _ = layout.find(name)
    return [int(column) for column in layout.n_shared + epochs * layout.n_local + slot.start]


def _of_target(problem: Problem, target: int, own: Array) -> Problem:
    """Return the problem of the rows `own` (m,) of one target, without biases; its target has the number 0."""
    number = np.cumsum(own) - 1
    blocks = []
    for block in problem.noise.blocks:
        groups = own[block.row[:, 0]]
        covariance = block.covariance if block.covariance.shape[-3] == 1 else block.covariance[..., groups, :, :]
        if groups.any():
            blocks.append(Block(number[block.row[groups]], covariance))
    parts = np.split(own, np.cumsum([rows.count for rows in problem.rows])[:-1])
    rows = tuple(_rows(block, mine) for block, mine in zip(problem.rows, parts, strict=True) if mine.any())
    motion: Motion = problem.motions[target]
    # The reference time of a state is the first epoch of the run, whose rows may be of another target.
    motion = replace(motion, reference=float(problem.times[0])) if motion.reference is None else motion
    old, new = (state_names(*each, motion.order) for each in ((target, len(problem.motions)), (0, 1)))
    priors = tuple(replace(p, name=new[old.index(p.name)]) for p in problem.priors if p.name in old)
    constraints = tuple(for_target(c, 0) for c in problem.constraints if c.target == target)
    unknowns: dict[str, Any] = {"motions": (motion,), "biases": (), "priors": priors, "constraints": constraints}
    return replace(problem, rows=rows, noise=Noise(tuple(blocks)), **unknowns)


def _rows(block: Rows, own: Array) -> Rows:
    """Return the rows `own` of a block as rows of the target 0."""
    arrays = {name: getattr(block, name)[..., own] for name in ("z", "weight", "correction", "a", "b", "epoch")}
    return replace(block, **arrays, target=np.zeros(int(own.sum()), dtype=block.target.dtype))


def _order_of(precision: Array) -> Array:
    """Return the order of combinations: first those with a prior, then the others."""
    return np.concatenate([np.flatnonzero(precision > 0.0), np.flatnonzero(precision == 0.0)])


def _combinations(problem: Problem, design: Array, centre: Array, precision: Array) -> tuple[Bias, ...]:
    """Return the combinations as families of offsets, with a prior and without; `design` (m, b) are their effects."""
    found = []
    for name, chosen in (("known combinations", precision > 0.0), ("free combinations", precision == 0.0)):
        part = np.flatnonzero(chosen)
        if not len(part):
            continue
        effect = design[:, part]
        row, member = np.nonzero(np.abs(effect) > _ZERO * np.abs(design).max(initial=0.0))
        names = tuple(str(i) for i in part.tolist())
        sigma = precision[part] ** -0.5 if chosen.any() and precision[part[0]] > 0.0 else None
        found.append(Bias(name, names, row, member, effect[row, member], "offset", centre[part], sigma))
    return tuple(found)


def certified_alone(
    problem: Problem, pool: Pool, prove: Prove, region: Array | None, margin: float, effort: float
) -> Pool:
    """Return the pools of a flat batch with known targets, with certificates of the problems of the other target.

    `prove` proves the fixes of these problems. The other parameters are as for
    `optloc.solvers.certificates.admitted.certified`.
    """
    began, fix, stages = perf_counter(), judge(problem, pool), pool.stages
    asked, proven_before = fixes_to_prove(pool, fix)
    claims = claims_so_far(pool, proven_before)
    detail = "nothing to prove"
    for item in np.flatnonzero(asked & ~proven_before)[:, None]:
        part, before, old = problem.take(item), take(pool, item), fix[item]
        lone = lone_problem(part, old.x[0])
        start = offer(lone.problem, lone.alone(before.x), None, "certify", began)
        done = prove(lone.problem, lsr(lone.problem, start), region, margin, effort)
        new = offer(part, lone.together(done.x, old.x[0]), before, "certify", began)
        new = keep_evidence(lsr(part, new), before)
        judged, found = judge(part, new), judge(lone.problem, done)
        changed = improved(old, judged)
        pool = pool.merge(item[changed], take(new, changed))
        claims.write(item, _claims_together(overwrite(old, changed, judged[changed]), found, done, lone))
        detail = f"{done.stages[-1].detail}, with known targets as a prior"
    return replace(pool, proven=claims, stages=(*stages, certify_stage(detail, began)))


def _claims_together(fix: Fix, found: Fix, done: Pool, lone: LoneProblem) -> Claims:
    """Return the claim about the fix of a whole problem, from the fix `found` of the lone problem and its pool `done`.

    The claim is valid only if both fixes have the same cost and list the same number of other minima.
    """
    claims = claims_before(done)
    claims.bound[:] += lone.constant
    drop_lost(claims, fix, found, lone.constant)
    return claims

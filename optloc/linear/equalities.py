"""Equality constraints of a run, for states that last for the run and for states of each epoch.

M problems have k epochs. A vector has `size` unknowns: n shared unknowns, and l local ones for each epoch. A state
(position, velocity and acceleration of a target) has c equalities. A *level* is the surface on which a constrained
quantity equals one of its bounds. A `Face` is a tuple of levels that an estimate satisfies together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.linalg import tangent
from optloc.base.types import Array, Band, Constraint
from optloc.linear.constraints import Face, exact, kind_of, levels, restore, tangent_at
from optloc.linear.normal import Normal, marginal, step
from optloc.linear.redundancy import degrees_of_freedom
from optloc.problem.epochs import states_by_epoch
from optloc.problem.problem import Problem


@dataclass(frozen=True, slots=True)
class Equalities:
    """The equality constraints of a flat batch of M problems.

    Parameters
    ----------
    problem : Problem
        The batch: runs of k epochs with l local unknowns in each.
    lasting : Face
        Equalities of states that all epochs share; empty if there are none.
    single : Problem, optional
        The states of one epoch, with their equalities and bounds (M or 1, k or 1). None if every constrained state
        lasts for the run.
    each : Face
        Equalities of `single`, which every epoch satisfies.
    """

    problem: Problem
    lasting: Face
    single: Problem | None
    each: Face

    @classmethod
    def of(cls, problem: Problem, face: Face | None = None) -> Equalities:
        """Return the equalities of a problem: by default the stated ones, else the levels of a face."""
        face = exact(problem) if face is None else face
        # numbers of the constraints whose target has a separate state in each epoch
        own = {i for level in face if problem.motions[_target(problem, i := level.constraint)].span == "epoch"}
        lasting = tuple(level for level in face if level.constraint not in own)
        if not own:
            return cls(problem, lasting, None, ())
        kept = replace(problem, priors=(), constraints=tuple(problem.constraints[i] for i in sorted(own)))
        single = states_by_epoch(kept)
        return cls(problem, lasting, single, exact(single))

    def restore(self, x: Array) -> Array:
        """Return vectors (M, size) projected onto the equalities, along the shortest way."""
        x = restore(self.problem, self.lasting, x) if self.lasting else x
        if self.single is None:
            return x
        return self._with_states(x, restore(self._single(x), self.each, self._states(x)))

    def retract(self, x: Array, move: Array) -> Array:
        """Return the vectors (M, size) after steps (M, size), projected onto the equalities."""
        return self.restore(x + move)

    def step(self, equations: Normal, damping: Array, x: Array) -> tuple[Array, Array]:
        """Return the damped steps (M, size) that satisfy the equalities to first order, and whether they exist (M,).

        Parameters
        ----------
        equations : Normal
            Normal equations of the batch at `x`.
        damping : array (M,)
            Marquardt's factor, as for `optloc.linear.normal.step`.
        x : array (M, size)
            Vectors before the steps.
        """
        along = tangent_at(self.problem, self.lasting, x) if self.lasting else None
        if along is not None and is_bent(self.problem, self.lasting):
            bend = bend_along(self.problem, self.lasting, equations, along, x)
            equations = replace(equations, shared=equations.shared + bend)
        if self.single is None:
            return step(equations, damping, along)
        # the local unknowns of these equations are coefficients of a basis of the steps that stay on the equalities
        basis = self._local_space(x)
        move, ok = step(_within(equations, basis), damping, along)
        n, (m, k, _, free) = self.problem.layout.n_shared, basis.shape
        local = (basis @ move[:, n:].reshape(m, k, free, 1))[..., 0] if free else np.zeros(basis.shape[:-1])
        return np.concatenate([move[:, :n], local.reshape(m, -1)], axis=1), ok

    def shared(self, equations: Normal, x: Array) -> tuple[Array, Array]:
        """Return information (M, n, n) and right side (M, n) of the shared unknowns, with the local ones eliminated.

        The local unknowns continue to satisfy their equalities.
        """
        if self.single is not None:
            equations = _within(equations, self._local_space(x))
        information, vector, _ = marginal(equations)
        return information, vector

    def lasting_space(self, x: Array) -> Array:
        """Return a basis (M, n, n - c) of the steps of the shared unknowns that stay on their equalities."""
        if not self.lasting:
            return np.broadcast_to(np.eye(n := self.problem.layout.n_shared), (len(x), n, n))
        return tangent_at(self.problem, self.lasting, x)

    def _local_space(self, x: Array) -> Array:
        """Return bases (M, k, l, l - c) of the steps of the local unknowns that stay on the equalities."""
        layout = self.problem.layout
        _, gradients = levels(self._single(x), self.each, self._states(x))
        # local unknowns that are not states, such as clocks, have zero gradients and move freely
        local = np.zeros((*gradients.shape[:2], layout.n_local))
        for here, there in self._slots():
            local[..., here] = gradients[..., there]
        along = tangent(local, np.ones((len(local), layout.n_local))).along
        return along.reshape(len(x), self.problem.epochs, *along.shape[1:])

    def _single(self, x: Array) -> Problem:
        """Return the epochs of vectors (M, size) as problems (M k,) of one epoch each."""
        shape = (len(x), self.problem.epochs)
        return replace(self._epoch, constraints=tuple(_spread(band, shape) for band in self._epoch.constraints))

    @property
    def _epoch(self) -> Problem:
        """Return the problem of one epoch."""
        assert self.single is not None  # callers check this
        return self.single

    def _slots(self) -> list[tuple[slice, slice]]:
        """Return pairs of slices for each state: in the local unknowns of the run, and in the vector of an epoch."""
        own = {slot.name: slice(slot.start, slot.start + slot.size) for slot in self._epoch.layout.shared}
        local = [slot for slot in self.problem.layout.local if slot.name in own]
        return [(slice(slot.start, slot.start + slot.size), own[slot.name]) for slot in local]

    def _states(self, x: Array) -> Array:
        """Return the states of every epoch as vectors (M k, size of an epoch)."""
        _, local = self.problem.layout.split(x)
        out = np.zeros((local.shape[0] * local.shape[1], self._epoch.layout.size))
        for here, there in self._slots():
            out[:, there] = local.reshape(len(out), -1)[:, here]
        return out

    def _with_states(self, x: Array, states: Array) -> Array:
        """Return vectors (M, size) whose epochs have the given states (M k, size of an epoch)."""
        shared, local = self.problem.layout.split(x)
        local = local.reshape(len(states), -1).copy()
        for here, there in self._slots():
            local[:, here] = states[:, there]
        return np.concatenate([shared, local.reshape(len(x), -1)], axis=1)


# Share of a curvature that must be left after the bend of the equalities: with less, the quadratic model says nothing.
_LEFT = 0.05
# Step of differences, relative to one plus a coordinate.
_STEP = 1e-5


def is_bent(problem: Problem, face: Face) -> bool:
    """Return whether a level of a face has a relevant curvature; the curvature of the Earth is negligible."""
    return any(kind_of(problem, level) not in ("plane", "height") for level in face)


def bend_along(problem: Problem, face: Face, equations: Normal, along: Array, x: Array) -> Array:
    """Return the curvature (M, n, n) that bent equalities add to the cost along their tangent space.

    On a surface g = 0 the cost has the second derivative of the function of Lagrange. It is the second derivative of
    the cost plus the multiplier times the second derivative of g. Steps with it converge in a few iterations. Where the
    sum is not positive, the result is zero, as in the method of Gauss and Newton.

    Parameters
    ----------
    problem : Problem
        Batch of M problems.
    face : Face
        The equalities.
    equations : Normal
        Normal equations at `x`.
    along : array (M, n, n - c)
        Basis of the tangent space.
    x : array (M, size)
        Vectors on the face.

    References
    ----------
    J. Nocedal, S. J. Wright, "Numerical Optimization" (2006), section 12.5.
    """
    information, vector, _ = marginal(equations)
    gradients, n = levels(problem, face, x)[1], information.shape[-1]
    with np.errstate(all="ignore"):
        # minus the gradient is a combination of the normals
        share = (np.linalg.pinv(np.swapaxes(np.nan_to_num(gradients), -1, -2)) @ vector[..., None])[..., 0]
        bend = np.zeros_like(information)
        for j in np.flatnonzero((gradients != 0.0).any((0, 1))):
            size = _STEP * (1.0 + np.abs(x[:, j]))
            moved = [x + np.where(np.arange(x.shape[1]) == j, sign * size[:, None], 0.0) for sign in (1.0, -1.0)]
            slope = (levels(problem, face, moved[0])[1] - levels(problem, face, moved[1])[1]) / (
                2.0 * size[:, None, None]
            )
            bend[:, :, j] = (share[..., None] * slope).sum(1)
        bend = 0.5 * (bend + np.swapaxes(bend, -1, -2))
        inner = np.swapaxes(along, -1, -2) @ bend @ along
        flat = np.swapaxes(along, -1, -2) @ information @ along
        good = np.isfinite(inner).all((-1, -2)) & np.isfinite(flat).all((-1, -2))
        if not inner.shape[-1] or not n:
            return np.zeros_like(information)
        eye = np.eye(inner.shape[-1])
        both = np.where(good[:, None, None], flat + inner - _LEFT * flat, eye)
        good &= np.linalg.eigvalsh(both)[:, 0] > 0.0
        added = along @ inner @ np.swapaxes(along, -1, -2)
        good &= (np.diagonal(equations.shared + added, axis1=-2, axis2=-1) > 0.0).all(-1)
    return np.where(good[:, None, None], added, 0.0)


def spare_rows(problem: Problem) -> Array:
    """Return the degrees of freedom (N,) of a flat batch; equalities of local states count once in every epoch."""
    found = degrees_of_freedom(problem)
    own = sum(problem.motions[_target(problem, level.constraint)].span == "epoch" for level in exact(problem))
    if not own or problem.epochs == 1:
        return found
    # an epoch without a row has no unknowns to constrain
    weight = np.atleast_2d(problem.weight)
    observed = np.zeros((len(weight), problem.epochs), dtype=bool)
    for i, row in enumerate(weight > 0.0):
        observed[i, problem.epoch[row]] = True
    return np.asarray(found + own * (observed.sum(1) - 1))


def _spread(band: Constraint, shape: tuple[int, int]) -> Constraint:
    """Return an equality whose bounds and coefficients have one axis (M k,), for M problems with k epochs each."""
    if not isinstance(band, Band):  # only bands are equalities
        return band
    lower, upper = (b if b.ndim == 0 else np.broadcast_to(b, shape).ravel() for b in (band.lower, band.upper))
    c = band.coefficients
    c = c if c.ndim == 1 else np.broadcast_to(c, (*shape, c.shape[-1])).reshape(-1, c.shape[-1])
    return replace(band, lower=lower, upper=upper, coefficients=c)


def _target(problem: Problem, constraint: int) -> int:
    """Return the number of the target of a constraint."""
    return problem.constraints[constraint].target


def _within(equations: Normal, basis: Array) -> Normal:
    """Return normal equations whose local unknowns move only along `basis` (M, k, l, l - c).

    The new local unknowns are the l - c coefficients of the basis.
    """
    turned = np.swapaxes(basis, -1, -2)
    return Normal(
        equations.shared,
        turned @ equations.local @ basis,
        equations.cross @ basis,
        equations.shared_vector,
        (turned @ equations.local_vector[..., None])[..., 0],
        equations.cost,
    )

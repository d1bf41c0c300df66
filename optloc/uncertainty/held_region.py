"""The region of a fix that equalities hold, such as a known height: a part of a surface, or of a line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from optloc.adequacy.shape import profile
from optloc.base.types import Array
from optloc.linear.constraints import Face, exact, levels, restore
from optloc.problem.chart import quantile
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.uncertainty.region import passes

# Steps of the grid from the fix to where a Gaussian meets the level, and nodes at most: more than a picture shows.
# Where there are more the steps are doubled, so often that a region of a million standard deviations has an end.
_FINE, _NODES, _DOUBLINGS = 8.0, 4000, 20


@dataclass(frozen=True, slots=True)
class Held:
    """The cost along a surface or line that equalities leave, by coordinates from the fix along its principal axes.

    Parameters
    ----------
    problem : Problem
        Flat batch of one, rows weighted as in the fix.
    face : Face
        The equalities.
    x : array (1, size)
        All unknowns of the fix.
    own : slice
        Which of them are the position.
    axes : array (d, k)
        One standard deviation along each axis, metres.
    least : float
        Cost of the fix.
    quantile : float
        By how much costs of the region exceed it at most: that of chi-square with k degrees of freedom.
    reach : float
        How far from the fix the region goes, metres: where it has no end, it has one.
    starts : array (q, k)
        The fix, and alternatives within the region.
    """

    problem: Problem
    face: Face
    x: Array
    own: slice
    axes: Array
    least: float
    quantile: float
    reach: float
    starts: Array

    def place(self, steps: Array) -> Array:
        """Return the positions (n, d), metres, of coordinates (n, k)."""
        return np.asarray(self._vectors(steps)[:, self.own])

    def away(self, steps: Array) -> Array:
        """Return how far coordinates (n, k) are from the fix, as shares (n,) of the reach."""
        return np.asarray(np.sqrt(((self.place(steps) - self.x[0, self.own]) ** 2).sum(-1)) / self.reach)

    def value(self, steps: Array) -> Array:
        """Return numbers (n,) that are negative inside the region and zero on its edge."""
        points = self._vectors(steps)
        cost = profile(self.problem, points[:, None], self.x, passes(self.problem))[0][:, 0]
        beyond = np.sqrt(((points[:, self.own] - self.x[0, self.own]) ** 2).sum(-1)) / self.reach - 1.0
        return np.asarray(np.maximum((cost - self.least) / self.quantile - 1.0, beyond))

    def flooded(self) -> tuple[Array, float]:
        """Return the nodes (n, k) of a grid that are reached within the region, and its step; none where too many."""
        step = float(np.sqrt(self.quantile)) / _FINE
        for _ in range(_DOUBLINGS):
            found = _flooded(lambda steps: self.value(steps) <= 0.0, self.starts, step)
            if found is not None:
                return found, step
            step *= 2.0
        return np.zeros((0, self.axes.shape[1]), dtype=int), step

    def _vectors(self, steps: Array) -> Array:
        points = np.repeat(self.x, len(steps), axis=0)
        points[:, self.own] += steps @ self.axes.T
        return restore(self.problem, self.face, points)


def hold_along(problem: Problem, fix: Fix, level: float, reach: float) -> Held:
    """Return the cost along what equalities leave of a fix.

    Parameters
    ----------
    problem : Problem
        The problem of the fix: one static position, held by equalities.
    fix : Fix
        A single fix.
    level : float
        Probability that the region contains the target.
    reach : float
        How far from the fix the region goes, metres.
    """
    flat, x = problem.flat().with_rows(weight=fix.weights[None]), fix.x[None]
    face, d = exact(flat), problem.dimension
    slot, _ = problem.layout.find("position")
    own = slice(slot.start, slot.start + d)
    gradients = levels(flat, face, x)[1][0][:, own]
    left = np.linalg.svd(gradients)[2][len(gradients) :].T  # what is orthogonal to all of them
    values, vectors = np.linalg.eigh(left.T @ fix.covariance() @ left)
    axes = left @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    q = quantile(level, axes.shape[1])
    least = float(profile(flat, x[None], x, passes(flat))[0][0, 0])
    others = fix.alternatives.x[:, own][fix.alternatives.gap <= q]
    starts = np.concatenate([np.zeros((1, axes.shape[1])), (others - x[0, own]) @ np.linalg.pinv(axes).T])
    return Held(flat, face, x, own, axes, least, q, reach, starts)


def _flooded(inside: Callable[[Array], Array], starts: Array, step: float) -> Array | None:
    """Return the nodes (n, k) of a grid, in steps, that are reached within a region; None where there are too many."""
    k = starts.shape[1]
    ways = np.array([way for way in product((-1, 0, 1), repeat=k) if any(way)])
    # those around a start are held too: the region may be thinner than a step
    seen = {tuple(node) for node in np.round(starts / step).astype(int).tolist()}
    held, front = set(seen), seen
    while front:
        fresh = {tuple(node) for at in front for node in (np.array(at) + ways).tolist()} - seen
        seen |= fresh
        nodes = np.array(sorted(fresh)).reshape(-1, k)
        good = inside(nodes * step) if len(nodes) else np.zeros(0, dtype=bool)
        front = {tuple(node) for node in nodes[good].tolist()}
        held |= front
        if len(held) > _NODES:
            return None
    return np.array(sorted(held)).reshape(-1, k)

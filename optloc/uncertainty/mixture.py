"""Gaussians in metres that together stand for a region: what a tracker starts from where one alone does not cover."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.problem.chart import CARTESIAN, CURVED
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.uncertainty.arc import trace_from
from optloc.uncertainty.posterior import Samples, along, around, moments
from optloc.uncertainty.surface import Surface

# Slices of a fix: with four the density at the truth is as high as that of the Gaussian in its chart; sixteen have too
# few samples each, and are worse. Arcs are longer than any slice: of a circle each is 15 degrees.
_SLICES, _ARC_SLICES = 4, 24
# Samples of a fix, and where the slices begin and end: beyond lies one in 500.
_SAMPLES, _EDGES = 4096, (0.001, 0.999)
# Fewest samples a dimension of a slice that stands alone.
_FEWEST = 4
# Gap in cost beyond which another minimum weighs nothing: 0.011 of the fix.
_NEGLIGIBLE = 9.0


@dataclass(frozen=True, slots=True)
class Mixture:
    """A sum of Gaussians.

    Parameters
    ----------
    weight : array (q,)
        They sum to one.
    mean : array (q, d)
        Metres.
    covariance : array (q, d, d)
        Square metres.
    """

    weight: Array
    mean: Array
    covariance: Array

    def log_density(self, points: Array) -> Array:
        """Return the logarithm of the density (...), per metre to the dimension, at points (..., d), metres."""
        from scipy.special import logsumexp

        apart = np.asarray(points)[..., None, :] - self.mean
        lower = np.linalg.cholesky(self.covariance)
        white = np.linalg.solve(lower, apart[..., None])[..., 0]
        size = np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1) + 0.5 * apart.shape[-1] * np.log(2.0 * np.pi)
        return np.asarray(logsumexp(-0.5 * (white**2).sum(-1) - size + np.log(self.weight), axis=-1))

    def moments(self) -> tuple[Array, Array]:
        """Return mean (d,) and covariance (d, d) of the whole, metres."""
        mean, spread = moments(self.mean, self.weight)
        return mean, spread + (self.weight[:, None, None] * self.covariance).sum(0)


def mixture(problem: Problem, fix: Fix, k: int = _SLICES, seed: int = 0) -> Mixture:
    """Return Gaussians in metres that stand for what the data say of a position, other minima included.

    Parameters
    ----------
    problem : Problem
        The problem of the fix: one static position.
    fix : Fix
        A single fix.
    k : int
        Slices of a minimum that is Gaussian in its inverse range: of equal logarithm of the range. One that is Gaussian
        in metres is one Gaussian; one that is curved in all coordinates has six times as many, along its arc.
    seed : int
        Decides the draw of the samples whose moments these are.

    Notes
    -----
    A minimum weighs exp(-gap / 2): the integral of its likelihood under Jeffreys' prior, whose determinant cancels that
    of the covariance (Laplace).
    """
    if k < 1:
        raise InvalidProblem(f"{k} slices are none", "k", "4 are enough")
    parts = [(1.0, _slices(Surface.of(problem, fix), k, seed))]
    for x, gap in zip(fix.alternatives.x, fix.alternatives.gap, strict=True):
        if gap < _NEGLIGIBLE and np.isfinite(x).all():
            parts.append((float(np.exp(-0.5 * max(gap, 0.0))), _slices(Surface.at(problem, fix, x), k, seed)))
    weight = np.concatenate([size * part.weight for size, part in parts])
    return Mixture(
        weight / weight.sum(),
        np.concatenate([part.mean for _, part in parts]),
        np.concatenate([part.covariance for _, part in parts]),
    )


def _slices(surface: Surface, k: int, seed: int) -> Mixture:
    """Return the Gaussians of one minimum; their weights sum to one."""
    chart = surface.chart
    if surface.kind == CARTESIAN:
        return Mixture(np.ones(1), chart.position[None], chart.covariance[None])
    if surface.kind == CURVED:
        arc = trace_from(surface)
        drawn = along(arc, _SAMPLES, seed)
        number, edges = arc.locate(drawn.position)[0], np.linspace(0.0, 1.0, k * _ARC_SLICES // _SLICES + 1)
    else:
        drawn = around(surface, _SAMPLES, seed)
        number = np.log(np.sqrt(((drawn.position - chart.centre) ** 2).sum(-1)))
        low, high = _quantiles(number, drawn.weight)
        edges = np.linspace(low, high, k + 1)
    return _by_slice(drawn, np.searchsorted(edges, number, side="right") - 1, len(edges) - 1)


def _quantiles(values: Array, weight: Array) -> list[float]:
    order = np.argsort(values)
    return [float(v) for v in np.interp(_EDGES, np.cumsum(weight[order]), values[order])]


def _by_slice(drawn: Samples, slice_of: Array, k: int) -> Mixture:
    """Return moments and weights of the samples in k slices; one with too few samples is joined to its neighbour."""
    fewest, groups = _FEWEST * drawn.position.shape[1], [np.zeros(len(slice_of), dtype=bool)]
    for i in range(k):
        if groups[-1].sum() >= fewest:
            groups.append(slice_of == i)
        else:
            groups[-1] = groups[-1] | (slice_of == i)
    if len(groups) > 1 and groups[-1].sum() < fewest:
        last = groups.pop()
        groups[-1] = groups[-1] | last
    found = [(drawn.weight[own].sum(), *moments(drawn.position[own], drawn.weight[own])) for own in groups]
    weight, mean, covariance = (np.array(each) for each in zip(*found, strict=True))
    return Mixture(weight / weight.sum(), mean, covariance)

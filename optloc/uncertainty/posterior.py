"""Samples of the posterior position, and a sum of a few Gaussians that approximates it.

Letters: n samples, d coordinates, q Gaussians. The inverse-range chart has a direction p and an inverse range w, which
is 1 at the fix and 0 at infinity (`optloc.problem.chart`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.problem.truncated import Truncated
from optloc.uncertainty.arc import Arc, student, trace_from
from optloc.uncertainty.region import RegionSurface

Belief = Literal["jeffreys", "flat"]

# Factor of the proposal over the ellipsoid of the fix: 0.8 of the samples are then effective (median).
_WIDER = 1.1
# Share of effective samples below which a mean is not reliable.
_POOR = 0.1
# Least w of a sample in the inverse-range chart: one rounding from infinity.
_LEAST_W = 1e-12


@dataclass(frozen=True, slots=True)
class Samples:
    """Weighted samples of a position.

    Parameters
    ----------
    position : array (n, d)
        Metres.
    weight : array (n,)
        Weights; they sum to one.
    prior : str
        Prior of the position: "jeffreys", "flat", or "arc" for a uniform prior along an arc.
    within : float, optional
        Radius of the ball around the middle of the stations that contains all samples, metres.
    bounded : bool
        Whether moments exist; they do not if infinity has density.
    reason : str
        Sentence on a fault of the samples; empty without one.
    """

    position: Array
    weight: Array
    prior: str
    within: float | None
    bounded: bool
    reason: str = ""

    @property
    def effective(self) -> float:
        """Return the effective number of samples: one over the sum of squared weights."""
        return float(1.0 / (self.weight**2).sum())

    @property
    def mean(self) -> Array:
        """Return the mean (d,), metres; raise InvalidProblem if infinity has density and no ball limits the samples."""
        self._demand("mean")
        return np.asarray(self.weight @ self.position)

    @property
    def covariance(self) -> Array:
        """Return the covariance (d, d), square metres; raise InvalidProblem in the same case as `mean`."""
        self._demand("covariance")
        return moments(self.position, self.weight)[1]

    def drawn(self, n: int, seed: int) -> Array:
        """Return n positions (n, d) of equal weight: systematic resampling.

        References
        ----------
        G. Kitagawa, "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models" (1996).
        """
        place = (np.random.default_rng(seed).random() + np.arange(n)) / n
        chosen = np.searchsorted(np.cumsum(self.weight), place).clip(max=len(self.weight) - 1)
        return np.asarray(self.position[chosen])

    def _demand(self, what: str) -> None:
        """Raise InvalidProblem if moments do not exist; `what` is the name of the moment in the message."""
        if not self.bounded:
            raise InvalidProblem(
                f"infinity has density, so the {what} in metres does not exist",
                "samples",
                "limit the samples to a ball by `within`",
            )


def moments(position: Array, weight: Array) -> tuple[Array, Array]:
    """Return mean (d,) and covariance (d, d) of positions (n, d) with weights (n,), in the unit of the positions."""
    share = weight / weight.sum()
    mean = share @ position
    apart = position - mean
    return mean, np.asarray((apart * share[:, None]).T @ apart)


def samples(
    problem: Problem, fix: Fix, n: int = 1024, seed: int = 0, *, prior: Belief = "jeffreys", within: float | None = None
) -> Samples:
    """Return weighted samples of the position that the data allow around a fix.

    Parameters
    ----------
    problem : Problem
        The problem of the fix: one static position.
    fix : Fix
        A single fix; its alternatives are ignored, see `optloc.uncertainty.mixture`.
    n : int
        Number of samples; powers of two are spread most evenly.
    seed : int
        Seed of the draw.
    prior : "jeffreys" or "flat"
        Prior of the position. Jeffreys' prior is the root of the determinant of the information. It does not depend on
        the coordinates and is proper at infinity. A flat prior is improper if the cost stays finite at infinity, so it
        needs `within`. If the fix is curved in all coordinates, the prior is uniform along its arc.
    within : float, optional
        Radius of a ball around the middle of the stations that limits the position, metres.

    Notes
    -----
    Importance sampling from a Student distribution by Sobol points. If the fix is Gaussian in metres or in the
    inverse-range chart, these coordinates are used; the weights make the samples exact.

    References
    ----------
    H. Jeffreys, "An invariant form for the prior probability in estimation problems" (1946).
    """
    if prior not in ("jeffreys", "flat"):
        raise InvalidProblem(f"unknown prior {prior!r}", "prior", "use 'jeffreys' or 'flat'")
    if prior == "flat" and within is None:
        raise InvalidProblem(
            "a flat prior is infinite, and the samples depend on its limit", "prior", "give the radius `within`, metres"
        )
    surface = RegionSurface.of(problem, fix)
    if surface.kind == CURVED:
        return along(trace_from(surface), n, seed, within)
    return around(surface, n, seed, prior, within)


def around(surface: RegionSurface, n: int, seed: int, prior: str = "jeffreys", within: float | None = None) -> Samples:
    """Return samples of a fix that is Gaussian in metres or in the inverse-range chart; arguments as of `samples`.

    `surface` is the cost around the fix.
    """
    chart, inverse = surface.chart, surface.kind == INVERSE_RANGE
    if chart.truncated is not None and chart.cut_off:
        return _within_bounds(surface, chart.truncated, n, seed, prior, within)
    start, spread = (chart.mean, chart.spread) if inverse else (chart.position, chart.covariance)
    _, points, log_proposal = student(len(start), n, seed)
    scale = np.sqrt(np.diagonal(spread))
    y = start + _WIDER * scale * (points @ np.linalg.cholesky(spread / np.outer(scale, scale)).T)
    # samples beyond infinity are moved to the fix, and get no weight
    good = y[:, -1] > _LEAST_W if inverse else np.ones(n, dtype=bool)
    y = np.where(good[:, None], y, start)
    position = chart.to_position(y) if inverse else y
    cost, information, _ = surface.look(position)
    log_weight = -0.5 * (cost - surface.least) - log_proposal
    log_weight += chart.log_volume(y) if inverse else 0.0
    if prior == "jeffreys":
        log_weight += 0.5 * np.linalg.slogdet(_scaled(information, position, chart.centre, inverse))[1]
        # `_scaled` has multiplied the root of the determinant by the distance to the power of d
        log_weight -= (len(start) * np.log(np.sqrt(((position - chart.centre) ** 2).sum(-1)))) if inverse else 0.0
    if within is not None:
        good &= ((position - chart.centre) ** 2).sum(-1) <= within**2
    return weighed(position, np.where(good, log_weight, -np.inf), prior, within, not inverse or within is not None)


def _within_bounds(
    surface: RegionSurface, law: Truncated, n: int, seed: int, prior: str, within: float | None
) -> Samples:
    """Return samples of a fix with a truncated law: drawn from the law, weighted by the cost.

    The other arguments are as in `samples`.
    """
    away, excess = law.draw(n, seed)
    position, centre = surface.position + away, surface.chart.centre
    cost, information, _ = surface.look(position)
    log_weight = -0.5 * (cost - surface.least - excess)
    if prior == "jeffreys":
        log_weight += 0.5 * np.linalg.slogdet(information)[1]
    good = np.ones(n, dtype=bool) if within is None else ((position - centre) ** 2).sum(-1) <= within**2
    return weighed(position, np.where(good, log_weight, -np.inf), prior, within, True)


def _scaled(information: Array, position: Array, centre: Array, inverse: bool) -> Array:
    """Return information (n, d, d) times the squared distance from the centre, for the inverse-range chart.

    Far away, information in metres is only rounding. If `inverse` is False, the information is returned unchanged.
    """
    if not inverse:
        return information
    return np.asarray(information * ((position - centre) ** 2).sum(-1)[:, None, None])


def along(arc: Arc, n: int, seed: int, within: float | None = None) -> Samples:
    """Return n samples along an arc from a seed, see `optloc.uncertainty.arc.Arc.draw`.

    `within` is the radius of a ball that limits the positions, metres; None for no limit.
    """
    position, log_weight, _ = arc.draw(n, seed)
    if within is not None:
        away = ((position - arc.surface.chart.centre) ** 2).sum(-1)
        log_weight = np.where(away <= within**2, log_weight, -np.inf)
    return weighed(position, log_weight, "arc", within, not arc.far or within is not None)


def weighed(position: Array, log_weight: Array, prior: str, within: float | None, bounded: bool) -> Samples:
    """Return samples with normalised weights, and a reason if too few are effective.

    `log_weight` (n,) are logarithms of weights up to a constant; -inf drops a sample. The other arguments are fields of
    `Samples`.
    """
    kept = log_weight > -np.inf
    if not kept.any():
        raise InvalidProblem("no sample is within the ball", "within", "the fix is outside: give a larger radius")
    weight = np.exp(log_weight[kept] - log_weight[kept].max())
    weight /= weight.sum()
    found = Samples(position[kept], weight, prior, within, bounded)
    if found.effective >= _POOR * len(position):
        return found
    sentence = (
        f"only {found.effective:.0f} of {len(position)} samples are effective: the proposal differs from the posterior"
    )
    return Samples(found.position, weight, prior, within, bounded, sentence)


# A sum of a few Gaussians.

# Slices of a fix: with four the density at the truth is as high as with the Gaussian in its chart; sixteen have too few
# samples each, and are worse. Arcs are longer than any slice: of a circle each slice is 15 degrees.
_SLICES, _ARC_SLICES = 4, 24
# Samples of a fix, and quantiles at which the slices begin and end: one sample in 500 is outside.
_SAMPLES, _EDGES = 4096, (0.001, 0.999)
# Fewest samples, per dimension, of a separate slice.
_FEWEST = 4
# Gap in cost beyond which another minimum is ignored: its weight is 0.011 of the fix.
_NEGLIGIBLE = 9.0


@dataclass(frozen=True, slots=True)
class Mixture:
    """A sum of Gaussians.

    Parameters
    ----------
    weight : array (q,)
        Weights; they sum to one.
    mean : array (q, d)
        Metres.
    covariance : array (q, d, d)
        Square metres.
    """

    weight: Array
    mean: Array
    covariance: Array

    def log_density(self, points: Array) -> Array:
        """Return the natural logarithm of the density (...), per m^d, at points (..., d), metres."""
        from scipy.special import logsumexp

        apart = np.asarray(points)[..., None, :] - self.mean
        lower = np.linalg.cholesky(self.covariance)
        white = np.linalg.solve(lower, apart[..., None])[..., 0]
        size = np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1) + 0.5 * apart.shape[-1] * np.log(2.0 * np.pi)
        return np.asarray(logsumexp(-0.5 * (white**2).sum(-1) - size + np.log(self.weight), axis=-1))

    def moments(self) -> tuple[Array, Array]:
        """Return mean (d,), metres, and covariance (d, d), square metres, of the sum."""
        mean, spread = moments(self.mean, self.weight)
        return mean, spread + (self.weight[:, None, None] * self.covariance).sum(0)


def mixture(problem: Problem, fix: Fix, k: int = _SLICES, seed: int = 0) -> Mixture:
    """Return Gaussians in metres that approximate the posterior position, including other minima.

    Parameters
    ----------
    problem : Problem
        The problem of the fix: one static position.
    fix : Fix
        A single fix.
    k : int
        Slices of a minimum that is Gaussian in its inverse range, equal in the logarithm of the range. A minimum that
        is Gaussian in metres is one Gaussian. A minimum that is curved in all coordinates has six times as many slices,
        along its arc.
    seed : int
        Seed of the samples from which the moments are computed.

    Notes
    -----
    The weight of a minimum is exp(-gap / 2): the integral of its likelihood under Jeffreys' prior, whose determinant
    cancels the determinant of the covariance (Laplace).
    """
    if k < 1:
        raise InvalidProblem(f"{k} slices are not possible", "k", "give 1 or more; 4 are enough")
    parts = [(1.0, _slices(RegionSurface.of(problem, fix), k, seed))]
    for x, gap in zip(fix.alternatives.x, fix.alternatives.gap, strict=True):
        if gap < _NEGLIGIBLE and np.isfinite(x).all():
            parts.append((float(np.exp(-0.5 * max(gap, 0.0))), _slices(RegionSurface.at(problem, fix, x), k, seed)))
    weight = np.concatenate([size * part.weight for size, part in parts])
    return Mixture(
        weight / weight.sum(),
        np.concatenate([part.mean for _, part in parts]),
        np.concatenate([part.covariance for _, part in parts]),
    )


def _slices(surface: RegionSurface, k: int, seed: int) -> Mixture:
    """Return the Gaussians of one minimum; their weights sum to one. `k` and `seed` are as in `mixture`."""
    chart = surface.chart
    if surface.kind == CARTESIAN:
        law = chart.truncated if chart.cut_off else None
        mean = chart.position if law is None else chart.position + law.moments()[0]
        return Mixture(np.ones(1), mean[None], chart.covariance[None])
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
    """Return the two weighted quantiles of values (n,) at which slices begin and end."""
    order = np.argsort(values)
    return [float(v) for v in np.interp(_EDGES, np.cumsum(weight[order]), values[order])]


def _by_slice(drawn: Samples, slice_of: Array, k: int) -> Mixture:
    """Return moments and weights of the samples in k slices; slices with too few samples join a neighbour.

    `slice_of` (n,) is the slice of each sample; samples outside all slices are dropped.
    """
    # neighbouring slices are collected in a group until the group has enough samples for a covariance
    fewest, groups = _FEWEST * drawn.position.shape[1], [np.zeros(len(slice_of), dtype=bool)]
    for i in range(k):
        if groups[-1].sum() >= fewest:
            groups.append(slice_of == i)
        else:
            groups[-1] = groups[-1] | (slice_of == i)
    if len(groups) > 1 and groups[-1].sum() < fewest:
        last = groups.pop()
        groups[-1] = groups[-1] | last
    found = [
        (drawn.weight[members].sum(), *moments(drawn.position[members], drawn.weight[members])) for members in groups
    ]
    weight, mean, covariance = (np.array(each) for each in zip(*found, strict=True))
    return Mixture(weight / weight.sum(), mean, covariance)

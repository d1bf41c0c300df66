"""Uncertain fences: the knowledge ``n . x <= b + N(0, s^2)`` as a smooth convex term of the cost.

The boundary of the half-plane is at ``b + e``, where e is a normal error. So the probability that the target x is
inside is ``Phi(u)`` with the margin ``u = (b - n . x) / s``, and the term is ``-2 log Phi(u)``. Phi and phi are the
distribution function and the density of the standard normal distribution; the hazard is ``w = phi(u) / Phi(u)``.

The second derivative ``w (u + w)`` is exact and between 0 and 1, so that the normal equations stay positive definite. A
residual ``r = sqrt(-2 log Phi(u))`` would give the Gauss-Newton term ``r'^2``. It is too small by up to a factor of two
near the boundary, so the covariance would be too large there.

A fence adds no degree of freedom. Far inside, its cost is zero and the chi-square test does not change. Near or beyond
the boundary its cost makes the p-value smaller, never larger.

Letters: N problems, n shared unknowns, d coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.arrays import as_array_like, library
from optloc.base.errors import InvalidProblem
from optloc.base.types import Amount, Array, Fence
from optloc.base.units import in_si
from optloc.models.primitives import namespace
from optloc.problem.chart import Skew
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem

# Coefficients of the Chebyshev series P(2 t - 1). For z >= 0, ``erfc(z) = t exp(P - z^2)`` with ``t = 2 / (2 + z)``.
# The form is from W. H. Press et al., "Numerical Recipes" (3rd ed., 2007), section 6.2.2. The numbers are projections
# of the exact function, computed with 50 digits; the next coefficient is below 1e-16.
_CHEBYSHEV = (
    -0.6513268598908547,
    0.64196979235649021,
    0.019476473204185836,
    -0.0095615147868086323,
    -0.00094659534448203692,
    0.00036683949785276145,
    4.2523324806907769e-05,
    -2.0278578112534242e-05,
    -1.6242900046470256e-06,
    1.3036558355805232e-06,
    1.5626441722066142e-08,
    -8.5238095914926541e-08,
    6.5290544390988515e-09,
    5.0593434955514693e-09,
    -9.9136415649303307e-10,
    -2.273651222931836e-10,
    9.646791102015527e-11,
    2.3940380830391146e-12,
    -6.8860275264975532e-12,
    8.9448792730907253e-13,
    3.1309213993429581e-13,
    -1.1270822361367252e-13,
    3.8109052551892321e-16,
    7.1060976136092371e-15,
    -1.5230282014571043e-15,
    -9.4574945712912334e-17,
    1.210237189224279e-16,
)
_ROOT_HALF, _HAZARD_AT_ZERO = np.sqrt(0.5), np.sqrt(2.0 / np.pi)
# Margin below which rounding of ``u + w`` exceeds the error 1e-10 of the expansion 1 - 1/u^2 + 6/u^4 of ``w (u + w)``.
_FAR_OUTSIDE = -100.0
# Sweeps over several fences, and change of a site in standard deviations at which they end: each sweep wins a digit.
_SWEEPS, _SETTLED = 50, 1e-9
# Share of the information across a fence that the rows must have. With less, only the fence limits the target, and on
# one side: there is no covariance.
_ALONE = 1e-12


def fence(
    normal: ArrayLike, offset: Amount | Array, sigma: Amount | Array, *, target: int = 0, name: str = "fence"
) -> tuple[Fence, ...]:
    """Return the knowledge that a target is in a half-plane with an uncertain boundary: ``n . x <= b + N(0, s^2)``.

    Give it to `optloc.assemble` with the constraints. It is no constraint, but a term of the cost: a target beyond the
    boundary is improbable, not impossible. For an exact boundary use a half-plane or a box.

    Parameters
    ----------
    normal : array (..., d)
        Normal n, directed out of the half-plane. It is scaled to unit length, and offset and sigma with it.
    offset : float, str or array (...)
        Stated place b of the boundary: metres, or text such as "2 km".
    sigma : float, str or array (...)
        Standard deviation s of the place, metres or text.
    target : int
        Number of the target. Of a moving target, the position at the reference time counts.
    name : str
        Name in reports.

    Raises
    ------
    InvalidProblem
        If the normal is zero, if sigma is not positive, or if a number is not finite.
    """
    direction = np.asarray(normal, dtype=float)
    place, spread = (
        np.asarray(in_si(value, "length", name, place=what == "offset"), dtype=float)
        for what, value in (("offset", offset), ("sigma", sigma))
    )
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt((direction**2).sum(-1))
    if direction.ndim == 0 or not (np.isfinite(length) & (length > 0.0)).all():
        raise InvalidProblem("the normal is not a direction", name, "give a vector such as (1, 0)")
    if not np.isfinite(place).all():
        raise InvalidProblem("the offset is not a finite number", name, "give metres, or leave the fence out")
    if not (np.isfinite(spread) & (spread > 0.0)).all():
        raise InvalidProblem("sigma is not a positive number", name, "give metres; for an exact boundary use a box")
    # all numbers get the same batch axes
    place, spread = np.broadcast_arrays(place / length, spread / length)
    unit = np.broadcast_to(direction / length[..., None], (*place.shape, direction.shape[-1]))
    return (Fence(unit, place, spread, name, target),)


def cost_of_margin(u: Any) -> Any:
    """Return ``-2 log Phi(u)`` (...) for margins u (...): arrays of any library, or CasADi symbols.

    The relative error is below 1e-12 for margins from -1e150 to 37; beyond 38 the result is zero.
    """
    choose, xp = _choose(u), namespace(u)
    # Both branches are evaluated for all margins, and derivatives too. So each branch has its own harmless argument.
    inside, outside = choose(u >= 0.0, u, 0.0 * u), choose(u >= 0.0, 0.0 * u, -u)
    t, series = _series(_ROOT_HALF * inside)
    log1p = _log1p if xp.__name__ == "casadi" else xp.log1p
    near = -2.0 * log1p(-0.5 * t * xp.exp(series - 0.5 * inside * inside))
    t, series = _series(_ROOT_HALF * outside)
    return choose(u >= 0.0, near, outside * outside - 2.0 * (xp.log(0.5 * t) + series))


def derivatives_of_margin(u: Any) -> tuple[Any, Any]:
    """Return the hazards w (...) and ``w (u + w)`` (...) of margins u (...): half of minus f', and half of f''.

    f is `cost_of_margin`.
    """
    xp = library(u)
    inside, outside = xp.where(u >= 0.0, u, 0.0 * u), xp.where(u >= 0.0, 0.0 * u, -u)
    t, series = _series(_ROOT_HALF * inside)
    density = xp.exp(-0.5 * inside * inside)
    within = 0.5 * _HAZARD_AT_ZERO * density / (1.0 - 0.5 * t * xp.exp(series) * density)
    t, series = _series(_ROOT_HALF * outside)
    w = xp.where(u >= 0.0, within, _HAZARD_AT_ZERO / (t * xp.exp(series)))
    far = u < _FAR_OUTSIDE
    small = 1.0 / xp.where(far, u, -1.0 + 0.0 * u)
    return w, xp.where(far, 1.0 - small * small * (1.0 - 6.0 * small * small), w * (u + w))


def _choose(u: Any) -> Callable[[Any, Any, Any], Any]:
    """Return the function ``where(condition, yes, no)`` of the library of a value."""
    if type(u).__module__.startswith("casadi"):
        from casadi import if_else

        return if_else
    return library(u).where  # type: ignore[no-any-return]


def _log1p(x: Any) -> Any:
    """Return log(1 + x) of a CasADi symbol between -1/2 and 0, with all digits."""
    import casadi as ca

    # older versions of CasADi have the function, but not its derivative in generated code
    return 2.0 * ca.atanh(x / (2.0 + x))


def _series(z: Any) -> tuple[Any, Any]:
    """Return t and the series P of ``erfc(z) = t exp(P - z^2)`` for z (...) of at least zero."""
    t = 2.0 / (2.0 + z)
    # Clenshaw's recurrence
    twice, last, before = 4.0 * t - 2.0, 0.0 * z, 0.0 * z
    for coefficient in _CHEBYSHEV[:0:-1]:
        last, before = twice * last - before + coefficient, last
    return t, 0.5 * twice * last - before + _CHEBYSHEV[0]


def slot_name(problem: Problem, fence: Fence) -> str:
    """Return the name of the unknown position that a fence bounds."""
    return state_names(fence.target, len(problem.motions), 0)[0]


class FenceTerm(NamedTuple):
    """A fence as a function of positions: the name of its unknown, and its numbers in the library of the positions.

    If each epoch has a position, the fence applies at each epoch. The arrays then have an axis of length one for the
    epochs.
    """

    name: str
    normal: Any
    offset: Any
    sigma: Any

    def __call__(self, position: Any) -> tuple[Any, Any, Any]:
        """Return precision (..., d, d), pull (..., d) and cost (...): half of f'', half of minus f', and f."""
        u = (self.offset - (self.normal * position).sum(-1)) / self.sigma
        w, bend = derivatives_of_margin(u)
        unit = self.normal / self.sigma[..., None]
        precision = bend[..., None, None] * unit[..., :, None] * unit[..., None, :]
        return precision, -w[..., None] * unit, cost_of_margin(u)


def fence_terms(problem: Problem, x: Any) -> Iterator[FenceTerm]:
    """Yield the fences of a problem as functions of positions, in the library of the vectors x (..., size)."""
    for one in problem.fences:
        name = slot_name(problem, one)
        normal, offset, sigma = one.normal, one.offset, one.sigma
        if not problem.layout.shares(name):
            normal, offset, sigma = normal[..., None, :], offset[..., None], sigma[..., None]
        yield FenceTerm(name, *(as_array_like(array, x) for array in (normal, offset, sigma)))


def fence_information(problem: Problem, x: Array) -> Array:
    """Return the information (n, n) of the fences about the n shared unknowns, at one vector x (size,)."""
    u, lines, _ = _lines(problem, x[None])
    return np.asarray((lines[0].T * derivatives_of_margin(u[0])[1]) @ lines[0])


def symbolic_cost(problem: Problem, x: Any, p: Any) -> Any:
    """Return the cost of all fences of a single problem as a CasADi expression.

    Parameters
    ----------
    problem : Problem
        Only its structure enters the expression.
    x : casadi.SX (size, 1)
        Parameter vector.
    p : casadi.SX (q, 1)
        Numbers in the order of `fence_numbers`.
    """
    total, d, layout = 0.0, problem.dimension, problem.layout
    for i, one in enumerate(problem.fences):
        slot, shared = layout.find(slot_name(problem, one))
        normal, offset, sigma = p[i * (d + 2) : i * (d + 2) + d], p[i * (d + 2) + d], p[i * (d + 2) + d + 1]
        for k in range(1 if shared else layout.epochs):
            start = slot.start + (0 if shared else layout.n_shared + k * layout.n_local)
            total = total + cost_of_margin((offset - normal.T @ x[start : start + d]) / sigma)
    return total


def fence_numbers(problem: Problem) -> Array:
    """Return the numbers (q,) of the fences of a single problem: normal, offset and sigma of each."""
    return np.concatenate(
        [np.zeros(0), *(np.ravel(part) for one in problem.fences for part in (one.normal, one.offset, one.sigma))]
    )


# The posterior: the law of the position without fences, times the probabilities of all fences.


class Unfenced(NamedTuple):
    """The Gaussian model of N problems without their fences, from their fixes with fences.

    Parameters
    ----------
    shift : array (N, n)
        Mean of the shared unknowns minus the fix, SI units.
    covariance : array (N, n, n)
        Covariance; NaN if the rows alone do not determine the target across a fence.
    cost : array (N,)
        Cost of the rows and priors at the mean, minus the whole cost at the fix.
    """

    shift: Array
    covariance: Array
    cost: Array


def _lines(problem: Problem, x: Array) -> tuple[Array, Array, Array]:
    """Return margins u (N, J), gradients of u (N, J, n) with a minus sign, and costs (N, J) of the J shared fences."""
    n, terms = problem.layout.n_shared, [t for t in fence_terms(problem, x) if problem.layout.shares(t.name)]
    u, lines = np.zeros((len(x), len(terms))), np.zeros((len(x), len(terms), n))
    for j, term in enumerate(terms):
        slot, _ = problem.layout.find(term.name)
        part = slice(slot.start, slot.start + slot.size)
        u[:, j] = (term.offset - (term.normal * x[:, part]).sum(-1)) / term.sigma
        lines[:, j, part] = term.normal / term.sigma[..., None]
    return u, lines, cost_of_margin(u)


def margins(problem: Problem, x: Array) -> Array:
    """Return the margins u (N, J) of the fences whose targets have one position, at vectors x (N, size)."""
    return _lines(problem, x)[0]


def unfenced(problem: Problem, x: Array, covariance: Array) -> Unfenced:
    """Return the Gaussian model of N problems without their fences.

    `x` (N, size) are fixes with fences, and `covariance` (N, n, n) is the inverse of their information, with the second
    derivatives of the fences. The result follows by Woodbury's identity, so it is also valid along equalities.
    """
    u, lines, costs = _lines(problem, x)
    w, bend = derivatives_of_margin(u)
    across = covariance @ lines.mT
    # bend^(1/2) scales the fences, because a far fence has none
    root = np.sqrt(bend)[..., None, :]
    inner = np.eye(u.shape[1]) - root.mT * (lines @ across) * root
    known = np.isfinite(inner).all((-1, -2))
    inner = np.where(known[:, None, None], inner, np.eye(u.shape[1]))
    known &= np.linalg.eigvalsh(inner).min(-1, initial=1.0) > _ALONE
    inner = np.where(known[:, None, None], inner, np.eye(u.shape[1]))
    free = covariance + across * root @ np.linalg.solve(inner, root.mT * across.mT)
    free = np.where(known[:, None, None], free, np.nan)
    pull = (lines.mT @ w[..., None])[..., 0]
    shift = (free @ pull[..., None])[..., 0]
    return Unfenced(shift, free, -costs.sum(-1) - (pull * shift).sum(-1))


def skew_of(problem: Problem, x: Array, covariance: Array, part: slice) -> Skew | None:
    """Return the laws of the positions at the columns `part`, or None without fences; arguments as for `unfenced`."""
    if not problem.fences:
        return None
    with np.errstate(all="ignore"):
        free, (u, lines, _) = unfenced(problem, x, covariance), _lines(problem, x)
    return Skew(u, lines[..., part], free.shift[:, part], free.covariance[:, part, part])


def posterior_spread(problem: Problem, x: Array, covariance: Array) -> Array:
    """Return the mean squared errors (N, n, n) of fixes under their posterior laws, with the skewness of the fences.

    The posterior is the Gaussian law without fences times ``Phi(u)`` of each fence. The fix is its mode, so the result
    is the covariance plus the square of mean minus mode. For one fence it is exact. For several it is expectation
    propagation, which matches the moments of one fence after the other.

    Parameters
    ----------
    problem, x, covariance
        As for `unfenced`.

    References
    ----------
    C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning" (2006), section 3.6, eq. 3.58.
    """
    free, (u, lines, _) = unfenced(problem, x, covariance), _lines(problem, x)
    mean, spread = free.shift, free.covariance
    precision, pull = np.zeros(u.shape), np.zeros(u.shape)
    for _ in range(_SWEEPS):
        before = mean
        for j in range(u.shape[1]):
            line = lines[:, j]
            across = (spread @ line[..., None])[..., 0]
            variance, place = (across * line).sum(-1), (mean * line).sum(-1)
            # the law without this fence, along its normal and in units of its sigma
            share = np.maximum(1.0 - precision[:, j] * variance, _ALONE)
            variance, place = variance / share, (place - pull[:, j] * variance) / share
            length = np.sqrt(1.0 + variance)
            margin = (u[:, j] - place) / length
            w, bend = derivatives_of_margin(margin)
            bend = bend / length**2
            new = bend / (1.0 - variance * bend)
            other = new * place - w / length * (1.0 + variance * new)
            change, more = new - precision[:, j], other - pull[:, j]
            precision[:, j], pull[:, j] = new, other
            gain = 1.0 + change * (across * line).sum(-1)
            at = (mean * line).sum(-1)
            mean = mean + across * ((more - change * at) / gain)[:, None]
            spread = spread - (change / gain)[:, None, None] * across[..., :, None] * across[..., None, :]
        scale = np.sqrt(np.maximum(np.diagonal(spread, axis1=-2, axis2=-1), 1e-300))
        if u.shape[1] < 2 or np.nanmax(np.abs(mean - before) / scale, initial=0.0) < _SETTLED:
            break
    return np.asarray(spread + mean[..., :, None] * mean[..., None, :])

"""A fixed number of Gauss-Newton steps on arrays of any library, for accelerators and for use in other programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from optloc.base.arrays import as_array_like, is_other_library, library
from optloc.base.errors import InvalidProblem
from optloc.linear.normal import Normal, covariance, depends_on_place, linearise, normal, step, whitener_at, with_priors
from optloc.problem.noise import Whitener
from optloc.problem.problem import Problem


@dataclass(frozen=True, slots=True)
class Estimate:
    """The vectors after a fixed number of steps, without a verdict.

    Parameters
    ----------
    x : array (..., size)
        Parameter vectors, ordered by ``problem.layout``.
    covariance : array (..., n, n)
        Covariance of the shared unknowns at `x`; NaN if the geometry is singular.
    cost : array (...)
        Weighted sum of squared residuals and prior penalties at `x`.
    regular : bool array (...)
        Whether every step had a solution; a problem without a solution keeps its vector.
    """

    x: Any
    covariance: Any
    cost: Any
    regular: Any


def gauss_newton(problem: Problem, x: Any, *, steps: int = 10, damping: float = 0.0) -> Estimate:
    """Return the vectors after a fixed number of Gauss-Newton steps from given starts.

    The function uses only operations of the array-API standard and no branches that depend on values. So arrays of JAX,
    PyTorch, CuPy or another library stay in their library and on their device. The function does not check whether the
    result is a minimum, or the best one; use `optloc.solve` for this. Constraints are ignored.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...). Its numbers are numpy arrays or, after ``problem.placed(x)``, arrays of the library
        of `x`.
    x : array (..., size)
        Starts, ordered by ``problem.layout``. They determine the library, the device and the float type.
    steps : int
        Number of steps, at least one.
    damping : float
        Marquardt's factor: the diagonal of the information is multiplied by ``1 + damping``; 0 for undamped steps.

    Returns
    -------
    Estimate
        Arrays of the library of `x`.

    Raises
    ------
    InvalidProblem
        If `steps` or `damping` is out of range, or if the noise of the rows depends on the position of the target,
        which only numpy arrays support.

    References
    ----------
    W. H. Foy, "Position-location solutions by Taylor-series estimation", IEEE Trans. Aerosp. Electron. Syst. 12
    (1976) 187-194.
    """
    if steps < 1 or not damping >= 0.0:
        raise InvalidProblem(f"{steps} steps with damping {damping:g}", "gauss_newton", "give steps >= 1, damping >= 0")
    noise = whiteners(problem, x)
    equations = _equations(problem, x, noise)
    # Same shape and library as the cost.
    factor = as_array_like(damping, equations.cost) + 0.0 * equations.cost
    # True except for NaN, as a mask on the device of the array.
    regular: Any = equations.cost == equations.cost
    for _ in range(steps):
        # A step without a solution is zero: the problem keeps its vector, and the other problems continue.
        move, solvable = step(equations, factor)
        x, regular = x + move, regular & solvable
        equations = _equations(problem, x, noise)
    spread, _ = covariance(equations)
    return Estimate(x, spread, equations.cost, regular)


def whiteners(problem: Problem, x: Any) -> tuple[Whitener, ...] | None:
    """Return the whitening matrices of a problem, or None if they depend on `x`, so that each step computes its own.

    In the second case, arrays of another library than numpy raise `InvalidProblem`.
    """
    if not depends_on_place(problem):
        return whitener_at(problem, x)
    if is_other_library(x):
        raise InvalidProblem(
            f"station errors that depend on the target, with arrays of {library(x).__name__}",
            "stations",
            'use numpy arrays, or station errors of span "epoch"',
        )
    return None


def _equations(problem: Problem, x: Any, noise: tuple[Whitener, ...] | None) -> Normal:
    """Return the normal equations with priors at vectors x (..., size); `noise` is the result of `whiteners`."""
    return with_priors(problem, x, normal(linearise(problem, x, noise), problem.epochs))

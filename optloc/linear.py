"""One linearisation for everything: residual and Jacobian of a problem at a point."""

from __future__ import annotations

from dataclasses import dataclass

from optloc.evaluate import differentiate
from optloc.noise import Whitener
from optloc.problem import Problem
from optloc.types import Array
from optloc.weigh import whitener_at


@dataclass(frozen=True, slots=True)
class Linear:
    """A problem linearised at a point.

    Parameters
    ----------
    residual : array (..., m)
        Measured less modelled, z - h(x); angles wrapped.
    shared : array (..., m, n)
        Derivative of h with respect to the shared unknowns.
    local : array (..., m, l)
        Derivative of h with respect to the local unknowns of the row's epoch.
    epoch : int array (m,)
        Epoch of each row.
    noise : tuple of Whitener
        Whitening matrices of the noise blocks.
    """

    residual: Array
    shared: Array
    local: Array
    epoch: Array
    noise: tuple[Whitener, ...]


def linearise(problem: Problem, x: Array, noise: tuple[Whitener, ...] | None = None) -> Linear:
    """Return residual, Jacobian and noise of a problem at a point.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size)
        Parameter vectors, ordered by ``problem.layout``.
    noise : tuple of Whitener, optional
        Whitening matrices made before; None: made from the problem, station errors of span "noise" at `x` included.

    Returns
    -------
    Linear
        With leading axes (...).
    """
    residual, jacobian = differentiate(problem, x)
    n = problem.layout.n_shared
    return Linear(
        residual,
        jacobian[..., :n],
        jacobian[..., n:],
        problem.epoch,
        whitener_at(problem, x) if noise is None else noise,
    )

"""The Cramer-Rao bound: what no unbiased estimate can beat."""

from __future__ import annotations

import numpy as np

from optloc.linear import linearise
from optloc.normal import covariance, normal, with_priors
from optloc.problem import Problem
from optloc.types import Array


def crlb(problem: Problem, truth: Array) -> Array:
    """Return the Cramer-Rao lower bound of the shared unknowns.

    The inverse of the same normal matrix that refines a fix, taken at the truth; unknowns local to an epoch are
    eliminated, priors count as information.

    Parameters
    ----------
    problem : Problem
        Stations, rows and noise; its measurements do not matter.
    truth : array (..., size)
        True parameter vectors.

    Returns
    -------
    array (..., n, n)
        Covariance bound in SI units; NaN where the geometry is singular.

    References
    ----------
    S. M. Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory" (1993), eq. 3.31.
    """
    x = np.asarray(truth, dtype=float)
    equations = with_priors(problem, x, normal(linearise(problem, x), problem.epochs))
    return covariance(equations)[0]

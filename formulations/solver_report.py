"""The report of a back end on one solve: status, residuals, gap, iterations and time, as the solver states them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Outcome = Literal["solved", "inaccurate", "infeasible", "unbounded", "failed"]
"""Result of a solve in one word, the same for all solvers."""


@dataclass(frozen=True, slots=True)
class SolverReport:
    """The report of a back end on one solve, read from the solver's own solution object.

    Parameters
    ----------
    backend : str
        Name of the solver.
    status : str
        Status in the solver's words; ``"error"`` if the solver raised an error.
    primal_residual, dual_residual : float
        Residuals of the constraints and of the gradient, in the norm of the solver; NaN if the solver reports none.
        Clarabel, PIQP and HiGHS report relative or scaled residuals, other solvers absolute ones.
    gap : float
        Distance of the primal from the dual objective over ``max(1, min(|primal|, |dual|))``; NaN if unknown.
    iterations : int
        Iterations of the solver.
    seconds : float
        Time that the solver reports, without cvxpy or CasADi; NaN if it reports none.
    message : str
        Message of the solver, for instance the reason of a failure; empty if the solver returns no message.
    outcome : str
        ``"solved"`` (full tolerances), ``"inaccurate"`` (reduced tolerances), ``"infeasible"``, ``"unbounded"``, or
        ``"failed"``.
    """

    backend: str
    status: str
    primal_residual: float = np.nan
    dual_residual: float = np.nan
    gap: float = np.nan
    iterations: int = 0
    seconds: float = np.nan
    message: str = ""
    outcome: Outcome = "failed"

    @property
    def worst(self) -> float:
        """Return the largest of primal residual, dual residual and gap; NaN if one of them is unknown."""
        return float(np.max([self.primal_residual, self.dual_residual, self.gap]))

    def __str__(self) -> str:
        """Return solver, status, and the message if there is one."""
        return f"{self.backend}: {self.message or self.status}"


def relative_gap(primal: float, dual: float) -> float:
    """Return the relative distance of two objectives, which are both known.

    Parameters
    ----------
    primal, dual : float
        Objectives at the primal and at the dual point.

    Returns
    -------
    float
        The distance over ``max(1, min(|primal|, |dual|))``, as Clarabel defines it.
    """
    return abs(primal - dual) / max(1.0, min(abs(primal), abs(dual)))

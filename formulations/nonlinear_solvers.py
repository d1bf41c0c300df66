"""Reports of CasADi's nonlinear solvers, read from the statistics of each solver."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from formulations.solver_report import Outcome, SolverReport


def status_of(stats: Mapping[str, Any]) -> str:
    """Return the status in the solver's words.

    Parameters
    ----------
    stats : Mapping[str, Any]
        Statistics of the last call, as CasADi returns them.

    Returns
    -------
    str
        The status. alpaqa has no status of its own, so the status is CasADi's word for all solvers.

    Raises
    ------
    KeyError
        If there is no status.
    """
    return str(stats["return_status"] if "return_status" in stats else stats["unified_return_status"])


def nonlinear_report(name: str, stats: Mapping[str, Any], status: str, *, success: bool) -> SolverReport:
    """Return the report of a solve by a nonlinear solver.

    Parameters
    ----------
    name : str
        Plugin of CasADi.
    stats : Mapping[str, Any]
        Statistics of the last call.
    status : str
        Status, with any contradiction to it.
    success : bool
        Whether the returned point is a solution.

    Returns
    -------
    SolverReport
        The residuals are those of the last iteration of IPOPT (of its scaled problem) and Uno; NaN for other solvers.
        There is no gap.
    """
    log = stats.get("iterations")
    rows = log if isinstance(log, Mapping) else {}
    primal = rows["inf_pr"][-1] if rows.get("inf_pr") else stats.get("primal_infeasbility", np.nan)
    dual = rows["inf_du"][-1] if rows.get("inf_du") else stats.get("stationarity", np.nan)
    iterations, seconds = int(stats.get("iter_count", 0)), float(stats.get("t_wall_total", np.nan))
    outcome: Outcome = "solved" if success else "infeasible" if "infeasible" in status.lower() else "failed"
    return SolverReport(name, status, float(primal), float(dual), np.nan, iterations, seconds, "", outcome)

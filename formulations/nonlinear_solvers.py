"""Reports of CasADi's nonlinear solvers, read from the statistics of each solver, and a filter of their output."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from formulations.backend import hold_in_forks
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
        The status of the solver. alpaqa returns none, so CasADi's `unified_return_status` replaces it.

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
        For IPOPT and Uno, the residuals after the last iteration; IPOPT's residuals belong to its scaled problem. For
        other solvers, the residuals are NaN. There is no gap.
    """
    log = stats.get("iterations")
    rows = log if isinstance(log, Mapping) else {}
    primal = rows["inf_pr"][-1] if rows.get("inf_pr") else stats.get("primal_infeasbility", np.nan)
    dual = rows["inf_du"][-1] if rows.get("inf_du") else stats.get("stationarity", np.nan)
    iterations, seconds = int(stats.get("iter_count", 0)), float(stats.get("t_wall_total", np.nan))
    outcome: Outcome = "solved" if success else "infeasible" if "infeasible" in status.lower() else "failed"
    return SolverReport(name, status, float(primal), float(dual), np.nan, iterations, seconds, "", outcome)


# CasADi writes messages or warnings of these plugins to Python's streams, and they have no setting that stops it.
_NOISY = frozenset({"alpaqa", "fatrop", "feasiblesqpmethod", "qrsqp", "uno"})


class _ThreadFilter:
    """A text stream that drops what muted threads write, and passes on the rest to another stream."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write text, unless this thread is muted; return its length."""
        if threading.get_ident() not in _MUTED:
            self.stream.write(text)
        return len(text)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the other stream."""
        return getattr(self.stream, name)


_MUTED: set[int] = set()
_LOCK = threading.Lock()
hold_in_forks(_LOCK)


@contextmanager
def silent(name: str) -> Iterator[None]:
    """Drop the output of a nonlinear solver inside the ``with`` block; output of other threads is not affected.

    Parameters
    ----------
    name : str
        Plugin of CasADi; solvers with quiet settings need no filter.
    """
    if name not in _NOISY:
        yield
        return
    own = threading.get_ident()
    with _LOCK:
        _MUTED.add(own)
        for stream in ("stdout", "stderr"):
            if not isinstance(getattr(sys, stream), _ThreadFilter):
                setattr(sys, stream, _ThreadFilter(getattr(sys, stream)))
    try:
        yield
    finally:
        with _LOCK:
            _MUTED.discard(own)
            for stream in ("stdout", "stderr"):
                if not _MUTED and isinstance(filtered := getattr(sys, stream), _ThreadFilter):
                    setattr(sys, stream, filtered.stream)

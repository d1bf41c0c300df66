"""Which back ends are installed here: conic solvers of cvxpy, nonlinear ones of CasADi, least squares."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Literal

from optloc.base.errors import InvalidProblem, nearest


@dataclass(frozen=True, slots=True)
class Backend:
    """A solver that is installed.

    Parameters
    ----------
    kind : "conic", "nonlinear" or "least squares"
        What it solves.
    version : str
        Its version; that of the library that ships it where it has none of its own.
    summary : str
        One line for listings.
    """

    kind: Literal["conic", "nonlinear", "least squares"]
    version: str
    summary: str


# Where cvxpy's name of a solver is not that of its package.
_PACKAGES = {"COPT": "coptpy", "CUCLARABEL": "juliacall", "GUROBI": "gurobipy", "MOSEK": "Mosek", "SDPA": "sdpa-python"}
_NONLINEAR = {
    "ipopt": "interior point with line search (Waechter, Biegler 2006)",
    "sqpmethod": "sequential quadratic programming with CasADi's qrqp",
    "feasiblesqpmethod": "feasible sequential quadratic programming",
    "blocksqp": "block-structured sequential quadratic programming (Janka et al. 2016)",
    "fatrop": "structured interior point",
    "alpaqa": "augmented Lagrangian with PANOC",
    "sleqp": "sequential linear and equality-constrained quadratic programming",
    "uno": "unified nonlinear optimisation",
    "knitro": "Artelys Knitro (licence)",
    "snopt": "SNOPT (licence)",
    "worhp": "WORHP (licence)",
    "madnlp": "interior point in Julia",
}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "?"


@cache
def backends() -> dict[str, Backend]:
    """Return every back end that works here, by the name that a study file uses."""
    import casadi
    import cvxpy
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC

    found: dict[str, Backend] = {}
    for name in sorted(set(cvxpy.installed_solvers()) & set(SOLVER_MAP_CONIC)):
        cones = {cone.__name__ for cone in SOLVER_MAP_CONIC[name].SUPPORTED_CONSTRAINTS}
        powers = [word for word, cone in (("cones of order 2", "SOC"), ("semidefinite cones", "PSD")) if cone in cones]
        if powers:
            found[name] = Backend("conic", _version(_PACKAGES.get(name, name.lower())), " and ".join(powers))
    for name, summary in _NONLINEAR.items():
        if casadi.has_nlpsol(name):
            found[name] = Backend("nonlinear", f"CasADi {_version('casadi')}", summary)
    about = "scipy.optimize.least_squares; a baseline of studies"
    found["scipy"] = Backend("least squares", _version("scipy"), about)
    return found


def kind_of(name: str, where: str) -> Literal["conic", "nonlinear"]:
    """Return what a back end solves; raise InvalidProblem where it is unknown, not installed or no setting."""
    found = {key: entry.kind for key, entry in backends().items() if entry.kind in ("conic", "nonlinear")}
    if name not in found:
        import cvxpy

        known = {*_NONLINEAR, *cvxpy.settings.SOLVERS} - set(found)
        if name in known:
            advice = f"install it; here are {', '.join(found)}"
            raise InvalidProblem(f"the solver {name!r} is not installed, or cannot solve these cones", where, advice)
        raise InvalidProblem(f"unknown solver {name!r}", where, nearest(name, list(found)))
    return "conic" if found[name] == "conic" else "nonlinear"


@cache
def versions() -> str:
    """Return the versions of optloc, Python and the libraries that decide numbers, as one line."""
    import platform

    names = ("optloc", "numpy", "scipy", "numba", "cvxpy", "clarabel", "casadi", "pyarrow")
    return "; ".join([f"Python {platform.python_version()}", *(f"{name} {_version(name)}" for name in names)])


@cache
def machine() -> str:
    """Return the processor, the number of its cores and the system of this machine as one line."""
    import os
    import platform
    from pathlib import Path

    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    except OSError:
        pass
    return f"{name}, {os.cpu_count()} cores, {platform.system()} {platform.release()}"

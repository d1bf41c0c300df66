"""Back ends: solvers of cvxpy (conic, quadratic), nonlinear solvers of CasADi, least squares.

A library may list a solver that does not work. Some solvers end the process, and some raise an error for
every program. Without a solution, some solvers never end, and some report a success. So each solver is tried once,
in a separate process, on programs with and without a solution (`formulations.backend_trial`). Only solvers that pass
are listed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from optloc.base.errors import InvalidProblem, nearest
from optloc.kernels.code_cache import folder

# Seconds that a solver may take for programs of two unknowns, which take milliseconds; and seconds to start a process.
_PATIENCE, _START = 5.0, 60.0
# First words of the lines of the trial, as in `formulations.backend_trial`.
_SAID = ("backend-passed", "backend-failed")


@dataclass(frozen=True, slots=True)
class Backend:
    """An installed solver.

    Parameters
    ----------
    kind : "conic", "quadratic", "nonlinear" or "least squares"
        Programs that it solves; "quadratic" has linear and quadratic programs, but no cones.
    version : str
        Its version, or the version of the library that includes it.
    summary : str
        One line for listings.
    """

    kind: Literal["conic", "quadratic", "nonlinear", "least squares"]
    version: str
    summary: str


# Packages of solvers whose name in cvxpy differs.
_PACKAGES = {
    "COPT": "coptpy",
    "CUCLARABEL": "juliacall",
    "GLOP": "ortools",
    "GLPK": "cvxopt",
    "GLPK_MI": "cvxopt",
    "GUROBI": "gurobipy",
    "MOSEK": "Mosek",
    "PDLP": "ortools",
    "SDPA": "sdpa-python",
}
_NONLINEAR = {
    "ipopt": "interior point with line search (Waechter, Biegler 2006)",
    "sqpmethod": "sequential quadratic programming with CasADi's qrqp",
    "feasiblesqpmethod": "feasible sequential quadratic programming",
    "qrsqp": "sequential quadratic programming with line search and CasADi's qrqp",
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


def version_of(package: str) -> str:
    """Return the version of an installed distribution; "?" if it is unknown."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "?"


@cache
def installed() -> dict[str, Backend]:
    """Return every back end that its library lists, working or not; the key is the name in study files."""
    import casadi
    import cvxpy

    from formulations.conic_solvers import adapter
    from formulations.cvxpy_access import cones_of_solvers

    found: dict[str, Backend] = {}
    for name in sorted(set(cvxpy.installed_solvers()) & set(cones_of_solvers())):
        one = adapter(name)
        kind: Literal["conic", "quadratic"] = "conic" if one.cones & {"second-order", "semidefinite"} else "quadratic"
        about = f"{one.solves()}: {one.summary}" if one.summary else one.solves()
        found[name] = Backend(kind, version_of(_PACKAGES.get(name, one.package)), about)
    # CasADi has no list of plugins, so each name is tested
    for name, summary in _NONLINEAR.items():
        if casadi.has_nlpsol(name):
            found[name] = Backend("nonlinear", f"CasADi {version_of('casadi')}", summary)
    about = "scipy.optimize.least_squares; a baseline of studies"
    found["scipy"] = Backend("least squares", version_of("scipy"), about)
    return found


@cache
def backends() -> dict[str, Backend]:
    """Return every back end that works here, by the name in study files."""
    faults = faults_of({name: entry.kind for name, entry in installed().items() if entry.kind != "least squares"})
    return {name: entry for name, entry in installed().items() if not faults.get(name)}


def kind_of(name: str) -> Literal["conic", "nonlinear"]:
    """Return the kind of programs that an installed back end solves, without a trial."""
    return "nonlinear" if installed()[name].kind == "nonlinear" else "conic"


def backend_kind(name: str, where: str) -> Literal["conic", "nonlinear"]:
    """Return the kind of programs that a back end solves; raise InvalidProblem if it is unknown, missing or broken.

    `where` is the place of the name in the input, for the message of the error.
    """
    here = {key: entry.kind for key, entry in installed().items() if entry.kind != "least squares"}
    working = [key for key in backends() if key in here]
    if name not in here:
        from formulations.cvxpy_access import known_solvers

        known = {*_NONLINEAR, *known_solvers()} - set(here)
        if name in known:
            advice = f"install it, or use one of {', '.join(working)}"
            raise InvalidProblem(f"the solver {name!r} is not installed", where, advice)
        raise InvalidProblem(f"unknown solver {name!r}", where, nearest(name, working))
    if here[name] == "quadratic":
        able = ", ".join(key for key in working if here[key] == "conic")
        reason = f"the solver {name!r} solves {installed()[name].summary.partition(':')[0]}"
        raise InvalidProblem(f"{reason}, and the methods of optloc need cones", where, f"use one of {able}")
    if name not in working:
        fault = faults_of(here)[name]
        raise InvalidProblem(
            f"the solver {name!r} does not work here: {fault}", where, f"use one of {', '.join(working)}"
        )
    return kind_of(name)


# The results of the trial are stored on disk, since it takes some seconds.


@cache
def _faults(kinds: tuple[tuple[str, str], ...]) -> dict[str, str]:
    """Return the fault of each back end, a sentence; "" for a back end that works.

    `kinds` has pairs (name, kind). A file in the cache folder stores the faults, if there is such a folder.
    """
    cache_folder = folder()
    file = None if cache_folder is None else cache_folder / f"backends-{_key(kinds)}.json"
    if file is not None:
        with suppress(OSError, ValueError):
            stored = json.loads(file.read_text(encoding="utf-8"))
            if isinstance(stored, dict) and set(stored) == {name for name, _ in kinds}:
                return {str(name): str(fault) for name, fault in stored.items()}
    faults = try_in_process(dict(kinds))
    if file is not None:
        with suppress(OSError):
            temporary = file.with_suffix(f".{os.getpid()}")
            temporary.write_text(json.dumps(faults), encoding="utf-8")
            temporary.replace(file)  # an atomic replacement: another process never reads a partial file
    return faults


def faults_of(kinds: Mapping[str, str]) -> dict[str, str]:
    """Return the fault of each back end, a sentence; "" for a back end that works. `kinds` maps names to kinds."""
    return dict(_faults(tuple(sorted(kinds.items()))))


def _key(kinds: tuple[tuple[str, str], ...]) -> str:
    """Return a digest of everything that the results depend on: `kinds`, versions, and the programs of the trial."""
    here = Path(__file__).parent
    programs = [path.read_text(encoding="utf-8") for path in sorted((here.parents[1] / "formulations").glob("*.py"))]
    libraries = [version_of(name) for name in ("casadi", "cvxpy", "numpy")]
    versions = [entry.version for entry in installed().values()]
    text = json.dumps([kinds, versions, libraries, programs, sys.version])
    return sha256(text.encode()).hexdigest()[:16]


def try_in_process(kinds: dict[str, str]) -> dict[str, str]:
    """Return the faults of back ends from a trial in a separate process; `kinds` maps names to kinds.

    If a solver ends the process, a new process tries the remaining solvers. The fault "" means that the solver works.
    """
    untried, faults = dict(kinds), dict[str, str]()
    while untried:
        tried = _one_process(untried)
        faults |= tried
        untried = {name: kind for name, kind in untried.items() if name not in faults}
        if untried and not tried:  # no solver was reached, so the fault is not in a solver
            faults |= dict.fromkeys(untried, "the trial did not run")
            break
    return faults


def _one_process(kinds: dict[str, str]) -> dict[str, str]:
    """Return the faults of the back ends that one process reaches, including the back end that ends the process.

    `kinds` maps names to kinds. Back ends that the process does not reach are missing from the result.
    """
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([root, *(place for place in sys.path if place)])
    process = subprocess.Popen(  # noqa: S603  (this interpreter, and a module of this package)
        [sys.executable, "-m", "formulations.backend_trial", str(_PATIENCE), *(f"{k}:{n}" for n, k in kinds.items())],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        stdin=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": path},
    )
    try:
        output, _ = process.communicate(timeout=_START + 2.0 * _PATIENCE * len(kinds))
    except subprocess.TimeoutExpired:
        process.kill()
        output, _ = process.communicate()
    faults: dict[str, str] = {}
    for line in output.decode(errors="replace").splitlines():
        word, _, rest = line.partition(" ")
        name, _, fault = rest.partition(" ")
        if word in _SAID and name in kinds:
            faults[name] = fault
    ended = next((name for name in kinds if name not in faults), None)
    if ended is not None and process.returncode:
        faults[ended] = f"it ends the process (exit code {process.returncode})"
    return faults

"""Back ends that a study may ask for: conic solvers of cvxpy, nonlinear ones of CasADi, least squares.

A library that lists a solver does not say that it works: some end the process, some raise an error of their own for
every program, some never end where there is no solution, some call that a success. So each is tried once, in a process
apart, on programs with and without a solution (`formulations.backend_trial`), and only those that pass are listed.
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

# Seconds in which a solver ends on programs of two unknowns, which take milliseconds; and to begin a process.
_PATIENCE, _START = 5.0, 60.0
# How lines of the trial begin, as in `formulations.backend_trial`.
_SAID = ("backend-passed", "backend-failed")


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


def version_of(package: str) -> str:
    """Return the version of an installed distribution, "?" where it has none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "?"


@cache
def installed() -> dict[str, Backend]:
    """Return every back end that its library lists here, whether it works or not, by the name in study files."""
    import casadi
    import cvxpy
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC

    found: dict[str, Backend] = {}
    # Studies compare solvers of cones: those that have neither kind cannot take any program of this package.
    for name in sorted(set(cvxpy.installed_solvers()) & set(SOLVER_MAP_CONIC)):
        cones = {cone.__name__.removeprefix("Svec") for cone in SOLVER_MAP_CONIC[name].SUPPORTED_CONSTRAINTS}
        powers = [word for word, cone in (("cones of order 2", "SOC"), ("semidefinite cones", "PSD")) if cone in cones]
        if powers:
            found[name] = Backend("conic", version_of(_PACKAGES.get(name, name.lower())), " and ".join(powers))
    # CasADi can only be asked plugin by plugin: it has no list.
    for name, summary in _NONLINEAR.items():
        if casadi.has_nlpsol(name):
            found[name] = Backend("nonlinear", f"CasADi {version_of('casadi')}", summary)
    about = "scipy.optimize.least_squares; a baseline of studies"
    found["scipy"] = Backend("least squares", version_of("scipy"), about)
    return found


@cache
def backends() -> dict[str, Backend]:
    """Return every back end that works here, by the name that a study file uses."""
    faults = faults_of({name: entry.kind for name, entry in installed().items() if entry.kind != "least squares"})
    return {name: entry for name, entry in installed().items() if not faults.get(name)}


def kind_of(name: str) -> Literal["conic", "nonlinear"]:
    """Return what an installed back end solves, which nobody tries again for that."""
    return "conic" if installed()[name].kind == "conic" else "nonlinear"


def backend_kind(name: str, where: str) -> Literal["conic", "nonlinear"]:
    """Return what a back end solves; raise InvalidProblem where it is unknown, not installed, or does not work here."""
    here = {key: entry.kind for key, entry in installed().items() if entry.kind != "least squares"}
    working = [key for key in backends() if key in here]
    if name not in here:
        import cvxpy

        known = {*_NONLINEAR, *cvxpy.settings.SOLVERS} - set(here)
        if name in known:
            advice = f"install it; here are {', '.join(working)}"
            raise InvalidProblem(f"the solver {name!r} is not installed, or cannot solve these cones", where, advice)
        raise InvalidProblem(f"unknown solver {name!r}", where, nearest(name, working))
    if name not in working:
        fault = faults_of(here)[name]
        raise InvalidProblem(f"the solver {name!r} does not work here: {fault}", where, f"take {', '.join(working)}")
    return kind_of(name)


# The trial of solvers, kept on disk: it takes some seconds.


@cache
def _faults(kinds: tuple[tuple[str, str], ...]) -> dict[str, str]:
    """Return what is wrong with each back end; empty where it works."""
    place = folder()
    file = None if place is None else place / f"backends-{_key(kinds)}.json"
    if file is not None:
        with suppress(OSError, ValueError):
            kept = json.loads(file.read_text(encoding="utf-8"))
            if isinstance(kept, dict) and set(kept) == {name for name, _ in kinds}:
                return {str(name): str(fault) for name, fault in kept.items()}
    found = try_in_process(dict(kinds))
    if file is not None:
        with suppress(OSError):
            own = file.with_suffix(f".{os.getpid()}")
            own.write_text(json.dumps(found), encoding="utf-8")
            own.replace(file)  # all at once: another process reads the whole of it or nothing
    return found


def faults_of(kinds: Mapping[str, str]) -> dict[str, str]:
    """Return what is wrong with each back end, given by name and kind; empty where it works."""
    return dict(_faults(tuple(sorted(kinds.items()))))


def _key(kinds: tuple[tuple[str, str], ...]) -> str:
    """Return what the outcome depends on, as a digest: names, versions, and the programs of the trial."""
    here = Path(__file__).parent
    programs = [path.read_text(encoding="utf-8") for path in sorted((here.parents[1] / "formulations").glob("*.py"))]
    libraries = [version_of(name) for name in ("casadi", "cvxpy", "numpy")]
    versions = [entry.version for entry in installed().values()]
    text = json.dumps([kinds, versions, libraries, programs, sys.version])
    return sha256(text.encode()).hexdigest()[:16]


def try_in_process(kinds: dict[str, str]) -> dict[str, str]:
    """Return what is wrong with back ends, given by name and kind, after a trial in a process apart.

    A new process begins behind a solver that ends one.
    """
    left, found = dict(kinds), dict[str, str]()
    while left:
        done = _one_process(left)
        found |= done
        left = {name: kind for name, kind in left.items() if name not in found}
        if left and not done:  # nobody was reached: what is wrong is not a solver
            found |= dict.fromkeys(left, "it could not be tried")
            break
    return found


def _one_process(kinds: dict[str, str]) -> dict[str, str]:
    """Return the outcomes of those that one process reaches; the one in which it ends is named with how."""
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
    found: dict[str, str] = {}
    for line in output.decode(errors="replace").splitlines():
        word, _, rest = line.partition(" ")
        name, _, fault = rest.partition(" ")
        if word in _SAID and name in kinds:
            found[name] = fault
    ended = next((name for name in kinds if name not in found), None)
    if ended is not None and process.returncode:
        found[ended] = f"it ends the process (exit code {process.returncode})"
    return found

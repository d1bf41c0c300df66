"""Methods of a study: their tables in the study file, the solver settings that a file may make, and their calls.

A method is a method of optloc or a baseline. No code of a study depends on the name of a method.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from time import perf_counter, process_time
from typing import Any

import numpy as np

from optloc.files import Units, join
from optloc.lab.study.baselines import BASELINES, listening, only_networks, start_of
from optloc.lab.study.document import MethodTable
from optloc.lab.study.minimizers import baseline_of, code_of, load_minimizer
from optloc.lab.study.networks import CALIBRATE, NetworkResult, Networks, calibrated
from optloc.lab.study.simulation import DrawnCase
from optloc.problem import ANSWERED, Array, Certificate, Fix, InvalidProblem, Status, nearest
from optloc.solvers import backend_kind, backends, kind_of, version_of

# Solvers are defined in another module; studies import them from here.
__all__ = [
    "SETTINGS",
    "MethodRun",
    "Nonsense",
    "Setting",
    "StudyMethod",
    "added",
    "backend_kind",
    "backends",
    "check_settings",
    "methods_of",
    "require_program",
    "run",
    "version_of",
]


@dataclass(frozen=True, slots=True)
class StudyMethod:
    """Method of a study.

    Parameters
    ----------
    name : str
        Name in tables.
    method, baseline : str, optional
        Method of optloc or baseline; one of them is None.
    solver : str
        Solver of its programs; empty: the default.
    settings : dict
        Settings of the solver.
    start : str
        Start of a baseline that needs a guess.
    width : float
        Width of the box of random starts, metres.
    batch, chunk : int, optional
        Number of fixes in a call, and of trials in a task.
    code : str
        Digest of the source file of a plugin's baseline; empty for optloc's baselines.
    """

    name: str
    method: str | None
    baseline: str | None
    solver: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    start: str = "centre"
    width: float = 1e5  # the default of a study file
    batch: int | None = None
    chunk: int | None = None
    code: str = ""

    @property
    def identity(self) -> str:
        """Return the settings that decide the answers, as one JSON text, the same for equal methods."""
        # Without the chunk: it divides the work, and is part of the fingerprint of the design.
        settings = json.dumps(self.settings, sort_keys=True)
        parts = (self.name, self.method, self.baseline, self.solver, settings, self.start, self.width, self.batch)
        return json.dumps((*parts, self.code) if self.code else parts)

    @property
    def slow(self) -> bool:
        """Return whether the method solves trials one by one; its chunks are then smaller."""
        if self.baseline is not None:
            return baseline_of(self.baseline).slow
        if self.method == CALIBRATE:
            return True
        from optloc.solvers import Method as Pipeline

        assert self.method is not None
        return not all(entry.batched for entry in Pipeline.parse(self.method).entries)

    @property
    def networked(self) -> bool:
        """Return whether the method solves networks."""
        if self.baseline is not None:
            return baseline_of(self.baseline).networks is not None
        return self.method == CALIBRATE

    @property
    def fixes(self) -> bool:
        """Return whether the method fixes targets."""
        if self.baseline is not None:
            return baseline_of(self.baseline).run is not only_networks
        return self.method != CALIBRATE

    @property
    def reference(self) -> bool:
        """Return whether the method starts at the truth.

        The results of a reference judge the other methods, so it is not ranked.
        """
        if self.baseline is None:
            return False
        known = baseline_of(self.baseline)
        return known.reference or (known.guess and self.start == "truth")


def methods_of(table: MethodTable, number: int) -> Iterator[StudyMethod]:
    """Yield the methods of a table: one for each combination of its lists.

    `number` is the place of the table in the file, from 1. Raise InvalidProblem for an unknown method, baseline or
    solver, a solver that is not installed, or a setting that a file may not make.
    """
    where = f"[[method]] {number}" if table.name is None else f"method {table.name!r}"
    if (table.method is None) == (table.baseline is None):
        raise InvalidProblem("it needs one method or one baseline", where, "give either method or baseline")
    solvers: list[str | None] = [*_list(table.solver)] or [None]
    names = _list(table.method) or _list(table.baseline)
    if not names:
        raise InvalidProblem("its list of methods is empty", where, "name one, or remove the table")
    for name, solver in product(names, solvers):
        if table.method is not None:
            from optloc.solvers import Method as Pipeline

            try:
                # Parse only to find errors. The method of networks, `CALIBRATE`, is not a pipeline of stages.
                _ = name == CALIBRATE or Pipeline.parse(name)
            except InvalidProblem as error:
                raise InvalidProblem(error.what, where, error.advice) from None
        elif name not in BASELINES:
            raise InvalidProblem(f"unknown baseline {name!r}", where, nearest(name, list(BASELINES)))
        if solver is not None:
            backend_kind(solver, join(where, "solver"))
            check_settings(solver, table.settings, join(where, "settings"))
        elif table.settings:
            raise InvalidProblem("settings need a solver", join(where, "settings"), "name it in 'solver'")
        yield StudyMethod(
            _name(table, name, solver, len(names) * len(solvers)),
            None if table.method is None else name,
            None if table.baseline is None else name,
            solver or "",
            dict(table.settings),
            table.start,
            Units("length").plain(table.width, "m", join(where, "width")),
            table.batch,
            table.chunk,
            "" if table.baseline is None else code_of(name),
        )


def added(names: Sequence[str]) -> list[StudyMethod]:
    """Return methods that the user names in addition to the methods of a file.

    Each name is a method such as gtrs+lsr, a baseline, or a function to load: FILE.py:FUNCTION or MODULE:FUNCTION.
    Raise InvalidProblem for an unknown method, or a function that cannot be loaded.
    """
    found = []
    for name in names:
        if ":" in name:
            load_minimizer(name)
            found.append(StudyMethod(name.rpartition(":")[2], None, name, code=code_of(name)))
        else:
            table = {"baseline": name} if name in BASELINES else {"method": name}
            found += methods_of(MethodTable.model_validate(table), len(found) + 1)
    return found


def _list(value: str | list[str] | None) -> list[str]:
    """Return a value of the file as a list: a text is a list of one, a missing value is empty."""
    return [] if value is None else [value] if isinstance(value, str) else value


def _name(table: MethodTable, name: str, solver: str | None, count: int) -> str:
    """Return the name of a method in tables; `count` is the number of methods that its table makes."""
    # The default name does not contain settings, so methods that differ only by settings need a name in the file.
    guess = table.baseline is not None and BASELINES[name].guess
    words = [name, *([f"from the {table.start}"] if guess else []), *([f"({solver})"] if solver else [])]
    made = " ".join(words)
    if table.name is None:
        return made
    return table.name if count == 1 else f"{table.name}: {made}"


@dataclass(frozen=True, slots=True)
class MethodRun:
    """Result of one call of a method on n trials.

    Parameters
    ----------
    fix : Fix or tuple of NetworkResult
        Fixes (n,), or networks.
    seconds : float
        Time of the call.
    processor : float
        Processor time of the call, of all its threads, seconds.
    evaluations : array (n,)
        Evaluations of the cost of each trial; NaN if the method does not count them.
    iterations : float
        Iterations of all its solvers and refinements over all trials; NaN if none are counted.
    used : bool
        Whether the requested solver has solved a program; True if no solver was requested.
    """

    fix: Fix | tuple[NetworkResult, ...]
    seconds: float
    processor: float
    evaluations: Array
    iterations: float
    used: bool


class Nonsense(Exception):  # noqa: N818  (the name describes an answer)
    """Raised if a method returns an invalid answer."""


def run(method: StudyMethod, drawn: DrawnCase | Networks) -> MethodRun:
    """Return the fixes of trials by a method, with its solver and settings, the times and the counts of the call.

    Raise Nonsense for invalid fixes.
    """
    from optloc.solvers import Choice, counting, using

    choice = None
    if method.solver:
        choice = Choice(kind_of(method.solver), method.solver, method.settings)
    # A method may change the floating-point error handling; the context restores it.
    evaluations = np.zeros(len(drawn.seed))
    with using(choice), counting() as tally, listening(lambda trial, _: _add(evaluations, trial)), np.errstate():
        began, processor = perf_counter(), process_time()
        fix = _results(method, drawn)
        seconds, processor = perf_counter() - began, process_time() - processor
    if not isinstance(drawn, Networks):
        _check_fix(fix, drawn)
    # `tally` has the name of a solver and its number of iterations for each program that was solved.
    used = choice is None or choice.name in {name for name, _ in tally}
    iterations = float(sum(n for _, n in tally)) if tally else np.nan
    return MethodRun(fix, seconds, processor, np.where(evaluations > 0.0, evaluations, np.nan), iterations, used)


def _add(counts: Array, trial: int) -> None:
    """Count one evaluation of a trial in `counts` (n,)."""
    counts[trial] += 1.0


def require_program(method: StudyMethod, call: MethodRun) -> None:
    """Raise InvalidProblem if the requested solver has solved no program in the call."""
    # Otherwise the study would report results of another solver under its name.
    if not call.used:
        what = f"{method.method or method.baseline} has no program that {method.solver} solves"
        raise InvalidProblem(what, f"method {method.name!r}", "remove the solver, or use a stage such as sdp or nlp")


def _results(method: StudyMethod, drawn: DrawnCase | Networks) -> Any:
    """Return the fixes of drawn trials, or the results for drawn networks."""
    if isinstance(drawn, Networks):
        solve_networks = calibrated if method.baseline is None else baseline_of(method.baseline).networks
        assert solve_networks is not None  # `design_of_text` rejects other methods
        return solve_networks(drawn)
    if method.baseline is not None:
        return baseline_of(method.baseline).run(drawn, start_of(method.start, method.width, drawn))
    from optloc.solvers import solve

    assert method.method is not None
    # refine=False: for a method that only starts, the start itself is scored.
    fix = solve(drawn.problem, method.method, refine=False)
    # A batch of one has no batch axis.
    return fix if fix.shape else fix.flat()


# Largest asymmetry or negative eigenvalue of a covariance from rounding, relative to the variances: half of the digits.
_ROUNDING = 1e-8


def _check_fix(fix: Any, drawn: DrawnCase) -> None:
    """Raise Nonsense if a value is not a valid fix of the trials: wrong type, shape, kind of numbers, or answers.

    `fix` is the value that the method has returned for the trials `drawn`.
    """
    if not isinstance(fix, Fix):
        raise Nonsense(f"it returned {type(fix).__name__} instead of a fix")
    n, size = drawn.truth.shape
    shared, listed = drawn.problem.layout.n_shared, np.shape(fix.alternatives.gap)[-1:]
    # By name: value, shape, and allowed kinds of its NumPy type: f float, i and u integer, O object, U text.
    expected: dict[str, tuple[Any, tuple[int, ...], str]] = {
        "x": (fix.x, (n, size), "f"),
        "cov": (fix.cov, (n, shared, shared), "f"),
        "code": (fix.code, (n,), "iu"),
        "cost": (fix.cost, (n,), "f"),
        "dof": (fix.dof, (n,), "iu"),
        "weights": (fix.weights, (n, drawn.problem.count), "f"),
        "reason": (fix.reason, (n,), "OU"),
        "proof": (getattr(fix.claims, "proof", None), (n,), "iu"),
        "alternatives.x": (fix.alternatives.x, (n, *listed, size), "f"),
        "alternatives.gap": (fix.alternatives.gap, (n, *listed), "f"),
    }
    for name, (value, shape, kinds) in expected.items():
        if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype.kind not in kinds:
            what = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            raise Nonsense(f"its {name} is {what}, not an array {shape} of kind {kinds!r}")
    if not all(isinstance(one, Certificate) for one in fix.certificates):
        raise Nonsense("its certificates are invalid")
    if not all(0 <= code < len(Status) for code in fix.code):
        raise Nonsense("its status is unknown")
    # An unbounded answer has no finite position.
    answered = np.isin(fix.code, [status for status in ANSWERED if status is not Status.UNBOUNDED])
    _check_answers(fix.x[answered, :shared], fix.cov[answered])


def _check_answers(x: Array, cov: Array) -> None:
    """Raise Nonsense if answers (n, p) are not finite, or their covariances (n, p, p) are invalid.

    p is the number of unknowns that all epochs share.
    """
    if not np.isfinite(x).all():
        raise Nonsense("its status claims an answer, but its estimate is not finite")
    if not np.isfinite(cov).all():
        raise Nonsense("its status claims an answer, but its covariance is not finite")
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    if (variance < 0.0).any():
        raise Nonsense("its covariance has negative variances")
    # In units of each standard deviation, so that metres and radians compare; known parameters have none.
    scale = np.sqrt(variance)
    scale = np.where(scale > 0.0, scale, 1.0)
    relative = cov / scale[:, :, None] / scale[:, None, :]
    if (np.abs(relative - np.swapaxes(relative, -1, -2)) > _ROUNDING).any():
        raise Nonsense("its covariance is not symmetric")
    if len(cov) and np.linalg.eigvalsh(relative).min() < -_ROUNDING:
        raise Nonsense("its covariance is not positive semidefinite")


# Settings of solvers. A study file may come from an untrusted source, so it may only set the effort of a solver.
# Options that name files, libraries, compilers or callbacks are not in the table, and cannot be set.


@dataclass(frozen=True, slots=True)
class Setting:
    """A number or a boolean that a study file may set for a solver.

    Parameters
    ----------
    kind : type
        bool, int or float.
    least, most : float
        Ends of the allowed range; not used for bool.
    """

    kind: type[bool | int | float]
    least: float = 0.0
    most: float = 1.0

    def __str__(self) -> str:
        """Return the allowed values in words."""
        if self.kind is bool:
            return "true or false"
        return f"{'a whole number' if self.kind is int else 'a number'} from {self.least:g} to {self.most:g}"

    def takes(self, value: object) -> bool:
        """Return whether a value has the right kind and is in the range; a float also accepts an int."""
        if isinstance(value, bool) or self.kind is bool:
            return isinstance(value, bool) and self.kind is bool
        whole = isinstance(value, int) or (self.kind is float and isinstance(value, float))
        return whole and self.least <= float(value) <= self.most  # type: ignore[arg-type]  # a number by now


# Tolerances below the precision of floats make every solve fail. A limit of a billion iterations or a day is no limit.
_TOLERANCE, _COUNT, _SECONDS = Setting(float, 1e-16, 1.0), Setting(int, 1, 1e9), Setting(float, 1e-3, 86_400.0)
_FACTOR, _SIZE, _SWITCH = Setting(float, 0.0, 1.0), Setting(float, 0.0, 1e12), Setting(bool)
_SQP = {"max_iter": _COUNT, "min_iter": _COUNT, "tol_pr": _TOLERANCE, "tol_du": _TOLERANCE}
SETTINGS: dict[str, dict[str, Setting]] = {
    "CLARABEL": {
        **dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas", "tol_infeas_abs", "tol_infeas_rel"), _TOLERANCE),
        **dict.fromkeys(("reduced_tol_gap_abs", "reduced_tol_gap_rel", "reduced_tol_feas"), _TOLERANCE),
        **dict.fromkeys(("static_regularization_constant", "static_regularization_proportional"), _FACTOR),
        **dict.fromkeys(("dynamic_regularization_eps", "dynamic_regularization_delta", "max_step_fraction"), _FACTOR),
        **dict.fromkeys(("static_regularization_enable", "dynamic_regularization_enable"), _SWITCH),
        **dict.fromkeys(("equilibrate_enable", "iterative_refinement_enable"), _SWITCH),
        **dict.fromkeys(("max_iter", "equilibrate_max_iter", "iterative_refinement_max_iter"), _COUNT),
        "time_limit": _SECONDS,
    },
    "SCS": {
        **dict.fromkeys(("eps", "eps_abs", "eps_rel", "eps_infeas"), _TOLERANCE),
        **dict.fromkeys(("normalize", "adaptive_scale"), _SWITCH),
        **dict.fromkeys(("scale", "rho_x"), _SIZE),
        "alpha": Setting(float, 0.0, 2.0),
        "max_iters": _COUNT,
        "acceleration_lookback": Setting(int, -100, 100),
        "acceleration_interval": _COUNT,
        "time_limit_secs": _SECONDS,
    },
    "CVXOPT": {
        **dict.fromkeys(("abstol", "reltol", "feastol"), _TOLERANCE),
        "max_iters": _COUNT,
        "refinement": Setting(int, 0, 100),
    },
    "QOCO": {**dict.fromkeys(("abstol", "reltol", "abstol_inacc", "reltol_inacc"), _TOLERANCE), "max_iters": _COUNT},
    "ipopt": {
        **dict.fromkeys(("tol", "acceptable_tol", "dual_inf_tol", "constr_viol_tol", "compl_inf_tol"), _TOLERANCE),
        **dict.fromkeys(("max_iter", "acceptable_iter"), _COUNT),
        **dict.fromkeys(("max_cpu_time", "max_wall_time"), _SECONDS),
        **dict.fromkeys(("mu_init", "bound_push", "bound_frac", "bound_relax_factor"), _FACTOR),
    },
    "sqpmethod": {**_SQP, **dict.fromkeys(("beta", "c1", "min_step_size"), _FACTOR), "max_iter_ls": _COUNT},
    "feasiblesqpmethod": {**_SQP, "max_inner_iter": _COUNT, "feas_tol": _TOLERANCE, "optim_tol": _TOLERANCE},
    "sleqp": {"max_iter": _COUNT, "max_wall_time": _SECONDS},
}
"""Settings that a study file may make, by solver; a solver that is missing has none."""


def check_settings(solver: str, settings: dict[str, Any], where: str) -> None:
    """Raise InvalidProblem for solver settings that a file may not make: unknown names, or values out of range."""
    known = SETTINGS.get(solver, {})
    for name, value in settings.items():
        if name not in known:
            advice = (
                f"a study may set {', '.join(sorted(known))}" if known else "a study has no settings of this solver"
            )
            raise InvalidProblem(f"a study may not set {name!r} of {solver}", where, advice)
        if not known[name].takes(value):
            raise InvalidProblem(f"{name} is {value!r}", where, f"give {known[name]}")

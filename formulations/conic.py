r"""Parametrised conic problems, canonicalised once and re-solved on Clarabel's own data.

A cvxpy problem that obeys the parameter rules (DPP) becomes

.. math:: \min_x \tfrac12 x^\top P x + q^\top x + d \quad\text{subject to}\quad A x + s = b, \; s \in K,

in which `P`, `q`, `d`, `A`, `b` are affine in the parameters. The affine maps are taken out of cvxpy once; a later
solve is a few sparse products, an update of Clarabel's data and the bare solve. Its dual point `z`, projected on the
dual cone, gives

.. math:: \min \ge d - \tfrac12 x^\top P x - b^\top z - \rho \, |P x + q + A^\top z|

for every minimiser with :math:`|x^*| \le \rho`, whatever the solver reports: the "optimal value" is never used as a
bound.

Sources: A. Agrawal et al., "Differentiable convex optimization layers", NeurIPS 2019 (the affine maps); C. Jansson,
D. Chaykin and C. Keil, "Rigorous error bounds for the optimal value in semidefinite programming", SIAM J. Numer.
Anal. 46 (2007) (the bound, here with one radius for all of x).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from formulations._canonical import Data
from formulations.backend import chosen, count

Array = NDArray[np.float64]
_Arguments = ParamSpec("_Arguments")
_Built = TypeVar("_Built")


@dataclass(frozen=True, slots=True)
class Answer:
    """What one conic solve gave.

    Parameters
    ----------
    values : Mapping[str, Array]
        Values of the variables by name; NaN where the solver gave none.
    primal : float
        Objective at the point found.
    bound : float
        Lower bound of the optimum, recomputed from the dual point; minus infinity where none is available.
    status : str
        The solver's own word for how it ended.
    solved : bool
        True where the solver met its full tolerances.
    iterations : int
        Interior-point (or other) iterations.
    """

    values: Mapping[str, Array]
    primal: float
    bound: float
    status: str
    solved: bool
    iterations: int


class Relaxation:
    """One cvxpy problem with named parameters, solved many times.

    Parameters
    ----------
    problem : cvxpy.Problem
        A minimisation that is DPP; parameters and variables carry unique names. Linear, second-order and
        semidefinite cones.
    backend : str
        ``"CLARABEL"`` for the fast way; any other solver of cvxpy goes through ``problem.solve`` and yields no bound.
    settings : Mapping[str, Any], optional
        Settings of the back end.
    radius : float
        Factor on ``1 + |x|`` of the solution found that is taken to hold every minimiser, for the bound.

    Notes
    -----
    Agrawal et al. (2019). Threads may share one: each works on numbers of its own, every solve starts afresh, and
    Clarabel releases the interpreter lock. An answer therefore depends on its own data alone. Do not pickle.
    """

    def __init__(
        self,
        problem: Any,
        *,
        backend: str = "CLARABEL",
        settings: Mapping[str, Any] | None = None,
        radius: float = 2.0,
    ) -> None:
        self.problem, self.backend, self.settings, self.radius = problem, backend, dict(settings or {}), radius
        self.parameters = {parameter.name(): parameter for parameter in problem.parameters()}
        self._shared = Data(problem) if backend == "CLARABEL" else None
        self._own, self._lock = threading.local(), threading.Lock()

    @property
    def _data(self) -> Data | None:
        """The data of this thread."""
        if self._shared is None:
            return None
        if not hasattr(self._own, "data"):
            self._own.data = self._shared.twin()
        own: Data = self._own.data
        return own

    def solve(self, values: Mapping[str, Array], *, bound: bool = True, reach: float | None = None) -> Answer:
        """Solve with new parameter values.

        Parameters
        ----------
        values : Mapping[str, Array]
            Values of every parameter, by name.
        bound : bool
            Whether to recompute the lower bound from the dual; without it the bound is minus infinity.
        reach : float, optional
            Length of the variables that no minimiser exceeds, where that is known: it makes the bound rigorous. In
            the place of ``radius (1 + |x|)``.

        Returns
        -------
        Answer
            Point, value, bound and status; failure is reported, not raised.
        """
        if values.keys() != self.parameters.keys():
            raise ValueError(f"parameters {sorted(values)} given, {sorted(self.parameters)} expected")
        choice, data = chosen("conic"), self._data
        backend, settings = (self.backend, self.settings) if choice is None else (choice.name, dict(choice.settings))
        if data is None or backend != "CLARABEL":
            with self._lock:  # the values are those of the one problem
                answer = self._elsewhere(values, backend, settings)
        else:
            answer = self._directly(data, values, {**self.settings, **settings}, bound=bound, reach=reach)
        count(backend, answer.iterations)
        return answer

    def _directly(
        self,
        data: Data,
        values: Mapping[str, Array],
        settings: Mapping[str, Any],
        *,
        bound: bool,
        reach: float | None,
    ) -> Answer:
        data.feed(values)
        solution = _solver(data, settings).solve()
        x, z, status = np.array(solution.x), np.array(solution.z), str(solution.status)
        if not (np.isfinite(x).all() and np.isfinite(z).all()):
            x, z = np.full(len(x), np.nan), np.full(len(z), np.nan)
        quadratic = float(x @ data.square(x))
        far = self.radius * (1.0 + float(np.sqrt(x @ x))) if reach is None else reach
        return Answer(
            data.recover(x),
            0.5 * quadratic + float(data.q @ x) + data.d,
            data.bound(x, z, far) if bound else -np.inf,
            status,
            status == "Solved",
            int(solution.iterations),
        )

    def _elsewhere(self, values: Mapping[str, Array], backend: str, settings: Mapping[str, Any]) -> Answer:
        import cvxpy

        for name, value in values.items():
            self.parameters[name].value = value
        try:
            self.problem.solve(solver=backend, **settings)
        except cvxpy.error.SolverError as trouble:
            status = str(trouble)
        else:
            status = str(self.problem.status)
        found: dict[str, Array] = {}
        for variable in self.problem.variables():
            missing = variable.value is None
            found[variable.name()] = np.full(variable.shape, np.nan) if missing else np.asarray(variable.value)
        known = status in ("optimal", "optimal_inaccurate")
        stats = self.problem.solver_stats if known else None
        count = int(stats.num_iters or 0) if stats is not None else 0
        primal = float(self.problem.value) if known else np.nan
        return Answer(found, primal, -np.inf, status, status == "optimal", count)


def _solver(data: Data, settings: Mapping[str, Any]) -> Any:
    import clarabel

    chosen = clarabel.DefaultSettings()
    # a presolve or a decomposition would return multipliers of another problem than the one that bounds are read from
    chosen.verbose, chosen.presolve_enable, chosen.chordal_decomposition_enable = False, False, False
    chosen.max_threads = 1
    for name, value in settings.items():
        setattr(chosen, name, value)
    return clarabel.DefaultSolver(data.P, data.q, data.A, data.b, data.cones, chosen)


def kept(maxsize: int) -> Callable[[Callable[_Arguments, _Built]], Callable[_Arguments, _Built]]:
    """Build once for each set of arguments in each process, whichever thread asks first.

    Parameters
    ----------
    maxsize : int
        How many are kept, the latest used.

    Returns
    -------
    callable
        A decorator of functions with hashable arguments.
    """

    def decorate(build: Callable[_Arguments, _Built]) -> Callable[_Arguments, _Built]:
        cached, lock = lru_cache(maxsize)(build), threading.Lock()

        @wraps(build)
        def once(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Built:
            with lock:
                return cached(*args, **kwargs)  # type: ignore[arg-type]  # arguments are hashable

        return once

    return decorate

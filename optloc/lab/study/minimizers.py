"""External minimizers in a study: functions of a cost and a start, loaded from a file or a module of the user.

A study file cannot name a minimizer: only plugins that the user has loaded are found.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from optloc.engine import FEW, Normal, equations_at, may_use_code, pack, walks
from optloc.lab.study.baselines import BASELINES, Baseline, claim, teller, weighed_at, weighings
from optloc.lab.study.simulation import DrawnCase
from optloc.problem import Array, Fix, InvalidProblem, Problem, load_plugin, nearest, plugin_module, whiten

Cost = Callable[[Array], tuple[float, Array]]
"""Function from a parameter vector (size,) to the maximum-likelihood cost and its gradient (size,); SI units."""


@dataclass(frozen=True, slots=True)
class Minimizer:
    """Baseline of a function that minimises a cost, problem by problem.

    Parameters
    ----------
    function : callable of (Cost, array (size,))
        Returns the final vector (size,), as ``scipy.optimize.minimize(cost, start, jac=True).x`` does.
    """

    function: Callable[[Cost, Array], Array]

    def __call__(self, drawn: DrawnCase, start: Array) -> Fix:
        """Return the fixes of all trials; `start` are vectors (n, size).

        Every finite fix has the status ok, so that the study judges it as an answer.
        """
        x = np.array(start, dtype=float)
        for _ in range(weighings(drawn.problem)):
            weighted = weighed_at(drawn.problem, x, start)
            for i in range(len(x)):
                answer = np.asarray(self.function(cost_of(weighted.take(np.array([i])), teller(i)), x[i].copy()))
                if answer.shape != x[i].shape:
                    what = f"the method returned an array of shape {answer.shape}, not the vector {x[i].shape}"
                    raise InvalidProblem(what, "method", "return the vector of unknowns, as minimize(...).x")
                x[i] = answer
        return claim(drawn.problem, start, x)


def cost_of(one: Problem, tell: Callable[[float], None] = lambda _: None) -> Cost:
    """Return a function from a parameter vector (size,) to the cost of a problem and its gradient (size,).

    `one` is a flat batch with one problem. `tell` is called with each cost, to count evaluations.
    """
    equations = _equations(one)

    def cost(x: Array) -> tuple[float, Array]:
        at = equations(np.array(x, dtype=float)[None])
        value = float(at.cost[0])
        tell(value)
        # The normal equations contain minus half the gradient.
        return value, -2.0 * np.concatenate([at.shared_vector[0], at.local_vector[0].ravel()])

    return cost


def _equations(one: Problem) -> Callable[[Array], Normal]:
    """Return a function from a vector (1, size) to the normal equations of one problem, with priors.

    It uses machine code, because the time of the minimizer is measured: in NumPy single evaluations take six times
    longer.
    """
    from optloc.engine import normal_at, normal_block

    whitening, item = whiten(one.noise, one.weight), np.zeros(1, dtype=np.int64)
    # A minimizer evaluates the cost many times, so it is worth waiting for the compiled code.
    packed = pack(one, whitening) if may_use_code(normal_block, FEW + 1) and not walks(one) else None
    if packed is None:
        return lambda x: equations_at(one, x, whitening)
    return lambda x: normal_at(packed, x, item, priors=True)


def load_minimizer(name: str) -> None:
    """Load ``FILE.py:FUNCTION`` or ``MODULE:FUNCTION`` of the user, so that `baseline_of` finds the function.

    Raise InvalidProblem if the file, the module or the function does not exist.
    """
    place, _, _ = name.rpartition(":")
    load_plugin(place)
    baseline_of(name)


def baseline_of(name: str) -> Baseline:
    """Return a baseline by its name, or a function of a loaded plugin as a baseline.

    Raise InvalidProblem for an unknown name, or a function of a file or module that is not loaded.
    """
    if name in BASELINES:
        return BASELINES[name]
    place, _, function_name = name.rpartition(":")
    module = plugin_module(place) if place else None
    if module is None:
        raise InvalidProblem(f"unknown baseline {name!r}", "baseline", nearest(name, list(BASELINES)))
    function = getattr(module, function_name, None)
    if not callable(function):
        # Imported functions, such as `minimize`, are not methods of the file.
        own = {key: value for key, value in vars(module).items() if callable(value) and not key.startswith("_")}
        known = [key for key, value in own.items() if getattr(value, "__module__", module.__name__) == module.__name__]
        raise InvalidProblem(f"there is no function {function_name!r}", place, nearest(function_name, known))
    if isinstance(function, Baseline):
        return function
    summary = (function.__doc__ or "a function of a plugin").partition("\n")[0]
    return Baseline(Minimizer(function), summary, slow=True)


def code_of(name: str) -> str:
    """Return a digest of the source file of a plugin's baseline; empty for optloc's baselines.

    A method with a changed file counts as another method, because results of the old file do not belong to it.
    """
    run = baseline_of(name).run
    function = run.function if isinstance(run, Minimizer) else run
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    if module is None or module.__name__.partition(".")[0] == "optloc":
        return ""
    return _digest(module)


def _digest(module: ModuleType) -> str:
    """Return 16 hexadecimal digits that identify the source file of a module; empty without a file."""
    file = getattr(module, "__file__", None)
    return "" if file is None else hashlib.blake2b(Path(file).read_bytes(), digest_size=8).hexdigest()

"""Method of the table: the fixed steps of optloc on arrays of JAX, compiled by it."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from benchmarks.scenes import Scene
from benchmarks.with_general import STEPS
from benchmarks.with_optloc import problem_of

from optloc.engine import gauss_newton

jax.config.update("jax_enable_x64", True)


def steps(scene: Scene) -> Any:
    """Gauss-Newton steps from the truth, with covariance."""
    problem = problem_of(scene)

    def taken(x: Any) -> tuple[Any, Any]:
        found = gauss_newton(problem, x, steps=STEPS)
        return found.x, found.covariance

    compiled = jax.jit(taken)
    return lambda: np.asarray(jax.block_until_ready(compiled(scene.truth))[0])


METHODS = {"JAX, Gauss-Newton from the truth": steps}

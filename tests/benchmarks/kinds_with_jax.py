"""The batches of the benchmark of kinds by JAX: Gauss-Newton from the truth, compiled and mapped over the batch.

Run as ``python kinds_with_jax.py OUT.json``: seconds of a fix, seconds of the unit, and costs of the trials by row.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.kinds import KINDS, TRIALS, Answers, Kind, Way
from benchmarks.kinds_table import ROUNDS, UNIT, solved, timed
from benchmarks.with_general import STEPS

jax.config.update("jax_enable_x64", True)


def mapped(kind: Kind) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Return the compiled steps of a batch: unknowns (N, n) and measurements (N, m) to unknowns and costs (N,)."""
    opponent = kind.opponent
    white = jnp.asarray(np.linalg.inv(np.linalg.cholesky(opponent.covariance)))
    turning = np.zeros(len(white), dtype=bool)
    turning[opponent.angles or slice(0)] = True

    def residual(p: Any, z: Any) -> Any:
        gap = opponent.rows.value(p, jnp) - z
        return white @ jnp.where(turning, (gap + jnp.pi) % (2.0 * jnp.pi) - jnp.pi, gap)

    def solve(p: Any, z: Any) -> tuple[Any, Any]:
        z = jnp.concatenate([z, opponent.known])
        for _ in range(STEPS):
            J, r = jax.jacfwd(residual)(p, z), residual(p, z)
            p = p - jnp.linalg.solve(J.T @ J, J.T @ r)
        return p, (residual(p, z) ** 2).sum()

    return jax.jit(jax.vmap(solve))


def main(out: str) -> None:
    """Measure all kinds whose weights do not depend on the position."""
    unit, found = KINDS[0].case().ways["opponent"], {}
    solved(unit)
    for kind in KINDS:
        if callable(kind.opponent.covariance):
            continue
        truth, z = (array[: kind.batch] for array in kind.drawn)
        work = mapped(kind)

        def call(work=work, truth=truth, z=z) -> Any:
            return jax.block_until_ready(work(truth, z))

        way = Way(lambda call=call: [call], lambda results: Answers([], np.asarray(results[0][1]), np.zeros(0)), len(z))
        solved(way)
        answers, each = solved(way)
        units, times = zip(*((timed(unit, UNIT), timed(way, each)) for _ in range(ROUNDS)), strict=True)
        found[kind.name] = min(times), min(units), answers.cost[:TRIALS].tolist()
    Path(out).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])

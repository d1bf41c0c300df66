"""Methods of the table: optloc's own."""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmarks.scenes import SIGMA, Scene

import optloc
from optloc import Fix, Problem, assemble, measured, solve


def problem_of(scene: Scene) -> Problem:
    """Return the batch of problems of a scene."""
    a = np.arange(1, scene.stations.shape[1])
    rows = measured("tdoa", scene.z, a=a, b=np.zeros_like(a), arrival_sigma=SIGMA / np.sqrt(2.0))
    return assemble(scene.stations[:, None], rows)


def told(fix: Fix) -> tuple[np.ndarray, dict[str, float]]:
    """Return positions, and the share of fixes that are proven to be the global minimum."""
    position = np.where(fix.answered[:, None], fix.position, np.nan)
    return position, {"proven": float(np.mean([one.proof == "global" for one in np.ravel(fix.certificate)]))}


def batch(method: str) -> Any:
    """Return a method that fixes all emitters in one call."""

    def make(scene: Scene) -> Any:
        problem = problem_of(scene)

        def work() -> Any:
            fix = solve(problem, method)
            return lambda: told(fix)

        return work

    return make


def single(method: str) -> Any:
    """Return a method that fixes one emitter a call: a prepared problem with new measurements."""

    def make(scene: Scene) -> Any:
        problems = [problem_of(scene.first(i + 1)).take(np.array([i])) for i in range(len(scene.z))]
        ready = [optloc.prepare(problem, method) for problem in problems]

        def work() -> np.ndarray:
            return np.array([prepared(z).position for prepared, z in zip(ready, scene.z, strict=True)]).reshape(-1, 3)

        return work

    return make


METHODS = {
    "gtrs+lsr": batch("gtrs+lsr"),
    "gtrs+lsr+value": batch("gtrs+lsr+value"),
    "gtrs+lsr+certify": batch("gtrs+lsr+certify"),
    "auto": batch("auto"),
    "auto, one by one": single("auto"),
    "gtrs+lsr, one by one": single("gtrs+lsr"),
    "gtrs+nlp": batch("gtrs+nlp"),
    "sdp+lsr": batch("sdp+lsr"),
    "socp+lsr": batch("socp+lsr"),
}

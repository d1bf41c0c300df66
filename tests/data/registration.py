"""What the tests of registration on real data share: parts of a run, calibration, and learnt biases taken as known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from data.windows import quantiles, report

from optloc import Fix, Problem, Status, solve, with_bias
from optloc.engine import predict
from optloc.problem import Noise, with_known_bias
from optloc.problem.noise import Block

ROUNDS = 6


def part(problem: Problem, epochs: np.ndarray) -> Problem:
    """Return the problem of some epochs of a run whose noise does not tie them; it has no biases yet."""
    kept, number = np.isin(problem.epoch, epochs), np.full(problem.epochs, -1)
    number[epochs] = np.arange(len(epochs))
    place, rows = np.cumsum(kept) - 1, []
    for block in problem.rows:
        own = np.isin(block.epoch, epochs)
        picked = {n: getattr(block, n)[..., own] for n in ("z", "a", "b", "target", "weight", "correction")}
        rows.append(replace(block, epoch=number[block.epoch[own]], **picked))
    blocks = []
    for block in problem.noise.blocks:
        own = kept[block.row].all(1)
        blocks.append(Block(place[block.row[own]], block.covariance[own]))
    stations = problem.stations
    if len(stations.position) > 1:
        axes = None if stations.axes is None else stations.axes[epochs]
        stations = replace(stations, position=stations.position[epochs], axes=axes)
    return replace(
        problem, stations=stations, rows=tuple(rows), noise=Noise(tuple(blocks)), times=problem.times[epochs]
    )


def calibrating(problem: Problem, truth: np.ndarray) -> Problem:
    """Return the problem with its only target known at each epoch, (k, d)."""
    return replace(problem, motions=(replace(problem.motions[0], known=truth[:, None]),))


def learnt(problem: Problem, fix: Fix, name: str) -> dict[str, float]:
    """Return the estimates of a family of biases, by member."""
    bias = next(bias for bias in problem.biases if bias.name == name)
    return dict(zip(bias.members, fix.take(name).tolist(), strict=True))


def corrected(problem: Problem, values: Mapping[str, float], **family: Any) -> Problem:
    """Return the problem less biases of known value, by member; others are none. The family is as in `with_bias`."""
    biased = with_bias(problem, "known", **family)
    own = set(biased.biases[-1].members)
    return with_known_bias(biased, "known", {name: value for name, value in values.items() if name in own})


def plausible(problem: Problem, least: float = 0.01) -> np.ndarray:
    """Return the epochs whose rows do not contradict each other, by the chi-square of their own fixes."""
    return np.flatnonzero(solve(problem).p_value > least)


def robust(problem: Problem, scale: float) -> Fix:
    """Return the fix by Cauchy's loss: from plain least squares on, rows are weighed anew by what they are off."""
    fix = solve(problem)
    for _ in range(ROUNDS):
        off = problem.observed - predict(problem, fix.x)
        weight = np.where(np.isfinite(off), problem.weight / (1.0 + (off / scale) ** 2), problem.weight)
        fix = solve(problem.with_rows(weight=weight), "lsr", start=fix.x)
    return fix


def not_beaten(problem: Problem, fix: Fix, truth: np.ndarray) -> None:
    """Assert that the fix made without a guess costs no more than the minimum that a vector near the truth leads to."""
    started = solve(problem, "lsr", start=truth)
    assert fix.cost <= started.cost * (1.0 + 1e-6) + 1e-6


def lines(name: str, errors: Mapping[str, np.ndarray], unit: str = "m") -> dict[str, tuple[float, float]]:
    """Print and return median and 95 % of several sets of errors."""
    found = {case: quantiles(error) for case, error in errors.items()}
    said = ", ".join(f"{case} {median:.3g} / {high:.3g} {unit}" for case, (median, high) in found.items())
    report(f"{name}: error median / 95 % {said}")
    return found


def fixed(fix: Fix) -> Fix:
    """Return a fix, asserting that it has an answer."""
    assert fix.answered.all(), f"{Status(int(np.ravel(fix.code)[0])).label}: {fix.reason}"
    return fix

"""Problems with gross errors: stations and emitters at random in a box, some rows wrong by so many sigma."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from verdicts import alone

from optloc import Fix, Motion, Problem, assemble, measured, solve
from optloc.kernels.least_squares import refine
from optloc.solvers.certificates.admitted import certified
from optloc.solvers.pool import in_parts
from optloc.solvers.stages import search_widely
from optloc.solvers.suspect_rows.stage import suspect
from optloc.solvers.verdict.judge import verdict

BOX, SIGMA, MILLIRADIANS = np.array([10e3, 10e3, 6e3]), 10.0, 3e-3
# Kilometres: six stations in a plane but for some hundred metres, in which every place has an image.
_NEARLY_FLAT = ((0.0, 0.0, 0.0), (9.0, 1.0, 0.2), (1.0, 8.0, 0.5), (8.0, 9.0, 0.3), (4.0, -3.0, 0.1), (-3.0, 4.0, 0.4))


@dataclass(frozen=True)
class Spoilt:
    """A batch of problems, true vectors (N, size), which arrivals are wrong (N, s), and by how many sigma (N, s)."""

    problem: Problem
    truth: np.ndarray
    wrong: np.ndarray
    error: np.ndarray | None = None


def spoilt(
    kind: str,
    trials: int,
    stations: int,
    *,
    bad: int = 0,
    share: float = 0.0,
    size: float = 100.0,
    late=False,
    seed=1,
    dimension: int = 3,
    noise: float = 1.0,
) -> Spoilt:
    """Return trials in which `bad` rows, or each with a probability, are off by `size` sigma, either way or late.

    All errors besides are `noise` times as large as is stated; azimuths have 3 mrad.
    """
    rng = np.random.default_rng([seed, stations, bad])
    place = rng.uniform(-0.5, 0.5, (trials, 1, stations, dimension)) * BOX[:dimension]
    truth = rng.uniform(-0.5, 0.5, (trials, dimension)) * BOX[:dimension]
    apart = truth[:, None] - place[:, 0]
    exact = np.arctan2(apart[..., 1], apart[..., 0]) if kind == "azimuth" else np.linalg.norm(apart, axis=-1)
    sigma = MILLIRADIANS if kind == "azimuth" else SIGMA
    wrong = np.argsort(rng.random((trials, stations)), axis=1) < bad
    wrong |= rng.random(wrong.shape) < share
    sign = 1.0 if late else rng.choice([-1.0, 1.0], wrong.shape)
    z = exact + sigma * (noise * rng.standard_normal(wrong.shape) + size * sign * wrong)
    every = np.arange(stations)
    if kind == "tdoa":
        rows = measured("tdoa", z[:, 1:] - z[:, :1], a=every[1:], b=0, arrival_sigma=sigma)
    elif kind == "toa":
        rows = measured("toa", z + 5e3, a=every, sigma=sigma)
        truth = np.column_stack([truth, np.full(trials, 5e3)])
    else:
        z = (z + np.pi) % (2 * np.pi) - np.pi if kind == "azimuth" else z
        rows = measured(kind, z, a=every, sigma=sigma)
    return Spoilt(assemble(place, rows), truth, wrong, size * sign * wrong)


def solve_apart(problem: Problem) -> Fix:
    """Return what `robust` says of problems that have nothing to do with each other: liars in all are no noise."""

    def work(part: Problem, _: slice) -> Fix:
        pool = suspect(part, search_widely(part), together=False)
        return verdict(part, certified(part, pool))

    return in_parts(problem, work)


def worse_than_from_truth(case: Spoilt, method: str, fix: Fix) -> np.ndarray:
    """Return the trials in which the minimum that the truth leads to costs less than the answer."""
    best = solve(case.problem, method, start=case.truth)
    return np.flatnonzero(~(fix.cost <= best.cost + 1e-3) & np.isfinite(best.cost))


def least_squares(case: Spoilt) -> np.ndarray:
    """Return the least-squares positions (N, 3) next to the truth of clean data."""
    return refine(case.problem, case.truth).x[:, :3]


def rmse(position: np.ndarray, truth: np.ndarray) -> float:
    """Return the root mean square of the length of position errors (N, 3)."""
    return float(np.sqrt(((position - truth[:, :3]) ** 2).sum(-1).mean()))


def nees(fix: Fix, truth: np.ndarray) -> np.ndarray:
    """Return squared errors (N,) of positions in their own sigma, over their number; NaN where nothing is claimed."""
    claimed = alone(fix)
    out, error = np.full(len(fix), np.nan), (fix.position - truth[:, :3])[claimed, :, None]
    solved = np.linalg.solve(fix.covariance()[claimed], error)
    out[claimed] = (np.swapaxes(error, 1, 2) @ solved)[:, 0, 0] / 3.0
    return out


def wild_run(seed: int, epochs: int, share: float) -> tuple[Problem, np.ndarray, np.ndarray]:
    """Return ranges to a target that moves in space, its places (k, 3), and which rows are 200 to 3000 m off."""
    rng, stations = np.random.default_rng(seed), 1e3 * np.array(_NEARLY_FLAT)
    start, velocity = rng.uniform([0.0, 0.0, 1e3], [8e3, 8e3, 3e3]), np.append(rng.uniform(-150.0, 150.0, 2), 0.0)
    times = np.arange(epochs) * 1.0
    places = start + times[:, None] * velocity
    a, epoch = np.tile(np.arange(len(stations)), epochs), np.repeat(np.arange(epochs), len(stations))
    z = np.linalg.norm(places[epoch] - stations[a], axis=1) + SIGMA * rng.standard_normal(len(a))
    wild = rng.random(len(a)) < share
    z[wild] += rng.choice([-1.0, 1.0], wild.sum()) * rng.uniform(200.0, 3000.0, wild.sum())
    rows, motion = measured("range", z, a=a, sigma=SIGMA, epoch=epoch), Motion(1, reference=times[-1])
    return assemble(stations, rows, times=times, motions=(motion,)), places, wild

"""Counts of registration: many draws of one run, solved without a guess and, beside it, from the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from time import perf_counter
from zlib import crc32

import numpy as np
from monte_carlo.layouts import SEED
from runs import truth
from verdicts import alone

import optloc
from optloc import Problem
from optloc.kernels.least_squares import refine

Array = np.ndarray
SLACK = 1e-3
"""A cost that exceeds that of the optimum next to the truth by more than this is a failure."""

_CHUNK = 200
_SAME = 1e-2
_PATIENCE = 300  # valleys of weak runs are long and curved


@dataclass(frozen=True)
class Case:
    """A run and where its trials lie.

    Parameters
    ----------
    name : str
        Also decides the seed.
    problem : Problem
        Without measurements.
    truths : callable, optional
        ``(rng, trials) -> (trials, size)``; None: the truth of `runs`, in every trial.
    spoil : callable, optional
        ``(problem, rng) -> problem``: what happens to the rows after they were drawn.
    """

    name: str
    problem: Problem
    truths: Callable[[np.random.Generator, int], Array] | None = None
    spoil: Callable[[Problem, np.random.Generator], Problem] | None = None


@dataclass(frozen=True)
class Counts:
    """What became of N trials.

    Parameters
    ----------
    code : int array (N,)
        Statuses.
    sure : bool array (N,)
        One place was found and nothing speaks against it; nothing proves that of a run.
    failed : bool array (N,)
        The answer costs more than the optimum that is reached from the truth, or is none.
    away : bool array (N,)
        The answer is not that optimum.
    listed : bool array (N,)
        The optimum is one of the alternatives.
    gap : array (N,)
        Cost of the best alternative less that of the answer.
    error : array (N, n)
        The answer or the alternative that is nearest to the truth, less the truth; shared unknowns.
    nees : array (N, p)
        Squared errors of the answer in units of its own covariance: of the target and of each family of biases.
    start : array (N,)
        Distance of the nearest start from the truth before the refinement on all epochs, metres; NaN if not asked for.
    seconds : array (N,)
        Time of one trial.
    """

    code: Array
    sure: Array
    failed: Array
    away: Array
    listed: Array
    gap: Array
    error: Array
    nees: Array
    start: Array
    seconds: Array

    def __len__(self) -> int:
        return len(self.code)

    @property
    def rmse(self) -> float:
        """Return the root mean square of the length of the position error, metres."""
        return float(np.sqrt((self.error[:, :3] ** 2).sum(1).mean()))


def counted(case: Case, trials: int, *, starts: bool = False) -> Counts:
    """Return the counts of some trials of a case; the first ones are the same whatever their number."""
    parts = []
    for first in range(0, trials, _CHUNK):
        seed = np.random.SeedSequence([SEED, crc32(case.name.encode()), first])
        parts.append(judged(*drawn(case, seed, min(_CHUNK, trials - first)), starts=starts))
    return Counts(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Counts)))


def drawn(case: Case, seed: np.random.SeedSequence, trials: int) -> tuple[Problem, Array]:
    """Return trials of a case and their true vectors (trials, size)."""
    draw, place, spoil = seed.spawn(3)
    if case.truths is None:
        x = np.tile(truth(case.problem), (trials, 1))
    else:
        x = case.truths(np.random.default_rng(place), trials)
    problem = optloc.simulate(case.problem, x, draw)
    return problem if case.spoil is None else case.spoil(problem, np.random.default_rng(spoil)), x


def judged(problem: Problem, x: Array, *, starts: bool = False) -> Counts:
    """Return the counts of drawn trials with true vectors (N, size)."""
    began = perf_counter()
    # What is proven of runs, and against what, is the matter of `tests/proof`: here it would be most of the time.
    fix = optloc.solve(problem, "searched")
    seconds = perf_counter() - began
    best = refine(problem, x, limit=_PATIENCE)
    n = problem.layout.n_shared
    pool = _pool(fix, n)
    same = _alike(pool, best.x[:, None, :n], best.equations.shared)
    return Counts(
        fix.code,
        alone(fix),
        ~(fix.answered & (fix.cost <= best.cost + SLACK)),
        ~same[:, 0],
        same[:, 1:].any(1),
        np.min(fix.alternatives.gap, axis=1, initial=np.inf),
        _nearest(pool, x[:, :n]),
        np.stack(_nees(fix, x), axis=1),
        np.linalg.norm(_nearest(_pool(optloc.solve(problem, "roots", refine=False), n), x[:, :n])[:, :3], axis=1)
        if starts
        else np.full(len(x), np.nan),
        np.full(len(x), seconds / len(x)),
    )


def _pool(fix: optloc.Fix, n: int) -> Array:
    return np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)[..., :n]


def _alike(pool: Array, best: Array, information: Array) -> Array:
    """Return which points (N, q) are the optimum, to a hundredth of a standard deviation in every direction."""
    apart = pool - best
    with np.errstate(invalid="ignore"):
        return ((apart @ information) * apart).sum(-1) < _SAME**2


def _nearest(pool: Array, x: Array) -> Array:
    apart = pool - x[:, None]
    distance = np.linalg.norm(apart[..., :3], axis=-1)
    return apart[np.arange(len(x)), np.where(np.isfinite(distance), distance, np.inf).argmin(1)]


def _nees(fix: optloc.Fix, x: Array) -> list[Array]:
    """Return the squared errors (N,) of the target's state and of each family of biases."""
    layout = fix.layout
    states = [slot for slot in layout.shared if slot.name in ("position", "velocity")]
    parts = [slice(0, states[-1].start + states[-1].size)]
    parts += [slice(slot.start, slot.start + slot.size) for slot in layout.shared if slot not in states]
    out = []
    for part in parts:
        error, cov = (fix.x - x)[:, part, None], fix.cov[:, part, part]
        known = np.isfinite(cov).all((1, 2))
        cov = np.where(known[:, None, None], cov, np.eye(cov.shape[-1]))
        squared = (np.swapaxes(error, 1, 2) @ np.linalg.solve(cov, error))[:, 0, 0]
        out.append(np.where(known, squared, np.nan))
    return out


def expected(problem: Problem, x: Array) -> Array:
    """Return the covariance of the error at a truth (n, n), to first order.

    Without priors the Cramer-Rao bound. A prior takes the biases of the truth x for an unlikely draw and pulls towards
    its own mean; the bound of a random draw is then not that of one truth.
    """
    cov = optloc.crlb(problem, x)
    prior, pull = np.zeros_like(cov), np.zeros(len(cov))
    for bias in problem.biases:
        if bias.sigma is not None:
            slot, _ = problem.layout.find(bias.name)
            part = np.arange(slot.start, slot.start + slot.size)
            prior[part, part] = 1.0 / bias.sigma.ravel() ** 2
            pull[part] = prior[part, part] * (x[part] - bias.mean.ravel())
    shift = cov @ pull
    return cov - cov @ prior @ cov + np.outer(shift, shift)


def around(rng: np.random.Generator, trials: int) -> Array:
    """Return targets 50 to 600 km away in all directions, with biases within 60 m, (trials, 7)."""
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, trials), rng.uniform(50e3, 600e3, trials)
    biases = rng.uniform(-60.0, 60.0, (trials, 4))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle, biases])

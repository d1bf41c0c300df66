"""The probability of each status at given positions, from many simulated measurements.

Letters: q positions, s statuses, `size` numbers of a parameter vector. A trial is one simulated measurement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import PRECEDENCE, Array, Prior, Status
from optloc.bounds.over_area import Grid, grid_of
from optloc.linear.normal import prior_parts
from optloc.linear.simulate import samples, simulate
from optloc.problem.chart import CURVED
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.solution import solve

# Fixes that are solved together: their rows take some tens of megabytes.
_PART = 2**14
_STATES = ("position", "velocity", "acceleration")


@dataclass(frozen=True, slots=True)
class StatusShares:
    """Shares of the statuses of fixes at given positions.

    Parameters
    ----------
    statuses : tuple of s Status
        Statuses that occur, in the order of precedence.
    share : array (..., s)
        Share of each status in the trials at each position; they sum to one.
    covered : array (...)
        Share of the `ok` fixes whose 95 % region contains the true position; NaN without such fixes, and for problems
        of several positions.
    trials : int
        Simulated measurements at each position.
    """

    statuses: tuple[Status, ...]
    share: Array
    covered: Array
    trials: int

    def of(self, status: Status) -> Array:
        """Return the share (...) of one status."""
        if status not in self.statuses:
            return np.zeros(self.share.shape[:-1])
        return np.asarray(self.share[..., self.statuses.index(status)])

    @property
    def deviation(self) -> Array:
        """Return the standard errors (..., s) of the shares, from the number of trials."""
        return np.asarray(np.sqrt(self.share * (1.0 - self.share) / self.trials))


def status_shares(
    problem: Problem, truth: Array, trials: int = 200, seed: int = 0, method: str = "auto"
) -> StatusShares:
    """Return the share of each status among fixes of simulated measurements at given positions.

    The simulation draws noise, biases from their priors, and prior means of states about the truth. The figures of `ok`
    apply to all measurements; this function returns the share of measurements that are `ok`.

    Parameters
    ----------
    problem : Problem
        A single problem. Of a batch, or of epochs that share nothing, the first is used. Its measurements do not
        matter.
    truth : array (..., size)
        True parameter vectors in the order of ``problem.layout``, with the positions.
    trials : int
        Simulated measurements at each position.
    seed : int
        Seed of all draws. The draws at a position depend on the seed and the number of the position only.
    method : str
        As of `optloc.solve`.

    Raises
    ------
    InvalidProblem
        For less than one trial, and for true vectors of another size.
    """
    apart = by_epoch(problem) if separable(problem) else problem
    single = apart.flat().take(np.zeros(1, dtype=int))
    truth = np.asarray(truth, dtype=float)
    if trials < 1:
        raise InvalidProblem(f"{trials} trials are not enough", "trials", "take 100 or more")
    if truth.shape[-1:] != (single.layout.size,):
        advice = f"give {single.layout.size} numbers in the order of problem.layout"
        raise InvalidProblem(f"a truth of shape {truth.shape} does not fit the unknowns", "truth", advice)
    places = truth.reshape(-1, truth.shape[-1])
    code, holds = (np.empty((len(places), trials), dtype=kind) for kind in (np.int8, float))
    for part in _parts(len(places), trials):
        fix, true = _solve_trials(single, places[part], part, trials, seed, method)
        code[part] = fix.code.reshape(-1, trials)
        holds[part] = _hold(fix, true).reshape(-1, trials)
    return _shares(code, holds, truth.shape[:-1])


def _parts(count: int, trials: int) -> Iterator[Array]:
    """Yield arrays with the numbers of the positions whose trials are solved together; `count` positions exist."""
    size = max(1, _PART // trials)
    for first in range(0, count, size):
        yield np.arange(first, min(first + size, count))


def _solve_trials(
    single: Problem, places: Array, numbers: Array, trials: int, seed: int, method: str
) -> tuple[Fix, Array]:
    """Return the fixes (q trials,) of measurements at q positions, and the true vectors (q trials, size).

    `single` is the problem, without measurements, and `method` solves it. `places` (q, size) are the true vectors at
    the positions, and `numbers` (q,) the numbers of the positions: together with `seed` they determine the draws.
    """
    drawn, true = [], []
    for number, place in zip(numbers.tolist(), places, strict=True):
        at_truth, at_noise = np.random.SeedSequence((seed, number)).spawn(2)
        problem, x = _with_drawn_priors(single, place, trials, np.random.default_rng(at_truth))
        drawn.append(simulate(problem, x, at_noise))
        true.append(x)
    z = np.concatenate([one.z for one in drawn])
    priors = tuple(
        Prior(first.name, np.concatenate([one.priors[i].mean for one in drawn]), first.covariance)
        for i, first in enumerate(drawn[0].priors)
    )
    many = replace(single.take(np.zeros(len(z), dtype=int)).with_rows(z=z), priors=priors)
    return solve(many, method), np.concatenate(true)


def _with_drawn_priors(problem: Problem, place: Array, trials: int, rng: np.random.Generator) -> tuple[Problem, Array]:
    """Return `trials` problems with drawn prior means, and their true vectors (trials, size).

    Prior means of states are drawn about the true vector `place` (size,). Biases and other unknowns are drawn from
    their priors. `rng` makes all draws.
    """
    layout, n = problem.layout, problem.layout.n_shared
    x, means = np.tile(place, (trials, 1)), dict[str, Array]()
    local = x[:, n:].reshape(trials, problem.epochs, -1)
    for name, mean, precision in prior_parts(problem):
        slot, shared = layout.find(name)
        entries = slice(slot.start, slot.start + slot.size)
        spread = linalg.inverse(precision.reshape(-1, slot.size, slot.size)[:1])[0]
        if name.partition("[")[0] in _STATES:
            means[name] = samples(spread, (trials,), rng) + (place[entries] if shared else mean)
        elif shared:
            x[:, entries] = np.reshape(mean, (-1, slot.size))[0] + samples(spread, (trials,), rng)
        else:
            drawn = samples(spread, (trials, problem.epochs), rng)
            local[..., entries] = np.reshape(mean, (-1, slot.size))[0] + drawn
    x[:, n:] = local.reshape(trials, -1)
    priors = tuple(replace(one, mean=means.get(one.name, one.mean)) for one in problem.priors)
    return replace(problem.take(np.zeros(trials, dtype=int)), priors=priors), x


def _hold(fix: Fix, true: Array) -> Array:
    """Return 1 for each `ok` fix whose 95 % region contains the truth, 0 if it does not, and NaN for other fixes; (N,).

    Fixes with a curved region count as other fixes.
    """
    out = np.full(len(true), np.nan)
    if fix.chart is None:
        return out
    items = np.flatnonzero((fix.code == Status.OK) & (fix.chart.kind != CURVED))
    if len(items):
        out[items] = fix[items].covers(fix.layout.take(true[items], "position"))
    return out


def _shares(code: Array, holds: Array, shape: tuple[int, ...]) -> StatusShares:
    """Return the shares of statuses from codes (q, trials) at q positions, which form an array of a given shape.

    `holds` (q, trials) has the results of `_hold`.
    """
    statuses = tuple(one for one in PRECEDENCE if (code == one).any())
    share = np.stack([(code == one).mean(-1) for one in statuses], axis=-1)
    known = np.isfinite(holds).sum(-1)
    with np.errstate(invalid="ignore"):
        covered = np.nansum(holds, axis=-1) / np.where(known > 0, known, np.nan)
    return StatusShares(statuses, share.reshape(*shape, -1), covered.reshape(shape), code.shape[-1])


@dataclass(frozen=True, slots=True)
class StatusMap:
    """Shares of the statuses over a grid of positions.

    Parameters
    ----------
    grid : Grid
        The positions.
    shares : StatusShares
        Shares at the positions (ny, nx).
    """

    grid: Grid
    shares: StatusShares


def status_map(
    problem: Problem,
    truth: Array,
    x: Array,
    y: Array,
    height: float = 0.0,
    *,
    trials: int = 100,
    seed: int = 0,
    method: str = "auto",
    geodetic: bool | None = None,
) -> StatusMap:
    """Return the shares of the statuses of fixes of a target at every point of a grid.

    Parameters
    ----------
    problem, truth, x, y, height, geodetic
        As of `optloc.bounds.over_area.bound_map`.
    trials, seed, method
        As of `status_shares`.
    """
    grid = grid_of(problem, x, y, height, geodetic)
    vectors = np.tile(np.asarray(truth, dtype=float), (*grid.shape, 1))
    vectors[..., grid.slot] = grid.places.reshape(*grid.shape, -1)
    return StatusMap(grid, status_shares(problem, vectors, trials, seed, method))

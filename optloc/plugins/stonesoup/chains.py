"""Chains of detections of several scans that may come from one target, fitted in batches within a limit of work.

The fix of one scan gives a position, and the fixes of two scans give a velocity. A chain with these start
values needs one descent, which is an iterative refinement. A search without start values takes as long as
hundreds of descents.

Letters: d coordinates, n numbers of a state (position, and velocity if it is known), B runs of
detections, C chains, K descents, m rows, q states. The gate is the largest distance between a detection
and a prediction at which both are compared.

Arguments of many functions: `terms` are the assumptions about all targets (`ChainTerms`), and `work` is
the work that the call can still do.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.special import chdtri

from optloc.engine import Refined, covariance, degrees_of_freedom, linearise, refine
from optloc.plugins.stonesoup.models import problem_of, rows_by_kind, values_of
from optloc.problem import Array, Fix, Motion, Prior, Problem, Status, tail_probability
from optloc.solvers import prepare, solve

# Smallest cost gap to another minimum at which a fix counts as Gaussian: five standard deviations.
GAP = 25.0
# Largest standard deviation of a Gaussian fix, as a share of the nearest range: a circle deviates from its
# tangent by half the square of this angle, which is 2.5 % of the standard deviation.
_FLAT = 0.05
# Factor of the gate (squared distance) before a fit: the gate is linear but the rows are curved, so it is twice
# as wide in standard deviations as the test after the fit.
_WIDE = 4.0
# Method for single scans: the search finds only mirror images, and there is no proof.
_QUICK = "gtrs+lsr"
# Largest number of states that a chain keeps: the best and its alternatives. Flat networks have two.
_KEPT = 3
# Steps of a descent: chains of one target need four to eight, and a descent that needs more is rarely one
# target.
_STEPS = 30
# Two descents have the same minimum if their squared distance, in units of the covariance, is smaller: 0.1
# sigma.
_SAME = 1e-2

# Work of a batch and of a descent, in milliseconds of one core (of 2020 or later, with five rows per scan); the
# limit of work of a call has the same unit.
_BATCH, _DESCENT = 8.0, 0.3
LONG = 100.0
"""Work of a search without a start, or of a proof that a fix is unique, in milliseconds."""


@dataclass(slots=True)
class ChainWork:
    """The work that a call can still do (`left`), in units of about a millisecond."""

    left: float

    def take(self, cost: float) -> bool:
        """Return whether work is left, and subtract the cost if so; the rest may become negative."""
        if self.left <= 0.0:
            return False
        self.left -= cost
        return True


@dataclass(frozen=True, slots=True)
class ChainTerms:
    """Assumptions about all targets.

    Parameters
    ----------
    order : int
        1 for targets with a velocity, 0 for targets at rest.
    speed : float, optional
        Prior standard deviation of each velocity coordinate about zero, m/s; None without a prior.
    least_p : float
        Smallest p-value of a chain; a chain with a smaller p-value is not one target.
    """

    order: int
    speed: float | None
    least_p: float


@dataclass(frozen=True, slots=True)
class DetectionChain:
    """Detections that may come from one target, in order of time.

    Parameters
    ----------
    detections : tuple of Detection
        Detections with models of this plug-in.
    x : array (q, n)
        States at the last detection that fit, best first: metres, then m/s. A state is only a position if no row or
        prior determines the velocity. q = 0 if no position is determined.
    cov : array (n, n), optional
        Covariance of the first state; None if it is too wide for a Gaussian, or if there are several states.
    p : float
        p-value of the chi-square; 1 without redundancy.
    """

    detections: tuple[Any, ...]
    x: Array
    cov: Array | None
    p: float

    @property
    def last(self) -> dt.datetime:
        """Return the time of the last detection."""
        return self.detections[-1].timestamp  # type: ignore[no-any-return]

    def __len__(self) -> int:
        """Return the number of detections."""
        return len(self.detections)


def is_flat(cov: Array, position: Array, detection: Any) -> bool:
    """Return whether the largest sigma of a covariance (d, d), m^2, is below 5 % of the range of the nearest station.

    Then a fix at `position` (d,) is nearly Gaussian. `detection` provides the stations.
    """
    nearest = np.linalg.norm(detection.measurement_model.sites - position, axis=-1).min()
    return bool(np.isfinite(cov).all() and np.sqrt(np.linalg.eigvalsh(cov)[-1]) < _FLAT * nearest)


def posed(runs: Sequence[Sequence[Any]], terms: ChainTerms) -> tuple[Problem, Array]:
    """Return the problem of B runs of detections, without values, and the values (B, m) of its rows.

    A run is a sequence of detections in the order of time. The runs have the same rows in each scan, and the
    same time differences. The state is the state at the last scan.
    """
    models = [[detection.measurement_model for detection in run] for run in runs]
    last = runs[0][-1].timestamp
    times = np.array([(detection.timestamp - last).total_seconds() for detection in runs[0]])
    d = len(models[0][0].mapping)
    priors = [Prior("velocity", np.zeros(d), terms.speed**2 * np.eye(d))] if terms.order and terms.speed else []
    rates = None if models[0][0].rates is None else _common_values([[model.rates for model in run] for run in models])
    rows = [model.rows for model in models[0]]
    problem = problem_of(
        _common_values([[model.sites for model in run] for run in models]),
        rows,
        [_common_values([run[k].covar() for run in models]) for k in range(len(rows))],
        velocity=rates,
        times=times,
        motions=(Motion(terms.order, reference=0.0),),
        priors=priors,
    )
    z = np.array([np.concatenate([values_of(detection) for detection in run]) for run in runs])
    return problem, z[:, rows_by_kind(rows)[1]]


def _common_values(values: Any) -> Array:
    """Return an array (B, ...), or only its first entry if all entries are equal."""
    array = np.asarray(values, dtype=float)
    return array[0] if (array == array[:1]).all() else array


def _batch_key(run: Sequence[Any]) -> Any:
    """Return a key that is equal for runs that fit into one batch: same shapes, rows and time differences."""
    last = run[-1].timestamp
    shape = run[0].measurement_model.stations.shape, tuple(run[0].measurement_model.mapping)
    scans = tuple((tuple(d.measurement_model.rows), d.measurement_model.rates is None) for d in run)
    return shape, scans, tuple(last - detection.timestamp for detection in run)


def _group_indices(keys: Sequence[Any]) -> list[list[int]]:
    """Return lists of the indices of equal keys, in the order of their first occurrence."""
    found: dict[Any, list[int]] = {}
    for i, key in enumerate(keys):
        found.setdefault(key, []).append(i)
    return list(found.values())


def alone(scan: Sequence[Any], terms: ChainTerms) -> list[DetectionChain]:
    """Return a chain for each detection of a scan, with the fix of this detection alone.

    Detections with the same rows are solved as one batch.
    """
    out: list[Any] = [None] * len(scan)
    for members in _group_indices([_batch_key([detection]) for detection in scan]):
        moving = scan[members[0]].measurement_model.rates is not None
        terms_here = ChainTerms(terms.order if moving else 0, terms.speed, terms.least_p)
        problem, z = posed([[scan[i]] for i in members], terms_here)
        fixes = prepare(problem, _QUICK)(z).flat()
        for place, i in enumerate(members):
            out[i] = _chain_of_fix((scan[i],), fixes[place], terms)
    return out


def _chain_of_fix(detections: tuple[Any, ...], fix: Fix, terms: ChainTerms) -> DetectionChain:
    """Return the chain of some detections with the states of their common fix.

    If the fix has no velocity, the velocity prior of `terms` is added.
    """
    p = float(fix.p_value)
    p = 1.0 if np.isnan(p) else p
    if not bool(fix.answered) or bool(fix.has(Status.UNBOUNDED)):
        return DetectionChain(detections, x=np.zeros((0, len(fix.x))), cov=None, p=p)
    rivals = fix.alternatives.x[fix.alternatives.gap < GAP]
    x, cov = np.concatenate([fix.x[None], rivals])[:_KEPT], np.array(fix.cov)
    d = fix.position.shape[-1]
    if terms.order and terms.speed and x.shape[1] == d:
        # The velocity is zero with the prior covariance, independent of the position.
        x, cov = np.hstack([x, np.zeros_like(x)]), np.kron(np.diag([0.0, terms.speed**2]), np.eye(d))
        cov[:d, :d] = fix.cov
    good = len(x) == 1 and is_flat(cov[:d, :d], x[0, :d], detections[-1])
    return DetectionChain(detections, x, cov if good else None, p)


def near(chains: Sequence[DetectionChain], single: DetectionChain, terms: ChainTerms) -> list[tuple[float, int]]:
    """Return the distance of a detection from each chain that it may continue, and the index of the chain.

    The distance is the squared innovation in units of its covariance, divided by the gate: 1 at the edge of
    the gate. Chains without a Gaussian state have no prediction and get the distance 1. Chains beyond the
    gate are omitted. `chains` are the waiting chains, and `single` is the chain of the detection alone.
    """
    detection = single.detections[-1]
    known = [
        i for i, c in enumerate(chains) if c.last < detection.timestamp and _same_stations(c.detections[-1], detection)
    ]
    d = len(detection.measurement_model.mapping)
    # `known` chains end before the detection. `blind` chains have no prediction, and `sharp` chains have a Gaussian.
    blind = [i for i in known if chains[i].cov is None or chains[i].x.shape[1] != d * (terms.order + 1)]
    sharp = [i for i in known if i not in set(blind)]
    out = [(1.0, i) for i in blind]
    if not sharp:
        return out
    mean = np.stack([_predict(chains[i].x[:1], chains[i], detection, d)[0] for i in sharp])
    step = np.array([(detection.timestamp - chains[i].last).total_seconds() for i in sharp])
    cov = np.stack([np.asarray(chains[i].cov) for i in sharp])
    F = np.tile(np.eye(mean.shape[1]), (len(sharp), 1, 1))
    if terms.order:
        F[:, :d, d:] = step[:, None, None] * np.eye(d)
    share = _innovations(detection, mean, F @ cov @ F.mT) / (
        _WIDE * chdtri(detection.measurement_model.ndim_meas, terms.least_p)
    )
    return out + [(float(s), i) for s, i in zip(share, sharp, strict=True) if s < 1.0]


def _innovations(detection: Any, mean: Array, cov: Array) -> Array:
    """Return the squared distances (C,) of a detection from the predictions of C states.

    `mean` (C, n) and `cov` (C, n, n) are the predicted states. The distances are in units of the innovation
    covariance.
    """
    model = detection.measurement_model
    size, order = len(model.places), model.order
    # A rate model also needs the velocity. For a target at rest, the velocity is exactly zero.
    x, P = np.zeros((len(mean), size)), np.zeros((len(mean), size, size))
    n = min(size, mean.shape[1])
    x[:, :n], P[:, :n, :n] = mean[:, :n], cov[:, :n, :n]
    linear = linearise(model.problem.with_rows(z=values_of(detection)[order]), x)
    S = linear.shared @ P @ linear.shared.mT + np.asarray(model.covar(), dtype=float)[np.ix_(order, order)]
    return np.asarray((linear.residual * np.linalg.solve(S, linear.residual[..., None])[..., 0]).sum(-1))


def _same_stations(one: Any, two: Any) -> bool:
    """Return whether two detections can be scans of one run: same number of stations, same state mapping."""
    a, b = one.measurement_model, two.measurement_model
    return a.stations.shape == b.stations.shape and list(a.mapping) == list(b.mapping)


def _predict(x: Array, chain: DetectionChain, detection: Any, d: int) -> Array:
    """Return the states x (q, n) of a chain at the time of a detection, for constant velocity.

    States without a velocity do not change. `d` is the number of coordinates.
    """
    if x.shape[1] == d:
        return x
    step = (detection.timestamp - chain.last).total_seconds()
    return np.hstack([x[:, :d] + step * x[:, d:], x[:, d:]])


def _starts(chain: DetectionChain, single: DetectionChain, terms: ChainTerms) -> Array:
    """Return start states (q, n) for the fit of a chain with one more detection.

    They are predictions of the chain, and for a chain of one detection velocities from two positions.
    `single` is the chain of the new detection.
    """
    detection = single.detections[-1]
    d = len(detection.measurement_model.mapping)
    if not terms.order:
        return np.concatenate([chain.x, single.x])[:_KEPT]
    ahead = [_predict(chain.x, chain, detection, d)] if chain.x.shape[1] == 2 * d else []
    if len(chain) == 1 or not len(chain.x):
        step = (detection.timestamp - chain.last).total_seconds()
        # The velocity follows from two positions. If only one of the two is known, the target starts at rest.
        pairs = [(b, (b - a) / step) for a, b in product(chain.x[:, :d], single.x[:, :d])]
        pairs = pairs or [(a, np.zeros(d)) for a in (*chain.x[:, :d], *single.x[:, :d])]
        ahead.append(np.array([np.concatenate(pair) for pair in pairs]).reshape(-1, 2 * d))
    return np.concatenate(ahead)


def grown(
    pairs: Sequence[tuple[DetectionChain, DetectionChain]], terms: ChainTerms, work: ChainWork
) -> list[tuple[DetectionChain, DetectionChain, DetectionChain]]:
    """Return (longer chain, chain, chain of the detection) of the pairs that fit together.

    `pairs` are chains with the chain of a later detection. They are fitted in their order, until no work is
    left. Pairs with the same rows and times are fitted as one batch.
    """
    chosen: dict[Any, list[tuple[DetectionChain, DetectionChain, Array]]] = {}
    for chain, single in pairs:
        key, starts = _batch_key((*chain.detections, *single.detections)), _starts(chain, single, terms)
        # Each new batch has a fixed amount of work, and each descent adds to it.
        if not work.take((0.0 if key in chosen else _BATCH) + _DESCENT * len(starts)):
            break
        chosen.setdefault(key, []).append((chain, single, starts))
    out = []
    for members in chosen.values():
        runs = [(*chain.detections, *single.detections) for chain, single, _ in members]
        longer = _fit_runs(runs, [starts for _, _, starts in members], terms, work)
        found = zip(longer, members, strict=True)
        out += [(new, chain, single) for new, (chain, single, _) in found if new is not None and new.p >= terms.least_p]
    return out


def _fit_runs(
    runs: Sequence[tuple[Any, ...]], starts: Sequence[Array], terms: ChainTerms, work: ChainWork
) -> list[DetectionChain | None]:
    """Return the chains of runs with the same rows and times; None if a run needs a search and no work is left.

    `starts` are the start states (q, n) of each run; a run without starts needs a search.
    """
    problem, z = posed(runs, terms)
    problem = problem.with_rows(z=z)
    dof = degrees_of_freedom(problem)
    out: list[DetectionChain | None] = [None] * len(runs)
    begun = [i for i, start in enumerate(starts) if len(start)]
    if begun:
        # `item` is the run of each descent: a run has one descent for each start state.
        item = np.repeat(begun, [len(starts[i]) for i in begun])
        done = refine(problem, np.concatenate([starts[i] for i in begun]), item=item, limit=_STEPS)
        p = tail_probability(done.cost, dof[item])
        cov, _ = covariance(done.equations)
        for i in begun:
            out[i] = _chain_of_descents(runs[i], done, p, cov, np.flatnonzero(item == i))
    for i in range(len(runs)):
        if len(starts[i]):
            continue
        if dof[i] < 0:  # too few rows for any state: wait for more scans
            out[i] = DetectionChain(runs[i], x=np.zeros((0, problem.layout.size)), cov=None, p=1.0)
        elif work.take(LONG):
            fix = solve(problem.take(np.array([i])), "roots+lsr").flat()[0]
            out[i] = _chain_of_fix(runs[i], fix, terms)
    return out


def _chain_of_descents(run: tuple[Any, ...], done: Refined, p: Array, cov: Array, descents: Array) -> DetectionChain:
    """Return the chain of a run from its descents: their different minima, best first.

    `done` are the descents of all runs, with p-values `p` (K,) and covariances `cov` (K, n, n). `descents` are the
    indices of the descents of this run.
    """
    descents = descents[
        np.argsort(np.where(np.isfinite(done.cost[descents]), done.cost[descents], np.inf), kind="stable")
    ]
    first, d = descents[0], len(run[-1].measurement_model.mapping)
    kept: list[int] = []
    for i in descents:
        if not done.cost[i] < done.cost[first] + GAP or len(kept) == _KEPT:
            break
        apart = [done.x[i] - done.x[j] for j in kept]
        if all(not (np.linalg.solve(cov[j], a) @ a < _SAME) for j, a in zip(kept, apart, strict=True)):
            kept.append(i)
    # Without redundancy the p-value is NaN and counts as 1. A failed descent (infinite cost) gets 0.
    value = 1.0 if np.isnan(p[first]) and np.isfinite(done.cost[first]) else float(np.nan_to_num(p[first]))
    good = len(kept) == 1 and is_flat(cov[first, :d, :d], done.x[first, :d], run[-1])
    return DetectionChain(run, done.x[np.array(kept, dtype=int)], cov[first] if good else None, value)

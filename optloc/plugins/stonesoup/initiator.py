"""An initiator of Stone Soup that needs no guess: it gathers scans until they determine the state."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from stonesoup.base import Property
from stonesoup.initiator.base import GaussianInitiator
from stonesoup.types.array import CovarianceMatrix, StateVector
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.mixture import GaussianMixture
from stonesoup.types.numeric import Probability
from stonesoup.types.state import GaussianState, State, WeightedGaussianState
from stonesoup.types.track import Track
from stonesoup.types.update import GaussianStateUpdate

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Motion, Prior
from optloc.plugins.stonesoup.models import StationMeasurement, problem_of, rows_by_kind, values_of
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers import solve
from optloc.track.start import is_one_gaussian
from optloc.uncertainty.posterior import mixture

# A fix is trusted as a Gaussian where no other minimum costs less than this more: five standard deviations.
_GAP = 25.0
# ... and where its largest standard deviation is below this share of the nearest range: a circle bends away from its
# tangent by half the square of that, which is then 2.5 % of the deviation.
_FLAT = 0.05
# Chains that wait for more scans. Each detection is tried on every one of them, a fix each: false alarms must not make
# scans take longer and longer.
_REMEMBERED = 40
# What tests whether detections are of one target: without a search for other minima, and without a proof.
_QUICK = "roots+lsr"
# The gate before a fix is twice as wide in standard deviations as the test after it: rows are curved, the gate is not.
_WIDE = 4.0


@dataclass(frozen=True, slots=True)
class _Chain:
    """Detections that may be of one target, and their fix."""

    detections: tuple[Any, ...]
    fix: Fix
    p: float

    @property
    def last(self) -> dt.datetime:
        return self.detections[-1].timestamp  # type: ignore[no-any-return]


def mixture_state(
    problem: Problem, fix: Fix, mapping: Sequence[int], prior_state: GaussianState, timestamp: dt.datetime | None = None
) -> GaussianMixture:
    """Return what the data say of a position, other minima included, as a Gaussian mixture of Stone Soup.

    Parameters
    ----------
    problem, fix : Problem, Fix
        One static position and its single fix, as `optloc.mixture` takes them.
    mapping : sequence of int
        Places of the position in the state.
    prior_state : GaussianState
        Mean and covariance of the rest of the state.
    timestamp : datetime, optional
        Of the state.
    """
    found, place = mixture(problem, fix), list(mapping)
    components = []
    for weight, mean, cov in zip(found.weight, found.mean, found.covariance, strict=True):
        vector = np.array(prior_state.state_vector, dtype=float)
        covariance = np.array(prior_state.covar, dtype=float)
        covariance[place], covariance[:, place] = 0.0, 0.0
        vector[place, 0], covariance[np.ix_(place, place)] = mean, cov
        components.append(
            WeightedGaussianState(
                StateVector(vector),
                CovarianceMatrix(covariance),
                weight=Probability(float(weight)),
                timestamp=timestamp,
            )
        )
    return GaussianMixture(components)


class FixInitiator(GaussianInitiator):  # type: ignore[misc]  # untyped base
    """Begins tracks with optloc's fix of as many scans as it takes, with its covariance.

    Every detection is a scan of one target, its measurement model one of this plug-in, and its stations, which may
    move, the same throughout. Detections of several targets are told apart by the chi-square of the fix that they would
    have together. A chain of them becomes a track once position and velocity are determined, unique and nearly
    Gaussian: no other minimum within a cost gap of 25, standard deviation below 5 % of the nearest range.
    """

    velocity_mapping: Sequence[int] | None = Property(
        default=None, doc="Places of the velocity in the state; by default those after the position's."
    )
    order: int = Property(default=1, doc="1 for a state with velocity, 0 for one without.")
    speed: float | None = Property(
        default=None,
        doc="Prior standard deviation of each coordinate of the velocity about zero, m/s; a single scan may then do.",
    )
    limit: int = Property(default=10, doc="Scans after which a chain that is not clear is given up.")
    confirm: int = Property(default=1, doc="Scans of a chain at least before it becomes a track: more in clutter.")
    work: int = Property(default=100, doc="Fixes tried in one call at most, longer chains first: a bound of its time.")
    prior_state: GaussianState | None = Property(
        default=None,
        doc="Mean and covariance of what a fix does not say, such as an acceleration; initiators of particles, "
        "mixtures and ensembles that stand around this one ask for it.",
    )
    least_p: float = Property(default=1e-3, doc="Chains whose chi-square is less likely are not of one target.")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.order not in (0, 1):
            raise InvalidProblem(f"a motion of order {self.order}", "order", "use 0 or 1")
        self._chains: list[_Chain] = []
        self._left = 0

    def initiate(self, detections: Any, timestamp: dt.datetime, **kwargs: Any) -> set[Track]:
        """Return the tracks that begin with some of the detections that belong to no track yet.

        Raises
        ------
        InvalidProblem
            For a detection whose measurement model is not one of this plug-in.
        """
        tracks, grown = set(), []
        self._left = self.work
        for detection in sorted(detections, key=lambda d: (d.timestamp, tuple(values_of(d)))):
            chain = self._extended(detection)
            # Whether it is the only fix is asked of what looks like a track alone: that takes ten times longer.
            proven = self._chain(chain.detections, proven=True) if self._clear(chain) else chain
            if proven is not chain and self._clear(proven):
                tracks.add(self._track(proven))
            elif len(chain.detections) < self.limit and chain.p >= self.least_p:
                grown.append(chain)
        # What no detection has continued for long is forgotten: false alarms must not pile up.
        self._chains = [*self._chains, *grown][-_REMEMBERED:]
        return tracks

    def _extended(self, detection: Any) -> _Chain:
        """Return the most likely chain that a detection continues, which is then taken, or a new one."""
        if not isinstance(detection.measurement_model, StationMeasurement):
            what = f"a detection has the measurement model {type(detection.measurement_model).__name__}"
            raise InvalidProblem(what, "initiator", "use a model of this plug-in, such as TDOA")
        known = [c for c in self._chains if c.last < detection.timestamp and _alike(c.detections[-1], detection)]
        starts = [(chain, self._ahead(chain, detection)) for chain in known]
        # What has fitted many scans is continued before what has fitted one, which in clutter is mostly false.
        near = sorted((pair for pair in starts if pair[1] is not None), key=lambda pair: -len(pair[0].detections))
        near = near[: max(self._left, 0)]
        self._left -= len(near)
        tried = [(self._chain((*chain.detections, detection), start), chain) for chain, start in near]
        fitting = [(new, old) for new, old in tried if new.p >= self.least_p]
        if not fitting:
            return self._chain((detection,))
        # Longer before likelier: a chain that has fitted many scans is hardly one of false alarms.
        new, old = max(fitting, key=lambda pair: (len(pair[0].detections), pair[0].p))
        self._chains.remove(old)
        return new

    def _ahead(self, chain: _Chain, detection: Any) -> Array | None:
        """Return where a chain is at a detection that is in a wide gate about it, else None: a fix takes far longer.

        The vector is empty where the chain's fix is no Gaussian to look ahead from.
        """
        from scipy.special import chdtri

        if not is_one_gaussian(chain.fix):
            return np.zeros(0)
        model, (mean, cov) = detection.measurement_model, chain.fix.gaussian()
        d, place = len(model.mapping), [*model.mapping, *self._rates(model)]
        ahead = np.eye(len(mean))
        if self.order:
            ahead[:d, d:] = (detection.timestamp - chain.last).total_seconds() * np.eye(d)
        state = np.zeros((model.ndim_state, 1))
        state[place, 0] = ahead @ mean
        H = model.jacobian(State(state))[:, place]
        off = np.asarray(detection.state_vector - model.function(State(state)), dtype=float)[:, 0]
        S = H @ ahead @ cov @ ahead.T @ H.T + np.asarray(model.covar(), dtype=float)
        near = off @ np.linalg.solve(S, off) < _WIDE * chdtri(len(off), self.least_p)
        return np.asarray(ahead @ mean) if near else None

    def _chain(self, detections: tuple[Any, ...], start: Array | None = None, *, proven: bool = False) -> _Chain:
        """Return a chain with its fix: by descent where it is known to begin, and proven only where that is asked."""
        problem = self._problem(detections)
        if start is not None and len(start) and not proven:
            fix = solve(problem, "lsr", start=start)
        else:
            fix = solve(problem, "auto" if proven else _QUICK)
        if not bool(fix.answered) and not proven:
            fix = solve(problem)
        p = float(fix.p_value)  # NaN without redundancy: nothing speaks against the chain then
        return _Chain(detections, fix, 1.0 if np.isnan(p) else p)

    def _problem(self, detections: tuple[Any, ...]) -> Problem:
        models = [detection.measurement_model for detection in detections]
        last = detections[-1].timestamp  # the state is that of the last scan
        times = np.array([(detection.timestamp - last).total_seconds() for detection in detections])
        d = len(models[0].mapping)
        priors = [Prior("velocity", np.zeros(d), self.speed**2 * np.eye(d))] if self.order and self.speed else []
        rates = [model.rates for model in models]
        problem = problem_of(
            np.stack([model.sites for model in models]),
            [model.rows for model in models],
            [model.covar() for model in models],
            velocity=None if any(rate is None for rate in rates) else np.stack(rates),
            times=times,
            motions=(Motion(self.order, reference=0.0),),
            priors=priors,
        )
        z = np.concatenate([values_of(detection) for detection in detections])
        return problem.with_rows(z=z[rows_by_kind([model.rows for model in models])[1]])

    def _clear(self, chain: _Chain) -> bool:
        """Return whether a fix is the only one, and nearly Gaussian."""
        fix = chain.fix
        if len(chain.detections) < self.confirm:
            return False
        if not is_one_gaussian(fix) or chain.p < self.least_p or (fix.alternatives.gap < _GAP).any():
            return False
        stations = chain.detections[-1].measurement_model.sites
        nearest = np.linalg.norm(stations - fix.position, axis=-1).min()
        return bool(np.sqrt(np.linalg.eigvalsh(fix.covariance())[-1]) < _FLAT * nearest)

    def _track(self, chain: _Chain) -> Track:
        detection = chain.detections[-1]
        model = detection.measurement_model
        place = [*model.mapping, *self._rates(model)]
        mean, cov = chain.fix.gaussian()
        vector, covariance = np.zeros((model.ndim_state, 1)), np.zeros((model.ndim_state,) * 2)
        if self.prior_state is not None:
            vector += np.asarray(self.prior_state.state_vector, dtype=float)
            covariance += np.asarray(self.prior_state.covar, dtype=float)
            covariance[place], covariance[:, place] = 0.0, 0.0
        vector[place, 0] = mean
        covariance[np.ix_(place, place)] = cov
        update = GaussianStateUpdate(
            StateVector(vector),
            CovarianceMatrix(covariance),
            hypothesis=SingleHypothesis(None, detection),
            timestamp=detection.timestamp,
        )
        return Track([update])

    def _rates(self, model: StationMeasurement) -> Sequence[int]:
        if not self.order:
            return []
        own = getattr(model, "velocity_mapping", None) if self.velocity_mapping is None else self.velocity_mapping
        return [i + 1 for i in model.mapping] if own is None else list(own)


def _alike(one: Any, two: Any) -> bool:
    """Return whether two detections can be scans of one run."""
    a, b = one.measurement_model, two.measurement_model
    return a.stations.shape == b.stations.shape and list(a.mapping) == list(b.mapping)

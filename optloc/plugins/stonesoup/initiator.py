"""An initiator of Stone Soup without a first guess: it collects scans until they determine a state."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np
from stonesoup.base import Property
from stonesoup.initiator.base import GaussianInitiator
from stonesoup.types.array import CovarianceMatrix, StateVector
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.mixture import GaussianMixture
from stonesoup.types.numeric import Probability
from stonesoup.types.state import GaussianState, WeightedGaussianState
from stonesoup.types.track import Track
from stonesoup.types.update import GaussianStateUpdate

from optloc.plugins.stonesoup.chains import (
    GAP,
    LONG,
    ChainTerms,
    ChainWork,
    DetectionChain,
    alone,
    grown,
    is_flat,
    near,
    posed,
)
from optloc.plugins.stonesoup.models import StationMeasurement, values_of
from optloc.problem import Fix, InvalidProblem, Problem
from optloc.solvers import solve
from optloc.tracking import is_one_gaussian
from optloc.uncertainty import mixture

# Largest number of chains that wait for more scans; the chains that were not continued for the longest time are
# dropped.
_REMEMBERED = 40


def mixture_state(
    problem: Problem, fix: Fix, mapping: Sequence[int], prior_state: GaussianState, timestamp: dt.datetime | None = None
) -> GaussianMixture:
    """Return the position and its alternatives as a Gaussian mixture of Stone Soup.

    Parameters
    ----------
    problem, fix : Problem, Fix
        One static position and its single fix, as for `optloc.uncertainty.mixture`.
    mapping : sequence of int
        Indices of the position in the state.
    prior_state : GaussianState
        Mean and covariance of the rest of the state.
    timestamp : datetime, optional
        Time of the state.
    """
    found, place = mixture(problem, fix), list(mapping)
    components = []
    for weight, mean, cov in zip(found.weight, found.mean, found.covariance, strict=True):
        # The fix replaces the position of the prior state, so its correlations with the rest become zero.
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
    """Starts tracks with the fix and covariance of optloc, after the number of scans that the fix needs.

    Each detection is a scan of one target with a measurement model of this plug-in. Stations can move, but their
    number must stay the same. The initiator separates targets by chi-square: detections of two targets do not fit
    one position and velocity. A chain of detections becomes a track if position and velocity are determined,
    unique and nearly Gaussian. Unique means no other minimum within a cost gap of 25; nearly Gaussian means a
    standard deviation below 5 % of the nearest range.
    """

    velocity_mapping: Sequence[int] | None = Property(
        default=None,
        doc="State indices of the velocity; by default, each follows the index of its position coordinate.",
    )
    order: int = Property(default=1, doc="1 for a state with a velocity, 0 for a state without.")
    speed: float | None = Property(
        default=None,
        doc="Prior standard deviation of each velocity coordinate about zero, m/s. With it, one scan can be enough.",
    )
    limit: int = Property(default=10, doc="Number of scans after which an undecided chain is dropped.")
    confirm: int = Property(default=1, doc="Smallest number of scans of a new track; use more in clutter.")
    work: int = Property(
        default=300,
        doc="Limit of the work of one call, in units of about a millisecond, without the fix of each detection. Longer "
        "chains come first; chains beyond the limit are skipped.",
    )
    prior_state: GaussianState | None = Property(
        default=None,
        doc="Mean and covariance of state components that a fix does not estimate, such as an acceleration. Particle, "
        "mixture and ensemble initiators that use this initiator need it.",
    )
    least_p: float = Property(
        default=1e-3, doc="Smallest p-value of a chain; below it, the detections are not one target."
    )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Check the order, and start without chains."""
        super().__init__(*args, **kwargs)
        if self.order not in (0, 1):
            raise InvalidProblem(f"a motion of order {self.order} is not possible", "order", "use 0 or 1")
        self._chains: list[DetectionChain] = []

    def initiate(self, detections: Any, timestamp: dt.datetime, **kwargs: Any) -> set[Track]:
        """Return the new tracks from detections that do not belong to a track yet.

        Stone Soup passes `timestamp`; it is not used, because each detection has its own time.

        Raises
        ------
        InvalidProblem
            If the measurement model of a detection is not from this plug-in.
        """
        for detection in detections:
            if not isinstance(detection.measurement_model, StationMeasurement):
                what = f"a detection has the measurement model {type(detection.measurement_model).__name__}"
                raise InvalidProblem(what, "initiator", "use a model of this plug-in, such as TDOA")
        work, tracks = ChainWork(float(self.work)), set()
        # Sort the detections: the order of a set is random, and the tracks must not depend on it.
        ordered = sorted(detections, key=lambda d: (d.timestamp, tuple(values_of(d))))
        for _, scan in groupby(ordered, key=lambda d: d.timestamp):
            waiting = []
            for chain in self._extend_chains(list(scan), work):
                fix = self._confirmed_fix(chain, work)
                if fix is not None:
                    tracks.add(self._track(chain, fix))
                elif len(chain) < self.limit:
                    waiting.append(chain)
            self._chains = [*self._chains, *waiting][-_REMEMBERED:]
        return tracks

    def _extend_chains(self, scan: list[Any], work: ChainWork) -> list[DetectionChain]:
        """Return new chains from a scan: extended chains (they replace the old chains), and single detections.

        Each chain and each detection is used at most once. The replaced chains are removed from the waiting chains.
        `work` is the work that the call can still do.
        """
        terms = ChainTerms(self.order, self.speed, self.least_p)
        # If the rows of one detection do not fit together, no chain with this detection fits.
        singles = [single for single in alone(scan, terms) if single.p >= self.least_p]
        pairs = [
            (share, self._chains[i], single) for single in singles for share, i in near(self._chains, single, terms)
        ]
        # Extend long chains first: in clutter, most chains of one detection are false.
        pairs.sort(key=lambda pair: (-len(pair[1]), pair[0]))
        fitting = grown([(chain, single) for _, chain, single in pairs], terms, work)
        fitting.sort(key=lambda found: (-len(found[0]), -found[0].p))
        # Accept the longest and likeliest chains first; each old chain and each detection is used once.
        taken: set[int] = set()
        out = []
        for new, old, single in fitting:
            if taken.isdisjoint((id(old), id(single))):
                taken |= {id(old), id(single)}
                out.append(new)
        self._chains = [chain for chain in self._chains if id(chain) not in taken]
        return [*out, *(single for single in singles if id(single) not in taken)]

    def _confirmed_fix(self, chain: DetectionChain, work: ChainWork) -> Fix | None:
        """Return the fix of a chain that is long enough, if the fix is unique and nearly Gaussian; otherwise None.

        Without work left, the result is None too.
        """
        size = len(chain.detections[-1].measurement_model.mapping) * (self.order + 1)
        # Test the cheap conditions first: the search for other minima takes as long as hundreds of descents.
        if len(chain) < self.confirm or chain.cov is None or len(chain.cov) != size or not work.take(LONG):
            return None
        problem, z = posed([chain.detections], ChainTerms(self.order, self.speed, self.least_p))
        fix = solve(problem.with_rows(z=z[0]))
        known = is_one_gaussian(fix) and not (fix.alternatives.gap < GAP).any()
        # Without redundancy, the p-value is NaN and the chain passes this test.
        if not known or fix.p_value < self.least_p:
            return None
        return fix if is_flat(fix.covariance(), fix.position, chain.detections[-1]) else None

    def _track(self, chain: DetectionChain, fix: Fix) -> Track:
        """Return a new track with the fix of a chain as its first state."""
        detection = chain.detections[-1]
        model = detection.measurement_model
        # `place` are the state indices that the fix estimates; the others keep the prior state, or zero without one.
        place = [*model.mapping, *self._rates(model)]
        mean, cov = fix.gaussian()
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
        """Return the state indices of the velocity; empty for targets at rest."""
        if not self.order:
            return []
        own = getattr(model, "velocity_mapping", None) if self.velocity_mapping is None else self.velocity_mapping
        return [i + 1 for i in model.mapping] if own is None else list(own)

"""An initiator of Stone Soup that needs no guess: it gathers scans until they determine the state."""

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

# Chains that wait for more scans: of those that no detection has continued for long the oldest are forgotten.
_REMEMBERED = 40


def mixture_state(
    problem: Problem, fix: Fix, mapping: Sequence[int], prior_state: GaussianState, timestamp: dt.datetime | None = None
) -> GaussianMixture:
    """Return what the data say of a position, other minima included, as a Gaussian mixture of Stone Soup.

    Parameters
    ----------
    problem, fix : Problem, Fix
        One static position and its single fix, as `optloc.uncertainty.mixture` takes them.
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
    work: int = Property(
        default=300,
        doc="Bound of the work of one call beside the fix of each detection, in units of about a millisecond: longer "
        "chains come first, and what exceeds it is left out.",
    )
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
        self._chains: list[DetectionChain] = []

    def initiate(self, detections: Any, timestamp: dt.datetime, **kwargs: Any) -> set[Track]:
        """Return the tracks that begin with some of the detections that belong to no track yet.

        Raises
        ------
        InvalidProblem
            For a detection whose measurement model is not one of this plug-in.
        """
        for detection in detections:
            if not isinstance(detection.measurement_model, StationMeasurement):
                what = f"a detection has the measurement model {type(detection.measurement_model).__name__}"
                raise InvalidProblem(what, "initiator", "use a model of this plug-in, such as TDOA")
        work, tracks = ChainWork(float(self.work)), set()
        # In an order of their own, so that a set that is iterated in another one begins the same tracks.
        ordered = sorted(detections, key=lambda d: (d.timestamp, tuple(values_of(d))))
        for _, scan in groupby(ordered, key=lambda d: d.timestamp):
            waiting = []
            for chain in self._continued(list(scan), work):
                fix = self._proven(chain, work)
                if fix is not None:
                    tracks.add(self._track(chain, fix))
                elif len(chain) < self.limit:
                    waiting.append(chain)
            self._chains = [*self._chains, *waiting][-_REMEMBERED:]
        return tracks

    def _continued(self, scan: list[Any], work: ChainWork) -> list[DetectionChain]:
        """Return the chains that the detections of a scan continue, which are taken, and those that they begin."""
        terms = ChainTerms(self.order, self.speed, self.least_p)
        # Where the rows of a detection do not fit together no chain with it would fit.
        singles = [single for single in alone(scan, terms) if single.p >= self.least_p]
        pairs = [
            (share, self._chains[i], single) for single in singles for share, i in near(self._chains, single, terms)
        ]
        # What has fitted many scans is continued before what has fitted one, which in clutter is mostly false.
        pairs.sort(key=lambda pair: (-len(pair[1]), pair[0]))
        fitting = grown([(chain, single) for _, chain, single in pairs], terms, work)
        fitting.sort(key=lambda found: (-len(found[0]), -found[0].p))
        taken: set[int] = set()
        out = []
        for new, old, single in fitting:
            if taken.isdisjoint((id(old), id(single))):
                taken |= {id(old), id(single)}
                out.append(new)
        self._chains = [chain for chain in self._chains if id(chain) not in taken]
        return [*out, *(single for single in singles if id(single) not in taken)]

    def _proven(self, chain: DetectionChain, work: ChainWork) -> Fix | None:
        """Return the fix of a chain that is long enough where it is the only one, and nearly Gaussian; else None."""
        size = len(chain.detections[-1].measurement_model.mapping) * (self.order + 1)
        # Another place is looked for where all else speaks for a track: that takes as long as hundreds of descents.
        if len(chain) < self.confirm or chain.cov is None or len(chain.cov) != size or not work.take(LONG):
            return None
        problem, z = posed([chain.detections], ChainTerms(self.order, self.speed, self.least_p))
        fix = solve(problem.with_rows(z=z[0]))
        known = is_one_gaussian(fix) and not (fix.alternatives.gap < GAP).any()
        # Without redundancy nothing speaks against the chain.
        if not known or fix.p_value < self.least_p:
            return None
        return fix if is_flat(fix.covariance(), fix.position, chain.detections[-1]) else None

    def _track(self, chain: DetectionChain, fix: Fix) -> Track:
        detection = chain.detections[-1]
        model = detection.measurement_model
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
        if not self.order:
            return []
        own = getattr(model, "velocity_mapping", None) if self.velocity_mapping is None else self.velocity_mapping
        return [i + 1 for i in model.mapping] if own is None else list(own)

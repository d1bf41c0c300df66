"""Whole trackers of Stone Soup that begin with ours: two aircraft among false alarms, a test for each way."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stonesoup", reason="Stone Soup is not installed: pip install 'optloc[stonesoup]'")

from plugins.stonesoup.test_contracts import prior, scans
from plugins.stonesoup.test_stonesoup import PLACE, RATE, STATIONS, TRANSITION, TRUTH
from scipy.special import chdtri
from stonesoup.dataassociator.neighbour import GlobalNearestNeighbour, GNNWith2DAssignment
from stonesoup.dataassociator.probability import JPDA
from stonesoup.deleter.time import UpdateTimeStepsDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.initiator.simple import EnsembleInitiator, GaussianParticleInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
from stonesoup.predictor.ensemble import EnsemblePredictor
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import SystematicResampler
from stonesoup.tracker.pointprocess import PointProcessMultiTargetTracker
from stonesoup.tracker.simple import MultiTargetMixtureTracker, MultiTargetTracker
from stonesoup.types.mixture import GaussianMixture
from stonesoup.types.numeric import Probability
from stonesoup.types.state import TaggedWeightedGaussianState
from stonesoup.types.track import Track
from stonesoup.types.update import GaussianMixtureUpdate
from stonesoup.updater.ensemble import EnsembleUpdater
from stonesoup.updater.kalman import ExtendedKalmanUpdater
from stonesoup.updater.particle import ParticleUpdater
from stonesoup.updater.pointprocess import LCCUpdater, PHDUpdater

from optloc.plugins.stonesoup import FixInitiator

OTHER = np.array([6000.0, -50, 3000, 30, 4500, 0])[:, None]
TARGETS = [TRUTH, OTHER]
SCANS, CLUTTER = 14, 2
# False alarms in each cubic metre to the power of 5 of range differences, which are at most as long as a baseline.
DENSITY = CLUTTER / np.prod([2.0 * np.linalg.norm(STATIONS[a] - STATIONS[0]) for a in range(1, 6)])
PREDICTOR, UPDATER = ExtendedKalmanPredictor(TRANSITION), ExtendedKalmanUpdater(None)
MORE = {"deleter": UpdateTimeStepsDeleter(5)}


def ours(**more):
    return FixInitiator(speed=100.0, confirm=3, prior_state=prior(), **more)


def probable():
    return PDAHypothesiser(PREDICTOR, UPDATER, clutter_spatial_density=DENSITY, prob_detect=0.99, prob_gate=0.999)


def off(state, truth):
    """Return how far a state is from the truth, and its squared distance in the state's covariance, positions only."""
    gap = np.asarray(state.mean, dtype=float).reshape(6, 1)[PLACE] - truth[PLACE]
    cov = np.asarray(state.covar, dtype=float)[np.ix_(PLACE, PLACE)]
    return float(np.linalg.norm(gap)), float(gap[:, 0] @ np.linalg.solve(cov, gap[:, 0]))


def check(states, *, believed=True):
    """Assert that there is one state for each target, near it, and (if believed) as near as its covariance says."""
    __tracebackhide__ = True  # thousands of particles take minutes to be shown
    assert len(states) == len(TARGETS)
    for target in TARGETS:
        truth = target.copy()
        truth[PLACE] += (SCANS - 1) * target[RATE]
        distance, nees = min(off(state, truth) for state in states)
        assert distance < 100.0
        # One in ten thousand targets is farther; filters allow for accelerations that these do not make.
        assert nees < chdtri(3, 1e-4) or not believed


def ended(tracker):
    """Return the last states of all tracks there ever were."""
    every = set()
    for _, tracks in tracker:
        every |= tracks
    return [track.state for track in every]


def test_joint_probabilistic_association(seed):
    check(
        ended(
            MultiTargetMixtureTracker(
                initiator=ours(),
                detector=scans(SCANS, seed, TARGETS, CLUTTER),
                data_associator=JPDA(probable()),
                updater=UPDATER,
                **MORE,
            )
        )
    )


def test_global_nearest_neighbours(seed):
    for kind in (GlobalNearestNeighbour, GNNWith2DAssignment):
        near = DistanceHypothesiser(PREDICTOR, UPDATER, Mahalanobis(), missed_distance=6.0)
        check(
            ended(
                MultiTargetTracker(
                    initiator=ours(),
                    detector=scans(SCANS, seed, TARGETS, CLUTTER),
                    data_associator=kind(near),
                    updater=UPDATER,
                    **MORE,
                )
            )
        )


SAMPLED = {
    "particles": (
        lambda inner: GaussianParticleInitiator(inner, number_particles=1000),
        lambda: ParticlePredictor(TRANSITION),
        lambda: ParticleUpdater(None, SystematicResampler()),
    ),
    "ensemble": (
        lambda inner: EnsembleInitiator(inner, ensemble_size=300),
        lambda: EnsemblePredictor(TRANSITION),
        lambda: EnsembleUpdater(None),
    ),
}


@pytest.mark.parametrize("name", SAMPLED)
def test_trackers_of_samples(name, seed):
    np.random.seed(seed % 2**32)  # noqa: NPY002  # the host draws from it
    around, predictor, updater = SAMPLED[name]
    near = DistanceHypothesiser(predictor(), updater(), Mahalanobis(), missed_distance=8.0)
    states = ended(
        MultiTargetTracker(
            initiator=around(ours()),
            detector=scans(SCANS, seed, TARGETS, CLUTTER),
            data_associator=GNNWith2DAssignment(near),
            updater=near.updater,
            **MORE,
        )
    )
    # Particles that are drawn again and again spread less than the error: their place is good, their covariance is not.
    check(states, believed=name != "particles")


def begun(detector, initiator):
    """Return the tracks of two targets that an initiator begins with the first scans of a detector."""
    tracks = set()
    while len(tracks) < len(TARGETS):
        time, found = next(detector)
        tracks |= initiator.initiate(found, time)
        assert all(track.timestamp == time for track in tracks)
    return sorted(tracks, key=lambda track: float(track.state_vector[0]))


def tagged(state, tag, weight=1.0):
    return TaggedWeightedGaussianState(
        state.state_vector, state.covar, timestamp=state.timestamp, weight=Probability(weight), tag=tag
    )


@pytest.mark.parametrize("kind", [PHDUpdater, LCCUpdater])
def test_point_processes_of_gaussian_mixtures(kind, seed):
    """The host's birth component is one for all targets; what we know of them is its mixture at the beginning."""
    detector = scans(SCANS, seed, TARGETS, CLUTTER)
    components = [tagged(track.state, f"track {i}") for i, track in enumerate(begun(detector, ours()))]
    near = DistanceHypothesiser(PREDICTOR, UPDATER, Mahalanobis(), missed_distance=8.0)
    tracker = PointProcessMultiTargetTracker(
        detector=detector,
        updater=kind(UPDATER, clutter_spatial_density=DENSITY, prob_detection=0.99, prob_survival=0.99),
        hypothesiser=GaussianMixtureHypothesiser(near, order_by_detection=True),
        reducer=GaussianMixtureReducer(prune_threshold=1e-3, merge_threshold=9.0),
        birth_component=tagged(prior(), "birth", 1e-9),
    )
    tracker.gaussian_mixture = GaussianMixture(components)
    for _, _ in tracker:
        pass
    check(tracker.extracted_target_states)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ortools") is None, reason="multi-frame assignment needs ortools, which is not installed")
def test_several_frames_of_hypotheses(seed):
    """In a process of its own: ortools has a HiGHS of its own, and is not loaded after CasADi's."""
    code = "import sys; sys.path.insert(0, sys.argv[1]); from plugins.stonesoup import test_trackers as own; "
    tests = str(Path(__file__).parents[2])
    subprocess.run([sys.executable, "-c", f"{code} own.several_frames({seed})", tests], check=True, timeout=120)


def several_frames(seed):
    """Follow with the host's multi-hypothesis tracker: a mixture a track, tagged with the detections of each scan."""
    from stonesoup.dataassociator.mfa import MFADataAssociator
    from stonesoup.hypothesiser.mfa import MFAHypothesiser

    detector = scans(SCANS, seed, TARGETS, CLUTTER)
    tracks = {Track([GaussianMixture([tagged(track.state, [])])]) for track in begun(detector, ours())}
    associator = MFADataAssociator(MFAHypothesiser(probable()), slide_window=3)
    for time, found in detector:
        for track, hypotheses in associator.associate(tracks, found, time).items():
            components = []
            for hypothesis in hypotheses:
                if hypothesis:
                    update = UPDATER.update(hypothesis)
                    components.append(tagged(update, hypothesis.prediction.tag, hypothesis.prediction.weight))
                else:
                    components.append(hypothesis.prediction)
            track.append(GaussianMixtureUpdate(hypothesis=hypotheses, components=components))
    check([max(track.state.components, key=lambda one: one.weight) for track in tracks])

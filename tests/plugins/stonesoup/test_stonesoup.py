"""The plug-in for Stone Soup: models against finite differences, the initiator, the feeder, YAML, whole trackers."""

import datetime as dt
from functools import partial
from importlib.metadata import entry_points
from io import StringIO

import numpy as np
import pytest
from monte_carlo.tables import write
from often import few

pytest.importorskip("stonesoup", reason="Stone Soup is not installed: pip install 'optloc[stonesoup]'")

from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.deleter.time import UpdateTimeStepsDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.initiator.simple import SimpleMeasurementInitiator, SinglePointInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import ExtendedKalmanPredictor, UnscentedKalmanPredictor
from stonesoup.serialise import YAML
from stonesoup.tracker.simple import MultiTargetTracker
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, State
from stonesoup.updater.kalman import ExtendedKalmanUpdater, IteratedKalmanUpdater, UnscentedKalmanUpdater

from optloc.plugins import stonesoup as plugin
from optloc.plugins.stonesoup import (
    AOATDOA,
    FDOA,
    GROA,
    TDOA,
    TDOAFDOA,
    FixInitiator,
    PairFeeder,
    RangeRate,
    arrival_covariance,
)

PLACE, RATE = [0, 2, 4], [1, 3, 5]
STATIONS = np.array(
    [[0, 0, 100], [9000, 500, 800], [300, 9500, 1500], [9200, 9000, 300], [4500, 4000, 2600], [-3000, 4000, 900.0]]
)
PAIRS = np.array([[1, 0], [2, 0], [3, 0], [4, 0], [5, 0]])
SIGMA = 10.0
SEED = 20260107
ZERO = dt.datetime(2026, 1, 1, tzinfo=dt.UTC).replace(tzinfo=None)
TRANSITION = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.1)] * 3)


def tdoa(stations=STATIONS, pairs=PAIRS, sigma=SIGMA, **more):
    covariance = arrival_covariance(pairs, sigma, len(stations))
    shape = {"ndim_state": 6, "mapping": PLACE} | more
    return TDOA(noise_covar=covariance, stations=stations, pairs=pairs, **shape)


def groa():
    covariance = arrival_covariance(PAIRS, 1e-3, len(STATIONS))
    return GROA(ndim_state=6, mapping=PLACE, noise_covar=covariance, stations=STATIONS, pairs=PAIRS)


def aoatdoa():
    noise = np.diag([1e-6] * 4 + [100.0] * 2)
    return AOATDOA(
        ndim_state=6, mapping=PLACE, noise_covar=noise, stations=STATIONS, angles=np.array([0, 3]), pairs=PAIRS[:2]
    )


def rates(kind, **more):
    """Return a model of range rates of the stations in motion."""
    shape = {"ndim_state": 6, "mapping": PLACE, "stations": STATIONS, "velocities": moving(1) - STATIONS} | more
    if kind is RangeRate:
        return RangeRate(noise_covar=0.01 * np.eye(6), receivers=np.arange(6), **shape)
    size, shared = 0.1, arrival_covariance(PAIRS, 1.0, len(STATIONS))
    noise = np.kron(np.diag([SIGMA**2, size**2]), shared) if kind is TDOAFDOA else size**2 * shared
    return kind(noise_covar=noise, pairs=PAIRS, **shape)


MODELS = {"TDOA": tdoa, "GROA": groa, "AOATDOA": aoatdoa}
RATES = {"RangeRate": RangeRate, "FDOA": FDOA, "TDOAFDOA": TDOAFDOA}
MODELS |= {name: partial(rates, kind) for name, kind in RATES.items()}
TRUTH = np.array([4000.0, 80, 6500, -60, 1800, 5])[:, None]


def detections(rng, truth, scans, stations=lambda k: STATIONS, step=1.0):
    """Return the TDOA scans (time, detection) of a straight flight, one a step."""
    found = []
    for k in range(scans):
        state = truth.copy()
        state[PLACE] += k * step * truth[RATE]
        model = tdoa(stations(k))
        noise = np.linalg.cholesky(np.asarray(model.covar(), dtype=float)) @ rng.standard_normal((5, 1))
        value = np.asarray(model.function(State(state)), dtype=float) + noise
        time = ZERO + dt.timedelta(seconds=k * step)
        found.append((time, state, Detection(value, timestamp=time, measurement_model=model)))
    return found


def drawn(rng):
    """Return a state within the box of the stations."""
    place = rng.uniform([0, 0, 500], [9000, 9000, 6000])
    out = np.zeros((6, 1))
    out[PLACE, 0], out[RATE, 0] = place, rng.uniform(-100, 100, 3)
    return out


FILTERS = {
    "EKF": (ExtendedKalmanPredictor, ExtendedKalmanUpdater),
    "IEKF": (ExtendedKalmanPredictor, IteratedKalmanUpdater),
    "UKF": (UnscentedKalmanPredictor, UnscentedKalmanUpdater),
}


def follow(name, initiator, scans):
    """Return initial state and NEES, and the last error in own sigma and in metres, of one target."""
    predictor_of, updater_of = FILTERS[name]
    predictor, updater = predictor_of(TRANSITION), updater_of(None)
    track, first = None, np.nan
    for time, state, detection in scans:
        if track is None:
            found = initiator.initiate({detection}, time)
            if found:
                track = found.pop()
                first = nees(track.state, state)
            continue
        prediction = predictor.predict(track.state, timestamp=time)
        track.append(updater.update(SingleHypothesis(prediction, detection)))
    if track is None:
        return np.nan, np.nan, np.nan
    off = np.asarray(track.state_vector, dtype=float) - scans[-1][1]
    return first, nees(track.state, scans[-1][1]), float(np.linalg.norm(off[PLACE]))


def nees(state, truth):
    off = np.asarray(state.state_vector, dtype=float) - truth
    return float(off[:, 0] @ np.linalg.solve(np.asarray(state.covar, dtype=float), off[:, 0]))


def stock():
    """Return Stone Soup's own initiator of reversible models, with the inverse of ours."""
    return SimpleMeasurementInitiator(_wide(), skip_non_reversible=True)


def wide():
    """Return Stone Soup's own update of a wide prior at the middle of the stations."""
    return SinglePointInitiator(_wide(), tdoa())


def _wide():
    spread = np.tile([3000.0**2, 100.0**2], 3)
    mean = np.zeros((6, 1))
    mean[PLACE, 0] = [4500.0, 4500.0, 3000.0]
    return GaussianState(mean, np.diag(spread), timestamp=ZERO)


INITIATORS = {"optloc": FixInitiator, "inverse of one scan": stock, "wide prior": wide}


def compared(kind, name, count, scans=30):
    """Return initial and last NEES, and the last error in metres, (count, 3), of an initiator and a filter."""
    rng = np.random.default_rng(SEED)
    return np.array([follow(name, INITIATORS[kind](), detections(rng, drawn(rng), scans)) for _ in range(count)])


def converged(found):
    """Return which tracks end within 100 m and within 99.9 % of the chi-square of their six numbers."""
    return (found[:, 2] < 100.0) & (found[:, 1] < 22.5)


@pytest.mark.full
def test_all_initiators_and_filters():
    """200 random tracks of 30 scans: the table of the documentation."""
    count, rows = 200, []
    for kind in INITIATORS:
        for name in FILTERS:
            found = compared(kind, name, count)
            good = converged(found)
            cells = [f"{100 * good.mean():.1f} %", f"{np.nanmean(found[:, 0]) / 6:.3g}"]
            rows.append([kind, name, *cells, f"{np.nanmean(found[:, 1]) / 6:.3g}", f"{np.nanmedian(found[:, 2]):.3g}"])
            if kind == "optloc":
                assert good.all(), f"{name}: {np.flatnonzero(~good)}"
                band = 3.3 * np.sqrt(12.0 / count)
                assert np.mean(found[:, 0]) == pytest.approx(6.0, abs=band), name
    header = ["initiator", "filter", "converged", "initial NEES / 6", "last NEES / 6", "median last error, m"]
    write("stonesoup", header, rows, f"seed {SEED}, {count} tracks of 30 scans")


@pytest.mark.parametrize("name", few(FILTERS, 1))
def test_every_filter_converges_from_our_initiator(name):
    found = compared("optloc", name, 8, scans=15)
    assert converged(found).all(), found
    assert np.isfinite(found[:, 0]).all()


def moving(k):
    return STATIONS + k * np.array([[60.0, 0, 0], [0, 70, 0], [-50, 0, 0], [0, -60, 0], [40, 40, 0], [0, 80, 0]])


def crowd(seed, scans=25):
    """Return the scans of two targets and their true states, seen by receivers that move."""
    rng = np.random.default_rng(seed)
    starts = [TRUTH, np.array([7000.0, -70, 2500, 90, 3500, 0])[:, None]]
    targets = [detections(rng, truth, scans, moving) for truth in starts]
    return [(row[0][0], {row[0][2], row[1][2]}) for row in zip(*targets, strict=True)], [t[-1][1] for t in targets]


def multi(detector):
    hypothesiser = DistanceHypothesiser(
        ExtendedKalmanPredictor(TRANSITION), ExtendedKalmanUpdater(None), Mahalanobis(), missed_distance=6.0
    )
    return MultiTargetTracker(
        initiator=FixInitiator(speed=100.0),
        deleter=UpdateTimeStepsDeleter(5),
        detector=detector,
        data_associator=GNNWith2DAssignment(hypothesiser),
        updater=ExtendedKalmanUpdater(None),
    )


def ended(tracker):
    *_, (_, tracks) = tracker
    return tracks


def test_two_targets_and_moving_receivers_end_to_end():
    scans, truths = crowd(5)
    tracks = ended(multi(scans))
    assert len(tracks) == 2
    for truth in truths:
        best = min(tracks, key=lambda t: np.linalg.norm(np.asarray(t.state_vector - truth, dtype=float)[PLACE]))
        assert np.linalg.norm(np.asarray(best.state_vector - truth, dtype=float)[PLACE]) < 60.0
        assert nees(best.state, truth) < 22.5
        assert len(best) > 20


@pytest.mark.parametrize("name", [*MODELS, "FixInitiator", "PairFeeder"])
def test_yaml_round_trip(name):
    made = {
        "FixInitiator": lambda: FixInitiator(speed=30.0, velocity_mapping=RATE, limit=7),
        "PairFeeder": lambda: PairFeeder([], arrival_sigma=3.0, label="emitter"),
    } | MODELS
    one = made[name]()
    yaml = YAML()
    plugin.register_yaml(yaml)
    text = StringIO()
    yaml.dump(one, text)
    two = yaml.load(text.getvalue())
    assert type(two) is type(one)
    again = StringIO()
    yaml.dump(two, again)
    assert again.getvalue() == text.getvalue()
    if name in MODELS:
        assert np.asarray(two.function(State(TRUTH)), dtype=float).tolist() == (
            np.asarray(one.function(State(TRUTH)), dtype=float).tolist()
        )


def test_stone_soup_finds_the_plug_in():
    found = entry_points(group="stonesoup.plugins", name="optloc")
    if not found:
        pytest.skip("optloc was installed before it had the entry point")
    assert next(iter(found)).load() is plugin
    assert next(iter(entry_points(group="stonesoup.serialise.yaml", name="optloc"))).load() is plugin.register_yaml

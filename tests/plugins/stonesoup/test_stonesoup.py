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
from stonesoup.models.measurement.nonlinear import CartesianToBearingRangeRate
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import ExtendedKalmanPredictor, UnscentedKalmanPredictor
from stonesoup.serialise import YAML
from stonesoup.tracker.simple import MultiTargetTracker
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, State, StateVectors
from stonesoup.updater.kalman import ExtendedKalmanUpdater, IteratedKalmanUpdater, UnscentedKalmanUpdater

from optloc import InvalidProblem, measured
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


def expected(name, state):
    """Return the measurement of a state (6,) from the definitions, written again."""
    line = state[PLACE] - STATIONS
    r = np.sqrt((line**2).sum(1))
    rate = (line * (state[RATE] - moving(1) + STATIONS)).sum(1) / r
    if name == "RangeRate":
        return rate
    if name in RATES:
        pairs = [r[a] - r[b] for a, b in PAIRS] if name == "TDOAFDOA" else []
        return [*pairs, *(rate[a] - rate[b] for a, b in PAIRS)]
    if name == "TDOA":
        return [r[a] - r[b] for a, b in PAIRS]
    if name == "GROA":
        return [r[a] / r[b] for a, b in PAIRS]
    azimuth = [np.arctan2(line[i, 1], line[i, 0]) for i in (0, 3)]
    elevation = [np.arcsin(line[i, 2] / r[i]) for i in (0, 3)]
    return [*azimuth, *elevation, *(r[a] - r[b] for a, b in PAIRS[:2])]


@pytest.mark.parametrize("name", MODELS)
def test_functions_derivatives_and_batches(name):
    model = MODELS[name]()
    value = np.asarray(model.function(State(TRUTH)), dtype=float)[:, 0]
    np.testing.assert_allclose(value, expected(name, TRUTH[:, 0]), rtol=1e-12)
    numeric = np.zeros((model.ndim_meas, 6))
    for i in range(6):
        step = np.zeros((6, 1))
        step[i] = 0.1
        ends = [np.array(expected(name, (TRUTH + sign * step)[:, 0])) for sign in (1, -1)]
        numeric[:, i] = (ends[0] - ends[1]) / 0.2
    np.testing.assert_allclose(model.jacobian(State(TRUTH)), numeric, rtol=1e-5, atol=1e-9)
    many = StateVectors(np.hstack([TRUTH, TRUTH + 1.0]))
    both = np.asarray(model.function(State(many)), dtype=float)
    np.testing.assert_allclose(both[:, 0], value)
    np.testing.assert_allclose(both[:, 1], expected(name, TRUTH[:, 0] + 1.0))


@pytest.mark.parametrize("name", MODELS)
def test_inverse_noise_and_density(name):
    model = MODELS[name]()
    exact = Detection(model.function(State(TRUTH)), timestamp=ZERO, measurement_model=model)
    if name not in ("RangeRate", "FDOA"):  # rates alone do not show position and velocity at one instant
        back = np.asarray(model.inverse_function(exact), dtype=float)
        np.testing.assert_allclose(back[PLACE, 0], TRUTH[PLACE, 0], atol=1e-3)
        np.testing.assert_allclose(back[RATE, 0], TRUTH[RATE, 0] if name == "TDOAFDOA" else 0.0, atol=1e-3)
    drawn = np.asarray(model.rvs(20_000, random_state=np.random.RandomState(0)), dtype=float)
    size = np.sqrt(np.outer(*[np.diag(model.covar())] * 2))
    np.testing.assert_allclose(np.cov(drawn) / size, np.asarray(model.covar(), dtype=float) / size, atol=0.05)
    at_peak = model.logpdf(exact, State(TRUTH))
    assert at_peak == pytest.approx(-0.5 * np.linalg.slogdet(2 * np.pi * np.asarray(model.covar(), dtype=float))[1])


def test_range_rates_are_those_of_the_host():
    """Stone Soup's own model of bearing, range and range rate, for each station with its velocity."""
    rate, velocities = rates(RangeRate), moving(1) - STATIONS
    ours, slope = np.asarray(rate.function(State(TRUTH)), dtype=float), rate.jacobian(State(TRUTH))
    for i, (place, velocity) in enumerate(zip(STATIONS, velocities, strict=True)):
        host = CartesianToBearingRangeRate(
            ndim_state=6,
            mapping=PLACE,
            velocity_mapping=RATE,
            noise_covar=np.eye(3),
            translation_offset=place[:, None],
            velocity=velocity[:, None],
        )
        assert float(host.function(State(TRUTH))[2, 0]) == pytest.approx(ours[i, 0], rel=1e-12)
        theirs = np.asarray(host.jacobian(State(TRUTH)), dtype=float)[2]
        np.testing.assert_allclose(slope[i], theirs, rtol=1e-4, atol=1e-6)  # theirs by differences


def test_rates_begin_a_track_with_its_velocity():
    """One scan of time and frequency differences is a state; another order of the state is only that."""
    order = {"mapping": [0, 1, 2], "velocity_mapping": [3, 4, 5]}
    swap = [0, 2, 4, 1, 3, 5]
    for shape, state in (({}, TRUTH), (order, TRUTH[swap])):
        model = rates(TDOAFDOA, **shape)
        found = Detection(model.function(State(state)), timestamp=ZERO, measurement_model=model)
        track = FixInitiator().initiate({found}, ZERO).pop()
        np.testing.assert_allclose(np.asarray(track.state_vector, dtype=float), state, atol=1e-3)
        assert np.sqrt(np.diag(np.asarray(track.covar, dtype=float))[swap[1] if not shape else 3]) < 5.0
    with pytest.raises(InvalidProblem, match="name the places of the velocity"):
        rates(FDOA, ndim_state=4, mapping=[1, 2, 3])
    with pytest.raises(InvalidProblem, match="give one for each station"):
        rates(FDOA, velocities=np.zeros((2, 3)))


def test_angles_wrap():
    model = aoatdoa()
    behind = TRUTH.copy()
    behind[PLACE, 0] = STATIONS[0] + [-4000.0, 1.0, 300.0]
    other = behind.copy()
    other[2] -= 2.0
    off = model.function(State(behind)) - model.function(State(other))
    assert abs(float(off[0, 0])) < 1e-3


def test_noise_of_functions_is_drawn():
    model = tdoa()
    one, two = (model.function(State(TRUTH), noise=True) for _ in range(2))
    assert not np.allclose(np.asarray(one, dtype=float), np.asarray(two, dtype=float))


def test_detections_without_a_fix_can_be_skipped():
    few = tdoa(pairs=PAIRS[:2])
    detection = Detection(few.function(State(TRUTH)), timestamp=ZERO, measurement_model=few)
    with pytest.raises(NotImplementedError, match="fewer measurements"):
        few.inverse_function(detection)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"mapping": [0, 2]}, "coordinates are mapped"),
        ({"pairs": PAIRS[:3]}, "for 3 rows"),
        ({"rotation_offset": np.array([[0.0], [0.0], [1.0]])}, "rotation offset"),
    ],
)
def test_bad_models_are_a_sentence(more, words):
    settings = {"ndim_state": 6, "mapping": PLACE, "stations": STATIONS, "pairs": PAIRS, "noise_covar": np.eye(5)}
    with pytest.raises(InvalidProblem, match=words):
        TDOA(**settings | more)


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


def test_initial_errors_are_those_of_the_covariance():
    rng, values = np.random.default_rng(3), []
    trials = 30
    for _ in range(trials):
        initiator = FixInitiator()
        for time, state, detection in detections(rng, drawn(rng), 12):
            tracks = initiator.initiate({detection}, time)
            if tracks:
                values.append(nees(tracks.pop().state, state))
                break
    assert len(values) == trials
    assert np.mean(values) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / trials))


def test_a_prior_of_the_speed_lets_one_scan_do():
    time, state, detection = detections(np.random.default_rng(1), TRUTH, 1)[0]
    track = FixInitiator(speed=100.0).initiate({detection}, time).pop()
    assert np.linalg.norm(np.asarray(track.state_vector - state, dtype=float)[PLACE]) < 100.0
    assert np.asarray(track.covar, dtype=float)[1, 1] == pytest.approx(1e4, rel=1e-3)
    still = FixInitiator(order=0).initiate({detection}, time).pop()
    assert np.count_nonzero(np.diag(np.asarray(still.covar, dtype=float))) == 3


def test_detections_of_other_models_are_refused():
    other = Detection(np.zeros((1, 1)), timestamp=ZERO)
    with pytest.raises(InvalidProblem, match="a model of this plug-in, such as TDOA"):
        FixInitiator().initiate({other}, ZERO)


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


def test_the_feeder_makes_pairs_a_correlated_scan():
    scans, _ = crowd(6, scans=3)
    single = []
    for time, found in scans:
        pairs = set()
        for name, detection in enumerate(sorted(found, key=lambda d: float(d.state_vector[0]))):
            for i, pair in enumerate(PAIRS):
                model = tdoa(detection.measurement_model.stations, pairs=pair[None])
                z = np.array([[float(detection.state_vector[i])]])
                pairs.add(Detection(z, timestamp=time, measurement_model=model, metadata={"emitter": name}))
        single.append((time, pairs))
    fed = list(PairFeeder(single, arrival_sigma=SIGMA, label="emitter"))
    for (time, ours), (other, theirs) in zip(fed, scans, strict=True):
        assert time == other
        for one, two in zip(
            *(sorted(part, key=lambda d: float(d.state_vector[0])) for part in (ours, theirs)), strict=True
        ):
            np.testing.assert_allclose(np.asarray(one.state_vector), np.asarray(two.state_vector))
            np.testing.assert_allclose(one.measurement_model.covar(), two.measurement_model.covar())
    assert len(next(iter(PairFeeder(single, arrival_sigma=SIGMA)))[1]) == 1


def test_loops_of_the_feeder_say_nothing_new_without_noise_of_their_own():
    pairs = np.array([[1, 0], [2, 1], [2, 0], [3, 0], [4, 0]])
    found = {Detection(np.array([[1.0]]), timestamp=ZERO, measurement_model=tdoa(pairs=pair[None])) for pair in pairs}
    joined = next(iter(PairFeeder([(ZERO, found)], arrival_sigma=SIGMA)))[1].pop()
    assert joined.measurement_model.ndim_meas == 4
    assert np.linalg.eigvalsh(joined.measurement_model.covar())[0] > 1.0
    noisy = next(iter(PairFeeder([(ZERO, found)], arrival_sigma=SIGMA, row_sigma=2.0)))[1].pop()
    assert noisy.measurement_model.ndim_meas == 5
    assert np.linalg.eigvalsh(noisy.measurement_model.covar())[0] == pytest.approx(4.0)


def test_the_covariance_of_arrivals_is_that_of_problems():
    rows = measured("tdoa", np.zeros(5), a=PAIRS[:, 0], b=PAIRS[:, 1], arrival_sigma=SIGMA)
    from optloc import assemble

    block = assemble(STATIONS, rows).noise.blocks[0]
    np.testing.assert_allclose(arrival_covariance(PAIRS, SIGMA, 6), block.covariance[0])


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

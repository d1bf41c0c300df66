"""Models of the plug-in: functions against definitions, derivatives against differences, inverses, the feeder."""

import numpy as np
import pytest

pytest.importorskip("stonesoup", reason="Stone Soup is not installed: pip install 'optloc[stonesoup]'")

from plugins.stonesoup.test_stonesoup import (
    MODELS,
    PAIRS,
    PLACE,
    RATE,
    RATES,
    SIGMA,
    STATIONS,
    TRUTH,
    ZERO,
    aoatdoa,
    crowd,
    moving,
    rates,
    tdoa,
)
from stonesoup.models.measurement.nonlinear import CartesianToBearingRangeRate
from stonesoup.types.detection import Detection
from stonesoup.types.state import State, StateVectors

from optloc import InvalidProblem, assemble, measured
from optloc.plugins.stonesoup import TDOA, PairFeeder, RangeRate, arrival_covariance
from optloc.plugins.stonesoup.models import _forest, rows_by_kind


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
    block = assemble(STATIONS, rows).noise.blocks[0]
    np.testing.assert_allclose(arrival_covariance(PAIRS, SIGMA, 6), block.covariance[0])


def test_rows_of_a_kind_stand_together_and_know_their_place_in_the_scans():
    found, order = rows_by_kind([[("tdoa", 1, 0), ("azimuth", 2, -1)], [("tdoa", 3, 0)]])
    assert found == {"tdoa": [(1, 0, 0), (3, 0, 1)], "azimuth": [(2, -1, 0)]}
    assert order.tolist() == [0, 2, 1]


def test_pairs_that_close_a_loop_are_no_part_of_a_forest():
    pairs = np.array([[1, 0], [3, 2], [2, 1], [3, 0], [4, 4], [5, 3]])
    assert _forest(pairs, 6).tolist() == [True, True, True, False, False, True]

"""The initiator: tracks from one scan or several, their covariance, and detections that it does not take."""

import numpy as np
import pytest

pytest.importorskip("stonesoup", reason="Stone Soup is not installed: pip install 'optloc[stonesoup]'")

from plugins.stonesoup.test_stonesoup import PLACE, TRUTH, ZERO, detections, drawn, nees, rates
from stonesoup.types.detection import Detection
from stonesoup.types.state import State

from optloc import InvalidProblem
from optloc.plugins.stonesoup import FDOA, TDOAFDOA, FixInitiator


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
    with pytest.raises(InvalidProblem, match="give the state indices of the velocity"):
        rates(FDOA, ndim_state=4, mapping=[1, 2, 3])
    with pytest.raises(InvalidProblem, match="give one velocity for each station"):
        rates(FDOA, velocities=np.zeros((2, 3)))


def test_initial_errors_are_those_of_the_covariance():
    rng, values = np.random.default_rng(3), []
    trials = 20
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


def test_a_motion_of_higher_order_is_refused():
    with pytest.raises(InvalidProblem, match="a motion of order 2"):
        FixInitiator(order=2)

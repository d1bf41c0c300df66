"""Methods of the table: Stone Soup, with the glue that a fix from one scan needs."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
from benchmarks.scenes import Scene
from benchmarks.worker import each
from stonesoup.base import Property
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.updater.kalman import ExtendedKalmanUpdater, IteratedKalmanUpdater, UnscentedKalmanUpdater

NOW = datetime(2026, 1, 1, tzinfo=UTC).replace(tzinfo=None)
SPREAD = 1e4


class RangeDifferences(NonLinearGaussianMeasurement):
    """Range differences to the first of several stations."""

    stations: np.ndarray = Property(doc="Positions (s, 3), metres.")

    @property
    def ndim_meas(self) -> int:
        return len(self.stations) - 1

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
        x = np.asarray(state.state_vector, dtype=float)
        r = np.sqrt(((x[None] - self.stations[:, :, None]) ** 2).sum(1))
        return StateVectors(r[1:] - r[0])

    def jacobian(self, state: Any, **kwargs: Any) -> np.ndarray:
        apart = np.asarray(state.state_vector, dtype=float)[:, 0] - self.stations
        unit = apart / np.sqrt((apart**2).sum(1))[:, None]
        return unit[1:] - unit[0]


def update(updater: Any) -> Any:
    """Return the update of a wide prior about the middle of the stations by one scan."""

    def make(scene: Scene) -> Any:
        def fix(i: int) -> np.ndarray:
            places = scene.stations[i]
            model = RangeDifferences(ndim_state=3, mapping=(0, 1, 2), noise_covar=scene.covariance, stations=places)
            wide = np.diag(np.full(3, SPREAD**2))
            prior = GaussianStatePrediction(StateVector(places.mean(0)), wide, timestamp=NOW)
            scan = Detection(StateVector(scene.z[i]), timestamp=NOW, measurement_model=model)
            return np.asarray(updater().update(SingleHypothesis(prior, scan)).state_vector, dtype=float)[:, 0]

        return each(scene, fix)

    return make


METHODS = {
    "Stone Soup, extended Kalman update of a wide prior": update(lambda: ExtendedKalmanUpdater(None)),
    "Stone Soup, iterated Kalman update of a wide prior": update(lambda: IteratedKalmanUpdater(None)),
    "Stone Soup, unscented Kalman update of a wide prior": update(lambda: UnscentedKalmanUpdater(None)),
}

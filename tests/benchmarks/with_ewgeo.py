"""Methods of the table: ewgeo, the companion of two textbooks on geolocation (Python 3.12 or later)."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from benchmarks.scenes import SIGMA, Scene
from benchmarks.worker import each
from ewgeo.tdoa import TDOAPassiveSurveillanceSystem

warnings.simplefilter("ignore")


def system(scene: Scene, i: int) -> Any:
    """Return its model of one array: independent arrival errors, differences to the first station."""
    arrivals = np.eye(scene.stations.shape[1]) * SIGMA**2 / 2.0
    return TDOAPassiveSurveillanceSystem(x=scene.stations[i].T, cov=arrivals, variance_is_toa=False, ref_idx=0)


def chan_ho(scene: Scene) -> Any:
    """The closed form of Chan and Ho."""
    return each(scene, lambda i: np.ravel(system(scene, i).chan_ho(scene.z[i]))[:3])


def from_the_middle(scene: Scene) -> Any:
    """Its least squares, started in the middle of the stations."""
    return each(
        scene, lambda i: np.ravel(system(scene, i).least_square(scene.z[i], x_init=scene.stations[i].mean(0))[0])
    )


def both(scene: Scene) -> Any:
    """Its least squares, started at its closed form."""

    def fix(i: int) -> np.ndarray:
        made = system(scene, i)
        start = np.ravel(made.chan_ho(scene.z[i]))[:3]
        return np.ravel(made.least_square(scene.z[i], x_init=start)[0])

    return each(scene, fix)


METHODS = {
    "ewgeo, Chan-Ho": chan_ho,
    "ewgeo, least squares from the middle": from_the_middle,
    "ewgeo, Chan-Ho, then least squares": both,
}

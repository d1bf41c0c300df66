"""One coarse bearing, a time difference and its Doppler: what cannot be proven is never ok."""

import numpy as np
import pytest

from optloc import Stations, Status, assemble, measured, simulate, solve

FEW, FULL = 20, 300
SPEED = 200.0


def scenes(bearing, count, seed):
    """Return two receivers that move and emitters up to 57 km away: 30 m, 0.1 m/s and a coarse bearing."""
    rng = np.random.default_rng([11, seed, int(100 * bearing)])
    place = rng.uniform(-5e3, 5e3, (count, 1, 2, 2))
    velocity = rng.standard_normal((count, 1, 2, 2))
    velocity *= SPEED / np.linalg.norm(velocity, axis=-1, keepdims=True)
    stations = Stations(place, ("one", "two"), velocity=velocity)
    truth = rng.uniform(-40e3, 40e3, (count, 2))
    rows = [
        measured("azimuth", a=[0], sigma=bearing),
        measured("tdoa", a=[1], b=0, sigma=30.0),
        measured("fdoa", a=[1], b=0, sigma=0.1),
    ]
    return simulate(assemble(stations, *rows), truth, [seed, int(100 * bearing)]), truth


def judged(bearing, count, seed, method):
    """Return how many fixes are ok though least squares from the truth ends lower."""
    problem, truth = scenes(bearing, count, seed)
    fix = solve(problem, method)
    reference = solve(problem, "lsr", start=truth)
    better = reference.cost < fix.cost - 1e-6 * (1.0 + fix.cost)
    return fix, int(((fix.code == Status.OK) & better).sum())


@pytest.mark.parametrize("bearing", [0.6, 0.2, 0.06])
def test_a_coarse_bearing_is_no_proof(bearing, seed):
    fix, wrong = judged(bearing, FEW, seed, "auto")
    assert wrong == 0
    assert fix.answered.mean() > 0.5


@pytest.mark.full
@pytest.mark.parametrize("bearing", [0.6, 0.2, 0.06])
@pytest.mark.parametrize("method", ["auto", "searched", "proven", "robust"])
def test_hybrids_in_full(bearing, method, seed):
    _, wrong = judged(bearing, FULL, seed, method)
    assert wrong == 0

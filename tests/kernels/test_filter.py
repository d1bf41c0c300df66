"""A scan of a tracker against the extended Kalman filter of the textbook."""

import numpy as np
import pytest

from optloc import Motion, Status, assemble, measured
from optloc.kernels.filter import CODE, COUNT, EKF, IEKF, LOGLIKELIHOOD, NIS, SPREAD, Filtering, Move
from optloc.kernels.jit import plain
from optloc.tracking import scan_rows

STATIONS = np.array([[0.0, 0.0], [9e3, 1e3], [10e3, 9e3], [1e3, 10e3]])
MEAN, COV = np.array([3e3, 6e3, 50.0, -20.0]), np.diag([900.0, 400.0, 25.0, 16.0]) + 3.0
F = np.eye(4) + 2.0 * np.eye(4, k=2)
Q = np.diag([1.0, 1.0, 0.5, 0.5])
SIGMA = 5.0


@pytest.fixture
def filtered(monkeypatch):
    """Return what filters a scan of ranges by the kernel, run as plain Python."""
    monkeypatch.setattr(scan_rows, "is_available", lambda kernel: True)
    monkeypatch.setattr(scan_rows, "_KEPT", type(scan_rows._KEPT)(256))

    def run(z, how, weight=1.0):
        rows = measured("range", z, a=np.arange(4), sigma=SIGMA, weight=weight)
        problem = assemble(STATIONS, rows, motions=(Motion(1),))
        with plain():
            scans = scan_rows.Scans.of(problem, 1)
            return scans.filtered(0, MEAN, COV, how, Move(F, Q, np.zeros(4)))

    return run


def predicted():
    """Return the predicted state, ranges, their derivatives and the covariance of the innovation."""
    x, P = F @ MEAN, F @ COV @ F.T + Q
    away = x[:2] - STATIONS
    r = np.linalg.norm(away, axis=1)
    H = np.c_[away / r[:, None], np.zeros((4, 2))]
    return x, P, r, H, H @ P @ H.T + SIGMA**2 * np.eye(4)


def test_an_update_is_that_of_the_textbook(filtered):
    x, P, r, H, S = predicted()
    off = np.array([12.0, -7.0, 4.0, 20.0])
    found = filtered(r + off, Filtering(EKF, d=2))
    gain = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(found.mean, x + gain @ off, rtol=1e-10)
    np.testing.assert_allclose(found.cov, (np.eye(4) - gain @ H) @ P, rtol=1e-8, atol=1e-9)
    nis = off @ np.linalg.inv(S) @ off
    assert found.values[NIS] == pytest.approx(nis)
    assert found.values[LOGLIKELIHOOD] == pytest.approx(-0.5 * (nis + np.linalg.slogdet(2.0 * np.pi * S)[1]))
    assert (found.values[COUNT], found.values[CODE]) == (4.0, Status.OK)
    assert found.values[SPREAD] == pytest.approx(P[0, 0] + P[1, 1])


def test_the_iterated_filter_ends_at_the_least_cost_of_prediction_and_rows(filtered):
    x, P, r, _, _ = predicted()
    z = r + np.array([120.0, -70.0, 40.0, 200.0])
    found = filtered(z, Filtering(IEKF, limit=30, tolerance=1e-9, d=2))

    def cost(at):
        off = z - np.linalg.norm(at[:2] - STATIONS, axis=1)
        return (at - x) @ np.linalg.solve(P, at - x) + off @ off / SIGMA**2

    least = cost(found.mean)
    for step in 0.05 * np.linalg.cholesky(found.cov).T:
        assert min(cost(found.mean + step), cost(found.mean - step)) > least


def test_a_row_outside_the_gate_and_an_absent_row_do_not_count(filtered):
    x, P, r, H, _ = predicted()
    off = np.array([1.0, 2.0, 5e3, -3.0])
    kept = [0, 1]
    found = filtered(r + off, Filtering(EKF, gate=5.0, d=2), weight=np.array([1.0, 1.0, 1.0, 0.0]))
    gain = P @ H[kept].T @ np.linalg.inv(H[kept] @ P @ H[kept].T + SIGMA**2 * np.eye(2))
    assert found.values[COUNT] == 2.0
    np.testing.assert_allclose(found.mean, x + gain @ off[kept], rtol=1e-10)


def test_without_rows_the_prediction_stays(filtered):
    x, P, r, _, _ = predicted()
    found = filtered(r, Filtering(EKF, d=2), weight=0.0)
    np.testing.assert_allclose(found.mean, x)
    np.testing.assert_allclose(found.cov, P)
    assert found.values[CODE] == Status.TOO_FEW_ROWS
    assert np.isnan(found.values[NIS])

"""Errors that last from scan to scan: the covariance of a track with them, clean tracks, and tracks out of sight."""

import numpy as np
import pytest
from often import few

from optloc import Motion, assemble, measured
from optloc.kernels.filter import COLUMNS, filter_scan
from optloc.kernels.jit import is_available
from optloc.problem.epochs import cut
from optloc.tracking import Rules, State, lasting, polynomial, tracked
from optloc.tracking.run import Follower
from optloc.tracking.scan_rows import Scans
from optloc.tracking.track import move_of, predicted, scan_at
from optloc.tracking.updates import ekf, reweighted

STATIONS = np.array([[0.0, 0], [100, 0], [0, 100], [100, 100], [50, 140], [-30, 50]])
SCANS, DRIVE = 60, 1.0
SIGMA = {"range": 1.0, "tdoa": 1.0, "azimuth": 0.02}


def course(rng):
    """A target of constant velocity that is driven by an acceleration of 1 m/s^2, constant between scans: (k, 2)."""
    place, speed, out = rng.uniform(20.0, 80.0, 2), rng.normal(0.0, 2.0, 2), []
    for _ in range(SCANS):
        out.append(place)
        push = DRIVE * rng.standard_normal(2)
        place, speed = place + speed + 0.5 * push, speed + push
    return np.array(out)


def run(kind, seed, *, lasts=0.0, scans=10.0, common=False):
    """Return a run and its truth; each station has a Gauss-Markov error of `lasts` sigma over a number of scans.

    A `common` error is the error of the first station for all stations: the heading of a robot that takes bearings.
    """
    rng = np.random.default_rng(seed)
    truth, s = course(rng), len(STATIONS)
    line = truth[:, None] - STATIONS
    exact = np.arctan2(line[..., 1], line[..., 0]) if kind == "azimuth" else np.linalg.norm(line, axis=-1)
    error, keep = rng.standard_normal((SCANS, s)), np.exp(-1.0 / scans)
    for k in range(1, SCANS):
        error[k] = keep * error[k - 1] + np.sqrt(1.0 - keep**2) * error[k]
    error = error[:, :1] if common else error
    z = exact + SIGMA[kind] * (rng.standard_normal((SCANS, s)) + lasts * error)
    a, more = np.arange(s), {"sigma": SIGMA[kind]}
    if kind == "tdoa":
        z, a, more = z[:, 1:] - z[:, :1], np.arange(1, s), {"b": 0, "arrival_sigma": SIGMA[kind]}
    rows = measured(kind, z.ravel(), a=np.tile(a, SCANS), epoch=np.repeat(np.arange(SCANS), len(a)), **more)
    return assemble(STATIONS, rows, times=np.arange(float(SCANS)), motions=(Motion(span="epoch"),)), truth


def squares(entries, truth):
    """Return the squared errors of the scans that are ok, in units of the covariance, and how many had a state."""
    kept = [(e, x) for e, x in zip(entries, truth, strict=True) if np.isfinite(e.updated.mean).all()]
    off = [(e.updated.mean[:2] - x, e.updated.cov[:2, :2]) for e, x in kept if e.label in ("ok", "started")]
    return np.array([d @ np.linalg.solve(cov, d) for d, cov in off]), len(kept)


def squares_of(kind, seeds, update="iekf", rules=None, **errors):
    found = []
    for seed in range(seeds):
        problem, truth = run(kind, seed, **errors)
        found.append(squares(list(tracked(problem, polynomial(1, DRIVE), update, rules=rules)), truth))
    return np.concatenate([square for square, _ in found]), sum(count for _, count in found)


def without(monkeypatch):
    """Take lasting errors for noise, as a filter does."""
    monkeypatch.setattr(lasting.LastingErrors, "begin", lambda self, stretch, state: state.cov)
    monkeypatch.setattr(lasting.LastingErrors, "take", lambda self, taken, dynamics, cov, screen: cov)


@pytest.mark.parametrize("kind", ["range", "tdoa", "azimuth"])
def test_the_covariance_covers_errors_that_last(kind, monkeypatch):
    square, count = squares_of(kind, 6, lasts=1.5)
    assert len(square) > 0.95 * count, "an honest covariance, and no other status"
    with monkeypatch.context() as context:
        without(context)
        before, _ = squares_of(kind, 6, lasts=1.5)
    assert np.mean(before > 25.0) > 0.04
    assert np.mean(square > 25.0) < 0.02
    assert np.mean(before) / 2.0 > 3.0
    assert 0.6 < np.mean(square) / 2.0 < 1.7


def test_the_covariance_covers_an_error_that_all_stations_share(monkeypatch):
    square, count = squares_of("azimuth", 6, lasts=1.5, common=True)
    assert len(square) > 0.95 * count
    with monkeypatch.context() as context:
        without(context)
        before, _ = squares_of("azimuth", 6, lasts=1.5, common=True)
    assert np.mean(before > 25.0) > 0.2
    assert np.mean(square > 25.0) < 0.04


@pytest.mark.parametrize("runs", few([8, 40], 1))
@pytest.mark.parametrize("kind", ["range", "azimuth"])
def test_a_clean_track_stays_as_it_was(kind, runs, monkeypatch):
    square, count = squares_of(kind, runs)
    assert len(square) == count, "every scan is ok"
    with monkeypatch.context() as context:
        without(context)
        before, _ = squares_of(kind, runs)
    np.testing.assert_allclose(square.mean(), before.mean(), rtol=0.03)


def test_the_estimate_of_a_filter_does_not_change(monkeypatch):
    problem, _ = run("range", 1, lasts=2.0)
    ours = list(tracked(problem, polynomial(1, DRIVE)))
    without(monkeypatch)
    plainly = list(tracked(problem, polynomial(1, DRIVE)))
    for one, other in zip(ours, plainly, strict=True):
        np.testing.assert_array_equal(one.updated.mean, other.updated.mean)
        if np.isnan(one.updated.mean).any():
            continue
        assert (np.linalg.eigvalsh(one.updated.cov - other.updated.cov) > -1e-9).all(), "never less than the filter's"


def test_the_recursion_is_the_covariance_of_simulated_errors():
    """A scalar filter: the variance with a lasting error, against the mean over 20 000 runs of the same gains."""
    rng, n, scans, size, last = np.random.default_rng(5), 20_000, 30, 1.3, 1
    keep = np.exp(-1.0 / lasting._LASTS[last])
    found, cov = lasting._Recursion(1), np.array([[4.0]])
    found.reset(np.zeros((1, 1)))
    error, b = 2.0 * rng.standard_normal(n), size * rng.standard_normal(n)
    F, Q, H = np.eye(1), 0.3, np.array([[1.0]])
    for k in range(scans):
        cov = cov + Q
        found.step(F)
        rows = lasting._LastingRows(H, np.zeros(1), np.full(1, k), np.eye(1), np.ones((len(found.phi), 1, 1)))
        found.take(rows, F, cov)
        error = error + np.sqrt(Q) * rng.standard_normal(n)
        gain = cov[0, 0] / (cov[0, 0] + 1.0)
        b = keep * b + np.sqrt(1.0 - keep**2) * size * rng.standard_normal(n)
        error = error - gain * (error + b + rng.standard_normal(n))
        cov = (1.0 - gain) * cov
    wanted = cov[0, 0] + size**2 * found.lasting[last, 0, 0]
    assert wanted > 1.5 * cov[0, 0]
    assert np.var(error) == pytest.approx(wanted, rel=0.06)
    assert np.mean(error * b) / size**2 == pytest.approx(found.cross[last, 0, 0], abs=0.05)


def test_the_screen_in_machine_code_is_a_score():
    """Products of scores in succession, against their definition with a dense covariance."""
    problem, _ = run("tdoa", 3, lasts=1.0)
    start = State(-1.0, np.r_[50.0, 50.0, 0.0, 0.0], np.diag([900.0, 900.0, 25.0, 25.0]))
    dynamics = polynomial(1, DRIVE)
    state, before, total, variance = start, None, 0.0, 0.0
    if not is_available(filter_scan):
        pytest.skip("there is no machine code")
    scans = Scans.of(problem, 1)
    memory = np.zeros(scans.memory)
    for k in range(6):
        ahead = predicted(state, dynamics, float(k), 2)
        found = scans.filtered(
            k, state.mean, state.cov, ekf.how._replace(d=2), move_of(state, dynamics, float(k), 2), memory=memory
        )
        rows = lasting._LastingRows.of(scan_at(problem, k, 1), ahead.mean, 1e6 * np.eye(4))
        S = rows.H @ ahead.cov @ rows.H.T + rows.R
        score = rows.D[0].T @ np.linalg.solve(S, rows.residual)
        total, variance = 0.98 * total, 0.98 * variance
        if before is not None:
            seen = rows.D[0] @ before
            total, variance = total + score @ before, variance + seen @ np.linalg.solve(S, seen)
        before, state = score, State(float(k), found.mean, found.cov)
        written = lasting._LastingRows.written(scans.rows[k], scans.item[k], memory, 4, len(STATIONS))
        for name in ("H", "residual", "R", "D"):
            np.testing.assert_allclose(getattr(written, name), getattr(rows, name), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(memory[:2], [total, variance], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(memory[COLUMNS : COLUMNS + len(score)], score, rtol=1e-6, atol=1e-9)


def test_a_stream_has_the_covariances_of_its_run():
    problem, _ = run("range", 2, lasts=2.0)
    whole = list(tracked(problem, polynomial(1, DRIVE)))
    follower, parts = Follower(polynomial(1, DRIVE)), []
    for k in range(problem.epochs):
        parts += follower.take(cut(problem, k, k + 1))
    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_allclose(one.updated.cov, other.updated.cov, rtol=1e-6)


def test_robust_losses_have_the_same_covariances():
    update, rules = reweighted("iekf", "huber"), Rules(starts="robust")
    square, count = squares_of("range", 2, update, rules, lasts=1.5)
    assert len(square) > 0.9 * count
    assert np.mean(square > 25.0) < 0.02
    assert np.mean(square) / 2.0 < 2.0


def test_a_track_by_differences_of_levels_ends_where_they_are_all_alike():
    """Levels of a phone in a flat are off by walls: such a track ran 650 m away, and every scan was ok."""
    flat, rng = (
        np.array([[5.5, 2.4], [0.8, 6.8], [3.0, 0.1], [3.8, 7.1], [6.0, 0.4], [8.7, 6.6]]),
        np.random.default_rng(4),
    )
    scans, ended = 12, 0
    for _ in range(1):
        place = np.cumsum(np.r_[[[4.0, 3.0]], 0.1 * rng.standard_normal((scans - 1, 2))], axis=0)
        level = -20.0 * np.log10(np.linalg.norm(place[:, None] - flat, axis=-1)) + 5.0 * rng.standard_normal((scans, 6))
        z = level[:, 1:] - level[:, :1]
        rows = measured(
            "rss_difference",
            z.ravel(),
            a=np.tile(np.arange(1, 6), scans),
            b=0,
            epoch=np.repeat(np.arange(scans), 5),
            sigma=7.0,
        )
        problem = assemble(flat, rows, times=2.0 * np.arange(scans), motions=(Motion(span="epoch"),))
        entries = list(tracked(problem, polynomial(1, 1.0)))
        ended += sum("uncertain by" in e.reason for e in entries)
        for e in entries:
            if e.label in ("ok", "started", "restarted"):
                assert np.linalg.norm(e.updated.mean[:2] - [4.5, 3.5]) < 25.0
    assert ended

"""The update of one state by machine code: what numpy makes of it, for all kinds of rows and any prediction."""

from dataclasses import replace

import numpy as np
import pytest
from cases import ENU

from optloc import Motion, Stations, assemble, measured
from optloc.compute.jit import enabled
from optloc.track import State, followed, polynomial, updates
from optloc.track.track import scan_at

pytestmark = pytest.mark.skipif(not enabled(), reason="there is no machine code")
STATIONS = 1e3 * np.array([[0, 0, 0], [8, 0, 0.2], [0, 8, -0.15], [-7, 1, 0.4], [1, -8, 0.1], [5, 5, 0.9]])
TRUTH, SPEED = np.array([2.1e3, -1.4e3, 3.2e3]), np.array([60.0, 30.0, -5.0])
EPOCHS = 3


def run(*kinds, d=3, moving=False, sigma=0.02, **more):
    """A run of three scans that some kinds of rows measure; with seeded noise."""
    a, rng = np.arange(1, 6), np.random.default_rng(len(kinds))
    place, rate = STATIONS[:, :d], 20.0 * np.ones((6, d))
    position = np.stack([place + (rate * k if moving else 0.0) for k in range(EPOCHS)])
    rows = []
    for kind in kinds:
        two = {"b": np.zeros(5 * EPOCHS, dtype=int)} if kind in ("tdoa", "fdoa", "groa") else {}
        z = np.zeros(5 * EPOCHS)
        rows.append(measured(kind, z, a=np.tile(a, EPOCHS), epoch=np.repeat(np.arange(EPOCHS), 5), sigma=sigma, **two))
    velocity = np.broadcast_to(rate, position.shape) if moving else None
    stations = Stations(position if moving else position[:1], tuple("ABCDEF"), velocity=velocity)
    problem = assemble(stations, *rows, times=np.arange(EPOCHS) * 2.0, motions=(Motion(1),), **more)
    from optloc.linear.evaluate import predict

    exact = predict(problem, np.concatenate([TRUTH[:d], SPEED[:d]]))
    return problem.with_rows(z=exact + sigma * rng.standard_normal(exact.shape))


def absent(problem):
    """A row without weight, which holds nothing, one with half its weight, and known corrections."""
    rows = problem.rows[0]
    weight, z = np.ones(rows.count), rows.z.copy()
    weight[[1, 7]], weight[2], z[1] = 0.0, 0.5, np.nan
    return replace(problem, rows=(replace(rows, z=z + 3.0, weight=weight, correction=np.full(rows.count, 3.0)),))


CASES = {
    "tdoa": lambda: run("tdoa", sigma=5.0),
    "2d": lambda: run("tdoa", "azimuth", d=2),
    "angles": lambda: run("azimuth", "elevation"),
    "mixed": lambda: run("range", "groa"),
    "moving": lambda: run("tdoa", "fdoa", moving=True),
    "absent": lambda: absent(run("tdoa", sigma=5.0)),
    "on Earth": lambda: run("tdoa", sigma=5.0, frame=ENU),
}


def predictions(n, d):
    """Covariances: of a good prediction, of a vague one, and of one that is exact in some direction."""
    unit = np.repeat([100.0, 5.0, 0.5], d)[:n]
    turned = np.eye(n) + 0.4 * np.sin(np.arange(n * n).reshape(n, n))
    good = unit[:, None] * (turned @ turned.T) * unit
    exact = good.copy()
    exact[0], exact[:, 0] = 0.0, 0.0
    return {"good": good, "vague": 25.0 * good, "exact": exact}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("rule", ["ekf", "iekf"])
def test_machine_code_updates_as_numpy_does(rule, name, monkeypatch):
    problem, update = CASES[name](), updates.UPDATES[rule]
    d = problem.dimension
    for order in (0, 1, 2) if name == "tdoa" else (2,):
        n = (order + 1) * d
        mean = np.concatenate([TRUTH[:d] + 60.0, SPEED[:d] + 2.0, np.zeros(d)])[:n]
        for kind, cov in predictions(n, d).items():
            for k in range(EPOCHS):
                scan = scan_at(problem, k, order)
                if rule == "iekf" and kind == "exact":
                    continue  # numpy whitens the prediction, and an exact one has no whitening
                monkeypatch.setattr(updates, "at_hand", lambda kernel: False)
                told = update(scan, mean, cov)
                monkeypatch.setattr(updates, "at_hand", lambda kernel: True)
                quick = updates._by_machine_code(scan, mean, cov, 1 if rule == "ekf" else 20, 1e-6)
                assert quick is not None
                found = update(scan, mean, cov)
                sigma = np.sqrt(np.diag(told.cov)) + 1e-9
                assert (np.abs(found.mean - told.mean) < 1e-4 * sigma).all()
                assert (np.abs(found.cov - told.cov) < 1e-4 * sigma[:, None] * sigma).all()
                # of a vague prediction numpy's has six digits, which longer numbers tell
                assert np.isclose(found.nis, told.nis, rtol=1e-5, atol=1e-6)
                assert np.isclose(found.loglikelihood, told.loglikelihood, rtol=1e-5, atol=1e-6)
                assert found.count == told.count
                assert np.array_equal(found.cov, found.cov.T)


def test_what_is_not_one_state_of_one_scan_takes_numpy(monkeypatch):
    monkeypatch.setattr(updates, "at_hand", lambda kernel: True)
    scan = scan_at(CASES["tdoa"](), 0, 1)
    mean, cov = np.r_[TRUTH, SPEED], predictions(6, 3)["good"]
    take = updates._by_machine_code
    assert take(scan, mean, cov, 1, 0.0) is not None
    assert take(scan, np.stack([mean, mean]), np.stack([cov, cov]), 1, 0.0) is None
    assert take(scan.with_rows(z=np.stack([scan.z, scan.z])), mean, cov, 1, 0.0) is None
    assert take(scan, mean, -cov, 1, 0.0) is None
    fitting = updates.UPDATES["ekf"](scan, np.stack([mean, mean]), np.stack([cov, cov]))
    assert np.allclose(fitting.mean[1], take(scan, mean, cov, 1, 0.0).mean, rtol=1e-9)


def test_a_track_is_the_same_either_way(monkeypatch):
    problem, tracks = CASES["moving"](), []
    start = State(-1.0, np.r_[TRUTH - SPEED + 30.0, SPEED], predictions(6, 3)["good"])
    for hand in (False, True):
        monkeypatch.setattr(updates, "at_hand", lambda kernel, hand=hand: hand)
        tracks.append(followed(problem, start, polynomial(1, 0.5)))
    for name in ("mean", "cov", "nis", "count", "loglikelihood", "code"):
        assert np.allclose(getattr(tracks[0], name), getattr(tracks[1], name), rtol=1e-6, atol=1e-6)

"""Scans by machine code: what NumPy makes of them, for all filters, kinds of rows, gates and predictions."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from cases import ENU

from optloc import Motion, Stations, Status, assemble, measured
from optloc.kernels.filter import CODE, GENERAL, NIS
from optloc.kernels.jit import enabled
from optloc.tracking import (
    UPDATES,
    Rules,
    State,
    collected,
    current_statistical,
    followed,
    gated,
    polynomial,
    scan_rows,
    tracked,
)
from optloc.tracking.scan_rows import Scans
from optloc.tracking.track import scan_at

pytestmark = pytest.mark.skipif(not enabled(), reason="there is no machine code")
STATIONS = 1e3 * np.array([[0, 0, 0], [8, 0, 0.2], [0, 8, -0.15], [-7, 1, 0.4], [1, -8, 0.1], [5, 5, 0.9]])
TRUTH, SPEED = np.array([2.1e3, -1.4e3, 3.2e3]), np.array([60.0, 30.0, -5.0])
EPOCHS = 3
# Standard deviations, SI units; of other kinds 0.02.
SIGMA = {"tdoa": 5.0, "range": 5.0, "fdoa": 0.5}


@pytest.fixture
def at_hand(monkeypatch):
    """Take machine code, which is made where it is not kept."""
    monkeypatch.setattr(scan_rows, "is_available", lambda kernel: True)


def run(*kinds, d=3, moving=False, **more):
    """A run of three scans that some kinds of rows measure; with seeded noise."""
    a, rng = np.arange(1, 6), np.random.default_rng(len(kinds))
    place, rate = STATIONS[:, :d], 20.0 * np.ones((6, d))
    position = np.stack([place + (rate * k if moving else 0.0) for k in range(EPOCHS)])
    rows, sigma = [], np.repeat([SIGMA.get(kind, 0.02) for kind in kinds], 5 * EPOCHS)
    for kind in kinds:
        two = {"b": np.zeros(5 * EPOCHS, dtype=int)} if kind in ("tdoa", "fdoa", "groa") else {}
        z = np.zeros(5 * EPOCHS)
        rows.append(
            measured(
                kind, z, a=np.tile(a, EPOCHS), epoch=np.repeat(np.arange(EPOCHS), 5), sigma=SIGMA.get(kind, 0.02), **two
            )
        )
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


def looped(sigma=5.0):
    """Differences of all pairs of five stations: their noise is singular, as loops of them have none."""
    a, b = np.triu_indices(5, 1)
    rows = measured("tdoa", np.zeros(10), a=b, b=a, arrival_sigma=sigma)
    problem = assemble(STATIONS, rows, motions=(Motion(1),))
    r = np.linalg.norm(TRUTH - STATIONS, axis=-1) + sigma * np.random.default_rng(3).standard_normal(6)
    return problem.with_rows(z=r[b] - r[a])


def correlated(kind="tdoa"):
    """Range differences whose noise is common to their first station."""
    a, epoch, rng = np.tile(np.arange(1, 6), EPOCHS), np.repeat(np.arange(EPOCHS), 5), np.random.default_rng(8)
    rows = measured(kind, np.zeros(5 * EPOCHS), a=a, b=0, epoch=epoch, arrival_sigma=5.0)
    problem = assemble(STATIONS, rows, times=np.arange(EPOCHS) * 2.0, motions=(Motion(1),))
    r = np.linalg.norm(TRUTH + 2.0 * np.arange(EPOCHS)[:, None, None] * SPEED - STATIONS, axis=-1)
    r += 5.0 * rng.standard_normal(r.shape)
    return problem.with_rows(z=(r[:, 1:] - r[:, :1]).ravel())


CASES = {
    "tdoa": lambda: run("tdoa"),
    "2d": lambda: run("tdoa", "azimuth", d=2),
    "angles": lambda: run("azimuth", "elevation"),
    "mixed": lambda: run("range", "groa"),
    "moving": lambda: run("tdoa", "fdoa", moving=True),
    "absent": lambda: absent(run("tdoa")),
    "on Earth": lambda: run("tdoa", frame=ENU),
    "correlated": correlated,
    "loops": looped,
}


def predictions(n, d):
    """Covariances: of a good prediction, of a vague one, and of one that is exact in some direction."""
    unit = np.repeat([100.0, 5.0, 0.5], d)[:n]
    turned = np.eye(n) + 0.4 * np.sin(np.arange(n * n).reshape(n, n))
    good = unit[:, None] * (turned @ turned.T) * unit
    exact = good.copy()
    exact[0], exact[:, 0] = 0.0, 0.0
    return {"good": good, "vague": 25.0 * good, "exact": exact}


def same(found, told, within):
    """Two updates agree: means and covariances in standard deviations, numbers relative to their size."""
    sigma = np.sqrt(np.diag(told.cov)) + 1e-9
    assert (np.abs(found.mean - told.mean) < within * sigma).all()
    assert (np.abs(found.cov - told.cov) < within * sigma[:, None] * sigma).all()
    assert np.isclose(found.nis, told.nis, rtol=within, atol=within)
    assert np.isclose(found.loglikelihood, told.loglikelihood, rtol=within, atol=within)
    assert found.count == told.count
    assert np.array_equal(found.cov, found.cov.T)


def by_machine_code(rule, scan, mean, cov):
    """The update, or None where machine code leaves it to the general form."""
    found = Scans.of(scan, scan.motions[0].order).filtered(0, mean, cov, rule.how._replace(d=scan.dimension))
    return None if found is None or found.values[CODE] == GENERAL else found


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("rule", ["ekf", "iekf", "mgekf", "mvekf"])
def test_machine_code_updates_as_numpy_does(rule, name, at_hand):
    """Random rows, predictions, gates, weights and missing rows."""
    problem, rng = CASES[name](), np.random.default_rng(len(name))
    d, orders = problem.dimension, (0, 1, 2) if name == "tdoa" else (1,)
    rates = name == "moving"
    for order, gate, k in product(orders, (np.inf, 2.0), range(problem.epochs)):
        n = (order + 1) * d
        if rates and not order:
            continue
        scan = scan_at(problem, k, order)
        weight = (
            scan.weight * rng.choice([0.0, 0.5, 1.0], scan.count, p=[0.2, 0.2, 0.6])
            if k and name != "loops"
            else scan.weight
        )
        scan = scan.with_rows(weight=weight)
        x = np.concatenate([TRUTH[:d] + 2.0 * k * SPEED[:d], SPEED[:d], np.zeros(d)])[:n]
        for kind, cov in predictions(n, d).items():
            if rule == "iekf" and kind == "exact":
                continue  # NumPy whitens the prediction, and an exact one has no whitening
            mean = x + np.repeat([60.0, 2.0, 0.1], d)[:n] * rng.standard_normal(n) * (0.0 if kind == "exact" else 1.0)
            filtering = gated(rule, gate)
            told, found = filtering._general(scan, mean, cov), filtering(scan, mean, cov)
            if told.count == 0:
                assert found.count == 0
                continue
            assert by_machine_code(filtering, scan, mean, cov) is not None or (name == "loops" and told.count < 4)
            # of a vague prediction NumPy's gain has six digits
            same(found, told, 1e-9 if kind == "good" else 1e-5)


def test_what_is_not_one_run_of_states_takes_numpy(at_hand):
    scan = scan_at(CASES["tdoa"](), 0, 1)
    mean, cov = np.r_[TRUTH, SPEED], predictions(6, 3)["good"]
    ekf = UPDATES["ekf"]
    assert by_machine_code(ekf, scan, mean, cov) is not None
    assert by_machine_code(ekf, scan, mean, -cov) is None
    shaken = replace(
        scan, stations=replace(scan.stations, covariance=np.tile(np.diag([1.0, 4, 9]), (6, 1, 1)), span="noise")
    )
    assert by_machine_code(ekf, shaken, mean, cov) is None
    alike = replace(scan, stations=replace(scan.stations, covariance=np.tile(9.0 * np.eye(3), (6, 1, 1)), span="noise"))
    same(ekf(alike, mean, cov), ekf._general(alike, mean, cov), 1e-9)


def test_a_scan_without_rows_is_the_prediction_whatever_memory_holds(at_hand, monkeypatch):
    scan = scan_at(CASES["tdoa"](), 0, 1)
    mean, cov = np.r_[TRUTH, SPEED], predictions(6, 3)["good"]
    for silent in (scan.with_rows(weight=np.zeros(5)), scan.with_rows(z=scan.z + 1e6)):
        given = Scans.of(silent, 1)
        with monkeypatch.context() as memory:
            memory.setattr(np, "empty", lambda shape: np.full(shape, np.nan))
            found = given.filtered(0, mean, cov, gated("iekf", 5.0).how._replace(d=3))
        assert found.values[CODE] == Status.TOO_FEW_ROWS
        assert np.isnan(found.values[NIS])
        assert np.array_equal(found.mean, mean)
        assert np.allclose(found.cov, cov, rtol=1e-15)


def test_a_batch_is_its_states(at_hand):
    scan, rng = scan_at(CASES["correlated"](), 0, 1), np.random.default_rng(2)
    mean = np.r_[TRUTH, SPEED] + rng.normal(0.0, [50.0] * 3 + [3.0] * 3, (2, 3, 6))
    cov, z = predictions(6, 3)["good"], scan.z + rng.normal(0.0, 30.0, (2, 1, 5))
    for rule in ("ekf", "iekf", "mgekf", "mvekf"):
        filtering = gated(rule, 2.0)
        many = filtering(scan.with_rows(z=z), mean, cov)
        assert many.mean.shape == (2, 3, 6)
        for i, j in np.ndindex(2, 3):
            one = filtering(scan.with_rows(z=z[i, 0]), mean[i, j], cov)
            for name in ("mean", "cov", "nis", "loglikelihood", "count"):
                assert np.array_equal(getattr(many, name)[i, j], getattr(one, name))


def test_runs_targets_and_noise_of_their_own_meet_in_one_batch(at_hand):
    """Two runs, three targets: measurements have one axis, states and their process noise the other."""
    problem, rng = CASES["correlated"](), np.random.default_rng(4)
    z = problem.z + rng.normal(0.0, 5.0, (2, 1, problem.count))
    mean = np.r_[TRUTH - SPEED, SPEED, np.zeros(3)] + rng.normal(0.0, [50.0] * 3 + [3.0] * 3 + [0.5] * 3, (3, 9))
    start, dynamics = State(-1.0, mean, predictions(9, 3)["good"]), current_statistical(5.0, 20.0)
    many = followed(problem.with_rows(z=z), start, dynamics, "ekf")
    assert many.mean.shape == (2, 3, EPOCHS, 9)
    for i, j in np.ndindex(2, 3):
        one = followed(problem.with_rows(z=z[i, 0]), replace(start, mean=mean[j]), dynamics, "ekf")
        np.testing.assert_allclose(many.mean[i, j], one.mean, rtol=1e-12)
        np.testing.assert_allclose(many.cov[i, j], one.cov, rtol=1e-12)
    shared = replace(start, mean=mean[0], cov=np.tile(start.cov, (2, 1, 1)))
    assert np.array_equal(*followed(problem, shared, dynamics, "ekf").mean)


@pytest.mark.parametrize("name", ["moving", "absent", "correlated"])
@pytest.mark.parametrize("rule", ["ekf", "iekf", "mgekf", "mvekf"])
def test_a_track_is_the_same_either_way(name, rule, monkeypatch):
    problem = CASES[name]()
    wild = problem.z.copy()
    wild[6] += 1e4 if name == "correlated" else 0.0
    problem, entries, tracks = problem.with_rows(z=wild), [], []
    start = State(-1.0, np.r_[TRUTH - SPEED + 30.0, SPEED], predictions(6, 3)["good"])
    for hand in (False, True):
        monkeypatch.setattr(scan_rows, "is_available", lambda kernel, hand=hand: hand)
        tracks.append(followed(problem, start, polynomial(1, 0.5), gated(rule)))
        entries.append(list(tracked(problem, polynomial(1, 0.5), rule, start=start, rules=Rules(gate=4.0))))
    for one, two in (tracks, [collected(own, 3) for own in entries]):
        for value in ("mean", "cov", "nis", "count", "loglikelihood", "code"):
            np.testing.assert_allclose(getattr(one, value), getattr(two, value), rtol=1e-8, atol=1e-8)
    for one, two in zip(*entries, strict=True):
        assert (one.code, one.rejected, one.event, one.reason) == (two.code, two.rejected, two.event, two.reason)

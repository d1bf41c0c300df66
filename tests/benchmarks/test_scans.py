"""Scans of a track, gate and status included, against FilterPy's extended Kalman filter of one run, in turn."""

import platform
from time import process_time

import numpy as np
import pytest
from monte_carlo.tables import write

from optloc import Motion, assemble, measured
from optloc.kernels.jit import enabled
from optloc.tracking import State, collected, polynomial, tracked
from optloc.tracking.several_models import imm

pytestmark = pytest.mark.skipif(not enabled(), reason="times of machine code")
filters = pytest.importorskip("filterpy.kalman", reason="FilterPy is not installed")
STATIONS = 1e3 * np.array([[0, 0, 0], [8, 0, 0.2], [0, 8, -0.15], [-7, 1, 0.4], [1, -8, 0.1], [5, 5, 0.9]])
PLACE, SPEED = np.array([2.1e3, -1.4e3, 3.2e3]), np.array([6.0, 3.0, -0.5])
SCANS, ROUNDS, SIGMA, ANGLE, DRIVE = 400, 9, 7.0, 0.01, 0.5
PRIOR = np.diag([1e4] * 3 + [1e2] * 3)
START = State(-1.0, np.r_[PLACE - SPEED + 20.0, SPEED + 1.0], PRIOR)


def run(angles=False):
    """One scan a second: ranges of six stations, or azimuths and elevations of three."""
    rng, times = np.random.default_rng(1), np.arange(SCANS) * 1.0
    line = (PLACE + times[:, None] * SPEED)[:, None] - STATIONS
    if not angles:
        m, z = 6, np.linalg.norm(line, axis=-1) + SIGMA * rng.standard_normal((SCANS, 6))
        kinds = {"range": (z, SIGMA)}
    else:
        m, flat = 3, np.hypot(line[:, :3, 0], line[:, :3, 1])
        noise = ANGLE * rng.standard_normal((2, SCANS, 3))
        kinds = {
            "azimuth": (np.arctan2(line[:, :3, 1], line[:, :3, 0]) + noise[0], ANGLE),
            "elevation": (np.arctan2(line[:, :3, 2], flat) + noise[1], ANGLE),
        }
    a, epoch = np.tile(np.arange(m), SCANS), np.repeat(np.arange(SCANS), m)
    rows = [measured(kind, z.ravel(), a=a, epoch=epoch, sigma=sigma) for kind, (z, sigma) in kinds.items()]
    return assemble(STATIONS, *rows, times=times, motions=(Motion(span="epoch"),))


def theirs(problem):
    """FilterPy's means (k, 6) of the run of ranges, without a gate."""
    f = filters.ExtendedKalmanFilter(dim_x=6, dim_z=6)
    f.x, f.P, f.R = START.mean.copy(), START.cov.copy(), SIGMA**2 * np.eye(6)
    drive = DRIVE * np.concatenate([0.5 * np.eye(3), np.eye(3)])
    f.F, f.Q = np.eye(6) + np.eye(6, k=3), drive @ drive.T

    def h(x):
        return np.sqrt(((x[:3] - STATIONS) ** 2).sum(1))

    def slope(x):
        line = x[:3] - STATIONS
        return np.hstack([line / np.sqrt((line**2).sum(1))[:, None], np.zeros((6, 3))])

    means = []
    for z in problem.z.reshape(-1, 6):
        f.predict()
        f.update(z, slope, h)
        means.append(f.x)
    return np.array(means)


def spent(work):
    began = process_time()
    work()
    return 1e6 * (process_time() - began) / SCANS


def race(work):
    """Microseconds of a scan of ours and of theirs, each in its quietest round, and the median of the ratios."""
    ranges = run()
    pairs = np.array([(spent(work), spent(lambda: theirs(ranges))) for _ in range(ROUNDS + 1)][1:])
    return *pairs.min(0), float(np.median(pairs[:, 0] / pairs[:, 1]))


def ours(name, angles=False):
    problem, dynamics = run(angles), polynomial(1, DRIVE)
    return lambda: list(tracked(problem, dynamics, name, start=START))


@pytest.mark.parametrize(("name", "most"), [("ekf", 1.0), ("iekf", 1.3)])
def test_a_scan_takes_no_longer_than_filterpys(name, most):
    assert race(ours(name))[2] < most


def test_both_are_the_same_filter():
    found = collected(ours("ekf")(), 3)
    np.testing.assert_allclose(found.mean, theirs(run()), rtol=1e-9, atol=1e-9)


@pytest.mark.full
def test_write_the_table():
    problem, models = run(), [polynomial(1, DRIVE), polynomial(1, 5.0)]
    chain = np.array([[0.95, 0.05], [0.05, 0.95]])
    works = {f"six ranges, {name}": ours(name) for name in ("ekf", "iekf", "mgekf", "mvekf")}
    works |= {f"three azimuths and elevations, {name}": ours(name, angles=True) for name in ("ekf", "iekf")}
    works["six ranges, two models that interact, ekf"] = lambda: imm(problem, START, models, chain, update="ekf")
    rows = []
    for name, work in works.items():
        mine, other, ratio = race(work)
        rows.append([name, f"{mine:.0f}", f"{other:.0f}", f"{ratio:.2f}"])
    facts = (
        f"tracks of {SCANS} scans from a given state, gate included; processor time, in turn with FilterPy's extended "
        f"Kalman filter of the six ranges without a gate; numpy {np.__version__}, Python {platform.python_version()}"
    )
    header = ["scan", "us", "FilterPy, us", "ratio"]
    assert write("scans", header, rows, facts).is_file()

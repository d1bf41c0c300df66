"""The least-squares program: agreement with SciPy, constraints and the signs of their multipliers, re-use."""

import shutil

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import least_squares

from formulations.nls import Program

STATIONS = np.array([[0.0, 0.0], [1.0, 0.1], [-0.2, 1.0], [1.1, 1.2], [0.4, -0.7]])


def distances(x, p):
    return [ca.sqrt((x[0] - p[2 * i]) ** 2 + (x[1] - p[2 * i + 1]) ** 2) for i in range(5)]


def measured(x, rng=None, sigma=0.02):
    exact = np.linalg.norm(STATIONS - x, axis=1)
    return exact if rng is None else exact + sigma * rng.normal(size=5)


@pytest.fixture(scope="module")
def program():
    return Program(2, 5, 10, distances)


def test_agrees_with_scipy_and_is_built_once(program):
    rng = np.random.default_rng(0)
    for _ in range(10):
        x, weight = rng.uniform(-1, 2, 2), rng.uniform(0.5, 3, 5)
        z = measured(x, rng)
        found = program.solve(x + 0.1, z, weight, STATIONS.ravel())
        other = least_squares(lambda y, z=z, w=weight: w * (z - measured(y)), x, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert found.success
        assert found.status == "Solve_Succeeded"
        assert found.iterations > 0
        np.testing.assert_allclose(found.x, other.x, atol=1e-7)
        assert found.cost == pytest.approx(2 * other.cost, rel=1e-8)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_machine_code_gives_the_same_answers(program, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fast = Program(2, 5, 10, distances, compiled=True)
    assert fast.compiled
    assert not program.compiled
    assert not list(tmp_path.iterdir())  # nothing is left where the program was built
    rng = np.random.default_rng(1)
    for _ in range(5):
        x, weight = rng.uniform(-1, 2, 2), rng.uniform(0.5, 3, 5)
        data = (x + 0.1, measured(x, rng), weight, STATIONS.ravel())
        one, other = program.solve(*data), fast.solve(*data)
        assert other.success
        np.testing.assert_allclose(other.x, one.x, atol=1e-10)
        assert other.cost == pytest.approx(one.cost, rel=1e-10)


@pytest.mark.parametrize("broken", [False, True])
def test_without_a_working_compiler_the_program_is_interpreted(broken, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    if broken:
        (tmp_path / "cc").write_text("#!/bin/sh\nexit 1\n")
        (tmp_path / "cc").chmod(0o755)
    slow = Program(2, 5, 10, distances, compiled=True)
    assert not slow.compiled
    found = slow.solve([0.2, 0.2], measured(np.array([0.5, 0.4])), p=STATIONS.ravel())
    np.testing.assert_allclose(found.x, [0.5, 0.4], atol=1e-7)


def test_stations_are_data(program):
    moved = STATIONS + 0.3
    found = program.solve([0.2, 0.2], measured(np.array([0.5, 0.4])), p=moved.ravel())
    np.testing.assert_allclose(found.x, [0.8, 0.7], atol=1e-7)


def test_bounds_hold_and_their_multipliers_have_signs(program):
    z = measured(np.array([0.6, 0.5]))
    found = program.solve([0.2, 0.2], z, p=STATIONS.ravel(), upper=[0.4, 5.0], lower=[-5.0, 0.7])
    assert found.success
    np.testing.assert_allclose(found.x, [0.4, 0.7], atol=1e-6)
    assert found.bounds[0] > 1e-3
    assert found.bounds[1] < -1e-3
    step = 1e-6

    def cost(y):
        return ((z - measured(y)) ** 2).sum()

    for j in range(2):
        unit = step * np.eye(2)[j]
        slope = (cost(found.x + unit) - cost(found.x - unit)) / (2 * step)
        assert slope + found.bounds[j] == pytest.approx(0.0, abs=1e-5)


def test_equality_and_inequality():
    program = Program(
        2,
        5,
        10,
        distances,
        equalities=lambda x, p: [x[0] - 2 * x[1]],
        inequalities=lambda x, p: [x[1] - 0.6, 3.0 - x[0]],
    )
    found = program.solve([1.0, 1.0], measured(np.array([0.6, 0.5])), p=STATIONS.ravel())
    assert found.success
    np.testing.assert_allclose(found.x, [1.2, 0.6], atol=1e-6)
    assert found.inequalities[0] < -1e-3
    assert abs(found.inequalities[1]) < 1e-6
    assert found.equalities.shape == (1,)


def test_correlated_noise_and_prior():
    rng = np.random.default_rng(1)
    root = np.tril(rng.normal(size=(5, 5))) + 3 * np.eye(5)
    program = Program(2, 5, 10, distances, diagonal=False)
    z, mean, information = measured(np.array([0.3, 0.4]), rng), np.array([0.5, 0.1]), np.array([[3.0, 1.0], [1.0, 2.0]])
    found = program.solve([0.1, 0.2], z, root, STATIONS.ravel(), prior=(mean, information))
    half = np.linalg.cholesky(information).T
    other = least_squares(
        lambda y: np.concatenate([root @ (z - measured(y)), half @ (y - mean)]),
        mean,
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    np.testing.assert_allclose(found.x, other.x, atol=1e-7)
    assert found.cost == pytest.approx(2 * other.cost, rel=1e-9)


def test_zero_weight_drops_a_row(program):
    z = measured(np.array([0.3, 0.4]))
    z[2] += 50.0
    found = program.solve([0.5, 0.5], z, [1, 1, 0, 1, 1], STATIONS.ravel())
    np.testing.assert_allclose(found.x, [0.3, 0.4], atol=1e-7)


def test_injected_residual_wraps_angles():
    def bearing(x, p, z):
        off = [z[i] - ca.atan2(x[1] - p[2 * i + 1], x[0] - p[2 * i]) for i in range(5)]
        return [ca.atan2(ca.sin(e), ca.cos(e)) for e in off]

    target = np.array([-3.0, 0.02])
    z = np.arctan2(*(target - STATIONS).T[::-1])
    z[0] -= 2 * np.pi
    found = Program(2, 5, 10, residual=bearing).solve([-2.0, 0.3], z, p=STATIONS.ravel())
    np.testing.assert_allclose(found.x, target, atol=1e-6)


def test_failure_is_a_result_and_silent(capfd):
    program = Program(2, 5, 10, distances, inequalities=lambda x, p: [x[0] - 1, -x[0] - 1])
    found = program.solve([0.1, 0.2], measured(np.array([0.6, 0.5])), p=STATIONS.ravel())
    assert not found.success
    assert found.status == "Infeasible_Problem_Detected"
    # a start on a station, where the distance has no gradient
    other = Program(2, 5, 10, distances).solve(STATIONS[0], measured(np.array([0.6, 0.5])), p=STATIONS.ravel())
    assert not other.success
    assert other.status == "the cost has no gradient at the start"
    assert other.iterations == 0
    assert capfd.readouterr() == ("", "")


def test_malformed_input_names_the_culprit(program):
    with pytest.raises(ValueError, match=r"z has shape \(4,\)"):
        program.solve([0.0, 0.0], np.zeros(4), p=STATIONS.ravel())
    with pytest.raises(ValueError, match="either h or residual"):
        Program(2, 5)
    with pytest.raises(ValueError, match="4 expressions"):
        Program(2, 5, 10, lambda x, p: distances(x, p)[:4])

"""Problems in lanes: operations, memory, and normal equations against differences of plain predictions."""

import numpy as np
import pytest
from cases import CASES, dense_covariance, plain_predict, wrapped

from optloc.kernels.batched_rows import (
    blocks,
    cell_layout,
    load,
    memory,
    rounding_of_residuals,
    run_operations,
    write_equations,
)
from optloc.kernels.jit import plain
from optloc.kernels.pack import pack
from optloc.kernels.trace import OPERATIONS, operate
from optloc.linear.normal import whitener_at


@pytest.fixture(autouse=True)
def in_python():
    """Run kernels as plain Python: nothing is compiled."""
    with plain():
        yield


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_on_registers_are_those_of_numpy(name):
    operation = OPERATIONS.index(name)
    r = np.array([[0.3, 1.7, 2.0, 9.0], [1.1, 0.4, 3.0, 9.0], [7.0, 7.0, 7.0, 7.0]])
    expected = operate(operation, r[0], r[1])
    run_operations(np.array([[operation, 2, 0, 1]]), 0, 1, r, 3)
    np.testing.assert_allclose(r[2, :3], expected[:3], rtol=1e-15)
    assert r[2, 3] == 7.0  # beyond the lanes that count


def loaded(problem, x):
    """Return packed problems, where things stand, and a memory of two lanes with the problem in each."""
    packed = pack(problem, whitener_at(problem, x))
    room = cell_layout(packed.tables, packed.numbers, x.shape[-1])
    m, r = memory(packed.tables, room, 2)
    c = packed.numbers
    for lane in range(2):
        load(m, lane, 0, c.source, c.white, c.prior, c.observed, c.present)
        m[room.trial : room.trial + x.shape[-1], lane] = x + lane
    return packed, room, m, r


@pytest.mark.parametrize("name", ["tdoa+azimuth-2d", "tdoa~groa-2d", "tdoa+fdoa-3d"])
def test_normal_equations_are_those_of_differences_of_plain_predictions(name):
    case = CASES[name]
    x = case.truth + 7.0
    packed, room, m, r = loaded(case.problem, x)
    n = packed.tables.shared
    write_equations(packed.tables, packed.numbers, m, r, room, False, 2)
    weight = np.linalg.pinv(dense_covariance(case.problem), rcond=1e-12, hermitian=True)
    for lane in range(2):
        at, step = x + lane, 1e-2
        rows = [
            plain_predict(case.problem, at + step * e) - plain_predict(case.problem, at - step * e) for e in np.eye(n)
        ]
        jacobian = wrapped(case.problem, np.array(rows)).T / (2.0 * step)
        residual = wrapped(case.problem, case.problem.observed - plain_predict(case.problem, at))
        whole = np.c_[jacobian, residual].T @ weight @ np.c_[jacobian, residual]
        found = m[room.after : room.after + (n + 1) ** 2, lane].reshape(n + 1, n + 1)
        scale = np.sqrt(np.diag(whole))
        np.testing.assert_allclose((np.tril(found) - np.tril(whole)) / np.outer(scale, scale), 0.0, atol=1e-6)


def test_the_parts_of_a_memory_follow_each_other():
    packed, room, m, _ = loaded(CASES["tdoa-3d"].problem, CASES["tdoa-3d"].truth)
    ends = np.array(room[:-1])
    assert (np.diff(ends) >= 0).all()
    assert m.shape == (room.cells, 2)
    assert room.observed == room.own  # a single problem has no numbers to itself
    assert blocks(packed, 3, 1) == 1
    assert blocks(packed, 3, 10**6) >= blocks(packed, 3, 20) == 20


def test_rounding_errors_grow_with_the_size_of_measurements_in_standard_deviations():
    packed, room, m, _ = loaded(CASES["range-2d"].problem, CASES["range-2d"].truth)
    c, z = packed.numbers, CASES["range-2d"].problem.observed
    found = rounding_of_residuals(c.sigma, c.size, m, room, 0, 0)
    assert found == pytest.approx(4.0 * np.finfo(float).eps * np.linalg.norm(z / 5.0))

"""Residuals and gap of the conic formulations, recomputed from the canonical data: at most 1e-6 in any unit of length.

The computation takes the data of cvxpy and the solution object of Clarabel. It does not use the solver's report.
"""

import numpy as np
import pytest

from formulations import conic, direction_sdp, lifted
from formulations.bearing_ls import predict
from formulations.lifted import lifted_ranges
from formulations.minimax_cone import common
from formulations.registration_sdp import registration
from formulations.sparse_errors import sparse_fit, square_cone
from formulations.squared_range import cone, paraboloid
from formulations.squared_range_conic import hull, shor

MOST = 1e-6
UNITS = (1e-3, 1.0, 1e3, 1e6, 1e9)


def violation(z, dims):
    """Distance of a point (m,) from the product of cones (which are their own duals, but for the zero cone)."""
    at, worst = int(dims.zero), 0.0
    worst = max(worst, float(np.max(-z[at : at + dims.nonneg], initial=0.0)))
    at += int(dims.nonneg)
    for size in dims.soc:
        worst = max(worst, float(np.linalg.norm(z[at + 1 : at + size]) - z[at]))
        at += int(size)
    for size in dims.psd:
        count = size * (size + 1) // 2
        row, column = np.tril_indices(size)
        matrix = np.zeros((size, size))
        matrix[row, column] = matrix[column, row] = z[at : at + count] * np.where(row == column, 1.0, np.sqrt(0.5))
        worst = max(worst, -float(np.linalg.eigvalsh(matrix)[0]))
        at += count
    assert at == len(z)
    return worst


def kkt(data, x, s, z):
    """Largest of primal residual, dual residual and gap, each relative to the size of its terms."""
    P = data.P.toarray()
    P = P + np.triu(P, 1).T
    A, b, q = data.A.toarray(), data.b, data.q
    sizes = 1.0 + max(np.abs(b).max(), np.abs(A @ x).max()), 1.0 + max(np.abs(q).max(), np.abs(A.T @ z).max())
    primal = max(np.abs(A @ x + s - b).max(), violation(s, data.dims), np.abs(s[: int(data.dims.zero)]).max(initial=0))
    dual = max(np.abs(P @ x + q + A.T @ z).max(), violation(z, data.dims))
    values = 0.5 * x @ P @ x + q @ x, -0.5 * x @ P @ x - b @ z
    gap = abs(values[0] - values[1]) / (1.0 + min(map(abs, values)))
    return max(primal / sizes[0], dual / sizes[1], gap)


@pytest.fixture
def solves(monkeypatch):
    """Collect the KKT numbers of every solve by Clarabel inside a test."""
    found, make = [], conic._solver

    def recorded(data, settings):
        solver = make(data, settings)

        class Kept:
            def solve(self):
                raw = solver.solve()
                # a failed first attempt is followed by a second one
                if str(raw.status) != "NumericalError":
                    found.append(kkt(data, np.array(raw.x), np.array(raw.s), np.array(raw.z)))
                return raw

        return Kept()

    monkeypatch.setattr(conic, "_solver", recorded)
    return found


def rows_of(rng, unit, shape):
    """Whitened squared-range rows of stations within one unit and a target within three."""
    d = int(rng.integers(2, 4))
    a, x = rng.uniform(-1, 1, (d + 3, d)), rng.uniform(-3, 3, d)
    r = unit * (np.linalg.norm(a - x, axis=1) + 0.01 * rng.normal(size=d + 3))
    a = unit * a
    if shape == "paraboloid":
        spread = 0.02 * unit * r
        B, g = np.column_stack([-2 * a, np.ones(d + 3)]), r**2 - (a**2).sum(1)
    else:
        away, c = a[1:] - a[0], r[1:] - r[0]
        spread = 0.02 * unit * r[1:]
        B, g = np.column_stack([2 * away, 2 * c]), (away**2).sum(1) - c**2
    return B / spread[:, None], g / spread, (paraboloid if shape == "paraboloid" else cone)(d)


def bearings_of(rng, unit):
    S, P = unit * rng.uniform(-1, 1, (4, 3)), unit * rng.uniform(-2, 2, 3)
    return S, predict(P, S) + 0.01 * rng.normal(size=(4, 2))


def solve_sparse(rng, unit):
    B, g, quadric = rows_of(rng, unit, "paraboloid")
    g = g + np.where(rng.random(len(g)) < 0.2, 30.0, 0.0)
    sparse_fit(B, g, cones=[square_cone(quadric.size - 1, quadric.size, quadric.size - 1)])


def solve_lifted(rng, unit):
    S, P = unit * rng.uniform(-1, 1, (6, 3)), unit * rng.uniform(-1.5, 1.5, 3)
    sigma = 0.03 * unit
    lifted_ranges(np.eye(6) / sigma, np.linalg.norm(P - S, axis=1) / sigma + rng.normal(size=6), S)


def solve_common(rng, unit):
    S, angle = bearings_of(rng, unit)
    u = np.stack([np.cos(angle[:, 0]) * np.cos(angle[:, 1]), np.sin(angle[:, 0]) * np.cos(angle[:, 1]),
                  np.sin(angle[:, 1])], axis=1)  # fmt: skip
    common(u, S, np.full(4, 0.05))


def solve_directions(rng, unit):
    S, angle = bearings_of(rng, unit)
    direction_sdp.directions(angle, np.full((4, 2), 0.01), S)


def solve_registration(rng, unit):
    S = unit * rng.uniform(-1, 1, (3, 4, 3))
    P, bias = unit * rng.uniform(-2, 2, 3), 0.05 * unit * rng.normal(size=3)
    r = np.linalg.norm(P - S, axis=-1)
    z = r[:, 1:] - r[:, :1] + bias + 0.003 * unit * rng.normal(size=(3, 3))
    registration(S, z, np.eye(3) / (0.003 * unit), np.full(3, 0.05 * unit), prices=(1.0,))


FORMULATIONS = {
    "shor, ranges": lambda rng, unit: shor(*rows_of(rng, unit, "paraboloid")),
    "shor, differences": lambda rng, unit: shor(*rows_of(rng, unit, "cone")),
    "hull, ranges": lambda rng, unit: hull(*rows_of(rng, unit, "paraboloid")),
    "hull, differences": lambda rng, unit: hull(*rows_of(rng, unit, "cone")),
    "sparse": solve_sparse,
    "lifted": solve_lifted,
    "common": solve_common,
    "directions": solve_directions,
    "registration": solve_registration,
}


def check(name, count, solves):
    for seed in range(count):
        rng = np.random.default_rng(seed)
        FORMULATIONS[name](rng, UNITS[seed % len(UNITS)])
    assert len(solves) >= count
    assert max(solves) <= MOST, (sum(one > MOST for one in solves), len(solves), max(solves))


@pytest.mark.parametrize("name", FORMULATIONS)
def test_twenty_solves_are_solutions(name, solves):
    check(name, 20, solves)


@pytest.mark.full
@pytest.mark.parametrize("name", FORMULATIONS)
def test_five_hundred_solves_are_solutions(name, solves):
    check(name, 500, solves)


def test_the_computation_sees_a_wrong_point(solves):
    """A point moved by 1e-5, a dual point outside of its cone, a slack that is not the constraint's."""
    relaxation = conic.Relaxation(lifted.lifted_problem(3, 2))
    kept = []
    make = conic._solver

    def recorded(data, settings):
        solver = make(data, settings)

        class Kept:
            def solve(self):
                raw = solver.solve()
                kept.append((data, np.array(raw.x), np.array(raw.s), np.array(raw.z)))
                return raw

        return Kept()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conic, "_solver", recorded)
        S = np.array([[0.0, 0.0], [1.0, 0.1], [0.3, 0.9]])
        table = np.column_stack([-np.linalg.norm(S - 0.4, axis=1), np.eye(3)])
        relaxation.solve({"gram": table.T @ table, "station": S, "square": (S**2).sum(1), "reach": np.array(4.0)})
    data, x, s, z = kept[0]
    good = kkt(data, x, s, z)
    assert good < MOST
    assert kkt(data, x + 1e-5, s, z) > 2e-6
    assert kkt(data, x, s, z + 1e-4) > 2e-6
    assert kkt(data, x, s + 1e-4, z) > 2e-6

"""The order-2 moment relaxation: exact forms, honest bounds, tightness, wrong minima, twins."""

import numpy as np
import pytest
from often import few
from ranged import drawn, minimum, whitened
from scipy.optimize import least_squares

from formulations.conic import Relaxation
from formulations.moment_sdp import _forms, _upper, moment_bound, moment_problem, moments
from formulations.range_enclosure import Ranged, ball, enclosure

TIGHT = 1e-4


def monomials(own, place: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Every monomial at one point, by its factors."""
    y = np.full(own.count, np.nan)
    both = np.einsum("a,b,k,m->abkm", place, place, error, error)
    y[own.table] = both
    return y


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("kind", ["difference", "both", "correlated range"])
def test_every_point_is_feasible_and_costs_what_it_costs(kind, d):
    """The polynomial program is exact: at the moments of any point the rules hold and the objective is the cost."""
    rng = np.random.default_rng(d)
    ranged, truth = drawn(rng, kind, 5, d, 1e-2)
    M = len(ranged.station)
    box, unit, own = ball(ranged, truth, 0.7), rng.uniform(0.01, 0.1, M - 1), moments(M, d)
    cone, rule, white = _forms(ranged, box, unit)
    form = white.T @ white
    for _ in range(10):
        s = rng.uniform(-0.6, 0.6, d)
        x = box.centre + box.axes @ s
        r = np.linalg.norm(x - ranged.station, axis=1)
        t = (r[0] - 0.5 * (box.low + box.high)) / (0.5 * (box.high - box.low))
        w = (r[1:] - ranged.side * r[0] - ranged.excess) / unit
        y = monomials(own, np.concatenate([[1.0], s, [t]]), np.concatenate([[1.0], w]))
        assert np.isfinite(y).all()
        np.testing.assert_allclose(y[own.cone] @ _upper(cone), 0.0, atol=1e-9 * np.abs(y).max())
        for i, index in enumerate(own.rules):
            np.testing.assert_allclose(y[index] @ rule[i], 0.0, atol=1e-9 * np.abs(y).max())
        assert _upper(form) @ y[own.cost] == pytest.approx(float(ranged.cost(x)), rel=1e-9)
        assert (np.linalg.eigvalsh(y[own.matrix])[:-1] < 1e-9 * np.abs(y).max()).all()


def test_the_solver_sees_the_moments_and_nothing_else():
    """The reach of the bound is that of the moments: no hidden variable may be longer."""
    relaxation = Relaxation(moment_problem(4, 2))
    assert len(relaxation._shared.q) == moments(4, 2).count


@pytest.mark.parametrize(
    ("kind", "count", "d"),
    few(
        [
            ("difference", 4, 2),
            ("difference", 5, 3),
            ("both", 5, 3),
            ("correlated range", 4, 2),
            ("difference", 6, 3),
            ("sum", 5, 3),
            ("range", 4, 3),
        ],
        4,
        3,
    ),
)
@pytest.mark.parametrize(("trials", "least"), few([(4, 3), (6, 5)], 1, 2))
def test_the_bound_is_the_global_minimum(kind, count, d, trials, least):
    rng = np.random.default_rng([count, d])
    tight = solved = 0
    for _ in range(trials):
        ranged, truth = drawn(rng, kind, count, d, 10.0 ** rng.uniform(-4.0, -2.5))
        x, cost = minimum(ranged, truth, rng)
        box = enclosure(ranged, x, cost + 0.1)
        if box is None:
            continue
        found = moment_bound(ranged, box, cost + 0.1)
        solved += 1
        assert found.bound <= cost + 1e-9 * (1.0 + cost)
        if cost - found.bound < TIGHT * (1.0 + cost):
            tight += 1
            assert found.rank_ratio < 1e-4
            np.testing.assert_allclose(found.point, x, atol=2e-3)
    assert solved >= least
    assert tight >= solved - 1


def test_no_point_of_the_box_costs_less_than_the_bound():
    rng = np.random.default_rng(3)
    for _ in range(4):
        ranged, truth = drawn(rng, "difference", 5, 3, 1e-2)
        box = ball(ranged, truth + 0.3 * rng.normal(size=3), 0.8)
        cost = 50.0
        found = moment_bound(ranged, box, cost)
        points = box.centre + rng.uniform(-1.0, 1.0, (20000, 3)) @ box.axes.T
        points = points[np.linalg.norm(points - box.centre, axis=1) <= 0.8]
        x = least_squares(lambda p, own=ranged: whitened(own, p), points[ranged.cost(points).argmin()]).x
        assert found.bound <= cost
        assert (found.bound <= ranged.cost(points) + 1e-9).all()
        if np.linalg.norm(x - box.centre) <= 0.8:
            assert found.bound <= ranged.cost(x) + 1e-9


def test_a_solver_that_stops_early_still_bounds(monkeypatch):
    """The bound comes from the dual point, whatever it is worth, never from the solver's word."""
    rng = np.random.default_rng(4)
    ranged, truth = drawn(rng, "difference", 5, 3, 3e-3)
    x, cost = minimum(ranged, truth, rng)
    box = enclosure(ranged, x, cost + 0.1)
    bounds = []
    for steps in (1, 3, 5, 30):
        early = Relaxation(moment_problem(5, 3), settings={"max_iter": steps, "static_regularization_constant": 1e-7})
        monkeypatch.setattr("formulations.moment_sdp._relaxation", lambda *_, own=early: own)
        bounds.append(moment_bound(ranged, box, cost + 0.1).bound)
    assert max(bounds) <= cost + 1e-9
    assert bounds[0] < bounds[-1]
    assert bounds[-1] == pytest.approx(cost, abs=1e-4)


@pytest.mark.parametrize(("kind", "count", "d", "sigma"), [("range", 4, 3, 0.03), ("sum", 4, 2, 0.01)])
@pytest.mark.parametrize("wanted", few([4, 8], 1))
def test_wrong_minima_are_never_reached_by_the_bound(kind, count, d, sigma, wanted):
    """Local minima above the global one: the bound stays below that, and says so by its gap."""
    rng = np.random.default_rng(9)
    wrong = 0
    for _ in range(60):
        ranged, truth = drawn(rng, kind, count, d, sigma)
        found = [least_squares(lambda p, own=ranged: whitened(own, p), s) for s in rng.uniform(-3.0, 3.0, (5, d))]
        x, least = minimum(ranged, truth, rng)
        others = [one for one in found if one.success and 2.0 * one.cost > least + 1e-2]
        if not others:
            continue
        one = min(others, key=lambda other: other.cost)
        cost = 2.0 * one.cost
        box = enclosure(ranged, one.x, cost + 0.1)
        if box is None:
            continue
        wrong += 1
        assert np.abs(np.linalg.solve(box.axes, x - box.centre)).max() <= 1.0  # the better point is in the box
        assert moment_bound(ranged, box, cost + 0.1).bound <= least + 1e-7 * (1.0 + least)
        if wrong == wanted:
            break
    assert wrong == wanted


def test_twins_are_two_points_of_one_cost():
    """Four range differences of a plane array, emitter above it: its mirror image costs the same."""
    rng = np.random.default_rng(11)
    station = np.column_stack([rng.uniform(-1.0, 1.0, (5, 2)), np.zeros(5)])
    truth = np.array([0.3, -0.2, 0.8])
    r = np.linalg.norm(truth - station, axis=1)
    covariance = np.zeros((5, 5))
    covariance[1:, 1:] = 0.5e-6 * (np.eye(4) + 1.0)
    ranged = Ranged(station, np.ones(5), np.concatenate([[0.0], r[1:] - r[0]]), covariance, free=True)
    assert enclosure(ranged, truth, 0.1) is None
    found = moment_bound(ranged, ball(ranged, np.zeros(3), 2.0), 0.1)
    assert -1e-4 < found.bound < 1e-9
    assert found.rank_ratio > 1e-3

"""From candidates to minima: each once, the best first, with the curvature of plain least squares."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import Status
from optloc.kernels.sums import equations_at
from optloc.problem.fix_parts import Stage
from optloc.solvers.pool import begin
from optloc.solvers.stages import lsr
from optloc.solvers.verdict.minima import (
    is_measured,
    likelihood_of,
    measure_curvature,
    settle,
    smallest_pivot,
    station_direction,
    unmeasured_direction,
    weak_direction,
)

HERE = Stage("here", "", 0.0)


def with_candidates(problem, points, costs):
    pool = begin(problem, np.array(points)[None])
    return replace(pool, cost=np.array([costs]), code=np.full((1, len(points)), int(Status.OK), dtype=np.int8))


def test_the_best_comes_first_and_what_is_one_minimum_is_listed_once():
    problem = ranges_to(PLACE, 2.0, stations=SQUARE[:2])
    mirror, far = PLACE * [1.0, -1.0], PLACE + 500.0
    pool = with_candidates(problem, [far, mirror, PLACE + 0.01, PLACE], [100.0, 4.0, 1e-3, 0.0])
    found = settle(problem, pool, HERE)
    # the far one costs more than is listed, and two are within a tenth of a sigma
    np.testing.assert_array_equal(found.x[0], [PLACE, mirror])
    assert found.cost[0].tolist() == [0.0, 4.0]
    assert found.stages[-1] is HERE


def test_the_covariance_is_that_of_plain_least_squares():
    problem = ranges_to(PLACE, 2.0)
    J = (PLACE - SQUARE) / np.linalg.norm(PLACE - SQUARE, axis=1, keepdims=True) / 2.0
    at = measure_curvature(problem, equations_at(problem, PLACE[None]), PLACE[None], np.zeros(1, dtype=int))
    np.testing.assert_allclose(at.covariance[0], np.linalg.inv(J.T @ J), rtol=1e-9)
    assert at.regular[0]


def test_the_smallest_pivot_does_not_depend_on_units():
    information = np.array([[4.0, 1.0], [1.0, 9.0]])
    expected = 1.0 - 1.0 / 36.0
    for scale in (np.eye(2), np.diag([1e-6, 1e3])):
        assert smallest_pivot((scale @ information @ scale)[None])[0] == pytest.approx(expected)
    assert smallest_pivot(np.ones((1, 2, 2)))[0] == pytest.approx(0.0, abs=1e-12)


def test_an_open_direction_is_named_by_its_unknowns():
    problem = ranges_to(PLACE, 2.0)
    assert weak_direction(problem, np.diag([0.0, 4.0])).startswith("no measurement depends on")
    text = weak_direction(problem, np.array([[1.0, -1.0], [-1.0, 1.0]]))
    assert text.startswith("the data do not determine the direction")
    assert text.count("+1") == 2 or text.count("-1") == 2
    assert weak_direction(problem, np.full((2, 2), np.nan)) == "the information is not finite"


def test_two_ranges_measure_a_place_and_one_does_not():
    assert is_measured(ranges_to(PLACE, 1.0, stations=SQUARE[:2])).tolist() == [True]
    assert is_measured(ranges_to(PLACE, 1.0, stations=SQUARE[:1])).tolist() == [False]
    assert unmeasured_direction(ranges_to(PLACE, 1.0)) == ""
    line = np.array([[0.0, 0.0, 0.0], [500.0, 0.0, 0.0], [1000.0, 0.0, 0.0]])
    assert "on one line" in station_direction(ranges_to([300.0, 650.0, 100.0], 1.0, stations=line))


def test_of_two_places_the_nearer_is_likelier_and_of_mirror_images_the_upper():
    problem = ranges_to(PLACE, 1.0, stations=SQUARE[:2]).take(np.zeros(3, dtype=int))
    x = np.array([PLACE, PLACE * [1.0, -1.0], PLACE * 3.0])
    first, second = likelihood_of(problem, x)
    assert first[0] == first[1] > first[2]
    assert second[0] > second[1]


def test_of_minima_that_cost_the_same_the_upper_one_is_answered():
    problem = ranges_to(PLACE, 2.0, stations=SQUARE[:2])
    for order in ([PLACE, PLACE * [1.0, -1.0]], [PLACE * [1.0, -1.0], PLACE]):
        pool = lsr(problem, begin(problem, np.array([order])))
        np.testing.assert_allclose(pool.x[0, 0], PLACE, atol=1e-3)

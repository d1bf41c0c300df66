"""The search of states: regions as boxes, known minima, and descents, against SciPy."""

import numpy as np
import pytest
from proof.runs.small import STATE, course as problem, residual
from scipy.optimize import least_squares

from optloc.proof.local_search import UNIQUE
from optloc.proof.runs.run_costs import course_costs
from optloc.proof.runs.state_bounds import axes_of, hessian_of_state
from optloc.proof.runs.state_search import (
    Search,
    _descends,
    _is_inside,
    _is_known,
    _push_halves,
    _set_first,
    _where,
    prove_course,
    set_minimum,
)
from optloc.proof.runs.states import floor_of, put, table_of

pytestmark = pytest.mark.usefixtures("plainly")

CORNERS = STATE + np.array([[-60.0, -60.0, -2.0, -2.0], [60.0, 60.0, 2.0, 2.0]])


@pytest.fixture(scope="module")
def best():
    return least_squares(residual, STATE, x_scale=[1.0, 1.0, 0.01, 0.01], xtol=1e-15, ftol=1e-15, gtol=1e-15).x


@pytest.fixture
def search(best):
    whole, few = course_costs(problem()).courses[0]
    axes = axes_of(hessian_of_state(whole, best), best, CORNERS)
    room = np.zeros((2, 1, 4))
    return Search(
        whole, few, axes, table_of(whole), table_of(few), (floor_of(whole, best), floor_of(few, best)), room[0], room[1]
    )


def test_the_first_box_holds_all_corners_of_the_region(search):
    at, half = np.zeros(4), np.zeros(4)
    _set_first(search.axes, at, half)
    corners = np.stack(np.meshgrid(*CORNERS.T), axis=-1).reshape(-1, 4)
    s = (corners - search.axes.origin) @ search.axes.back.T
    assert (np.abs(s - at) <= half * (1.0 + 1e-9)).all()
    assert _where(search.axes, at, half) == 0
    assert _where(search.axes, np.zeros(4), np.full(4, 1e-3)) == 1
    assert _where(search.axes, at + 3.0 * half, half) == -1


def test_a_minimum_is_written_with_a_box_and_a_slope_is_none(search, best):
    least = (residual(best) ** 2).sum()
    assert set_minimum(search, 0, best, least - 1e-6, 1e-6)
    np.testing.assert_allclose(search.minima[0], 0.0, atol=1e-6)
    assert (search.sides[0] > 0.1).all()
    assert _is_known(search, search.minima[0], 0.5 * search.sides[0])
    assert not _is_known(search, search.minima[0], 1.5 * search.sides[0])
    assert not set_minimum(search, 0, best, least + 1.0, 1e-6)


def test_a_descent_ends_at_the_minimum_of_scipy(search, best):
    found = np.zeros(4)
    put(search.table, np.array([3.0, -2.0, 1.0, 2.0]), np.zeros(4))
    search.sides[:] = -1.0  # nothing is known
    assert _descends(search, (residual(best) ** 2).sum() + 1.0, found)
    np.testing.assert_allclose(found, best, rtol=1e-5)


def test_halves_make_up_a_box(search):
    stack = np.zeros((3, 8))
    put(search.small, np.zeros(4), np.array([1.0, 2.0, 3.0, 4.0]))
    assert _push_halves(stack, 1, search.small, 2) == 3
    assert stack[1:, 2].tolist() == [-1.5, 1.5]
    np.testing.assert_allclose(stack[1:, 6], 1.5)
    assert _is_inside(search.axes, np.zeros(4), np.zeros(4))


def test_the_best_state_of_a_small_region_is_the_only_one(search, best):
    found, nothing = np.full(4, np.nan), np.zeros((0, 4))
    verdict, boxes, bound = prove_course(search.whole, search.few, search.axes, nothing, 9.0, 1e-6, 200, found)
    assert verdict == UNIQUE
    assert boxes <= 200
    assert bound == pytest.approx((residual(best) ** 2).sum(), abs=1e-5)

"""States of a target in uniform motion: costs, places over boxes of states, and derivatives, by plain formulas."""

import numpy as np
import pytest
from proof.runs.small import EPOCHS, STATE, STATIONS, TIMES, course as problem, residual

from optloc.proof.nodes.node import PHI, SLOPE0
from optloc.proof.runs.run_costs import course_costs
from optloc.proof.runs.states import StateAxes, cost_of_state, floor_of, put, set_bends, set_box, table_of

pytestmark = pytest.mark.usefixtures("plainly")


@pytest.fixture
def course():
    return course_costs(problem()).courses[0][0]


def boxed(course, half):
    rng = np.random.default_rng(1)
    turn = np.diag([10.0, 10.0, 0.1, 0.1]) @ rng.normal(size=(4, 4))
    axes, table = StateAxes(STATE, turn, np.linalg.inv(turn), np.zeros((2, 4))), table_of(course)
    put(table, np.array([0.5, -1.0, 0.0, 2.0]), np.full(4, half))
    set_box(course, axes, table)
    return rng, axes, table


def test_a_state_costs_what_its_ranges_do(course):
    for state in (STATE, STATE + np.array([300.0, -200.0, 5.0, 8.0])):
        cost, blur = cost_of_state(course, state)
        assert cost == pytest.approx((residual(state) ** 2).sum(), rel=1e-9)
        assert 0.0 < blur < 1e-8


def test_all_places_of_a_box_are_within_its_reach(course):
    rng, axes, table = boxed(course, 3.0)
    s = table.at + rng.uniform(-1.0, 1.0, (500, 4)) * table.half
    states = axes.origin + s @ axes.turn.T
    for k, time in enumerate(TIMES):
        away = np.abs(states[:, :2] + time * states[:, 2:] - table.places[k, 0, :2])
        assert (away <= table.places[k, 1, :2]).all()
        assert away.max() > 0.5 * table.places[k, 1, :2].max()


def test_nodes_and_their_derivatives_are_those_of_ranges(course):
    _, axes, table = boxed(course, 0.0)
    set_bends(course, axes, table)
    state = axes.origin + axes.turn @ table.at
    for k in range(EPOCHS):
        place = state[:2] + TIMES[k] * state[2:]
        own = slice(course.first[k], course.first[k + 1])
        line = place - STATIONS
        r = np.linalg.norm(line, axis=1)
        np.testing.assert_allclose(np.sort(table.nodes[own, PHI]), np.sort(r), rtol=1e-9)
        order = np.argsort(np.argsort(table.nodes[own, PHI]))
        unit = (line / r[:, None])[np.argsort(r)][order]
        np.testing.assert_allclose(table.nodes[own, SLOPE0 : SLOPE0 + 2], unit, atol=1e-9)


def test_the_floor_counts_the_farthest_epoch(course):
    fast = STATE * [1.0, 1.0, 100.0, 100.0]
    assert floor_of(course, fast) > floor_of(course, STATE) > np.linalg.norm(course.rows.w)

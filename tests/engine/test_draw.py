"""Drawn plans: linear maps to ranges, and rows whose cost is that of the problem."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, plain_cost, plain_predict

from optloc import assemble, measured, with_bias
from optloc.engine.admission import admission_of
from optloc.engine.draw import _is_bounded, draw_ranges, draw_tapes
from optloc.engine.memory import BY_HEIGHT, BY_SQUARES, HEARD, RANGED, SEEN, SIGN
from optloc.engine.plan import _without_measurements
from optloc.linear.constraints import height
from optloc.problem import ECEF, Prior


def drawn(problem):
    one = _without_measurements(problem)
    return draw_ranges(one, admission_of(one))


@pytest.mark.parametrize("name", ["range-2d", "tdoa-3d", "range+range_sum-2d", "toa+tdoa-2d"])
def test_linear_maps_give_the_ranges_up_to_that_of_the_reference(name):
    problem, truth = CASES[name].problem, CASES[name].truth
    found = drawn(problem)
    d, s = problem.dimension, len(STATIONS[problem.dimension])
    z = plain_predict(problem, truth)
    anchored = z - np.where(found.model.anchor >= 0, z[found.model.anchor], 0.0)
    station, reference = found.model.station, found.model.reference
    r = np.linalg.norm(STATIONS[d][found.node[1]] - TARGET[d], axis=1)
    t = r[reference] if reference >= 0 else 0.0
    np.testing.assert_allclose(found.model.linear[:s] @ anchored + station[SIGN] * t, r, rtol=1e-9)
    assert station[RANGED].tolist() == [1.0] * s


@pytest.mark.parametrize("name", ["range-2d", "tdoa-3d", "range_sum-3d"])
def test_the_cost_of_whitened_rows_and_loops_is_that_of_the_problem(name):
    problem = CASES[name].problem
    found = drawn(problem)
    rows, s, d = found.rows(problem), found.node.shape[1], problem.dimension
    image = found.model.linear @ problem.observed
    u, loops = image[s : s + len(rows.K)], image[s + len(rows.K) + len(rows.start) :]
    for place in (TARGET[d], TARGET[d] + 500.0):
        r = np.linalg.norm(STATIONS[d][found.node[1]] - place, axis=1)
        cost = ((u - rows.K @ r) ** 2).sum() + (loops**2).sum()
        assert cost == pytest.approx(plain_cost(problem, place))
    assert rows.level == (name == "tdoa-3d")


def test_stations_without_a_link_have_no_plan_of_ranges():
    rows = measured("tdoa", a=[1, 3, 5], b=[0, 2, 4], sigma=1.0)
    assert drawn(assemble(STATIONS[2], rows)) is None


def test_the_way_of_a_start_depends_on_rows_and_heights():
    one = _without_measurements(CASES["tdoa+azimuth-2d"].problem)
    assert draw_tapes(one, admission_of(one), 1).model.start == BY_SQUARES
    place = 7e6 * np.eye(3) + 1e6
    held = assemble(place, measured("tdoa", a=[1, 2], b=0, sigma=1.0), frame=ECEF, constraints=height(exactly=100.0))
    one = _without_measurements(held)
    model = draw_tapes(one, admission_of(one), 0).model
    assert (model.start, model.height) == (BY_HEIGHT, 0)


def test_costs_grow_without_bound_where_ranges_add_up_or_a_position_has_a_prior():
    ranges, differences = CASES["range-2d"].problem, CASES["tdoa-2d"].problem
    prior = Prior("position", np.zeros(2), np.eye(2))
    assert _is_bounded(ranges)
    assert not _is_bounded(differences)
    assert _is_bounded(replace(differences, priors=(prior,)))
    assert not _is_bounded(with_bias(ranges, "offset", per="kind"))
    assert _is_bounded(with_bias(ranges, "offset", per="kind", sigma=3.0))
    assert not _is_bounded(with_bias(ranges, "gain", per="kind", form="scale", sigma=0.1))


def test_stations_of_angles_are_marked_beside_those_with_any_row():
    one = _without_measurements(CASES["range+azimuth-2d"].problem)  # ranges to stations 0 and 4, azimuths of 1 and 2
    found = draw_tapes(one, admission_of(one), 2)
    station = found.node[1]
    assert sorted(station[found.model.station[HEARD] == 1.0]) == [0, 1, 2, 4]
    assert sorted(station[found.model.station[SEEN] == 1.0]) == [1, 2]

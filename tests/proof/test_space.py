"""Places of boxes, in search coordinates and in an atlas, and the nodes bounded there."""

import numpy as np
import pytest
from proof.costs import random_case

from optloc.proof.atlas import atlas_of, piece_of
from optloc.proof.box import cost_at, station_cube
from optloc.proof.search_space import chart_at
from optloc.proof.space import Space, bound_or_halve, floor_of, in_atlas, place_of, set_box, set_nodes, set_place

pytestmark = pytest.mark.usefixtures("plainly")


@pytest.fixture(params=[2, 3])
def looks(request):
    """Return a case, its cost with a box, and both spaces: search coordinates around its minimum and the atlas."""
    rng = np.random.default_rng(request.param)
    case, truth = random_case(rng, request.param)
    cost, box = case.tables
    x = case.minimum(truth)
    chart, _ = chart_at(cost, x, box)
    atlas = atlas_of(*station_cube(cost.kinds, cost.data, x), case.d, 0)
    return case, cost, box, Space(False, atlas, chart, np.empty((0, 3)), np.empty((0, 3))), in_atlas(atlas, chart)


def test_a_place_in_the_atlas_is_the_one_whose_coordinates_were_set(looks):
    case, cost, box, _, far = looks
    rng, out = np.random.default_rng(1), np.empty(case.d)
    for size in (1e3, 1e5, 1e8):
        x = size * rng.normal(size=case.d)
        box.at[:], box.half[:] = 0.0, 0.0
        piece = piece_of(far.atlas, x, box.at)
        set_place(far, box, piece)
        place_of(far, box, out)
        np.testing.assert_allclose(out, x, rtol=1e-9, atol=1e-6)
        assert set_nodes(far, cost, box)
        # ranges count less the distance to the middle there, which differences do not feel
        assert cost_at(cost.K, cost.w, box.nodes) == pytest.approx(case.cost(x), rel=1e-6)


def test_a_place_in_search_coordinates_is_the_fix_and_so_many_sigma(looks):
    case, cost, box, near, _ = looks
    out, s = np.empty(case.d), np.array([1.0, -2.0, 0.5 if case.d == 3 else 0.0])
    box.at[:], box.half[:] = s, 0.0
    set_box(near, box, 0)
    place_of(near, box, out)
    np.testing.assert_allclose(out, (near.chart.origin + near.chart.sense @ s)[: case.d])
    assert set_nodes(near, cost, box)
    assert cost_at(cost.K, cost.w, box.nodes) == pytest.approx(case.cost(out), rel=1e-9)
    # a box covers the rounding of its centre
    assert (box.half[: case.d] > 0.0).all()


def test_a_box_in_that_of_a_known_minimum_is_dropped(looks):
    case, cost, box, near, _ = looks
    known = near._replace(minima=np.zeros((1, 3)), sides=np.full((1, 3), 2.0))
    box.at[:], box.half[:] = 0.0, 1.0
    box.half[case.d :] = 0.0
    assert bound_or_halve(known, cost, box, 0, np.zeros((4, 8)), 3) == 3
    assert bound_or_halve(near, cost, box, 0, np.zeros((4, 8)), 3) == -1


def test_the_atlas_has_larger_lines_to_round_than_the_fix(looks):
    _, cost, _, near, far = looks
    length = np.linalg.norm(cost.w)
    assert length < floor_of(near, cost) < floor_of(far, cost)

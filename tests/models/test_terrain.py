"""The ground of a grid: heights, slopes, equality and refusals."""

import pickle

import casadi as ca
import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.models.primitives import Jet
from optloc.models.terrain import Terrain

X, Y = np.array([0.0, 90.0, 210.0, 300.0, 400.0]), np.linspace(-100.0, 300.0, 6)
GROUND = Terrain(X, Y, 40.0 * np.sin(X[:, None] / 150.0) * np.cos(Y / 120.0))


def test_the_ground_has_the_heights_of_its_grid():
    values, _, _ = GROUND.at(*np.meshgrid(X, Y, indexing="ij"))
    assert values == pytest.approx(GROUND.height, abs=1e-9)


def test_slopes_are_differences_also_beyond_the_edge():
    place, step = np.array([[120.0, 40.0], [-30.0, 55.0], [430.0, 310.0], [250.0, -140.0]]).T, 1e-4
    _, along_x, along_y = GROUND.at(*place)
    for slope, (dx, dy) in ((along_x, (step, 0.0)), (along_y, (0.0, step))):
        ahead, behind = (GROUND.at(place[0] + s * dx, place[1] + s * dy)[0] for s in (1, -1))
        assert slope == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-6)


@pytest.mark.parametrize("place", [(120.0, 40.0), (-30.0, 55.0), (430.0, 310.0)])
def test_numbers_jets_and_symbols_agree(place):
    jets = GROUND.of(Jet(np.array([place[0]]), {0: np.ones(1)}), Jet(np.array([place[1]]), {1: np.ones(1)}))
    symbols = ca.SX.sym("p", 2)
    height = GROUND.of(symbols[0], symbols[1])
    found = ca.Function("f", [symbols], [height, ca.gradient(height, symbols)])(place)
    assert float(GROUND.of(*place)) == pytest.approx(float(found[0]), abs=1e-9)
    assert jets.value[0] == pytest.approx(float(found[0]), abs=1e-9)
    assert [jets.partials[k][0] for k in (0, 1)] == pytest.approx(found[1].full()[:, 0], abs=1e-9)


def test_two_points_along_an_axis_are_a_slope():
    plane = Terrain([0.0, 10.0], [0.0, 10.0, 20.0], [[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]])
    assert plane.at(np.array(2.0), np.array(5.0)) == pytest.approx((2.5, 1.0, 0.1))


def test_grids_are_equal_by_their_numbers():
    again = pickle.loads(pickle.dumps(GROUND))
    assert again == GROUND
    assert hash(again) == hash(GROUND)
    assert Terrain(X, Y, GROUND.height + 1.0) != GROUND
    with pytest.raises(ValueError, match="read-only"):
        again.height[0, 0] = 1.0


def test_what_is_neither_number_nor_symbol_is_refused():
    with pytest.raises(TypeError, match="needs numbers"):
        GROUND.of(object(), 1.0)


BAD = {
    "an axis of one": (([0.0], [0.0, 1.0], [[0.0, 1.0]]), "the axis has shape"),
    "a descending axis": (([1.0, 0.0], [0.0, 1.0], np.eye(2)), "is not ascending"),
    "a gap": (([0.0, 1.0], [0.0, 1.0], [[0.0, np.nan], [1.0, 2.0]]), "heights without a finite number: 1"),
    "a transposed grid": (([0.0, 1.0, 2.0], [0.0, 1.0], np.zeros((2, 3))), "for a grid of 3 by 2 points"),
    "words": ((["a", "b"], [0.0, 1.0], np.eye(2)), "not all entries are numbers"),
}


@pytest.mark.parametrize("case", BAD)
def test_one_sentence_names_the_fault(case):
    numbers, words = BAD[case]
    with pytest.raises(InvalidProblem, match=words):
        Terrain(*numbers)

"""Problems that cannot be meant are refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, assemble, measured, with_bias
from optloc.base.types import Stations
from optloc.linear.constraints import box, speed
from optloc.problem import Prior
from optloc.problem.noise import Block, Noise
from optloc.problem.validation import check_unknowns, check_values, checked

PLACES = np.array([[0.0, 0.0], [9.0, 1.0], [10.0, 9.0], [1.0, 10.0]])
ROWS = measured("range", np.full(4, 5.0), a=np.arange(4), sigma=1.0)
GOOD = assemble(PLACES, ROWS)
(RANGES,) = GOOD.rows
PLACE = GOOD.stations.position
INFINITE = np.array([[[np.inf, 0.0], *PLACE[0, 1:]]])
SKEW = Noise((Block(np.arange(4)[None], np.array([np.eye(4) + 0.5 * np.eye(4, k=1)])),))

BAD = {
    "a position": ({"stations": Stations(INFINITE, tuple("ABCD"))}, "position of station 'A' is not finite"),
    "names": ({"stations": Stations(PLACE, tuple("ABCA"))}, "station name 'A' is used twice"),
    "axes": (
        {"stations": Stations(PLACE, tuple("ABCD"), axes=np.full((1, 4, 2, 2), 0.5))},
        "the axes of station 'A' are not unit vectors",
    ),
    "a station": ({"rows": (replace(RANGES, a=np.array([0, 1, 2, 4])),)}, "range row 3 has a = 4"),
    "a weight": ({"rows": (replace(RANGES, weight=np.array([1, 1, 2, 1.0])),)}, "weight outside 0 to 1"),
    "a correction": ({"rows": (replace(RANGES, correction=np.full(4, np.nan)),)}, "correction that is not finite"),
    "times": ({"times": np.array([1.0, 1.0])}, "epoch 1 is not later than epoch 0"),
    "noise": ({"noise": Noise(GOOD.noise.blocks * 2)}, "does not cover every row exactly once"),
    "a covariance": ({"noise": SKEW}, "the covariance in noise of row 0 is not symmetric"),
    "an order": ({"motions": (Motion(3),)}, "the motion has order 3"),
    "a prior": ({"priors": (Prior("position", np.zeros(3), np.eye(3)),)}, "do not fit"),
    "a speed": ({"constraints": speed(3.0)}, "speed needs a target that moves"),
    "bounds": (
        {"constraints": (*box([5.0, 0.0], [9.0, 9.0]), *box([0.0, 0.0], [4.0, 9.0]))},
        "at least 5 m and at most 4 m",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_meant_is_named(case):
    change, words = BAD[case]
    with pytest.raises(InvalidProblem, match=words):
        checked(replace(GOOD, **change))


def test_a_problem_in_order_stays_as_it_is():
    found = checked(GOOD)
    assert (found.rows, found.motions, found.stations) == (GOOD.rows, GOOD.motions, GOOD.stations)


def test_a_value_that_is_missing_passes_and_an_infinite_one_does_not():
    check_values(replace(RANGES, z=np.array([np.nan, 1.0, 2.0, 3.0])))
    with pytest.raises(InvalidProblem, match="range row 2 is infinite"):
        check_values(replace(RANGES, z=np.array([1.0, 2.0, -np.inf, 3.0])))


def test_two_unknowns_of_one_name_are_refused():
    clock = with_bias(GOOD, "clock").biases[0]
    with pytest.raises(InvalidProblem, match="the name 'position' is used twice"):
        check_unknowns(replace(GOOD, biases=(replace(clock, name="position"),)))

"""Arguments of constraints: units and refusals."""

import numpy as np
import pytest

from optloc import InvalidProblem, constraints
from optloc.linear.constraints.arguments import (
    check_order,
    direction_of,
    float_array,
    metres,
    numbers_of,
    point_of,
    radius_of,
    rate_of,
)


def test_lengths_have_units():
    assert metres("2 km", "x") == 2000.0
    assert radius_of("1 nmi", "x") == 1852.0
    assert point_of(["1 km", 5.0], (2,), "x").tolist() == [1000.0, 5.0]
    assert float_array(3).dtype == float
    assert numbers_of([[1, 2]], "x").shape == (1, 2)


def test_rates_have_units():
    assert rate_of("3 deg/s", "x", {"deg/s": np.pi / 180.0}) == pytest.approx(np.radians(3.0))
    assert rate_of(0.5, "x", {}) == 0.5
    assert float(constraints.acceleration("0.5 g")[0].upper) == pytest.approx(4.903325)


def test_a_normal_is_scaled_to_length_one():
    direction, length = direction_of([3.0, 4.0], "x")
    assert (direction.tolist(), length) == ([0.6, 0.8], 5.0)


BAD = {
    "limits": (lambda: check_order(2.0, 1.0, "x", "m"), "at least 2 m and at most 1 m"),
    "no number": (lambda: check_order(np.nan, 1.0, "x", "m"), "not a number"),
    "a centre in space": (lambda: constraints.disc([0.0, 0.0, 0.0], 5.0), "give 2 coordinates"),
    "an infinite centre": (lambda: constraints.ball([0.0, np.inf], 5.0), "not finite"),
    "no radius": (lambda: constraints.keep_out_disc([0.0, 0.0], 0.0), "the radius is 0 m"),
    "a point as a disc": (lambda: constraints.disc([0.0, 0.0], 1e-9), "so that the region is a point"),
    "an annulus inside out": (lambda: constraints.annulus([0.0, 0.0], 5.0, 4.0), "contradict each other"),
    "no direction": (lambda: constraints.half_plane([0.0, 0.0], 5.0), "no direction"),
    "a band inside out": (lambda: constraints.band([1.0, 0.0], 5.0, 4.0), "contradict each other"),
    "offsets": (lambda: constraints.polyhedron(np.eye(2), [1.0]), "1 offsets for normals"),
    "one point": (lambda: constraints.polyline([[0.0, 0.0]], 5.0), "no line"),
    "no tolerance": (lambda: constraints.polyline([[0.0, 0.0], [1.0, 1.0]], 0.0), "the tolerance is 0 m"),
    "a point twice": (lambda: constraints.polyline([[0, 0], [1, 1], [1, 1]], 5.0), "point 3 repeats point 2"),
    "a gap in a line": (lambda: constraints.polyline([[0, 0], [np.nan, 1]], 5.0), "not finite"),
    "a ground": (lambda: constraints.terrain([0, 1], [1, 0], np.eye(2)), "not ascending"),
    "a turn": (lambda: constraints.turn_rate("3 deg/min"), "no number with a unit"),
    "turns one way": (lambda: constraints.turn_rate(2.0, lower=1.0), "leave out a straight course"),
    "no acceleration": (lambda: constraints.acceleration(0.0), "give a positive number"),
    "itself": (lambda: constraints.separation(1, 1, 5.0), "no distance from itself"),
    "a quantity": (lambda: constraints.quantity("distanse"), "did you mean 'distance'"),
    "words": (lambda: constraints.polygon([["a", "b"]] * 3), "polygon"),
    "a slow top speed": (lambda: constraints.speed(2.0, lower=3.0), "contradict each other"),
}


@pytest.mark.parametrize("case", BAD)
def test_one_sentence_names_the_fault(case):
    state, words = BAD[case]
    with pytest.raises(InvalidProblem, match=words) as found:
        state()
    assert str(found.value).count(".") >= 1

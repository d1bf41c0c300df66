"""Emitters of an epoch as a value, and the density of false rows that are spread evenly."""

import numpy as np
import pytest

import optloc
from optloc import InvalidProblem
from optloc.multi_target import evenly


def test_false_rows_are_spread_over_what_is_possible():
    stations = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 300.0]])
    tdoa = optloc.measured("tdoa", [1.0, 2.0], a=[1, 2], b=0, sigma=1.0)
    problem = optloc.assemble(stations, tdoa, optloc.measured("azimuth", [0.1], a=0, sigma=0.01))
    density = evenly(problem, 0.9, 2.0).density
    assert density == {"tdoa": pytest.approx(2.0 / 400.0), "azimuth": pytest.approx(1.0 / np.pi)}
    with pytest.raises(InvalidProblem, match="false"):
        evenly(problem, 0.9, 0.0)
    with pytest.raises(InvalidProblem, match="range"):
        evenly(optloc.assemble(stations, optloc.measured("range", [1.0], a=0, sigma=1.0)), 0.9, 1.0)

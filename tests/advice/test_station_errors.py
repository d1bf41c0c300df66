"""Errors of one station are told apart over several epochs."""

import numpy as np
import pytest
from advice.cases import PLACES, TRUTHS, at, range_case

from optloc.advice.causes import causes_of
from optloc.base.units import SPEED_OF_LIGHT

RIGHT = np.linalg.norm(TRUTHS[:, None] - PLACES, axis=-1)
ELSEWHERE = PLACES + np.outer(at(2, 1.0), [300.0, -400.0])
EXCHANGED = PLACES[[0, 1, 5, 3, 4, 2, 6]]
ERRORS = {
    "drift": (np.outer(10.0 * np.arange(4), at(2, 4.0)), ("S2",)),
    "scale": (0.02 * RIGHT * at(2, 1.0), ("S2",)),
    "period": (at(2, 1e-3 * SPEED_OF_LIGHT) * np.ones((4, 1)), ("S2",)),
    "moved": (np.linalg.norm(TRUTHS[:, None] - ELSEWHERE, axis=-1) - RIGHT, ("S2",)),
    "swapped": (np.linalg.norm(TRUTHS[:, None] - EXCHANGED, axis=-1) - RIGHT, ("S2", "S5")),
}


@pytest.mark.parametrize("cause", ERRORS)
def test_the_error_of_a_station_is_named(cause):
    error, stations = ERRORS[cause]
    first = causes_of(range_case(error, epochs=4)[0])[0]
    assert (first.change.cause, first.change.station) == (cause, stations)

"""A change of some epochs, and the rows of stations and kinds."""

import numpy as np
from advice.cases import range_case

from optloc.advice.change import Change
from optloc.advice.wording import no_words


def test_arrays_of_epochs_are_selected():
    change = Change("unit", no_words, factor=np.arange(8.0).reshape(4, 2), shift=np.ones(2))
    part = change.in_epochs(np.array([3, 1]))
    assert part.factor.tolist() == [[6.0, 7.0], [2.0, 3.0]]
    assert part.shift.tolist() == [1.0, 1.0]


def test_rows_of_stations_and_their_coefficients():
    case, _ = range_case(epochs=2)
    assert np.flatnonzero(case.rows_at(3)).tolist() == [3]
    assert case.coefficients("station", "offset", "range", "S3").tolist() == [0.0, 0, 0, 1, 0, 0, 0]
    assert case.when[:, 0].tolist() == [0.0, 10.0]

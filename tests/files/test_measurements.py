"""Rows of a table in SI units: their kinds, signs, noise, and the covariances that are none."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files.measurements import Context, chunks_of, square
from optloc.files.schema import MeasurementsTable
from optloc.files.table import of_rows

STATIONS = ("A", "B", "C")


def chunks(rows, speed=SPEED_OF_LIGHT, **section):
    table = of_rows(rows, "rows", {})
    return chunks_of(Context(MeasurementsTable(**section), table, STATIONS, "rows", speed, True))


def test_nanoseconds_become_metres_and_a_turned_sign_turns_the_stations():
    rows = [{"a": "B", "b": "A", "z": 100.0, "sigma": 10.0}]
    (one,) = chunks(rows, kind="tdoa", unit="ns", speed=3e8)
    assert (one.z.tolist(), one.sigma.tolist()) == (pytest.approx([30.0]), pytest.approx([3.0]))
    (turned,) = chunks(rows, kind="tdoa", unit="ns", positive="b-farther")
    assert (turned.a.tolist(), turned.b.tolist()) == (one.b.tolist(), one.a.tolist())


def test_a_column_of_kinds_makes_one_chunk_of_each_in_order_of_appearance():
    rows = [
        {"kind": kind, "a": "A", "z": z, "sigma": 1.0} for kind, z in (("range", 1.0), ("height", 2.0), ("range", 3.0))
    ]
    found = chunks(rows)
    assert [(one.kind, one.row.tolist(), one.z.tolist()) for one in found] == [
        ("range", [0, 2], [1.0, 3.0]),
        ("height", [1], [2.0]),
    ]


def test_noise_is_given_once():
    with pytest.raises(InvalidProblem, match="more than once"):
        chunks([{"a": "A", "z": 1.0, "sigma": 1.0}], kind="range", arrival_sigma="2 m")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "empty"),
        ([[1.0, 2.0]], "has 2 numbers"),
        ([[1.0, 0.5], [0.4, 1.0]], "not symmetric"),
        ([[1.0, 0.0], [0.0, -1.0]], "not positive"),
        ([[1.0, 2.0], [2.0, 1.0]], "negative eigenvalue -1"),
    ],
)
def test_a_matrix_that_is_no_covariance_is_refused(rows, words):
    assert np.array_equal(square([[2.0, 1.0], [1.0, 2.0]], "here"), [[2.0, 1.0], [1.0, 2.0]])
    with pytest.raises(InvalidProblem, match=words):
        square(rows, "here")

"""Values of `locate` by station or pair: mappings, arrays and frames give the same values and the same ends."""

import numpy as np
import pandas as pd
import pytest

from optloc import InvalidProblem
from optloc.files.by_station import ARGUMENTS, station_values
from optloc.models import MODELS

NAMES = ["A", "B", "C"]


@pytest.mark.parametrize(
    "given",
    [
        {"B": 2.0, "C": 3.0},
        [2.0, 3.0],
        [0.0, 2.0, 3.0],
        pd.Series([2.0, 3.0], ["B", "C"]),
        {("B", "A"): 2.0, "C-A": 3.0},
    ],
    ids=["mapping", "without the reference", "with the reference", "series", "pairs"],
)
def test_differences_are_counted_from_the_first_station_in_every_form(given):
    found = station_values("tdoa", given, NAMES, None)
    assert found.keys == [(1, 0), (2, 0)]
    assert found.values.tolist() == [2.0, 3.0]


def test_a_frame_with_a_column_for_each_station_is_a_batch():
    found = station_values("ranges", pd.DataFrame({"C": [1.0, 2.0], "A": [3.0, None]}), NAMES, None)
    assert found.keys == [(2, -1), (0, -1)]
    assert np.array_equal(found.values, [[1.0, 3.0], [2.0, np.nan]], equal_nan=True)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"D": 1.0}, "no station 'D'"),
        ([1.0], "1 values for 3 stations"),
        ({"A": [1.0, 2.0], "B": [1.0]}, "more values"),
    ],
)
def test_values_of_no_station_are_refused(given, words):
    with pytest.raises(InvalidProblem, match=words):
        station_values("ranges", given, NAMES, None)


def test_every_argument_is_a_kind_with_its_unit():
    assert all(argument.kind in MODELS for argument in ARGUMENTS.values())


@pytest.mark.parametrize("word", sorted(ARGUMENTS))
def test_integers_of_a_long_frame_are_the_values_of_the_table(word):
    """Only times of arrival have a free origin: a shift of other values moves the fix."""
    frame = pd.DataFrame({"station": ["B", "C", "A"], "value": [50, 60, 70]})
    found, exact = (
        station_values(word, frame.astype({"value": number}), ["A", "B", "C"], "A").values for number in (int, float)
    )
    np.testing.assert_array_equal(found - exact, found[0] - exact[0])
    assert found[0] == exact[0] or word == "toa"


def test_rows_of_a_long_frame_are_grouped_by_any_word_for_a_message():
    frame = pd.DataFrame({"event": ["e2", "e2", "e1", "e1"], "station": ["A", "B"] * 2, "range": [1.0, 2.0, 3.0, 4.0]})
    found = station_values("ranges", frame, NAMES, None)
    assert found.labels == (["e2", "e1"], ("event",))
    assert found.values.tolist() == [[1.0, 2.0], [3.0, 4.0]]

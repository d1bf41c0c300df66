"""Tables as they were read: cells as numbers, labels and times, places in messages, and rows by epoch."""

import numpy as np
import pandas as pd
import pytest

from optloc import InvalidProblem
from optloc.files.table import Keys, csv, epochs_of, need_clock, of_frame, of_rows, parquet


def test_rows_frames_and_files_hold_the_same_cells(tmp_path):
    frame = pd.DataFrame({"name": ["A", "B"], "z": [1.5, 2.5]})
    frame.to_csv(tmp_path / "t.csv", index=False)
    frame.to_parquet(tmp_path / "t.parquet")
    rows = of_rows(frame.to_dict("records"), "rows", {})
    for table in (
        rows,
        of_frame(frame, "frame", {}),
        csv(tmp_path / "t.csv", None, {}),
        parquet(tmp_path / "t.parquet", {}),
    ):
        assert list(table.labels("name")) == ["A", "B"]
        assert table.numbers("z").tolist() == [1.5, 2.5]


@pytest.mark.parametrize(
    ("cell", "words"), [("x", "'x' is not a number"), ("", "empty"), ("1_000", "not a number"), ("inf", "not a finite")]
)
def test_a_cell_without_a_number_is_named_by_row_and_column(cell, words):
    table = of_rows([{"z": "1"}, {"z": cell}], "t.csv", {})
    with pytest.raises(InvalidProblem, match=words) as refused:
        table.numbers("z")
    assert "row 2" in refused.value.where
    assert "'z'" in refused.value.where


def test_rows_that_were_taken_keep_their_numbers_in_messages():
    table = of_rows([{"z": k} for k in range(5)], "t.csv", {}).take(np.array([3, 4]))
    assert table.numbers("z").tolist() == [3.0, 4.0]
    assert table.at(0) == "t.csv, row 4"


def test_dates_are_seconds_since_1970_and_numbers_are_scaled():
    dates = of_rows([{"t": "1970-01-01T00:00:01Z"}, {"t": "1970-01-01T01:00:02+01:00"}], "t.csv", {})
    assert dates.times("t", 1.0) == pytest.approx([1.0, 2.0])
    assert of_rows([{"t": 3}], "t.csv", {}).times("t", 1e-3).tolist() == [0.003]


def keys(label=None, time=None, target=None):
    text = [None if given is None else np.array(given, dtype=object) for given in (label, target)]
    time = None if time is None else np.array(time)
    return Keys(text[0], time, None if time is None else time.astype(str).astype(object), text[1])


def test_labels_that_are_numbers_go_by_size_and_others_as_they_appear():
    assert epochs_of(keys(["10", "2", "10"]), 3, None, None).labels == ("2", "10")
    assert epochs_of(keys(["b", "a"]), 2, None, None).labels == ("b", "a")


def test_a_window_joins_rows_by_time():
    found = epochs_of(keys(time=[0.0, 0.4, 1.2, 2.9]), 4, 1.0, None)
    assert found.index.tolist() == [0, 0, 1, 2]
    assert found.times == pytest.approx([0.2, 1.2, 2.9])
    assert found.clock is found.times


def test_free_targets_have_epochs_of_their_own():
    both = keys(["1", "1", "2"], target=["a", "b", "a"])
    free, bound = epochs_of(both, 3, None, True), epochs_of(both, 3, None, False)
    assert (free.count, free.targets, free.own) == (3, ("a", "b", "a"), True)
    assert (bound.count, bound.targets, bound.target.tolist()) == (2, ("a", "b"), [0, 1, 0])


def test_a_clock_needs_times_that_increase():
    assert need_clock(epochs_of(keys(time=[3.0, 5.0]), 2, None, None), "motion", "x").tolist() == [3.0, 5.0]
    with pytest.raises(InvalidProblem, match="needs the time"):
        need_clock(epochs_of(keys(["a", "b"]), 2, None, None), "motion", "x")

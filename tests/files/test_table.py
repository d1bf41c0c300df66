"""Tables as they were read: cells as numbers, labels and times, places in messages, and rows by epoch."""

import numpy as np
import pandas as pd
import pytest

from optloc import InvalidProblem
from optloc.files.table import csv, number_advice, of_frame, of_rows, parquet


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


def test_a_decimal_comma_has_its_next_step():
    table = of_rows([{"z": "55,2"}, {"z": "1,234.5"}], "rows", {})
    with pytest.raises(
        InvalidProblem, match=r"'55,2' is not a number; write decimal points in all cells, such as 55.2"
    ):
        table.numbers("z")
    assert number_advice("1,234.5", "give a number") == "give a number"


def test_rows_that_were_taken_keep_their_numbers_in_messages():
    table = of_rows([{"z": k} for k in range(5)], "t.csv", {}).take(np.array([3, 4]))
    assert table.numbers("z").tolist() == [3.0, 4.0]
    assert table.at(0) == "t.csv, row 4"


def test_dates_are_seconds_since_1970_and_numbers_are_scaled():
    dates = of_rows([{"t": "1970-01-01T00:00:01Z"}, {"t": "1970-01-01T01:00:02+01:00"}], "t.csv", {})
    assert dates.times("t", 1.0) == pytest.approx([1.0, 2.0])
    assert of_rows([{"t": 3}], "t.csv", {}).times("t", 1e-3).tolist() == [0.003]

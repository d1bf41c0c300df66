"""Written tables and TOML, read back by pandas and tomllib."""

import tomllib

import numpy as np
import pandas as pd
import pytest

from optloc.files.writer import GrowingTable, harmless, toml_text, write_csv


def test_toml_is_read_back_as_it_was():
    settings = {
        "title": 'a "b" \\ ü', "n": 3, "x": 0.1, "on": True, "list": [1.5, 2.5], "none": None,
        "table": {"key with space": 1e-300, "inner": {"a": ["x"]}}, "rows": [{"a": 1}, {"a": 2, "b": {"c": 3}}],
    }  # fmt: skip
    expected = {key: value for key, value in settings.items() if value is not None}
    assert tomllib.loads(toml_text(settings)) == expected


def test_numbers_keep_all_digits_and_nan_is_an_empty_cell(tmp_path):
    path, values = tmp_path / "t.csv", np.array([0.1, np.nan, 1 / 3, 1e-17])
    write_csv(path, {"z": values, "k": range(4)})
    assert np.array_equal(pd.read_csv(path).z.to_numpy(), values, equal_nan=True)
    assert path.read_text().splitlines()[2] == ",1"


@pytest.mark.parametrize(
    ("text", "cell"), [("=1+1", "'=1+1"), ("@x", "'@x"), ("-A", "'-A"), ("-3.5", "-3.5"), ("A=1", "A=1"), ("", "")]
)
def test_text_that_a_spreadsheet_would_compute_is_made_harmless(text, cell):
    assert harmless(text) == cell


def test_a_growing_table_has_one_header_and_all_rows(tmp_path):
    table = GrowingTable(tmp_path / "g.csv")
    for k in range(3):
        table.add({"k": [k], "name": ["=x"]})
    assert table.rows == 3
    table.file.finish()
    found = pd.read_csv(tmp_path / "g.csv")
    assert found.k.tolist() == [0, 1, 2]
    assert set(found.name) == {"'=x"}

"""Files of other programs as tables: nested records, lists in cells, JSON lines and logs."""

import json

import pytest

from optloc import InvalidProblem
from optloc.files.csv_formats import read_table, records, with_lists
from optloc.files.table import of_rows


def cells(table):
    return {name: column.tolist() for name, column in ((key, table.raw(key)) for key in table.columns)}


def test_lists_of_objects_are_rows_with_the_values_around_them():
    found = records([{"t": 5, "heard": [{"rx": "A", "ns": 1}, {"rx": "B", "ns": 2}]}, {"t": 6, "heard": []}], "x")
    assert cells(found) == {"t": [5, 5, 6], "rx": ["A", "B", None], "ns": [1, 2, None]}


def test_nested_names_are_joined_and_lists_of_coordinates_are_axes():
    found = records({name: {"position_m": [x, 2.0], "at": {"t": 7}} for name, x in (("A", 1.0), ("B", 3.0))}, "x")
    assert cells(found) == {"name": ["A", "B"], "x_m": [1.0, 3.0], "y_m": [2.0, 2.0], "at_t": [7, 7]}


def test_lists_of_equal_length_are_columns_and_others_are_refused():
    assert cells(records([{"rx": ["A", "B"], "ns": [1, 2]}], "x")) == {"rx": ["A", "B"], "ns": [1, 2]}
    with pytest.raises(InvalidProblem, match="different lengths: rx has 2, ns has 1"):
        records([{"rx": ["A", "B"], "ns": [1]}], "x")


def test_a_cell_that_spells_a_list_is_rows():
    table = of_rows([{"id": "m", "rx": "['A', 'B']", "ns": "[1, 2]"}], "x", {})
    assert cells(with_lists(table)) == {"id": ["m", "m"], "rx": ["A", "B"], "ns": [1, 2]}


def test_lines_of_json_are_one_table_and_unknown_files_are_refused(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text("\n".join(json.dumps({"rx": name, "ns": k}) for k, name in enumerate("AB")))
    assert read_table(path).raw("rx").tolist() == ["A", "B"]
    other = tmp_path / "log.xlsx"
    other.write_bytes(b"PK")
    with pytest.raises(InvalidProblem, match=r"type '\.xlsx' are unknown"):
        read_table(other)

"""Tables with stations in their rows, and the epochs of their rows."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.files.roles import ColumnPlaces, Roles
from optloc.files.shapes import epochs_of, read_inline, read_long, read_wide
from optloc.files.table import of_rows
from optloc.files.table_import import ColumnHints, named_columns, sort_named

PLACES = ColumnPlaces({"name": np.array(["A", "B"], dtype=object), "x": np.zeros(2), "y": np.zeros(2)}, "cartesian")


def test_a_station_that_is_elsewhere_is_another_one():
    rows = [{"station": "A", "x": x, "y": 0.0, "range_m": 1.0} for x in (0.0, 5.0, 0.0)]
    place, heard = read_inline(Roles.of(of_rows(rows, "t.csv", {}), {}), ColumnHints())
    assert heard.tolist() == ["A", "A (2)", "A"]
    assert place.columns["x"].tolist() == [0.0, 5.0]


def test_long_and_wide_tables_hold_the_same_readings():
    told = ColumnHints(sigma="1 m")
    tidy = Roles.of(of_rows([{"station": n, "range_m": r} for n, r in (("A", 3.0), ("B", 4.0))], "t.csv", {}), {})
    form = sort_named("range")
    by_row = read_long(tidy, form, told, PLACES, None, [form])
    flat = of_rows([{"range_A_m": 3.0, "range_B_m": 4.0}], "t.csv", {})
    columns = named_columns(list(flat.columns), ["A", "B"])
    (by_column,) = read_wide(Roles.of(flat, {}, list(flat.columns)), told, columns, PLACES)
    for found in (by_row, by_column):
        assert found.a.tolist() == ["A", "B"]
        assert found.values.floats().tolist() == [3.0, 4.0]
        assert (found.form.kind, found.unit) == ("range", "m")


def test_rows_of_one_message_are_one_epoch_and_a_window_needs_times():
    rows = [{"message": k, "station": n, "range_m": 1.0} for k in (7, 9) for n in "AB"]
    roles, form = Roles.of(of_rows(rows, "t.csv", {}), {}), sort_named("range")
    found = [read_long(roles, form, ColumnHints(sigma="1 m"), PLACES, None, [form])]
    assert list(epochs_of(roles, ColumnHints(), found)["epoch"]) == ["7", "7", "9", "9"]
    with pytest.raises(InvalidProblem, match="column of times"):
        epochs_of(roles, ColumnHints(window="1 s"), found)

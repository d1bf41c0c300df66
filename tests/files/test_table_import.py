"""Readings of tables: columns that name receivers, units, marks of missing values, and words of options."""

from decimal import Decimal

import pytest

from optloc import InvalidProblem
from optloc.files.table import of_rows
from optloc.files.table_import import (
    ColumnHints,
    in_unit,
    marks_of,
    named_columns,
    sigmas_by_kind,
    sort_named,
    unused_measurement,
    without_ignored_columns,
)
from optloc.models import MODELS


def test_columns_of_receivers_name_one_station_or_two_and_no_other_word():
    found = named_columns(
        ["toa_north_ns", "north - south", "range_south_sigma_m", "north_serial", "note"], ["north", "south"]
    )
    assert [(one.column, one.ends, one.minus, one.sigma) for one in found] == [
        ("toa_north_ns", ("north",), False, False),
        ("north - south", ("north", "south"), True, False),
        ("range_south_sigma_m", ("south",), False, True),
    ]
    assert [one.form for one in found] == ["arrivals", None, "range"]


def test_units_are_converted_with_all_digits():
    ranges = sort_named("range")
    assert in_unit(Decimal("1.234567890123456789"), "km", "m", ranges) == Decimal("1234.567890123456789")
    assert in_unit(Decimal("0.1"), "us", "ns", ranges) == Decimal(100)
    with pytest.raises(InvalidProblem, match="some columns are in ns, others in m"):
        in_unit(Decimal(1), "ns", "m", ranges)


def test_marks_of_missing_values_are_numbers_or_none():
    assert marks_of(ColumnHints()) is None
    assert marks_of(ColumnHints(missing="none")) == frozenset()
    assert marks_of(ColumnHints(missing="-1, 9999")) == {Decimal(-1), Decimal(9999)}
    with pytest.raises(InvalidProblem, match="not a list of numbers"):
        marks_of(ColumnHints(missing="zero"))


def test_sigmas_of_several_kinds_are_told_apart():
    assert sigmas_by_kind("range=6 m, bearing=2 deg") == {"range": "6 m", "azimuth": "2 deg"}


def test_a_column_may_measure_if_its_name_is_that_of_a_kind():
    assert unused_measurement("range_m") == MODELS["range"].summary
    assert unused_measurement("range_sigma_m") is None
    assert unused_measurement("comment") is None
    assert unused_measurement("azimuth_deg", lengths=True) is None


def test_an_ignored_column_is_left_out_and_an_unknown_one_is_refused():
    table = of_rows([{"a": 1, "note": "x"}], "t.csv", {})
    assert list(without_ignored_columns(table, ["note"]).columns) == ["a"]
    with pytest.raises(InvalidProblem, match="no column 'nota'"):
        without_ignored_columns(table, ["nota"])

"""Columns that are not used: harmless ones are listed, and those that may hold measurements are refused."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.files.cell_text import Decimals
from optloc.files.reading_report import check_receivers, farther_station, unused_columns
from optloc.files.roles import Roles
from optloc.files.table import of_rows
from optloc.files.table_import import Readings, named_columns, sort_named


def test_unused_columns_are_listed_unless_they_may_be_measured():
    table = of_rows([{"station": "A", "range_m": 5.0, "note": "x", "azimuth_deg": 3.0}], "t.csv", {})
    roles = Roles.of(table, {})
    with pytest.raises(InvalidProblem, match="azimuth_deg"):
        unused_columns(roles, {"station": "station", "range_m": "range"})
    assert unused_columns(roles, {"station": "station", "range_m": "range", "azimuth_deg": "azimuth"}) == ["note"]


def test_a_column_named_like_those_of_receivers_must_name_a_station():
    table = of_rows([{"toa_A1_ns": 1.0, "toa_A2_ns": 2.0, "toa_A3_ns": 3.0, "toa_A2_note": "x"}], "t.csv", {})
    named = named_columns(list(table.columns), ["A1", "A2"])
    uses = {"toa_A1_ns": "toa", "toa_A2_ns": "toa"}
    with pytest.raises(InvalidProblem, match="no station 'A3'"):
        check_receivers(table, uses, named, ["A1", "A2"])
    check_receivers(table, uses | {"toa_A3_ns": "toa"}, named, ["A1", "A2"])


@pytest.mark.parametrize(("kind", "positive", "which"), [
    ("tdoa", "a-farther", "first"), ("tdoa", "b-farther", "second"),
    # A level is higher at the nearer station.
    ("rss_difference", "a-farther", "second"), ("rss_difference", "b-farther", "first"),
])  # fmt: skip
def test_the_farther_station_follows_from_the_sign_and_the_quantity(kind, positive, which):
    none = np.zeros(0, dtype=int)
    found = Readings(sort_named(kind), "m", Decimals.of([]), none, (), none, none, none, positive)
    assert farther_station(found) == which

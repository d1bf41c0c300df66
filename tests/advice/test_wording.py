"""Names and numbers in advice."""

from dataclasses import replace

import numpy as np
import pytest
from advice.cases import range_case

from optloc.advice.wording import bias_lines, quoted, row_name, size_text, station_lines
from optloc.problem.written import Written


def test_names_are_quoted_for_toml():
    assert quoted('a "b" \\c') == '"a \\"b\\" \\\\c"'


def test_angles_are_in_degrees_and_scales_in_percent():
    assert size_text(0.0174532925, 0.00174532925, "rad") == "+1 ± 0.1 deg"
    assert size_text(0.02, 0.001, "") == "+2 ± 0.1 %"


def test_rows_are_counted_from_one():
    case, _ = range_case(epochs=2)
    assert row_name(case, 1, 3) == "the range of S3 at t = 10 s (row 11)"


def test_a_bias_has_the_lines_of_a_file():
    lines = bias_lines(range_case()[0], "offset", "station", "range", ("S1",))
    assert lines.splitlines()[0] == "[[biases]]"
    assert 'members = ["S1"]' in lines


@pytest.mark.parametrize(
    ("unit", "keys", "sigma", "row"),
    [
        (1.0, ("x", "y"), 0.0, "x = 10.0, y = -20.5 "),
        (1000.0, ("x", "y"), 0.0, "x = 0.01, y = -0.0205 "),
        (1.0, ("x", "y"), 3000.0, "x = 10.0, y = -20.0 "),
    ],
)
def test_rows_of_stations_are_in_the_unit_of_the_file(unit, keys, sigma, row):
    case, _ = range_case()
    base = replace(case.base, written=Written(place_unit=unit, place_keys=keys))
    lines = station_lines(replace(case, base=base), {2: np.array([10.0, -20.5])}, sigma)
    assert lines == f'[stations]\nrows = [\n  {{ name = "S2", {row}}},\n]\n'


def test_rows_of_stations_of_another_file_are_unknown():
    case, _ = range_case()
    assert station_lines(case, {2: np.zeros(2)}) == ""

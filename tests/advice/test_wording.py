"""Names and numbers in advice."""

from advice.cases import range_case

from optloc.advice.wording import bias_lines, quoted, row_name, size_text


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

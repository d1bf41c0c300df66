"""Numbers and states as text: rounded to their errors, and no radius where it is not valid."""

import numpy as np
import pytest
from show.answers import singles
from show.ranging import ranged

from optloc.show.answer_texts import (
    NOT_DETERMINED,
    as_p,
    frame_rows,
    height_text,
    latlon_texts,
    length_text,
    lengths,
    place_rows,
    region_rows,
    rounded,
    sure_rows,
    with_sigma,
)
from optloc.show.columns import fix_columns


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (1234.5678, 12.3, "1235 ± 12 m"),
        (1.23456, 0.0123, "1.235 ± 0.012 m"),
        (-0.001, 0.5, "0.00 ± 0.50 m"),
        (5.0, 0.0, "5 m (held)"),
        (5.0, np.inf, "5 m"),
    ],
)
def test_a_number_is_rounded_to_its_error(value, sigma, text):
    assert with_sigma(value, sigma, "m") == text


def test_zero_has_no_sign_and_rounding_errors_are_zero():
    assert rounded(-0.0001, 2) == "0.00"
    assert lengths([1.0, 1e-9]) == ["1", "0"]


def test_a_p_value_is_short_and_absent_without_redundancy():
    assert as_p(np.nan) == "-"
    assert float(as_p(0.25)) == 0.25


def test_on_earth_latitude_longitude_and_height_come_first():
    _, fix = ranged()
    columns = fix_columns(fix)
    assert [label for label, _ in place_rows(columns, 0)] == ["latitude", "longitude", "height"]
    assert dict(frame_rows(columns, 0))["x"] == with_sigma(fix.position[0], fix.sigma()[0], "m")
    assert [label for label, _ in place_rows(fix_columns(singles()["ok in a plain frame"]), 0)] == ["x", "y"]


@pytest.mark.parametrize(
    ("north", "up", "latitude", "height"),
    [
        (120.0, 31.0, "48.12346", "132"),
        (3.1, 3.1, "48.123457", "132.1"),
        (0.031, 0.31, "48.12345679", "132.12"),
        (np.inf, np.inf, "48.123457", "132.1"),
    ],
)
def test_coordinates_on_earth_are_rounded_to_their_errors(north, up, latitude, height):
    assert latlon_texts(48.123456789, 8.0, (2 * north, north))[0] == latitude
    assert height_text(132.1234, up) == f"{height} m"


def test_a_held_height_has_the_digits_that_were_given():
    assert height_text(120.125 + 2e-9, 1e-9) == "120.125 m (held)"
    assert height_text(-2e-9, 0.0) == "0 m (held)"
    assert latlon_texts(1.0, 2.0, (1e-9, 3.0)) == ["1.000000", "2.000000"]


def test_an_alternative_without_errors_shows_decimetres():
    assert latlon_texts(48.123456789, 8.0) == ["48.123457", "8.000000"]
    assert length_text(-0.001) == "0.0"


def test_a_coordinate_that_is_not_determined_has_no_number():
    columns = fix_columns(ranged()[1]) | {"undetermined": np.array(["x; east"], dtype=object)}
    assert dict(place_rows(columns, 0))["longitude"] == NOT_DETERMINED
    assert dict(frame_rows(columns, 0))["x"] == NOT_DETERMINED
    assert "sigma north" in dict(sure_rows(columns, 0))


def test_a_radius_has_a_condition_unless_the_status_confirms_the_position():
    found = {name: dict(sure_rows(fix_columns(fix), 0)).get("95 % radius") for name, fix in singles().items()}
    assert found["ok on Earth"] == "3.49 m"
    assert found["ambiguous on Earth"].endswith("vertical ± 3.82 m), if this position is correct")
    assert found["ambiguous in a plain frame"] == "4.19 m, if this position is correct"
    assert found["misfit on Earth"].startswith("not valid")
    assert found["unbounded on Earth"] is None


def test_the_regions_of_data_sheets_need_a_valid_covariance():
    assert [label for label, _ in region_rows(fix_columns(ranged()[1]), 0)] == ["95 % ellipse", "CEP50, CEP95"]
    assert region_rows(fix_columns(singles()["unbounded on Earth"]), 0) == []

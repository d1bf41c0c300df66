"""Amounts with units, and places for messages."""

import pytest

from optloc import InvalidProblem
from optloc.files.settings import Units, join


def test_an_amount_is_a_number_with_its_unit():
    assert Units("length").plain("30 ns", None, "here") == pytest.approx(30e-9 * 299792458.0)
    assert Units("length", speed=340.0).plain("2 s", None, "here") == pytest.approx(680.0)
    assert Units("length").plain(2.0, "km", "here") == 2000.0
    for value, words in (("30", "has no unit"), ("soon", "is no amount"), ("1e300 m", "is beyond"), ("3 deg", "deg")):
        with pytest.raises(InvalidProblem, match=words):
            Units("length").plain(value, None, "here")


def test_places_are_joined_from_the_file_inwards():
    assert join("x.toml", None, "[frame]", "") == join("x.toml", "[frame]")
    assert join("x.toml", "[frame]").startswith("x.toml")

"""The speed that a problem file states: light, sound by temperature, layers; and which units depend on it."""

import pytest

from optloc import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files.propagation import is_time, medium_in, speed_of
from optloc.files.schema import validate
from optloc.files.settings import Units

REST = {"format": 2, "stations": {"file": "s.csv"}, "measurements": [{"kind": "range", "file": "r.csv"}]}


def file(**given):
    return validate(REST | given, "x.toml")


def test_light_is_the_speed_of_a_file_that_names_none():
    assert speed_of(file(), "x.toml") == SPEED_OF_LIGHT
    assert speed_of(file(propagation_speed="1.5 km/s"), "x.toml") == 1500.0


def test_sound_in_air_is_faster_where_it_is_warm():
    cold, warm = (speed_of(file(propagation_speed={"medium": "air", "celsius": t}), "x.toml") for t in (0.0, 20.0))
    # Cramer 1993: 331.3 m/s at 0 degrees, and the root of the absolute temperature.
    assert cold == pytest.approx(331.3, abs=0.5)
    assert warm / cold == pytest.approx((293.15 / 273.15) ** 0.5, rel=2e-3)


def test_layers_are_read_in_the_units_of_their_table():
    table = {"kind": "layers", "depths": [0.0, 1.0], "speeds": [5.0, 6.0], "unit": "km", "speed_unit": "km/s"}
    found = medium_in(file(medium=table), "x.toml")
    assert (found.depth, found.speed) == ((0.0, 1000.0), (5000.0, 6000.0))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"propagation_speed": "-3 m/s"}, "not positive"),
        ({"propagation_speed": {"medium": "air", "celsius": 20.0, "salinity": 35.0}}, "no salinity"),
        ({"medium": {"kind": "layers", "depths": [0.0]}}, "needs speeds"),
        ({"medium": {"kind": "atmosphere"}, "propagation_speed": 3e8}, "determines the speed"),
    ],
)
def test_contradicting_speeds_are_refused(given, words):
    with pytest.raises(InvalidProblem, match=words):
        speed_of(file(**given), "x.toml")


def test_only_lengths_in_units_of_time_depend_on_the_speed():
    assert is_time(Units("length"), "ns", "here")
    assert not is_time(Units("length"), "km", "here")
    assert not is_time(Units("angle"), "deg", "here")

"""Texts of a wave speed, profiles, winds and options that replace statements of a file."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.base.sound import sound_in_air, sound_in_water
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files.schema import validate
from optloc.files.wave_speed import (
    WaveOptions,
    is_profile,
    profile_of,
    stated_speed,
    wind_of,
    with_options,
    with_profile,
)

FORMS = {
    "343": (343.0, None),
    "343 m/s": (343.0, None),
    "1.2 km/s": (1200.0, None),
    "343+-5 m/s": (343.0, 5.0),
    "343±5 m/s": (343.0, 5.0),
    "343 m/s +/- 5 m/s": (343.0, 5.0),
    "0.343 km/s ± 5 m/s": (343.0, 5.0),
    "343 m/s ± 2 %": (343.0, 6.86),
    "air:20C": (sound_in_air(20.0), None),
    "air: -5 °C": (sound_in_air(-5.0), None),
    "air:20C,50%": (sound_in_air(20.0, 50.0), None),
    "water:8C,35,50m": (sound_in_water(8.0, 35.0, 50.0), None),
    "water:8C,0": (sound_in_water(8.0, 0.0), None),
    "light": (SPEED_OF_LIGHT, None),
}


@pytest.mark.parametrize(("text", "expected"), FORMS.items())
def test_every_form_is_read_and_named(text, expected):
    found = stated_speed(text, "--wave-speed")
    if text != "0.343 km/s ± 5 m/s":
        assert found.speed == pytest.approx(expected[0])
    assert (found.sigma is None) == (expected[1] is None)
    assert found.sigma is None or found.sigma == pytest.approx(expected[1])
    assert "m/s" in found.words


def test_the_units_of_the_speed_and_of_its_deviation_may_differ():
    found = stated_speed("0.343 km/s ± 5 m/s", "here")
    assert (found.speed, found.sigma) == pytest.approx((343.0, 5.0))


WRONG = {
    "air:200C": "temperature of air is 200",
    "air:20C,120%": "humidity is 120",
    "air:20C,50": "'50' of 'air:20C,50'",
    "air:20F": "'20F'",
    "air:20C,50%,3": "has 3 values",
    "water:8C": "salinity of the water is missing",
    "water:8C,35,50m,3": "has 4 values",
    "water:8C,35,20km": "'20km'",
    "fire:3": "no medium 'fire'",
    "fast": "no wave speed",
    "343 ns": "not a unit of speed",
    "28C": 'name the medium, such as "air:28C"',
    "343 Hz": "not a unit of speed",
    "-3 m/s": "not positive",
    "343+-0 m/s": "not positive",
    "343+-5+-2": "two standard deviations",
}


@pytest.mark.parametrize(("text", "words"), WRONG.items())
def test_other_texts_are_refused_in_one_sentence(text, words):
    with pytest.raises(InvalidProblem, match=words) as caught:
        stated_speed(text, "--wave-speed")
    assert caught.value.where == "--wave-speed"
    assert len(str(caught.value)) <= 200


@pytest.mark.parametrize(
    "text",
    [
        "depth_m,speed_m_s\n0,1500\n100,1490\n",
        "height,c\n0,1500\n-100,1490\n",
        "depth_km,speed_km_s\n0,1.5\n0.1,1.49\n",
        "z_m;sound_speed\n-100;1490\n0;1500\n",
    ],
)
def test_a_profile_has_depths_or_heights(tmp_path, text):
    path = tmp_path / "profile.csv"
    path.write_text(text)
    assert is_profile(str(path))
    found = profile_of(str(path), "--wave-speed")
    assert found.depths == pytest.approx([0.0, 100.0])
    assert found.speeds == pytest.approx([1500.0, 1490.0])


@pytest.mark.parametrize(("text", "words"), [("x,speed\n0,3\n", "no column depth_m"), ("depth,x\n0,3\n", "speed_m_s")])
def test_a_profile_without_its_columns_is_refused(tmp_path, text, words):
    path = tmp_path / "profile.csv"
    path.write_text(text)
    with pytest.raises(InvalidProblem, match=words):
        profile_of(str(path), "--wave-speed")


def document(**more):
    """Return a problem file with keys at its top."""
    rows = {"stations": {"rows": [{"name": "A", "x": 0.0, "y": 0.0}]}, "measurements": [{"kind": "range", "rows": []}]}
    return validate({"format": 2} | rows | more, "x.toml")


def test_a_file_may_name_a_profile_in_its_folder(tmp_path):
    (tmp_path / "profile.csv").write_text("depth_m,speed_m_s\n0,1500\n100,1490\n")
    file = with_profile(document(propagation_speed="profile.csv"), tmp_path, "x.toml")
    assert file.propagation_speed is None
    assert file.medium.speeds == [1500.0, 1490.0]
    layers = {"kind": "layers", "depths": [0.0, 9.0], "speeds": [1.0, 2.0]}
    with pytest.raises(InvalidProblem, match="speed is given twice"):
        with_profile(document(propagation_speed="profile.csv", medium=layers), tmp_path, "x.toml")


def test_options_replace_the_statements_of_a_file():
    layers = {"kind": "layers", "depths": [0.0, 9.0], "speeds": [1.0, 2.0]}
    file = with_options(document(medium=layers), WaveOptions("air:20C", "5,0", True, "2 ms"))
    assert (file.propagation_speed, file.wind, file.medium) == ("air:20C", "5,0", None)
    assert (file.measurements[0].two_way, file.measurements[0].turn_around) == (True, "2 ms")
    assert with_options(file, None) is file
    assert with_options(file, WaveOptions()) is file
    with pytest.raises(InvalidProblem, match=r"--wave-speed: .*no wave speed"):
        with_options(file, WaveOptions("fast"))
    lines = document(measurements=[{"kind": "azimuth", "rows": []}])
    with pytest.raises(InvalidProblem, match="--turn-around: the file has no ranges"):
        with_options(lines, WaveOptions(turn_around="2 ms"))


def test_a_wind_comes_from_a_direction_or_has_components():
    assert wind_of("5 m/s from 270", "--wind") == pytest.approx((5.0, 0.0))  # from the west, towards the east
    assert wind_of("18 km/h from 0 deg", "--wind") == pytest.approx((0.0, -5.0))
    assert wind_of("3,-4", "--wind") == (3.0, -4.0)
    assert wind_of([3.0, -4.0], "--wind") == (3.0, -4.0)
    for text in ("west", "5 from", "5 m/s from west", "1,2,3,4", "nan,0"):
        with pytest.raises(InvalidProblem, match="is not a wind"):
            wind_of(text, "--wind")
    assert np.hypot(*wind_of("10 kn from 33", "--wind")) == pytest.approx(5.1444, abs=1e-3)

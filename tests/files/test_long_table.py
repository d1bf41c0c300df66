"""Problems from tables in long form; the reader has most of the tests."""

import numpy as np
import pytest

import optloc
from optloc.files.long_table import from_table

PLACES = {"A": (0.0, 0.0), "B": (0.0, 20.0), "C": (20.0, 20.0), "D": (20.0, 0.0)}


def test_a_profile_is_the_medium_of_a_table(tmp_path):
    path = tmp_path / "profile.csv"
    path.write_text("depth_m,speed_m_s\n0,1500\n100,1490\n")
    places = {name: (*place, -5.0) for name, place in PLACES.items()}
    table = {"a": list(places), "z": [1.0, 1.001, 1.002, 1.003]}
    problem = from_table(table, places, kind="toa", unit="s", sigma="0.1 ms", wave_speed=str(path))
    assert problem.medium == optloc.models.Layers((0.0, 100.0), (1500.0, 1490.0))


def test_two_way_times_are_options_of_the_rows():
    table = {"a": list(PLACES), "z": [10.0, 20.0, 30.0, 40.0]}
    stated = {"kind": "range", "unit": "ms", "sigma": "0.1 ms", "wave_speed": 1500.0}
    problem = from_table(table, PLACES, **stated, two_way=True, turn_around="2 ms")
    assert problem.z == pytest.approx(0.5 * 1500.0 * (np.array([8.0, 18.0, 28.0, 38.0]) * 1e-3))

"""Tables of constraints: keys in Python, and the same table as one line of text."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.files.constraint_kinds import CONSTRAINT_KINDS, check_keys
from optloc.files.constraint_table import ConstraintTable, constraint_of_text, constraint_table


@pytest.mark.parametrize("kind", CONSTRAINT_KINDS)
def test_the_example_of_each_kind_is_valid(kind):
    found = constraint_of_text(CONSTRAINT_KINDS[kind].example, "--constraint")
    assert found.kind == kind
    check_keys(kind, found.given, "--constraint")


def test_values_are_numbers_texts_and_lists():
    found = constraint_of_text("height exactly=1640 ft within=-5e1 along=false", "x")
    assert (found.exactly, found.within, found.along) == ("1640 ft", -50.0, False)
    found = constraint_of_text("box min=0,-inf max = 5e3, 4000", "x")
    assert (found.min, found.max) == ([0.0, -np.inf], [5000.0, 4000.0])
    assert constraint_of_text("visible stations=G01,G02", "x").stations == ["G01", "G02"]
    assert constraint_of_text("polygon corners=[[0,0],[9,0],[0,9]]", "x").corners == [
        [0.0, 0.0],
        [9.0, 0.0],
        [0.0, 9.0],
    ]
    found = constraint_of_text("polyline file=my roads/a b.geojson tolerance=10 m", "x")
    assert (found.file, found.tolerance) == ("my roads/a b.geojson", "10 m")


def test_arrays_and_short_names_in_python():
    values = {"kind": "polygon", "corners": np.eye(2), "target": "a"}
    assert constraint_table(values, "x") == ConstraintTable(
        kind="polygon", corners=[[1.0, 0.0], [0.0, 1.0]], target="a"
    )
    assert constraint_table({"kind": "disc", "lat": np.float64(3), "lon_deg": 4, "radius": 1}, "x").given == {
        "lat_deg",
        "lon_deg",
        "radius",
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "there is no constraint ''"),
        ("disk x=3", "there is no constraint 'disk'; did you mean 'disc'"),
        ("disc 3 km", "'3' is no key with a value; write it as 'disc x=3 km"),
        ("disc radios=3", "disc has no key 'radios'; did you mean 'radius'"),
        ("polyline points=road tolerance=3", "points = 'road' does not fit"),
        ("above-ground mim=3", "above-ground has no key 'mim'"),
        ("height along=maybe", "along = 'maybe' does not fit"),
        ("disc x=3 x=4", "the key 'x' is given twice"),
    ],
)
def test_a_mistake_is_one_sentence(text, words):
    with pytest.raises(InvalidProblem, match=words) as error:
        constraint_of_text(text, "--constraint")
    assert str(error.value).startswith("--constraint: ")
    assert len(str(error.value).splitlines()) == 1

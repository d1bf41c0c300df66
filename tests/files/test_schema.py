"""Amounts with units, documents, and complaints about keys."""

import pytest

from optloc import InvalidProblem
from optloc.files.schema import ProblemFile, document_of, schema, validate
from optloc.files.settings import Units, join


def test_an_amount_is_a_number_with_its_unit():
    assert Units("length").plain("30 ns", None, "here") == pytest.approx(30e-9 * 299792458.0)
    assert Units("length", speed=340.0).plain("2 s", None, "here") == pytest.approx(680.0)
    assert Units("length").plain(2.0, "km", "here") == 2000.0
    for value, words in (("30", "has no unit"), ("soon", "is no amount"), ("1e300 m", "is beyond"), ("3 deg", "deg")):
        with pytest.raises(InvalidProblem, match=words):
            Units("length").plain(value, None, "here")


REST = {"format": 2, "stations": {"file": "s.csv"}, "measurements": [{"kind": "range", "file": "r.csv"}]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stations": {"fil": "s.csv"}}, "unknown key 'fil'"),
        ({"measurements": []}, "measurements"),
        ({"format": 9}, "format"),
        ({"frame": {"kind": "moon"}}, "frame"),
    ],
)
def test_a_complaint_names_the_key_and_its_table(change, words):
    with pytest.raises(InvalidProblem, match=words):
        validate(REST | change, "x.toml")


def test_a_document_is_a_problem_file_with_defaults():
    text = 'format = 2\n[stations]\nfile = "s.csv"\n[[measurements]]\nkind = "range"\nfile = "r.csv"\n'
    found = document_of(text, "x.toml")
    assert found == validate(REST, "x.toml")
    assert found.frame.kind == "cartesian"


def test_the_schema_holds_every_key_of_a_file():
    assert set(schema()["properties"]) == set(ProblemFile.model_fields)


def test_places_are_joined_from_the_file_inwards():
    assert join("x.toml", None, "[frame]", "") == join("x.toml", "[frame]")
    assert join("x.toml", "[frame]").startswith("x.toml")

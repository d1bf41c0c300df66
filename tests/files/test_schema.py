"""Documents, complaints about keys, and the JSON schema."""

import pytest

from optloc import InvalidProblem
from optloc.files.constraint_kinds import CONSTRAINT_KINDS
from optloc.files.schema import ProblemFile, document_of, schema, validate

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


def test_the_schema_lists_the_kinds_of_constraints_and_their_keys():
    table = schema()["$defs"]["ConstraintTable"]
    assert set(CONSTRAINT_KINDS) <= set(table["properties"]["kind"]["enum"])
    keys = {each["if"]["properties"]["kind"]["const"]: each["then"]["propertyNames"]["enum"] for each in table["allOf"]}
    assert keys["disc"] == ["kind", "target", "name", "x", "y", "lat_deg", "lon_deg", "radius", "unit"]
    assert {key for names in keys.values() for key in names} <= set(table["properties"])

"""The OpenAPI document: it is valid, it has all endpoints, and its schema of lines is the schema of the parser."""

import json

import pytest
from service.lines import ask, line

jsonschema = pytest.importorskip("jsonschema")

from optloc.base.errors import InvalidProblem  # noqa: E402
from optloc.service.messages import KEYS, ROW_KEYS, parse  # noqa: E402
from optloc.service.openapi import REFUSALS, line_schema  # noqa: E402

LINES = [
    line(event="1", z=[0.0, None, 1, 2, 3]),
    line(event=1, z=[0.0] * 5, target="t", time="1.5", client="c"),
    line(event="1", z=[0.0] * 5, time=1.5, more=True),
    line(event="1", rows=[{"kind": "tdoa", "a": "B", "b": "A", "z": 1.0, "sigma": 2.0}]),
    line(event="1", arrivals=[{"station": "A", "time_ns": 1}, {"station": "B", "time": "1.5"}]),
    line(event="1", station="A", time_ps=7),
    line(event="1", kind="tdoa", a="B", b="A", z=1.0),
    line(command="flush"),
]
WRONG = [
    line(event="1"),
    line(event=1.5, z=[0.0] * 5),
    line(event="1", z=[]),
    line(event="1", z=["1"] * 5),
    line(event="1", z=[0.0] * 5, zz=1),
    line(event="1", rows=[]),
    line(event="1", rows=[{"kind": "tdoa", "a": "B", "b": "A", "z": 1.0, "time": 1}]),
    line(event="1", arrivals=[{"station": "A", "time_ns": 1, "x": 1}]),
    line(event="1", z=[0.0] * 5, target=""),
    line(event="1", z=[0.0] * 5, more=1),
    line(event="1", kind="tdoa", a="B", b="A", z=1.0, sigma=0),
    line(command="stop"),
]


def test_the_schema_of_lines_accepts_and_refuses_as_the_parser(on_earth):
    jsonschema.Draft202012Validator.check_schema(line_schema())
    schema = jsonschema.Draft202012Validator(line_schema())
    for each in LINES:
        assert parse(each, on_earth)
        schema.validate(json.loads(each))
    for each in WRONG:
        with pytest.raises(InvalidProblem):
            parse(each, on_earth)
        assert not schema.is_valid(json.loads(each)), each


def test_the_schema_has_the_keys_of_the_parser():
    properties = line_schema()["properties"]
    assert properties.keys() == KEYS
    assert properties["rows"]["items"]["properties"].keys() == ROW_KEYS


def test_the_document_describes_what_the_server_answers(server):
    _, port = server
    document = json.loads(ask(port, "GET", "/openapi.json")[2])
    assert document["openapi"] == "3.1.0"
    names = set()
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            names.add(operation["operationId"])
            asked = path.replace("{target}", "nobody")
            code, headers, said = ask(
                port, method.upper(), asked, line(event="d", z=[0.0] * 5) if method == "post" else None
            )
            response = operation["responses"][str(code)]
            kind = headers["content-type"].partition(";")[0]
            schema = response["content"][kind]["schema"]
            if "json" in kind and "$ref" in schema:
                full = {"components": document["components"], **schema}
                jsonschema.Draft202012Validator(full).validate(json.loads(said))
            assert {int(other) for other in operation["responses"]} - {200} <= REFUSALS.keys()
    assert len(names) == sum(map(len, document["paths"].values())) == 11


def test_the_document_is_valid_openapi(server):
    validate = pytest.importorskip("openapi_spec_validator", reason="needs openapi-spec-validator").validate
    validate(json.loads(ask(server[1], "GET", "/openapi.json")[2]))

"""The OpenAPI description of a server, from the table of its endpoints and from the form of lines.

Source: OpenAPI Specification 3.1.0 (2021), whose schemas are JSON Schema 2020-12.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from optloc.service.events import GONE, OTHER
from optloc.service.messages import COMMANDS, NAME, ROWS
from optloc.service.site import Site

BODY = 1 << 20
"""Largest size of a request, bytes: a thousand events of a large network."""

JSON, LINES = "application/json", "application/x-ndjson"
"""Media types of one record, and of one record in each line."""

REFUSALS: Mapping[int, str] = {
    400: "the request is not valid",
    401: "a valid token is missing",
    403: "the request comes from a page of another site",
    404: "there is nothing at this path",
    405: "the path has no such method",
    408: "the request was not complete in time",
    409: "the id is used with other values",
    410: "the answer to this id is no longer kept",
    413: f"the request has more than {BODY} bytes",
    429: "the input queue is full",
    503: "the stream ends",
    504: "no answer yet; send the same lines again",
}
"""Meanings of the HTTP status codes with an error."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A path of the server.

    Parameters
    ----------
    path : str
        Path, with parameters in braces as in OpenAPI.
    method : str
        HTTP method.
    run : callable
        Returns the response to a request.
    about : str
        One sentence for people.
    schema : str
        Name of the schema of the answer in the OpenAPI document; empty for text.
    media : tuple of str
        Media types of the answer.
    lines : bool
        Whether the body of a request has lines.
    refusals : tuple of int
        HTTP status codes of errors, in addition to the codes of every path.
    """

    path: str
    method: str
    run: Callable[[Any], Awaitable[Any]]
    about: str
    schema: str = ""
    media: tuple[str, ...] = (JSON,)
    lines: bool = False
    refusals: tuple[int, ...] = ()


# Codes of the checks of every request; an address without tokens never answers 401.
_ALWAYS = (400, 401, 403)

_TEXT = {"type": "string", "minLength": 1, "maxLength": NAME}
_TIME: dict[str, Any] = {"type": ["integer", "string"]}
_NUMBER = {"type": "number"}
_ROW: dict[str, Any] = {
    "kind": _TEXT,
    "a": _TEXT,
    "b": _TEXT,
    "z": _NUMBER,
    "sigma": {"exclusiveMinimum": 0, **_NUMBER},
}
_TIMES: dict[str, Any] = {
    "time": {"type": ["number", "string"], "description": "seconds; a string is exact"},
    "time_ns": {**_TIME, "description": "nanoseconds"},
    "time_ps": {**_TIME, "description": "picoseconds"},
}


def line_schema() -> dict[str, Any]:
    """Return the JSON schema of a line: the forms of `optloc.service.messages.parse`, for any site."""
    listed = {"type": "array", "minItems": 1, "maxItems": ROWS}
    row = {"type": "object", "properties": _ROW, "required": ["kind", "z"], "additionalProperties": False}
    arrival = {"type": "object", "properties": {"station": _TEXT, **_TIMES}, "required": ["station"]}
    properties: dict[str, Any] = {
        "event": {"type": ["string", "integer"], "description": "id of the event, within its client"},
        "client": {**_TEXT, "description": "name of the client to which the id belongs"},
        "target": {**_TEXT, "description": "name of the target, copied to the answer"},
        **_ROW,
        "z": {
            "description": "one value, or all values in the order of the site, null for a missing value",
            "oneOf": [_NUMBER, {**listed, "items": {"type": ["number", "null"]}}],
        },
        "rows": {**listed, "items": row},
        "station": _TEXT,
        "arrivals": {**listed, "items": {**arrival, "additionalProperties": False}},
        **_TIMES,
        "more": {"type": "boolean", "description": "whether more rows of the event will come"},
        "command": {"enum": list(COMMANDS)},
        "received": {"type": "number", "description": "time of reading in a recording, s"},
    }
    forms = (["event", "z"], ["event", "rows"], ["event", "arrivals"], ["event", "station"], ["command"])
    return {
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        "anyOf": [{"required": form} for form in forms],
    }


def _schemas() -> dict[str, Any]:
    """Return the schemas of lines and answers by name."""
    vector = {"type": ["array", "null"], "items": _NUMBER}
    record = {
        "event": {"type": "string"},
        "client": {"type": "string"},
        "target": {"type": "string"},
        "status": {"type": "string", "description": "status of the fix, or of the track"},
        "sentence": {"type": "string", "description": "meaning of the status, with advice"},
        "reason": {"type": "string"},
        "position": {**vector, "description": "metres in the frame of the site; null without a position"},
        "velocity": vector,
        "cov": {"type": ["array", "null"], "items": vector, "description": "covariance, m^2"},
        "lat_deg": {"type": ["number", "null"]},
        "lon_deg": {"type": ["number", "null"]},
        "height": {"type": ["number", "null"], "description": "height above the ellipsoid, m"},
        "proof": {"type": "string"},
        "alternatives": {"type": "array", "items": {"type": "object"}},
        "accepted": {"type": "integer", "description": "number of lines of a request without an answer"},
        "error": {"type": "string"},
        "code": {"type": "integer", "description": "HTTP status code of one line that is refused"},
    }
    return {
        "Line": line_schema(),
        "Record": {"type": "object", "properties": record},
        "Error": {"type": "object", "properties": {"error": {"type": "string"}}, "required": ["error"]},
        "Health": {"type": "object", "properties": {"site": {"type": "string"}}, "required": ["site"]},
        "Features": _with_list("features", {"type": {"const": "FeatureCollection"}}),
        "Map": _with_list("fixes", {"now": _NUMBER}),
        "Aircraft": _with_list("aircraft", {"now": _NUMBER, "messages": {"type": "integer"}}),
        "Tracks": _with_list("tracks", {}),
        "Description": {"type": "object", "required": ["openapi"]},
    }


def _with_list(name: str, others: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of an object with a list of objects under `name`, and the properties `others`."""
    entries = {"type": "array", "items": {"type": "object"}}
    return {"type": "object", "properties": {**others, name: entries}, "required": [name, *others]}


def document(table: Sequence[Endpoint], site: Site) -> dict[str, Any]:
    """Return the OpenAPI document of the endpoints of a site."""
    paths: dict[str, dict[str, Any]] = {}
    for endpoint in table:
        paths.setdefault(endpoint.path, {})[endpoint.method.lower()] = _operation(endpoint)
    about = "A websocket at /ws sends all answers of the stream, and accepts lines of the schema Line."
    return {
        "openapi": "3.1.0",
        "info": {"title": f"optloc: {site.title}", "version": version("optloc"), "description": about},
        "paths": paths,
        "components": {
            "schemas": _schemas(),
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{"token": []}, {}],
    }


def _operation(endpoint: Endpoint) -> dict[str, Any]:
    """Return the operation of an endpoint."""
    schema = {"$ref": f"#/components/schemas/{endpoint.schema}"} if endpoint.schema else {"type": "string"}
    name = f"{endpoint.method.lower()}{endpoint.path.translate(str.maketrans('/.{}', '____'))}".rstrip("_")
    # A body with one record in each line is text for a schema.
    answers = {kind: {"schema": {"type": "string"} if kind == LINES else schema} for kind in endpoint.media}
    error: dict[str, Any] = {JSON: {"schema": {"$ref": "#/components/schemas/Error"}}}
    # a request whose lines are all refused has one record for each line
    errors = error | ({LINES: {"schema": {"type": "string"}}} if endpoint.lines else {})
    found: dict[str, Any] = {
        "operationId": name,
        "summary": endpoint.about,
        "responses": {"200": {"description": "the answer", "content": answers}}
        | {
            str(code): {"description": REFUSALS[code], "content": errors if code in (OTHER, GONE) else error}
            for code in sorted({*_ALWAYS, *endpoint.refusals})
        },
    }
    if "{target}" in endpoint.path:
        found["parameters"] = [{"name": "target", "in": "path", "required": True, "schema": _TEXT}]
    if endpoint.lines:
        line = {"$ref": "#/components/schemas/Line"}
        found["requestBody"] = {
            "required": True,
            "description": f"one line as {JSON}, or one line of JSON in each line as {LINES}",
            "content": {JSON: {"schema": line}, LINES: {"schema": {"type": "string"}}},
        }
        about = "the ids of the lines belong to this client"
        found["parameters"] = [{"name": "X-Client", "in": "header", "description": about, "schema": _TEXT}]
    return found

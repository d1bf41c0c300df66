"""Read a TOML file and hold it against the schema; every complaint is one sentence with its place."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from optloc.errors import InvalidProblem
from optloc.files.schema import ProblemFile
from optloc.files.words import join, nearest

_Model = TypeVar("_Model", bound=BaseModel)


def read_document(path: Path) -> ProblemFile:
    """Return the contents of a problem file; raise InvalidProblem where it is none."""
    return validated(parsed(read_text(path), path.name), path.name)


def parsed(text: str, source: str) -> dict[str, Any]:
    """Return TOML of format 1 as data; `source` is the place to name."""
    data = _toml(text, source)
    if data.get("format") != 1 or isinstance(data.get("format"), bool):
        given = f"format {data['format']!r} is unknown" if "format" in data else "the key 'format' is missing"
        raise InvalidProblem(given, source, "begin the file with the line format = 1")
    return data


def validated(data: dict[str, Any], source: str) -> ProblemFile:
    """Return data as a problem file; `source` is the place to name."""
    return fitted(ProblemFile, data, source)


def fitted(model: type[_Model], data: dict[str, Any], source: str) -> _Model:
    """Return data as a table of a schema; raise InvalidProblem with the first complaint.

    Parameters
    ----------
    model : type of pydantic model
        The schema.
    data : dict
        What was written.
    source : str
        Place to name.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _sentence(error, source, data, model) from None


def read_text(path: Path) -> str:
    """Return the text of a file; raise InvalidProblem where it is missing, a folder or not UTF-8."""
    try:
        return existing(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise InvalidProblem("the text is not UTF-8", join(path.name, f"line {line}"), "save it as UTF-8") from None


def existing(path: Path) -> Path:
    """Return a path that is a readable file; raise InvalidProblem otherwise."""
    if path.is_dir():
        raise InvalidProblem("this is a folder, not a file", str(path), "name a file in it")
    if not path.exists():
        near = nearest(path.name, sorted(p.name for p in path.parent.iterdir())) if path.parent.is_dir() else ""
        hint = (
            near.partition("?")[0] + "?" if "?" in near else "check the name; it is taken relative to the problem file"
        )
        raise InvalidProblem("there is no such file", str(path), hint)
    try:
        path.open("rb").close()
    except OSError as error:
        raise InvalidProblem(
            f"the file cannot be opened ({error.strerror})", str(path), "check its permissions"
        ) from None
    return path


def _toml(text: str, source: str) -> dict[str, Any]:
    if not text.strip():
        raise InvalidProblem("the file is empty", source, "begin it with the line format = 1")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        what, _, place = str(error).partition(" (at ")
        line = place.rstrip(")").partition(",")[0] if place else None
        raise InvalidProblem(
            f"this is not TOML: {what[0].lower()}{what[1:]}", join(source, line), "see toml.io"
        ) from None


_WHAT = {
    "missing": "the key {key!r} is missing",
    "extra_forbidden": "unknown key {key!r}",
    "finite_number": "{key} is {value}, not a finite number",
}


def _sentence(error: ValidationError, source: str, data: dict[str, Any], model: type[BaseModel]) -> InvalidProblem:
    # Alternatives of a union each complain; the deepest complaint is the one about what was written.
    first = max(
        error.errors(), key=lambda e: (e["type"] in {"extra_forbidden", "finite_number"}, len(_path(e["loc"], data)[0]))
    )
    path, key = _path(first["loc"], data)
    template = _WHAT.get(first["type"])
    if template is not None:
        what = template.format(key=key, value=first["input"])
    else:
        what = f"{key} = {first['input']!r} does not fit: {first['msg'][0].lower()}{first['msg'][1:]}"
    advice = None
    if first["type"] in {"extra_forbidden", "missing"}:
        known = _keys(path, model)
        advice = nearest(key, known) if first["type"] == "extra_forbidden" else "add it"
    if first["type"] == "literal_error":
        known = [part.strip().strip("'") for part in str(first["ctx"]["expected"]).replace(" or ", ", ").split(",")]
        what, advice = f"{key} = {first['input']!r} is unknown", nearest(str(first["input"]), known)
    return InvalidProblem(what, join(source, *_spelled(path)), advice)


def _path(loc: tuple[int | str, ...], data: Any) -> tuple[list[int | str], str]:
    """Return the path of the table and the key of a complaint, without the names of union members."""
    path: list[int | str] = []
    at: Any = data
    for part in loc:
        if (isinstance(at, dict) and part in at) or (isinstance(at, list) and part in range(len(at))):
            at = at[part]  # type: ignore[index]  # just checked
        elif part != loc[-1] or not isinstance(at, dict):
            continue
        path.append(part)
    *table, key = path or ["file"]
    while table and isinstance(key, int):
        key = table.pop()
    return table, str(key)


def _spelled(path: list[int | str]) -> list[str]:
    """Return a path as a file spells it: ``[[measurements]] 2``."""
    names: list[str] = []
    for part in path:
        if isinstance(part, int):
            names[-1] = f"{names[-1].replace('[', '[[').replace(']', ']]')} {part + 1}"
        else:
            names.append(f"[{part}]")
    return names


def _keys(path: list[int | str], model: Any) -> list[str]:
    """Return the keys that the table at a path of a schema may have."""
    for part in path:
        if isinstance(part, str) and part in getattr(model, "model_fields", {}):
            model = _model_in(model.model_fields[part].annotation)
    return sorted(model.model_fields)


def _model_in(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = [_model_in(inner) for inner in getattr(annotation, "__args__", ())]
    return next((model for model in found if model is not None), None)

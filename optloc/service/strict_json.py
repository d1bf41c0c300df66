"""Strict JSON: one object from bytes of a stranger, or one sentence that refuses them.

RFC 8259 leaves repeated keys, lone surrogates, depth and sizes to each program. Two programs may then read one line
differently, so a stream refuses such lines.
"""

from __future__ import annotations

import json
import re
from typing import Any

from optloc.problem import InvalidProblem

DEPTH = 16
"""Largest depth of lists and objects: a line has 3 levels, an uplink of a gateway about 6."""

# Largest number of digits of a whole number: picoseconds since 1970 have 22, and longer numbers cost quadratic time.
_DIGITS = 100
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def _refuse(word: str) -> Any:
    """Raise ValueError for a constant that JSON does not permit, such as NaN."""
    raise ValueError(f"{word} is not a number")


def _whole(digits: str) -> int:
    """Return a whole number; raise ValueError if it has too many digits, since its conversion takes quadratic time."""
    if len(digits) > _DIGITS:
        raise ValueError(f"a whole number has {len(digits)} digits, more than {_DIGITS}")
    return int(digits)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs of an object as a dictionary; raise ValueError for a repeated key."""
    found = dict(pairs)
    if len(found) != len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)[:40]!r} occurs twice")
    return found


_JSON = json.JSONDecoder(parse_constant=_refuse, parse_int=_whole, object_pairs_hook=_once)


def read_object(data: bytes, most: int) -> dict[str, Any]:
    """Return the JSON object of a line of at most `most` bytes.

    Raises
    ------
    InvalidProblem
        If the line is too long, is not UTF-8, or is not one JSON object (RFC 8259). Also for NaN, infinity, a key twice
        in one object, and a lone surrogate. Also for more than `DEPTH` levels, or a whole number of more than 100
        digits.
    """
    if len(data) > most:
        raise InvalidProblem(f"the line has {len(data)} bytes, more than {most}", None, "send fewer rows in a line")
    try:
        text = data.decode()
        found = _JSON.decode(text)
        if _SURROGATE.search(text):
            json.dumps(found, ensure_ascii=False).encode()  # a pair of surrogates is one character, and permitted
    except RecursionError:
        raise _too_deep() from None
    except UnicodeDecodeError:
        raise _not_json("it is not UTF-8") from None
    except UnicodeEncodeError:
        raise _not_json("a text has half of a surrogate pair") from None
    except ValueError as error:
        raise _not_json(error.msg.lower() if isinstance(error, json.JSONDecodeError) else str(error)) from None
    if type(found) is not dict:
        raise InvalidProblem("this is not a JSON object", None, 'send {"event": "1", "z": [...]}')
    # The count of brackets is quick, and decides for almost all lines.
    if text.count("[") + text.count("{") > DEPTH and _is_deep(found):
        raise _too_deep()
    return found


def _is_deep(found: Any) -> bool:
    """Return whether a value has more than `DEPTH` levels of lists and objects."""
    level = [found]
    for _ in range(DEPTH):
        inner = [each.values() if type(each) is dict else each for each in level]
        level = [value for values in inner for value in values if type(value) in (dict, list)]
    return bool(level)


def _too_deep() -> InvalidProblem:
    """Return the error for a line with too many levels."""
    return InvalidProblem("the line is nested too deeply", None, "send one flat object in each line")


def _not_json(why: str) -> InvalidProblem:
    """Return the error for a line that is not strict JSON, for the reason `why`."""
    return InvalidProblem(f"this is not JSON: {why}", None, "send one object in each line")

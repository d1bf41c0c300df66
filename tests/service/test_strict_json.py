"""Strict JSON: valid objects are read as by the standard library, and all that programs read unlike is refused."""

import json

import pytest

from optloc.base.errors import InvalidProblem
from optloc.service.strict_json import DEPTH, read_object

MOST = 1000


@pytest.mark.parametrize(
    "text",
    [
        '{"event": "1", "z": [1, -2.5e3, null, true]}',
        '{"a": {"a": {"a": 1}}, "b": [{"a": 1}, {"a": 2}]}',
        '{"pair": "\\ud83d\\ude80", "backslash": "\\\\ud800", "é": "ü\\n"}',
        '{"digits": ' + "9" * 100 + "}",
        ' {"a":' + "[" * (DEPTH - 1) + "]" * (DEPTH - 1) + "} ",
        "{" + ",".join(f'"{i}":[]' for i in range(60)) + "}",
    ],
)
def test_valid_objects_are_read(text):
    assert read_object(text.encode(), MOST) == json.loads(text)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b'{"a":1,"a":1}', "the key 'a' occurs twice"),
        (b'{"b":[{"a":1,"a":2}]}', "the key 'a' occurs twice"),
        (b'{"a":1,"\\u0061":2}', "the key 'a' occurs twice"),
        (b'{"a":"\\ud800"}', "half of a surrogate pair"),
        (b'{"\\udfff":1}', "half of a surrogate pair"),
        (b'{"a":"\xed\xa0\x80"}', "it is not UTF-8"),
        (b'{"a":NaN}', "NaN is not a number"),
        (b'{"a":-Infinity}', "-Infinity is not a number"),
        (b'{"a":' + b"9" * 101 + b"}", "a whole number has 101 digits"),
        (b'{"a":' + b"[" * DEPTH + b"]" * DEPTH + b"}", "nested too deeply"),
        (b'{"a":' * 150 + b"1" + b"}" * 150, "nested too deeply"),
        (b'{"a":"' + b"x" * MOST + b'"}', "more than 1000"),
        (b'{"a":1} {}', "extra data"),
        (b'\xef\xbb\xbf{"a":1}', "this is not JSON"),
        (b'{"a":01}', "this is not JSON"),
        (b'{"a":"\n"}', "invalid control character"),
        (b"{'a':1}", "this is not JSON"),
        (b'"a"', "not a JSON object"),
    ],
)
def test_what_programs_read_unlike_is_refused_in_a_sentence(data, said):
    with pytest.raises(InvalidProblem) as caught:
        read_object(data, MOST)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 200


def test_the_deepest_line_does_not_end_the_interpreter():
    for bracket in (b"[", b'{"a":', b'{"a":['):
        with pytest.raises(InvalidProblem, match="nested too deeply"):
            read_object(bracket * 20_000, 1 << 20)

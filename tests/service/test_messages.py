"""Messages: what a line may say, exact times, names."""

import json
from dataclasses import replace

import pytest
from service.lines import line, site_in

from optloc.base.errors import InvalidProblem
from optloc.service.messages import LINE, full_name, full_name_under, name_keys, parse, picoseconds, with_reading_time


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"))


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (b"", "this is not JSON"),
        (b"[1]", "not a JSON object"),
        (b'{"event": 1', "this is not JSON"),
        (b'{"event": "1", "z": [NaN, 0, 0, 0, 0]}', "this is not JSON: NaN is not a number"),
        (b'{"event": "1", "z": [1e400, 0, 0, 0, 0]}', "z: inf is not a number"),
        (b'{"event": "1", "z": [true, 0, 0, 0, 0]}', "z: True is not a number"),
        (b'{"event": "1", "z": [1' + b"0" * 400 + b", 0, 0, 0, 0]}", "a whole number has 401 digits, more than 100"),
        (b'{"event": "1", "z": [1' + b"0" * 80 + b", 0, 0, 0, 0]}", "is not a number up to"),
        (b'{"event": "1", "z": [0]}', "there are 1 values, but the site has 5 rows"),
        (b'{"event": "1", "z": []}', "there are 0 values"),
        (b'{"event": "1"}', "the line has no rows"),
        (b'{"event": "1", "x": 1}', "unknown key 'x'"),
        (b'{"z": [0, 0, 0, 0, 0]}', "the line has no event"),
        (b'{"event": "", "z": [0, 0, 0, 0, 0]}', "event: '' is not a name"),
        (b'{"event": "\\u001b[2J", "z": [0, 0, 0, 0, 0]}', "is not a name"),
        (b'{"event": 1.5, "z": [0, 0, 0, 0, 0]}', "event: '1.5' is not a name"),
        (b'{"event": "1", "station": "G", "time_ns": 1}', "there is no station 'G'"),
        (b'{"event": "1", "station": ["A"], "time_ns": 1}', "there is no station"),
        (b'{"event": "1", "station": "A"}', "an arrival needs one time"),
        (b'{"event": "1", "station": "A", "time_ns": 1.7e18}', "is not an exact time"),
        (b'{"event": "1", "station": "A", "time": 1700000000.5}', "is not an exact time"),
        (b'{"event": "1", "station": "A", "time_ns": 1, "time_ps": 1}', "an arrival needs one time"),
        (b'{"event": "1", "station": "A", "time_ns": 1' + b"0" * 30 + b"}", "is not an exact time"),
        (b'{"event": "1", "kind": "azimuth", "a": "A", "z": 1}', "the site has no rows of the kind 'azimuth'"),
        (b'{"event": "1", "kind": "tdoa", "a": "A", "z": 1}', "the station is missing"),
        (b'{"event": "1", "kind": "tdoa", "a": "A", "b": "A", "z": 1}', "names station 'A' twice"),
        (b'{"event": "1", "kind": "tdoa", "a": "B", "b": "A", "z": 1, "sigma": 0}', "is not positive"),
        (b'{"event": "1", "rows": [{"kind": "tdoa", "a": "B", "b": "A", "zz": 1}]}', "unknown key 'zz'"),
        (b'{"event": "1", "rows": [1]}', "an entry is not an object"),
        (b'{"command": "stop"}', "unknown command 'stop'"),
        (b'{"event": "1", "z": [0, 0, 0, 0, 0], "more": 1}', "neither true nor false"),
        (b"[" * 60_000, "nested too deep"),
        (b'{"event": ' + b"[" * 16 + b"]" * 16 + b"}", "nested too deep"),
        (b'{"event": "1", "event": "2", "z": [0, 0, 0, 0, 0]}', "this is not JSON: the key 'event' occurs twice"),
        (b'{"event": "1", "rows": [{"z": 1, "z": 2}]}', "the key 'z' occurs twice"),
        (b'{"event": "\\ud800", "z": [0, 0, 0, 0, 0]}', "half of a surrogate pair"),
        (b'{"event": "1", "target": "\\udc00\\ud83d", "z": [0, 0, 0, 0, 0]}', "half of a surrogate pair"),
        (b'{"event": "1", "z": [Infinity, 0, 0, 0, 0]}', "Infinity is not a number"),
        (b'{"event": "1", "client": "", "z": [0, 0, 0, 0, 0]}', "client: '' is not a name"),
        (b'{"event": "1", "client": "a\\nb", "z": [0, 0, 0, 0, 0]}', "is not a name"),
        (b"{" + b" " * LINE + b"}", "bytes, more than 65536"),
        (b'{"event": "\xff", "z": [0, 0, 0, 0, 0]}', "it is not UTF-8"),
    ],
)
def test_what_a_line_must_not_say_is_one_sentence(site, found, said):
    with pytest.raises(InvalidProblem) as caught:
        parse(found, site)
    assert said in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_times_are_exact():
    assert picoseconds(1_700_000_000_123_456_789, "time_ns") == 1_700_000_000_123_456_789_000
    assert picoseconds("1700000000123456789.25", "time_ns") == 1_700_000_000_123_456_789_250
    assert picoseconds("1700000000.123456789012", "time") == 1_700_000_000_123_456_789_012
    assert picoseconds("-0.5", "time") == -(5 * 10**11)
    assert picoseconds(7, "time_ps") == picoseconds("7", "time_ps") == picoseconds("7.9", "time_ps") == 7


def test_pairs_of_surrogates_are_characters(site):
    assert parse(b'{"event": "\\ud83d\\ude80", "z": [0, 0, 0, 0, 0]}', site).event == "\N{ROCKET}"


def test_ids_belong_to_their_client(site):
    own = parse(line(event="1", client="roof", z=[0.0] * 5), site).event
    assert own == full_name("roof", "1") != parse(line(event="1", z=[0.0] * 5), site).event
    assert name_keys(own) == {"event": "1", "client": "roof"}
    assert full_name_under("event", own) == own
    for name in ("a\nb\nc", "\nb", "a\n"):
        with pytest.raises(InvalidProblem, match="is not a name"):
            full_name_under("event", name)


def test_a_line_is_recorded_with_one_time_of_reading():
    assert with_reading_time(b'{"event":"1"}', 2.0) == b'{"received":2.000000,"event":"1"}'
    assert json.loads(with_reading_time(b'{"event":"1","received":1}', 2.0)) == {"received": 2.0, "event": "1"}


def test_an_id_may_be_a_number_and_is_told_as_text(site):
    assert parse(line(event=7, z=[0.0] * 5), site).event == "7"


def test_what_is_told_of_a_site_is_what_it_takes(site):
    from optloc.service.command import input_description

    lines = [text.partition(": ")[2] for text in input_description(replace(site))]
    for text in lines[1:4]:
        assert parse(text.encode(), site).event == "1"
        assert json.loads(text)["event"] == "1"

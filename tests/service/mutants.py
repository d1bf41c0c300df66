"""Mutated messages of all sources of a stream, drawn from a seed and a number alone."""

import json
import random

from service.lines import EPOCH, line

# Values that readers of JSON treat unlike, or that are far beyond what a value may be.
EVIL = (
    b"NaN", b"-Infinity", b"1e999", b"-0.0", b"1e-400", b"null", b"true", b'""', b"[]", b"{}", b"[[]]", b'{"":{}}',
    b'"\\ud800"', b'"\\udc00\\ud800"', b'"\\u0000"', b'"\\u001b[2J"', b'"\\u202e"', b'"<script>alert(1)</script>"',
    b'"' + b"x" * 300 + b'"', b"9" * 40, b"9" * 400, b"9" * 5000, b"1." + b"1" * 400, b"[" * 17 + b"]" * 17,
    b'{"a":' * 40 + b"1" + b"}" * 40, b"[" * 900 + b"]" * 900, b'"../../etc/passwd"', b'"%s%n{0}"', b'"a\\nb"',
    b'{"event":"1","event":"2"}', b"\xff\xfe", b"\xed\xa0\x80", b"\x00", b"'1'", b"1_000", b"0x10", b"+1", b".5", b"1e",
)  # fmt: skip
UPLINK = {
    "deduplicationId": "d",
    "time": "2026-01-01T00:00:00Z",
    "deviceInfo": {"devEui": "0011223344556677", "tags": {}},
    "rxInfo": [{"gatewayId": name, "rssi": -80, "fineTimeSinceGpsEpoch": "1449964818.000000123s"} for name in "ABCDEF"],
    "object": {"temperature": [21.5]},
}
MLAT = {"receiver": "A", "mlat": {"t": 1_234_567_890, "m": "8d4840d6202cc371c32ce0576098"}}


def originals(site, z):
    """Return valid messages by the form of their source; `z` (n, m) are rows of the site."""
    row = z[0]
    named = [{"kind": r.kind, "a": r.a, "b": r.b, "z": v} for r, v in zip(site.rows, row, strict=True)]
    heard = [{"station": name, "time_ns": EPOCH // 1000 + 100 * i} for i, name in enumerate(site.stations)]
    lines = [
        line(event="e", z=row),
        line(event="e", z=row, target="4b1234", time=1_700_000_000.5, client="c"),
        line(event="e", rows=named),
        line(event="e", rows=[named[0] | {"sigma": 2.0}], more=True),
        line(event="e", arrivals=heard, time="1.5", target="t"),
        line(event="e", station="A", time_ns=EPOCH // 1000),
        line(event=7, kind="tdoa", a="B", b="A", z=1.5),
        line(command="flush"),
        line(command="health"),
        line(received=1.0, event="e", z=row),
    ]
    return {"line": lines, "chirpstack": [json.dumps(UPLINK).encode()], "mode-s": [json.dumps(MLAT).encode()]}


def mutant(rng: random.Random, messages):
    """Return a message with one to four mutations; one of ten is unchanged, except for its id."""
    data = rng.choice(messages).replace(b'"e"', b'"e%d"' % rng.randrange(400))
    for _ in range(rng.choice((0, 1, 1, 1, 1, 1, 2, 2, 3, 4))):
        data = rng.choice((_bytes, _cut, _token, _token, _value, _value, _value, _repeat))(rng, data)
    return data


def _bytes(rng, data):
    """Replace, add or remove single bytes."""
    out = bytearray(data or b"{")
    for _ in range(rng.randrange(1, 4)):
        place = rng.randrange(len(out))
        out[place : place + rng.randrange(2)] = bytes([rng.choice(b'{}[]",:0\\\x00\x1f\x7f\xff\n e')])
    return bytes(out)


def _cut(rng, data):
    """Keep a part of a message."""
    ends = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return rng.choice((data[: ends[0]], data[ends[1] :], data[: ends[0]] + data[ends[1] :]))


def _token(rng, data):
    """Replace text between two separators by an evil value."""
    places = [i for i, byte in enumerate(data) if byte in b":,[]{}"]
    if len(places) < 2:
        return rng.choice(EVIL)
    number = rng.randrange(len(places) - 1)
    return data[: places[number] + 1] + rng.choice(EVIL) + data[places[number + 1] :]


def _value(rng, data):
    """Replace, remove, add or move a value at any depth of a JSON message."""
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        return _bytes(rng, data)
    if not isinstance(found, dict) or not found:
        return rng.choice(EVIL)
    place = found
    while rng.random() < 0.6:
        inner = [
            value
            for value in (place.values() if isinstance(place, dict) else place)
            if value and isinstance(value, dict | list)
        ]
        if not inner:
            break
        place = rng.choice(inner)
    key = rng.choice(list(place)) if isinstance(place, dict) else rng.randrange(len(place))
    what = rng.randrange(5)
    if what == 0:
        del place[key]
    elif what == 1:
        place[key] = rng.choice(
            (None, True, -1, 2**70, 1e308, "", "A", [], {}, [place[key]], {"z": place[key]}, "\ud800")
        )
    elif what == 2 and isinstance(place, dict):
        place[rng.choice(("event", "z", "station", "command", "client", "target", "more", "\ud83d", "x" * 300))] = (
            place[key]
        )
    else:
        text = json.dumps(found).encode()
        old = json.dumps(place[key]).encode()
        return text.replace(old, rng.choice(EVIL), 1)
    return json.dumps(found).encode()


def _repeat(rng, data):
    """Repeat a part of a message."""
    first, last = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:last] + data[first:last] * rng.choice((1, 1, 3, 50)) + data[last:]

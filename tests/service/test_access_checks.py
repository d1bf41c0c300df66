"""Access checks: hosts, origins and tokens of requests, and the headers of all answers."""

import asyncio
import json
from base64 import b64encode

import pytest

from optloc.service.access_checks import SAFE_HEADERS, AccessChecks
from optloc.service.http_options import AccessRules, digest_of

TOKEN = "0123456789abcdef"


def asked(access=None, *, local=True, kind="http", **headers):
    """Return the messages that answer a request, and whether the application was called; `_` is - in names."""
    sent, called = [], []

    async def app(scope, receive, send):
        called.append(scope)
        await send({"type": "http.response.start", "status": 200, "headers": [(b"x-frame-options", b"SAMEORIGIN")]})

    async def send(message):
        sent.append(message)

    given = {"host": "localhost:8200"} | {name.replace("_", "-"): value for name, value in headers.items()}
    found = [(name.encode(), each.encode()) for name, value in given.items() for each in value.split("|") if each]
    checks = AccessChecks(app, access or AccessRules(), local=local)
    asyncio.run(checks({"type": kind, "headers": found}, None, send))
    return sent, bool(called)


def code(*args, **headers):
    sent, called = asked(*args, **headers)
    status = sent[0]["status"]
    assert called == (status == 200)
    if status != 200:
        assert json.loads(sent[1]["body"])["error"]
    return status


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:80", "127.0.0.1:8200", "[::1]:8200", "127.0.0.2", "fixes.org:1"]
)
def test_own_names_are_permitted(host):
    assert code(AccessRules(hosts=("fixes.org",)), host=host) == 200


@pytest.mark.parametrize(
    "host", ["", "evil.example", "localhost.evil.example", "192.168.1.5", "[", "a|a", "x@localhost:y"]
)
def test_other_names_are_refused(host):
    assert code(AccessRules(hosts=("fixes.org",)), host=host) == 400


def test_an_open_server_has_addresses_and_stated_names_only():
    access = AccessRules(hosts=("fixes.org",), without_token=True)
    for host, expected in (
        ("192.168.1.5:8200", 200),
        ("[2001:db8::1]", 200),
        ("fixes.org", 200),
        ("evil.example", 400),
    ):
        assert code(access, local=False, host=host) == expected


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ("http://localhost:8200", 200),
        ("https://LOCALHOST:8200", 200),
        ("http://localhost:8201", 403),
        ("http://evil.example", 403),
        ("null", 403),
        ("http://[", 403),
        ("http://localhost:8200|http://evil.example", 403),
    ],
)
def test_pages_of_other_servers_are_refused(origin, expected):
    assert code(origin=origin) == expected
    sent, called = asked(origin=origin, kind="websocket")
    assert called == (expected == 200)
    if not called:
        assert (sent[0]["type"], sent[0]["code"]) == ("websocket.close", 1008)


def basic(token):
    return "Basic " + b64encode(b"anybody:" + token).decode()


@pytest.mark.parametrize(
    ("authorization", "expected"),
    [
        (f"Bearer {TOKEN}", 200),
        (f"bearer  {TOKEN} ", 200),
        (basic(TOKEN.encode()), 200),
        ("", 401),
        ("Bearer", 401),
        (f"Bearer {TOKEN[:-1]}", 401),
        (f"Bearer {TOKEN}x", 401),
        (f"Bearer {TOKEN}|Bearer {TOKEN}", 401),
        (f"Digest {TOKEN}", 401),
        ("Basic ***", 401),
        (basic(b"\xff"), 401),
        (basic(b"other"), 401),
    ],
)
def test_a_server_with_tokens_needs_one(authorization, expected):
    access = AccessRules(tokens=(digest_of("another-token-of-16"), digest_of(TOKEN)))
    assert code(access, authorization=authorization) == expected
    if expected == 401:
        (start, _), _ = asked(access, authorization=authorization)
        assert [value[:6] for name, value in start["headers"] if name == b"www-authenticate"] == [b"Bearer", b"Basic "]


def test_every_token_is_compared(monkeypatch):
    """The time of a refusal depends neither on the token that fits nor on its characters."""
    compared = []

    def count(one, other):
        compared.append((len(one), len(other)))
        return one == other

    monkeypatch.setattr("optloc.service.access_checks.compare_digest", count)
    access = AccessRules(tokens=tuple(digest_of(name) for name in (TOKEN, "another-token-of-16")))
    assert code(access, authorization=f"Bearer {TOKEN}") == 200
    assert code(access, authorization="Bearer x") == 401
    assert compared == [(32, 32)] * 4


def test_all_answers_have_the_headers_and_keep_their_own():
    (start,), _ = asked()
    assert [value for name, value in start["headers"] if name == b"x-frame-options"] == [b"SAMEORIGIN"]
    (refused, _), _ = asked(host="evil.example")
    for message, others in ((start, {"X-Frame-Options"}), (refused, set())):
        found = dict(message["headers"])
        assert {name: found[name.lower().encode()].decode() for name in SAFE_HEADERS.keys() - others} == {
            name: SAFE_HEADERS[name] for name in SAFE_HEADERS.keys() - others
        }

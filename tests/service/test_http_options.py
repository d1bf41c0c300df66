"""Options for HTTP: addresses, host names, and files of tokens."""

import pytest

from optloc.base.errors import InvalidProblem
from optloc.service.http_options import access_of, address_of, digest_of, hostname, is_local, tokens_in


def test_addresses_have_a_port():
    assert address_of("8200") == ("127.0.0.1", 8200)
    assert address_of("0.0.0.0:80") == ("0.0.0.0", 80)
    assert address_of("[::]:80") == ("::", 80)
    for text in ("", "host", "host:", "host:8x"):
        with pytest.raises(InvalidProblem, match="is not a port"):
            address_of(text)


def test_local_addresses_are_reached_from_this_machine_only():
    assert all(map(is_local, ("localhost", "127.0.0.1", "127.9.9.9", "::1", "[::1]")))
    assert not any(map(is_local, ("0.0.0.0", "::", "192.168.1.5", "fixes.org", "")))


def test_host_names_have_no_port():
    assert access_of(["Fixes.org", "[2001:db8::1]"], None).hosts == ("fixes.org", "2001:db8::1")
    assert hostname("Fixes.ORG:80") == "fixes.org"
    for name in ("", "fixes.org:80", "http://fixes.org", "fixes.org/", "me@fixes.org", "a b", "[::1]:80"):
        with pytest.raises(InvalidProblem, match="is not a host name"):
            access_of([name], None)


def test_tokens_are_read_one_a_line(tmp_path):
    path = tmp_path / "tokens"
    path.write_text("# of the gateway\n0123456789abcdef\n\n  abcdefabcdefabcdef  \n")
    assert tokens_in(path) == (digest_of("0123456789abcdef"), digest_of("abcdefabcdefabcdef"))
    assert access_of((), path).tokens == tokens_in(path)
    with pytest.raises(InvalidProblem, match="required and not required"):
        access_of((), path, without_token=True)


@pytest.mark.parametrize("text", ["", "# none\n", "letmein\n", "0123456789 abcdef\n", "0123456789abcdefé\n"])
def test_a_weak_token_is_refused_and_not_printed(tmp_path, text):
    path = tmp_path / "tokens"
    path.write_text(text)
    with pytest.raises(InvalidProblem) as caught:
        tokens_in(path)
    assert text.strip() == "" or text.strip() not in str(caught.value)

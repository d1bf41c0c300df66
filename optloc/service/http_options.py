"""The options of ``optloc live`` and ``optloc serve`` for HTTP: address, permitted hosts and tokens."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import sha256
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import typer

from optloc.files import read_text
from optloc.problem import InvalidProblem

HOST, PORT = "127.0.0.1", 8200
"""Default address of a server: requests of this machine only."""

Http = Annotated[
    str | None,
    typer.Option(
        "--http", metavar="[HOST:]PORT", help="Accept HTTP requests as well; by default from this machine only."
    ),
]
Hosts = Annotated[
    list[str] | None,
    typer.Option("--allow-host", metavar="NAME", help="Accept HTTP requests under this host name; may be repeated."),
]
Tokens = Annotated[
    Path | None,
    typer.Option("--token-file", metavar="FILE", help="Require one of the tokens in this file from HTTP requests."),
]
NoToken = Annotated[
    bool, typer.Option("--no-token", help="Accept HTTP requests of other machines without a token, as of a proxy.")
]

# Least number of characters of a token: with 64 symbols they have 96 random bits, too many to try.
_TOKEN = 16


def address_of(text: str) -> tuple[str, int]:
    """Return host and port of a text such as "0.0.0.0:8200" or "8200"; raise InvalidProblem for other texts."""
    host, _, port = text.rpartition(":")
    if not port.isdecimal():
        raise InvalidProblem(f"{text!r} is not a port", "--http", "write 8200, or 0.0.0.0:8200")
    return host.strip("[]") or HOST, int(port)


@dataclass(frozen=True, slots=True)
class AccessRules:
    """Rules of access to a server.

    Parameters
    ----------
    hosts : tuple of str
        Permitted host names in lower case, in addition to names and addresses that no stranger can choose.
    tokens : tuple of bytes
        SHA-256 digests of the permitted tokens; empty if requests need no token.
    without_token : bool
        Whether other machines may send requests without a token.
    """

    hosts: tuple[str, ...] = ()
    tokens: tuple[bytes, ...] = ()
    without_token: bool = False


def access_of(hosts: Iterable[str], token_file: Path | None, *, without_token: bool = False) -> AccessRules:
    """Return the rules of the options ``--allow-host``, ``--token-file`` and ``--no-token``.

    Raise InvalidProblem for an invalid host name, for a file without valid tokens, or for both token options.
    """
    given = tuple(host.lower() for host in hosts)
    for name in given:
        if not _is_host(name):
            raise InvalidProblem(f"{name[:40]!r} is not a host name", "--allow-host", "write fixes.example.org")
    if token_file is not None and without_token:
        raise InvalidProblem("a token is required and not required", "--no-token", "remove this option")
    return AccessRules(tuple(map(hostname, given)), () if token_file is None else tokens_in(token_file), without_token)


def _is_host(name: str) -> bool:
    """Return whether a text is a host name or an address, without a port."""
    return name != "" and hostname(name) == name.strip("[]") and " " not in name


def tokens_in(path: Path) -> tuple[bytes, ...]:
    """Return the SHA-256 digests of the tokens in a file, one token on each line; lines with ``#`` are comments.

    Raise InvalidProblem for a file without tokens, or with a token that is too short or has blanks.
    """
    lines = [line.strip() for line in read_text(path).splitlines()]
    tokens = [line for line in lines if line and not line.startswith("#")]
    if not tokens:
        raise InvalidProblem("the file has no token", str(path), "write one token on each line")
    for token in tokens:  # the message must not print a token
        if len(token) < _TOKEN or not token.isascii() or not token.isprintable() or " " in token:
            what = f"a token is shorter than {_TOKEN} characters, or has other characters than ASCII without blanks"
            raise InvalidProblem(what, str(path), "write the output of: openssl rand -base64 24")
    return tuple(digest_of(token) for token in tokens)


def hostname(given: str) -> str:
    """Return the host name of a header in lower case, without port and brackets; empty for an invalid header."""
    try:
        found = urlsplit(f"//{given}")
    except ValueError:
        return ""
    return (found.hostname or "") if found.netloc == given and "@" not in given else ""


def digest_of(token: str) -> bytes:
    """Return the SHA-256 digest of a token, so that all compared texts have one length."""
    return sha256(token.encode("utf-8", "surrogatepass")).digest()


def is_local(host: str) -> bool:
    """Return whether a host name or address is reached from this machine only."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower() == "localhost"

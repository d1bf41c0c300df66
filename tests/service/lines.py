"""What the tests of streams share: a site, events drawn on it as lines, and a stream that answers them."""

import http.client
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from optloc.problem.build import Problem
from optloc.service.account import SETTLED
from optloc.service.site import read_site
from optloc.service.standard_input import read_lines
from optloc.service.stream import Settings, Stream
from optloc.solvers import solve

C = 299_792_458.0
EPOCH = 1_700_000_000 * 10**12  # picoseconds since 1970, of which a float keeps none

SITE = """
format = 1
title = "Six receivers"

[stations]
rows = [
  { name = "A", x = 0.0, y = 0.0, z = 0.0 },
  { name = "B", x = 4000.0, y = 200.0, z = 900.0 },
  { name = "C", x = 4300.0, y = 4100.0, z = 100.0 },
  { name = "D", x = -200.0, y = 3900.0, z = 1200.0 },
  { name = "E", x = 2100.0, y = -1500.0, z = 400.0 },
  { name = "F", x = 2000.0, y = 5600.0, z = 2000.0 },
]

[[measurements]]
kind = "tdoa"
arrival_sigma = "5 m"
b = "A"
rows = [{ a = "B" }, { a = "C" }, { a = "D" }, { a = "E" }, { a = "F" }]
"""


def site_in(folder: Path, text: str = SITE, method: str = "auto"):
    """Return the site of a text."""
    path = folder / "site.toml"
    path.write_text(text)
    return read_site(path, method)


def arrivals(site, count, seed=1, sigma=5.0):
    """Return times of arrival (count, stations) in picoseconds since 1970, of targets among the stations."""
    rng = np.random.default_rng(seed)
    low, high = site.position.min(0), site.position.max(0)
    x = low + (high - low) * rng.uniform(0.1, 0.9, (count, len(low)))
    path = np.linalg.norm(x[:, None] - site.position, axis=-1) + sigma * rng.standard_normal(
        (count, len(site.stations))
    )
    return [[EPOCH + round(v / C * 1e12) for v in row] for row in path.tolist()]


def differences(site, times):
    """Return the rows (n, m) of the site from times of arrival, metres."""
    number = {name: i for i, name in enumerate(site.stations)}
    ends = [(number[row.a], number[row.b]) for row in site.rows]
    return np.array([[C * 1e-12 * (row[a] - row[b]) for a, b in ends] for row in times])


def line(**found) -> bytes:
    """Return a line of JSON."""
    return json.dumps(found).encode()


class Answers:
    """Takes what a stream writes, and gives it as records."""

    def __init__(self):
        self.data = b""

    def __call__(self, data):
        self.data += data

    @property
    def records(self):
        return [json.loads(each, parse_constant=_refuse) for each in self.data.splitlines()]


def _refuse(word):
    raise AssertionError(f"{word} is no JSON")


def answers(site, lines, **settings):
    """Return the records that a stream answers to lines, and its health."""
    out = Answers()
    stream = Stream(site, Settings(**({"shed": False, "deadline": 1e6} | settings)), out)
    data = iter([b"\n".join(lines), b""])
    read_lines(lambda _: next(data), stream, "test")
    stream.close()
    assert stream.ended.wait(120.0)
    return out.records, stream.health()


def balanced(health):
    """Return the account of a record of health, after checks of its sums and its alarms."""
    for source, counts in health["account"].items():
        assert counts["received"] == sum(counts[state] for state in (*SETTLED, "open")), (source, counts)
        assert min(counts.values()) >= 0, (source, counts)
    assert not [alarm for alarm in health["alarms"] if alarm["part"] == "account"]
    return health["account"]


def solved(site, z, method="auto") -> tuple[Problem, object]:
    """Return the fix of rows of the whole template."""
    ready = site.ready((), site.rows)
    problem = ready.full.problem.with_rows(z=np.asarray(z))
    return problem, solve(problem, method)


class Slow:
    """A prepared problem whose every fix takes 40 ms, as the hardest proofs do.

    It holds the interpreter lock where it is busy, as plain Python does; machine code does not.
    """

    def __init__(self, prepared, busy):
        self.prepared, self.busy = prepared, busy

    def __call__(self, z):
        until = time.perf_counter() + 0.04 * len(np.atleast_2d(z))
        while self.busy and time.perf_counter() < until:
            pass
        time.sleep(max(until - time.perf_counter(), 0.0))
        return self.prepared(z)


def slowed(site, busy=False):
    """Return a site all of whose proofs are slow."""
    ready = site.ready((), site.rows)
    other = replace(ready, full=Slow(ready.full, busy))

    class Other(type(site)):
        def ready(self, heard, rows):
            return other

    return Other(*(getattr(site, name) for name in site.__dataclass_fields__))


def ask(port, method, path, body=None, **headers):
    """Return code, headers and text of an answer; names of headers have underscores here."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    given = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, given)
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read().decode()
    connection.close()
    return found

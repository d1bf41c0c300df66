"""What a stream does in a second of processor time, and how long an answer takes at 200 events a second.

Rates are of processor time; beside other work the latencies are not those of the stream alone. Run it with ``-s``.
"""

import json
import os
import subprocess
import sys
import time

import pytest
from data.windows import report
from service.lines import Answers, arrivals, differences, line, site_in, slowed

from optloc.service.command import _threads
from optloc.service.stream import Settings, Stream

EVENTS = 20_000


@pytest.fixture(scope="module")
def feed(tmp_path_factory):
    """Return a folder with a site, and files of whole events and of arrivals."""
    folder = tmp_path_factory.mktemp("feed")
    site = site_in(folder)
    times = arrivals(site, EVENTS)
    whole = [line(event=str(i), z=z) for i, z in enumerate(differences(site, times).round(3).tolist())]
    single = [
        line(event=str(i), station=name, time_ns=t // 1000)
        for i, row in enumerate(times)
        for name, t in zip(site.stations, row, strict=True)
    ]
    (folder / "whole").write_bytes(b"\n".join(whole))
    (folder / "arrivals").write_bytes(b"\n".join(single))
    (folder / "nothing").write_bytes(b"")
    return folder


def run(folder, name, phases):
    """Return processor seconds of a stream that reads a file through a pipe, and its health."""
    words = [
        sys.executable,
        "-m",
        "optloc.cli",
        "live",
        "site.toml",
        "--phases",
        phases,
        "--no-shed",
        "--deadline",
        "1e6 s",
        "--wait",
        "60 s",  # no event ends because this process was late to write it
    ]
    before = os.times()
    with (folder / "out").open("wb") as out:
        process = subprocess.Popen(words, cwd=folder, stdin=subprocess.PIPE, stdout=out, stderr=subprocess.PIPE)
        process.stdin.write((folder / name).read_bytes())
        process.stdin.close()
        said = process.stderr.read().splitlines()
        assert process.wait() == 0
    after = os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return used, json.loads(said[-1])["health"]


@pytest.mark.parametrize(
    ("name", "phases", "wanted"),
    [("whole", "fix", 10_000), ("whole", "one", 4000), ("arrivals", "fix", 6000), ("arrivals", "one", 3000)],
)
def test_events_in_a_second_of_one_processor(feed, name, phases, wanted):
    start, _ = run(feed, "nothing", phases)
    used, health = run(feed, name, phases)
    rate = EVENTS / (used - start)
    report(f"{name}, {'proven' if phases == 'one' else 'unproven'}: {rate:.0f} events/s, start {start:.2f} s")
    assert sum(health["statuses"].values()) == EVENTS
    assert health["incomplete"] == 0
    assert phases == "fix" or health["proofs"] == {"global": EVENTS}
    assert rate >= wanted


def test_latency_at_two_hundred_events_a_second(feed):
    lines = (feed / "whole").read_bytes().splitlines()[:4000]
    words = [sys.executable, "-m", "optloc.cli", "live", "site.toml"]
    with (feed / "out").open("wb") as out:
        process = subprocess.Popen(words, cwd=feed, stdin=subprocess.PIPE, stdout=out, stderr=subprocess.PIPE)
        assert process.stderr.readline().startswith(b"ready")
        began = time.perf_counter()
        for i, each in enumerate(lines):
            time.sleep(max(began + i / 200.0 - time.perf_counter(), 0.0))
            process.stdin.write(each + b"\n")
            process.stdin.flush()
        process.stdin.close()
        health = json.loads(process.stderr.read().splitlines()[-1])["health"]
    report(f"ms: fixes {health['fix_latency_ms']}, proofs {health['proof_latency_ms']}")
    assert health["fix_latency_ms"]["p99"] <= 20.0


@pytest.mark.parametrize("busy", [False, True])
def test_latency_beside_proofs_of_40_milliseconds(tmp_path, busy):
    site = site_in(tmp_path)
    rows = differences(site, arrivals(site, 2000))
    with _threads():  # as the command has them
        stream = Stream(slowed(site, busy), Settings(), Answers())
        began = time.perf_counter()
        for i, z in enumerate(rows.tolist()):
            time.sleep(max(began + i / 200.0 - time.perf_counter(), 0.0))
            stream.inbox.put(stream.lines([line(event=str(i), z=z)], "test"))
        stream.close()
        assert stream.ended.wait(60.0)
    found = stream.health()
    report(f"proofs {'hold' if busy else 'release'} the lock: fixes {found['fix_latency_ms']} ms")
    assert sum(found["statuses"].values()) >= len(rows)
    assert found["fix_latency_ms"]["p99"] <= 20.0

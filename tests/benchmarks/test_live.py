"""What a stream does in a second of processor time, and how long an answer takes at 200 and 1000 events a second.

Rates are of processor time; beside other work the latencies are not those of the stream alone. Run it with ``-s``.
"""

import json
import os
import subprocess
import sys
import time
from collections import Counter

import pytest
from benchmarks.test_latency import general
from data.windows import report
from service.lines import Answers, arrivals, balanced, differences, line, site_in, slowed

from optloc.service.process import _stream_environment
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


def fed(folder, rate, count):
    """Return the health and the answers of a stream to `count` whole events that a pipe brings at a rate, in 1/s."""
    lines = (folder / "whole").read_bytes().splitlines()[:count]
    words = [sys.executable, "-m", "optloc.cli", "live", "site.toml"]
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        process = subprocess.Popen(words, cwd=folder, stdin=subprocess.PIPE, stdout=out, stderr=err)
        while b"ready" not in (folder / "err").read_bytes():
            time.sleep(0.1)
        began = time.perf_counter()
        for i, each in enumerate(lines):
            ahead = began + i / rate - time.perf_counter()
            if ahead > 0.0:
                process.stdin.flush()
                time.sleep(ahead)
            process.stdin.write(each + b"\n")
        process.stdin.close()
        assert process.wait(120.0) == 0
    health = json.loads((folder / "err").read_bytes().splitlines()[-1])["health"]
    return health, [json.loads(each) for each in (folder / "out").read_bytes().splitlines()]


def test_latency_at_two_hundred_events_a_second(feed):
    health, _ = fed(feed, 200.0, 4000)
    report(f"ms: fixes {health['fix_latency_ms']}, proofs {health['proof_latency_ms']}")
    assert health["fix_latency_ms"]["p99"] <= 20.0


def test_latency_at_a_thousand_events_a_second(feed):
    """In solutions of SciPy of one event, measured in the same run: at most 250 for the fix and 500 for the proof."""
    scipy = 1e-3 * general("inside")[0]
    health, records = fed(feed, 1000.0, EVENTS)
    scipy = 0.5 * (scipy + 1e-3 * general("inside")[0])
    fix, proof = (health[f"{phase}_latency_ms"]["p99"] for phase in ("fix", "proof"))
    report(f"1000 a second: S = {scipy:.3f} ms, p99 of fixes {fix / scipy:.0f} S, of proofs {proof / scipy:.0f} S")
    assert sum(record["phase"] == "proof" for record in records) == EVENTS
    assert fix <= 250.0 * scipy
    assert proof <= 500.0 * scipy


def test_at_three_thousand_events_a_second_nothing_is_lost(feed):
    health, records = fed(feed, 3000.0, EVENTS)
    counts = balanced(health)["stdin"]
    assert counts == {"received": EVENTS, "answered": EVENTS, "refused": 0, "dropped": 0, "open": 0}
    phases = Counter(record["phase"] for record in records)
    assert phases == {"fix": EVENTS, "proof": EVENTS}
    why = Counter(record.get("why") for record in records if record["phase"] == "proof")
    assert (why["skipped: load"], why["deadline"]) == (health["skipped"], health["overdue"])
    report(f"3000 a second: proofs {health['proofs']}, skipped {health['skipped']}, overdue {health['overdue']}")


@pytest.mark.parametrize("busy", [False, True])
def test_latency_beside_proofs_of_40_milliseconds(tmp_path, busy):
    site = site_in(tmp_path)
    rows = differences(site, arrivals(site, 2000))
    with _stream_environment():  # as the command has them
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

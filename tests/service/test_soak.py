"""Long runs of a stream: latency, memory, and that nothing is lost, also with kills, restarts and a full disk."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from data.windows import report
from service.lines import arrivals as drawn, differences, line, site_in
from service.soak import MINUTES, soak

pytestmark = pytest.mark.full

# Events that fill all that is bounded, then seconds of 200 events each. The ids of the last 65 536 are in a dictionary,
# whose table has its final size after 87 381 of them and is made anew, beside the old one, after 196 607 for the first
# time: until then memory grows by 9 MB, and over the next 300 000 events by a quarter of one.
BEFORE, SECONDS, RATE = 200_000, 600, 200


def memory(process):
    """Return the resident megabytes of a process."""
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * 4096 / 1e6


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_ten_minutes_at_two_hundred_events_a_second(tmp_path):
    site = site_in(tmp_path)
    z = differences(site, drawn(site, 500)).tolist()
    words = [sys.executable, "-m", "optloc.cli", "live", "site.toml", "--state", "s.json", "--phases", "two"]
    with (tmp_path / "out").open("wb") as out, (tmp_path / "err").open("wb") as err:
        process = subprocess.Popen(words, cwd=tmp_path, stdin=subprocess.PIPE, stdout=out, stderr=err)
        for i in range(BEFORE):
            process.stdin.write(line(event=f"before {i}", z=z[i % 500]) + b"\n")
        process.stdin.flush()
        while (tmp_path / "out").read_bytes().count(b'"phase":"fix"') < BEFORE:
            time.sleep(1.0)
        time.sleep(12.0)  # a checkpoint of all of it
        first, began = memory(process), time.perf_counter()
        for i in range(SECONDS * RATE):
            time.sleep(max(began + i / RATE - time.perf_counter(), 0.0))
            process.stdin.write(line(event=str(i), z=z[i % 500]) + b"\n")
            process.stdin.flush()
        last = memory(process)
        process.stdin.close()
        assert process.wait(60.0) == 0
    health = json.loads((tmp_path / "err").read_text().splitlines()[-1])["health"]
    report(f"{first:.1f} MB, {last:.1f} MB, {health['fix_latency_ms']}")
    records = [json.loads(each) for each in (tmp_path / "out").read_bytes().splitlines()]
    assert {r["event"] for r in records if r["phase"] == "proof"} >= {str(i) for i in range(SECONDS * RATE)}
    assert last - first <= 5.0
    assert health["fix_latency_ms"]["p99"] <= 20.0


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_garbage_restarts_a_full_disk_and_kills_lose_no_event(tmp_path):
    """For an hour, or OPTLOC_SOAK_MINUTES: 20 kills in the first half (fewer in less time), and memory from then on."""
    pytest.importorskip("paho.mqtt.client")
    pytest.importorskip("zmq")
    pytest.importorskip("uvicorn")
    site = site_in(tmp_path)
    z = differences(site, drawn(site, 500)).tolist()
    kills = 20 if MINUTES >= 60.0 else max(3, round(MINUTES))  # a start takes seconds on a busy machine
    service, sent, code, (first, last) = soak(tmp_path, z, 60.0 * MINUTES, kills)
    account, again = service.last["account"], sum(len(each) > 1 for each in service.answered.values())
    report(f"{sent} events, {kills} kills, {service.healths} accounts; {again} answers were repeated")
    report(f"memory {first:.1f} MB, {last:.1f} MB; alarms {sorted(service.alarms)}; at the end {account}")
    assert service.errors == []
    assert code == 0
    for phase in ("fix", "proof"):
        assert {name for name, each in service.answered if each == phase} == {f"event-{i}" for i in range(sent)}
    # an answer that is repeated has a higher revision
    assert not [each for each in service.answered.values() if each != sorted(set(each))]
    assert {counts["open"] for counts in account.values()} == {0}
    assert {("source", "mqtt"), ("output", "recording")} <= service.alarms
    assert ("account", "lines") not in service.alarms
    # memory grows for ten minutes, until all that is bounded is full
    assert MINUTES < 60.0 or last <= 1.05 * first

"""Counters of a stream: latencies by phase, health as a record, and text that Prometheus reads."""

import numpy as np
import pytest

from optloc.service.metrics import COUNTS, PHASES, Metrics


def test_percentiles_are_those_of_the_latest_latencies():
    metrics = Metrics()
    assert np.isnan(metrics.percentiles("fix")).all()
    metrics.note_latency("fix", [1.0] * 4096)
    metrics.note_latency("fix", list(np.linspace(2.0, 3.0, 4096)))  # all others have left
    assert metrics.percentiles("fix") == pytest.approx([2.5, 2.99])


def test_health_tells_counts_statuses_and_silence():
    metrics = Metrics()
    metrics.add("lines", 3)
    metrics.count_event("ok", "global")
    metrics.count_event("misfit", None)
    metrics.note_rows(["B", "A"], 10.0)
    metrics.gauges["proofs"] = lambda: 7
    metrics.note_latency("fix", [0.002])
    found = metrics.health(12.5, {"version": "x"})
    assert next(iter(found)) == "version"
    assert (found["lines"], found["rows"]) == (3, 0)
    assert (found["statuses"], found["proofs"]) == ({"ok": 1, "misfit": 1}, {"global": 1})
    assert (found["queues"], found["seconds_since_row"]) == ({"proofs": 7}, {"A": 2.5, "B": 2.5})
    assert (found["fix_latency_ms"], found["proof_latency_ms"]) == ({"p50": 2.0, "p99": 2.0}, None)


def test_the_text_for_prometheus_has_every_count_and_escapes_names():
    metrics = Metrics()
    metrics.note_rows(['a"b\\c'], 1.0)
    metrics.note_latency("track", [0.5])
    lines = metrics.text(3.0).splitlines()
    assert [name for name in COUNTS if f"optloc_{name}_total 0" not in lines] == []
    assert 'optloc_silence_seconds{station="a\\"b\\\\c"} 2.0' in lines
    assert [line for line in lines if "quantile" in line and "track" not in line] == []
    values = [line.rpartition(" ") for line in lines if not line.startswith("#")]
    assert all(np.isfinite(float(value)) for _, _, value in values)
    assert set(PHASES) == {"fix", "proof", "track"}

"""What a stream counts, and how long its answers take: health as one record, and as text for Prometheus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from threading import Lock
from typing import Any

import numpy as np

from optloc.problem import Array

# Latencies that are kept, of each phase: percentiles of the last seconds under load, of the last minute at 64 a second.
_LATENCIES = 4096

PHASES = ("fix", "proof", "track")
"""Answers whose latency is told."""

COUNTS = {
    "lines": "lines read",
    "rows": "rows and arrivals read",
    "events": "events closed and answered",
    "malformed": "lines that could not be read",
    "late": "rows that came after their event was answered",
    "repeated": "rows that were there already, with the same value",
    "conflicts": "rows that were there already, with another value",
    "revisions": "answers given again with late rows",
    "incomplete": "events closed by time with rows missing",
    "early": "events closed before their time because too many were open",
    "elsewhere": "rows of events that other processes answer",
    "dropped": "messages of a broker that were dropped because the input was full",
    "refused": "requests that were refused because the input was full",
    "unsolvable": "events whose rows make no problem, or name what the site does not have",
    "tracked": "events that were taken into a track",
    "unordered": "events that came after a later one of their track, and were refused",
    "forgotten": "tracks that were forgotten: silent for too long, too many, or failed",
}
"""What is counted, and what it means."""


class Metrics:
    """Counters of one stream; safe in threads."""

    def __init__(self) -> None:
        self._lock = Lock()
        self.counts: Counter[str] = Counter(dict.fromkeys(COUNTS, 0))
        self.statuses: Counter[str] = Counter()
        self.proofs: Counter[str] = Counter()
        self.tracks: Counter[str] = Counter()
        self._latency = {phase: np.zeros(_LATENCIES) for phase in PHASES}
        self._answers: Counter[str] = Counter()
        self.heard: dict[str, float] = {}
        self.gauges: dict[str, Callable[[], int]] = {}

    def add(self, name: str, count: int = 1) -> None:
        """Count something."""
        with self._lock:
            self.counts[name] += count

    def took(self, phase: str, seconds: Sequence[float]) -> None:
        """Keep how long answers of a phase, one of `PHASES`, took from the last row of their events, seconds."""
        taken = np.asarray(seconds, dtype=float)
        with self._lock:
            place = (self._answers[phase] + np.arange(len(taken))) % _LATENCIES
            self._latency[phase][place] = taken
            self._answers[phase] += len(taken)

    def concluded(self, status: str, proof: str | None) -> None:
        """Count an event by its status, and by its proof where it has one."""
        with self._lock:
            self.statuses[status] += 1
            if proof is not None:
                self.proofs[proof] += 1

    def followed(self, status: str) -> None:
        """Count an event of a track by its status."""
        with self._lock:
            self.tracks[status] += 1

    def hear(self, stations: Iterable[str], now: float) -> None:
        """Note when stations were heard last, by the clock of the stream."""
        for name in stations:
            self.heard[name] = now

    def percentiles(self, phase: str) -> Array:
        """Return the median and the 99th percentile of the latest latencies of a phase, seconds; NaN before any."""
        with self._lock:
            count = min(self._answers[phase], _LATENCIES)
            values = self._latency[phase][:count].copy()
        return np.quantile(values, [0.5, 0.99]) if count else np.full(2, np.nan)

    def health(self, now: float, about: Mapping[str, Any]) -> dict[str, Any]:
        """Return all of it as a record.

        Parameters
        ----------
        now : float
            By the clock of the stream.
        about : mapping
            What stands in front.
        """
        with self._lock:
            out: dict[str, Any] = {
                **about,
                **self.counts,
                "statuses": dict(self.statuses),
                "proofs": dict(self.proofs),
                "tracks": dict(self.tracks),
            }
        out["queues"] = {name: depth() for name, depth in self.gauges.items()}
        for phase in PHASES:
            p50, p99 = self.percentiles(phase)
            out[f"{phase}_latency_ms"] = None if np.isnan(p50) else {"p50": _ms(p50), "p99": _ms(p99)}
        out["seconds_since_row"] = {name: round(now - when, 3) for name, when in sorted(self.heard.items())}
        return out

    def text(self, now: float) -> str:
        """Return all of it in the text format of Prometheus (version 0.0.4)."""
        found = self.health(now, {})
        lines = []
        for name, meaning in COUNTS.items():
            lines += [f"# HELP optloc_{name}_total {meaning}", f"# TYPE optloc_{name}_total counter"]
            lines.append(f"optloc_{name}_total {found[name]}")
        for name, key, meaning in (
            ("fixes_total", "statuses", "fixes by status"),
            ("proofs_total", "proofs", "proofs by outcome"),
            ("tracks_total", "tracks", "events of tracks by status"),
        ):
            label = "proof" if key == "proofs" else "status"
            lines += [f"# HELP optloc_{name} {meaning}", f"# TYPE optloc_{name} counter"]
            lines += [f'optloc_{name}{{{label}="{_label(word)}"}} {n}' for word, n in sorted(found[key].items())]
        lines += ["# HELP optloc_queue_depth what waits", "# TYPE optloc_queue_depth gauge"]
        lines += [f'optloc_queue_depth{{queue="{name}"}} {depth}' for name, depth in found["queues"].items()]
        lines += [
            "# HELP optloc_latency_seconds from the last row to the answer",
            "# TYPE optloc_latency_seconds gauge",
        ]
        for phase in PHASES:
            if not self._answers[phase]:
                continue
            for word, value in zip(("0.5", "0.99"), self.percentiles(phase), strict=True):
                lines.append(f'optloc_latency_seconds{{phase="{phase}",quantile="{word}"}} {value:.6g}')
        lines += [
            "# HELP optloc_silence_seconds since the last row of a station",
            "# TYPE optloc_silence_seconds gauge",
        ]
        lines += [
            f'optloc_silence_seconds{{station="{_label(name)}"}} {seconds}'
            for name, seconds in found["seconds_since_row"].items()
        ]
        return "\n".join(lines) + "\n"


def _ms(seconds: float) -> float:
    return round(1e3 * float(seconds), 3)


def _label(text: str) -> str:
    """Return text as the value of a label."""
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

"""Counters and latencies of a stream: health as a JSON record, and as text for Prometheus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from threading import Lock
from typing import Any

import numpy as np

from optloc.problem import Array
from optloc.service.account import SETTLED, Account
from optloc.service.alarms import Alarm

# Number of stored latencies per phase: the last seconds under load, the last minute at 64 answers a second.
_LATENCIES = 4096

PHASES = ("fix", "proof", "track")
"""Answers whose latency is measured."""

COUNTS = {
    "lines": "lines read",
    "rows": "rows and arrivals read",
    "events": "events closed and answered",
    "malformed": "lines that could not be read",
    "late": "rows received after the answer of their event",
    "repeated": "rows received again with the same value",
    "conflicts": "rows received again with another value",
    "revisions": "new answers with late rows",
    "incomplete": "events closed by time with missing rows",
    "early": "events closed before their time because too many were open",
    "elsewhere": "rows of events that other processes answer",
    "dropped": "messages of a broker dropped because the input queue was full",
    "refused": "requests refused because the input queue was full",
    "unsolvable": "events whose rows give no problem, or have names that the site does not have",
    "skipped": "proofs skipped because too many waited",
    "overdue": "proofs given up at their deadline",
    "unwritable": "answers that could not be written in the output format, or passed to a receiver",
    "tracked": "events used in a track",
    "unordered": "events refused because a later event of their track came first",
    "forgotten": "tracks removed: no events for too long, too many tracks, or failed",
}
"""Names of the counts, and their meanings."""


class Metrics:
    """Counters and latencies of one stream; thread-safe.

    Attributes
    ----------
    counts : Counter of str
        Counts by the names in `COUNTS`.
    statuses, proofs, tracks : Counter of str
        Numbers of last answers by status, of proofs by outcome, and of events of tracks by status.
    last_row : dict of str to float
        Time of the last row of each station, by the clock of the stream, s.
    gauges : dict of str to callable
        Functions that return the present length of each queue.
    account : Account
        Lines by source and state.
    alarms : dict of (str, str) to callable
        Functions that return the alarm of each part, by its kind ("source", "output" or "account") and its name.
    restarts, losses : dict of str to callable
        Functions that return the number of restarts of each source, and of dropped entries of each side output.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self.counts: Counter[str] = Counter(dict.fromkeys(COUNTS, 0))
        self.statuses: Counter[str] = Counter()
        self.proofs: Counter[str] = Counter()
        self.tracks: Counter[str] = Counter()
        # the latest latencies of each phase, s: a new value replaces the oldest; `_answers` counts all values
        self._latency = {phase: np.zeros(_LATENCIES) for phase in PHASES}
        self._answers: Counter[str] = Counter()
        self.last_row: dict[str, float] = {}
        self.gauges: dict[str, Callable[[], int]] = {}
        self.account = Account()
        self.alarms: dict[tuple[str, str], Callable[[], Alarm | None]] = {}
        self.restarts: dict[str, Callable[[], int]] = {}
        self.losses: dict[str, Callable[[], int]] = {}

    def add(self, name: str, count: int = 1) -> None:
        """Add to a count."""
        with self._lock:
            self.counts[name] += count

    def note_latency(self, phase: str, seconds: Sequence[float]) -> None:
        """Store the latencies of answers of a phase, one of `PHASES`: seconds from the last row of their events."""
        taken = np.asarray(seconds, dtype=float)
        with self._lock:
            place = (self._answers[phase] + np.arange(len(taken))) % _LATENCIES
            self._latency[phase][place] = taken
            self._answers[phase] += len(taken)

    def count_event(self, status: str, proof: str | None) -> None:
        """Count an event by its status, and by its proof if it has one."""
        with self._lock:
            self.statuses[status] += 1
            if proof is not None:
                self.proofs[proof] += 1

    def count_scan(self, status: str) -> None:
        """Count an event of a track by its status."""
        with self._lock:
            self.tracks[status] += 1

    def note_rows(self, stations: Iterable[str], now: float) -> None:
        """Store the time of the last row of stations, by the clock of the stream."""
        for name in stations:
            self.last_row[name] = now

    def percentiles(self, phase: str) -> Array:
        """Return the median and the 99th percentile of the latest latencies of a phase, seconds; NaN without any."""
        with self._lock:
            count = min(self._answers[phase], _LATENCIES)
            values = self._latency[phase][:count].copy()
        return np.quantile(values, [0.5, 0.99]) if count else np.full(2, np.nan)

    def active_alarms(self, now: float) -> list[dict[str, Any]]:
        """Return the present alarms: kind and name of the part, its error, and the seconds since which it fails."""
        found = [(kind, name, alarm()) for (kind, name), alarm in list(self.alarms.items())]
        return [
            {"part": kind, "name": name, "error": alarm.error, "seconds": round(now - alarm.since, 3)}
            for kind, name, alarm in found
            if alarm is not None
        ]

    def health(self, now: float, about: Mapping[str, Any]) -> dict[str, Any]:
        """Return all counts and latencies as a record.

        `now` is the time of the clock of the stream, s. The entries of `about` come first.
        """
        with self._lock:
            out: dict[str, Any] = {
                **about,
                **self.counts,
                "statuses": dict(self.statuses),
                "proofs": dict(self.proofs),
                "tracks": dict(self.tracks),
            }
        out["account"], out["alarms"] = self.account.records(), self.active_alarms(now)
        out["dropped_by_output"] = {name: count() for name, count in list(self.losses.items())}
        out["queues"] = {name: depth() for name, depth in self.gauges.items()}
        for phase in PHASES:
            p50, p99 = self.percentiles(phase)
            out[f"{phase}_latency_ms"] = None if np.isnan(p50) else {"p50": _ms(p50), "p99": _ms(p99)}
        out["seconds_since_row"] = {name: round(now - when, 3) for name, when in sorted(self.last_row.items())}
        return out

    def text(self, now: float) -> str:
        """Return all counts and latencies in the text format of Prometheus (version 0.0.4)."""
        found = self.health(now, {})
        lines = []
        for name, meaning in COUNTS.items():
            lines += _family(f"{name}_total", "counter", meaning, [({}, found[name])])
        for name, key, label, meaning in (
            ("fixes_total", "statuses", "status", "fixes by status"),
            ("proofs_total", "proofs", "proof", "proofs by outcome"),
            ("tracks_total", "tracks", "status", "events of tracks by status"),
        ):
            lines += _family(name, "counter", meaning, [({label: word}, n) for word, n in sorted(found[key].items())])
        lines += self._account_text(found["account"]) + self._alarm_text(found)
        depths = [({"queue": name}, depth) for name, depth in found["queues"].items()]
        lines += _family("queue_depth", "gauge", "waiting entries", depths)
        latencies = [
            ({"phase": phase, "quantile": quantile}, f"{value:.6g}")
            for phase in PHASES
            if self._answers[phase]
            for quantile, value in zip(("0.5", "0.99"), self.percentiles(phase), strict=True)
        ]
        lines += _family("latency_seconds", "gauge", "time from the last row to the answer", latencies)
        silence = [({"station": name}, seconds) for name, seconds in found["seconds_since_row"].items()]
        lines += _family("silence_seconds", "gauge", "time since the last row of a station", silence)
        return "\n".join(lines) + "\n"

    def _account_text(self, account: Mapping[str, Mapping[str, int]]) -> list[str]:
        """Return the account in the text format of Prometheus."""
        sources = sorted(account.items())
        settled = [
            ({"source": name, "state": state}, counts[state])
            for name, counts in sources
            for state in ("received", *SETTLED)
        ]
        waiting = [({"source": name}, counts["open"]) for name, counts in sources]
        meaning = "lines by source; received = answered + refused + dropped + open"
        return [
            *_family("source_lines_total", "counter", meaning, settled),
            *_family("open_lines", "gauge", "lines that wait for their answers", waiting),
        ]

    def _alarm_text(self, found: Mapping[str, Any]) -> list[str]:
        """Return alarms, restarts and losses of outputs in the text format of Prometheus; `found` is the health."""
        active = {(each["part"], each["name"]) for each in found["alarms"]}
        alarms = [({"part": part, "name": name}, int((part, name) in active)) for part, name in sorted(self.alarms)]
        restarts = [({"source": name}, count()) for name, count in sorted(self.restarts.items())]
        losses = [({"output": name}, count) for name, count in sorted(found["dropped_by_output"].items())]
        return [
            *_family("alarm", "gauge", "1 if a part does not work", alarms),
            *_family("restarts_total", "counter", "restarts of a source", restarts),
            *_family("output_dropped_total", "counter", "entries that a side output dropped", losses),
        ]


def _family(name: str, kind: str, meaning: str, samples: Sequence[tuple[Mapping[str, str], Any]]) -> list[str]:
    """Return one metric in the text format of Prometheus.

    `kind` is "counter" or "gauge". Each of `samples` has the labels of a value, and the value.
    """
    lines = [f"# HELP optloc_{name} {meaning}", f"# TYPE optloc_{name} {kind}"]
    for labels, value in samples:
        text = ",".join(f'{key}="{_label(word)}"' for key, word in labels.items())
        lines.append(f"optloc_{name}{{{text}}} {value}" if labels else f"optloc_{name} {value}")
    return lines


def _ms(seconds: float) -> float:
    """Return seconds in milliseconds, rounded to microseconds."""
    return round(1e3 * float(seconds), 3)


def _label(text: str) -> str:
    """Return text as a label value, with escapes."""
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

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

    counts: counts by the names in `COUNTS`. statuses: number of last answers by status. proofs: number of proofs by
    outcome. tracks: number of events of tracks by status. heard: time of the last row of each station by the clock of
    the stream, s. gauges: functions that return the present length of each queue. account: lines by source and state.
    alarms: functions that return the alarm of each part, by the kind of the part ("source" or "output") and its name.
    restarts: functions that return the number of restarts of each source. losses: functions that return the number of
    dropped entries of each side output.
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
        self.heard: dict[str, float] = {}
        self.gauges: dict[str, Callable[[], int]] = {}
        self.account = Account()
        self.alarms: dict[tuple[str, str], Callable[[], Alarm | None]] = {}
        self.restarts: dict[str, Callable[[], int]] = {}
        self.losses: dict[str, Callable[[], int]] = {}

    def add(self, name: str, count: int = 1) -> None:
        """Add to a count."""
        with self._lock:
            self.counts[name] += count

    def took(self, phase: str, seconds: Sequence[float]) -> None:
        """Store the latencies of answers of a phase, one of `PHASES`: seconds from the last row of their events."""
        taken = np.asarray(seconds, dtype=float)
        with self._lock:
            place = (self._answers[phase] + np.arange(len(taken))) % _LATENCIES
            self._latency[phase][place] = taken
            self._answers[phase] += len(taken)

    def concluded(self, status: str, proof: str | None) -> None:
        """Count an event by its status, and by its proof if it has one."""
        with self._lock:
            self.statuses[status] += 1
            if proof is not None:
                self.proofs[proof] += 1

    def followed(self, status: str) -> None:
        """Count an event of a track by its status."""
        with self._lock:
            self.tracks[status] += 1

    def hear(self, stations: Iterable[str], now: float) -> None:
        """Store the time of the last row of stations, by the clock of the stream."""
        for name in stations:
            self.heard[name] = now

    def percentiles(self, phase: str) -> Array:
        """Return the median and the 99th percentile of the latest latencies of a phase, seconds; NaN without any."""
        with self._lock:
            count = min(self._answers[phase], _LATENCIES)
            values = self._latency[phase][:count].copy()
        return np.quantile(values, [0.5, 0.99]) if count else np.full(2, np.nan)

    def active(self, now: float) -> list[dict[str, Any]]:
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
        out["account"], out["alarms"] = self.account.records(), self.active(now)
        out["dropped_by_output"] = {name: count() for name, count in list(self.losses.items())}
        out["queues"] = {name: depth() for name, depth in self.gauges.items()}
        for phase in PHASES:
            p50, p99 = self.percentiles(phase)
            out[f"{phase}_latency_ms"] = None if np.isnan(p50) else {"p50": _ms(p50), "p99": _ms(p99)}
        out["seconds_since_row"] = {name: round(now - when, 3) for name, when in sorted(self.heard.items())}
        return out

    def text(self, now: float) -> str:
        """Return all counts and latencies in the text format of Prometheus (version 0.0.4)."""
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
        lines += self._account_text(found["account"]) + self._alarm_text(found)
        lines += ["# HELP optloc_queue_depth waiting entries", "# TYPE optloc_queue_depth gauge"]
        lines += [f'optloc_queue_depth{{queue="{name}"}} {depth}' for name, depth in found["queues"].items()]
        lines += [
            "# HELP optloc_latency_seconds time from the last row to the answer",
            "# TYPE optloc_latency_seconds gauge",
        ]
        for phase in PHASES:
            if not self._answers[phase]:
                continue
            for word, value in zip(("0.5", "0.99"), self.percentiles(phase), strict=True):
                lines.append(f'optloc_latency_seconds{{phase="{phase}",quantile="{word}"}} {value:.6g}')
        lines += [
            "# HELP optloc_silence_seconds time since the last row of a station",
            "# TYPE optloc_silence_seconds gauge",
        ]
        lines += [
            f'optloc_silence_seconds{{station="{_label(name)}"}} {seconds}'
            for name, seconds in found["seconds_since_row"].items()
        ]
        return "\n".join(lines) + "\n"

    def _account_text(self, account: Mapping[str, Mapping[str, int]]) -> list[str]:
        """Return the account in the text format of Prometheus."""
        lines = [
            "# HELP optloc_source_lines_total lines by source; received = answered + refused + dropped + open",
            "# TYPE optloc_source_lines_total counter",
        ]
        for source, counts in sorted(account.items()):
            for state in ("received", *SETTLED):
                labels = f'source="{_label(source)}",state="{state}"'
                lines.append(f"optloc_source_lines_total{{{labels}}} {counts[state]}")
        lines += ["# HELP optloc_open_lines lines that wait for their answers", "# TYPE optloc_open_lines gauge"]
        lines += [
            f'optloc_open_lines{{source="{_label(source)}"}} {n["open"]}' for source, n in sorted(account.items())
        ]
        return lines

    def _alarm_text(self, found: Mapping[str, Any]) -> list[str]:
        """Return alarms, restarts and losses of outputs in the text format of Prometheus; `found` is the health."""
        active = {(each["part"], each["name"]) for each in found["alarms"]}
        lines = ["# HELP optloc_alarm 1 if a part does not work", "# TYPE optloc_alarm gauge"]
        lines += [
            f'optloc_alarm{{part="{part}",name="{_label(name)}"}} {int((part, name) in active)}'
            for part, name in sorted(self.alarms)
        ]
        lines += ["# HELP optloc_restarts_total restarts of a source", "# TYPE optloc_restarts_total counter"]
        lines += [
            f'optloc_restarts_total{{source="{_label(name)}"}} {n()}' for name, n in sorted(self.restarts.items())
        ]
        lines += [
            "# HELP optloc_output_dropped_total entries that a side output dropped",
            "# TYPE optloc_output_dropped_total counter",
        ]
        lines += [
            f'optloc_output_dropped_total{{output="{_label(name)}"}} {count}'
            for name, count in sorted(found["dropped_by_output"].items())
        ]
        return lines


def _ms(seconds: float) -> float:
    """Return seconds in milliseconds, rounded to microseconds."""
    return round(1e3 * float(seconds), 3)


def _label(text: str) -> str:
    """Return text as a label value, with escapes."""
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

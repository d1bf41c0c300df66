"""Answers of a stream: records of fixes, proofs and tracks.

A record is a dictionary that is written as one JSON line. An event has up to two answers: the first phase gives the
fix, the second phase gives the proof.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from optloc.problem import PROOFS, UNKNOWN, Array, Fix, Problem, Status
from optloc.service.events import Event
from optloc.service.messages import name_keys
from optloc.tracking import Entry, scan_sentence

Record = dict[str, Any]

# All threads share this encoder: it has no state.
_JSON = json.JSONEncoder(allow_nan=False, separators=(",", ":"))
_LABELS = {int(status): status.label for status in Status}
_SENTENCES = {status.label: status.sentence for status in Status}

UNNAMED = "target"
"""Name of the target of events without a target in tracks, as in files."""

# The advice for an unproven fix of a file is wrong for a stream, whose proof is a second answer with a deadline.
_PENDING = "The position is refined, but its proof is not finished, so another position is not excluded."
_BEFORE_PROOF = {int(status): status.sentence for status in Status} | {int(Status.UNPROVEN): _PENDING}
_GIVEN_UP = (
    "The position is refined, but its proof was given up, so another position is not excluded; raise '--deadline', or "
    "divide the events with '--partition'."
)


def fix_records(fix: Fix, events: Sequence[Event], phase: str | None, *, pending: bool = False) -> list[Record]:
    """Return the answers to the events of a batch (n,): metres in the frame of the site, degrees; None for no number.

    `phase` is the phase of the answer, None for a single answer. `pending` is whether proofs follow.
    """
    position, covariance = fix.position, fix.covariance()
    known = np.asarray(np.isfinite(position).all(-1))
    # `wild` (n, d) marks coordinates that the data do not determine. Their covariance is not written.
    wild = fix.undetermined()
    has_cov = np.asarray(known & np.isfinite(covariance).all((-1, -2)) & ~wild.any(-1))
    columns: dict[str, list[Any]] = {} if phase is None else {"phase": [phase] * len(events)}
    columns |= {
        "status": [_LABELS[code] for code in fix.code.tolist()],
        "sentence": _sentences(fix, pending=pending),
        "position": _known(position, known),
        "cov": _known(covariance, has_cov),
        "cost": _known(fix.cost, np.isfinite(fix.cost)),
        "dof": fix.dof.tolist(),
    }
    if fix.frame.geodetic:
        lat, lon, height = fix.frame.to_geodetic(np.where(known[:, None], position, 0.0))
        for name, values in (("lat_deg", np.degrees(lat)), ("lon_deg", np.degrees(lon)), ("height", height)):
            columns[name] = _known(values, known)
    names, others, alone = ("event", *columns), _alternatives(fix), np.ravel(fix.unchecked)
    made = [
        dict(zip(names, row, strict=True))
        for row in zip((_id_of(event) for event in events), *columns.values(), strict=True)
    ]
    for i, (record, event) in enumerate(zip(made, events, strict=True)):
        record["alternatives"] = others.get(i, [])
        if fix.reason[i]:
            record["reason"] = fix.reason[i]
        if alone[i]:
            record["unchecked"] = True
        if wild[i].any():
            record["undetermined"] = ["xyz"[axis] for axis in np.flatnonzero(wild[i])]
        _add_exceptions(record, event)
    return made


def _sentences(fix: Fix, *, pending: bool) -> list[str]:
    """Return the sentence of the status of each fix of a batch (n,); `pending` is whether proofs follow."""
    if pending:
        return [_BEFORE_PROOF[code] for code in fix.code.tolist()]
    return np.ravel(fix.sentence).tolist()


def unsolved_record(event: Event, phase: str = "fix", **why: Any) -> Record:
    """Return the answer to an event without a position; `why` is its status, or an error, with other entries."""
    if "status" in why:
        status = why["status"]
        why["sentence"] = scan_sentence(status) if phase == "track" else _SENTENCES[status]
    record = {"event": _id_of(event), "phase": phase, **why, "position": None}
    _add_exceptions(record, event)
    return record


def _id_of(event: Event) -> str:
    """Return the id of an event, without the name of its client."""
    return event.name.rpartition("\n")[2]


def _known(values: Array, known: Array) -> list[Any]:
    """Return `values` (n, ...) as a list with one entry for each event, None where `known` (n,) is false."""
    given: list[Any] = values.tolist()
    return (
        given if known.all() else [value if good else None for value, good in zip(given, known.tolist(), strict=True)]
    )


def _alternatives(fix: Fix) -> dict[int, list[Record]]:
    """Return the other positions of the events of a batch, by event number; events without any are absent.

    Each entry has the position in metres and the gap, which is its cost (chi-square) minus the cost of the fix.
    """
    gap = fix.alternatives.gap
    if not gap.shape[-1]:
        return {}
    place, out = fix.layout.take(fix.alternatives.x, "position"), {}
    for i in np.flatnonzero(np.isfinite(gap).any(-1)).tolist():
        shown = np.isfinite(gap[i])
        pairs = zip(place[i][shown].tolist(), gap[i][shown].tolist(), strict=True)
        out[i] = [{"position": x, "gap": g} for x, g in pairs]
    return out


def _add_exceptions(record: Record, event: Event) -> None:
    """Add the properties of an event that not all events have: client, time, closing reason, revision, and others."""
    if event.when is not None:
        record.setdefault("time", event.when * 1e-12)
    if _id_of(event) != event.name:
        record |= name_keys(event.name)
    if event.closed != "whole":
        record["closed"] = event.closed
    if event.revision > 1:
        record["revision"] = event.revision
    if event.conflict:
        record["conflict"] = True
    if event.target:
        record["target"] = event.target


def proof_records(fix: Fix, events: Sequence[Event], before: Sequence[Record | None]) -> list[Record]:
    """Return the answers of the second phase (n): the proof alone, or a better fix with its proof.

    `fix` has the fixes (n,) of the whole method. `before` has the answers of the first phase. If an entry is None, or
    the fix has changed, the answer includes the fix.
    """
    records = fix_records(fix, events, None)
    out = []
    proofs = (column.tolist() for column in (fix.claims.proof, fix.claims.margin, fix.claims.boxes, fix.claims.reason))
    # `number` is the outcome of the proof, as an index of `PROOFS`.
    for new, old, number, margin, boxes, reason in zip(records, before, *proofs, strict=True):
        proof: Record = {"proof": PROOFS[number], "margin": margin, "boxes": boxes}
        if number == UNKNOWN:
            proof["why"] = reason
        if old is None:
            out.append(new | proof)
        elif _is_same_fix(new, old):
            changed = {
                key: new[key] for key in ("alternatives", "revision", "reason", "target", "client") if new.get(key)
            }
            kept = {key: new[key] for key in ("event", "status", "sentence")}
            out.append({"event": kept.pop("event"), "phase": "proof", **kept, **proof, **changed})
        else:
            head = {"event": new.pop("event"), "phase": "proof"}
            out.append(head | new | proof | {"revised": True})
    return out


# Relative difference of costs and coordinates that is rounding: the whole method refines to eleven digits.
_ROUNDING = 1e-9


def _is_same_fix(new: Record, old: Record) -> bool:
    """Return whether the whole method gives the same fix as the first phase: `new` and `old` are their answers.

    Positions may differ by rounding. Both fixes must have a covariance, or both none; the covariances are not compared.
    """
    if new["position"] is None or old["position"] is None:
        return bool(new["position"] == old["position"])
    size = 1.0 + max(map(abs, old["position"]))
    difference = max(abs(a - b) for a, b in zip(new["position"], old["position"], strict=True))
    return bool(difference <= _ROUNDING * size and (new["cov"] is None) == (old["cov"] is None))


def track_record(event: Event, time: float, entry: Entry, problem: Problem) -> Record:
    """Return the answer to an event of a track: metres and seconds in the frame of the site, angles in degrees.

    `time` is the time of the event, s. `entry` is the result of the scan, with a state of position, velocity and
    acceleration, or fewer of them. `problem` gives the dimension and the frame. The value `cov` is the covariance of
    the state. `nis` is the normalised innovation squared of the scan.
    """
    d, mean = problem.dimension, entry.updated.mean
    known = bool(np.isfinite(mean).all())
    record: Record = {"event": _id_of(event), "phase": "track", "target": UNNAMED, "time": time}
    record |= {"status": entry.label, "sentence": scan_sentence(entry.label)}
    for i, name in enumerate(("position", "velocity", "acceleration")[: len(mean) // d]):
        record[name] = mean[i * d : (i + 1) * d].tolist() if known else None
    record["cov"] = entry.updated.cov.tolist() if known else None
    if problem.frame.geodetic and known:
        lat, lon, height = problem.frame.to_geodetic(mean[:d])
        record |= {"lat_deg": float(np.degrees(lat)), "lon_deg": float(np.degrees(lon)), "height": float(height)}
    nis = float(entry.updated.nis)
    record |= {"nis": nis if np.isfinite(nis) else None, "rows": int(entry.updated.count), "rejected": entry.rejected}
    if entry.reason:
        record["reason"] = entry.reason
    _add_exceptions(record, event)
    return record


def unproven_record(event: Event, why: str, fix: Record, *, answered: bool) -> Record:
    """Return the answer to an event whose proof was not finished.

    `why` is "deadline" or "skipped: load". `fix` is the answer of the first phase. With `answered`, it was already
    written, so it is left out.
    """
    about = {"status": fix["status"], "sentence": fix["sentence"]}
    if fix["status"] == Status.UNPROVEN.label:
        about["sentence"] = _GIVEN_UP
    about |= {"proof": "unknown", "margin": 0.0, "boxes": 0, "why": why}
    if not answered:
        return fix | about
    about |= {"target": event.target} if event.target else {}
    about |= {"revision": event.revision} if event.revision > 1 else {}
    return {**name_keys(event.name), "phase": "proof", **about}


def join(first: Record | None, then: Record) -> Record:
    """Return the answers of both phases of an event as one record.

    `first` is the answer of the first phase, or None. Its values are replaced by the values of `then`, the later
    answer.
    """
    left_out = ("phase", "reason")  # the second phase replaces the reason of the first
    kept = {} if first is None else {key: value for key, value in first.items() if key not in left_out}
    return kept | {key: value for key, value in then.items() if key != "phase"}


def to_line(record: Record) -> bytes:
    """Return a record as one line of strict JSON; numbers that are not finite become null."""
    try:
        return _JSON.encode(record).encode() + b"\n"
    except ValueError:
        return _JSON.encode(finite(record)).encode() + b"\n"


def finite(value: Any) -> Any:
    """Return a value of JSON with null (None) instead of each number that is not finite, at all depths."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [finite(inner) for inner in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value

"""The text of a comparison: what was compared, the differences by group, and the totals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby

import numpy as np

from recorder.comparison import KINDS, Difference, place, sigmas
from recorder.recording import Key, Record, Recording, numbers


def listing(old: Recording, new: Recording, differences: list[Difference], most: int | None = None) -> Iterator[str]:
    """Yield the lines of a comparison; of each group at most so many differences."""
    yield _version("old", old)
    yield _version("new", new)
    for group, members in groupby(differences, key=lambda one: (one.kind, one.group)):
        listed = list(members)
        yield f"\n{group[0]}: {group[1]} ({len(listed)})"
        for one in listed[:most]:
            yield f"  {_line(old, new, one)}"
        if most is not None and len(listed) > most:
            yield f"  and {len(listed) - most} more"
    yield from _totals(old, new, differences)


def _version(word: str, recording: Recording) -> str:
    head = recording.head
    machine = ", ".join([head["machine"]["platform"], *head["machine"]["blas"]])
    return f"{word}: optloc {head['optloc']}, code {head['code']}, {head['date']}, {machine}"


def _line(old: Recording, new: Recording, one: Difference) -> str:
    if one.key is None:
        return one.text
    return " ".join(part for part in (f"{place(*one.key)}:", one.text, _context(old, new, one.key)) if part)


def _context(old: Recording, new: Recording, key: Key) -> str:
    """Return status, cost and error of both fixes: whether the difference is an improvement."""
    if key not in old.fixes or key not in new.fixes:
        return ""
    before, after = (
        _state(recording.fixes[key], recording.scenes.get(key[:3], {}).get("truth", {})) for recording in (old, new)
    )
    return f"({before})" if before == after else f"({before} -> {after})"


def _state(fix: Record, truth: Record) -> str:
    if "cost" not in fix:
        return fix.get("status", "exception")
    away = error(fix, truth)
    distance = f"{away:.3g} sigma from the truth" if np.isfinite(away) else "no estimate"
    return f"{fix['status']}, cost {float(fix['cost']):.4g}, {distance}"


def error(fix: Record, truth: Record) -> float:
    """Return the largest error of a coordinate in its standard deviations."""
    errors = [0.0]
    for name in [name for name in truth if name in fix.get("estimate", {})]:
        away = numbers(fix["estimate"][name]) - numbers(truth[name])
        errors.append(float(np.abs(away / sigmas(fix, name, len(away))).max()))
    return float(np.max(errors))


def _totals(old: Recording, new: Recording, differences: list[Difference]) -> Iterator[str]:
    both = [key for key in old.fixes if key in new.fixes]
    differing = {one.key for one in differences}.intersection(both)
    identical = sum(_values(old.fixes[key]) == _values(new.fixes[key]) for key in both)
    equal = len(both) - len(differing)
    yield f"\n{len(both)} fixes in both: {identical} identical, {equal} equal, {len(differing)} differ"
    counts = Counter(kind for kind, _ in {(one.kind, one.key) for one in differences if one.key in differing})
    if counts:
        yield f"fixes by kind of difference: {', '.join(f'{kind} {counts[kind]}' for kind in KINDS if counts[kind])}"
    for name, recording in (("old", old), ("new", new)):
        missing = recording.head["fixes"] - len(recording.fixes)
        if missing:
            yield f"the {name} recording is not complete: {missing} of {recording.head['fixes']} fixes are missing"
    seconds, boxes = ([_sum(recording, both, part) for recording in (old, new)] for part in (_seconds, _boxes))
    yield f"CPU seconds {seconds[0]:.1f} -> {seconds[1]:.1f}, boxes of proofs {boxes[0]:.0f} -> {boxes[1]:.0f}"


def _values(fix: Record) -> Record:
    return {name: value for name, value in fix.items() if name != "seconds"}


def _seconds(fix: Record) -> float:
    return fix["seconds"]


def _boxes(fix: Record) -> float:
    return fix.get("certificate", {}).get("boxes", 0)


def _sum(recording: Recording, keys: Iterable[Key], part: Callable[[Record], float]) -> float:
    return sum(part(recording.fixes[key]) for key in keys)

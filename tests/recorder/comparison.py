"""Differences of two recordings, one by one, each of a kind and with the numbers that explain it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from recorder.recording import Key, Record, Recording, numbers

# A fix without a covariance has moved by its distance in metres: the noise of the cases is of this order.
NO_SIGMA = 1.0
# Two minima are the same where they are within one standard deviation of each other; others are kilometres apart.
SAME_MINIMUM = 1.0
# From strong to weak. A word that is not in the list is only "changed".
PROOFS = ("global", "region", "blockwise", "local", "unknown")
_NUMBER = re.compile(r"[-+]?(?:\d[\d.,]*(?:e[-+]?\d+)?|\binf\b|\bnan\b)")


@dataclass(frozen=True)
class Tolerance:
    """Differences that another processor or BLAS may cause, measured with OPENBLAS_CORETYPE=Sandybridge."""

    # In sigma: robust losses stop at steps of 1e-6, and the ends of two such iterations were 3e-6 apart.
    estimate: float = 1e-5
    cost: float = 1e-9
    covariance: float = 1e-6
    bound: float = 1e-6
    gap: float = 1e-6
    # Of an alternative, also relative to its distance from the fix: far minima are flat, and ended 7e-9 apart.
    distance: float = 1e-8
    weight: float = 1e-6
    # Relative, of each coordinate: 16 roundings.
    rounding: float = 4e-15

    def times(self, factor: float) -> Tolerance:
        """Return all tolerances times a factor."""
        return Tolerance(*(factor * getattr(self, field.name) for field in fields(self)))


@dataclass(frozen=True)
class Difference:
    """One difference: its kind, the group that it is listed in, the fix (None for a whole problem), and the values."""

    kind: str
    group: str
    key: Key | None
    text: str


# A group and a text.
Found = Iterator[tuple[str, str]]


def compare(old: Recording, new: Recording, tolerance: Tolerance) -> list[Difference]:
    """Return all differences, by kind and group, in the order of the recordings."""
    found = [*_problems(old, new), *_missing("old", old, new), *_missing("new", new, old)]
    for key in _common(old.fixes, new.fixes):
        one, two = old.fixes[key], new.fixes[key]
        skipped = _skipped(one, two) if tolerance.estimate > 0.0 else ()
        for kind, differ in OF_A_FIX.items():
            if kind not in skipped:
                found += [Difference(kind, group, key, text) for group, text in differ(one, two, tolerance)]
    return sorted(found, key=lambda one: (KINDS.index(one.kind), one.group))


def _skipped(old: Record, new: Record) -> tuple[str, ...]:
    """Return the kinds whose numbers mean nothing for two fixes of one status."""
    return MEANINGLESS.get(old.get("status", ""), ()) if old.get("status") == new.get("status") else ()


def _problems(old: Recording, new: Recording) -> Iterator[Difference]:
    """Yield the problems of both recordings whose measurements, weights or truths differ: their fixes must differ."""
    for scene in _common(old.scenes, new.scenes):
        one, two = old.scenes[scene], new.scenes[scene]
        changed = [part for part in ("z", "weight", "truth") if one[part] != two[part]]
        if changed:
            yield Difference("problem", "the problems differ", None, f"{place(*scene)}: {', '.join(changed)}")


def _missing(name: str, one: Recording, other: Recording) -> Iterator[Difference]:
    """Yield what only one recording has: problems, methods, and then single fixes."""
    group, methods = f"only in the {name} recording", {key[3] for key in other.fixes}
    alone = dict.fromkeys(key[:3] for key in one.fixes if key[:3] not in other.scenes)
    yield from (Difference("missing", group, None, f"{place(*scene)} by all methods") for scene in alone)
    shared = [key for key in one.fixes if key[:3] not in alone and key not in other.fixes]
    new = dict.fromkeys(key[3] for key in shared if key[3] not in methods)
    yield from (Difference("missing", group, None, f"all problems by {method}") for method in new)
    yield from (Difference("missing", group, key, "") for key in shared if key[3] in methods)


def place(case: str, variant: str, seed: int, method: str = "") -> str:
    """Return how a line calls a problem or a fix."""
    return f"{case} {variant} seed {seed} {method}".strip()


def _common(old: Mapping[Any, Any], new: Mapping[Any, Any]) -> list[Any]:
    """Return the keys of both, in the order of the first."""
    return [key for key in old if key in new]


def _exception(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = old.get("error"), new.get("error")
    if one != two:
        group = "exception gone" if two is None else "new exception" if one is None else "another exception"
        yield group, f"{one} -> {two}"


def _status(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = old.get("status", "exception"), new.get("status", "exception")
    if one != two:
        yield f"status {one} -> {two}", f"{old.get('reason')!r} -> {new.get('reason')!r}"


def _findings(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = (fix.get("findings", []) for fix in (old, new))
    # The first finding is the status, which has a kind of its own.
    if old.get("status") == new.get("status") and one != two:
        gone, more = (sorted(set(a) - set(b)) for a, b in ((one, two), (two, one)))
        yield "findings changed", "; ".join([f"no longer {name}" for name in gone] + [f"now {name}" for name in more])


# Estimates.


def _estimate(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = (fix.get("estimate", {}) for fix in (old, new))
    if one.keys() != two.keys():
        yield "other unknowns", f"{', '.join(one)} -> {', '.join(two)}"
    for name in _common(one, two):
        before, after = numbers(one[name]), numbers(two[name])
        if np.isfinite(before).all() != np.isfinite(after).all():
            lost = bool(np.isfinite(before).all())
            yield "estimate lost" if lost else "estimate gained", f"{name} {_listed(before)} -> {_listed(after)}"
            continue
        away = moved(before, after, sigmas(old, name, len(before)), tolerance.rounding * np.abs(before))
        if away > tolerance.estimate:
            yield "estimate moved", f"{name} by {away:.3g} sigma, {_listed(before)} -> {_listed(after)}"


def moved(before: np.ndarray, after: np.ndarray, sigma: np.ndarray, allowed: np.ndarray | float) -> float:
    """Return the largest move of a coordinate in sigma, beyond an allowed one; 0 where both are not finite."""
    absent = ~np.isfinite(before) & ~np.isfinite(after)
    before, after = np.where(absent, 0.0, before), np.where(absent, 0.0, after)
    away = np.maximum(np.abs(after - before) - np.nan_to_num(allowed), 0.0) / sigma
    return float(np.nan_to_num(away, nan=np.inf).max(initial=0.0))


def sigmas(fix: Record, name: str, size: int) -> np.ndarray:
    """Return the standard deviations of a named part; those of the position where a part has no covariance."""
    covariance = fix.get("covariance", {})
    block = covariance.get(name, covariance.get("position"))
    values = np.full(size, NO_SIGMA) if block is None else np.sqrt(np.diagonal(numbers(block)))
    if len(values) != size:
        values = np.full(size, values.max())
    return np.where(np.isfinite(values) & (values > 0.0), values, NO_SIGMA)


def _covariance(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = (fix.get("covariance", {}) for fix in (old, new))
    for name in _common(one, two):
        before, after = numbers(one[name]), numbers(two[name])
        if np.isfinite(before).all() != np.isfinite(after).all():
            yield "covariance lost" if np.isfinite(before).all() else "covariance gained", name
            continue
        scale = sigmas(old, name, len(before))
        change = np.abs(np.nan_to_num(after) - np.nan_to_num(before)) / np.outer(scale, scale)
        if change.max() > tolerance.covariance:
            widths = (np.sqrt(np.diagonal(block)) for block in (before, after))
            text = f"{name} by {change.max():.3g}, sigma {' -> '.join(_listed(width) for width in widths)}"
            yield "covariance changed", text


def _cost(old: Record, new: Record, tolerance: Tolerance) -> Found:
    if _is_changed(one := _number(old, "cost"), two := _number(new, "cost"), tolerance.cost):
        word = "lower" if two < one else "higher" if two > one else "lost" if np.isnan(two) else "gained"
        yield f"cost {word}", f"by {two - one:.3g}, {one:.9g} -> {two:.9g}"
    if old.get("dof") != new.get("dof"):
        yield "degrees of freedom changed", f"{old.get('dof')} -> {new.get('dof')}"


# Certificates.


def _certificate(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = (fix.get("certificate", {}) for fix in (old, new))
    before, after = one.get("proof"), two.get("proof")
    if before != after:
        known = before in PROOFS and after in PROOFS
        weaker = known and PROOFS.index(before) < PROOFS.index(after)
        word = "weaker" if weaker else "stronger" if known else "changed"
        yield f"certificate {word}: {before} -> {after}", f"{one.get('reason')!r} -> {two.get('reason')!r}"
        return
    if one.get("unique") != two.get("unique"):
        word = "lost" if one.get("unique") else "gained"
        yield f"uniqueness {word}", f"margin {one.get('margin')} -> {two.get('margin')}, {two.get('reason')!r}"
    elif _is_changed(_number(one, "margin"), _number(two, "margin"), tolerance.gap):
        yield "margin changed", f"{one['margin']} -> {two['margin']}"


def _bound(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = (fix.get("certificate", {}) for fix in (old, new))
    for name in ("bound", "gap"):
        if _is_changed(before := _number(one, name), after := _number(two, name), tolerance.bound):
            yield f"{name} of the certificate changed", f"by {after - before:.3g}, {before:.9g} -> {after:.9g}"
    region = [numbers(certificate.get("region") or []) for certificate in (one, two)]
    size = [np.ptp(corners, axis=0) if corners.size else 0.0 for corners in region]
    if region[0].shape != region[1].shape or (np.abs(region[1] - region[0]) > tolerance.bound * size[0]).any():
        yield "region of the certificate changed", f"{one.get('region')} -> {two.get('region')}"


def _alternatives(old: Record, new: Record, tolerance: Tolerance) -> Found:
    def apart(one: Record, two: Record) -> float:
        moves = [0.0]
        for name in _common(one["estimate"], two["estimate"]):
            before, after, best = (numbers(fix["estimate"][name]) for fix in (one, two, old))
            allowed = tolerance.distance * np.linalg.norm(before - best) + tolerance.rounding * np.abs(before)
            moves.append(moved(before, after, sigmas(old, name, len(before)), allowed))
        return max(moves)

    left = list(new.get("alternatives", []))
    for rival in old.get("alternatives", []):
        distances = [apart(rival, other) for other in left]
        nearest = int(np.argmin(distances)) if left else -1
        if not left or distances[nearest] > SAME_MINIMUM:
            yield "alternative lost", _rival(rival)
            continue
        other, away = left.pop(nearest), distances[nearest]
        if away > tolerance.estimate:
            yield "alternative moved", f"by {away:.3g} sigma, {_rival(rival)} -> {_rival(other)}"
        if _is_changed(float(rival["gap"]), float(other["gap"]), tolerance.gap):
            yield "gap of an alternative changed", f"{rival['gap']:.9g} -> {other['gap']:.9g}, {_rival(rival)}"
    for rival in left:
        yield "new alternative", _rival(rival)


def _rival(rival: Record) -> str:
    estimate = ", ".join(f"{name} {_listed(numbers(value))}" for name, value in rival["estimate"].items())
    return f"{estimate} with gap {rival['gap']:.6g}"


def _weights(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = (numbers(fix.get("weights", [])) for fix in (old, new))
    if one.shape != two.shape:
        yield "weights of other rows", f"{len(one)} -> {len(two)} rows"
        return
    rows = np.flatnonzero(~np.isclose(one, two, rtol=0.0, atol=tolerance.weight, equal_nan=True))
    if len(rows):
        yield "weights changed", ", ".join(f"row {i}: {one[i]:.6g} -> {two[i]:.6g}" for i in rows)


def _suspects(old: Record, new: Record, tolerance: Tolerance) -> Found:
    one, two = (fix.get("suspects", []) for fix in (old, new))
    if one != two:
        yield "suspects changed", f"{_explanations(one)} -> {_explanations(two)}"


def _explanations(suspects: list[list[str]]) -> str:
    return " or ".join(" and ".join(names) or "nothing wrong" for names in suspects) or "no explanation"


def _wording(old: Record, new: Record, tolerance: Tolerance) -> Found:
    """Yield texts that differ by more than their numbers, for the same status and the same proof word."""
    texts = [("status", "reason", old, new)]
    one, two = (fix.get("certificate", {}) for fix in (old, new))
    texts += [("proof", "reason", one, two), ("proof", "method", one, two)]
    for same, part, before, after in texts:
        pair = [_NUMBER.sub("#", str(text.get(part, ""))) for text in (before, after)]
        if before.get(same) == after.get(same) and pair[0] != pair[1]:
            yield f"{part} of the {'fix' if same == 'status' else 'certificate'}: {pair[0]!r} -> {pair[1]!r}", ""


OF_A_FIX: dict[str, Callable[[Record, Record, Tolerance], Found]] = {
    "exception": _exception,
    "status": _status,
    "findings": _findings,
    "estimate": _estimate,
    "covariance": _covariance,
    "cost": _cost,
    "certificate": _certificate,
    "bound": _bound,
    "alternatives": _alternatives,
    "weights": _weights,
    "suspects": _suspects,
    "wording": _wording,
}

_NUMBERS = ("estimate", "covariance", "cost", "bound", "alternatives", "weights")
MEANINGLESS = {
    # an iteration without convergence ends where the last bits of its steps lead
    "max iterations": _NUMBERS,
    "stalled": _NUMBERS,
    # the minima are a curve, and the alternatives are any points of it
    "singular geometry": ("alternatives",),
}
"""The kinds of difference that are skipped for fixes of a status."""

KINDS = ("problem", "missing", *OF_A_FIX)
"""The kinds of difference, in the order in which they are listed."""


# Numbers.


def _number(record: Record, name: str) -> float:
    value = record.get(name)
    return float("nan") if value is None else float(value)


def _is_changed(one: float, two: float, tolerance: float) -> bool:
    """Return whether two costs differ by more than a tolerance, relative to the larger of 1 and the first."""
    if np.isfinite(one) and np.isfinite(two):
        return abs(two - one) > tolerance * max(1.0, abs(one))
    return not (one == two or (np.isnan(one) and np.isnan(two)))


def _listed(values: np.ndarray) -> str:
    return "[" + " ".join(f"{value:.10g}" for value in values) + "]"

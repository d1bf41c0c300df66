"""Marks of the advice on planted causes: whether it is first, listed, or another cause is given alone."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from advice.judge import STATION, Verdict, verdict
from advice.planted import PAIRS, Draw, drawn
from advice.scene import loaded

import optloc
from optloc.advice import Advice, advise

# Advice on the geometry, and advice that names no cause of a misfit.
NO_CAUSE = frozenset({"plane", "line", "mirror", "redundancy", "impossible", "constraint"})
# Checks before the fix have names of their own.
_OTHER_NAMES = {"slant": "height", "wrap": "period", "size": "unit"}


@dataclass(frozen=True)
class Mark:
    """The advice on one draw against its planted cause and the scores of the judge.

    - given: causes with their stations, in the order of the advice.
    - first, listed: whether the planted cause is first, and whether it is listed.
    - alone: whether another cause is given alone; `near`: whether the stations of this cause are guilty.
    - rivals: the best explanations of the judge.
    - seconds: of the fix and of the advice.
    """

    pair: str
    seed: int
    cause: str | None
    stations: tuple[int, ...]
    size: float
    status: str
    given: tuple[tuple[str, tuple[int, ...]], ...]
    first: bool
    listed: bool
    alone: bool
    near: bool
    identifiable: bool
    lead: float
    rivals: tuple[tuple[str, tuple[int, ...], float], ...]
    seconds: tuple[float, float]

    @property
    def wrong(self) -> bool:
        """Return whether a wrong cause is given alone; the same station with another error is not wrong."""
        return self.alone and not self.near

    def line(self) -> str:
        """Return the mark as one line of text."""
        given = ", ".join(f"{cause}{list(who) or ''}" for cause, who in self.given) or "nothing"
        rivals = ", ".join(f"{cause}{list(who) or ''} {score:.0f}" for cause, who, score in self.rivals)
        what = f"{self.cause}{list(self.stations) or ''} of size {self.size:.3g}"
        return f"{self.pair} {self.seed}: planted {what}, lead {self.lead:.0f}; advice: {given}; judge: {rivals}"


def causes(advice: Iterable[Advice]) -> list[tuple[str, tuple[int, ...]]]:
    """Return the causes of a misfit with the numbers of their stations, in the order of the advice."""
    out = []
    for one in advice:
        if one.cause not in NO_CAUSE:
            names = getattr(one, "station", ()) or re.findall(r"\bS\d+\b", f"{one.toml} {one.seen}")
            out.append((_OTHER_NAMES.get(one.cause, one.cause), tuple(sorted({int(n[1:]) for n in names}))))
    return out


def right(draw: Draw, found: Verdict, cause: str, stations: tuple[int, ...]) -> bool:
    """Return whether a cause is the planted one, or another name of it that no data separate from it."""
    if cause == draw.cause:
        return not draw.stations or stations == draw.stations
    if {cause, draw.cause} == {"unit", "coordinate-unit"}:
        cost = {
            name: min((one.cost for one in found.scores if one.cause == name), default=np.inf)
            for name in (cause, draw.cause)
        }
        return bool(abs(cost[cause] - cost[draw.cause]) < 1.0)
    single = len(draw.data.z) == 1 and stations == draw.stations
    return single and {cause, draw.cause} <= {"offset", "outlier", "drift", "moved"}


def near(draw: Draw, cause: str, stations: tuple[int, ...]) -> bool:
    """Return whether the stations of a cause are guilty, though of another error."""
    return bool(stations) and draw.cause in (*STATION, "noise") and set(stations) <= set(draw.stations)


def marked(pair: str, seed: int, folder: Path, found: Verdict | None = None) -> Mark:
    """Return the mark of the advice on a draw; `found` are the scores of the judge, if they are known."""
    draw = drawn(pair, seed)
    problem = loaded(draw.data, folder)
    began = perf_counter()
    fix = optloc.solve(problem)
    middle = perf_counter()
    advice = causes(advise(problem, fix))
    seconds = (middle - began, perf_counter() - middle)
    found = found or verdict(draw)
    good = [right(draw, found, *one) for one in advice]
    status = Counter(one.label for one in np.ravel(fix.statuses)).most_common(1)[0][0]
    return Mark(
        pair,
        seed,
        draw.cause,
        draw.stations,
        float(draw.size),
        status,
        tuple(advice),
        bool(good) and good[0],
        any(good),
        len(advice) == 1 and not good[0],
        len(advice) == 1 and near(draw, *advice[0]),
        bool(draw.cause is not None and found.identifiable),
        float(found.lead),
        tuple((one.cause, one.stations, float(one.score)) for one in found.scores[:4]),
        seconds,
    )


def mark_of(stored: dict[str, Any]) -> Mark:
    """Return the mark that was stored as JSON."""
    lists = {
        key: tuple(tuple(tuple(v) if isinstance(v, list) else v for v in one) for one in stored[key])
        for key in ("given", "rivals")
    }
    return Mark(**(stored | lists | {key: tuple(stored[key]) for key in ("stations", "seconds")}))


@dataclass(frozen=True)
class Counts:
    """Counts of the marks of one pair."""

    draws: int
    identifiable: int
    first: int
    listed: int
    wrong: int
    near: int
    wrong_identifiable: int
    silent: int
    confused: Counter

    @classmethod
    def of(cls, marks: list[Mark]) -> Counts:
        """Return the counts: first, listed and silent of the identifiable draws, wrong of all draws."""
        sure = [mark for mark in marks if mark.identifiable]
        confused = Counter(mark.given[0][0] for mark in sure if mark.given and not mark.first)
        return cls(
            len(marks),
            len(sure),
            sum(mark.first for mark in sure),
            sum(mark.listed for mark in sure),
            sum(mark.wrong for mark in marks),
            sum(mark.alone and mark.near for mark in marks),
            sum(mark.wrong for mark in sure),
            sum(not mark.given for mark in sure),
            confused,
        )

    @property
    def cells(self) -> list[object]:
        """Return the cells of a row of the table."""
        n = max(self.identifiable, 1)
        wrongs = ", ".join(f"{cause} {count}" for cause, count in self.confused.most_common(4))
        shares = [f"{100 * count / n:.0f} %" for count in (self.first, self.listed)]
        return [
            self.draws,
            self.identifiable,
            *shares,
            self.silent,
            self.wrong,
            self.wrong_identifiable,
            self.near,
            wrongs,
        ]


def false_alarms(marks: list[Mark]) -> Counter:
    """Return the first causes that are given for data without a mistake."""
    return Counter(mark.given[0][0] for mark in marks if mark.cause is None and mark.given)


PLANTED = [name for name, pair in PAIRS.items() if pair.cause]
CLEAN = [name for name, pair in PAIRS.items() if not pair.cause]

"""The benchmark of kinds: processor time in units of one SciPy solution, with statuses and costs of the answers.

Run as ``python kinds_table.py OUT.json [answers]``; with "answers" nothing is timed.
"""

from __future__ import annotations

import gc
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import ceil
from pathlib import Path
from time import process_time

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.kinds import KINDS, TRIALS, Answers, Case, Way
from benchmarks.kinds_of_work import work
from benchmarks.rounds import ONE_THREAD, ROOT, interpreter

Array = np.ndarray
WAYS = ("prepare", "solve", "auto", "batch", "opponent")
# Rounds, and seconds of one way after which there are no more of them; two there are always.
ROUNDS, ENOUGH = 5, 2.0
# Seconds of the unit, about.
UNIT = 2e-4
# Seconds: passes over the trials are repeated below the first and take fewer trials, three at least, above the second.
SHORT, LONG = 0.02, 0.3
# Relative difference of costs that are the same minimum; costs below one are compared with one.
SAME = 1e-6
# Relative difference of errors of the same estimates: a step of a millionth of a standard deviation ends iterations.
ESTIMATE = 1e-4
ANSWERS = ("statuses", "statuses of the batch", "same cost, solve", "same cost, auto", "cost", "error, m")
HEADER = ("kind", *WAYS, "batch of", *ANSWERS, "opponent's method")


@dataclass
class Row:
    """What was found for one row.

    Parameters
    ----------
    name, opponent : str
        Of the case.
    seconds : dict of str to float
        Processor time of one answer by way, in the quietest round.
    units : dict of str to float
        Time of the unit just before, in the quietest round.
    batch : int
        Answers of the batch.
    answers : dict of str to str
        Cells of `ANSWERS`.
    costs : list of float
        Of the opponent's trials.
    """

    name: str
    opponent: str
    seconds: dict[str, float] = field(default_factory=dict)
    units: dict[str, float] = field(default_factory=dict)
    batch: int = 0
    answers: dict[str, str] = field(default_factory=dict)
    costs: list[float] = field(default_factory=list)


def timed(way: Way, each: float) -> float:
    """Return the seconds of an answer in the quietest pass, for a call that takes about so long."""
    best, calls = np.inf, way.ready()
    count = int(np.clip(LONG / each, min(3, len(calls)), len(calls)))
    for _ in range(int(np.clip(ceil(SHORT / (each * count)), 1, 20))):
        calls = way.ready()[:count]
        began = process_time()
        for call in calls:
            call()
        best = min(best, (process_time() - began) / count)
    return best / way.size


def solved(way: Way) -> tuple[Answers, float]:
    """Return the answers of all trials, and the seconds of the quickest call."""
    found, times = [], []
    for call in way.ready():
        began = process_time()
        found.append(call())
        times.append(process_time() - began)
    return way.read(found), max(min(times), 1e-6)


def measure(case: Case, unit: Way, rounds: int = ROUNDS) -> Row:
    """Return the row of a case; without rounds nothing is timed."""
    answers, each, spent = {}, {}, dict.fromkeys(case.ways, 0.0)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in case.ways}
    for name, way in case.ways.items():
        answers[name], each[name] = solved(way)
    names = list(case.ways)
    gc.collect()
    gc.disable()
    try:
        for i in range(rounds):
            for name in names[i % len(names) :] + names[: i % len(names)]:
                if i < 2 or spent[name] < ENOUGH:
                    before, began = timed(unit, UNIT), process_time()
                    times[name].append((before, timed(case.ways[name], each[name])))
                    spent[name] += process_time() - began
    finally:
        gc.enable()
    row = Row(case.name, case.opponent)
    for name, found in times.items():
        if found:
            row.units[name], row.seconds[name] = (min(column) for column in zip(*found, strict=True))
    row.batch = case.ways["batch"].size if "batch" in case.ways else 0
    row.answers, row.costs = described(answers), [float(cost) for cost in answers["opponent"].cost[:TRIALS]]
    return row


def statuses(found: Answers | None) -> str:
    """Return the number of answers of each status, the most frequent first."""
    if found is None:
        return ""
    many = Counter(found.status)
    return ", ".join(f"{many[name]} {name}" for name in sorted(many, key=lambda name: (-many[name], name)))


def compared(found: Answers | None, theirs: Answers) -> str:
    """Return how often the cost is the opponent's, and how often it is lower or higher."""
    if found is None:
        return ""
    gap = found.cost - theirs.cost
    room = SAME * np.maximum(1.0, np.abs(theirs.cost))
    counts = {"lower": gap < -room, "higher": gap > room, "without": np.isnan(gap)}
    more = "".join(f", {int(mask.sum())} {word}" for word, mask in counts.items() if mask.any())
    return f"{int((np.abs(gap) <= room).sum())} of {len(gap)}{more}"


def described(answers: dict[str, Answers]) -> dict[str, str]:
    """Return the cells that two runs must have in common."""
    one = answers.get("auto") or answers["solve"]
    # Where there are as many rows as unknowns, the cost is rounding.
    cost, error = float(one.cost.sum()), float(np.sqrt((one.error**2).mean()))
    return dict(
        zip(
            ANSWERS,
            (
                statuses(one),
                statuses(answers.get("batch")),
                compared(answers.get("solve"), answers["opponent"]),
                compared(answers.get("auto"), answers["opponent"]),
                f"{cost if cost > SAME**2 else abs(0.0 * cost):.9g}",
                f"{error:.6g}",
            ),
            strict=True,
        )
    )


def changes(row: dict[str, str], stored: dict[str, str]) -> list[str]:
    """Return the cells of answers that differ: costs and errors by more than rounding and the end of iterations."""
    out = []
    for name in ANSWERS:
        new, old = row[name], stored[name]
        if name in ("cost", "error, m"):
            room = (SAME if name == "cost" else ESTIMATE) * max(1.0, abs(float(old)))
            same = new == old or abs(float(new) - float(old)) <= room
        else:
            same = new == old
        if not same:
            out.append(f"{row['kind']}: {name}: {new}, was {old}")
    return out


# The table.


def short(number: float) -> str:
    """Return three digits without an exponent."""
    return f"{float(f'{number:.3g}'):.10g}"


def as_time(seconds: float, unit: float) -> str:
    """Return microseconds, and units in brackets."""
    return f"{short(1e6 * seconds)} ({short(seconds / unit)})"


def cells(row: Row) -> list[str]:
    """Return a row of the table."""
    times = [as_time(row.seconds[name], row.units[name]) if name in row.seconds else "" for name in WAYS]
    batch = f"{row.batch}" if row.batch else ""
    return [row.name, *times, batch, *(row.answers[name] for name in ANSWERS), row.opponent]


def read_table(path: Path) -> dict[str, dict[str, str]]:
    """Return the cells of a stored table by row and column."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    header, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    return {row[0]: dict(zip(header, row, strict=True)) for row in rows}


def processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


# The process that measures.


def cases(folder: Path) -> Iterator[Callable[[], Case]]:
    """Yield a function that makes each row."""
    for kind in KINDS:
        yield kind.case
    yield from work(folder)


def rows(rounds: int, progress: Callable[[str], None] = lambda name: None) -> list[Row]:
    """Return all rows, measured in this process."""
    unit = KINDS[0].case().ways["opponent"]
    solved(unit)
    out = []
    with tempfile.TemporaryDirectory() as folder:
        for make in cases(Path(folder)):
            out.append(measure(make(), unit, rounds))
            progress(out[-1].name)
    return out


def apart(module: str, *arguments: str, python: str = sys.executable) -> None:
    """Run a module of this folder in a process with one thread."""
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(ROOT)}
    script = str(Path(__file__).with_name(f"{module}.py"))
    subprocess.run([python, script, *arguments], env=environment, check=True)


def measured_apart(folder: Path, *, answers_alone: bool = False) -> list[Row]:
    """Return all rows, measured in a process with one thread."""
    out = folder / "rows.json"
    apart("kinds_table", str(out), *(["answers"] if answers_alone else []))
    return [Row(**row) for row in json.loads(out.read_text(encoding="utf-8"))]


def with_jax(folder: Path, found: list[Row]) -> dict[str, str] | None:
    """Return the cell of JAX by row: time, and how often its cost is the opponent's; None where it is not installed."""
    python = interpreter("jax")
    if python is None:
        return None
    out, nothing = folder / "jax.json", np.zeros(0)
    apart("kinds_with_jax", str(out), python=python)
    theirs = {row.name: Answers([], np.array(row.costs), nothing) for row in found}
    return {
        name: f"{as_time(seconds, unit)}, {compared(Answers([], np.array(cost), nothing), theirs[name])}"
        for name, (seconds, unit, cost) in json.loads(out.read_text(encoding="utf-8")).items()
    }


def main(out: str, *more: str) -> None:
    """Measure, and write the rows as JSON."""

    def progress(name: str) -> None:
        print(name, file=sys.stderr, flush=True)  # noqa: T201  # it takes minutes

    found = rows(0 if "answers" in more else ROUNDS, progress)
    Path(out).write_text(json.dumps([vars(row) for row in found]), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])

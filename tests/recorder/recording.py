"""Recordings: fixes as plain values, one JSON object a line, behind a line with the version and the machine."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info

import formulations
import optloc
from optloc import Fix, Problem, solve
from recorder.scope import Scene

FORMAT = 1
# Packages that compute parts of a fix.
NUMERICAL = ("numpy", "scipy", "numba", "cvxpy", "clarabel", "casadi")

Record = dict[str, Any]
Key = tuple[str, str, int, str]


@dataclass(frozen=True)
class Recording:
    """A recording that was read: its head, and its problems and fixes by case, variant, seed (and method)."""

    head: Record
    scenes: dict[tuple[str, str, int], Record]
    fixes: dict[Key, Record]


# Fixes as plain values.


def plain(value: Any) -> Any:
    """Return arrays as nested lists, with texts for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return repr(value) if isinstance(value, float) and not np.isfinite(value) else value


def numbers(value: Any) -> np.ndarray:
    """Return the array of a list of numbers of a recording."""
    return np.asarray(value, dtype=float)


def fix_record(fix: Fix) -> Record:
    """Return the values of a single fix that a recording compares, by public names alone."""
    slots = (*fix.layout.shared, *fix.layout.local)
    certificate = fix.certificate
    words = ("proof", "reason", "method", "bound", "gap", "unique", "margin", "boxes", "region")
    rivals = zip(fix.alternatives.x, fix.alternatives.gap, strict=True)
    explanations = () if fix.explanations is None else fix.explanations[()]
    return {
        "status": fix.status.label,
        "findings": [status.label for status in fix.findings],
        "reason": str(fix.reason[()]),
        "estimate": {slot.name: np.ravel(fix.take(slot.name)) for slot in slots},
        # optloc keeps no covariance of the unknowns of an epoch
        "covariance": {slot.name: fix.covariance(slot.name) for slot in fix.layout.shared},
        "cost": fix.cost,
        "dof": fix.dof,
        "certificate": {word: getattr(certificate, word) for word in words},
        "alternatives": [
            {"estimate": {slot.name: np.ravel(fix.layout.take(x, slot.name)) for slot in slots}, "gap": gap}
            for x, gap in rivals
            if np.isfinite(gap)
        ],
        "weights": fix.weights,
        "suspects": [list(explanation.names) for explanation in explanations],
        "stages": [f"{stage.name}: {stage.detail}" for stage in fix.stages],
    }


def solved(problem: Problem, method: str, solver: Callable[[Problem, str], Fix] = solve) -> Record:
    """Return the record of one solve; an exception is a record, too."""
    began = process_time()
    try:
        found = fix_record(solver(problem, method))
    except ImportError as error:
        found = {"status": "unavailable", "reason": f"{type(error).__name__}: {error}"}
    except Exception as error:  # noqa: BLE001  # a recording ends with all its records
        found = {"error": f"{type(error).__name__}: {error}"}
    return {**found, "seconds": round(process_time() - began, 4)}


# Files.


def head(count: int, options: Record) -> Record:
    """Return the first line of a recording."""
    blas = [info for info in threadpool_info() if info["user_api"] == "blas"]
    return {
        "format": FORMAT,
        "optloc": version("optloc"),
        "code": code_digest(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {
            "platform": platform.platform(),
            "processors": os.cpu_count(),
            "blas": sorted({f"{info['internal_api']} {info.get('architecture', '')}" for info in blas}),
        },
        "packages": {"python": platform.python_version()} | {name: version(name) for name in NUMERICAL},
        "options": options,
        "fixes": count,
    }


def code_digest() -> str:
    """Return a digest of the sources of optloc and formulations, by their names and contents."""
    made = sha256()
    for package in (optloc, formulations):
        root = Path(package.__file__).parent
        for path in sorted(root.rglob("*.py")):
            text = path.read_bytes()
            made.update(f"{path.relative_to(root.parent).as_posix()} {len(text)}\n".encode())
            made.update(text)
    return made.hexdigest()[:16]


def record(
    path: Path, scenes: Iterable[Scene], methods: Iterable[str], options: Record, tell: Callable[[str], None]
) -> list[Record]:
    """Write a recording, and return its fixes in the order of the file."""
    every, methods, fixes = list(scenes), list(methods), []
    with path.open("w", encoding="utf-8") as file:
        _write(file, head(len(every) * len(methods), options))
        for number, scene in enumerate(every):
            name = {"case": scene.case, "variant": scene.variant, "seed": scene.seed}
            drawn = {"z": scene.problem.observed, "weight": scene.problem.weight, "truth": _truth(scene)}
            _write(file, name | drawn)
            for method in methods:
                fixes.append(name | {"method": method} | solved(scene.problem, method))
                _write(file, fixes[-1])
            file.flush()
            tell(f"{number + 1} of {len(every)}: {scene.case} {scene.variant} seed {scene.seed}")
    return fixes


def _truth(scene: Scene) -> Record:
    layout = scene.problem.layout
    names = [slot.name for slot in (*layout.shared, *layout.local)]
    return {name: np.ravel(layout.take(scene.truth, name)) for name in names}


def _write(file: Any, line: Record) -> None:
    file.write(json.dumps(plain(line), allow_nan=False) + "\n")


def read(path: Path) -> Recording:
    """Return a recording; raise ValueError for another file."""
    lines = list(_lines(path))
    if not lines or lines[0].get("format") != FORMAT:
        raise ValueError(f"{path} is not a recording of format {FORMAT}")
    scenes, fixes = {}, {}
    for line in lines[1:]:
        scene = (line["case"], line["variant"], line["seed"])
        if "method" in line:
            fixes[*scene, line["method"]] = line
        else:
            scenes[scene] = line
    return Recording(lines[0], scenes, fixes)


def _lines(path: Path) -> Iterator[Record]:
    with path.open(encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            try:
                yield json.loads(line)
            except json.JSONDecodeError as error:
                raise ValueError(
                    f"{path}, line {number}: not JSON ({error}); the recording may have been cut"
                ) from error

"""A process that fixes emitters on request: one JSON line in, one out. It needs what its methods need, and numpy.

Run as ``python worker.py MODULE SCENE...``: MODULE has ``METHODS``, a dict of name to ``make(scene)``, which returns
the work that is timed: a callable of no arguments whose answer is positions (N, 3), or a callable that reads positions
and facts off the answer when the clock has stopped.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path
from time import perf_counter
from typing import Any, TextIO

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.scenes import Scene, load

# Repetitions of what is quick, and seconds from which on nothing is.
REPEATS, ENOUGH = 6, 0.5


def serve(module: str, paths: list[str], channel: TextIO) -> None:
    """Answer requests on standard input until it ends."""
    methods = importlib.import_module(module).METHODS
    scenes = {Path(path).stem: load(path) for path in paths}
    ready: dict[tuple[str, str, int], Any] = {}
    print(json.dumps({"methods": list(methods)}), file=channel, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        key = (request["method"], request["scene"], request["count"])
        try:
            if key not in ready:
                ready[key] = methods[key[0]](scenes[key[1]].first(key[2]))
            reply = answer(ready[key], request.get("out"))
        except Exception as error:  # noqa: BLE001  # the table says so; the others go on
            reply = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(reply), file=channel, flush=True)


def answer(work: Any, out: str | None) -> dict[str, Any]:
    """Do the work; return its seconds and facts, and write the positions where that is wanted.

    What is quick is done several times: the other methods have cooled the caches and the pages of this process since.
    """
    times: list[float] = []
    while not times or (len(times) < REPEATS and sum(times) < ENOUGH):
        began = perf_counter()
        found = work()
        times.append(perf_counter() - began)
    seconds = float(np.median(times[1:] or times))
    positions, facts = found() if callable(found) else (found, {})
    if out:
        np.save(out, np.asarray(positions, dtype=float))
    return {"seconds": seconds, "facts": facts}


def each(scene: Scene, fix: Any) -> Any:
    """Return work that fixes one emitter after the other; an exception counts as no answer."""

    def work() -> np.ndarray:
        out = np.full(scene.truth.shape, np.nan)
        for i in range(len(out)):
            try:
                out[i] = fix(i)
            except (ValueError, ArithmeticError, np.linalg.LinAlgError):
                continue
        return out

    return work


if __name__ == "__main__":
    # What libraries print, also from C, must not get between the lines of answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    serve(sys.argv[1], sys.argv[2:], answers)

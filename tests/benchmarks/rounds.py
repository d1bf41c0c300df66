"""Timing in interleaved rounds: every round runs every method once, each beside a matrix product of the machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
# Interpreters, joined by the separator of paths, that have peers which the one that runs the tests has not.
PEERS = "OPTLOC_PEERS"
ORDER = 200
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPTLOC_THREADS"), "1")
ONE_THREAD["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


class Worker:
    """A process with the methods of one module.

    Parameters
    ----------
    module : str
        A module of this folder with ``METHODS``.
    scenes : sequence of Path
        Files of the data.
    python : str
        Its interpreter.
    settings : dict
        More environment variables.
    """

    def __init__(
        self, module: str, scenes: list[Path], python: str = sys.executable, settings: dict[str, str] | None = None
    ) -> None:
        command = [python, str(HERE / "worker.py"), f"benchmarks.{module}", *map(str, scenes)]
        environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(ROOT), **(settings or {})}
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )
        self.methods: list[str] = self._read()["methods"]

    def _read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.process.args} ended with {self.process.wait()}")
        return json.loads(line)

    def ask(self, method: str, scene: str, count: int, out: Path | None = None) -> dict[str, Any]:
        """Return what the worker says of fixing the first emitters of a scene once."""
        assert self.process.stdin is not None
        request = {"method": method, "scene": scene, "count": count, "out": str(out) if out else None}
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        return self._read()

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(timeout=60)


@dataclass(frozen=True)
class Contender:
    """One line of the table.

    Parameters
    ----------
    name : str
        How the table calls it.
    worker : Worker
        Who runs it.
    method : str
        How the worker calls it.
    count : int
        Fixes in a round.
    group : str
        "optloc", "general" or "peer".
    """

    name: str
    worker: Worker
    method: str
    count: int
    group: str


@dataclass
class Times:
    """Seconds of one method, and of the matrix product beside it, round by round."""

    count: int
    seconds: list[float] = field(default_factory=list)
    product: list[float] = field(default_factory=list)

    @property
    def microseconds(self) -> float:
        """Return the median time of a fix."""
        return 1e6 * float(np.median(self.seconds)) / self.count

    @property
    def ratio(self) -> float:
        """Return the median of the time of a fix over that of the product next to it."""
        return float(np.median(np.array(self.seconds) / np.array(self.product))) / self.count


def product() -> float:
    """Return the seconds of a product of two matrices of order 200, the quickest of some."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, ORDER, ORDER))
    times = []
    for _ in range(7):
        began = perf_counter()
        a @ b
        times.append(perf_counter() - began)
    return min(times)


def interpreter(library: str) -> str | None:
    """Return the first interpreter that has a library: that of the tests, then those of OPTLOC_PEERS."""
    more = [path for path in os.environ.get(PEERS, "").split(os.pathsep) if path]
    for python in (sys.executable, *more):
        probe = f"import importlib.util as u, sys; sys.exit(u.find_spec({library!r}) is None)"
        if subprocess.run([python, "-c", probe], check=False, capture_output=True).returncode == 0:
            return python
    return None


def timed(contenders: list[Contender], scene: str, rounds: int) -> dict[str, Times]:
    """Return the times of all contenders, one run of each in every round after one that does not count."""
    found = {one.name: Times(one.count) for one in contenders}
    for one in contenders:
        one.worker.ask(one.method, scene, one.count)
    for i in range(rounds):
        for one in contenders[i % len(contenders) :] + contenders[: i % len(contenders)]:
            beside = product()
            found[one.name].seconds.append(one.worker.ask(one.method, scene, one.count)["seconds"])
            found[one.name].product.append(beside)
    return found

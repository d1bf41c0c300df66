"""The command ``optloc compile``: compile the machine code of all kernels, or print what is on disk.

Python calls few kernels, each with arrays of one type. So a small set of problems compiles all machine code that other
problems need. Two child processes compile side by side.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import numpy as np
import typer
from rich.table import Table

from optloc.base.frames import Frame
from optloc.base.types import Array, Motion, Stations
from optloc.cli.extensions import KernelPart, extensions
from optloc.cli.output import Screen, dumps, meter
from optloc.kernels.code_cache import CALLEES, folder_in_use, is_checkout, sole_compiler
from optloc.kernels.filter import filter_scan
from optloc.kernels.jit import REPORTER, compiling, enabled, names_in, plain, require_code
from optloc.kernels.manifest import installed
from optloc.linear.constraints import height
from optloc.linear.simulate import simulate
from optloc.problem.bias import with_bias
from optloc.problem.build import assemble, measured
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.proof.scope import SHORT
from optloc.solvers.certificates.admitted import certify
from optloc.solvers.prepared import prepare
from optloc.solvers.solution import solve
from optloc.solvers.starts.best_first import best_first_starts
from optloc.tracking.updates import ekf
from optloc.uncertainty.region import likelihood_region

_STATIONS = 1e3 * np.array([[0.0, 0, 0], [10, 0, 1], [0, 10, 2], [-9, 1, 0.5], [1, -8, 3], [6, 7, 0]])
TARGET = np.array([2e3, 3e3, 4e3])
# _FEW exceeds the number of problems that plain Python solves; _MANY exceeds the number that numpy sums.
_FEW, _MANY = 40, 500


def problem_of(kind: str, stations: Stations | Array = _STATIONS, **more: Any) -> Problem:
    """Return a problem of one kind with five rows and without measured values.

    `more` are further arguments of `assemble`, such as a frame.
    """
    rows = {"b": np.zeros(5, dtype=int)} if kind in ("tdoa", "fdoa", "groa") else {}
    return assemble(stations, measured(kind, a=np.arange(1, 6), sigma=1.0, **rows), **more)


def _simulated(kind: str, count: int, stations: Stations | Array = _STATIONS, **more: Any) -> Problem:
    """Return `count` simulated problems of one kind as a batch, with the target at `TARGET`."""
    problem = problem_of(kind, stations, **more)
    place = np.append(TARGET, np.zeros(problem.layout.size - 3)) if problem.layout.size > 3 else TARGET
    return simulate(problem, place, 1, count).flat()


def _fix_ranges() -> None:
    """Compile the fixes from ranges, and from differences of ranges."""
    problem = _simulated("tdoa", _FEW)
    solve(problem, "gtrs+lsr")
    prepare(problem_of("tdoa"), "gtrs+lsr")(problem.z[0])


def _fix_tapes() -> None:
    """Compile the fixes from rows of every kind."""
    problem = _simulated("groa", _FEW)
    solve(problem, "gtrs+lsr")
    prepare(problem_of("groa"), "gtrs+lsr")(problem.z[0])


def _filter() -> None:
    """Compile the update of a filter."""
    require_code(filter_scan)
    scan = simulate(assemble(_STATIONS, measured("range", a=np.arange(6), sigma=1.0)), TARGET, 1)
    ekf(scan, TARGET, np.eye(3))


def _refine() -> None:
    """Compile the refinement of single epochs and of runs."""
    solve(_simulated("elevation", _MANY), "lsr", start=np.tile(TARGET, (_MANY, 1)))
    # a run with the emission times of its two epochs as unknowns
    rows = measured("toa", a=np.tile(np.arange(6), 2), epoch=np.repeat([0, 1], 6), sigma=1.0)
    run = assemble(_STATIONS, rows)
    truth = np.append(TARGET, np.zeros(run.layout.size - 3))
    solve(simulate(run, truth, 1, _MANY).flat(), "lsr", start=np.tile(truth, (_MANY, 1)))


def _solve_without_machine_code(problem: Problem) -> Fix:
    """Return fixes computed without machine code.

    Another process compiles the code of fixes; this process does not wait for it.
    """
    with plain():
        return solve(problem, "gtrs+lsr")


def _prove() -> None:
    """Compile the proofs of fixes of single epochs."""
    problem = _simulated("tdoa", _FEW)
    certify(problem, _solve_without_machine_code(problem))


def _prove_runs() -> None:
    """Compile the proofs of runs: a static target with moving stations, and a moving target."""
    speed = np.random.default_rng(1).normal(0.0, 100.0, _STATIONS.shape)  # any velocities serve
    # Longer than the runs whose proof is the same as for one epoch.
    epochs = SHORT // len(_STATIONS) + 1
    place = _STATIONS + 10.0 * np.arange(epochs)[:, None, None] * speed
    rows = measured("tdoa", a=np.tile(np.arange(1, 6), epochs), b=0, epoch=np.repeat(np.arange(epochs), 5), sigma=1.0)
    problem = simulate(assemble(Stations(place, tuple("ABCDEF")), rows), TARGET, 1, _FEW).flat()
    certify(problem, _solve_without_machine_code(problem))
    moving = assemble(_STATIONS[:, :2], rows, times=np.arange(float(epochs)), motions=(Motion(1),))
    problem = simulate(moving, np.append(TARGET[:2], [30.0, -10.0]), 1).flat()
    certify(problem, _solve_without_machine_code(problem))


def _prove_scaled() -> None:
    """Compile the proofs with an unknown propagation speed."""
    problem = with_bias(problem_of("toa"), "speed", form="scale", per="kind", sigma=0.05)
    found = simulate(problem, np.append(TARGET, np.zeros(problem.layout.size - 3)), 1, _FEW).flat()
    certify(found, _solve_without_machine_code(found))


def _search() -> None:
    """Compile the searches for starts."""
    velocity = np.broadcast_to([50.0, -30.0, 0.0], _STATIONS.shape)
    moving = Stations(_STATIONS[None], tuple("ABCDEF"), velocity=velocity[None])
    # Three search domains: the whole space, a shell around the Earth at one height, and a bounded enclosure.
    best_first_starts(_simulated("fdoa", _FEW, moving))
    frame = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
    best_first_starts(_simulated("tdoa", _FEW, frame=frame, constraints=height(exactly=4400.0)))
    best_first_starts(_simulated("range", _FEW))


def _cover() -> None:
    """Compile the covering of regions by cells."""
    # a target inside the array, and a target so far outside that infinity is as likely
    for times in (1.0, 1000.0):
        problem = simulate(problem_of("tdoa"), times * TARGET, 1)
        likelihood_region(problem, _solve_without_machine_code(problem))


# The longest parts come first. Each process needs a gigabyte of memory, so at most two run at once. Parts that share
# callees do not start together.
_PARTS: Mapping[str, KernelPart] = {
    "proofs": KernelPart(
        "proofs of fixes", "optloc.proof", (_prove,), ("optloc.proof.batch._loop", "optloc.proof.batch._evaluate")
    ),
    "tapes": KernelPart(
        "fixes from rows of every kind",
        "optloc.engine",
        (_fix_tapes,),
        tuple(f"optloc.engine.fixes.fixes_{mark}" for mark in ("tapes", "one_by_tapes")),
    ),
    "ranges": KernelPart(
        "fixes from ranges",
        "optloc.engine",
        (_fix_ranges,),
        tuple(f"optloc.engine.fixes.fixes_{mark}" for mark in ("ranges", "one_by_ranges")),
    ),
    "refinements": KernelPart(
        "refinements and filters",
        "optloc.kernels",
        (_refine, _filter),
        (
            "optloc.kernels.filter.filter_scan",
            "optloc.kernels.refine.refine_block",
            "optloc.kernels.equations.normal_block",
            *(f"optloc.kernels.runs.{name}" for name in ("refine_runs", "sum_runs")),
        ),
    ),
    "runs": KernelPart(
        "proofs of runs",
        "optloc.proof",
        (_prove_runs,),
        (
            *(f"optloc.proof.runs.{name}" for name in ("search.tables_of", "prove.prove_run", "prove.cost_of_place")),
            "optloc.proof.runs.states.cost_of_state",
            "optloc.proof.runs.state_bounds.hessian_of_state",
            "optloc.proof.runs.state_search.prove_course",
        ),
    ),
    "speeds": KernelPart(
        "proofs with an unknown speed",
        "optloc.proof",
        (_prove_scaled,),
        tuple(f"optloc.proof.scaled.scaled_proof.{name}" for name in ("prove_scaled", "_evaluate")),
    ),
    "searches": KernelPart(
        "searches for starts", "optloc.proof", (_search,), ("optloc.proof.best_first.search_minima",)
    ),
    "regions": KernelPart("cells of regions", "optloc.proof", (_cover,), ("optloc.proof.subpaving.cover_region",)),
}


@cache
def parts() -> Mapping[str, KernelPart]:
    """Return all parts to compile, by name, including the parts of neighbours."""
    return {**_PARTS, **{name: part for one in extensions() for name, part in one.kernels().items()}}


def missing() -> list[str]:
    """Return the kernels without machine code on disk."""
    return [name for part in parts().values() for name in part.missing()]


def make(tell: Callable[[int, int], None] = lambda done, total: None) -> list[str]:
    """Compile all kernels that are not on disk yet, in two processes, and return the kernels that are still missing.

    The callback `tell` receives the number of compiled functions and the approximate total. The list is empty if all
    kernels are on disk at the end.
    """
    names = [name for name, part in parts().items() if part.missing()]
    # `known` has all functions of each part, and `done` the compiled functions of all parts.
    known, done, lock = dict[str, set[str]](), set[str](), Lock()

    def follow(name: str) -> None:
        """Compile a part in a child process, and count the functions that it reports."""
        for line in _run_part(name, shared):
            word, _, rest = line.partition(" ")
            with lock:
                if word == "all":
                    known[name] = set(rest.split())
                else:
                    done.add(rest)
                tell(len(done), len(set().union(*known.values(), done)))

    with TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        shared = {} if is_checkout() else {CALLEES: folder}
        list(pool.map(follow, names))
    return missing()


def environment(**more: str) -> dict[str, str]:
    """Return the environment of a child process that imports this installation of optloc, with more variables."""
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PYTHONPATH": path, **more}


def _run_part(name: str, variables: Mapping[str, str]) -> Iterator[str]:
    """Start a process that compiles a part, and yield the lines that it writes.

    The process ends with this process. `variables` are added to its environment.
    """
    # -P: do not import from the current folder.
    command = [sys.executable, "-P", "-m", "optloc.cli.compile", name]
    with subprocess.Popen(  # noqa: S603  (this interpreter, and this module)
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        env=environment(OPTLOC_COMPILE="wait", **variables),
    ) as process:
        try:
            assert process.stdout is not None
            yield from (line.strip() for line in process.stdout)
        finally:
            process.kill()


def _compile(part: KernelPart) -> None:
    """Compile a part in this process, and write its progress to standard output."""
    for entry in (entry for each in parts().values() for entry in each.entries):
        import_module(entry.rpartition(".")[0])  # the import registers the kernels
    print("all", *names_in(part.package), flush=True)  # noqa: T201

    def tell(name: str, done: bool) -> None:
        """Write the name of a compiled function."""
        if done:
            try:
                print("made", name, flush=True)  # noqa: T201
            except BrokenPipeError:  # the parent process has ended
                os._exit(1)

    REPORTER.muted = True  # the parent process prints the progress
    # Most objects of the compiler live long. A garbage collection each 700 new objects takes a sixth of the time. A
    # collection each 50 000, without the imported objects, costs a twentieth more memory.
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    with compiling(tell):
        for work in part.works:
            work()


def run_compile(check: bool, as_json: bool, *, quiet: bool = False) -> int:
    """Compile the missing kernels and print the state of all parts; return exit code 1 if a part is still missing."""
    place = folder_in_use() if enabled() else None
    if place is not None and not check:
        with meter("making machine code", quiet) as tell:
            make(tell)
    found = {name: len(part.missing()) for name, part in parts().items()} if place is not None else {}
    if as_json:
        there = {name: not missing for name, missing in found.items()}
        typer.echo(dumps({"folder": None if place is None else str(place), "parts": there}))
    else:
        _print(found, None if place is None else str(place))
    return int(place is None or any(found.values()))


def _print(found: dict[str, int], place: str | None) -> None:
    """Print the state of the parts.

    `found` is the number of missing kernels by part, and `place` the folder of the machine code; None without a folder.
    """
    screen = Screen()
    if place is None:
        reason = "no folder can be written" if enabled() else "numba is not installed, or disabled"
        screen.print(f"no machine code can be stored: {reason}", highlight=False)
        return
    table = Table()
    for title in ("machine code of", "on disk"):
        table.add_column(title)
    for name, missing in found.items():
        table.add_row(parts()[name].summary, "no" if missing else "yes")
    screen.print(table)
    shipped = installed()
    before = "" if shipped is None else f"installed in {shipped[0]}; missing parts are "
    screen.print(f"{before}stored in {place}", highlight=False, soft_wrap=True)
    if any(found.values()):
        screen.print(
            "`optloc compile` compiles the missing parts; until then, small batches run in plain Python",
            highlight=False,
        )


def _make_in_background() -> None:
    """Compile all missing kernels at low priority, unless another process already does."""
    with sole_compiler() as only:
        if only:
            if hasattr(os, "nice"):
                os.nice(10)  # the processes that wait for this code, and answer in plain Python, go first
            make()


if __name__ == "__main__":
    if sys.argv[1:]:
        _compile(parts()[sys.argv[1]])
    else:
        _make_in_background()

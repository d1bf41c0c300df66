"""optloc in a process that lives long, forks, has threads and workers, and runs under stricter Pythons."""

import copy
import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from cases import CASES, truth_of
from joblib import Parallel, delayed
from often import few
from progress import without_progress
from typer.testing import CliRunner

import optloc
from optloc import assemble, measured, solve
from optloc.base.cache import Cache
from optloc.cli import app

# How many fixes of how many structures are let go by before memory is looked at, in full and by default.
FULL, QUICK = (20_000, 200, 2000), (150, 15, 75)
GROWTH = 1.05
SIGMA = {"azimuth": 1e-3, "groa": 1e-3}
H = {
    "range": lambda a, b: a,
    "toa": lambda a, b: a + 100.0,
    "tdoa": lambda a, b: a - b,
    "groa": lambda a, b: a / b,
}


def problem_of(structure, number):
    """Return one problem of a structure: kinds, stations and dimension are drawn by it, the target by the number."""
    rng = np.random.default_rng([7, structure])
    d = int(rng.integers(2, 4))
    s = int(rng.integers(d + 3, 12))
    kinds = rng.choice([*H, "azimuth"], size=int(rng.integers(1, 3)), replace=False).tolist()
    place = rng.uniform(-5e3, 5e3, (s, d))
    rng = np.random.default_rng([8, structure, number])
    target, rows = rng.uniform(-4e3, 4e3, d), []
    away = np.linalg.norm(target - place, axis=-1)
    for kind in kinds:
        a = np.arange(1 if kind in ("tdoa", "groa") else 0, s)
        if kind == "azimuth":
            z = np.arctan2(target[1] - place[a, 1], target[0] - place[a, 0])
        else:
            z = H[kind](away[a], away[0])
        sigma = SIGMA.get(kind, 3.0)
        two = {"b": 0} if kind in ("tdoa", "groa") else {}
        rows.append(measured(kind, z + sigma * rng.standard_normal(len(a)), a=a, sigma=sigma, **two))
    return assemble(place, *rows)


def held():
    """Return the megabytes, file descriptors and threads of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    size = int(next(line.split()[1] for line in lines if line.startswith("VmRSS"))) / 1024
    # one thread tells how far the loading of machine code is, and ends a second after it
    threads = sum(thread.name != "optloc progress" for thread in threading.enumerate())
    return size, len(list(Path("/proc/self/fd").iterdir())), threads


def grown(total, structures, warm):
    """Return how much memory, file descriptors and threads grow, after the first `warm` of a number of single fixes."""
    for number in range(total):
        solve(problem_of(number % structures, number))
        if number == warm:
            before = held()
    after = held()
    return after[0] / before[0], after[1] - before[1], after[2] - before[2]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is told by /proc")
@pytest.mark.parametrize("counts", [QUICK, pytest.param(FULL, marks=pytest.mark.full)], ids=["quick", "full"])
def test_many_fixes_of_many_structures_leave_nothing_behind(counts):
    growth, files, threads = grown(*counts)
    assert growth < GROWTH
    assert (files, threads) == (0, 0)


def said(fix):
    """Return what a fix says, to the last bit."""
    return fix.status.label, fix.x.tobytes(), fix.cov.tobytes()


def told(number):
    return said(solve(problem_of(number, 0)))


def child(number, pipe):
    pipe.send(told(number))
    pipe.close()


def busy(cache, started, until):
    """Make a value of a cache for as long as it takes somebody else to fork."""

    def make():
        started.set()
        until.wait(60)
        return 1

    cache.find("slow", make)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_child_makes_what_a_thread_of_its_parent_was_making():
    cache, started, until = Cache(4), threading.Event(), threading.Event()
    cache.find("made", lambda: 2)
    thread = threading.Thread(target=busy, args=(cache, started, until))
    thread.start()
    assert started.wait(60)
    mine, theirs = multiprocessing.get_context("fork").Pipe(duplex=False)
    ask = lambda: theirs.send((cache.find("slow", lambda: 3), cache.find("made", lambda: 4)))  # noqa: E731
    process = multiprocessing.get_context("fork").Process(target=ask)
    process.start()
    assert mine.poll(60), "the child waits for a thread that it has not"
    assert mine.recv() == (3, 2)
    until.set()
    thread.join()
    process.join(60)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork")
# Python warns of forking a process with threads, which is what is tried.
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_threads_forks_and_workers_give_one_answer():
    numbers = range(4)
    expected = [told(number) for number in numbers]
    fork = multiprocessing.get_context("fork")
    with ThreadPoolExecutor(2) as pool:
        threads = pool.map(told, numbers)
        ends = []
        for number in numbers:  # while the threads work
            mine, theirs = fork.Pipe(duplex=False)
            process = fork.Process(target=child, args=(number, theirs))
            process.start()
            ends.append((mine, process))
        workers = [said(fix) for fix in Parallel(n_jobs=2)(delayed(solve)(problem_of(number, 0)) for number in numbers)]
        assert list(threads) == expected
    assert workers == expected
    for (mine, process), answer in zip(ends, expected, strict=True):
        assert mine.poll(60), "the child does not answer"
        assert mine.recv() == answer
        process.join(60)
        assert process.exitcode == 0


@pytest.mark.parametrize("options", few([["-W", "error", "-X", "dev"], ["-OO", "-W", "error", "-X", "dev"]], 1))
@pytest.mark.slow
def test_a_stricter_python_gives_the_same_answer(options):
    ask = ["-m", "optloc.cli", "fix", "demo", "--json", "--method", "proven"]
    plain = CliRunner().invoke(app, ask[2:])
    strict = subprocess.run([sys.executable, *options, *ask], capture_output=True, text=True, check=False)
    assert (strict.returncode, strict.stdout, without_progress(strict.stderr)) == (0, plain.stdout, [])


def same(one, two):
    return one.x.tobytes() == two.x.tobytes() and one.reason == two.reason and bool(np.all(one.code == two.code))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))], ids=["deepcopy", "pickle"]
)
def test_problems_and_fixes_are_copied_whole(name, copied):
    problem = CASES[name].problem
    problem = optloc.simulate(problem, truth_of(problem), 3)
    fix = solve(problem, "auto")
    again = copied(problem)
    assert again.structure == problem.structure
    assert same(solve(again, "auto"), fix)
    assert same(copied(fix), fix)


# A program whose threads solve from the first moment, also while their modules are imported, and which forks 50 times.
# Each child solves. A child that does not end within a minute is killed and reported.
FORKING = """
import os, signal, sys, threading, time
import numpy as np
import optloc

stations = {"A": (0.0, 0.0), "B": (8e3, 0.0), "C": (0.0, 6e3), "D": (8e3, 6e3), "E": (4e3, 9e3)}
place = np.array(list(stations.values()))

def ranges(seed, count):
    rng = np.random.default_rng(seed)
    return np.linalg.norm(place - rng.uniform(0.0, 6e3, 2), axis=1) + rng.normal(0.0, 5.0, (count, 5))

stop = threading.Event()

def work(number):
    seed = 1000 * number
    while not stop.is_set():
        seed += 1
        method = ("auto", "gtrs+lsr", "huber")[seed % 3]
        optloc.locate(stations, ranges=ranges(seed, 1 + seed % 40), sigma=5.0, method=method)

threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
for thread in threads:
    thread.start()
lost = 0
for seed in range(50):
    time.sleep(0.02)
    child = os.fork()
    if not child:
        signal.alarm(60)
        fix = optloc.locate(stations, ranges=ranges(seed, 1)[0], sigma=5.0)
        os._exit(0 if fix.answered else 1)
    lost += os.waitpid(child, 0)[1] != 0
stop.set()
for thread in threads:
    thread.join()
sys.exit(min(lost, 100))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
@pytest.mark.slow
def test_fifty_forks_among_solving_threads_end():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", FORKING], timeout=600, check=False)
    assert done.returncode == 0

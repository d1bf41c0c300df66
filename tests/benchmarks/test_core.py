"""The compiled core in numbers: an iteration, one small fix, a registration run; ratios to a product of matrices."""

import os
from importlib import import_module
from time import thread_time

import numpy as np
import pytest
from benchmarks.speed import SCENES, batch
from monte_carlo.tables import write
from runs import drawn, estimated, run, truth

from optloc.kernels.damping import StopRules
from optloc.kernels.jit import enabled
from optloc.kernels.least_squares import refine
from optloc.kernels.pack import pack
from optloc.kernels.refine import new_answers, refine_block
from optloc.linear.normal import with_station_noise
from optloc.problem.noise import whiten

pytestmark = pytest.mark.skipif(not enabled(), reason="kernels are not compiled")
ROUNDS, EPOCHS, RUNS = 9, 700, 64


def quickest(work, rounds=ROUNDS):
    """Seconds of processor time of the quietest round."""
    work()
    times = []
    for _ in range(rounds):
        began = thread_time()
        work()
        times.append(thread_time() - began)
    return min(times)


def product():
    """Seconds of a product of matrices of size 400 by numpy, on the same core."""
    a = np.random.default_rng(0).standard_normal((400, 400))
    return quickest(lambda: a @ a, 20)


def ready(problem):
    return pack(problem, whiten(with_station_noise(problem).noise, problem.weight))


def array(scene):
    problem, _, _, places = batch(scene)
    start = places + np.random.default_rng(0).normal(0.0, 300.0, places.shape)
    return problem.flat(), start


def iteration(scene):
    """Microseconds of an iteration of a fix of six stations, and of a fix."""
    problem, start = array(scene)
    ours, item = ready(problem), np.arange(len(start))
    out = new_answers(start)
    refine_block(ours, item, 0, len(start), StopRules(), out)
    seconds = quickest(lambda: refine_block(ours, item, 0, len(start), StopRules(), new_answers(start)))
    count = int(out.iterations.sum()) + len(start)
    return 1e6 * seconds / count, 1e6 * seconds / len(start)


def by_numpy(scene, monkeypatch):
    """Microseconds of a fix by numpy."""
    problem, start = array(scene)
    monkeypatch.setattr(import_module("optloc.kernels.least_squares"), "serves", lambda problem, starts: False)
    many = problem.take(np.arange(1000)), start[:1000]
    return 1e6 * quickest(lambda: refine(*many), 3) / 1000


def single(scene):
    """Microseconds of one small fix, the call from Python included."""
    problem, start = array(scene)
    ours, item = ready(problem), np.arange(1)
    return 1e6 * quickest(lambda: refine_block(ours, item, 0, 1, StopRules(), new_answers(start[:1])), 200)


def registration(eliminated):
    """Microseconds of an iteration of a run of 700 epochs, and of a row in it."""
    problem = run(EPOCHS)
    problem = drawn(estimated(problem) if eliminated else problem, 1, RUNS).flat()
    start = np.tile(truth(problem), (RUNS, 1)) + 20.0
    ours, item = ready(problem), np.arange(RUNS)
    kept = 0 if eliminated else None
    out = new_answers(start, kept)
    refine_block(ours, item, 0, RUNS, StopRules(), out)
    seconds = quickest(lambda: refine_block(ours, item, 0, RUNS, StopRules(), new_answers(start, kept)), 3)
    each = 1e6 * seconds / (int(out.iterations.sum()) + RUNS)
    return each, each / problem.count


@pytest.mark.parametrize("scene", SCENES)
def test_an_iteration_takes_a_fraction_of_a_microsecond(scene, monkeypatch):
    each, fix = iteration(scene)
    assert each < 0.5  # less than 0.2 on a quiet core
    assert 3.0 * fix < by_numpy(scene, monkeypatch)


def test_one_fix_takes_microseconds():
    assert single(SCENES[0]) < 40.0  # 15 on a quiet core


@pytest.mark.full
def test_write_the_table():
    unit = product()
    rows = []
    for scene in SCENES:
        each, fix = iteration(scene)
        rows += [[f"{scene}: an iteration, six stations", each], [f"{scene}: a refinement, six stations", fix]]
    rows.append(["one refinement, six stations, from Python", single(SCENES[0])])
    for eliminated, how in ((False, "weighed"), (True, "eliminated")):
        each, row = registration(eliminated)
        what = f"run of {EPOCHS} epochs, station errors {how}"
        rows += [[f"{what}: an iteration", each], [f"{what}: a row of an iteration", row]]
    facts = f"processor time of one core; OPENBLAS_NUM_THREADS {os.environ.get('OPENBLAS_NUM_THREADS', 'not set')}"
    table = [[what, f"{us:.3g}", f"{1e-6 * us / unit:.3g}"] for what, us in rows]
    assert write("core", ["what", "us", "products of matrices of size 400"], table, facts).is_file()

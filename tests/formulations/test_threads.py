"""Programs shared by threads: every answer is that of its own data, whatever the others do meanwhile."""

import random
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from often import few

from formulations import conic
from formulations.backend import Choice, choice_for, counting, using
from formulations.conic import Relaxation, keep
from formulations.lifted import lifted_ranges
from formulations.minimax_cone import common
from formulations.nls import Program
from formulations.sparse_errors import sparse_fit
from formulations.squared_range import cone, minimiser, paraboloid, stationary
from formulations.squared_range_conic import hull, shor, shor_problem

THREADS = 8


@pytest.fixture(autouse=True)
def hurried():
    """Threads that take turns all the time."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def distances(x, p):
    return [((x[0] - p[2 * k]) ** 2 + (x[1] - p[2 * k + 1]) ** 2 + 1e-9) ** 0.5 for k in range(4)]


PROGRAM = Program(2, 4, 8, distances)


def squared(rng, i):
    quadric = (cone, paraboloid)[i % 2](2 + i % 3)
    B, g = rng.normal(size=(quadric.size + 2, quadric.size)), rng.normal(size=quadric.size + 2)
    found = (shor, hull)[i % 4 // 2](B, g, quadric)
    return found.y, found.value, found.bound, found.answer.iterations, *minimiser(B, g, quadric)


def points(rng, i):
    B, g = rng.normal(size=(30, 6, 4)), rng.normal(size=(30, 6))
    return stationary(B, g, (cone, paraboloid)[i % 2](3))


def lift(rng, i):
    n = 4 + i % 4
    found = lifted_ranges(np.eye(n)[1:] - np.eye(n)[0], rng.normal(size=n - 1), rng.normal(size=(n, 2)))
    return found.point, found.bound


def cones(rng, i):
    u = rng.normal(size=(3 + i % 4, 3))
    found = common(u / np.linalg.norm(u, axis=1)[:, None], rng.normal(size=u.shape), np.full(len(u), 1.2))
    return found.point, found.most


def sparse(rng, i):
    g = rng.normal(size=7 + i % 5)
    g[0] += 30.0
    found = sparse_fit(rng.normal(size=(len(g), 3)), g, bound=True)
    return found.y, found.errors, found.bound


def local(rng, i):
    start = rng.normal(size=2) * 10.0 ** (i % 3)
    found = PROGRAM.solve(start, 2.0 * rng.normal(size=4), p=rng.normal(size=8))
    return found.x, found.cost, found.status, found.iterations


def elsewhere(rng, i):
    with using(Choice("conic", "SCS", {"eps": 1e-4})):
        return squared(rng, i)[:2]


def answer(job, i):
    return [np.asarray(part).tobytes() for part in job(np.random.default_rng(i), i)]


@pytest.mark.parametrize("jobs", few([(squared, lift, cones, sparse, points), (local,), (squared, elsewhere)], 2))
def test_answers_in_threads_are_those_of_one_thread(jobs):
    work = [partial(answer, job, i) for job in jobs for i in range(24)]
    alone = [each() for each in work]
    for turn in range(2):
        order = random.Random(turn).sample(range(len(work)), len(work))
        with ThreadPoolExecutor(THREADS) as pool:
            found = dict(zip(order, pool.map(lambda k: work[k](), order), strict=True))
        assert [found[k] for k in range(len(work))] == alone


def test_an_answer_of_another_back_end_does_not_depend_on_the_solve_before():
    rng = np.random.default_rng(3)
    one, other = rng.normal(size=(2, 6, 4)), rng.normal(size=(2, 6))
    with using(Choice("conic", "SCS", {"eps": 1e-4})):
        first, _, again = (shor(one[k], other[k], cone(3)) for k in (0, 1, 0))
    assert np.array_equal(first.y, again.y)
    assert first.answer.iterations == again.answer.iterations


def test_what_many_ask_for_is_built_once_and_one_at_a_time():
    built, inside, most, gate = [], [0], [0], threading.Barrier(THREADS, timeout=20.0)

    @keep
    def build(size: int) -> Relaxation:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        made = Relaxation(shor_problem(cone(size)))
        built.append(size)
        inside[0] -= 1
        return made

    def ask(k: int) -> int:
        gate.wait()
        return [id(build(1 + (k + i) % 5)) for i in range(5)][-k % 5]

    with ThreadPoolExecutor(THREADS) as pool:
        found = list(pool.map(ask, range(THREADS)))
    assert len(set(found)) == 1
    assert sorted(built) == [1, 2, 3, 4, 5]
    assert most[0] == 1


def test_the_latest_used_are_kept(monkeypatch):
    monkeypatch.setattr(conic, "_KEPT", 2)
    built = []
    build = keep(built.append)
    for size in (1, 2, 1, 3, 1, 2):
        build(size)
    assert built == [1, 2, 3, 2]


def test_choices_and_counts_are_those_of_a_thread():
    gate = threading.Barrier(THREADS, timeout=20.0)

    def own(k: int) -> tuple[str, int]:
        with using(Choice("conic", f"solver {k}")), counting() as tally:
            gate.wait()
            tally.append(("", k))
            gate.wait()
            chosen = choice_for("conic")
            assert choice_for("nonlinear") is None
            return chosen.name, len(tally)

    with ThreadPoolExecutor(THREADS) as pool:
        assert list(pool.map(own, range(THREADS))) == [(f"solver {k}", 1) for k in range(THREADS)]
    assert choice_for("conic") is None

"""Work over threads: order, errors, caches that all share, and answers that do not depend on who else asks."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar

import numpy as np
import pytest
from often import few
from restless import restless

from formulations.conic import Relaxation
from formulations.moment_sdp import moment_problem
from formulations.nls import Program
from optloc import Fix, InvalidProblem, Problem, assemble, measured, simulate, solve
from optloc.base.threads import map_in_order, map_on_threads, thread_count
from optloc.engine import plan
from optloc.kernels import tables, trace
from optloc.linear import evaluate
from optloc.solvers import scaled_program


@pytest.mark.parametrize("threads", [1, 2, 7])
def test_results_come_in_the_order_of_the_items(threads):
    def slow(i: int) -> int:
        time.sleep(0.002 * (i % 3))
        return i * i

    assert map_on_threads(slow, range(20), threads) == [i * i for i in range(20)]
    assert map_on_threads(slow, [], threads) == []


def test_as_many_run_at_a_time_as_asked_for():
    gate = threading.Barrier(3, timeout=20.0)
    assert sorted(map_on_threads(lambda i: gate.wait() * 0 + i, range(3), 3)) == [0, 1, 2]


@pytest.mark.parametrize("threads", [1, 4])
def test_the_error_of_the_earliest_item_is_raised(threads):
    def bad(i: int) -> int:
        if i >= 3:
            time.sleep(0.02 if i == 3 else 0.0)
            raise ValueError(str(i))
        return i

    with pytest.raises(ValueError, match=r"^3$"):
        map_on_threads(bad, range(8), threads)


def test_what_holds_for_the_caller_holds_for_its_threads():
    choice: ContextVar[str] = ContextVar("choice", default="none")
    token = choice.set("mine")
    try:
        assert map_on_threads(lambda _: choice.get(), range(4), 2) == ["mine"] * 4
    finally:
        choice.reset(token)


@pytest.mark.parametrize("threads", ["1", "2", "7"])
def test_parts_flow_in_their_order_and_share_the_threads(threads, monkeypatch):
    monkeypatch.setenv("OPTLOC_THREADS", threads)

    def slow(i: int) -> tuple[int, int]:
        time.sleep(0.002 * (i % 3))
        return i, thread_count()

    share = max(1, int(threads) // min(int(threads), 5))
    assert list(map_in_order(slow, range(5))) == [(i, share) for i in range(5)]
    assert list(map_in_order(slow, [])) == []
    assert thread_count() == int(threads)


def test_no_more_parts_are_held_than_there_are_threads(monkeypatch):
    monkeypatch.setenv("OPTLOC_THREADS", "2")
    begun: list[int] = []
    parts = map_in_order(begun.append, range(20))
    next(parts)
    time.sleep(0.05)
    assert len(begun) <= 4
    parts.close()
    assert len(begun) <= 5


@pytest.mark.parametrize("threads", ["1", "3"])
def test_the_error_of_a_part_comes_where_the_part_would(threads, monkeypatch):
    monkeypatch.setenv("OPTLOC_THREADS", threads)

    def bad(i: int) -> int:
        if i == 3:
            raise ValueError(str(i))
        return i

    parts, found = map_in_order(bad, range(8)), []
    with pytest.raises(ValueError, match=r"^3$"):
        found.extend(parts)
    assert found == [0, 1, 2]


def test_the_number_of_threads_is_read_from_one_place(monkeypatch):
    monkeypatch.setenv("OPTLOC_THREADS", "3")
    assert thread_count() == 3
    for wrong in ("0", "-1", "two", "1.5"):
        monkeypatch.setenv("OPTLOC_THREADS", wrong)
        with pytest.raises(InvalidProblem, match="OPTLOC_THREADS"):
            thread_count()
    for absent in ("", " "):
        monkeypatch.setenv("OPTLOC_THREADS", absent)
        assert thread_count() >= 1


def test_the_conic_solver_lets_other_threads_run():
    """While one solve lasts, Python goes on: the longest pause is far shorter than the solve."""
    relaxation = Relaxation(moment_problem(5, 3), settings={"max_iter": 40})
    rng = np.random.default_rng(0)
    values = {name: rng.normal(size=parameter.shape) for name, parameter in relaxation.parameters.items()}
    relaxation.solve(values)
    spans: list[float] = []

    def solve() -> None:
        begin = time.perf_counter()
        relaxation.solve(values)
        spans.append(time.perf_counter() - begin)

    worker = threading.Thread(target=solve)
    worker.start()
    pause, last, rounds = 0.0, time.perf_counter(), 0
    while worker.is_alive():
        now = time.perf_counter()
        pause, last, rounds = max(pause, now - last), now, rounds + 1
    assert rounds > 1000
    assert pause < 0.5 * spans[0], (pause, spans)


@pytest.mark.parametrize("seconds", [0.0, 0.02])
def test_items_that_take_less_than_threads_are_worth_stay_where_they_are(seconds):
    def slept(i: int) -> int:
        time.sleep(seconds)
        who.add(threading.get_ident())
        return i

    who: set[int] = set()
    assert map_on_threads(slept, range(8), 2, least=5e-3) == list(range(8))
    assert len(who) == (1 if seconds == 0.0 else 2)  # the caller and one more


# Caches that all threads share.


KINDS = ("range", "tdoa", "toa", "range_sum", "angles", "mixture", "epochs")


def varied(number: int) -> Problem:
    """Return one of many problems, none of the structure of another: up to 90 rows; every fifth a batch of 20."""
    rng, kind, d = np.random.default_rng(number), KINDS[number // 2 % len(KINDS)], 2 + number % 2
    count = int(rng.integers(5, 10))
    rows = int(rng.integers(count, 14 if number % 3 else 91))
    a = np.concatenate([rng.permutation(count), rng.integers(0, count, rows - count)])
    b = (a + rng.integers(1, count, rows)) % count
    epochs = 3 if kind == "epochs" else 1
    blocks = {
        "range": [measured("range", a=a, sigma=5.0)],
        "tdoa": [measured("tdoa", a=a, b=b, sigma=5.0)],
        "toa": [measured("toa", a=a, sigma=5.0)],
        "range_sum": [measured("range_sum", a=a, b=b, sigma=5.0)],
        "angles": [measured(name, a=a[:45], sigma=2e-3) for name in ("azimuth", "elevation")[: d - 1]],
        "mixture": [measured("tdoa", a=a[3:], b=b[3:], sigma=5.0), measured("azimuth", a=a[:3], sigma=2e-3)],
        "epochs": [measured("toa", a=a, epoch=np.sort(rng.integers(0, 3, rows)), sigma=5.0)],
    }[kind]
    problem = assemble(rng.uniform(-5e3, 5e3, (count, d)), *blocks, times=np.arange(float(epochs)))
    truth = np.zeros(problem.layout.size)
    truth[:d] = rng.uniform(-4e3, 4e3, d)
    return simulate(problem, np.tile(truth, (20, 1)) if number % 5 == 0 else truth, rng)


def assert_same(one: Fix, other: Fix) -> None:
    """Two fixes are equal to the last bit."""
    for name in ("x", "cov", "cost", "code", "dof", "weights"):
        u, v = getattr(one, name), getattr(other, name)
        assert np.array_equal(u, v, equal_nan=np.asarray(u).dtype.kind == "f"), name
    for name in ("x", "gap"):
        assert np.array_equal(getattr(one.alternatives, name), getattr(other.alternatives, name), equal_nan=True), name
    assert np.array_equal(one.certificate, other.certificate)


def solved_in_threads(problems: list[Problem], methods: tuple[str, ...], solves: int) -> None:
    """Eight threads find the same fixes as one does, with nothing made beforehand."""
    count = len(problems)
    tasks = [(i % count, methods[(i + i // count) % len(methods)]) for i in range(solves)]
    alone = {task: solve(problems[task[0]], task[1]) for task in set(tasks)}
    for cache in (evaluate._LINKS, tables._KEPT, trace._TRACED, plan._KEPT, scaled_program._PROGRAMS):
        cache.clear()

    def again(task: tuple[int, str]) -> None:
        assert_same(solve(problems[task[0]], task[1]), alone[task])

    with restless(), ThreadPoolExecutor(8) as pool:
        for _ in pool.map(again, tasks):
            pass


def test_threads_solve_different_problems_as_one_thread_does():
    solved_in_threads([varied(i) for i in range(42)], ("gtrs+lsr", "auto"), 100)  # three of each kind and dimension


@pytest.mark.full
def test_threads_solve_many_different_problems_as_one_thread_does():
    solved_in_threads([varied(i) for i in range(400)], ("gtrs+lsr", "auto"), 5000)


@pytest.mark.parametrize("methods", few([("sdp+lsr", "socp+lsr"), ("gtrs+nlp+lsr",), ("sparse+lsr",)], 2))
def test_threads_share_the_programs_of_back_ends(methods):
    """Twenty problems of four structures: a program of IPOPT or Clarabel serves several threads at a time."""
    problems = [
        simulate(varied(i), np.resize([1e3, -2e3, 500.0], varied(i).layout.size), k)
        for i in (0, 1, 2, 3)
        for k in range(5)
    ]
    solved_in_threads([p.take(np.arange(1)) if p.batch_shape else p for p in problems], methods, 40)


def test_a_nonlinear_program_serves_several_threads_at_a_time():
    """CasADi's function would corrupt its memory, and report another solve's end."""
    station = np.random.default_rng(0).uniform(-5.0, 5.0, (6, 2))
    program = Program(2, 6, h=lambda x, p: [((x[0] - a) ** 2 + (x[1] - b) ** 2) ** 0.5 for a, b in station])
    draw = np.random.default_rng(1)
    tasks = [(draw.uniform(-50.0, 50.0, 2), draw.uniform(1.0, 9.0, 6)) for _ in range(100)]
    alone = [program.solve(*task) for task in tasks]
    with restless(), ThreadPoolExecutor(8) as pool:
        for found, other in zip(pool.map(lambda task: program.solve(*task), tasks), alone, strict=True):
            assert np.array_equal(found.x, other.x)
            assert (found.status, found.iterations) == (other.status, other.iterations)


def test_a_batch_is_the_same_in_one_part_and_in_many_on_any_threads(monkeypatch):
    """Parts flow through threads, and what a part shares out itself has its share of them."""
    problem = simulate(
        assemble(1e4 * np.eye(5, 3), measured("tdoa", a=[1, 2, 3, 4], b=0, sigma=9.0)),
        [7e3, 5e3, 3e3],
        5,
        90,
    )
    found = []
    for threads, most in (("1", 1000), ("3", 1000), ("1", 16), ("3", 16)):
        monkeypatch.setenv("OPTLOC_THREADS", threads)
        monkeypatch.setattr("optloc.solvers.solution.PART", most)
        found.append(solve(problem))
    for fix in found[1:]:
        assert np.array_equal(fix.x, found[0].x)
        assert np.array_equal(fix.cov, found[0].cov)
        assert list(fix.certificate) == list(found[0].certificate)
        assert list(fix.reason) == list(found[0].reason)

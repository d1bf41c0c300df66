"""Work over threads: order, errors, what holds for the caller, and that the conic solver lets others run."""

import threading
import time
from contextvars import ContextVar

import numpy as np
import pytest

from formulations.conic import Relaxation
from formulations.moment_sdp import moment_problem
from optloc import InvalidProblem
from optloc.base.threads import mapped, thread_count


@pytest.mark.parametrize("threads", [1, 2, 7])
def test_results_come_in_the_order_of_the_items(threads):
    def slow(i: int) -> int:
        time.sleep(0.002 * (i % 3))
        return i * i

    assert mapped(slow, range(20), threads) == [i * i for i in range(20)]
    assert mapped(slow, [], threads) == []


def test_as_many_run_at_a_time_as_asked_for():
    gate = threading.Barrier(3, timeout=20.0)
    assert sorted(mapped(lambda i: gate.wait() * 0 + i, range(3), 3)) == [0, 1, 2]


@pytest.mark.parametrize("threads", [1, 4])
def test_the_error_of_the_earliest_item_is_raised(threads):
    def bad(i: int) -> int:
        if i >= 3:
            time.sleep(0.02 if i == 3 else 0.0)
            raise ValueError(str(i))
        return i

    with pytest.raises(ValueError, match=r"^3$"):
        mapped(bad, range(8), threads)


def test_what_holds_for_the_caller_holds_for_its_threads():
    choice: ContextVar[str] = ContextVar("choice", default="none")
    token = choice.set("mine")
    try:
        assert mapped(lambda _: choice.get(), range(4), 2) == ["mine"] * 4
    finally:
        choice.reset(token)


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
    assert mapped(slept, range(8), 2, least=5e-3) == list(range(8))
    assert len(who) == (1 if seconds == 0.0 else 3)

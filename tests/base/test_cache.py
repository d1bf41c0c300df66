"""The cache of all modules: one value for each key, a bound on its size, and nothing left by a failed call."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from restless import restless

from optloc.base.cache import Cache


def test_a_cache_makes_a_value_once_whoever_asks():
    cache: Cache[int] = Cache(1000)
    made: list[int] = []

    def make(i: int) -> int:
        time.sleep(1e-4)
        made.append(i)
        return i * i

    def ask(i: int) -> int:
        return cache.find(i % 50, lambda: make(i % 50))

    with restless(), ThreadPoolExecutor(8) as pool:
        assert list(pool.map(ask, range(1500))) == [(i % 50) ** 2 for i in range(1500)]
    assert sorted(made) == list(range(50))


def test_a_cache_keeps_its_bound_and_what_was_used_last():
    cache: Cache[int] = Cache(10, lambda value: value)
    assert [cache.find(key, lambda key=key: key) for key in (4, 3, 2)] == [4, 3, 2]
    cache.find(4, lambda: pytest.fail("kept"))
    cache.find(5, lambda: 5)  # 14 of 10: drives out 3 and 2, which were used before 4
    assert cache.find(4, lambda: pytest.fail("kept")) == 4
    assert cache.find(3, lambda: 1) == 1
    assert cache.find(11, lambda: 11) == 11  # too heavy to be kept
    assert len(cache) == 3
    cache.clear()
    assert len(cache) == 0


def test_a_cache_of_threads_that_drive_each_other_out_keeps_its_bound():
    cache: Cache[int] = Cache(30, lambda value: 1 + value % 3)
    with restless(), ThreadPoolExecutor(8) as pool:
        found = pool.map(lambda i: cache.find(i * i % 97, lambda: i * i % 97), range(20000))
        assert list(found) == [i * i % 97 for i in range(20000)]
    assert 10 <= len(cache) <= 30


def test_a_call_that_raises_leaves_nothing_in_a_cache():
    cache: Cache[int | None] = Cache(5)
    with pytest.raises(ZeroDivisionError):
        cache.find("key", lambda: 1 // 0)
    assert len(cache) == 0
    assert cache.find("key", lambda: None) is None
    assert cache.find("key", lambda: pytest.fail("None is a value")) is None

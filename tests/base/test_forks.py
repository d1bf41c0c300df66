"""Forks: locks are free in the child, and the child does not wait for a module that another thread imports."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from optloc.base.forks import held_by_forks

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork"),
    pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning"),
]


def ends(work):
    """Return whether a forked child ends `work` within twenty seconds without an error."""
    child = os.fork()
    if not child:
        signal.alarm(20)
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitpid(child, 0)[1] == 0


def test_a_fork_waits_for_the_lock_and_the_child_has_it_free():
    repaired = []
    lock = held_by_forks(threading.Lock(), lambda: repaired.append(1))
    held, free = threading.Event(), threading.Event()

    def hold():
        with lock:
            held.set()
            free.wait(20)

    thread = threading.Thread(target=hold)
    thread.start()
    assert held.wait(20)
    threading.Timer(0.1, free.set).start()

    def work():
        assert repaired == [1]
        assert lock.acquire(timeout=10)

    assert ends(work)
    thread.join()
    assert lock.acquire(timeout=10), "the parent has the lock free, too"
    lock.release()
    assert repaired == []


def test_a_lock_that_is_registered_during_a_fork_stays_untouched():
    first = held_by_forks(threading.Lock())
    held, free, second = threading.Event(), threading.Event(), []

    def hold():
        with first:
            held.set()
            free.wait(20)
            second.append(held_by_forks(threading.Lock()))
            second[0].acquire()

    thread = threading.Thread(target=hold)
    thread.start()
    assert held.wait(20)
    threading.Timer(0.1, free.set).start()
    assert ends(lambda: None)
    thread.join()
    assert second[0].locked(), "the fork has released a lock that it had not acquired"
    second[0].release()


SLOW = """
import os, signal, sys, threading
sys.path.insert(0, sys.argv[1])
import optloc.base.forks as forks
forks._IMPORTED = frozenset(["slow_module"])
thread = threading.Thread(target=__import__, args=("slow_module",))
thread.start()
while "slow_module" not in sys.modules:
    pass
child = os.fork()
if not child:
    signal.alarm(20)
    import slow_module
    os._exit(0 if slow_module.READY else 1)
sys.exit(os.waitpid(child, 0)[1] != 0)
"""


def test_a_child_imports_what_a_thread_of_its_parent_was_importing(tmp_path):
    (tmp_path / "slow_module.py").write_text("import time\ntime.sleep(0.5)\nREADY = True\n")
    command = [sys.executable, "-W", "ignore", "-c", SLOW, str(tmp_path)]
    assert subprocess.run(command, timeout=60, check=False).returncode == 0

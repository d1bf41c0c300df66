"""A process apart, in which the methods of a study run: watched over, held to limits, ended with who began it.

It is begun without multiprocessing, which would run the caller's script again, and which lets the daemonic workers of a
cluster begin none.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import IO, Any, NoReturn

from optloc.lab.study.design import Chunk
from optloc.lab.study.trial import DIED, LATE, Lost, TrialPart, compute
from optloc.problem import InvalidProblem, load_plugin, plugins

# Seconds: to begin, half of one where a processor is free; without a task, after which it ends, as nobody tells a
# cluster that a study is over; between the end of its pipe and its own, which says how it ended.
_START, _IDLE, _MOMENT = 120.0, 60.0, 0.2
# Workers times threads would be more than the processors, and each thread of BLAS reserves memory.
_ONE = ("OPTLOC", "OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "BLIS_NUM", "VECLIB_MAXIMUM", "NUMEXPR_NUM", "NUMBA_NUM")
# From its beginning the system kills its group where the other end of its pipe is closed, or written to. A thread that
# waits for that does so everywhere, but not while machine code holds the interpreter.
_BEGIN = """
import contextlib, os, pickle, select, signal, sys
def die_with(file, on):
    with contextlib.suppress(ImportError, AttributeError, OSError):
        import fcntl
        fcntl.fcntl(file, fcntl.F_SETOWN, -os.getpgrp())
        fcntl.fcntl(file, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(file, fcntl.F_SETFL, os.O_ASYNC if on else 0)
        if on and select.select([file], [], [], 0)[0]:
            os.killpg(os.getpgrp(), signal.SIGKILL)
sys.path[:], run = pickle.load(sys.stdin.buffer) if sys.stdin.buffer.peek() else sys.exit()
die_with(0, True)
pickle.loads(run)(die_with)
"""


class WorkerProcess:
    """A process apart that computes chunks, one at a time; what it begins ends with it."""

    def __init__(self) -> None:
        # -P: nothing is imported from the current folder, unless this process does that, too. A session of its own:
        # Ctrl-C is for this process, which ends it.
        self._process = subprocess.Popen(  # noqa: S603  (this interpreter, and a text of this file)
            [sys.executable, "-P", "-c", _BEGIN],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {f"{name}_THREADS": "1" for name in _ONE},
            start_new_session=True,
        )
        self._ended, self._pipes = Lock(), Lock()

    def lives(self) -> bool:
        """Return whether it can be asked."""
        return self._process.poll() is None

    def ask(self, message: object, seconds: float) -> Any:
        """Return the answer to a message; raise TimeoutError after so many seconds, EOFError where the process ends."""
        answer: SimpleQueue[Any] = SimpleQueue()

        def exchange() -> None:
            # In a thread: pipes have no time limit on every system.
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            found = None
            with self._pipes, suppress(Exception):  # whatever a process that ends leaves in its pipe
                _send(self._process.stdin, message)
                found = pickle.load(self._process.stdout)  # noqa: S301  (of a process of our own)
            answer.put(found)

        Thread(target=exchange, daemon=True).start()
        try:
            found = answer.get(timeout=seconds)
        except Empty:
            self.end()
            raise TimeoutError from None
        if found is None:
            raise EOFError(self.end(_MOMENT))
        return found

    def end(self, seconds: float = 0.0) -> str:
        """End the process, after some seconds, with all that it began, whatever it does, and return how it ended."""
        with self._ended:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)
            # Its group lives on where what it began has not ended; some systems have none.
            with suppress(AttributeError, ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.kill()
            code = self._process.wait()
        # A copy of it that left its group may hold the other ends.
        if self._pipes.acquire(timeout=_MOMENT):
            with suppress(OSError), self._process:
                self._pipes.release()
        how = f"exit code {code}" if code >= 0 else f"signal {-code} ({signal.strsignal(-code)})"
        return f"its process ended with {how}"


def _send(file: IO[bytes], message: object) -> None:
    pickle.dump(message, file)
    file.flush()


class WorkerPool:
    """Processes apart: begun when they are needed, and others where they died.

    Parameters
    ----------
    count : int
        How many share the machine.
    """

    def __init__(self, count: int) -> None:
        self._memory, self._lock, self._closed = memory_of(count), Lock(), False
        self._all: set[WorkerProcess] = set()
        self._idle: list[WorkerProcess] = []

    def compute(self, chunk: Chunk, seconds: float, names: Sequence[str] | None = None) -> TrialPart | Lost:
        """Return the part of a chunk, computed in a process apart, or what came of it in so many seconds.

        Parameters
        ----------
        chunk : Chunk
            What is to be done.
        seconds : float
            Its limit; 0: it is not tried.
        names : sequence of str, optional
            Plugins that are loaded first; those of this process by default.

        Raises
        ------
        InvalidProblem
            Where the method cannot be run at all, or no process can be begun.
        """
        if not seconds:
            return Lost(chunk.key, LATE, "not tried")
        apart = self._take()
        try:
            # Pickled twice: who listens need not import what belongs to the chunk, and plugins come before it.
            message = (chunk.key, tuple(plugins() if names is None else names), pickle.dumps(chunk))
            found = apart.ask(pickle.dumps(message), seconds)
            if isinstance(found, InvalidProblem):
                raise found
            if isinstance(found, TrialPart) and (found.key, len(found.table)) == (chunk.key, chunk.count):
                return found
            # A process without memory, or one that answers something else, is of no use to others.
            apart.end()
            return found if isinstance(found, Lost) else Lost(chunk.key, DIED, "its process answered something else")
        except TimeoutError:
            return Lost(chunk.key, LATE, f"it took more than {seconds:g} s")
        except EOFError as error:
            return Lost(chunk.key, DIED, str(error))
        finally:
            with self._lock:
                (self._idle.append if apart.lives() else self._all.discard)(apart)

    def close(self) -> None:
        """End all processes."""
        with self._lock:
            self._closed, left = True, list(self._all)
        for apart in left:
            apart.end()

    def _take(self, *, again: bool = True) -> WorkerProcess:
        """Return a process that waits, or another."""
        with self._lock:
            while self._idle:
                if (apart := self._idle.pop()).lives():
                    return apart
                self._all.discard(apart)
        try:
            return self._begin()
        except (EOFError, TimeoutError) as error:
            # Once somebody may have killed it; twice, nothing can be computed here.
            if again:
                return self._take(again=False)
            advice = "what it said stands above; check the installation, and the memory that is left"
            raise InvalidProblem(f"no process can be begun ({error})", sys.executable, advice) from None

    def _begin(self) -> WorkerProcess:
        with self._lock:
            if self._closed:
                raise InvalidProblem("the run was stopped", "study", "the same command goes on")
            self._all.add(apart := WorkerProcess())
        # What runs there is found when the path is that of this process.
        apart.ask(([str(place) for place in sys.path], pickle.dumps(partial(serve, self._memory))), _START)
        return apart


# What methods may take of the memory of a machine, if all processes do so; and bytes that each may use at least:
# libraries alone reserve 2e9.
_MEMORY, _LEAST_MEMORY = 0.8, 4 << 30


def memory_of(count: int) -> int | None:
    """Return the bytes that each of so many processes of this machine may use; None where that is not known."""
    if not hasattr(os, "sysconf"):
        return None
    return max(_LEAST_MEMORY, int(_MEMORY * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / count))


def restrain(memory: int | None) -> None:
    """Limit the memory of this process, have it leave no core, and be the first to go where memory is short."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if memory is not None:
            resource.setrlimit(resource.RLIMIT_AS, (memory, resource.getrlimit(resource.RLIMIT_AS)[1]))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


# What runs in the process apart.


def serve(memory: int | None, die_with: Callable[[IO[bytes], bool], None]) -> NoReturn:
    """Compute the chunks that come in at standard input, one by one, and answer at standard output, until it closes."""
    restrain(memory)
    # A method may read and print what it likes. First, lest a pipe's copy takes the place of closed standard error.
    nowhere, own, line = os.open(os.devnull, os.O_RDWR), os.getpid(), SimpleQueue[bytes]()
    tasks, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    for number in range(3):
        os.dup2(nowhere, number)
    Thread(target=_listen, args=(tasks, line, die_with), daemon=True).start()
    found: object = True
    try:
        while True:
            if os.getpid() != own:
                os._exit(0)  # a method forked, and its copy has arrived here, too
            die_with(tasks, False)
            _send(answers, found)
            key, names, packed = pickle.loads(line.get(timeout=_IDLE))  # noqa: S301
            try:
                for name in names:
                    load_plugin(name)
                found = compute(pickle.loads(packed))  # noqa: S301
            except InvalidProblem as error:
                found = error
            except Exception as error:  # noqa: BLE001  (short of memory, most of all)
                found = Lost(key, DIED, f"{type(error).__name__}: {error}")
    finally:
        _end()


def _listen(tasks: IO[bytes], line: SimpleQueue[bytes], die_with: Callable[[IO[bytes], bool], None]) -> None:
    """Pass on what comes in; where nothing can come any more, who sent it has ended, and so does this process."""
    try:
        while True:
            message = pickle.load(tasks)  # noqa: S301
            die_with(tasks, True)
            line.put(message)
    finally:
        _end()


def _end() -> NoReturn:
    """End this process and its group, whatever threads it has."""
    if hasattr(os, "killpg"):
        os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(1)

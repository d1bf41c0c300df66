"""Worker process for the methods of a study: it has limits of time and memory, and it ends with its parent process.

The parent starts the worker without multiprocessing. multiprocessing would run the script of the caller again, and it
does not let daemonic workers of a cluster start processes.

Parent and worker exchange pickled messages through pipes: standard input and output of the worker. `WorkerProcess` and
`WorkerPool` run in the parent, `serve` and the functions after it run in the worker.
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

# Time limits, seconds. For the start of a worker: it takes half a second if a processor is free. Until an idle worker
# ends: a cluster does not signal the end of a study. From the end of the pipe to the end of the process: only then is
# there an exit code.
_START, _IDLE, _END_WAIT = 120.0, 60.0, 0.2
# Variables that limit the threads of libraries. Workers times threads would exceed the processors, and each thread of
# BLAS reserves memory.
_THREAD_VARIABLES = (
    "OPTLOC",
    "OMP_NUM",
    "OPENBLAS_NUM",
    "MKL_NUM",
    "BLIS_NUM",
    "VECLIB_MAXIMUM",
    "NUMEXPR_NUM",
    "NUMBA_NUM",
)
# Code that the new process runs. Its function `die_with(file, on)` switches a signal of the pipe `file` on or off.
# While the signal is on, the system kills the worker's group if the parent closes its end of the pipe or writes to it.
# It is on while a chunk is computed. A thread that waits for the end of the pipe works on every system. But it does not
# run while machine code holds the interpreter.
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
    """Worker process that computes one chunk at a time; all processes that it starts end with it."""

    def __init__(self) -> None:
        # -P: the worker imports nothing from the current folder, unless this process does so too. It has a session of
        # its own, because Ctrl-C is for this process, which then ends the worker.
        self._process = subprocess.Popen(  # noqa: S603  (this interpreter, and a text of this file)
            [sys.executable, "-P", "-c", _BEGIN],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {f"{name}_THREADS": "1" for name in _THREAD_VARIABLES},
            start_new_session=True,
        )
        self._ended, self._pipes = Lock(), Lock()

    def lives(self) -> bool:
        """Return whether the process is alive and accepts messages."""
        return self._process.poll() is None

    def ask(self, message: object, seconds: float) -> Any:
        """Return the reply to a message; raise TimeoutError after `seconds`, or EOFError if the process ends.

        In both cases the process has been killed.
        """
        replies: SimpleQueue[Any] = SimpleQueue()

        def exchange() -> None:
            # In a thread, because pipes have no time limit on some systems.
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            reply = None
            with self._pipes, suppress(Exception):  # a process that ends may leave an incomplete message
                _send(self._process.stdin, message)
                reply = pickle.load(self._process.stdout)  # noqa: S301  (the sender is our worker)
            replies.put(reply)

        Thread(target=exchange, daemon=True).start()
        try:
            reply = replies.get(timeout=seconds)
        except Empty:
            self.end()
            raise TimeoutError from None
        if reply is None:
            raise EOFError(self.end(_END_WAIT))
        return reply

    def end(self, seconds: float = 0.0) -> str:
        """Kill the process and its children, and return its exit code as text.

        First wait at most `seconds` until the process ends without a signal, because a killed process has another code.
        """
        with self._ended:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)
            # Its group continues while a child process runs; some systems have no groups.
            with suppress(AttributeError, ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.kill()
            code = self._process.wait()
        # A forked copy that left the group may hold the other ends of the pipes.
        if self._pipes.acquire(timeout=_END_WAIT):
            with suppress(OSError), self._process:
                self._pipes.release()
        ending = f"exit code {code}" if code >= 0 else f"signal {-code} ({signal.strsignal(-code)})"
        return f"its process ended with {ending}"


def _send(file: IO[bytes], message: object) -> None:
    """Write a pickled message to a pipe."""
    pickle.dump(message, file)
    file.flush()


class WorkerPool:
    """Worker processes of this machine, started on demand and replaced if they die.

    Parameters
    ----------
    count : int
        Number of workers that share the memory of the machine.
    """

    def __init__(self, count: int) -> None:
        self._memory, self._lock, self._closed = memory_of(count), Lock(), False
        self._all: set[WorkerProcess] = set()
        self._idle: list[WorkerProcess] = []

    def compute(self, chunk: Chunk, seconds: float, names: Sequence[str] | None = None) -> TrialPart | Lost:
        """Return the part of a chunk, computed in a worker, or a `Lost` that records the reason of the failure.

        Parameters
        ----------
        chunk : Chunk
            Trials to compute.
        seconds : float
            Time limit; with 0 the chunk is not tried.
        names : sequence of str, optional
            Plugins that the worker loads first; by default the plugins of this process.

        Raises
        ------
        InvalidProblem
            If the method cannot run at all, or no worker can be started.
        """
        if not seconds:
            return Lost(chunk.key, LATE, "not tried")
        worker = self._take()
        try:
            # Pickled twice: the receiving thread need not import the modules of the chunk, and plugins are loaded
            # before the chunk.
            message = (chunk.key, tuple(plugins() if names is None else names), pickle.dumps(chunk))
            reply = worker.ask(pickle.dumps(message), seconds)
            if isinstance(reply, InvalidProblem):
                raise reply
            if isinstance(reply, TrialPart) and (reply.key, len(reply.table)) == (chunk.key, chunk.count):
                return reply
            # A process that is out of memory or sends an invalid reply is not used again.
            worker.end()
            return reply if isinstance(reply, Lost) else Lost(chunk.key, DIED, "its process sent an invalid reply")
        except TimeoutError:
            return Lost(chunk.key, LATE, f"it took more than {seconds:g} s")
        except EOFError as error:
            return Lost(chunk.key, DIED, str(error))
        finally:
            # A living worker becomes idle, and a dead one is removed.
            with self._lock:
                (self._idle.append if worker.lives() else self._all.discard)(worker)

    def close(self) -> None:
        """End all workers."""
        with self._lock:
            self._closed, processes = True, list(self._all)
        for worker in processes:
            worker.end()

    def _take(self, *, again: bool = True) -> WorkerProcess:
        """Return an idle worker, or a new one. If `again` is true, a failed start is tried once more.

        Raise InvalidProblem if no worker can be started.
        """
        with self._lock:
            while self._idle:
                if (worker := self._idle.pop()).lives():
                    return worker
                self._all.discard(worker)
        try:
            return self._begin()
        except (EOFError, TimeoutError) as error:
            # Another program may have killed the worker once. After a second failure nothing can be computed here.
            if again:
                return self._take(again=False)
            advice = "read its output above; check the installation and the free memory"
            raise InvalidProblem(f"no process can be started ({error})", sys.executable, advice) from None

    def _begin(self) -> WorkerProcess:
        """Start a process, send it the import path and the server function, and return it when it is ready."""
        with self._lock:
            if self._closed:
                raise InvalidProblem("the run was stopped", "study", "run the same command to continue")
            self._all.add(worker := WorkerProcess())
        # With the path of this process the worker finds the same modules.
        worker.ask(([str(place) for place in sys.path], pickle.dumps(partial(serve, self._memory))), _START)
        return worker


# Share of the machine's memory that all workers may use together, and the least bytes of each worker: libraries alone
# reserve 2e9.
_MEMORY, _LEAST_MEMORY = 0.8, 4 << 30


def memory_of(count: int) -> int | None:
    """Return the bytes that each of `count` workers of this machine may use; None if the memory is unknown."""
    if not hasattr(os, "sysconf"):
        return None
    return max(_LEAST_MEMORY, int(_MEMORY * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / count))


def limit_memory(memory: int | None) -> None:
    """Limit the memory (bytes) of this process, which leaves no core file and ends first if memory is short."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if memory is not None:
            resource.setrlimit(resource.RLIMIT_AS, (memory, resource.getrlimit(resource.RLIMIT_AS)[1]))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


# Code that runs in the worker.


def serve(memory: int | None, die_with: Callable[[IO[bytes], bool], None]) -> NoReturn:
    """Compute chunks from standard input one by one, and write replies to standard output, until the input closes.

    `memory` is the limit of this process in bytes. `die_with` is the function in the text `_BEGIN`, which switches the
    signal of the pipe on or off. The first reply is True, and reports that the worker is ready.
    """
    limit_memory(memory)
    # A method may read and print, so standard streams go to the null device. This comes first: otherwise a copy of a
    # pipe could take the place of a closed standard error.
    null_device, pid, messages = os.open(os.devnull, os.O_RDWR), os.getpid(), SimpleQueue[bytes]()
    tasks, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    for number in range(3):
        os.dup2(null_device, number)
    Thread(target=_listen, args=(tasks, messages, die_with), daemon=True).start()
    reply: object = True
    try:
        while True:
            if os.getpid() != pid:
                os._exit(0)  # a method forked, and its copy has returned here too
            # Off before the reply, because the next message of the parent would also cause the signal.
            die_with(tasks, False)
            _send(replies, reply)
            key, names, packed = pickle.loads(messages.get(timeout=_IDLE))  # noqa: S301
            try:
                for name in names:
                    load_plugin(name)
                reply = compute(pickle.loads(packed))  # noqa: S301
            except InvalidProblem as error:
                reply = error
            except Exception as error:  # noqa: BLE001  (most often out of memory)
                reply = Lost(key, DIED, f"{type(error).__name__}: {error}")
    finally:
        _end()


def _listen(tasks: IO[bytes], messages: SimpleQueue[bytes], die_with: Callable[[IO[bytes], bool], None]) -> None:
    """Put incoming messages into a queue; end this process if the pipe closes, because the parent has ended."""
    try:
        while True:
            message = pickle.load(tasks)  # noqa: S301
            die_with(tasks, True)
            messages.put(message)
    finally:
        _end()


def _end() -> NoReturn:
    """End this process and its group, with all threads."""
    if hasattr(os, "killpg"):
        os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(1)

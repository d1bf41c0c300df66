"""A line every two seconds while machine code is made or loaded, unless the user wants none (`--quiet`).

On a terminal one line is written over and over; elsewhere each is a warning of the log ``optloc.compile``, which goes
to standard error unless a program has other plans for it.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from threading import Lock, Thread
from time import monotonic, sleep
from typing import ClassVar

from optloc.base.threads import held_by_forks

# Seconds after which somebody who sees nothing begins to wonder; seconds between two looks at the clock; and between
# two compilations that belong together.
_EVERY, _LOOK, _PAUSE = 2.0, 0.2, 1.0
_LOG = logging.getLogger("optloc.compile")
# To the begin of the line, and clear it.
_CLEAR = "\r\x1b[2K"


class Reporter:
    """Says every two seconds how far something is, for as long as it goes on.

    Parameters
    ----------
    text : callable
        Returns the line.
    """

    # Whether the user wants no line at all, in this process.
    quiet: ClassVar[bool] = False

    def __init__(self, text: Callable[[], str]) -> None:
        self._text, self.muted = text, False
        self._lock = Lock()
        self._start()
        held_by_forks(self._lock, self._start)

    def _start(self) -> None:
        self._depth, self._watching, self._since, self._ended = 0, False, 0.0, -_PAUSE

    def begin(self) -> None:
        """Note that something begins, in whichever thread, or within what has begun before."""
        with self._lock:
            self._depth += 1
            now = monotonic()
            if self._depth == 1 and now - self._ended >= _PAUSE:
                self._since = now
            if not self._watching and not self.muted and not Reporter.quiet:
                self._watching = True
                Thread(target=self._watch, daemon=True, name="optloc progress").start()

    def end(self) -> None:
        """Note that what began has ended."""
        with self._lock:
            self._depth -= 1
            self._ended = monotonic()

    def _watch(self) -> None:
        said = False
        while True:
            sleep(_LOOK)
            with self._lock:
                now = monotonic()
                if self._depth == 0 and now - self._ended >= _PAUSE:
                    self._watching = False
                    break
                due = self._depth > 0 and now - self._since >= _EVERY - _LOOK
                self._since = now if due else self._since
            if due:
                said = True
                _say(self._text())
        if said and _on_terminal():
            sys.stderr.write(_CLEAR)
            sys.stderr.flush()


def _on_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


def _say(text: str) -> None:
    if _on_terminal():
        sys.stderr.write(_CLEAR + text)
        sys.stderr.flush()
    else:
        _LOG.warning("%s", text)


def keep_quiet(quiet: bool) -> bool:
    """Switch progress off or on in this process, and return the argument, as the callback of an option must."""
    Reporter.quiet = quiet
    return quiet

"""A progress line every two seconds while machine code is compiled or loaded; the option `--quiet` switches it off.

On a terminal, one line is overwritten. Elsewhere each line is a warning of the log ``optloc.compile``, which goes to
standard error unless the program configures logging differently. A notebook would store each line as an output of its
cell. So there the lines have the level "info", which logging hides by default.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from threading import Lock, Thread
from time import monotonic, sleep
from typing import ClassVar

from optloc.base.forks import held_by_forks

# Seconds between two lines, so that a user does not wait without any output; seconds between two checks of the clock;
# longest pause between two compilations that count as one activity.
_EVERY, _LOOK, _PAUSE = 2.0, 0.2, 1.0
_LOG = logging.getLogger("optloc.compile")
# Return to the start of the line and clear it.
_CLEAR = "\r\x1b[2K"


class Reporter:
    """Prints the progress of an activity every two seconds while it lasts.

    Parameters
    ----------
    text : callable
        Returns the line.
    """

    # Whether this process prints no progress at all.
    quiet: ClassVar[bool] = False

    def __init__(self, text: Callable[[], str]) -> None:
        self._text, self.muted = text, False
        self._lock = Lock()
        self._start()
        held_by_forks(self._lock, self._start)

    def _start(self) -> None:
        """Reset the counters, also in a child process after a fork."""
        self._depth, self._watching, self._since, self._ended = 0, False, 0.0, -_PAUSE

    def begin(self) -> None:
        """Count the start of an activity, in any thread, also inside another activity."""
        with self._lock:
            self._depth += 1
            now = monotonic()
            if self._depth == 1 and now - self._ended >= _PAUSE:
                self._since = now
            if not self._watching and not self.muted and not Reporter.quiet:
                self._watching = True
                Thread(target=self._watch, daemon=True, name="optloc progress").start()

    def end(self) -> None:
        """Count the end of an activity."""
        with self._lock:
            self._depth -= 1
            self._ended = monotonic()

    def _watch(self) -> None:
        """Print lines until the activity has ended."""
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


def in_notebook() -> bool:
    """Return whether a notebook stores standard error as the output of a cell: in its kernel, or in a command of it."""
    # Jupyter sets the variable for the kernel, and shell commands of cells inherit it, although they see a terminal.
    return type(sys.stderr).__module__.partition(".")[0] == "ipykernel" or "JPY_PARENT_PID" in os.environ


def _on_terminal() -> bool:
    """Return whether standard error is a terminal on which a line can be overwritten."""
    return sys.stderr is not None and sys.stderr.isatty() and not in_notebook()


def _say(text: str) -> None:
    """Print a line on the terminal, or log it."""
    if _on_terminal():
        sys.stderr.write(_CLEAR + text)
        sys.stderr.flush()
    else:
        _LOG.log(logging.INFO if in_notebook() else logging.WARNING, "%s", text)


def keep_quiet(quiet: bool) -> bool:
    """Switch progress off or on in this process, and return the argument, as a callback of an option must."""
    Reporter.quiet = quiet
    return quiet

"""Standard error of a service: a bounded queue, since a reader that does not read must not stop the stream."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from io import TextIOBase
from typing import Any

from optloc.files import visible
from optloc.service.side_outputs import SideOutput

# Characters that wait for standard error: some hours of health.
_WAITING = 1 << 20
# Seconds for which the end of the service waits for a reader of standard error.
_PATIENCE = 2.0


class QueuedText(TextIOBase):
    """Text file that passes all texts to a side output; `file` is the file that the output writes."""

    def __init__(self, output: SideOutput[str], file: Any) -> None:
        self._output, self._file = output, file

    def write(self, text: str) -> int:
        """Queue a text, and return its length."""
        if text:
            self._output.put(text, len(text))
        return len(text)

    def isatty(self) -> bool:
        """Return whether the file is a terminal."""
        return bool(self._file.isatty())

    def fileno(self) -> int:
        """Return the number of the file."""
        return int(self._file.fileno())


@contextmanager
def standard_error(*, quiet: bool = False) -> Iterator[tuple[Callable[[str], None], SideOutput[str]]]:
    """Send all texts for standard error through a bounded queue within the block.

    Yield a function that prints a line for people, and the output. With `quiet`, the function prints nothing; warnings
    and errors are still printed.
    """
    file = sys.stderr
    output = SideOutput("standard error", _writer(file), _WAITING)
    # Handlers of the log have the file from before the block, except handlers that are made within it.
    handlers = [handler for handler in _log_handlers() if handler.stream is file]
    text = QueuedText(output, file)

    def say(line: str) -> None:
        """Print a line for people."""
        if not quiet:
            text.write(visible(line) + "\n")

    try:
        for handler in handlers:
            handler.setStream(text)
        with redirect_stderr(text):
            yield say, output
    finally:
        for handler in handlers:
            handler.setStream(file)
        output.close(_PATIENCE)


def _log_handlers() -> list[Any]:
    """Return the handlers that write the log of optloc to a file or a terminal."""
    import logging

    return [each for each in logging.getLogger("optloc").handlers if isinstance(each, logging.StreamHandler)]


def _writer(file: Any) -> Callable[[Sequence[str]], None]:
    """Return a function that writes texts to a text file.

    It writes to the number of the file if there is one. The lock of the file is then free while a write waits, so the
    process can end.
    """
    try:
        number = file.fileno()
    except (OSError, AttributeError, ValueError):
        number = None  # in memory, as in tests

    def write(texts: Sequence[str]) -> None:
        """Write texts."""
        if number is None:
            file.write("".join(texts))
            file.flush()
            return
        data = "".join(texts).encode("utf-8", "replace")
        while data:
            data = data[os.write(number, data) :]

    return write

"""Files of a stream: its state, which one process owns, and its recording. Their threads never stop the stream."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from optloc.files import GrowingFile, write_text
from optloc.service.answers import Record, to_line
from optloc.service.checkpoint import restore
from optloc.service.events import Events
from optloc.service.messages import with_reading_time
from optloc.service.side_outputs import SideOutput
from optloc.service.state_lock import StateLock

# Bytes of a recording that are collected before they are queued, and bytes that wait if the disk is full or slow: half
# a minute of a thousand lines of 250 bytes a second.
_BUFFER, _WAITING = 1 << 16, 1 << 23


class StreamFiles:
    """State and recording of a stream.

    Parameters
    ----------
    state : Path, optional
        File of the checkpoints. If it exists, its checkpoint is restored.
    record : Path, optional
        File for the lines with their times of reading.
    events : Events
        Receives the restored checkpoint.
    now : float
        Time of the clock for which events wait, s.
    say : callable
        Receives one sentence if a file cannot be written, and one if it can be written again.

    Raises
    ------
    InvalidProblem
        If a file cannot be used, or another process has the state. No file of a recording is then created.
    """

    def __init__(
        self, state: Path | None, record: Path | None, events: Events, now: float, say: Callable[[str], None]
    ) -> None:
        self._lock = None if state is None else StateLock(state)
        self._state: SideOutput[Record] | None = None
        self._record: SideOutput[bytes] | None = None
        self._lines, self._count = bytearray(), 0  # lines that are not yet in the queue of the recording
        try:
            if state is not None and state.exists():
                restore(state, events, now)
            file = None if record is None else GrowingFile(record)
        except BaseException:
            if self._lock is not None:
                self._lock.release()
            raise
        if state is not None:
            # A newer checkpoint replaces a checkpoint that waits.
            self._state = SideOutput("state", lambda states: _write_state(state, states[-1]), 1, say)
        if file is not None:
            self._record = SideOutput(
                "recording", lambda parts: file.append(b"".join(parts)), _WAITING, say, file.finish
            )

    @property
    def outputs(self) -> list[SideOutput[Any]]:
        """Return the outputs of the files."""
        return [output for output in (self._state, self._record) if output is not None]

    def checkpoint(self, state: Callable[[], Record], *, waits: bool = False) -> None:
        """Queue a checkpoint, if there is a file for it; with `waits`, wait until it is written, or writing fails."""
        if self._state is not None:
            self._state.put(state())
            if waits:
                self._state.wait()

    def record(self, data: bytes, stamp: float) -> None:
        """Record a line with its time of reading, `stamp`, s, as the first key of its JSON object."""
        if self._record is not None:
            self._lines += with_reading_time(data, stamp) + b"\n"
            self._count += 1
            if len(self._lines) > _BUFFER:
                self.write_record()

    def write_record(self) -> None:
        """Queue the collected lines for the recording, if any."""
        if self._record is not None and self._lines:
            self._record.put(bytes(self._lines), len(self._lines), self._count)
            self._lines, self._count = bytearray(), 0

    def close(self) -> None:
        """Write the waiting entries, for `PATIENCE` seconds at most, and release the state."""
        self.write_record()
        for output in self.outputs:
            output.close()
        if self._lock is not None:
            self._lock.release()


def _write_state(path: Path, state: Record) -> None:
    """Write a checkpoint; raise InvalidProblem if this fails."""
    write_text(path, to_line(state).decode())

"""Lock of a state file: one process owns it. The operating system releases the lock when the process ends or dies."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

from optloc.problem import InvalidProblem

# Attempts to get a lock file that its last owner removes at the same moment.
_ATTEMPTS = 10


class StateLock:
    """Exclusive lock on a state file, held until `release` or the end of the process.

    The lock is on the file with the same name plus ``.lock``, since each checkpoint replaces the state file.

    Parameters
    ----------
    path : Path
        State file.

    Raises
    ------
    InvalidProblem
        If another stream has the lock, or if the lock file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._path = path.with_name(f"{path.name}.lock")
        for _ in range(_ATTEMPTS):
            try:
                self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
            except OSError as error:
                what = f"the lock file {self._path.name} cannot be made ({error.strerror or error})"
                raise InvalidProblem(what, str(path), "choose another place") from None
            try:
                _lock(self._file)
            except OSError:
                os.close(self._file)
                what = "another process uses this state file"
                raise InvalidProblem(what, str(path), "stop the other process, or use another file") from None
            if self._is_current():
                return
            os.close(self._file)  # the former owner removed this lock file after it was opened
        raise InvalidProblem("the lock file changes all the time", str(path), "use another file")

    def _is_current(self) -> bool:
        """Return whether the locked file still has the name of the lock file."""
        try:
            return os.path.samestat(os.fstat(self._file), self._path.stat())
        except OSError:
            return False

    def release(self) -> None:
        """Remove the lock file and release the lock."""
        with suppress(OSError):  # on Windows, an open file cannot be removed; an unlocked file is harmless
            self._path.unlink()
        os.close(self._file)


if sys.platform == "win32":
    import msvcrt

    def _lock(file: int) -> None:
        """Lock the first byte of an open file; raise OSError if another process has the lock."""
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _lock(file: int) -> None:
        """Lock an open file; raise OSError if another process has the lock."""
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

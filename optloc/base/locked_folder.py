"""A folder of results with a single writer: created, checked for other files, and locked until the run ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from optloc.base.errors import InvalidProblem
from optloc.base.outputs import refuse_address


@contextmanager
def locked_folder(folder: Path, lock: str, own: str, foreign: str, kept: str) -> Iterator[None]:
    """Create a folder and lock it against other runs; the lock ends with the process.

    Parameters
    ----------
    folder : Path
        The folder. A folder with files, but without the files `lock` or `own`, stays unchanged.
    lock, own : str
        Name of the lock file, and of a file that each such folder has.
    foreign : str
        The error for a folder with other files.
    kept : str
        Next step if the folder cannot be written.

    Raises
    ------
    InvalidProblem
        If another run has the lock, the folder cannot be written, or it has other files.
    """
    refuse_address(folder)
    try:
        names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        if names and not names & {lock, own}:
            raise InvalidProblem(foreign, str(folder), "choose another with --out")
        folder.mkdir(parents=True, exist_ok=True)
        # Open for writing: network file systems do not lock other files.
        file = (folder / lock).open("ab")
    except OSError as error:
        raise unwritable_folder(folder, error, kept) from None
    with file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InvalidProblem("another run writes to this folder", str(folder), "wait until it ends") from None
        except (ImportError, OSError):  # a system or a file system without locks
            pass
        yield


def unwritable_folder(path: Path, error: OSError, kept: str) -> InvalidProblem:
    """Return the error for a folder or its file that cannot be written, with the reason of the system."""
    return InvalidProblem(f"the folder cannot be written ({error.strerror or error})", str(path), kept)

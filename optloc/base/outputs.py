"""Writing of output files: checked before the work, written to a temporary file, renamed when complete.

Library calls replace an existing file, as `numpy.save` does; the command line requires ``--force``. No incomplete file
ever has the final name: after a full disk or Ctrl-C the old file is still there.
"""

from __future__ import annotations

import os
import re
import secrets
import stat
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from tempfile import TemporaryDirectory
from unicodedata import category

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import files_read

_REPLACES: ContextVar[bool] = ContextVar("_REPLACES", default=True)
# Temporary file, final path and requested path of files that wait until all files of a group are complete.
_WAITING: ContextVar[list[tuple[Path, Path, Path]] | None] = ContextVar("_WAITING", default=None)
# Temporary files of this process. Code that ends the process immediately removes them first.
_TEMPORARY: set[Path] = set()
# Names of open streams. The stream can be a file, which must not be replaced.
_OPEN = ("/dev/stdout", "/dev/stderr", "/dev/fd/", "/proc/")


def visible(text: str) -> str:
    """Return the text with every control or invisible character except line ends replaced by an escape sequence."""
    if text.isprintable():  # true for most texts, and a hundred times faster
        return text
    return "".join(c if c == "\n" or category(c)[0] != "C" else c.encode("unicode_escape").decode() for c in text)


def replace_files(wanted: bool) -> bool:
    """Set whether existing files may be replaced, from now on in this context; return the argument."""
    _REPLACES.set(wanted)
    return wanted


def unwritable(path: Path, error: OSError) -> InvalidProblem:
    """Return the error for a file that cannot be written."""
    return InvalidProblem(f"the file cannot be written ({error.strerror or error})", str(path), "choose another place")


# An address such as s3://bucket/key; the class Path joins its slashes. A drive of Windows has a single letter.
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


def refuse_address(path: Path) -> None:
    """Raise InvalidProblem if a path is an address of an object store, such as ``s3://bucket/key``."""
    if _ADDRESS.match(str(path)):
        advice = "copy the data to a folder, or read and write them with Dask or Ray and optloc.fix_table"
        raise InvalidProblem("this is an address of an object store, not a file or folder", str(path), advice)


def make_folder(path: Path) -> None:
    """Make a folder and its parents; raise InvalidProblem if the system refuses, or for an address."""
    refuse_address(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"the folder cannot be made ({error.strerror or error})"
        raise InvalidProblem(what, str(path), "choose another place") from None


def is_standard_output(path: Path | None) -> bool:
    """Return whether a path is "-", the name of standard output for options."""
    return path is not None and str(path) == "-"


def is_stream(path: Path) -> bool:
    """Return whether a path is a pipe, a terminal or another stream, which has no file ending and is not replaced."""
    if is_standard_output(path):
        return True
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode) or os.path.abspath(path).startswith(_OPEN)  # noqa: PTH100


def claim(*paths: Path | None, inputs: Iterable[Path] = ()) -> None:
    """Raise if an output path is not allowed, before the work that produces the output.

    Parameters
    ----------
    *paths : Path, optional
        Files that one command writes. None, and "-" for standard output, are ignored.
    inputs : iterable of Path
        Files that the command reads, in addition to files that were read already.

    Raises
    ------
    InvalidProblem
        If a file exists and may not be replaced, is an input, is named twice (in any spelling), is a folder, or is in a
        folder that does not exist.
    """
    read, seen = tuple(inputs), set[str]()
    for path in paths:
        if path is None or is_stream(path):
            continue
        # Some systems ignore case in file names. A command must work on all systems, so names must differ in more.
        name = str(_place(path, read)).casefold()
        if name in seen:
            raise InvalidProblem("two outputs have this name", str(path), "give each output a different name")
        seen.add(name)


def _place(path: Path, inputs: Iterable[Path] = ()) -> Path:
    """Return the path to write, with links resolved; raise InvalidProblem if it is not allowed.

    `inputs` are files that must not be replaced.
    """
    refuse_address(path)
    try:
        place = Path(os.path.realpath(path))
        if place.name != place.name.encode(errors="replace").decode():
            raise InvalidProblem("the name is not Unicode", str(path), "choose another name")
        if place.is_dir():
            raise InvalidProblem("it is a folder", str(path), "name a file")
        if not place.parent.is_dir():
            raise InvalidProblem("the file cannot be written (no such folder)", str(path), "choose another place")
        if place.is_symlink():
            raise InvalidProblem("it is a link to itself", str(path), "name a file")
        if place.exists():
            _refuse(path, place, inputs)
        if not os.access(place if place.exists() else place.parent, os.W_OK):
            raise InvalidProblem("the file cannot be written (it is protected)", str(path), "choose another place")
    except OSError as error:
        raise unwritable(path, error) from None
    return place


def _refuse(path: Path, place: Path, inputs: Iterable[Path]) -> None:
    """Raise InvalidProblem if an existing file must not be replaced; `place` is `path` with links resolved."""
    if not place.is_file():
        raise InvalidProblem("it is not a file that can be replaced", str(path), "choose another name")
    for one in (*inputs, *files_read()):
        if one.exists() and place.samefile(one):
            raise InvalidProblem("it would replace an input file", str(path), "choose another name")
    if not _REPLACES.get():
        raise InvalidProblem("the file already exists", str(path), "choose another name, or add --force")


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write. It gets the name `path` at the end of the block, or is removed after an error.

    Parameters
    ----------
    path : Path
        The file. An existing file, or the file that a link leads to, is replaced. A pipe or device is written directly.
        The path "-" is standard output, which gets the content at the end of the block.

    Yields
    ------
    Path
        An empty file in the same folder with the same ending, or the stream itself.

    Raises
    ------
    InvalidProblem
        As for `claim`, and if the system refuses, for instance because the disk is full.
    """
    if is_standard_output(path):
        with TemporaryDirectory() as folder:
            yield (temporary := Path(folder) / "output")
            sys.stdout.flush()
            sys.stdout.buffer.write(temporary.read_bytes())
            sys.stdout.flush()
        return
    if is_stream(path):
        with _invalid_if_unwritable(path):
            yield path
        return
    place = _place(path)
    temporary = place.with_name(f".optloc-{secrets.token_hex(8)}{path.suffix}")
    # Temporary files of an open `replace_together` block, which renames them at its end; None outside such a block.
    waiting = _WAITING.get()
    _TEMPORARY.add(temporary)
    try:
        with _invalid_if_unwritable(path):
            # Permissions of a new file, or of the file that it replaces.
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            if place.exists():
                temporary.chmod(stat.S_IMODE(place.stat().st_mode))
            yield temporary
        if waiting is None:
            _give_names([(temporary, place, path)])
        else:
            waiting.append((temporary, place, path))
    except BaseException:
        _remove(temporary)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file through `written`. Characters that are not Unicode, as in file names, become "?"."""
    with written(path) as file:
        file.write_text(text, encoding="utf-8", errors="replace")


@contextmanager
def replace_together() -> Iterator[None]:
    """Give all files written in the block their final names at its end, if all are complete; otherwise remove them."""
    waiting: list[tuple[Path, Path, Path]] = []
    outer = _WAITING.set(waiting)
    try:
        yield
        _give_names(waiting)
    finally:
        _WAITING.reset(outer)
        for temporary, _, _ in waiting:
            _remove(temporary)


def _give_names(waiting: list[tuple[Path, Path, Path]]) -> None:
    """Rename temporary files to their final paths, and remove them from the list.

    Each entry has the temporary path, the final path, and the path that the caller requested.
    """
    while waiting:
        temporary, place, path = waiting[0]
        with _invalid_if_unwritable(path):
            os.replace(temporary, place)  # noqa: PTH105  (as everywhere, and easier to replace in tests)
        _TEMPORARY.discard(temporary)
        del waiting[0]


@contextmanager
def _invalid_if_unwritable(path: Path) -> Iterator[None]:
    """Convert errors of the operating system in the block to InvalidProblem; a closed pipe stays a BrokenPipeError."""
    try:
        yield
    except BrokenPipeError:
        raise  # the reader closed the pipe, which is not an error
    except OSError as error:
        raise unwritable(path, error) from None


def _remove(temporary: Path) -> None:
    """Remove a temporary file, and its entry in the set of temporary files."""
    temporary.unlink(missing_ok=True)
    _TEMPORARY.discard(temporary)


def remove_unnamed() -> None:
    """Remove all temporary files, because the process is about to end."""
    for temporary in tuple(_TEMPORARY):
        _remove(temporary)


class GrowingFile:
    """An output file that grows. It has a temporary name until it is complete, so an interrupted run stays readable.

    Parameters
    ----------
    path : Path
        The final path. Until the end the data are in a file with the same name plus ``.partial``.

    Raises
    ------
    InvalidProblem
        As for `claim`, and if an interrupted run has left a ``.partial`` file.
    """

    def __init__(self, path: Path) -> None:
        """Check the final path and the temporary path. No file is made before the first `append`."""
        self.path, self.partial = path, partial_of(path)
        claim(path, self.partial)
        self._begun = self._whole = False

    def append(self, data: bytes) -> None:
        """Append data immediately; raise InvalidProblem if this fails. The file then has none of the data."""
        mode = "ab" if self._begun else "wb" if _REPLACES.get() else "xb"
        self._begun, self._whole = True, False
        # One write without a buffer, so that an interrupted run leaves complete lines.
        with _invalid_if_unwritable(self.partial), self.partial.open(mode, buffering=0) as file:
            size = os.fstat(file.fileno()).st_size
            try:
                while data:
                    data = data[file.write(data) :]
            except OSError:
                file.truncate(size)  # a full disk accepts a part, which a second attempt would repeat
                raise
        self._whole = True

    def finish(self) -> None:
        """Give the file its final name, unless a write failed; raise InvalidProblem if renaming fails."""
        if self._whole:
            _give_names([(self.partial, _place(self.path), self.path)])

    def discard(self) -> None:
        """Remove the file, because its content is stored elsewhere."""
        self.partial.unlink(missing_ok=True)


def partial_of(path: Path) -> Path:
    """Return the temporary path of a growing file: the path, with links resolved, plus ``.partial``."""
    place = Path(os.path.realpath(path))
    return place.with_name(f"{place.name}.partial")

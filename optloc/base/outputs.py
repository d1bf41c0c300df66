"""Every file that optloc writes: refused where it would hurt, made beside its place, given its name when it is whole.

A file that exists is replaced by library calls, as `numpy.save` does; the command line asks for ``--force``. What is
written never lies half done under its name: a full disk or Ctrl-C leaves what was there before.
"""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from unicodedata import category

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import files_read

_REPLACES: ContextVar[bool] = ContextVar("_REPLACES", default=True)
# Temporary file, place and the name it was asked by, of files that wait for others that belong to them.
_WAITING: ContextVar[list[tuple[Path, Path, Path]] | None] = ContextVar("_WAITING", default=None)
# Temporary files of this process that have no name yet: whoever ends it at once removes them first.
_UNNAMED: set[Path] = set()
# Other names of what is open already: what stands behind them may be a file, which is not to be replaced.
_OPEN = ("/dev/stdout", "/dev/stderr", "/dev/fd/", "/proc/")


def visible(text: str) -> str:
    """Return text in which everything but line ends is seen: what would steer a terminal, or hide, is spelled."""
    if text.isprintable():  # most texts, in a hundredth of the time
        return text
    return "".join(c if c == "\n" or category(c)[0] != "C" else c.encode("unicode_escape").decode() for c in text)


def replace_files(wanted: bool) -> bool:
    """Say whether files that exist may be replaced, from here on in this context; return the same."""
    _REPLACES.set(wanted)
    return wanted


def unwritable(path: Path, error: OSError) -> InvalidProblem:
    """Return what is said of a file that cannot be written."""
    return InvalidProblem(f"the file cannot be written ({error.strerror or error})", str(path), "choose another place")


def make_folder(path: Path) -> None:
    """Make a folder and those above it; raise InvalidProblem where the system refuses."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"the folder cannot be made ({error.strerror or error})"
        raise InvalidProblem(what, str(path), "choose another place") from None


def is_stream(path: Path) -> bool:
    """Return whether a name is that of a pipe, a terminal or the like, which is written to and has no ending."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode) or os.path.abspath(path).startswith(_OPEN)  # noqa: PTH100


def claim(*paths: Path | None, inputs: Iterable[Path] = ()) -> None:
    """Refuse places that cannot or must not be written, before there is work to lose.

    Parameters
    ----------
    *paths : Path, optional
        The files that one command is to write; None and "-", standard output, are passed over.
    inputs : iterable of Path
        Files that it reads, beside those that were read already.

    Raises
    ------
    InvalidProblem
        Where a file exists and may not be replaced, is an input, is named twice (also by another spelling), is a
        folder, or has no folder.
    """
    read, seen = tuple(inputs), set[str]()
    for path in paths:
        if path is None or str(path) == "-" or is_stream(path):
            continue
        # Names that differ in case are one file on some systems: a command that works is to work on all.
        name = str(_place(path, read)).casefold()
        if name in seen:
            raise InvalidProblem("two outputs have this name", str(path), "give each a name of its own")
        seen.add(name)


def _place(path: Path, inputs: Iterable[Path] = ()) -> Path:
    """Return where a file is to be written: a link is followed, and stays; raise InvalidProblem where it must not."""
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
    """Raise InvalidProblem where a file that exists must not be replaced."""
    if not place.is_file():
        raise InvalidProblem("it is no file that can be replaced", str(path), "choose another name")
    for one in (*inputs, *files_read()):
        if one.exists() and place.samefile(one):
            raise InvalidProblem("it would replace a file that is read here", str(path), "choose another name")
    if not _REPLACES.get():
        raise InvalidProblem("there is such a file already", str(path), "choose another name, or add --force")


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yield where a file is to be written; it gets its name when the block ends, and is removed where that fails.

    Parameters
    ----------
    path : Path
        The file. What stands there, or where a link leads that does, is replaced; a pipe or a device is written to.

    Yields
    ------
    Path
        An empty file in the same folder with the same ending, or the stream itself.

    Raises
    ------
    InvalidProblem
        As `claim` does, and where the system refuses: a full disk, for instance.
    """
    if is_stream(path):
        with _sentence(path):
            yield path
        return
    place = _place(path)
    temporary = place.with_name(f".optloc-{secrets.token_hex(8)}{path.suffix}")
    waiting = _WAITING.get()
    _UNNAMED.add(temporary)
    try:
        with _sentence(path):
            # The rights that a new file has, or those of the old one.
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
    """Write a text file in UTF-8, as `written` does; what is no Unicode, of a file's name, becomes a question mark."""
    with written(path) as file:
        file.write_text(text, encoding="utf-8", errors="replace")


@contextmanager
def replace_together() -> Iterator[None]:
    """Give the files that are written in the block their names at its end, when all are whole; none where one fails."""
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
    """Move files to their places; those that are moved leave the list."""
    while waiting:
        temporary, place, path = waiting[0]
        with _sentence(path):
            os.replace(temporary, place)  # noqa: PTH105  (as everywhere, and easier to replace in tests)
        _UNNAMED.discard(temporary)
        del waiting[0]


@contextmanager
def _sentence(path: Path) -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise  # the reader of a pipe has gone, which is no error
    except OSError as error:
        raise unwritable(path, error) from None


def _remove(temporary: Path) -> None:
    temporary.unlink(missing_ok=True)
    _UNNAMED.discard(temporary)


def remove_unnamed() -> None:
    """Remove the files that have no name yet: the process ends at once."""
    for temporary in tuple(_UNNAMED):
        _remove(temporary)


class GrowingFile:
    """A file that grows beside its place and gets its name at the end: what a killed run had stays readable.

    Parameters
    ----------
    path : Path
        The file; what it has so far stands in one of this name with ``.partial`` behind it.

    Raises
    ------
    InvalidProblem
        As `claim` does; also where a stopped run has left such a file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.partial = path, partial_of(path)
        claim(path, self.partial)
        self._begun = self._whole = False

    def append(self, data: bytes) -> None:
        """Write behind what is there, at once; raise InvalidProblem where that fails."""
        how = "ab" if self._begun else "wb" if _REPLACES.get() else "xb"
        self._begun, self._whole = True, False
        # one write without a buffer: whenever the run is killed, whole lines are there
        with _sentence(self.partial), self.partial.open(how, buffering=0) as file:
            while data:
                data = data[file.write(data) :]
        self._whole = True

    def finish(self) -> None:
        """Give the file its name, unless something could not be written; raise InvalidProblem where that fails."""
        if self._whole:
            _give_names([(self.partial, _place(self.path), self.path)])

    def discard(self) -> None:
        """Remove the file: what it holds stands elsewhere."""
        self.partial.unlink(missing_ok=True)


def partial_of(path: Path) -> Path:
    """Return the name under which a file grows: that of the file, or of what a link leads to, and ``.partial``."""
    place = Path(os.path.realpath(path))
    return place.with_name(f"{place.name}.partial")

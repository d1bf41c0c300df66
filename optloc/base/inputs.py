"""Reading of input files: only regular files, within size limits, and only below the folder of the naming file.

Files can come from untrusted sources, so this module opens all of them. A device, a pipe, an oversized file or a path
to another folder raises an error with one sentence. The module also records the files that a run has read, so that
outputs do not overwrite them.
"""

from __future__ import annotations

import io
import json
import os
import re
import stat
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, replace
from itertools import islice
from math import inf
from pathlib import Path
from typing import Any

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.units import LARGEST

__all__ = [
    "Access",
    "Budget",
    "access",
    "budget_of",
    "check_budget",
    "files_read",
    "has_controls",
    "json_of",
    "read_bytes",
    "read_text",
    "within",
]

STANDARD_INPUT = Path("-")
"""Name of standard input in commands that accept it instead of a file."""

# Bytes per read: large enough that system calls cost little, small enough that an oversized file is detected early.
_PIECE = 1 << 22
# Characters of a refused word that a message repeats.
_WORD = 40
# Maximum number of file names in a folder that are compared with the name of a missing file.
_NAMES = 10_000


@dataclass(frozen=True, slots=True)
class Budget:
    """Size limits of an input file, so that reading it takes at most seconds and a few gigabytes.

    Parameters
    ----------
    bytes : int
        Size of a table (CSV, Parquet; stored size and declared unpacked size) or of a file of a data set.
    text : int
        Bytes of a document (TOML, JSON, GeoJSON). It is parsed as a whole, at about 1 MB per second.
    rows, columns, cells : int
        Size of a table.
    nesting : int
        Depth of nested tables and lists in a document.
    unknowns : int
        Number of unknowns that all epochs of a problem file share: positions of targets, biases, offsets of stations.
    """

    bytes: int = 1 << 28
    text: int = 1 << 22
    rows: int = 4_000_000
    columns: int = 1000
    cells: int = 40_000_000
    nesting: int = 32
    unknowns: int = 300


@dataclass(frozen=True, slots=True)
class Access:
    """Permissions for reading files, and a record of the files that were read.

    Parameters
    ----------
    budget : Budget
        Size limits.
    outside : bool
        Whether a file may name files outside its own folder.
    read : set of Path
        Resolved paths of the files that were read.
    """

    budget: Budget = field(default_factory=Budget)
    outside: bool = False
    read: set[Path] = field(default_factory=set, compare=False)


# Permissions of the current thread or task. A context variable avoids passing them through many functions.
_ACCESS: ContextVar[Access | None] = ContextVar("access", default=None)


def _current_access() -> Access:
    """Return the permissions of the open `access` block, or the defaults outside a block."""
    return _ACCESS.get() or Access()


@contextmanager
def access(*, outside: bool | None = None, budget: Budget | None = None, anew: bool = False) -> Iterator[Access]:
    """Change the permissions for reading files within a `with` block.

    Parameters
    ----------
    outside : bool, optional
        Whether files may name files outside their own folders. None: unchanged.
    budget : Budget, optional
        Size limits. None: unchanged.
    anew : bool
        Whether to start with an empty record of read files, and with the defaults for arguments that are None.
    """
    old = Access() if anew else _current_access()
    new = replace(
        old, outside=old.outside if outside is None else outside, budget=old.budget if budget is None else budget
    )
    token = _ACCESS.set(new)
    try:
        yield new
    finally:
        _ACCESS.reset(token)


def relax_budget(*, outside: bool | None = None, budget: Budget | None = None) -> None:
    """Change the permissions for the rest of the open `access` block; None leaves a permission unchanged.

    A command line sets the permissions option by option.
    """
    old = _current_access()
    more = {key: value for key, value in (("outside", outside), ("budget", budget)) if value is not None}
    _ACCESS.set(replace(old, **more))  # type: ignore[arg-type]  # each has the type of its field


def files_read() -> frozenset[Path]:
    """Return the resolved paths of all files that were read in the open `access` block; empty outside a block."""
    current = _ACCESS.get()
    return frozenset() if current is None else frozenset(current.read)


def budget_of(text: str, where: str) -> Budget:
    """Return the budget that a text such as ``rows=2e7,bytes=4e9`` describes. Other limits have their defaults.

    Parameters
    ----------
    text : str
        Names of limits with whole numbers.
    where : str
        Location that error messages name.
    """
    known = [entry.name for entry in fields(Budget)]
    limits = {}
    for part in text.split(","):
        name, _, number = (word.strip() for word in part.partition("="))
        if name not in known:
            raise InvalidProblem(f"there is no budget {name!r}", where, nearest(name, known))
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        # Each limit is at least one. No file system can store more than 2^63 bytes.
        if not 1.0 <= value < 2.0**63:
            raise InvalidProblem(f"{number!r} is not a number of {name}", where, f"write {name}=1e8")
        limits[name] = int(value)
    return Budget(**limits)


def check_budget(what: str, count: int, where: str) -> None:
    """Raise InvalidProblem if a count is above the limit with this name: "rows", "columns", "cells" ...

    `what` is the name of a limit of the current `Budget`. `where` is the location that the message names.
    """
    limit = getattr(_current_access().budget, what)
    if count > limit:
        raise _too_large(what, f"{count}", limit, where)


def _too_large(what: str, count: str, limit: int, where: str) -> InvalidProblem:
    """Return the error for a file that exceeds a limit.

    `what` is the name of the limit in `Budget`. `count` is the number found, or "more" if reading stopped at the limit.
    """
    name = {"text": "bytes of text", "nesting": "levels of nesting"}.get(what, what)
    option = f"--budget {what}=NUMBER, in Python with budget=optloc.files.Budget({what}=NUMBER)"
    advice = f"make it smaller, or raise the limit with {option}"
    message = (
        f"there are {count} {name} than {limit}" if count == "more" else f"there are {count} {name}, {limit} at most"
    )
    return InvalidProblem(message, where, advice)


def within(folder: Path, name: str, where: str) -> Path:
    """Return the path of a file that another file names.

    Parameters
    ----------
    folder : Path
        Folder of the other file.
    name : str
        Path relative to this folder, as written in the other file.
    where : str
        Location that error messages name.

    Raises
    ------
    InvalidProblem
        If the path, with links resolved, is outside the folder, and this is not allowed.
    """
    path = folder / name
    try:
        inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    except ValueError:  # a name with a zero character is not valid
        raise InvalidProblem(f"{name!r} is not a file name", where, "correct it") from None
    if not (inside or _current_access().outside):
        advice = "move it there, or allow it with --outside, in Python with outside=True"
        raise InvalidProblem(f"{name!r} is outside the folder of the file that names it", where, advice)
    return path


def read_bytes(path: Path, what: str = "bytes", *, lines: bool = False) -> bytes:
    """Return the content of a file.

    Parameters
    ----------
    path : Path
        A regular file, or a link to one.
    what : "bytes" or "text"
        Name of the size limit.
    lines : bool
        Whether lines count as rows, which have their own limit.

    Raises
    ------
    InvalidProblem
        If it is missing, a folder, a device or a pipe, if it is not readable, or if it exceeds a limit.
    """
    with os.fdopen(_open(path), "rb", buffering=0) as file:
        return _all_of(file.read, what, str(path), lines=lines)


def _all_of(read: Callable[[int], bytes], what: str, where: str, *, lines: bool = False) -> bytes:
    """Return all available bytes of a stream; raise InvalidProblem as soon as they exceed a limit.

    ``read(n)`` returns at most n bytes, and none at the end. `what` is the limit, "bytes" or "text". With `lines`, the
    number of lines is limited too. `where` is the location that messages name.
    """
    budget = _current_access().budget
    limit = getattr(budget, what)
    buffer, size, rows = io.BytesIO(), 0, 0
    while piece := read(_PIECE):
        buffer.write(piece)
        size += len(piece)
        rows += piece.count(b"\n") if lines else 0
        if size > limit:
            raise _too_large(what, "more", limit, where)
        # The first line is the header.
        if rows > budget.rows + 1:
            raise _too_large("rows", "more", budget.rows, where)
    return buffer.getvalue()


def _open(path: Path) -> int:
    """Return a file descriptor of a regular file and record its path; raise InvalidProblem for anything else."""
    try:
        # Only opening the file is a reliable test. O_NONBLOCK: opening a pipe without a writer would wait without end.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (FileNotFoundError, NotADirectoryError):
        raise InvalidProblem("there is no such file", str(path), _similar_file(path)) from None
    except OSError as error:
        if os.path.isdir(path):  # noqa: PTH112  # does not raise for a name that is too long
            raise InvalidProblem("this is a folder, not a file", str(path), "name a file in it") from None
        what = f"the file cannot be opened ({error.strerror})"
        raise InvalidProblem(what, str(path), "check its permissions and links") from None
    except ValueError:
        raise InvalidProblem("this is not a file name", repr(str(path)), "correct it") from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        if stat.S_ISDIR(mode):
            raise InvalidProblem("this is a folder, not a file", str(path), "name a file in it")
        what = "this is a pipe, a device or a socket, not a regular file"
        raise InvalidProblem(what, str(path), "write its contents to a file")
    _current_access().read.add(Path(os.path.realpath(path)))
    return descriptor


def _similar_file(path: Path) -> str:
    """Return advice for a file that does not exist: a similar name in the same folder."""
    try:
        names = sorted(entry.name for entry in islice(path.parent.iterdir(), _NAMES))
    except OSError:
        names = []
    near = nearest(path.name, names)
    return (
        near.partition("?")[0] + "?" if "?" in near else "check the name; it is relative to the file that contains it"
    )


# Documents.


def read_text(path: Path) -> str:
    """Return the text of a document, or of standard input for "-"; raise InvalidProblem if it is unreadable."""
    if path == STANDARD_INPUT:
        return decoded(_all_of(sys.stdin.buffer.read, "text", "standard input"), "standard input")
    return decoded(read_bytes(path, "text"), path.name)


def decoded(data: bytes, source: str) -> str:
    """Return bytes as text; raise InvalidProblem with the line number if they are not UTF-8.

    `source` is the name of the file in messages.
    """
    try:
        # Editors on Windows write a byte order mark at the start of files.
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InvalidProblem("the text is not UTF-8", f"{source}, line {line}", "save it as UTF-8") from None


# Characters that separate a dotted key from other text, and the maximum number of its parts. The time of the TOML
# parser grows with the square of the number of parts: 0.7 ms for 300, hours for a million. No table is nested so
# deeply. For keys with fewer parts, the limit on nesting applies after parsing.
_KEYS, _PARTS = re.compile(r"[=,{}\[\]\n]"), 300


def toml_of(text: str, source: str) -> dict[str, Any]:
    """Return the content of a TOML text; raise InvalidProblem with the line number if the text is not valid TOML.

    Parameters
    ----------
    text : str
        The document.
    source : str
        Location that error messages name.
    """
    if max(key.count(".") for key in _KEYS.split(text)) > _PARTS:
        raise _too_large("nesting", "more", _current_access().budget.nesting, source)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        # tomllib gives the position in its message only.
        what, _, place = str(error).partition(" (at ")
        line = place.rstrip(")").partition(",")[0] if place else None
        where = ", ".join(part for part in (source, line) if part)
        raise InvalidProblem(f"this is not TOML: {what[0].lower()}{what[1:]}", where, "see toml.io") from None
    except (ValueError, RecursionError) as error:
        raise _invalid_document(error, "TOML", source) from None
    _check_data(data, source)
    return data


def json_of(text: str, source: str, parse_float: Callable[[str], Any] | None = None) -> Any:
    """Return the content of a JSON text; raise InvalidProblem with the line number if the text is not valid JSON.

    The arguments are as for `toml_of`. `parse_float` converts numbers with a decimal point, for instance to a type
    that keeps all digits.
    """
    try:
        data = json.loads(text, parse_float=parse_float)
    except json.JSONDecodeError as error:
        what = f"this is not JSON: {error.msg.lower()}"
        raise InvalidProblem(what, f"{source}, line {error.lineno}", "write it again") from None
    except (ValueError, RecursionError) as error:
        raise _invalid_document(error, "JSON", source) from None
    _check_data(data, source)
    return data


def _invalid_document(error: Exception, language: str, source: str) -> InvalidProblem:
    """Return the error for a document that its parser refuses: nesting too deep, or a number with too many digits.

    `error` is the exception of the parser, `language` is "TOML" or "JSON", and `source` is the location for the
    message.
    """
    if isinstance(error, RecursionError):
        return _too_large("nesting", "more", _current_access().budget.nesting, source)
    # The other cause is a whole number with more than 4300 digits, which Python refuses.
    what = f"this {language} contains a number with too many digits"
    return InvalidProblem(what, source, "write numbers with at most 17 digits")


# Characters that move the cursor of a terminal, end lines or reverse the writing direction, and surrogates, which no
# file can contain. Line breaks and tabs are allowed.
_CONTROLS = re.compile(
    "[\\x00-\\x08\\x0b\\x0c\\x0e-\\x1f\\x7f-\\x9f\\u2028\\u2029\\u202a-\\u202e\\u2066-\\u2069\\ud800-\\udfff]"
)


def has_controls(text: str) -> bool:
    """Return whether a text contains control characters. Names must not, because they are printed on terminals."""
    return _CONTROLS.search(text) is not None


def _check_data(data: Any, source: str) -> None:
    """Raise if data are nested too deeply, contain control characters, or contain numbers that are too large.

    `data` is the content of a document. `source` is the location that messages name.
    """
    # `level` are all values at one depth of nesting. The loop goes from level to level, so that it can count the depth.
    level, depth = [data], 0
    while level:
        check_budget("nesting", depth, source)
        inner: list[Any] = []
        for outer in level:
            if isinstance(outer, dict):
                inner += [*outer, *outer.values()]
            elif isinstance(outer, list):
                inner += outer
            elif isinstance(outer, str) and has_controls(outer):
                raise InvalidProblem(f"{outer[:_WORD]!r} contains control characters", source, "remove them")
            elif isinstance(outer, int | float) and LARGEST < abs(outer) < inf:
                given = f"{outer:.10g}" if isinstance(outer, float) else f"{str(outer)[:_WORD]}..."
                raise InvalidProblem(f"the number {given} is beyond {LARGEST:g}", source, "use another unit")
        level, depth = inner, depth + 1

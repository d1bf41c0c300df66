"""What is read from outside: regular files within a budget, and nothing beyond the folder of the file that names them.

Files come from other people. Every one is opened here, so that a device, a pipe, a bomb or a path to somewhere else
is one sentence, and so that what a run has read is known when it writes.
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
"""Name of standard input where a command takes it in the place of a file."""

# Read at a time: large enough that system calls do not count, small enough that a file that is too long is noticed.
_PIECE = 1 << 22
# What is repeated of a word that is refused.
_WORD = 40
# Names in a folder that are looked through for one like that of a missing file.
_NAMES = 10_000


@dataclass(frozen=True, slots=True)
class Budget:
    """How much a file may hold, so that reading it takes seconds and a few gigabytes at most.

    Parameters
    ----------
    bytes : int
        Of a table (CSV, Parquet: as it is stored, and as it declares itself unpacked) or a file of a data set.
    text : int
        Bytes of a document (TOML, JSON, GeoJSON), which is parsed as a whole, some 1 MB a second.
    rows, columns, cells : int
        Of a table.
    nesting : int
        Tables and lists within each other in a document.
    unknowns : int
        That all epochs of a problem file share: places of targets, biases, offsets of stations.
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
    """What may be read.

    Parameters
    ----------
    budget : Budget
        How much.
    outside : bool
        Whether a file may name files that are not beneath its own folder.
    read : set of Path
        Resolved paths of what was read.
    """

    budget: Budget = field(default_factory=Budget)
    outside: bool = False
    read: set[Path] = field(default_factory=set, compare=False)


# Of a thread, or of a task: whoever reads for somebody else says so here, and nobody passes it through ten functions.
_ACCESS: ContextVar[Access | None] = ContextVar("access", default=None)


def _now() -> Access:
    return _ACCESS.get() or Access()


@contextmanager
def access(*, outside: bool | None = None, budget: Budget | None = None, anew: bool = False) -> Iterator[Access]:
    """Let what is read meanwhile be more, or less, than by default.

    Parameters
    ----------
    outside : bool, optional
        Whether files may name files that are not beneath their own folders; None: as before.
    budget : Budget, optional
        How much they may hold; None: as before.
    anew : bool
        Whether the list of what was read, and all that is None, begins anew.
    """
    old = Access() if anew else _now()
    new = replace(
        old, outside=old.outside if outside is None else outside, budget=old.budget if budget is None else budget
    )
    token = _ACCESS.set(new)
    try:
        yield new
    finally:
        _ACCESS.reset(token)


def relax_budget(*, outside: bool | None = None, budget: Budget | None = None) -> None:
    """Do as `access` for the rest of the one that is open; a command line learns of its options one by one."""
    old = _now()
    more = {key: value for key, value in (("outside", outside), ("budget", budget)) if value is not None}
    _ACCESS.set(replace(old, **more))  # type: ignore[arg-type]  # each has the type of its field


def files_read() -> frozenset[Path]:
    """Return the resolved paths of all files that were read in the access that is open; none outside of one."""
    found = _ACCESS.get()
    return frozenset() if found is None else frozenset(found.read)


def budget_of(text: str, where: str) -> Budget:
    """Return a budget in words, such as ``rows=2e7,bytes=4e9``; what is not named is as by default.

    Parameters
    ----------
    text : str
        Names and whole numbers.
    where : str
        Place to name.
    """
    known = [entry.name for entry in fields(Budget)]
    found = {}
    for part in text.split(","):
        name, _, number = (word.strip() for word in part.partition("="))
        if name not in known:
            raise InvalidProblem(f"there is no budget {name!r}", where, nearest(name, known))
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        # no file system has more bytes than 2^63, and nothing can be limited to less than one
        if not 1.0 <= value < 2.0**63:
            raise InvalidProblem(f"{number!r} is no number of {name}", where, f"write {name}=1e8")
        found[name] = int(value)
    return Budget(**found)


def check_budget(what: str, count: int, where: str) -> None:
    """Raise InvalidProblem where a count is above the budget of its name: "rows", "columns", "cells" ..."""
    limit = getattr(_now().budget, what)
    if count > limit:
        raise _beyond(what, f"{count}", limit, where)


def _beyond(what: str, count: str, limit: int, where: str) -> InvalidProblem:
    name = {"text": "bytes of text", "nesting": "levels of nesting"}.get(what, what)
    by = f"--budget {what}=NUMBER, in Python with budget=optloc.files.Budget({what}=NUMBER)"
    advice = f"make it smaller, or allow more with {by}"
    found = (
        f"there are {count} {name} than {limit}" if count == "more" else f"there are {count} {name}, {limit} at most"
    )
    return InvalidProblem(found, where, advice)


def within(folder: Path, name: str, where: str) -> Path:
    """Return the path of a file that another file names.

    Parameters
    ----------
    folder : Path
        Folder of the file that names it.
    name : str
        Its path relative to that folder, as written.
    where : str
        Place of the name.

    Raises
    ------
    InvalidProblem
        Where it is not beneath the folder, links followed, and that is not allowed.
    """
    path = folder / name
    try:
        inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    except ValueError:  # a name with a zero in it is none
        raise InvalidProblem(f"{name!r} is no name of a file", where, "correct it") from None
    if not (inside or _now().outside):
        advice = "move it there, or allow it with --outside, in Python with outside=True"
        raise InvalidProblem(f"{name!r} is outside the folder of the file that names it", where, advice)
    return path


def read_bytes(path: Path, what: str = "bytes", *, lines: bool = False) -> bytes:
    """Return what a file holds.

    Parameters
    ----------
    path : Path
        A regular file, or a link to one.
    what : "bytes" or "text"
        The budget that it has.
    lines : bool
        Whether its lines are rows, and have their budget too.

    Raises
    ------
    InvalidProblem
        Where it is missing, a folder, a device or a pipe, must not be read or holds more than its budget.
    """
    with os.fdopen(_open(path), "rb", buffering=0) as file:
        return _all_of(file.read, what, str(path), lines=lines)


def _all_of(read: Callable[[int], bytes], what: str, where: str, *, lines: bool = False) -> bytes:
    """Return all that can be read, or raise InvalidProblem as soon as it is more than the budget."""
    budget = _now().budget
    limit = getattr(budget, what)
    held, size, rows = io.BytesIO(), 0, 0
    while piece := read(_PIECE):
        held.write(piece)
        size += len(piece)
        rows += piece.count(b"\n") if lines else 0
        if size > limit:
            raise _beyond(what, "more", limit, where)
        # one line is the header
        if rows > budget.rows + 1:
            raise _beyond("rows", "more", budget.rows, where)
    return held.getvalue()


def _open(path: Path) -> int:
    """Return a descriptor of a regular file; raise InvalidProblem for all else."""
    try:
        # Opening is the only sure test. Without waiting: a pipe that nobody writes to would hold it for ever.
        found = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (FileNotFoundError, NotADirectoryError):
        raise InvalidProblem("there is no such file", str(path), _like(path)) from None
    except OSError as error:
        if os.path.isdir(path):  # noqa: PTH112  # it does not raise for a name that is too long
            raise InvalidProblem("this is a folder, not a file", str(path), "name a file in it") from None
        what = f"the file cannot be opened ({error.strerror})"
        raise InvalidProblem(what, str(path), "check its permissions and links") from None
    except ValueError:
        raise InvalidProblem("this is no name of a file", repr(str(path)), "correct it") from None
    mode = os.fstat(found).st_mode
    if not stat.S_ISREG(mode):
        os.close(found)
        if stat.S_ISDIR(mode):
            raise InvalidProblem("this is a folder, not a file", str(path), "name a file in it")
        what = "this is a pipe, a device or a socket, not a regular file"
        raise InvalidProblem(what, str(path), "write its contents to a file")
    _now().read.add(Path(os.path.realpath(path)))
    return found


def _like(path: Path) -> str:
    """Return advice for a name that is not there."""
    try:
        names = sorted(found.name for found in islice(path.parent.iterdir(), _NAMES))
    except OSError:
        names = []
    near = nearest(path.name, names)
    return near.partition("?")[0] + "?" if "?" in near else "check the name; it is taken relative to the file it is in"


# Documents.


def read_text(path: Path) -> str:
    """Return the text of a document, of standard input where the path is "-"; raise InvalidProblem where it is none."""
    if path == STANDARD_INPUT:
        return decoded(_all_of(sys.stdin.buffer.read, "text", "standard input"), "standard input")
    return decoded(read_bytes(path, "text"), path.name)


def decoded(data: bytes, source: str) -> str:
    """Return bytes as text; raise InvalidProblem where they are not UTF-8, naming the line."""
    try:
        # Editors of Windows begin files with a byte order mark.
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InvalidProblem("the text is not UTF-8", f"{source}, line {line}", "save it as UTF-8") from None


# What a dotted key is cut from its neighbours by. The parser takes the square of a key's parts as long: 0.7 ms for 300,
# hours for a million. No table is nested so deep; that of fewer is told when it is read.
_KEYS, _PARTS = re.compile(r"[=,{}\[\]\n]"), 300


def toml_of(text: str, source: str) -> dict[str, Any]:
    """Return TOML as data; raise InvalidProblem where it is none, naming the line.

    Parameters
    ----------
    text : str
        The document.
    source : str
        Place to name.
    """
    if max(key.count(".") for key in _KEYS.split(text)) > _PARTS:
        raise _beyond("nesting", "more", _now().budget.nesting, source)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        # tomllib has the place in its message only.
        what, _, place = str(error).partition(" (at ")
        line = place.rstrip(")").partition(",")[0] if place else None
        where = ", ".join(part for part in (source, line) if part)
        raise InvalidProblem(f"this is not TOML: {what[0].lower()}{what[1:]}", where, "see toml.io") from None
    except (ValueError, RecursionError) as error:
        raise _refused(error, "TOML", source) from None
    _check_data(data, source)
    return data


def json_of(text: str, source: str, parse_float: Callable[[str], Any] | None = None) -> Any:
    """Return JSON as data; raise InvalidProblem where it is none, naming the line; arguments as `toml_of`.

    `parse_float` makes something else of a number with a decimal point, such as one that keeps all its digits.
    """
    try:
        data = json.loads(text, parse_float=parse_float)
    except json.JSONDecodeError as error:
        what = f"this is not JSON: {error.msg.lower()}"
        raise InvalidProblem(what, f"{source}, line {error.lineno}", "write it again") from None
    except (ValueError, RecursionError) as error:
        raise _refused(error, "JSON", source) from None
    _check_data(data, source)
    return data


def _refused(error: Exception, language: str, source: str) -> InvalidProblem:
    if isinstance(error, RecursionError):
        return _beyond("nesting", "more", _now().budget.nesting, source)
    # What is left is a whole number that Python does not read: of more than 4300 digits.
    what = f"this {language} holds a number of more digits than can be read"
    return InvalidProblem(what, source, "write numbers with 17 digits at most")


# Characters that move a terminal's cursor, end its lines or turn its writing round, and halves of characters, which no
# file can hold; breaks and tabs are text.
_CONTROLS = re.compile(
    "[\\x00-\\x08\\x0b\\x0c\\x0e-\\x1f\\x7f-\\x9f\\u2028\\u2029\\u202a-\\u202e\\u2066-\\u2069\\ud800-\\udfff]"
)


def has_controls(text: str) -> bool:
    """Return whether a text holds characters that are no writing: names are printed on terminals."""
    return _CONTROLS.search(text) is not None


def _check_data(data: Any, source: str) -> None:
    """Refuse data that are nested too deep, whose words hold control characters or whose numbers are too large."""
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
                raise InvalidProblem(f"{outer[:_WORD]!r} holds control characters", source, "leave them out")
            elif isinstance(outer, int | float) and LARGEST < abs(outer) < inf:
                given = f"{outer:.10g}" if isinstance(outer, float) else f"{str(outer)[:_WORD]}..."
                raise InvalidProblem(f"the number {given} is beyond {LARGEST:g}", source, "use another unit")
        level, depth = inner, depth + 1

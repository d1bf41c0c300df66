"""Machine code on disk: each kernel is stored under the digest of its call graph (`optloc.kernels.digests`).

numba recompiles a stored function if the file of this function changes. But machine code contains all functions that it
calls, from any file: after an edit or an upgrade of one of them, numba would run stale code. So numba's file stamp is
not used. The name of the folder of machine code depends on the versions of the compilers and on the processor. The
folder of an installed distribution (`optloc.kernels.manifest`) is read first.

A *callee* is a kernel that only other kernels call. Callees are stored too if this saves time: in a checkout, and while
`optloc compile` compiles everything.
"""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryFile
from types import SimpleNamespace
from typing import IO, Any

from optloc.kernels.compilation import callee_library
from optloc.kernels.digests import Compilable, digest_of
from optloc.kernels.manifest import PACKAGE, PREFIX, installed, of_this_process

# Number of folders for other compilers that are not deleted (the most recent ones), and of stored versions of one
# function. So branches of a checkout, and releases that share a folder by NUMBA_CACHE_DIR, can alternate.
_LEFT = 4
CALLEES = "OPTLOC_CALLEES"
"""Environment variable with the folder for callees while `optloc compile` compiles everything in several processes."""
_LOG = logging.getLogger("optloc")


@cache
def folder() -> Path | None:
    """Return the folder in which machine code is stored, or None if no folder is writable.

    The candidates are: the folder in NUMBA_CACHE_DIR, a folder in the package, and the user's cache folder.
    """
    from numba.core import config
    from numba.misc import appdirs

    settings: Any = config  # without types
    users: Any = appdirs
    for root in (settings.CACHE_DIR, PACKAGE / "__pycache__", users.user_cache_dir("optloc", appauthor=False)):
        if not root:
            continue
        place = Path(root) / of_this_process().name
        try:
            place.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=place).close()
            os.utime(place)  # mark the folder as used now
            _clear(place)
        except OSError:
            continue
        return place
    return None


def _clear(place: Path) -> None:
    """Remove the folders next to `place` for other compilers, except the most recent ones.

    A process that still uses a removed folder compiles again.
    """
    others = [path for path in place.parent.glob(f"{PREFIX}*") if path != place and path.is_dir()]
    for path in sorted(others, key=_last_use, reverse=True)[_LEFT:]:
        shutil.rmtree(path, ignore_errors=True)


def _last_use(path: Path) -> float:
    """Return the time at which a folder was last used, seconds; 0 if it no longer exists."""
    try:
        return path.stat().st_mtime
    except OSError:  # another process has removed it
        return 0.0


class _CacheLocator:
    """The location of the machine code of a function, with the interface of a cache locator of numba.

    `place` is the folder, `digest` the digest of the function's call graph.
    """

    def __init__(self, function: Callable[..., Any], place: Path, digest: str) -> None:
        self._py_file = str(Path(function.__code__.co_filename).resolve())
        self._path, self._digest = str(place), digest

    def ensure_cache_path(self) -> None:
        """Create the folder."""
        Path(self._path).mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """Return the folder."""
        return self._path

    def get_source_stamp(self) -> str:
        """Return an empty stamp of the source file, so that numba does not compare stamps."""
        return ""  # the name of the file contains the digest

    def get_disambiguator(self) -> str:
        """Return the part of the file name that distinguishes versions of the function."""
        return self._digest


@cache
def _entries() -> tuple[Any, Any]:
    """Return numba's cache types for functions that Python calls, and for functions that only kernels call."""
    from numba.core import caching

    numba: Any = caching  # half typed

    class Impl(numba.CompileResultCacheImpl):  # type: ignore[misc]
        def __init__(self, place: _CacheLocator, function: Callable[..., Any]) -> None:
            self._locator, self._lineno = place, function.__code__.co_firstlineno
            self._filename_base = file_prefix_of(name_of(function), place.get_disambiguator())

    class CachedCallee(Impl):
        def rebuild(self, target_context: Any, payload: Any) -> Any:
            """Return the compiled callee from stored code, read by the library for callees."""

            def read(stored: Any) -> Any:
                return callee_library().read(target_context.codegen(), stored)

            context = SimpleNamespace(
                codegen=lambda: SimpleNamespace(unserialize_library=read),
                get_executable=target_context.get_executable,
                typing_context=target_context.typing_context,
            )
            return super().rebuild(context, payload)._replace(target_context=target_context)

    return Impl, CachedCallee


def _fields(kind: Any) -> tuple[Any, ...]:
    """Return the names of the fields of a numba type, nested for the types inside it; () for a type that is no tuple.

    The names are part of the key of an entry. Otherwise machine code for an old order of fields would be read.
    """
    from numba.core import types

    numba: Any = types  # half typed
    if not isinstance(kind, numba.BaseTuple):
        return ()
    return getattr(kind, "fields", ()), tuple(_fields(inner) for inner in kind)


@cache
def _cache_type() -> Any:
    """Return a subclass of numba's function cache, with our folder and file names, that ignores damaged entries.

    The class is defined in a function, so that numba is imported only if it is needed.
    """
    from numba.core import caching

    numba: Any = caching  # half typed

    class CachedKernel(numba.FunctionCache):  # type: ignore[misc]
        def __init__(self, kernel: Compilable, place: Path, *, callee: bool) -> None:
            function = kernel.function
            self._impl_class = partial(_entries()[callee], _CacheLocator(function, place, digest_of(kernel)))
            super().__init__(function)
            self._name = name_of(function)
            self._installed = None if callee else installed()

        def _index_key(self, sig: Any, codegen: Any) -> Any:
            """Return the key of an entry, with the names of fields of named tuples."""
            # numba distinguishes named tuples by class and types of the fields, but not by the names of the fields.
            return *super()._index_key(sig, codegen), tuple(map(_fields, getattr(sig, "args", sig)))

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            """Return the stored machine code for a signature, or None."""
            try:
                found = self._from_installed(sig, target_context)
                return super().load_overload(sig, target_context) if found is None else found
            except Exception as error:  # noqa: BLE001  # a damaged pickle may raise anything
                _LOG.warning("cannot read the stored machine code of %s (%r); it is compiled again", self._name, error)
                return None

        def _from_installed(self, sig: Any, target_context: Any) -> Any:
            """Return the installed machine code for a signature, or None."""
            if self._installed is None:
                return None
            place, made = self._installed
            target_context.refresh()
            sig, _, *code = self._index_key(sig, target_context.codegen())
            file = numba.IndexDataCacheFile(str(place), self._impl.filename_base, "")
            data = file.load((sig, (made.triple, made.processor, made.features), *code))
            return None if data is None else self._impl.rebuild(target_context, data)

        def save_overload(self, sig: Any, data: Any) -> None:
            """Store machine code for a signature, and remove old versions of the function."""
            place, base = Path(self._cache_path), self._impl.filename_base
            try:
                try:
                    super().save_overload(sig, data)
                except OSError:
                    raise
                except Exception:  # noqa: BLE001  # the index is damaged, or its class no longer exists
                    (place / f"{base}.nbi").unlink()
                    super().save_overload(sig, data)
                _leave_last(place, self._name, base)
            except OSError as error:  # a full disk: the machine code is used in this process only
                _LOG.warning("cannot store the machine code of %s: %s", self._name, error)

    return CachedKernel


def code_cache_of(kernel: Compilable, *, callee: bool) -> Any:
    """Return a cache for the machine code of a kernel, for numba's dispatcher; None without a folder.

    `callee` is True for the form that other kernels call, False for the form that Python calls.
    """
    place = _callees() if callee else folder_in_use()
    return None if place is None else _cache_type()(kernel, place, callee=callee)


def folder_in_use() -> Path | None:
    """Return the folder in which machine code is stored; if none is writable, the installed folder."""
    return folder() or _installed_folder()


def _callees() -> Path | None:
    """Return the folder for callees, or None if no later compilation will use it."""
    named = os.environ.get(CALLEES)
    if named:
        return Path(named)
    place = folder()
    return place / "callees" if place is not None and is_checkout() else None


def is_checkout() -> bool:
    """Return whether this package is a checkout, whose kernels change."""
    return (PACKAGE.parent / "pyproject.toml").is_file()


def is_cached(kernel: Compilable) -> bool:
    """Return whether machine code of a kernel is on disk."""
    return bool(files_of(kernel, _installed_folder(), folder()))


def files_of(kernel: Compilable, *places: Path | None) -> list[Path]:
    """Return the files with the machine code of a kernel, from the first of the folders `places` that contains it.

    The list is empty if no folder contains it.
    """
    index = f"{file_prefix_of(name_of(kernel.function), digest_of(kernel))}.nbi"
    found = next((place for place in places if place is not None and (place / index).exists()), None)
    return [] if found is None else [found / index, *found.glob(index.replace(".nbi", ".*.nbc"))]


def name_of(function: Callable[..., Any]) -> str:
    """Return the qualified name of a function, with its module."""
    return f"{function.__module__}.{function.__qualname__}"


def file_prefix_of(name: str, digest: str) -> str:
    """Return the start of the file names of machine code, for a qualified name and a digest."""
    # Windows forbids the angle brackets that occur in names of inner functions.
    version = f"py{sys.version_info[0]}{sys.version_info[1]}{getattr(sys, 'abiflags', '')}"
    return f"{name.replace('<', '').replace('>', '')}-{digest}.{version}"


def _leave_last(place: Path, name: str, base: str) -> None:
    """Remove the files of old versions of the function `name`, except the newest `_LEFT` - 1.

    `base` is the file name of the present version, which stays.
    """
    others = [path for path in place.glob(f"{file_prefix_of(name, '*')}.nbi") if path.stem != base]
    for path in sorted(others, key=_last_use, reverse=True)[_LEFT - 1 :]:
        for file in (path, *place.glob(f"{path.stem}.*.nbc")):
            file.unlink(missing_ok=True)


def _installed_folder() -> Path | None:
    """Return the folder of installed machine code, or None."""
    found = installed()
    return None if found is None else found[0]


@cache
def start_background_compiler() -> None:
    """Start a background process that compiles all machine code, unless one is running; it may outlive this process.

    A failure to start it is only logged: the machine code is compiled later or never, and plain Python is used until
    then.
    """
    path = os.pathsep.join([str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    quiet = subprocess.DEVNULL
    try:
        subprocess.Popen(
            [sys.executable, "-P", "-m", "optloc.cli.compile"],
            stdin=quiet,
            stdout=quiet,
            stderr=quiet,
            env=os.environ | {"PYTHONPATH": path},
            start_new_session=True,
        )
        _LOG.warning("a background process compiles machine code (once, some minutes); until then plain Python is used")
    except OSError as error:
        _LOG.warning("cannot start the process that compiles machine code: %s", error)


def _lock_file(file: IO[bytes], *, wait: bool) -> bool:
    """Lock a file until it is closed, and return whether this succeeded.

    If `wait` is True, the function waits for the lock. The result is True if the system or file system has no locks.
    """
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        pass
    return True


def _unlock_file(file: IO[bytes]) -> None:
    """Unlock a file; nothing happens where the system or file system has no locks."""
    with suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(file, fcntl.LOCK_UN)


@contextmanager
def sole_compiler() -> Iterator[bool]:
    """Yield True and lock the compilation of all machine code, or yield False if another process has the lock."""
    place = folder()
    if place is None:
        yield False
        return
    with (place / "all.lock").open("ab") as file:
        yield _lock_file(file, wait=False)


@contextmanager
def locked(kernel: Compilable) -> Iterator[None]:
    """Lock the machine code of a kernel while it is compiled.

    Processes that wait for the lock load the result afterwards.
    """
    place = folder()
    if place is None or is_cached(kernel):
        yield
        return
    with ExitStack() as stack:
        try:
            file = stack.enter_context((place / f"{name_of(kernel.function)}.lock").open("ab"))
        except OSError:  # the folder was removed, so it is created again
            yield
            return
        _lock_file(file, wait=True)
        try:
            yield
        finally:
            # Closing is not enough: a process that was forked meanwhile shares the open file, and would keep the lock.
            _unlock_file(file)

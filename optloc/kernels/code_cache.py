"""Machine code on disk: each kernel is kept under the digest of its call graph (`optloc.kernels.digests`).

numba renews its files of a function when the file of that function changes. But machine code contains all functions
that it calls, in any file: after an edit or an upgrade of one of those, stale code would answer. So numba's own
stamp is not used. The folder of machine code is named by the versions of the compilers and by the processor. The
folder of an installed distribution (`optloc.kernels.manifest`) comes first.

Callees are kept too where they save time: in a checkout, and while `optloc compile` makes everything.
"""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryFile
from types import SimpleNamespace
from typing import IO, Any

from optloc.kernels.compilation import callee_library
from optloc.kernels.digests import Compilable, digest_of
from optloc.kernels.manifest import PACKAGE, PREFIX, installed, of_this_process

# Folders for other compilers that are left, the last used ones, and versions of one function: branches of a checkout
# and releases that share a folder by NUMBA_CACHE_DIR take turns.
_LEFT = 4
CALLEES = "OPTLOC_CALLEES"
"""The variable that names a folder for callees while `optloc compile` makes everything in several processes."""
_LOG = logging.getLogger("optloc")


@cache
def folder() -> Path | None:
    """Return the folder that machine code is kept in, None where nothing can be written.

    It lies in the folder that NUMBA_CACHE_DIR names, else beside the package, else in the user's folder of caches.
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
            os.utime(place)  # used now
            _clear(place)
        except OSError:
            continue
        return place
    return None


def _clear(place: Path) -> None:
    """Remove folders for other compilers but the last used; a process that still uses one makes its own anew."""
    others = [path for path in place.parent.glob(f"{PREFIX}*") if path != place and path.is_dir()]
    for path in sorted(others, key=_used, reverse=True)[_LEFT:]:
        shutil.rmtree(path, ignore_errors=True)


def _used(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # removed by another process meanwhile
        return 0.0


class _KeptPlace:
    """Where the machine code of a function is kept, as numba asks for it (a cache locator)."""

    def __init__(self, function: Callable[..., Any], place: Path, digest: str) -> None:
        self._py_file = str(Path(function.__code__.co_filename).resolve())
        self._path, self._digest = str(place), digest

    def ensure_cache_path(self) -> None:
        Path(self._path).mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return self._path

    def get_source_stamp(self) -> str:
        return ""  # the digest is in the name

    def get_disambiguator(self) -> str:
        return self._digest


@cache
def _entries() -> tuple[Any, Any]:
    """Return numba's types of a stored function: one that Python calls, and one that only kernels call."""
    from numba.core import caching

    numba: Any = caching  # half typed

    class Impl(numba.CompileResultCacheImpl):  # type: ignore[misc]
        def __init__(self, place: _KeptPlace, function: Callable[..., Any]) -> None:
            self._locator, self._lineno = place, function.__code__.co_firstlineno
            self._filename_base = file_prefix_of(name_of(function), place.get_disambiguator())

    class CachedCallee(Impl):
        def rebuild(self, target_context: Any, payload: Any) -> Any:
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
    """Return the fields of a type of numba, and of the types in it; () of one without."""
    from numba.core import types

    numba: Any = types  # half typed
    if not isinstance(kind, numba.BaseTuple):
        return ()
    return getattr(kind, "fields", ()), tuple(_fields(inner) for inner in kind)


@cache
def _cache_type() -> Any:
    """Return numba's cache of a function, told where it lies and by which name; damaged entries are as good as none."""
    from numba.core import caching

    numba: Any = caching  # half typed

    class CachedKernel(numba.FunctionCache):  # type: ignore[misc]
        def __init__(self, kernel: Compilable, place: Path, *, callee: bool) -> None:
            function = kernel.function
            self._impl_class = partial(_entries()[callee], _KeptPlace(function, place, digest_of(kernel)))
            super().__init__(function)
            self._name = name_of(function)
            self._installed = None if callee else installed()

        def _index_key(self, sig: Any, codegen: Any) -> Any:
            # For numba two named tuples differ by class and types of fields, not by the names of the fields.
            return *super()._index_key(sig, codegen), tuple(map(_fields, getattr(sig, "args", sig)))

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            try:
                found = self._from_installed(sig, target_context)
                return super().load_overload(sig, target_context) if found is None else found
            except Exception as error:  # noqa: BLE001  # whatever a damaged pickle raises
                _LOG.warning("machine code of %s on disk cannot be read (%r); it is made anew", self._name, error)
                return None

        def _from_installed(self, sig: Any, target_context: Any) -> Any:
            if self._installed is None:
                return None
            place, made = self._installed
            target_context.refresh()
            sig, _, *code = self._index_key(sig, target_context.codegen())
            file = numba.IndexDataCacheFile(str(place), self._impl.filename_base, "")
            data = file.load((sig, (made.triple, made.processor, made.features), *code))
            return None if data is None else self._impl.rebuild(target_context, data)

        def save_overload(self, sig: Any, data: Any) -> None:
            place, base = Path(self._cache_path), self._impl.filename_base
            try:
                try:
                    super().save_overload(sig, data)
                except OSError:
                    raise
                except Exception:  # noqa: BLE001  # the index is damaged, or names a class that no longer exists
                    (place / f"{base}.nbi").unlink()
                    super().save_overload(sig, data)
                _leave_last(place, self._name, base)
            except OSError as error:  # a full disk: the code serves this process
                _LOG.warning("machine code of %s cannot be kept on disk: %s", self._name, error)

    return CachedKernel


def code_cache_of(kernel: Compilable, *, callee: bool) -> Any:
    """Return a cache for the machine code of a kernel, as a dispatcher of numba holds one; None without a folder."""
    place = _callees() if callee else folder_in_use()
    return None if place is None else _cache_type()(kernel, place, callee=callee)


def folder_in_use() -> Path | None:
    """Return the folder that machine code is kept in, or was installed in where nothing can be written."""
    return folder() or _installed_folder()


def _callees() -> Path | None:
    """Return the folder for code that only kernels call; None where no later compilation will need it."""
    named = os.environ.get(CALLEES)
    if named:
        return Path(named)
    place = folder()
    return place / "callees" if place is not None and is_checkout() else None


def is_checkout() -> bool:
    """Return whether this package is a checkout, whose kernels are edited."""
    return (PACKAGE.parent / "pyproject.toml").is_file()


def is_cached(kernel: Compilable) -> bool:
    """Return whether there is machine code of a kernel on disk."""
    return bool(files_of(kernel, _installed_folder(), folder()))


def files_of(kernel: Compilable, *places: Path | None) -> list[Path]:
    """Return the files that machine code of a kernel is kept in, in the first folder that has some; [] without any."""
    index = f"{file_prefix_of(name_of(kernel.function), digest_of(kernel))}.nbi"
    found = next((place for place in places if place is not None and (place / index).exists()), None)
    return [] if found is None else [found / index, *found.glob(index.replace(".nbi", ".*.nbc"))]


def name_of(function: Callable[..., Any]) -> str:
    """Return the whole name of a function."""
    return f"{function.__module__}.{function.__qualname__}"


def file_prefix_of(name: str, digest: str) -> str:
    """Return how the names of files of machine code begin, of a function by its whole name."""
    # Windows forbids the brackets of a function inside another.
    version = f"py{sys.version_info[0]}{sys.version_info[1]}{getattr(sys, 'abiflags', '')}"
    return f"{name.replace('<', '').replace('>', '')}-{digest}.{version}"


def _leave_last(place: Path, name: str, base: str) -> None:
    """Remove files of other digests of a function, but the newest."""
    others = [path for path in place.glob(f"{file_prefix_of(name, '*')}.nbi") if path.stem != base]
    for path in sorted(others, key=_used, reverse=True)[_LEFT - 1 :]:
        for file in (path, *place.glob(f"{path.stem}.*.nbc")):
            file.unlink(missing_ok=True)


def _installed_folder() -> Path | None:
    found = installed()
    return None if found is None else found[0]


@cache
def start_background_compiler() -> None:
    """Begin a process in the background that makes all machine code, if none does so already; it may outlive this one.

    Its absence is no failure: what it would have made is made later, or never, and answers come in plain Python.
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
        _LOG.warning("machine code is made in the background, once and in some minutes; plain Python answers meanwhile")
    except OSError as error:
        _LOG.warning("no process can be begun that would make machine code: %s", error)


def _holds(file: IO[bytes], *, wait: bool) -> bool:
    """Return whether a file could be locked, until it is closed; True on systems and file systems without locks."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        pass
    return True


@contextmanager
def sole_compiler() -> Iterator[bool]:
    """Tell whether no other process makes all machine code, and be the one that does."""
    place = folder()
    if place is None:
        yield False
        return
    with (place / "all.lock").open("ab") as file:
        yield _holds(file, wait=False)


@contextmanager
def locked(kernel: Compilable) -> Iterator[None]:
    """Hold the machine code of a kernel while it is made: a process that waits for it loads it afterwards."""
    place = folder()
    if place is None or is_cached(kernel):
        yield
        return
    with ExitStack() as stack:
        try:
            file = stack.enter_context((place / f"{name_of(kernel.function)}.lock").open("ab"))
        except OSError:  # the folder was removed: it is made once more
            yield
            return
        _holds(file, wait=True)
        yield

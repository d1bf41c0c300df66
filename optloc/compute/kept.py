"""Machine code on disk: kept under a digest of all the sources that it may hold.

numba renews what it keeps of a function when the file of that function changes, but machine code holds that of all
functions it calls, wherever they stand: after an edit or an upgrade of one of those, stale code of the caller would go
on answering. So the folder of machine code is named by a digest of all sources of kernels, of the versions of what
compiles them, and of the processor that they are compiled for. What was installed for it (`optloc.compute.manifest`) is
read first.

What kernels call is only made ready to be taken in by them: to optimise and translate it by itself, and once more in
each that takes it in, took half of the time of a compilation. It is kept as well, for kernels of other processes.
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
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryFile
from types import SimpleNamespace
from typing import IO, Any

from optloc.compute.borrowing import borrowing
from optloc.compute.manifest import PACKAGE, PREFIX, digest_of, installed, of_this_process

# Folders of machine code of other sources that are left, the last used ones: branches of one checkout and versions that
# share a folder by NUMBA_CACHE_DIR take turns. One is some 90 MB.
_LEFT = 4
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
    """Remove machine code of other sources but that used last; a process that still uses it makes its own anew."""
    others = [path for path in place.parent.glob(f"{PREFIX}*") if path != place and path.is_dir()]
    for path in sorted(others, key=_used, reverse=True)[_LEFT:]:
        shutil.rmtree(path, ignore_errors=True)


def _used(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # removed by another process meanwhile
        return 0.0


@cache
def _taken_in() -> Any:
    """Return numba's type of the code of a function, for what callers take in: neither optimised nor translated."""
    from llvmlite import binding
    from numba.core import codegen

    llvm: Any = binding
    numba: Any = codegen

    class TakenIn(numba.JITCodeLibrary):  # type: ignore[misc]
        # Nothing of it is in the engine, so there is no place for an environment.
        codegen = SimpleNamespace(set_env=lambda name, environment: None)

        def _optimize_final_module(self) -> None:
            pass

        def _finalize_final_module(self) -> None:
            self._finalize_dynamic_globals()
            self._finalized = True

        def get_pointer_to_function(self, name: str) -> int:
            return 0

        def serialize_using_object_code(self) -> Any:
            return self.serialize_using_bitcode()

        @classmethod
        def read(cls, engine: Any, stored: tuple[str, str, bytes]) -> Any:
            """Return what was stored, in the engine of this process."""
            made = cls(engine, stored[0])
            made._final_module = llvm.parse_bitcode(stored[2])
            made._finalize_final_module()
            return made

    return TakenIn


@cache
def callee_compiler() -> Any:
    """Return numba's compiler of what only compiled functions call, as its option `pipeline_class` takes it."""
    from numba.core import compiler
    from numba.core.typed_passes import AnnotateTypes

    numba: Any = compiler

    class Callees(numba.Compiler):  # type: ignore[misc]
        def define_pipelines(self) -> Any:
            state = self.state
            state.library = _taken_in()(state.targetctx.codegen(), state.func_id.func_qualname)
            pipelines = super().define_pipelines()
            for pipeline in pipelines:
                pipeline.add_pass_after(borrowing(), AnnotateTypes)
                pipeline.finalize()
            return pipelines

    return Callees


class _Place:
    """Where the machine code of a function is kept, as numba asks for it (a cache locator)."""

    def __init__(self, function: Callable[..., Any], place: Path) -> None:
        file = Path(function.__code__.co_filename).resolve()
        self._py_file = str(file)
        self._path = str(place)
        line = str(function.__code__.co_firstlineno)
        if PACKAGE in file.parents:
            self._name, self._stamp = line, ""
        else:  # a node from outside, whose kernels may call those of files beside it
            self._name = f"{line}-{sha256(str(file).encode()).hexdigest()[:8]}"
            self._stamp = digest_of(list(file.parent.glob("*.py")), file.parent)

    def ensure_cache_path(self) -> None:
        Path(self._path).mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return self._path

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return self._name


@cache
def _entries() -> tuple[Any, Any]:
    """Return numba's types of what is kept of a function: that Python calls, and that only kernels call."""
    from numba.core import caching

    numba: Any = caching  # half typed

    class Impl(numba.CompileResultCacheImpl):  # type: ignore[misc]
        suffix = ""

        def __init__(self, place: _Place, function: Callable[..., Any]) -> None:
            self._locator, self._lineno = place, function.__code__.co_firstlineno
            # By the whole name of the module: all lie in one folder.
            name = f"{function.__module__}.{function.__qualname__}{self.suffix}"
            self._filename_base = self.get_filename_base(name, getattr(sys, "abiflags", ""))

    class TakenIn(Impl):
        suffix = ".callee"

        def rebuild(self, target_context: Any, payload: Any) -> Any:
            def read(stored: Any) -> Any:
                return _taken_in().read(target_context.codegen(), stored)

            context = SimpleNamespace(
                codegen=lambda: SimpleNamespace(unserialize_library=read),
                get_executable=target_context.get_executable,
                typing_context=target_context.typing_context,
            )
            return super().rebuild(context, payload)._replace(target_context=target_context)

    return Impl, TakenIn


@cache
def _cache_type() -> Any:
    """Return numba's cache of a function, told where it lies and by which name; damaged entries are as good as none."""
    from numba.core import caching

    numba: Any = caching  # half typed

    class Kept(numba.FunctionCache):  # type: ignore[misc]
        def __init__(self, function: Callable[..., Any], place: Path, *, callee: bool) -> None:
            locator = _Place(function, place)
            self._impl_class = partial(_entries()[callee], locator)
            super().__init__(function)
            self._name = f"{function.__module__}.{function.__qualname__}"
            # what stands outside of optloc was not installed with it
            self._installed = None if locator.get_source_stamp() else installed()

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
            sig, _, code = self._index_key(sig, target_context.codegen())
            file = numba.IndexDataCacheFile(str(place), self._impl.filename_base, "")
            data = file.load((sig, (made.triple, made.processor, made.features), code))
            return None if data is None else self._impl.rebuild(target_context, data)

        def save_overload(self, sig: Any, data: Any) -> None:
            try:
                super().save_overload(sig, data)
            except OSError as error:  # a full disk: the code serves this process
                _LOG.warning("machine code of %s cannot be kept on disk: %s", self._name, error)

    return Kept


def kept(function: Callable[..., Any], *, callee: bool) -> Any:
    """Return a cache for the machine code of a function, as a dispatcher of numba holds one; None without a folder."""
    place = kept_in()
    return None if place is None else _cache_type()(function, place, callee=callee)


def kept_in() -> Path | None:
    """Return the folder that machine code is kept in, or was installed in where nothing can be written."""
    return folder() or _installed_folder()


def is_kept(name: str) -> bool:
    """Return whether there is machine code on disk of a function, by its whole name."""
    wanted = f"{name}-*.py{sys.version_info[0]}{sys.version_info[1]}*.nbi"
    return any(place is not None and any(place.glob(wanted)) for place in (_installed_folder(), folder()))


def _installed_folder() -> Path | None:
    found = installed()
    return None if found is None else found[0]


@cache
def begin_child() -> None:
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
def alone() -> Iterator[bool]:
    """Tell whether no other process makes all machine code, and be the one that does."""
    place = folder()
    if place is None:
        yield False
        return
    with (place / "all.lock").open("ab") as file:
        yield _holds(file, wait=False)


@contextmanager
def locked(name: str) -> Iterator[None]:
    """Hold the machine code of a function while it is made: a process that waits for it loads it afterwards."""
    place = folder()
    if place is None or is_kept(name):
        yield
        return
    with ExitStack() as stack:
        try:
            file = stack.enter_context((place / f"{name}.lock").open("ab"))
        except OSError:  # the folder was removed: it is made once more
            yield
            return
        _holds(file, wait=True)
        yield

"""Compilation of scalar kernels: machine code by numba, or the same functions as plain Python."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial, update_wrapper
from importlib import import_module
from threading import Lock
from types import FunctionType
from typing import Any, TypeAlias, TypeVar, cast

from optloc.base.errors import InvalidProblem
from optloc.base.threads import held_by_forks
from optloc.base.types import Array
from optloc.kernels.code_cache import code_cache_of, folder, is_cached, locked, name_of, start_background_compiler
from optloc.kernels.compilation import options
from optloc.kernels.digests import Compilable, callers, closure
from optloc.kernels.progress import Reporter

_Function = TypeVar("_Function", bound=Callable[..., Any])

Constant: TypeAlias = int
"""The annotation of an argument that has machine code for each constant in the calls, not one for all.

Annotations are read as text, so a module with kernels has ``from __future__ import annotations``.
"""

# A context variable: one thread may run plainly while others run machine code.
_PLAIN = ContextVar("plain", default=False)
_LOCK = held_by_forks(Lock())
# While a thread loads or makes machine code it has numba's own lock, which a child of a fork would wait for in vain.
_LOADING = held_by_forks(Lock())


@cache
def _numba() -> Any:
    try:
        import numba
    except ImportError:
        return None
    # numba reads the variable NUMBA_DISABLE_JIT; its kernels would then be plain functions, without its rules of
    # division.
    settings: Any = numba.config
    if settings.DISABLE_JIT:
        return None
    _listen(_report)
    return numba


def enabled() -> bool:
    """Return whether kernels run as machine code: numba is installed and NUMBA_DISABLE_JIT is not set."""
    return not _PLAIN.get() and _numba() is not None


@contextmanager
def plain() -> Iterator[None]:
    """Run kernels as plain Python: a thousand times slower, but nothing has to be compiled or loaded first."""
    token = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(token)


_KERNELS: list[_Kernel] = []


class _Kernel(Compilable):
    """A function of scalars and arrays: as it is, compiled for Python, and compiled for kernels that call it."""

    def __init__(self, function: Callable[..., Any], *, taken_in: bool) -> None:
        super().__init__(function, taken_in=taken_in)
        self.ready = False
        self.seen, self.asked = False, 0  # machine code on disk; problems that it was asked for
        self._forms: dict[bool, Any] = {}
        update_wrapper(self, function)
        _KERNELS.append(self)

    @property
    def name(self) -> str:
        """The whole name of the function."""
        return name_of(self.function)

    @property
    def machine(self) -> Any:
        """The form that Python calls."""
        return self._form(callee=False)

    def _form(self, *, callee: bool) -> Any:
        """Return a compiled form, of which there is one for all threads: numba looks up types for each form anew."""
        made = self._forms.get(callee)  # by a name of its own: another thread may renew the kernel meanwhile
        if made is None:
            with _LOCK:
                made = self._forms.get(callee)
                if made is None:
                    made = _numba().njit(**options(callee=callee, taken_in=self.taken_in))(self.function)
                    if callee:
                        _take_as_variables(made, self.function)
                    # What numba's own option `cache` sets; where nothing can be written, machine code is not kept.
                    made._cache = code_cache_of(self, callee=callee) or made._cache  # noqa: SLF001
                    self._forms[callee] = made
        return made

    def renew(self) -> None:
        """Forget the compiled forms."""
        with _LOCK:
            self.ready, self.seen, self._forms = False, False, {}

    def __getattr__(self, name: str) -> Any:
        """Return what numba wants to know of a function that a kernel calls."""
        if name not in ("_numba_type_", "targetoptions", "py_func"):
            raise AttributeError(name)
        return getattr(self._form(callee=True), name)

    def __call__(self, *args: Any) -> Any:
        if not enabled():
            return self.function(*args)
        if not self.ready:
            self._prepare(args)
        return self.machine(*args)

    def _prepare(self, args: tuple[Any, ...]) -> None:
        """Load or compile the form for arguments of these types, while other processes wait for it."""
        REPORTER.begin()
        try:
            with locked(self), _LOADING:
                machine = self.machine
                machine.compile(tuple(machine.typeof_pyval(value) for value in args))
        finally:
            REPORTER.end()
        self.ready = True


def _take_as_variables(made: Any, function: Callable[..., Any]) -> None:
    """Compile constants in calls like variables, except for arguments that are a `Constant`.

    numba compiles a callee once more for each constant that it is handed, and for its callees in turn: of a thousand
    forms, 175 differed by a constant. LLVM knows the constants in what it inlines all the same.
    """
    from numba.core import types

    numba: Any = types  # half typed
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    kept = {name for name, kind in function.__annotations__.items() if kind == "Constant"}
    template, fold = made.get_call_template, made._compiler.fold_argument_types  # noqa: SLF001

    def template_of_variables(args: Any, kws: Any) -> Any:
        args = fold(args, kws)[1]
        return template([a if n in kept else numba.unliteral(a) for n, a in zip(names, args, strict=True)], {})

    made.get_call_template = template_of_variables


@contextmanager
def compiling(tell: Callable[[str, bool], None]) -> Iterator[None]:
    """Have the name of each kernel told when its compilation begins (False) and ends (True), in whichever thread."""
    stop = _listen(tell)
    try:
        yield
    finally:
        stop()


def _listen(tell: Callable[[str, bool], None]) -> Callable[[], None]:
    from numba.core import event

    events: Any = event  # without types

    class CompileReport(events.Listener):  # type: ignore[misc]
        def on_start(self, found: Any) -> None:
            tell(name_of(found.data["dispatcher"].py_func), False)

        def on_end(self, found: Any) -> None:
            tell(name_of(found.data["dispatcher"].py_func), True)

    listener = CompileReport()
    events.register("numba:compile", listener)
    return partial(events.unregister, "numba:compile", listener)


# The whole names of functions that this process has compiled, and of those that it compiles now.
_DONE: set[str] = set()
_BEGUN: set[str] = set()


def _text() -> str:
    if not _BEGUN:
        return "loading machine code"
    loaded = {kernel.name for kernel in _KERNELS}
    return f"making machine code: {len(_DONE)} of about {len(loaded | _DONE)} functions, once; kept in {folder()}"


REPORTER = Reporter(_text)


def _report(name: str, done: bool) -> None:
    if done:
        _DONE.add(name)
        _BEGUN.discard(name)
        REPORTER.end()
    else:
        _BEGUN.add(name)
        REPORTER.begin()


def names_in(package: str) -> list[str]:
    """Return the whole names of all kernels of a package, as far as it is loaded."""
    return [kernel.name for kernel in _KERNELS if kernel.name.startswith(f"{package}.")]


def named(name: str) -> Compilable:
    """Return a kernel by its whole name; its module is imported."""
    import_module(name.rpartition(".")[0])
    return next(kernel for kernel in _KERNELS if kernel.name == name)


# So many problems are few: plain Python answers them before machine code could be made.
FEW = 16
# What is done where there is no machine code yet: wait for it, have a process in the background make it, or neither.
_VARIABLE, _WAYS = "OPTLOC_COMPILE", ("wait", "child", "never")


def compile_mode() -> str:
    """Return what OPTLOC_COMPILE says of machine code that has to be made first: wait, child, never, or nothing."""
    given = os.environ.get(_VARIABLE, "").strip()
    if given and given not in _WAYS:
        raise InvalidProblem(f"{given!r} is no way to come by machine code", _VARIABLE, f"one of {', '.join(_WAYS)}")
    return given


def may_use_code(kernel: Callable[..., Any], count: int) -> bool:
    """Return whether machine code is the way for a number of problems: it is at hand, or they may wait for it.

    Raises
    ------
    InvalidProblem
        If OPTLOC_COMPILE is neither wait, child nor never.
    """
    assert isinstance(kernel, _Kernel)
    if not enabled():
        return False
    kernel.seen = kernel.seen or is_in_use(kernel) or is_cached(kernel)  # to look into the folder takes a millisecond
    if kernel.seen:
        return True
    chosen = compile_mode()
    if chosen == "child" and count > FEW:
        start_background_compiler()
    return chosen == "wait" or (not chosen and count > FEW)


def worth_loading(kernel: Callable[..., Any], count: int) -> bool:
    """Return whether machine code is the way for so many problems more: plain Python is sooner done with the first few.

    Counts the problems of a process, so that one which solves few again and again goes on with machine code.
    """
    assert isinstance(kernel, _Kernel)
    kernel.asked += count
    return is_in_use(kernel) or (kernel.asked > FEW and may_use_code(kernel, count))


def is_in_use(kernel: Callable[..., Any]) -> bool:
    """Return whether machine code of a kernel has been used in this process: the next call need not load it."""
    return bool(getattr(kernel, "ready", False))


def require_code(kernel: Callable[..., Any]) -> None:
    """Let a kernel count as at hand, so that its next use compiles it where there is no machine code on disk."""
    assert isinstance(kernel, _Kernel)
    kernel.ready = True


def is_available(kernel: Callable[..., Any]) -> bool:
    """Return whether machine code of a kernel was used in this process, or was on disk when that was first asked."""
    assert isinstance(kernel, _Kernel)
    return enabled() and (kernel.ready or _was_kept(kernel))


@cache  # to look into the folder takes longer than what it is asked for
def _was_kept(kernel: _Kernel) -> bool:
    return is_cached(kernel)


def replace(functions: Mapping[Callable[..., Any], Callable[..., Any]]) -> None:
    """Replace the functions of some kernels; these and all of their callers are compiled again at their next use."""
    for kernel, function in functions.items():
        assert isinstance(kernel, _Kernel)
        kernel.function = function
    for caller in callers(cast(Iterable[_Kernel], functions), _KERNELS):
        cast(_Kernel, caller).renew()


def compiled(function: _Function) -> _Function:
    """Return a function of scalars and arrays as machine code that releases the interpreter lock, kept on disk.

    Division by zero gives infinity or NaN, as in numpy; the order of operations is that of the source.
    """
    return cast(_Function, _Kernel(function, taken_in=False))


def inlined(function: _Function) -> _Function:
    """Return a function like `compiled`, which compiled callers always take in: every array handed on costs."""
    return cast(_Function, _Kernel(function, taken_in=True))


@compiled
def zero() -> int:
    """Return 0 as the start of a count: numba would compile what is handed a constant once more for a variable."""
    return int(0.0)  # not 0, which it takes for a constant again


# In `out[:] = values` numba compiles what would tell of shapes that differ, in words: each kernel with one took half a
# second more to make, and the first of a process three.


@compiled
def put(values: Array, out: Array) -> None:
    """Write a vector (n,) into another, as numpy does."""
    for i in range(out.shape[0]):
        out[i] = values[i]


@compiled
def put_rows(values: Array, out: Array) -> None:
    """Write a matrix (m, n) into another."""
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] = values[i, k]


# Copies of kernels with other constants, by the ends of their names.
_COPIES: dict[tuple[_Kernel, str], _Kernel] = {}


def specialise(
    kernel: _Function,
    mark: str,
    replaced: Mapping[Callable[..., Any], Callable[..., Any]] | None = None,
    /,
    **constants: Any,
) -> _Function:
    """Return a kernel with other values of module constants, in it and in all kernels that it calls.

    Machine code knows constants when it is made, so others take machine code of their own; the source is one.

    Parameters
    ----------
    kernel : callable
        As `compiled` returns it.
    mark : str
        Ends the names of kernels that call replaced ones. Kernels that differ by constants alone have these in their
        names, and are the same for all.
    replaced : dict, optional
        Kernels that are called in the place of others.
    constants : object
        New values by name; kernels that use none of them, nor call one that does, stay as they are.
    """
    others = cast(Mapping[_Kernel, _Kernel], replaced or {})
    made = dict[_Kernel, tuple[_Kernel, frozenset[tuple[str, Any]], bool]]()

    def copy(one: _Kernel) -> tuple[_Kernel, frozenset[tuple[str, Any]], bool]:
        """Return a copy, the constants that differ in it or below, and whether it reaches what is replaced."""
        one, other = others.get(one, one), one in others
        if one in made:
            return made[one][0], made[one][1], made[one][2] or other
        old, changed, differ, reaches = one.function, dict[str, Any](), frozenset[tuple[str, Any]](), False
        assert isinstance(old, FunctionType)
        for name in sorted(set(old.__code__.co_names) & old.__globals__.keys()):
            value = old.__globals__[name]
            if isinstance(value, _Kernel):
                new, below, replaces = copy(value)
                differ, reaches = differ | below, reaches or replaces
            else:
                new = constants.get(name, value)
                differ |= {(name, new)} if new is not value else set()
            changed |= {} if new is value else {name: new}
        # what only differs by constants is the same for all that call it
        key = one, mark if reaches else "_".join(f"{name}_{value}" for name, value in sorted(differ)).replace(".", "_")
        if changed and key not in _COPIES:
            own = FunctionType(old.__code__, {**old.__globals__, **changed}, old.__name__, old.__defaults__)
            own.__qualname__, own.__doc__ = f"{old.__qualname__}_{key[1]}", old.__doc__
            own.__annotations__ = old.__annotations__
            _COPIES[key] = _Kernel(own, taken_in=one.taken_in)
        made[one] = _COPIES[key] if changed else one, differ, reaches
        return made[one][0], differ, reaches or other

    assert isinstance(kernel, _Kernel)
    out = copy(kernel)[0]
    for one in {*made, *others}:
        if one in _KERNELS and not closure(one).isdisjoint(others):
            _KERNELS.remove(one)  # a pattern, of which there will be no machine code
    return cast(_Function, out)

"""Compilation of scalar kernels: numba compiles them to machine code, or they run as plain Python functions."""

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
from optloc.base.forks import held_by_forks
from optloc.base.types import Array
from optloc.kernels.code_cache import code_cache_of, folder, is_cached, locked, name_of, start_background_compiler
from optloc.kernels.compilation import options
from optloc.kernels.digests import Compilable, callers, closure
from optloc.kernels.progress import Reporter

_Function = TypeVar("_Function", bound=Callable[..., Any])

Constant: TypeAlias = int
"""Annotation of an argument for whose constant values numba compiles separate machine code.

All other arguments are compiled as variables. Annotations are read as text, so a module with kernels needs
``from __future__ import annotations``."""

# A context variable: one thread may run plain Python while others run machine code.
_PLAIN = ContextVar("plain", default=False)
_LOCK = held_by_forks(Lock())
# A thread that loads or compiles machine code holds numba's own lock. A child process forked meanwhile would wait for
# this lock forever.
_LOADING = held_by_forks(Lock())


@cache
def _numba() -> Any:
    """Return the module numba, or None if it is missing or disabled.

    Compilations are reported from the first call on.
    """
    try:
        import numba
    except ImportError:
        return None
    # With NUMBA_DISABLE_JIT, numba returns plain functions, whose division by zero raises an exception.
    settings: Any = numba.config
    if settings.DISABLE_JIT:
        return None
    _listen(_report)
    return numba


def enabled() -> bool:
    """Return whether kernels run as machine code.

    They do if numba is installed, NUMBA_DISABLE_JIT is not set, and the code does not run inside `plain`.
    """
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
    """A function of scalars and arrays in three forms: plain, compiled for Python, and compiled for calling kernels.

    `taken_in` is True if every caller inlines the function. `ready` is True if this process has used the machine code.
    `seen` is True if the machine code was found on disk. `asked` counts the problems requested so far.
    """

    def __init__(self, function: Callable[..., Any], *, taken_in: bool) -> None:
        super().__init__(function, taken_in=taken_in)
        self.ready = False
        self.seen, self.asked = False, 0
        self._forms: dict[bool, Any] = {}
        update_wrapper(self, function)
        _KERNELS.append(self)

    @property
    def name(self) -> str:
        """The qualified name of the function, with its module."""
        return name_of(self.function)

    @property
    def machine(self) -> Any:
        """The compiled form that Python calls."""
        return self._form(callee=False)

    def _form(self, *, callee: bool) -> Any:
        """Return a compiled form, shared by all threads: numba infers types again for each new form.

        `callee` is True for the form that other kernels call, False for the form that Python calls.
        """
        made = self._forms.get(callee)  # a local name, because another thread may discard the form meanwhile
        if made is None:
            with _LOCK:
                made = self._forms.get(callee)
                if made is None:
                    made = _numba().njit(**options(callee=callee, taken_in=self.taken_in))(self.function)
                    if callee:
                        _take_as_variables(made, self.function)
                    # Replaces the effect of numba's option `cache`. Without a writable folder, machine code is not
                    # stored.
                    made._cache = code_cache_of(self, callee=callee) or made._cache  # noqa: SLF001
                    self._forms[callee] = made
        return made

    def renew(self) -> None:
        """Discard the compiled forms, so that the next use compiles them again."""
        with _LOCK:
            self.ready, self.seen, self._forms = False, False, {}

    def __getattr__(self, name: str) -> Any:
        """Return the attributes that numba reads from a function that a kernel calls."""
        if name not in ("_numba_type_", "targetoptions", "py_func"):
            raise AttributeError(name)
        return getattr(self._form(callee=True), name)

    def __call__(self, *args: Any) -> Any:
        """Run the machine code, or the plain function if machine code is disabled."""
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
    """Make numba compile constants in calls as variables, except for arguments annotated with `Constant`.

    `made` is numba's dispatcher of the function. Otherwise numba compiles a callee again for each constant argument,
    and its callees as well: of a thousand forms, 175 differed only by a constant. LLVM still uses the constants in code
    that it inlines.
    """
    from numba.core import types

    numba: Any = types  # half typed
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    kept = {name for name, kind in function.__annotations__.items() if kind == "Constant"}
    template, fold = made.get_call_template, made._compiler.fold_argument_types  # noqa: SLF001

    def template_of_variables(args: Any, kws: Any) -> Any:
        """Return numba's template of a call whose constants are variables."""
        args = fold(args, kws)[1]
        return template([a if n in kept else numba.unliteral(a) for n, a in zip(names, args, strict=True)], {})

    made.get_call_template = template_of_variables


@contextmanager
def compiling(tell: Callable[[str, bool], None]) -> Iterator[None]:
    """Call `tell(name, done)` when the compilation of a kernel begins (False) and ends (True), in any thread."""
    stop = _listen(tell)
    try:
        yield
    finally:
        stop()


def _listen(tell: Callable[[str, bool], None]) -> Callable[[], None]:
    """Register a listener `tell(name, done)` for compilations, and return the function that removes it."""
    from numba.core import event

    events: Any = event  # without types

    class CompileReport(events.Listener):  # type: ignore[misc]
        def on_start(self, found: Any) -> None:
            """Report the start of a compilation."""
            tell(name_of(found.data["dispatcher"].py_func), False)

        def on_end(self, found: Any) -> None:
            """Report the end of a compilation."""
            tell(name_of(found.data["dispatcher"].py_func), True)

    listener = CompileReport()
    events.register("numba:compile", listener)
    return partial(events.unregister, "numba:compile", listener)


# Qualified names of the functions that this process has compiled, and of those that it is compiling.
_DONE: set[str] = set()
_BEGUN: set[str] = set()


def _text() -> str:
    """Return the progress line: how many functions are compiled, or that machine code is loaded."""
    if not _BEGUN:
        return "loading machine code"
    loaded = {kernel.name for kernel in _KERNELS}
    return f"making machine code: {len(_DONE)} of about {len(loaded | _DONE)} functions (once, stored in {folder()})"


REPORTER = Reporter(_text)


def _report(name: str, done: bool) -> None:
    """Count the start or the end of a compilation."""
    if done:
        _DONE.add(name)
        _BEGUN.discard(name)
        REPORTER.end()
    else:
        _BEGUN.add(name)
        REPORTER.begin()


def names_in(package: str) -> list[str]:
    """Return the qualified names of all kernels in the modules of a package that are imported."""
    return [kernel.name for kernel in _KERNELS if kernel.name.startswith(f"{package}.")]


def named(name: str) -> Compilable:
    """Return a kernel by its qualified name, and import its module."""
    import_module(name.rpartition(".")[0])
    return next(kernel for kernel in _KERNELS if kernel.name == name)


# Greatest number of problems for which plain Python is faster than compiling first.
FEW = 16
# Name of the environment variable, and its values; see `compile_mode`.
_VARIABLE, _WAYS = "OPTLOC_COMPILE", ("wait", "child", "never")


def compile_mode() -> str:
    """Return the value of OPTLOC_COMPILE, which applies if machine code is not on disk yet.

    - "wait": compile now, and continue when the machine code is ready.
    - "child": run plain Python; for more than `FEW` problems, a background process compiles meanwhile.
    - "never": run plain Python.
    - "" (not set): compile now for more than `FEW` problems; run plain Python for fewer.
    """
    given = os.environ.get(_VARIABLE, "").strip()
    if given and given not in _WAYS:
        raise InvalidProblem(f"{given!r} is not a setting for machine code", _VARIABLE, f"one of {', '.join(_WAYS)}")
    return given


def may_use_code(kernel: Callable[..., Any], count: int) -> bool:
    """Return whether to use machine code for `count` problems: it exists, or it may be compiled for them.

    Raises
    ------
    InvalidProblem
        If OPTLOC_COMPILE has another value than wait, child or never.
    """
    assert isinstance(kernel, _Kernel)
    if not enabled():
        return False
    kernel.seen = (
        kernel.seen or is_in_use(kernel) or is_cached(kernel)
    )  # stored, because a look into the folder takes a millisecond
    if kernel.seen:
        return True
    chosen = compile_mode()
    if chosen == "child" and count > FEW:
        start_background_compiler()
    return chosen == "wait" or (not chosen and count > FEW)


def worth_loading(kernel: Callable[..., Any], count: int) -> bool:
    """Return whether to load machine code for `count` more problems; for the first few, plain Python is faster.

    The problems of the whole process are counted, so that a process with many small calls changes to machine code.
    """
    assert isinstance(kernel, _Kernel)
    kernel.asked += count
    return is_in_use(kernel) or (kernel.asked > FEW and may_use_code(kernel, count))


def is_in_use(kernel: Callable[..., Any]) -> bool:
    """Return whether this process has used the machine code of a kernel, so that the next call does not load it."""
    return bool(getattr(kernel, "ready", False))


def require_code(kernel: Callable[..., Any]) -> None:
    """Mark a kernel as ready, so that its next use compiles it if there is no machine code on disk."""
    assert isinstance(kernel, _Kernel)
    kernel.ready = True


def is_available(kernel: Callable[..., Any]) -> bool:
    """Return whether the machine code of a kernel was used in this process, or was on disk at the first check."""
    assert isinstance(kernel, _Kernel)
    return enabled() and (kernel.ready or _was_cached(kernel))


@cache  # cached, because a look into the folder takes longer than the work of the kernel
def _was_cached(kernel: _Kernel) -> bool:
    """Return whether the machine code of a kernel is on disk."""
    return is_cached(kernel)


def replace(functions: Mapping[Callable[..., Any], Callable[..., Any]]) -> None:
    """Replace the functions of some kernels; they and all of their callers are compiled again at their next use."""
    for kernel, function in functions.items():
        assert isinstance(kernel, _Kernel)
        kernel.function = function
    for caller in callers(cast(Iterable[_Kernel], functions), _KERNELS):
        cast(_Kernel, caller).renew()


def compiled(function: _Function) -> _Function:
    """Return a function of scalars and arrays as machine code that is stored on disk and releases the interpreter lock.

    Division by zero gives infinity or NaN, as in numpy; the order of operations is the order in the source.
    """
    return cast(_Function, _Kernel(function, taken_in=False))


def inlined(function: _Function) -> _Function:
    """Return a function like `compiled`, which compiled callers always inline, since each array argument costs time."""
    return cast(_Function, _Kernel(function, taken_in=True))


@compiled
def zero() -> int:
    """Return 0 as the initial value of a counter that is not a compile-time constant.

    numba would compile a function that takes the constant once more for a variable.
    """
    return int(0.0)  # not 0, which numba would treat as a constant again


# For `out[:] = values`, numba also compiles an error message about different shapes. Each kernel with such a statement
# took half a second longer to compile, and the first of a process three seconds.


@compiled
def put(values: Array, out: Array) -> None:
    """Copy a vector (n,) into `out`, as numpy does."""
    for i in range(out.shape[0]):
        out[i] = values[i]


@compiled
def put_rows(values: Array, out: Array) -> None:
    """Copy a matrix (m, n) into `out`."""
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] = values[i, k]


# Copies of kernels with other constants, by kernel and name suffix.
_COPIES: dict[tuple[_Kernel, str], _Kernel] = {}


def specialise(
    kernel: _Function,
    mark: str,
    replaced: Mapping[Callable[..., Any], Callable[..., Any]] | None = None,
    /,
    **constants: Any,
) -> _Function:
    """Return a copy of a kernel with other values of module constants, in the kernel and in all kernels that it calls.

    The values of constants are fixed when machine code is compiled. So other values need another copy of the machine
    code from the same source.

    Parameters
    ----------
    kernel : callable
        Kernel returned by `compiled`.
    mark : str
        Suffix of the names of kernels that call replaced kernels. Kernels that differ only by constants have the
        constants in their names, and are shared.
    replaced : dict, optional
        Kernels to call instead of others.
    constants : object
        New values by name. Kernels that do not use them, directly or in callees, are not copied.
    """
    others = cast(Mapping[_Kernel, _Kernel], replaced or {})
    made = dict[_Kernel, tuple[_Kernel, frozenset[tuple[str, Any]], bool]]()

    def copy(one: _Kernel) -> tuple[_Kernel, frozenset[tuple[str, Any]], bool]:
        """Return a copy of a kernel, the changed constants in it or in its callees, and whether it calls a replacement.

        Without changes, the kernel itself is returned. The last result is also True if the kernel is a replacement.
        """
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
        # copies that differ only by constants are shared by all callers
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
            _KERNELS.remove(one)  # a template, which is never compiled itself
    return cast(_Function, out)

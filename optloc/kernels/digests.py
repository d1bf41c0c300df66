"""The digest of a kernel: a hash of its code, its constants, and everything that it calls.

The machine code of a kernel contains its callees and the values of module constants. So the digest covers the whole
call graph below the kernel and nothing else: after an edit, only the kernels that reach the edited function are
compiled again. Comments, docstrings and line numbers do not change the digest.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from hashlib import sha256
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

# Modules of numpy, numba and the standard library: the version of numba, which is part of the folder name, covers them.
_LIBRARIES = ("math", "numpy", "heapq", "typing", "operator", "numba")
# Hexadecimal digits of a digest in a file name: with 64 bits no accidental collision is expected.
_DIGITS = 16


class Compilable:
    """A function that numba compiles separately or into its callers; it can be replaced.

    Parameters
    ----------
    function : callable
        The Python function.
    taken_in : bool
        Whether each caller inlines the function.
    """

    def __init__(self, function: Callable[..., Any], *, taken_in: bool) -> None:
        self.function, self.taken_in = function, taken_in


def digest_of(kernel: Compilable) -> str:
    """Return the digest of a kernel's call graph; kernels that call each other have the same digest."""
    own = sorted(
        f"{one.function.__module__}.{one.function.__qualname__} {one.taken_in} {_digest_and_callees(one.function)[0]}"
        for one in closure(kernel)
    )
    return sha256("\n".join(own).encode()).hexdigest()[:_DIGITS]


def closure(kernel: Compilable) -> set[Compilable]:
    """Return a set: the kernel and all kernels that it calls, directly or indirectly."""
    found, left = {kernel}, [kernel]
    while left:
        new = set(callees(left.pop())) - found
        found |= new
        left += new
    return found


def callees(kernel: Compilable) -> tuple[Compilable, ...]:
    """Return the compiled functions whose names a kernel uses."""
    return _digest_and_callees(kernel.function)[1]


def callers(kernels: Iterable[Compilable], known: Iterable[Compilable]) -> set[Compilable]:
    """Return the given kernels, and all of `known` that call one of them directly or indirectly."""
    found, known = set(kernels), tuple(known)
    while True:
        more = {one for one in known if one not in found and not found.isdisjoint(callees(one))}
        if not more:
            return found
        found |= more


@cache
def _digest_and_callees(function: Callable[..., Any]) -> tuple[str, tuple[Compilable, ...]]:
    """Return the digest of a function without its callees, and its callees.

    The result is cached, because many call graphs contain the same function.
    """
    texts, called = list[str](), list[Compilable]()
    for text, callee in _parts(function, set()):
        texts.append(text)
        if callee is not None:
            called.append(callee)
    return sha256("\n".join(texts).encode()).hexdigest(), tuple(called)


def _parts(function: Callable[..., Any], seen: set[FunctionType]) -> Iterator[tuple[str, Compilable | None]]:
    """Yield (text, callee) for each part of a function that changes its machine code.

    `callee` is None unless the text is the name of a kernel. `seen` contains the functions that were visited already.
    """
    assert isinstance(function, FunctionType)
    if function in seen:
        return
    seen.add(function)
    yield _text(function.__code__, function.__doc__), None
    yield _text(function.__defaults__), None
    for word in sorted(_words(function.__annotations__)):
        if is_record(found := function.__globals__.get(word)):
            yield f"takes {_text(found)}", None
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    named = dict(zip(function.__code__.co_freevars, cells, strict=True))
    names = sorted(_names(function.__code__))
    named |= {name: function.__globals__[name] for name in names if name in function.__globals__}
    for name, value in named.items():
        yield from _value(name, value, names, seen)


def _value(name: str, value: Any, names: list[str], seen: set[FunctionType]) -> Iterator[tuple[str, Compilable | None]]:
    """Yield (text, callee) for a value whose name a function uses; see `_parts`.

    `names` are all names in the function: for a module, its attributes with these names are included.
    """
    if isinstance(value, Compilable):
        yield f"{name} calls {value.function.__module__}.{value.function.__qualname__}", value
    elif isinstance(value, ModuleType) and not _is_library(value.__name__):
        for attribute in names:
            if hasattr(value, attribute):
                yield from _value(f"{name}.{attribute}", getattr(value, attribute), names, seen)
    elif isinstance(
        inner := getattr(value, "py_func", value), FunctionType
    ):  # compiled by numba's `njit`, or a plain function
        yield f"{name} calls {inner.__module__}.{inner.__qualname__}", None
        yield from () if _is_library(inner.__module__) else _parts(inner, seen)
    else:
        yield f"{name} = {_text(value)}", None


def _words(annotations: Mapping[str, Any]) -> set[str]:
    """Return the names that occur in annotations, which are strings."""
    return set(re.findall(r"[A-Za-z_]\w*", " ".join(map(str, annotations.values()))))


def is_record(value: Any) -> bool:
    """Return whether a value is a class of named tuples; machine code addresses their fields by position."""
    return isinstance(value, type) and hasattr(value, "_fields")


def _record(kind: Any) -> str:
    """Return a text for a class of named tuples: its name, its fields, and the named tuples among the fields."""
    space = vars(sys.modules[kind.__module__])
    inner = [space[word] for word in sorted(_words(kind.__annotations__)) if is_record(space.get(word))]
    return f"{kind.__module__}.{kind.__qualname__}{kind._fields} of {list(map(_record, inner))}"


def _is_library(module: str) -> bool:
    """Return whether a module belongs to numpy, numba or the standard library, whose versions are covered elsewhere."""
    return module.partition(".")[0] in _LIBRARIES


def _names(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in a function, and in the functions inside it.

    An attribute with the name of a kernel counts as a call: to distinguish them from bytecode would take too long.
    """
    inner = [_names(part) for part in code.co_consts if isinstance(part, CodeType)]
    return set(code.co_names).union(*inner)


def _text(value: Any, documentation: str | None = None) -> str:
    """Return a text that two values share only if they compile to the same machine code.

    `documentation` is the docstring of a function whose code is the value; the text does not contain it.
    """
    if isinstance(value, CodeType):
        # The docstring is the first constant; some Python versions put None there if there is no docstring.
        constants = value.co_consts[value.co_consts[:1] in ((documentation,), (None,)) :]
        return _text((value.co_code, value.co_names, value.co_varnames, value.co_argcount, constants))
    if isinstance(value, tuple):
        kind = _text(type(value)) if is_record(type(value)) else "tuple"
        return f"{kind}({', '.join(map(_text, value))})"
    if isinstance(value, frozenset):
        return f"frozenset({', '.join(sorted(map(_text, value)))})"
    if isinstance(value, np.ndarray):
        return f"array {value.dtype} {value.shape} {value.tobytes().hex()}"
    if is_record(value):
        return _record(value)
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"
    if isinstance(value, ModuleType):
        return value.__name__
    return f"{type(value).__name__} {value!r}"

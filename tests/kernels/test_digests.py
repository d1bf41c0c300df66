"""An edit renews the machine code of what reaches it, and of nothing else: by the call graph, read from the source."""

import ast
import importlib
import inspect
import os
import subprocess
import sys
import textwrap
from collections import defaultdict
from functools import cache
from statistics import mean, median
from types import FunctionType
from typing import NamedTuple

import numpy as np
import pytest

import optloc
from optloc.cli.compile import parts
from optloc.kernels import code_cache, digests
from optloc.kernels.jit import _KERNELS, compiled, enabled, inlined, named, replace, specialise
from optloc.proof.nodes.dispatch import NODES, text_of

# Of the lines of all kernels, what an edit of one module may renew on average.
SHARE = 0.12


@cache
def shipped():
    """Return all kernels of optloc by name: those that entries reach."""
    entries = [named(name) for part in parts().values() for name in part.entries]
    return {kernel.name: kernel for entry in entries for kernel in digests.closure(entry)}


@cache
def source(kernel):
    """Return the source of a kernel; the table of nodes writes some functions as texts."""
    if kernel.function.__module__.endswith("nodes.dispatch"):
        return text_of(kernel.function.__name__, NODES)
    return textwrap.dedent(inspect.getsource(kernel.function))


def named_in(kernel):
    """Return the names that the source of a kernel reads, without those of its own variables."""
    nodes = list(ast.walk(ast.parse(source(kernel))))
    names = [node for node in nodes if isinstance(node, ast.Name)]
    own = {node.id for node in names if isinstance(node.ctx, ast.Store)}
    return {node.id for node in names} - own - {node.arg for node in nodes if isinstance(node, ast.arg)}


@cache
def called(name):
    """Return the whole names of the kernels that the source of a kernel names."""
    meant = [shipped()[name].function.__globals__.get(word) for word in named_in(shipped()[name])]
    return {one.name for one in meant if isinstance(one, digests.Compilable)}


@cache
def reached(name):
    """Return the whole names of a kernel and of all that it calls, at any depth, read from the source."""
    found, left = {name}, [name]
    while left:
        new = called(left.pop()) - found
        found |= new
        left += new
    return found


def test_the_call_graph_is_that_of_the_source():
    """But for attributes with the name of a kernel, which count as calls."""
    assert len(shipped()) > 500
    more = 0
    for name, kernel in shipped().items():
        known = {one.name for one in digests.closure(kernel)}
        assert reached(name) <= known, name
        more += len(known - reached(name))
    assert more <= 0.1 * sum(len(reached(name)) for name in shipped())


def test_an_edit_of_one_module_renews_few_lines():
    """The lines of the functions in a module, and of the functions that call them, at any depth."""
    lines = {name: len(source(kernel).splitlines()) for name, kernel in shipped().items()}
    renewed = defaultdict(set)
    for name in shipped():
        for other in reached(name) | {one.name for one in digests.closure(shipped()[name])}:
            renewed[shipped()[other].function.__module__].add(name)
    shares = [sum(lines[name] for name in names) / sum(lines.values()) for names in renewed.values()]
    assert len(shares) > 40
    assert median(shares) < mean(shares) <= SHARE


def test_digests_differ_and_are_the_same_each_time():
    made = {name: digests.digest_of(kernel) for name, kernel in shipped().items()}
    assert len(set(made.values())) >= 0.98 * len(made)  # kernels that call each other share one
    digests._digest_and_callees.cache_clear()
    assert {name: digests.digest_of(kernel) for name, kernel in shipped().items()} == made


@pytest.mark.parametrize("order", ["1", "2", "3"])
def test_digests_do_not_depend_on_the_order_of_sets(order):
    """Code under a digest that the next process does not compute is compiled by every process."""
    code = """
from optloc.cli.compile import parts
from optloc.kernels import digests
from optloc.kernels.jit import named
print(*(digests.digest_of(named(name)) for part in parts().values() for name in part.entries))
"""
    command, environment = [sys.executable, "-P", "-c", code], {**os.environ, "PYTHONHASHSEED": order}
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
    assert said == [digests.digest_of(named(name)) for part in parts().values() for name in part.entries]


def test_no_kernel_names_a_value_without_a_text_of_its_own():
    """The text of an object with an address differs in each process, so its kernel would never be found on disk."""
    texts = [text for kernel in shipped().values() for text, _ in digests._parts(kernel.function, set())]
    assert not [text for text in texts if " at 0x" in text]


STEP = 2.0
MOVES = np.arange(6).reshape(3, 2)


@compiled
def _level(x):
    """Return a level."""
    return STEP * x + MOVES[0, 1]


@inlined
def _other(x):
    return x - 1


@compiled
def _answer(x):
    return _level(x) + 1


@compiled
def _pair(x):
    return _answer(x), _other(x)


EDITS = {
    "a line": "def f(x):\n    return STEP * x - MOVES[0, 1]",
    "a number": "def f(x):\n    return STEP * x + MOVES[0, 0]",
    "a callee": "def f(x):\n    return STEP * x + MOVES[0, 1] + other(x)",
    "a name": "def f(y):\n    return STEP * y + MOVES[0, 1]",
}
SAME = {
    "a docstring": 'def f(x):\n    """Return another text."""\n    return STEP * x + MOVES[0, 1]',
    "a comment": "def f(x):\n    # A reason.\n\n\n    return STEP * x + MOVES[0, 1]",
}


def written(text, **values):
    """Return a function of a text, in the place of `_level`."""
    space = {"__name__": __name__, "STEP": STEP, "MOVES": MOVES, "other": _other, **values}
    exec(compile(text, __file__, "exec"), space)
    function = space["f"]
    assert isinstance(function, FunctionType)
    function.__name__, function.__qualname__ = "_level", "_level"
    return function


@pytest.fixture
def level():
    """Return the kernel whose function a test replaces."""
    before = _level.function
    yield _level
    replace({_level: before})


def digests_of():
    return [digests.digest_of(kernel) for kernel in (_level, _answer, _pair, _other)]


@pytest.mark.parametrize("edit", EDITS)
def test_an_edit_renews_its_callers_alone(edit, level):
    before = digests_of()
    replace({level: written(EDITS[edit])})
    assert [old == new for old, new in zip(before, digests_of(), strict=True)] == [False, False, False, True]


@pytest.mark.parametrize("edit", SAME)
def test_words_and_lines_renew_nothing(edit, level):
    replace({level: written(SAME["a docstring"])})
    before = digests_of()
    replace({level: written(SAME[edit])})
    assert digests_of() == before


@pytest.mark.parametrize("values", [{"STEP": 3.0}, {"STEP": 2}, {"MOVES": MOVES + 1}, {"MOVES": MOVES.astype(float)}])
def test_a_constant_renews_what_reads_it(values, level):
    replace({level: written(SAME["a comment"])})
    before = digests_of()
    replace({level: written(SAME["a comment"], **values)})
    assert [old == new for old, new in zip(before, digests_of(), strict=True)] == [False, False, False, True]


class Inner(NamedTuple):
    low: float
    high: float


class Outer(NamedTuple):
    inner: Inner
    x: float


def turned():
    """Return a class like `Inner`, but for the order of its fields."""

    class Other(NamedTuple):
        high: float
        low: float

    Other.__qualname__ = Inner.__qualname__
    return Other


def test_the_places_of_fields_count_though_the_code_names_them_alone(monkeypatch):
    """A field is read by its place: with the fields in another order, old machine code would read another."""

    def kernel(outer: "Outer") -> float:
        return outer.inner.low

    def digest():
        digests._digest_and_callees.cache_clear()
        return digests.digest_of(digests.Compilable(kernel, taken_in=False))

    before = digest()
    assert digest() == before
    monkeypatch.setitem(globals(), "Inner", turned())
    assert digest() != before


@pytest.mark.skipif(not enabled(), reason="without numba there is no machine code")
def test_named_tuples_with_other_fields_have_other_keys():
    from numba import typeof

    one, other = (typeof((Outer(kind(1.0, 2.0), 3.0), 4)) for kind in (Inner, turned()))
    assert code_cache._fields(one) != code_cache._fields(other)
    assert code_cache._fields(typeof(1.0)) == ()


def test_a_callee_that_is_taken_in_makes_other_code():
    def one(x):
        return x + 1

    forms = [digests.Compilable(one, taken_in=taken_in) for taken_in in (False, True)]
    assert len({digests.digest_of(form) for form in forms}) == 2


def test_closures_plain_functions_and_modules_count():
    module = importlib.import_module("optloc.base.units")

    def kernel(shift, helper):
        def inside(x):
            return helper(x) + shift + module.LARGEST

        return digests.digest_of(digests.Compilable(inside, taken_in=False))

    def plain(x):
        return x

    def double(x):
        return 2 * x

    assert kernel(1, plain) == kernel(1, plain)
    assert len({kernel(1, plain), kernel(2, plain), kernel(1, double)}) == 3


def test_recursion_ends():
    def again(x):
        return again(x - 1) if x > 0 else 0

    assert digests.digest_of(digests.Compilable(again, taken_in=False))


@pytest.mark.skipif(not enabled(), reason="without numba there is no machine code")
def test_replaced_functions_answer_through_their_callers(level):
    assert _pair(3.0) == (8.0, 2.0)
    replace({level: written(EDITS["a number"])})
    assert _pair(3.0) == (7.0, 2.0)


def test_other_constants_are_other_code():
    own = specialise(_answer, "three", STEP=3.0)
    assert digests.digest_of(own) != digests.digest_of(_answer)
    assert [kernel for kernel in _KERNELS if kernel.name.endswith("_level_STEP_3_0")]


def test_the_package_holds_no_kernel_that_no_entry_reaches():
    """A kernel for tests alone would take time of each compilation."""
    unused = {kernel.name for kernel in _KERNELS if kernel.name.startswith("optloc.")} - set(shipped())
    assert len(unused) <= 4, unused
    assert optloc.__name__ == "optloc"

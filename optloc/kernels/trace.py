"""Measurement functions with their derivatives as tapes; each kind is traced once, including user-defined kinds.

To trace a function means to call it with symbols that record every operation. A *node* is a recorded operation, input
or constant. A *tape* is the list of the operations on registers; machine code runs it without calling Python.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from optloc.base.cache import Cache
from optloc.base.types import Array
from optloc.linear.courses import over_ground
from optloc.linear.evaluate import BlockLinks, join
from optloc.models import Model
from optloc.models.primitives import Jet
from optloc.problem.problem import Problem

# Symbols represent numbers that are not known yet. Each operation on them is recorded once.

OPERATIONS = ("add", "sub", "mul", "div", "neg", "sqrt", "hypot", "atan2", "sin", "cos", "log", "exp")
ADD, SUB, MUL, DIV, NEG, SQRT, HYPOT, ATAN2, SIN, COS, LOG, EXP = range(len(OPERATIONS))
INPUT, CONSTANT = -1, -2
UNARY = (NEG, SQRT, SIN, COS, LOG, EXP)

_FUNCTIONS: tuple[Any, ...] = (
    np.add,
    np.subtract,
    np.multiply,
    np.divide,
    np.negative,
    np.sqrt,
    np.hypot,
    np.arctan2,
    np.sin,
    np.cos,
    np.log,
    np.exp,
)
_NUMBER = {function.__name__: number for number, function in enumerate(_FUNCTIONS)}


def operate(operation: int, left: Any, right: Any) -> Any:
    """Return the result of an operation (a number of `OPERATIONS`) on numbers or arrays, computed by numpy."""
    with np.errstate(all="ignore"):
        return _FUNCTIONS[operation](left) if operation in UNARY else _FUNCTIONS[operation](left, right)


@dataclass(slots=True)
class Recorder:
    """The recorded operations of a function, each of them once.

    Parameters
    ----------
    nodes : list of (operation, left, right)
        Operation and operands of each node; inputs and constants have negative operation numbers.
    known : dict
        The number of each node.
    """

    nodes: list[tuple[int, Any, Any]] = field(default_factory=list)
    known: dict[tuple[int, Any, Any], int] = field(default_factory=dict)

    def input(self, seed: int) -> Symbol:
        """Return the symbol of an input; `seed` is the number of the input."""
        return Symbol(self, self._number((INPUT, seed, 0)))

    def node(self, value: Any) -> int:
        """Return the number of the node of a symbol or a constant."""
        if isinstance(value, Symbol):
            return value.node
        number = float(value)
        # The sign is part of the key, because -0.0 differs from 0.0.
        return self._number((CONSTANT, number, math.copysign(1.0, number)))

    def constant(self, node: int) -> float | None:
        """Return the value of a constant node, or None for other nodes."""
        operation, value, _ = self.nodes[node]
        return float(value) if operation == CONSTANT else None

    def apply(self, operation: int, left: Any, right: Any = None) -> Symbol:
        """Record an operation (a number of `OPERATIONS`) on symbols or numbers, and return its symbol."""
        u = self.node(left)
        v = u if operation in UNARY else self.node(right)
        return Symbol(self, self._simplify(operation, u, v))

    def _number(self, key: tuple[int, Any, Any]) -> int:
        """Return the number of the node `key`, (operation, left, right), which is added if it is new."""
        if key not in self.known:
            self.known[key] = len(self.nodes)
            self.nodes.append(key)
        return self.known[key]

    def _simplify(self, operation: int, u: int, v: int) -> int:
        """Return the number of the node of an operation on the nodes u and v.

        Constants are evaluated, and equivalent forms with identical rounding are used.
        """
        left, right = self.constant(u), self.constant(v)
        if left is not None and right is not None:
            return self.node(operate(operation, left, right))
        rule = {ADD: self._add, SUB: self._sub, MUL: self._mul, DIV: self._div, NEG: self._neg}.get(operation)
        found = None if rule is None else rule(u, v)
        if found is not None:
            return found
        # A fixed order of the operands of commutative operations, so that equal operations are found.
        if operation in (ADD, MUL, HYPOT):
            u, v = min(u, v), max(u, v)
        return self._number((operation, u, v))

    def _is(self, node: int, operation: int) -> bool:
        """Return whether a node is the given operation."""
        return self.nodes[node][0] == operation

    def _add(self, u: int, v: int) -> int | None:
        """Return the node of a simpler form of u + v, or None."""
        if self.constant(u) == 0.0:
            return v
        if self.constant(v) == 0.0:
            return u
        # Doubling is exact, so that `_rescale` can simplify the derivative of the root of a square.
        if u == v:
            return self._simplify(MUL, self.node(2.0), u)
        if self._is(v, NEG):
            return self._simplify(SUB, u, self.nodes[v][1])
        return self._simplify(SUB, v, self.nodes[u][1]) if self._is(u, NEG) else None

    def _sub(self, u: int, v: int) -> int | None:
        """Return the node of a simpler form of u - v, or None."""
        if self.constant(v) == 0.0:
            return u
        if self.constant(u) == 0.0:
            return self._simplify(NEG, v, v)
        return self._simplify(ADD, u, self.nodes[v][1]) if self._is(v, NEG) else None

    def _mul(self, u: int, v: int) -> int | None:
        """Return the node of a simpler form of u v, or None."""
        for one, other in ((u, v), (v, u)):
            value = self.constant(one)
            # Zero times infinity or NaN becomes zero here: derivatives contain many zeros, and h is finite where it is
            # used.
            if value == 0.0:
                return self.node(0.0)
            if value in (1.0, -1.0):
                return other if value == 1.0 else self._simplify(NEG, other, other)
            if self._is(one, NEG):
                product = self._simplify(MUL, self.nodes[one][1], other)
                return self._simplify(NEG, product, product)
            scaled = self._rescale(one, other)
            if scaled is not None:
                return scaled
        return None

    def _rescale(self, u: int, v: int) -> int | None:
        """Return ``(2^k a) (c / b)`` as ``a (2^k c / b)``: the derivative of a root of squares has this form."""
        operation, factor, a = self.nodes[u]
        if operation != MUL or not self._is(v, DIV):
            return None
        if self.constant(factor) is None:
            factor, a = a, factor
        power, top = self.constant(factor), self.constant(self.nodes[v][1])
        # A factor that is a power of two is exact; any other factor would change the rounding.
        if power is None or top is None or math.frexp(power)[0] != 0.5:
            return None
        return self._simplify(MUL, a, self._simplify(DIV, self.node(power * top), self.nodes[v][2]))

    def _div(self, u: int, v: int) -> int | None:
        """Return the node of a simpler form of u / v, or None."""
        if self.constant(v) == 1.0:
            return u
        if self._is(u, NEG):
            ratio = self._simplify(DIV, self.nodes[u][1], v)
            return self._simplify(NEG, ratio, ratio)
        return None

    def _neg(self, u: int, v: int) -> int | None:
        """Return the node of a simpler form of -u, or None."""
        operation, left, right = self.nodes[u]
        if operation == NEG:
            return int(left)
        return self._simplify(SUB, right, left) if operation == SUB else None


@dataclass(frozen=True, slots=True, eq=False)
class Symbol:
    """A number that is not known yet; arithmetic on it is recorded.

    Parameters
    ----------
    recorder : Recorder
        Recorder of the operations.
    node : int
        Number of this symbol's node.
    """

    recorder: Recorder
    node: int

    def __elementary__(self) -> ModuleType:
        """Return this module, whose functions `optloc.models.primitives` calls for symbols."""
        return sys.modules[__name__]

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """Record a function of numpy that was called with symbols."""
        if method != "__call__" or options or ufunc.__name__ not in _NUMBER:
            return NotImplemented
        return self.recorder.apply(_NUMBER[ufunc.__name__], *inputs)

    def __add__(self, other: Any) -> Any:
        """Record ``self + other``."""
        return self._with(ADD, self, other)

    def __radd__(self, other: Any) -> Any:
        """Record ``other + self``."""
        return self._with(ADD, other, self)

    def __sub__(self, other: Any) -> Any:
        """Record ``self - other``."""
        return self._with(SUB, self, other)

    def __rsub__(self, other: Any) -> Any:
        """Record ``other - self``."""
        return self._with(SUB, other, self)

    def __mul__(self, other: Any) -> Any:
        """Record ``self * other``."""
        return self._with(MUL, self, other)

    def __rmul__(self, other: Any) -> Any:
        """Record ``other * self``."""
        return self._with(MUL, other, self)

    def __truediv__(self, other: Any) -> Any:
        """Record ``self / other``."""
        return self._with(DIV, self, other)

    def __rtruediv__(self, other: Any) -> Any:
        """Record ``other / self``."""
        return self._with(DIV, other, self)

    def __neg__(self) -> Symbol:
        """Record ``-self``."""
        return self.recorder.apply(NEG, self)

    def __bool__(self) -> bool:
        """Raise TypeError: the value is not known yet, so that a function cannot branch on it."""
        raise TypeError("a measurement function must not branch on its arguments")

    def _with(self, operation: int, left: Any, right: Any) -> Any:
        """Return the symbol of an operation with a symbol or a number; NotImplemented for other operands."""
        for one in (left, right):
            if not isinstance(one, Symbol | int | float | np.number):
                return NotImplemented
        return self.recorder.apply(operation, left, right)


def _function(operation: int) -> Callable[..., Symbol]:
    """Return the function that records an operation."""

    def record(u: Any, v: Any = None) -> Symbol:
        """Return the symbol of the operation on u, or on u and v."""
        owner = u if isinstance(u, Symbol) else v
        return owner.recorder.apply(operation, u, v)

    return record


# Functions that `optloc.models.primitives` calls for symbols.
sqrt, hypot, atan2, sin, cos, log, exp = (_function(op) for op in (SQRT, HYPOT, ATAN2, SIN, COS, LOG, EXP))


# A tape contains only the operations that the outputs need, and uses registers again.


@dataclass(frozen=True, slots=True)
class Tape:
    """A list of operations on registers, without branches.

    Parameters
    ----------
    code : int array (n, 4)
        Operation, target register, left and right operand; a target is never an operand of the same operation.
    inputs : tuple of (seed, register)
        Register of each input.
    constants : tuple of (register, value)
        Values to load before the first operation.
    outputs : tuple of int
        Registers of the outputs.
    registers : int
        Number of registers.
    """

    code: Array
    inputs: tuple[tuple[int, int], ...]
    constants: tuple[tuple[int, float], ...]
    outputs: tuple[int, ...]
    registers: int


def tape(recorder: Recorder, outputs: list[Any]) -> Tape:
    """Return the tape of the operations that the given outputs (symbols or numbers) need."""
    wanted = [recorder.node(value) for value in outputs]
    needed = _needed_nodes(recorder, wanted)
    last = _last_uses(recorder, needed, wanted)
    # Registers whose values are not needed later are used again, so that fewer registers stay in the cache.
    free: list[int] = []
    code: list[tuple[int, int, int, int]] = []
    loaded = [node for node in needed if recorder.nodes[node][0] < 0]
    register = {node: number for number, node in enumerate(loaded)}
    count = len(loaded)
    for node in needed:
        operation, left, right = recorder.nodes[node]
        if operation < 0:
            continue
        count += not free
        register[node] = free.pop() if free else count - 1
        code.append((operation, register[node], register[left], register[right]))
        # Freed after the choice of the target, so that no operation overwrites one of its operands.
        free.extend(register[used] for used in {left, right} if last[used] == node)
    return Tape(
        np.array(code, dtype=np.int64).reshape(-1, 4),
        tuple((int(recorder.nodes[n][1]), register[n]) for n in loaded if recorder.nodes[n][0] == INPUT),
        tuple((register[n], float(recorder.nodes[n][1])) for n in loaded if recorder.nodes[n][0] == CONSTANT),
        tuple(register[node] for node in wanted),
        count,
    )


def _needed_nodes(recorder: Recorder, wanted: list[int]) -> list[int]:
    """Return the nodes that the `wanted` nodes depend on, in the order in which they were recorded."""
    found: set[int] = set()
    ahead = list(wanted)
    while ahead:
        node = ahead.pop()
        if node not in found:
            found.add(node)
            operation, left, right = recorder.nodes[node]
            ahead.extend((left, right) if operation >= 0 else ())
    return sorted(found)


def _last_uses(recorder: Recorder, needed: list[int], wanted: list[int]) -> dict[int, int]:
    """Return a dictionary with the last node that uses each node; outputs are used after all nodes."""
    last: dict[int, int] = {}
    for node in needed:
        operation, left, right = recorder.nodes[node]
        if operation >= 0:
            last[left] = last[right] = node
    return last | dict.fromkeys(wanted, len(recorder.nodes))


def evaluate(tape: Tape, inputs: dict[int, Any]) -> list[Any]:
    """Return the outputs of a tape for numbers or arrays, computed by numpy.

    Tests compare the compiled interpreter with this function.
    """
    values: list[Any] = [0.0] * tape.registers
    for seed, register in tape.inputs:
        values[register] = inputs[seed]
    for register, value in tape.constants:
        values[register] = value
    for operation, target, left, right in tape.code.tolist():
        values[target] = operate(operation, values[left], values[right])
    return [values[register] for register in tape.outputs]


@dataclass(frozen=True, slots=True)
class Traced:
    """The tape of a measurement function.

    Parameters
    ----------
    tape : Tape
        Its first output is the value, the others are the derivatives.
    seeds : tuple of int
        Input of each derivative; inputs whose derivative is always zero are missing.
    """

    tape: Tape
    seeds: tuple[int, ...]


# A dozen kinds, in two dimensions, with a few sets of unknowns each. Each origin of local coordinates has its own
# entry.
_TRACED = Cache["Traced | None"](256)


def trace(problem: Problem, links: BlockLinks, given: frozenset[int], moved: frozenset[int]) -> Traced | None:
    """Return the tape of a block of rows, or None if its function cannot be traced.

    Parameters
    ----------
    problem : Problem
        Problem with the dimension and the frame.
    links : BlockLinks
        The block of rows.
    given : set of int
        Inputs that are data.
    moved : set of int
        Inputs that depend on unknowns; the tape has the derivatives by them.
    """
    model = links.model
    medium = problem.medium if model.straight else None
    frame = problem.frame if model.ecef or medium is not None or over_ground(problem) else None
    key = (model, given, moved, problem.dimension, frame, medium)
    return _TRACED.find(key, lambda: _trace(problem, model, given, moved))


def _trace(problem: Problem, model: Model, given: frozenset[int], moved: frozenset[int]) -> Traced | None:
    """Return the tape of a kind's function, see `trace`, without the cache."""
    recorder = Recorder()
    inputs: dict[int, Any] = {seed: recorder.input(seed) for seed in sorted(given | moved)}
    inputs |= {seed: Jet(inputs[seed], {seed: 1.0}) for seed in sorted(moved)}
    try:
        value = model.h(*join(problem, model, inputs))
        partials = dict(value.partials) if isinstance(value, Jet) else {}
        value = value.value if isinstance(value, Jet) else value
        if not isinstance(value, Symbol | int | float):
            return None
        # Derivatives that are always zero are left out.
        seeds = tuple(seed for seed in sorted(partials) if recorder.constant(recorder.node(partials[seed])) != 0.0)
        return Traced(tape(recorder, [value, *(partials[seed] for seed in seeds)]), seeds)
    except (TypeError, AttributeError, ValueError):  # the function uses more than the elementary functions
        return None

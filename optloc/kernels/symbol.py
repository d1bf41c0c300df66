"""Numbers that are not known yet: what a function does with them is written down, each operation once."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

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


def computed(operation: int, left: Any, right: Any) -> Any:
    """Return the value of an operation on numbers or arrays, by numpy."""
    with np.errstate(all="ignore"):
        return _FUNCTIONS[operation](left) if operation in UNARY else _FUNCTIONS[operation](left, right)


@dataclass(slots=True)
class Recorder:
    """Every operation of a function, each of them once.

    Parameters
    ----------
    nodes : list of (operation, left, right)
        What each node is made of; inputs and constants have negative operations.
    known : dict
        The number of each node.
    """

    nodes: list[tuple[int, Any, Any]] = field(default_factory=list)
    known: dict[tuple[int, Any, Any], int] = field(default_factory=dict)

    def input(self, seed: int) -> Symbol:
        """Return the symbol of an input."""
        return Symbol(self, self._number((INPUT, seed, 0)))

    def node(self, value: Any) -> int:
        """Return the number of the node of a symbol or a constant."""
        if isinstance(value, Symbol):
            return value.node
        number = float(value)
        # Keyed by its bits: -0.0 is not 0.0, and one NaN is as good as another.
        return self._number((CONSTANT, number, math.copysign(1.0, number)))

    def constant(self, node: int) -> float | None:
        """Return the value of a constant node, None for any other."""
        operation, value, _ = self.nodes[node]
        return float(value) if operation == CONSTANT else None

    def apply(self, operation: int, left: Any, right: Any = None) -> Symbol:
        """Return the symbol of an operation on symbols or numbers."""
        u = self.node(left)
        v = u if operation in UNARY else self.node(right)
        return Symbol(self, self._simplified(operation, u, v))

    def _number(self, key: tuple[int, Any, Any]) -> int:
        if key not in self.known:
            self.known[key] = len(self.nodes)
            self.nodes.append(key)
        return self.known[key]

    def _simplified(self, operation: int, u: int, v: int) -> int:
        """Return the node of an operation: folded, or another form that gives the same number to the last bit."""
        left, right = self.constant(u), self.constant(v)
        if left is not None and right is not None:
            return self.node(computed(operation, left, right))
        rule = {ADD: self._add, SUB: self._sub, MUL: self._mul, DIV: self._div, NEG: self._neg}.get(operation)
        found = None if rule is None else rule(u, v)
        if found is not None:
            return found
        if operation in (ADD, MUL, HYPOT):
            u, v = min(u, v), max(u, v)
        return self._number((operation, u, v))

    def _is(self, node: int, operation: int) -> bool:
        return self.nodes[node][0] == operation

    def _add(self, u: int, v: int) -> int | None:
        if self.constant(u) == 0.0:
            return v
        if self.constant(v) == 0.0:
            return u
        if u == v:
            return self._simplified(MUL, self.node(2.0), u)
        if self._is(v, NEG):
            return self._simplified(SUB, u, self.nodes[v][1])
        return self._simplified(SUB, v, self.nodes[u][1]) if self._is(u, NEG) else None

    def _sub(self, u: int, v: int) -> int | None:
        if self.constant(v) == 0.0:
            return u
        if self.constant(u) == 0.0:
            return self._simplified(NEG, v, v)
        return self._simplified(ADD, u, self.nodes[v][1]) if self._is(v, NEG) else None

    def _mul(self, u: int, v: int) -> int | None:
        for one, other in ((u, v), (v, u)):
            value = self.constant(one)
            if value == 0.0:
                return self.node(0.0)
            if value in (1.0, -1.0):
                return other if value == 1.0 else self._simplified(NEG, other, other)
            if self._is(one, NEG):
                product = self._simplified(MUL, self.nodes[one][1], other)
                return self._simplified(NEG, product, product)
            scaled = self._scaled(one, other)
            if scaled is not None:
                return scaled
        return None

    def _scaled(self, u: int, v: int) -> int | None:
        """Return ``(2^k a) (c / b)`` as ``a (2^k c / b)``: the derivative of a root of squares has this form."""
        operation, factor, a = self.nodes[u]
        if operation != MUL or not self._is(v, DIV):
            return None
        if self.constant(factor) is None:
            factor, a = a, factor
        power, top = self.constant(factor), self.constant(self.nodes[v][1])
        if power is None or top is None or math.frexp(power)[0] != 0.5:
            return None
        return self._simplified(MUL, a, self._simplified(DIV, self.node(power * top), self.nodes[v][2]))

    def _div(self, u: int, v: int) -> int | None:
        if self.constant(v) == 1.0:
            return u
        if self._is(u, NEG):
            ratio = self._simplified(DIV, self.nodes[u][1], v)
            return self._simplified(NEG, ratio, ratio)
        return None

    def _neg(self, u: int, v: int) -> int | None:
        operation, left, right = self.nodes[u]
        if operation == NEG:
            return int(left)
        return self._simplified(SUB, right, left) if operation == SUB else None


@dataclass(frozen=True, slots=True, eq=False)
class Symbol:
    """A number that is not known yet: arithmetic on it is written down.

    Parameters
    ----------
    recorder : Recorder
        Where.
    node : int
        Its own node.
    """

    recorder: Recorder
    node: int

    def __elementary__(self) -> ModuleType:
        return sys.modules[__name__]

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method != "__call__" or options or ufunc.__name__ not in _NUMBER:
            return NotImplemented
        return self.recorder.apply(_NUMBER[ufunc.__name__], *inputs)

    def __add__(self, other: Any) -> Any:
        return self._with(ADD, self, other)

    def __radd__(self, other: Any) -> Any:
        return self._with(ADD, other, self)

    def __sub__(self, other: Any) -> Any:
        return self._with(SUB, self, other)

    def __rsub__(self, other: Any) -> Any:
        return self._with(SUB, other, self)

    def __mul__(self, other: Any) -> Any:
        return self._with(MUL, self, other)

    def __rmul__(self, other: Any) -> Any:
        return self._with(MUL, other, self)

    def __truediv__(self, other: Any) -> Any:
        return self._with(DIV, self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return self._with(DIV, other, self)

    def __neg__(self) -> Symbol:
        return self.recorder.apply(NEG, self)

    def __bool__(self) -> bool:
        raise TypeError("a measurement function must not test its arguments")

    def _with(self, operation: int, left: Any, right: Any) -> Any:
        for one in (left, right):
            if not isinstance(one, Symbol | int | float | np.number):
                return NotImplemented
        return self.recorder.apply(operation, left, right)


def _function(operation: int) -> Callable[..., Symbol]:
    def record(u: Any, v: Any = None) -> Symbol:
        owner = u if isinstance(u, Symbol) else v
        return owner.recorder.apply(operation, u, v)

    return record


# What a measurement function finds here by way of `optloc.models.namespace`.
sqrt, hypot, atan2, sin, cos, log, exp = (_function(op) for op in (SQRT, HYPOT, ATAN2, SIN, COS, LOG, EXP))

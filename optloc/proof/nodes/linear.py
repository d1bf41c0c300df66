"""Linear forms of the position: coordinates, planes, priors. Exact over any box."""

from __future__ import annotations

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.proof.nodes.node import FLAT, Node, Row, inner, lay_out, pull, triple, write

# Numbers: where the form n.(x - o) is zero, and its coefficients.
ORIGIN, COEFFICIENTS, _WIDTH = 0, 3, 6


@compiled
def bound_linear(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound a linear form over a box (see `optloc.proof.nodes.node`), which has no remainder."""
    n = triple(data, COEFFICIENTS)
    write(pull(n, sense), slope)
    return inner(n, triple(line, 0)), 0.0, 0.0


@compiled
def size_linear(data: Array, reach: float) -> float:
    """Return the size of what a linear form is a difference of."""
    size = reach + (abs(data[ORIGIN]) + abs(data[ORIGIN + 1]) + abs(data[ORIGIN + 2]))
    return float(size * (abs(data[COEFFICIENTS]) + abs(data[COEFFICIENTS + 1]) + abs(data[COEFFICIENTS + 2])))


def linear_numbers(coefficients: Array, origin: Array | None = None) -> Array:
    """Return the numbers (B, n) of a linear node with coefficients (B, d), zero at an origin (B, d)."""
    parts = {COEFFICIENTS: coefficients}
    return lay_out(parts if origin is None else parts | {ORIGIN: origin})


def _of_row(row: Row) -> Array:
    """Return the numbers of a row: none is linear in the position; priors and planes make these nodes themselves."""
    raise NotImplementedError("a row of measurements does not say which linear form it is of")


LINEAR_FORM = Node("linear", _WIDTH, 1, _of_row, bound_linear, shape=FLAT, size=size_linear)

"""Steps across a plane of symmetry: the square q of the distance w from it is the unknown, with q >= 0.

Where all stations lie in a plane, ranges depend on the distance of the target by its square alone. On the plane the
derivatives by w vanish, so steps of Gauss and Newton in w have no end there; those in q do, and a minimum on the plane
is one at a bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array
from optloc.linear.normal import Normal, step


@dataclass(frozen=True, slots=True)
class Folded:
    """Steps of M problems whose target is mirrored in a plane.

    Parameters
    ----------
    column : int
        The distance from the plane among the shared unknowns.
    least : array (M,)
        The distance that stands for none, metres: so small that its square changes no range.
    held : bool
        Whether the target stays on the plane.
    """

    column: int
    least: Array
    held: bool = False

    def take(self, items: Array) -> Folded:
        """Return some of them."""
        return replace(self, least=self.least[items])

    def step(self, equations: Normal, damping: Array, x: Array) -> tuple[Array, Array]:
        """Return the damped steps (M, size), and where they exist (M,); on the plane none leads across it.

        A step of Gauss and Newton in q is one in w to first order, ``dq = 2 w dw``: `retract` makes it one in q.
        """
        at = x[:, self.column] <= self.least
        stays = at & (self.held | (equations.shared_vector[:, self.column] <= 0.0))
        return step(_without(equations, self.column, stays), damping)

    def retract(self, x: Array, move: Array) -> Array:
        """Return the vectors (M, size) that steps (M, size) from vectors lead to."""
        out, w = x + move, x[:, self.column]
        square = w * w + 2.0 * w * move[:, self.column]
        out[:, self.column] = np.sqrt(np.maximum(square, self.least**2))
        return out


def _without(equations: Normal, column: int, items: Array) -> Normal:
    """Return normal equations in which a shared unknown of some problems does not move."""
    if not items.any():
        return equations
    shared, cross, vector = (np.array(part) for part in (equations.shared, equations.cross, equations.shared_vector))
    own = shared[items, column, column]
    shared[items, column], shared[items, :, column] = 0.0, 0.0
    # Any pivot serves, for nothing else is left in its row.
    shared[items, column, column] = np.where(own > 0.0, own, 1.0)
    cross[items, :, column], vector[items, column] = 0.0, 0.0
    return replace(equations, shared=shared, cross=cross, shared_vector=vector)

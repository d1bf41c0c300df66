r"""Origin and unit of length for conic programs: this module centres and scales all coordinates.

A conic solver has relative tolerances, and the lift of a position contains squares. In metres, the cost of a fix would
be smaller than the rounding error of its squared coordinates. A bound from the dual would have no meaning. Both changes
of variables are exact:

- *points*: :math:`x = c + u x'`;
- *squared-range rows* :math:`B y = g` with `y` on a quadric (:mod:`formulations.squared_range`): on the cone,
  :math:`(x, r) = u (x', r')`, because its apex is fixed; on the paraboloid, :math:`x = c + u x'` and :math:`w = |c|^2 +
  2 u c^\top x' + u^2 w'`. Then again :math:`w' = |x'|^2`.

The unit is a power of two, so that multiplications by it have no rounding error. Source: N. J. Higham, "Accuracy and
stability of numerical algorithms", 2nd ed. (2002), section 7.3 (scaling by powers of the base).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.algebra import Array
from formulations.squared_range import Quadric


def power_of_two(length: float) -> float:
    """Return the power of two nearest to a length; one if the length is zero or not finite.

    Parameters
    ----------
    length : float
        Any length, at least zero.

    Returns
    -------
    float
        The unit.
    """
    return float(2.0 ** np.round(np.log2(length))) if np.isfinite(length) and length > 0.0 else 1.0


@dataclass(frozen=True, slots=True)
class PointScale:
    """Centred and scaled coordinates of points.

    Parameters
    ----------
    origin : Array, shape (d,)
        The mean of the points.
    unit : float
        The power of two nearest to the root mean square of their distances from it.
    """

    origin: Array
    unit: float

    @classmethod
    def of(cls, points: Array) -> PointScale:
        """Return the coordinates for points (N, d)."""
        origin = points.mean(axis=0)
        return cls(origin, power_of_two(float(np.sqrt(((points - origin) ** 2).sum(axis=1).mean()))))

    def scaled(self, points: Array) -> Array:
        """Return points (..., d) in these coordinates."""
        return np.asarray((points - self.origin) / self.unit)

    def back(self, points: Array) -> Array:
        """Return points (..., d) of these coordinates in the coordinates of the caller."""
        return np.asarray(self.origin + self.unit * points)


@dataclass(frozen=True, slots=True)
class RowScale:
    """Centred and scaled unknowns of squared-range rows.

    Parameters
    ----------
    shift : Array, shape (n - 1,)
        New origin of x; zero on the cone.
    unit : float
        Unit of length.
    paraboloid : bool
        Whether the last unknown is a squared length; else it is a length.
    """

    shift: Array
    unit: float
    paraboloid: bool

    @classmethod
    def of(cls, B: Array, g: Array, quadric: Quadric) -> RowScale:
        """Return the unknowns for rows B (q, n) and right sides g (q,), so that their largest numbers are alike."""
        d, last = quadric.size - 1, B[:, -1]
        weight = float(last @ last)
        if quadric.shape == "paraboloid" and weight > 0.0:
            # of ranges, whose rows are multiples of (-2 a, 1), this is the weighted mean of the stations a
            shift = -0.5 * (last @ B[:, :-1]) / weight
            left = B[:, :-1] + 2.0 * last[:, None] * shift
            right = g - B[:, :-1] @ shift - last * float(shift @ shift)
            side = float(np.sqrt((left * left).sum(axis=0).max()))
            length = max(0.5 * side / np.sqrt(weight), float(np.sqrt(np.sqrt(right @ right / weight))))
        else:
            shift = np.zeros(d)
            size = float(np.sqrt((B * B).sum(axis=0).max()))
            length = float(np.sqrt(g @ g)) / size if size > 0.0 else 1.0
        return cls(shift, power_of_two(length), quadric.shape == "paraboloid")

    def rows(self, B: Array, g: Array) -> tuple[Array, Array]:
        """Return the rows (q, n) and right sides (q,) for the new unknowns."""
        out, last, u = B * self.unit, B[:, -1], self.unit
        if not self.paraboloid:
            return out, g
        out[:, :-1] += 2.0 * u * last[:, None] * self.shift
        out[:, -1] *= u
        return out, g - B[:, :-1] @ self.shift - last * float(self.shift @ self.shift)

    def back(self, y: Array) -> Array:
        """Return unknowns (..., n) of the caller for new unknowns of the same shape."""
        out = np.asarray(self.unit * y)
        if self.paraboloid:
            out[..., -1] = self.unit * out[..., -1] + out[..., :-1] @ (2.0 * self.shift) + self.shift @ self.shift
            out[..., :-1] += self.shift
        return out

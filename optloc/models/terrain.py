"""Heights of the ground on a grid of the plan, as a bicubic spline with its gradient."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from optloc.base.cached import cached_property
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.models.primitives import Jet, differential, namespace

# Degree of the spline: its second derivatives are continuous, which steps of second order need. An axis with fewer than
# four points gets the highest degree that its points determine.
_DEGREE = 3


@dataclass(frozen=True, eq=False)  # without slots, because the cached properties need `__dict__`
class Terrain:
    """Heights of the ground at the points of a grid, with a bicubic spline between them.

    Outside the grid, the height is the height of the nearest point on its edge. Two grids are equal if their
    numbers are.

    Parameters
    ----------
    x, y : array (p,), (q,)
        Coordinates of the grid, metres, ascending; at least two along each axis.
    height : array (p, q)
        Third coordinate of the ground in the frame of the problem, metres.

    Raises
    ------
    InvalidProblem
        For axes that are not ascending, a wrong shape, or numbers that are not finite.

    References
    ----------
    P. Dierckx, "Curve and Surface Fitting with Splines" (1993); `scipy.interpolate.RectBivariateSpline`.
    """

    x: Array
    y: Array
    height: Array

    def __post_init__(self) -> None:
        """Convert and check the numbers, and make them read-only, since the hash depends on them."""
        for name in ("x", "y", "height"):
            values = np.array(_numbers(getattr(self, name), name), dtype=float)
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        for name, axis in (("x", self.x), ("y", self.y)):
            if axis.ndim != 1 or len(axis) < 2:
                raise InvalidProblem(f"the axis has shape {axis.shape}", name, "give two numbers or more in a row")
            if not np.isfinite(axis).all() or not (np.diff(axis) > 0.0).all():
                raise InvalidProblem(
                    "the axis of the grid is not ascending", name, "sort it, and leave out repetitions"
                )
        shape = (len(self.x), len(self.y))
        if self.height.shape != shape:
            what = f"heights of shape {self.height.shape} for a grid of {shape[0]} by {shape[1]} points"
            raise InvalidProblem(what, "height", "give one height for each x (first axis) and y (second axis)")
        if not np.isfinite(self.height).all():
            what = f"heights without a finite number: {int((~np.isfinite(self.height)).sum())}"
            raise InvalidProblem(what, "height", "fill the gaps of the grid first")

    @cached_property
    def digest(self) -> str:
        """Return the hash of the numbers; equal for equal grids, also in other processes."""
        return sha256(b"|".join(part.tobytes() for part in (self.x, self.y, self.height))).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Terrain) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the constructor and the numbers; splines and programs are made again in the other process."""
        return Terrain, (self.x, self.y, self.height)

    @cached_property
    def _knots(self) -> tuple[Array, Array, Array]:
        """Return the knots of both axes, and the coefficients (p, q) of the spline."""
        from scipy.interpolate import RectBivariateSpline

        kx, ky = self._degrees
        along_x, along_y, values = RectBivariateSpline(self.x, self.y, self.height, kx=kx, ky=ky, s=0).tck
        return along_x, along_y, np.reshape(values, self.height.shape)

    @cached_property
    def _spline(self) -> Any:
        """Return the spline of SciPy, which has slopes also where it is linear."""
        from scipy.interpolate import NdBSpline

        along_x, along_y, values = self._knots
        return NdBSpline((along_x, along_y), values, self._degrees)

    @property
    def _degrees(self) -> tuple[int, int]:
        """Return the degree of the spline along each axis."""
        return min(_DEGREE, len(self.x) - 1), min(_DEGREE, len(self.y) - 1)

    @cached_property
    def _symbolic(self) -> Any:
        """Return the spline as a CasADi function of (x, y), with the knots and coefficients of SciPy."""
        import casadi as ca

        knots_x, knots_y, coefficients = self._knots
        # CasADi varies the first axis fastest, SciPy the last. A function that is not inlined accepts SX from CasADi
        # 3.8 on; CasADi 3.7 raises an error that names it.
        values = coefficients.T.ravel()
        knots = [list(knots_x), list(knots_y)]
        return ca.Function.bspline("terrain", knots, list(values), list(self._degrees), 1, {"never_inline": True})

    def at(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the height (...) of the ground at points (...), metres, and its slopes (...) along x and y.

        Points outside the grid get the height of the nearest point on its edge.
        """
        inner = [np.clip(p, axis[0], axis[-1]) for p, axis in ((x, self.x), (y, self.y))]
        finite = np.isfinite(inner[0]) & np.isfinite(inner[1])
        place = [np.where(finite, p, axis[0]) for p, axis in zip(inner, (self.x, self.y), strict=True)]
        points = np.stack(place, axis=-1)
        value, along_x, along_y = (self._spline(points, nu=order) for order in ((0, 0), (1, 0), (0, 1)))
        # beyond an edge the height does not change along the axis that leaves the grid
        along_x = np.where(inner[0] == x, along_x, 0.0)
        along_y = np.where(inner[1] == y, along_y, 0.0)
        return (*(np.where(finite, number, np.nan) for number in (value, along_x, along_y)),)  # type: ignore[return-value]

    def of(self, x: Any, y: Any) -> Any:
        """Return the height of the ground at a point: numbers, jets or CasADi symbols, metres.

        Raises
        ------
        TypeError
            For other operands, for instance of a recorder of kernels.
        """
        xp = namespace(x.value if isinstance(x, Jet) else x)
        if getattr(xp, "__name__", "") == "casadi":
            low, high = (self.x[0], self.y[0]), (self.x[-1], self.y[-1])
            inner = [xp.fmin(xp.fmax(p, float(a)), float(b)) for p, a, b in zip((x, y), low, high, strict=True)]
            return self._symbolic(xp.vertcat(*inner))
        place = [np.asarray(p.value if isinstance(p, Jet) else p) for p in (x, y)]
        if any(p.dtype.kind not in "fiu" for p in place):
            raise TypeError("a terrain needs numbers, jets of numbers, or CasADi symbols")
        value, along_x, along_y = self.at(*(p.astype(float) for p in np.broadcast_arrays(*place)))
        return differential(value, [(x, along_x), (y, along_y)])


def _numbers(values: Any, name: str) -> Array:
    """Return the numbers of one argument as an array of floats; raise InvalidProblem for anything else."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise InvalidProblem("not all entries are numbers", name, "give numbers in metres") from None

r"""Least squares of ranges and range differences on an ellipsoid, with the horizon as linear inequalities.

.. math:: \min_x \; |W\,(z - D\,r(x))|^2 \quad\text{subject to}\quad (x - c)^\top A\,(x - c) = 1, \quad
   (x - c)^\top A\,(s_i - c) \ge 1

with :math:`r_i = |x - s_i|` and D the rows ``e_a - e_b`` (a range difference) or ``e_a`` (a range). On the ellipsoid
the polar planes describe exactly the part that every outside station sees. They remove the far-side basin, in which
most starts end without them. A station inside the ellipsoid sees all of it and gets no plane.

Source: D. Hilbert and S. Cohn-Vossen, "Geometry and the Imagination", 1932, chapter III (polar planes); the program
is that of :mod:`formulations.nls`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formulations.ellipsoid import Ellipsoid
from formulations.nls import Local, Program

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# the left side of a polar plane is at least -1 for a point and a station of the closed ellipsoid
_FREE = -10.0
# of the largest weight, tried in turn. Too small, and IPOPT's barrier outweighs metres where satellites fix a point
# weakly; too large, and rounding stops it short of its tolerance where they fix it well. IPOPT's own scaling looks at
# the gradient of the start, which vanishes where the start is the fix
_SIZES = (1e3, 1e2, 1e1)


class HeightProgram:
    """A compiled program for one set of rows, solved many times with new stations, data and surface.

    Parameters
    ----------
    rows : sequence of pairs of int
        Stations (a, b) of each row: ``r_a - r_b``, or ``r_a`` where b is negative.
    count : int
        Number of stations.
    diagonal : bool
        True: weights are a vector; False: a matrix W.
    settings : Mapping[str, Any], optional
        IPOPT settings.

    Notes
    -----
    Holds a compiled program: build one per worker, do not pickle.
    """

    def __init__(
        self,
        rows: Sequence[tuple[int, int]],
        count: int,
        *,
        diagonal: bool = True,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        if not rows or any(not (0 <= a < count and b < count) for a, b in rows):
            raise ValueError(f"rows {list(rows)} do not fit {count} stations")
        self.count = count

        def station(p: Any, i: int) -> Any:
            return p[12 + 4 * i : 15 + 4 * i]

        def distance(x: Any, p: Any, i: int) -> Any:
            away = x - station(p, i)
            return (away[0] ** 2 + away[1] ** 2 + away[2] ** 2) ** 0.5

        def h(x: Any, p: Any) -> list[Any]:
            return [distance(x, p, a) - (distance(x, p, b) if b >= 0 else 0.0) for a, b in rows]

        def surface(x: Any, p: Any) -> list[Any]:
            return [_polar(p, x, x) - 1.0]

        def horizon(x: Any, p: Any) -> list[Any]:
            return [_polar(p, x, station(p, i)) - p[15 + 4 * i] for i in range(count)]

        self._weight = np.ones(len(rows)) if diagonal else np.eye(len(rows))
        self._program = Program(
            3,
            len(rows),
            12 + 4 * count,
            h,
            equalities=surface,
            inequalities=horizon,
            diagonal=diagonal,
            settings={"nlp_scaling_method": "none", **(settings or {})},
        )

    def solve(
        self,
        start: ArrayLike,
        z: ArrayLike,
        stations: ArrayLike,
        surface: Ellipsoid,
        weight: ArrayLike | None = None,
        *,
        horizon: ArrayLike = True,
    ) -> Local:
        """Solve with new data.

        Parameters
        ----------
        start : array_like, shape (3,)
            First iterate; neither a station nor the centre, where gradients vanish.
        z : array_like, shape (m,)
            Measurements, in the unit of the positions: numbers of order one (Earth radii).
        stations : array_like, shape (s, 3)
            Positions.
        surface : Ellipsoid
            Shape (3, 3) and centre (3,).
        weight : array_like, shape (m,) or (m, m), optional
            W, of any size; a zero drops a row.
        horizon : array_like of bool, shape (s,) or ()
            False takes away the polar plane of a station that did not hear the target.

        Returns
        -------
        Local
            One equality multiplier (the height) and s inequality multipliers (at most zero; negative where the fix
            lies on a horizon).
        """
        s = np.asarray(stations, dtype=np.float64)
        if s.shape != (self.count, 3):
            raise ValueError(f"stations have shape {s.shape}, {(self.count, 3)} expected")
        planes = np.broadcast_to(np.asarray(horizon, dtype=np.bool_), s.shape[:1]) & (surface.polar(s, s) > 1.0)
        limit = np.where(planes, 1.0, _FREE)
        p = np.concatenate([surface.shape.ravel(), surface.centre, np.column_stack([s, limit]).ravel()])
        W = self._weight if weight is None else np.asarray(weight, dtype=np.float64)
        size = float(np.abs(W).max(initial=0.0))
        for aim in _SIZES:
            unit = aim / size if np.isfinite(size) and size > 0.0 else 1.0
            found = self._program.solve(start, z, unit * W, p)
            if found.success or "Infeasible" in found.status:
                break
        return replace(
            found,
            cost=found.cost / unit**2,
            bounds=found.bounds / unit**2,
            equalities=found.equalities / unit**2,
            inequalities=found.inequalities / unit**2,
        )


def _polar(p: Any, x: Any, y: Any) -> Any:
    """``(x - c)'A(y - c)`` on CasADi symbols; the first nine parameters are A, the next three c."""
    left, right = [x[i] - p[9 + i] for i in range(3)], [y[i] - p[9 + i] for i in range(3)]
    return sum(p[3 * i + j] * left[i] * right[j] for i in range(3) for j in range(3))

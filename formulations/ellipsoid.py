r"""Ellipsoids, and what is seen of them.

.. math:: (x - c)^\top A\,(x - c) = 1

The polar plane of an outside point `s`, :math:`(x - c)^\top A (s - c) = 1`, touches the ellipsoid where the tangents
from `s` do: it cuts off exactly the part that is seen from `s`. In numbers of order one (semi-axes as units) the form
keeps all digits; in metres it loses eight of them.

Source: D. Hilbert and S. Cohn-Vossen, "Geometry and the Imagination", 1932, chapter III (poles and polar planes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """The surface ``(x - centre)' shape (x - centre) = 1``.

    Parameters
    ----------
    shape : Array, shape (..., 3, 3)
        Symmetric positive definite.
    centre : Array, shape (..., 3)
        Centre.
    """

    shape: Array
    centre: Array

    def polar(self, x: Array, s: Array) -> Array:
        """Bilinear form ``(x - centre)' shape (s - centre)``.

        Parameters
        ----------
        x, s : Array, shape (..., 3)
            Points.

        Returns
        -------
        Array, shape (...)
            Equal points: 1 on the surface, more outside.
        """
        left = np.einsum("...i,...ij->...j", x - self.centre, self.shape)
        return np.asarray(np.sum(left * (s - self.centre), axis=-1))


def ellipsoid(
    axes: ArrayLike, height: ArrayLike = 0.0, *, origin: ArrayLike = 0.0, rotation: ArrayLike | None = None
) -> Ellipsoid:
    """Ellipsoid with all semi-axes grown by a height: the surface of that height to about 1e-3 of the flattening.

    Parameters
    ----------
    axes : array_like, shape (..., 3)
        Semi-axes along the coordinates of the ellipsoid's own frame, for instance (a, a, b).
    height : array_like, shape (...)
        Added to each semi-axis.
    origin : array_like, shape (..., 3)
        Origin of the frame wanted, in the ellipsoid's own frame.
    rotation : array_like, shape (..., 3, 3), optional
        Rows are the axes of the frame wanted, in the ellipsoid's own frame: ``rotation @ (x - origin)`` are its
        coordinates.

    Returns
    -------
    Ellipsoid
        In the frame wanted.
    """
    inverse = (np.asarray(axes, dtype=np.float64) + np.asarray(height, dtype=np.float64)[..., None]) ** -2
    R = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    centre = np.broadcast_to(-np.asarray(origin, dtype=np.float64), (*np.shape(origin)[:-1], 3))
    return Ellipsoid(np.einsum("...ik,...k,...jk->...ij", R, inverse, R), np.einsum("...ij,...j->...i", R, centre))


def visible(x: Array, surface: Ellipsoid, s: Array) -> Mask:
    """Whether a point of the ellipsoid is seen from a station: nothing of the ellipsoid lies between.

    Parameters
    ----------
    x : Array, shape (..., 3)
        Points of the surface.
    surface : Ellipsoid
        Shape (..., 3, 3) and centre (..., 3) broadcast against the points.
    s : Array, shape (..., 3)
        Stations. One inside the ellipsoid sees all of it.

    Returns
    -------
    Mask, shape (...)
        False where x or s is not finite.
    """
    inside = surface.polar(s, s) <= 1.0
    # a station of finite size sees the tangent points of its cone
    return np.asarray((surface.polar(x, s) >= 1.0) | (inside & np.isfinite(x).all(axis=-1)))

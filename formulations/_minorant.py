r"""Quadratic functions of a unit direction that stay below its squared angle errors and touch them at one direction.

Let :math:`\hat v` (azimuth :math:`\hat A`, elevation :math:`\hat E`) be predicted by a fix, `v` any direction,
:math:`\eta = A_v - \hat A`, :math:`\epsilon = E_v - \hat E`, and :math:`\hat\delta`, :math:`\hat\varepsilon` the
fix's own errors against the measured angles, so that the cost of `v` is

.. math:: f(v) = \frac{(\hat\delta + \eta)^2}{\sigma_A^2} + \frac{(\hat\varepsilon + \epsilon)^2}{\sigma_E^2} .

In the frame :math:`(\hat v, \hat a, \hat e)` of the fix's direction and tangents, with :math:`c = \cos E_v`,

.. math:: \hat a^\top v = c \sin\eta, \qquad \hat e^\top v = \sin\epsilon + \sin\hat E \, c \, (1 - \cos\eta), \qquad
   |v - \hat v|^2 = 4 \sin^2\tfrac{\epsilon}{2} + 4 c \cos\hat E \sin^2\tfrac{\eta}{2} .

On the cap :math:`|\hat\delta + \eta| \le \rho \sigma_A`, :math:`|\hat\varepsilon + \epsilon| \le \rho \sigma_E`
every remainder of

.. math:: q(v) = f(\hat v) + \frac{2 \hat\delta \, \hat a^\top v}{\sigma_A^2 \cos\hat E} + \frac{2 \hat\varepsilon \,
   \hat e^\top v}{\sigma_E^2} + w_A (\hat a^\top v)^2 + w_E (\hat e^\top v)^2 + w_0 |v - \hat v|^2

is at most a multiple of :math:`\eta^2` or :math:`\epsilon^2` (from :math:`|x - \sin x| \le |x|^3/6`, :math:`1 - \cos x
\le x^2/2` and the mean value theorem for cos), and the three weights are what is left of :math:`1/\sigma^2`. Hence
:math:`q \le f` on the cap and :math:`q(\hat v) = f(\hat v)`. A point with total cost at most :math:`\rho^2` has all its
directions in their caps, so the least sum of `q` over any set that holds the best point is at most the least sum of
`f`.

Source: derived here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ISOTROPIC = 1.0  # share of the possible weight that is put on the chord |v - v^|; what is left goes to the tangents


@dataclass(frozen=True, slots=True)
class Minorant:
    """``constant + 2 linear'w + sum square w^2`` for each direction, ``w = (v^, a^, e^)'v - (1, 0, 0)``.

    Parameters
    ----------
    constant : Array, shape (N,)
        Cost of the fix itself; zero where nothing better than ``f >= 0`` is known.
    linear, square : Array, shape (N, 3)
        Coefficients.
    reach : Array, shape (N,)
        Largest ``|v - v^|`` on the cap.
    """

    constant: Array
    linear: Array
    square: Array
    reach: Array


def minorant(error: Array, sigma: Array, elevation: Array, cost: float) -> Minorant:
    """Build the touching quadratics of one fix.

    Parameters
    ----------
    error : Array, shape (N, 2)
        Predicted minus measured azimuth (wrapped) and elevation.
    sigma : Array, shape (N, 2)
        Standard deviations.
    elevation : Array, shape (N,)
        Predicted by the fix.
    cost : float
        Total cost of the fix, the square of rho; only points at most as costly are bounded.

    Returns
    -------
    Minorant
        One quadratic per direction.

    Notes
    -----
    The module's text. Near the zenith, or with caps so wide that a remainder eats a weight, that direction's quadratic
    is zero: still a minorant.
    """
    (dA, dE), (sA, sE), rho = error.T, sigma.T, np.sqrt(cost)
    low = np.maximum(elevation - dE - rho * sE, -0.5 * np.pi)
    high = np.minimum(elevation - dE + rho * sE, 0.5 * np.pi)
    own = np.cos(elevation)
    widest = np.where((low <= 0.0) & (high >= 0.0), 1.0, np.maximum(np.cos(low), np.cos(high)))
    steep = np.sin(np.maximum(np.abs(low), np.abs(high)))
    turn = np.minimum(rho * sA, np.pi) + np.abs(dA)
    tilt = np.maximum(high - elevation, elevation - low)
    with np.errstate(all="ignore"):
        # |eta epsilon| is split so that both weights lose the same share
        mixed = np.abs(dA) * steep / (own * sA * sE)
        left_A = 1.0 / sA**2 - mixed * (sE / sA) ** 2 - np.abs(dA) * widest * turn / (3.0 * own * sA**2)
        left_A -= np.maximum(dE * np.sin(elevation), 0.0) * widest / sE**2
        left_E = 1.0 / sE**2 - mixed - np.abs(dE) * tilt / (3.0 * sE**2)
        # (e^'v)^2 <= epsilon^2 + spill eta^2
        spill = widest * steep * tilt + 0.5 * widest**2 * np.minimum(2.0, 0.5 * turn**2)
        chord = _ISOTROPIC * np.minimum(left_E, left_A / (widest * own))
        rest = left_A - chord * widest * own
        up = np.minimum(left_E - chord, rest / spill)
        across = (rest - up * spill) / widest**2
        square = np.stack([chord, across + chord, up + chord], axis=-1)
        linear = np.stack([np.zeros_like(own), dA / (sA**2 * own), dE / sE**2], axis=-1)
        constant = (dA / sA) ** 2 + (dE / sE) ** 2
        known = (left_A > 0.0) & (left_E > 0.0) & np.isfinite(square).all(axis=-1) & np.isfinite(linear).all(axis=-1)
    return Minorant(
        np.where(known, constant, 0.0),
        np.where(known[:, None], linear, 0.0),
        np.where(known[:, None], square, 0.0),
        np.minimum(np.sqrt(tilt**2 + widest * own * turn**2), 2.0),
    )

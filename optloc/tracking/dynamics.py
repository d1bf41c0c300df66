"""Models of motion from one scan to the next: transition F, process noise Q and drive of a state [p, v, a].

The state is position, velocity and acceleration, as far as the order of the model has them, in m, m/s and
m/s^2. Each part has d coordinates, and the whole state has n. A prediction is mean <- F mean + drive,
covariance <- F covariance F' + Q. The drive is an input that the model computes from the mean; most
models have none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import factorial

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array

Step = Callable[[float, Array, int], tuple[Array, Array, Array]]
"""Function of seconds, means (..., n) and dimension d; returns F (n, n), Q (..., n, n) and the added drive (..., n)."""

# Smallest distance of an acceleration from the limit of the current statistical model, as a share of the limit. At the
# limit, the published variance is zero; beyond the limit, it is unbounded.
_CLAMP = 0.05
# Powers of the time step in the responses of position, velocity and acceleration to an impulse of acceleration.
_POWERS = np.array([2.0, 1.0, 0.0])
# Time step as a share of the time constant, below which power series are summed. The closed form is a difference of
# order x^5 of numbers of order 1: above this limit it loses two digits at most.
_SERIES = 1.0
# Number of terms of the series: the next term, x^18 / 18! at most, is below the rounding of the sum.
_TERMS = 18


@dataclass(frozen=True, slots=True)
class Dynamics:
    """A model of motion.

    Parameters
    ----------
    name : str
        Name for reports.
    order : 0, 1 or 2
        The state holds position (0); position and velocity (1); or position, velocity and acceleration (2).
    step : callable
        See `Step`.
    """

    name: str
    order: int
    step: Step


def polynomial(order: int, noise: float = 0.0) -> Dynamics:
    """Return the model of a static target (order 0), constant velocity (1) or acceleration (2), with white noise.

    Parameters
    ----------
    order : 0, 1 or 2
        Order of the polynomial.
    noise : float
        Standard deviation of the next derivative, which is constant between scans: the velocity of a static target, the
        acceleration at constant velocity, or the jerk at constant acceleration (SI units).

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), 6.3.2.
    """
    if order not in (0, 1, 2):
        raise InvalidProblem(f"a motion of order {order}", "order", "use 0, 1 or 2")
    if not (np.isfinite(noise) and noise >= 0.0):
        raise InvalidProblem(f"the process noise is {noise}", "noise", "give a standard deviation of at least 0")

    def step(dt: float, mean: Array, d: int) -> tuple[Array, Array, Array]:
        """Return F (n, n), Q and drive of one time step; see `Step`."""
        return *_polynomial(order, noise, dt, d), np.zeros(mean.shape)

    return Dynamics(("static", "constant velocity", "constant acceleration")[order], order, step)


def singer(time_constant: float, deviation: float) -> Dynamics:
    """Return Singer's model: an acceleration that is exponentially correlated in time.

    Parameters
    ----------
    time_constant : float
        Time in seconds after which the correlation is 1/e.
    deviation : float
        Standard deviation of the acceleration, m/s^2.

    References
    ----------
    R. A. Singer, "Estimating optimal tracking filter performance for manned maneuvering targets", IEEE Trans. Aerosp.
    Electron. Syst. 6 (1970), eq. 8 and 10.
    """
    alpha = 1.0 / _positive(time_constant, "time_constant")
    _positive(deviation, "deviation")

    def step(dt: float, mean: Array, d: int) -> tuple[Array, Array, Array]:
        """Return F (n, n), Q and drive of one time step; see `Step`."""
        F, Q, _ = correlated(alpha, dt)
        return *_blocked(F, deviation**2 * Q, d), np.zeros(mean.shape)

    return Dynamics("Singer", 2, step)


def current_statistical(time_constant: float, limit: float, floor: float = 0.0) -> Dynamics:
    """Return the current statistical model: Singer's model about the present acceleration, with an adaptive variance.

    The mean is predicted with constant acceleration; time constant and limit affect only the covariance.

    Parameters
    ----------
    time_constant : float
        Seconds.
    limit : float
        Largest acceleration of an axis, m/s^2; three or four times the expected acceleration. Estimates near the limit
        or beyond it count as 5 % away from it, because the published variance is zero or unbounded there.
    floor : float
        Smallest standard deviation of the acceleration, m/s^2.

    References
    ----------
    H. Zhou, K. S. P. Kumar, "A current statistical model and adaptive algorithm for estimating maneuvering targets",
    J. Guidance 7 (1984), eq. 8 and 15.
    """
    alpha = 1.0 / _positive(time_constant, "time_constant")
    _positive(limit, "limit")
    if not (np.isfinite(floor) and floor >= 0.0):
        raise InvalidProblem(f"the floor is {floor}", "floor", "give a standard deviation of at least 0")

    def step(dt: float, mean: Array, d: int) -> tuple[Array, Array, Array]:
        """Return F (n, n), Q and drive of one time step; see `Step`."""
        F, Q, u = correlated(alpha, dt)
        present = mean[..., 2 * d :]
        gap = np.maximum(limit - np.abs(present), _CLAMP * limit)
        # The variance of a Rayleigh density between the present acceleration and the limit.
        variance = np.maximum((4.0 - np.pi) / np.pi * gap**2, floor**2)
        # Axes are independent: Q of one axis times the variance of each axis, in blocks [p, v, a].
        noise = np.einsum("ij,...c,cb->...icjb", Q, variance, np.eye(d))
        drive = (u[:, None] * present[..., None, :]).reshape(mean.shape)
        return np.kron(F, np.eye(d)), noise.reshape(*mean.shape, mean.shape[-1]), drive

    return Dynamics("current statistical", 2, step)


# Scans at equal intervals have one time step; other runs have some dozens of recurring time steps.
@lru_cache(maxsize=256)
def _polynomial(order: int, noise: float, dt: float, d: int) -> tuple[Array, Array]:
    """Return F (n, n) and Q (n, n) of a polynomial motion over `dt` seconds as read-only arrays.

    The cache shares the arrays. `noise` is the standard deviation of the derivative of order `order` + 1, SI
    units.
    """
    powers = np.array([dt**j / factorial(j) for j in range(order + 2)])
    F = sum(powers[j] * np.eye(order + 1, k=j) for j in range(order + 1))
    # The next derivative is constant between scans: it enters position, velocity, ... with the factor dt^j / j!.
    drive = noise * powers[order + 1 : 0 : -1]
    both = _blocked(np.asarray(F), np.outer(drive, drive), d)
    for array in both:
        array.setflags(write=False)
    return both


@lru_cache(maxsize=256)
def correlated(alpha: float, dt: float) -> tuple[Array, Array, Array]:
    """Return F (3, 3), Q (3, 3) for unit variance and U (3,) of an exponentially correlated acceleration of one axis.

    `alpha` is the inverse correlation time, 1/s, and `dt` is the time step, s. U is the effect of a constant
    mean acceleration on [p, v, a], which F does not contain. With x = alpha dt, let f(s) be the response of
    [p, v, a] to an impulse of acceleration after the share s of the step. Then Q = 2 x int_0^1 f f' ds in
    units of the step. For small x the closed form loses all digits, so f is summed as a power series.

    References
    ----------
    R. A. Singer, IEEE Trans. Aerosp. Electron. Syst. 6 (1970), eq. 8 and 11.
    """
    x = alpha * dt
    f, Q, U = _series(x) if x < _SERIES else _closed(x)
    units = dt**_POWERS
    F = np.eye(3) + dt * np.eye(3, k=1)
    F[:, 2] = units * f
    return F, units[:, None] * units * Q, units * U


def _series(x: float) -> tuple[Array, Array, Array]:
    """Return f (3,) at the end of the step, Q (3, 3) and U (3,) in units of the step, from power series in x.

    See `correlated` for f, Q, U and x.
    """
    n = np.arange(_TERMS)
    terms = (-x) ** n / np.array([[float(factorial(k + p)) for k in range(_TERMS)] for p in (2, 1, 0)])
    # The integral of the product of the terms s^i and s^j of f over the step is 1 / (i + j + 1).
    order = n + _POWERS[:, None]
    lengths = order[:, None, :, None] + order[None, :, None, :] + 1.0
    Q = 2.0 * x * (terms[:, None, :, None] * terms[None, :, None, :] / lengths).sum((-2, -1))
    return terms.sum(-1), Q, -terms[:, 1:].sum(-1)


def _closed(x: float) -> tuple[Array, Array, Array]:
    """Return f (3,) at the end of the step, Q (3, 3) and U (3,) in units of the step, in closed form; see `_series`."""
    e, e2 = np.exp(-x), np.exp(-2.0 * x)
    f = np.array([(x - 1.0 + e) / x**2, (1.0 - e) / x, e])
    q11 = (1.0 - e2 + 2.0 * x + 2.0 * x**3 / 3.0 - 2.0 * x**2 - 4.0 * x * e) / x**4
    q12 = (e2 + 1.0 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2) / x**3
    q13, q22 = (1.0 - e2 - 2.0 * x * e) / x**2, (4.0 * e - 3.0 - e2 + 2.0 * x) / x**2
    q23, q33 = (e2 + 1.0 - 2.0 * e) / x, 1.0 - e2
    return f, np.array([[q11, q12, q13], [q12, q22, q23], [q13, q23, q33]]), np.array([0.5, 1.0, 1.0]) - f


def _blocked(F: Array, Q: Array, d: int) -> tuple[Array, Array]:
    """Return F and Q of a state [p, v, a] of d axes from F and Q of one axis."""
    return np.kron(F, np.eye(d)), np.kron(Q, np.eye(d))


def _positive(value: float, name: str) -> float:
    """Return a finite positive number; other numbers raise InvalidProblem with `name` as the argument."""
    if not (np.isfinite(value) and value > 0.0):
        raise InvalidProblem(f"{name} is {value}", name, "give a positive number")
    return float(value)

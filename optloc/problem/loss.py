"""Robust loss functions: the cost of a residual, and the weight of its row in least squares.

u is a residual in standard deviations, rho(u) its loss, and psi = rho' / 2. Least squares has rho = u² and psi = u. E
is the expectation for a standard normal u. c is the constant of a loss.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.registry import Registry
from optloc.base.types import Array


@dataclass(frozen=True, slots=True)
class Loss:
    """A loss function of residuals u in standard deviations: about u² near zero, with slower growth for large u.

    Parameters
    ----------
    name : str
        Name of the loss and of the solver stage that uses it.
    constant : float
        Residual above which the loss differs from u². For clean Gaussian data the mean square error is the error of
        least squares divided by 0.95. For the truncated loss it is divided by 0.99, because with few rows an
        unnecessary rejection of a row costs more than 5 %.
    cost : callable of (u, constant)
        The loss rho(u).
    importance : callable of (u, constant)
        The weight psi(u) / u with psi = rho' / 2. It is in [0, 1] and does not increase with abs(u).
    summary : str
        One line for listings.
    one_sided : bool
        Whether the loss reduces the weight of positive residuals only. For kinds with errors of either sign, u is then
        abs(u).
    flat : bool
        Whether the loss is constant for large residuals. The number of outliers is then evidence. The search for minima
        starts with another loss, because a constant loss has no slope.
    """

    name: str
    constant: float
    cost: Callable[[Array, float], Array]
    importance: Callable[[Array, float], Array]
    summary: str = ""
    one_sided: bool = False
    flat: bool = False

    def rho(self, u: Array) -> Array:
        """Return the loss of each residual u (...), in standard deviations; u² for small residuals."""
        return self.cost(np.asarray(u, dtype=float), self.constant)

    def weight(self, u: Array) -> Array:
        """Return the weight psi(u) / u in [0, 1] of each residual u (...), in standard deviations."""
        return self.importance(np.asarray(u, dtype=float), self.constant)

    @property
    def psi_squared(self) -> float:
        """Return the expectation of psi(u)² for a standard normal u."""
        return _moments(self)[0]

    @property
    def slope(self) -> float:
        """Return the expectation of psi'(u) for a standard normal u.

        It is computed as the expectation of u psi(u) (integration by parts), which is valid even if psi has steps.
        """
        return _moments(self)[1]

    @property
    def mean_weight(self) -> float:
        """Return the expected weight for a standard normal u."""
        return _moments(self)[2]

    @property
    def efficiency(self) -> float:
        """Return the mean square error of least squares over the error of this loss, for clean Gaussian data.

        It is (E psi')² / E psi², at most 1: P. J. Huber, "Robust Statistics" (1981), eq. 3.2.13.
        """
        return self.slope**2 / self.psi_squared

    @property
    def spread(self) -> float:
        """Return the factor that converts the inverse of the weighted normal matrix to the covariance of the estimate.

        The covariance of an M-estimate is E psi² / (E psi')² times the inverse normal matrix of least squares (Huber
        1981, eq. 7.6.2). The expected weight converts the weighted normal matrix to the normal matrix of least squares.
        """
        return self.psi_squared * self.mean_weight / self.slope**2


# Number of Gauss-Legendre nodes per panel, and end of the integration (density e^-72). Larger values change no digit.
_NODES, _REACH = 60, 12.0


@lru_cache
def _moments(loss: Loss) -> tuple[float, float, float]:
    """Return three expectations for a standard normal u: of psi(u)², of u psi(u) and of the weight.

    They are computed by quadrature between the kinks of the loss.
    """
    node, share = np.polynomial.legendre.leggauss(_NODES)
    # The integrand is smooth between the kinks at 0 and at the constant. The panel ends at 6 sigma make the nodes dense
    # where the density is large.
    ends = np.array([-_REACH, -6.0, -loss.constant, 0.0, loss.constant, 6.0, _REACH])
    half, middle = 0.5 * np.diff(ends)[:, None], 0.5 * (ends[1:] + ends[:-1])[:, None]
    u = middle + half * node
    density = half * share * np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi)
    weight = loss.weight(u)
    return tuple(float((density * value).sum()) for value in ((weight * u) ** 2, weight * u**2, weight))  # type: ignore[return-value]


def _huber(u: Array, c: float) -> Array:
    """Return Huber's loss: u² up to the constant c, and a straight line beyond it."""
    return np.where(np.abs(u) <= c, u**2, 2.0 * c * np.abs(u) - c**2)


def _huber_weight(u: Array, c: float) -> Array:
    """Return the weights of Huber's loss: 1 up to the constant c, then c / abs(u)."""
    return np.asarray(c / np.maximum(np.abs(u), c))


def _cauchy(u: Array, c: float) -> Array:
    """Return Cauchy's loss c² log(1 + u² / c²)."""
    return np.asarray(c**2 * np.log1p((u / c) ** 2))


def _cauchy_weight(u: Array, c: float) -> Array:
    """Return the weights 1 / (1 + u² / c²) of Cauchy's loss."""
    return np.asarray(1.0 / (1.0 + (u / c) ** 2))


def _truncated(u: Array, c: float) -> Array:
    """Return the truncated loss: u², but c² at most."""
    return np.asarray(np.minimum(u**2, c**2))


def _truncated_weight(u: Array, c: float) -> Array:
    """Return the weights of the truncated loss: 1 up to the constant c, 0 beyond it."""
    return np.asarray(1.0 * (np.abs(u) <= c))


def _late(u: Array, c: float) -> Array:
    """Return the one-sided loss: Cauchy's loss for positive residuals, u² for negative residuals."""
    return np.where(u > 0.0, _cauchy(u, c), u**2)


def _late_weight(u: Array, c: float) -> Array:
    """Return the weights of the one-sided loss: 1 for negative residuals, Cauchy's for positive residuals."""
    return _cauchy_weight(np.maximum(u, 0.0), c)


# Loss for late rows: a share of the rows has exponentially distributed delays. It exists for every share and mean
# delay.

LATE = frozenset(("range", "toa", "range_sum"))
"""Kinds that a blocked path can only lengthen: each path has a positive sign. Differences can err either way."""

# Name of a loss for late rows: late(share, mean delay in sigma).
_LATE_NAME = re.compile(r"late\((?P<share>[0-9.eE+-]+),(?P<delay>[0-9.eE+-]+)\)")
# Residual below which psi / u is replaced by its limit, and the step of the difference quotient for this limit. The
# step is far above the rounding error of a logarithm.
_ZERO, _STEP = 1e-6, 1e-3


@lru_cache(maxsize=256)
def late_loss(share: float, delay: float) -> Loss:
    """Return the loss for rows of which a share is late, with exponentially distributed delays.

    The residual of a row, in sigma, is normal. With probability p = `share` an exponential delay is added. Its density
    is (1 - p) phi(u) + p g(u). Here phi is the standard normal density, and g is the density of an exponential plus a
    normal variable (Grushka 1972, equation 5). The loss is twice the negative logarithm of this density, measured from
    its mode, which is some hundredths of sigma above zero. Early rows cost u².

    Parameters
    ----------
    share : float
        Probability that a row is late, between 0 and 1.
    delay : float
        Mean delay of late rows, standard deviations.

    Raises
    ------
    InvalidProblem
        If the share is not between 0 and 1, or the delay is not positive.
    """
    name = f"late({share:.4g},{delay:.4g})"
    if not 0.0 < share < 1.0 or not 0.0 < delay < np.inf:
        advice = "write the share of late rows and their mean delay in sigma, such as late(0.1,8)"
        raise InvalidProblem(f"there is no loss {name}", "method", advice)
    mode = _mode(share, delay)
    # Slope of psi at the mode: the limit of the weight psi(u) / u for u = 0. psi is zero at the mode.
    log_density_at_mode = _late_density(np.array(mode), share, delay)[0]
    curvature = float(_late_density(np.array(mode + _STEP), share, delay)[1]) / _STEP

    # A loss has two arguments, the residuals and its constant. This loss has no constant, so it ignores the second.
    def cost(u: Array, _: float) -> Array:
        """Return the loss of residuals u, in standard deviations."""
        log_density = _late_density(np.maximum(u, 0.0) + mode, share, delay)[0]
        return np.where(u > 0.0, np.maximum(2.0 * (log_density_at_mode - log_density), 0.0), u**2)

    def importance(u: Array, _: float) -> Array:
        """Return the weights psi(u) / u of residuals u, between 0 and 1."""
        psi = _late_density(np.maximum(u, 0.0) + mode, share, delay)[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = np.where(u > _ZERO, psi / u, curvature)
        return np.where(u > 0.0, np.clip(weight, 0.0, 1.0), 1.0)

    summary = f"a share of {share:.2g} late by {delay:.2g} sigma on average"
    # The constant of this loss is the residual at which the weight is about 0.5. The quadrature needs no precise value.
    grid = np.linspace(0.5, 8.0, 151)
    kink = float(grid[int(np.argmin(np.abs(importance(grid, 0.0) - 0.5)))])
    return Loss(name, kink, cost, importance, summary, one_sided=True)


def _late_density(u: Array, share: float, delay: float) -> tuple[Array, Array]:
    """Return the logarithm of the density of residuals u (...) with a share of late rows, and minus its derivative.

    u is in standard deviations. `share` and `delay` as for `late_loss`.
    """
    from scipy.special import log_ndtr

    # Logarithms of both terms of the density: late rows and prompt rows. `p_late` is the probability that a row with
    # this residual is late.
    late = np.log(share / delay) + 0.5 / delay**2 - u / delay + log_ndtr(u - 1.0 / delay)
    prompt = np.log1p(-share) - 0.5 * u**2 - _LOG_ROOT
    density = np.logaddexp(late, prompt)
    p_late = np.exp(late - density)
    # Derivative of the logarithm of the normal distribution function: its hazard rate.
    hazard = np.exp(-0.5 * (u - 1.0 / delay) ** 2 - _LOG_ROOT - log_ndtr(u - 1.0 / delay))
    return density, (1.0 - p_late) * u + p_late * (1.0 / delay - hazard)


_LOG_ROOT = 0.5 * float(np.log(2.0 * np.pi))


def _mode(share: float, delay: float) -> float:
    """Return the mode of the density of residuals with a share of late rows, in sigma, by bisection.

    The loss is measured from the mode, so that it is least at u = 0.
    """
    low, high = 0.0, 1.0 + 2.0 * delay
    for _ in range(60):  # 60 halvings reach rounding error
        middle = 0.5 * (low + high)
        rising = float(_late_density(np.array(middle), share, delay)[1]) < 0.0
        low, high = (middle, high) if rising else (low, middle)
    return 0.5 * (low + high)


class _NamedLosses(dict[str, Loss]):
    """Table of losses that also makes losses from names such as "late(0.1,8)"."""

    def __missing__(self, name: str) -> Loss:
        """Return the loss of a name such as "late(0.1,8)"; raise KeyError for other names."""
        match = _LATE_NAME.fullmatch(name.replace(" ", ""))
        if match is None:
            raise KeyError(name)
        return late_loss(float(match["share"]), float(match["delay"]))


# Each constant gives an `efficiency` of 95 %, for the truncated loss 99 %.
_BUILT_IN = (
    Loss(
        "huber", 1.345, _huber, _huber_weight, "Huber's convex loss: a gross error has no more influence than 1.3 sigma"
    ),
    Loss("cauchy", 2.385, _cauchy, _cauchy_weight, "Cauchy's loss: the larger an error, the smaller its influence"),
    Loss("truncated", 3.368, _truncated, _truncated_weight, "least squares without rows beyond 3.4 sigma", flat=True),
    Loss(
        "late",
        2.328,
        _late,
        _late_weight,
        "reduces the weight of ranges and arrivals that are too long: blocked paths",
        one_sided=True,
    ),
)
LOSSES: Registry[Loss] = Registry(
    "optloc.losses", lambda value: isinstance(value, Loss), {loss.name: loss for loss in _BUILT_IN}, _NamedLosses
)
"""Losses by name, each a stage of a method: Huber 1964; Holland, Welsch 1977; Blake, Zisserman 1987; Cauchy one-sided.

``LOSSES["late(0.1,8)"]`` is ``late_loss(0.1, 8.0)``. To add a loss, add an entry here, or declare an entry point of the
group ``optloc.losses`` in another package.
"""

"""Robust losses: how much a residual costs, and how much its row then counts."""

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
    """A loss of residuals u in standard deviations; near zero it is u², far away it grows more slowly.

    Parameters
    ----------
    name : str
        Also the name of the solver stage.
    constant : float
        Where it leaves u². They are tuned so that the mean square error of an estimate from clean Gaussian data is that
        of least squares divided by 0.95; that of the truncated loss by 0.99, as with few rows one that is cut off
        without need costs more than that.
    cost : callable of (u, constant)
        rho(u).
    importance : callable of (u, constant)
        The weight psi(u) / u with psi = rho' / 2: in [0, 1], not rising with abs(u).
    summary : str
        One line for listings.
    one_sided : bool
        Whether only positive residuals are doubted. Residuals of either sign of other kinds are then given as abs(u).
    flat : bool
        Whether all gross errors cost the same: how many there are is then evidence, and it takes a loss that still
        rises to lead the way to its minima.
    """

    name: str
    constant: float
    cost: Callable[[Array, float], Array]
    importance: Callable[[Array, float], Array]
    summary: str = ""
    one_sided: bool = False
    flat: bool = False

    def rho(self, u: Array) -> Array:
        """Return the cost of residuals u, in sigma, elementwise: u² for small ones."""
        return self.cost(np.asarray(u, dtype=float), self.constant)

    def weight(self, u: Array) -> Array:
        """Return the weights in [0, 1] of residuals u, in sigma, elementwise; least squares with them has their psi."""
        return self.importance(np.asarray(u, dtype=float), self.constant)

    @property
    def psi_squared(self) -> float:
        """Return E psi(u)² for a standard normal u."""
        return _moments(self)[0]

    @property
    def slope(self) -> float:
        """Return E psi'(u) for a standard normal u; by parts it is E u psi(u), which steps of psi leave valid."""
        return _moments(self)[1]

    @property
    def mean_weight(self) -> float:
        """Return the expected weight of a standard normal u."""
        return _moments(self)[2]

    @property
    def efficiency(self) -> float:
        """Return the mean square error of least squares over that of this loss, for clean Gaussian data.

        P. J. Huber, "Robust Statistics" (1981), eq. 3.2.13: (E psi')² / E psi².
        """
        return self.slope**2 / self.psi_squared

    @property
    def spread(self) -> float:
        """Return by what the inverse of the weighted normal matrix is multiplied for a covariance.

        The covariance of an M-estimate is E psi² / (E psi')² times the inverse normal matrix of least squares (Huber
        1981, eq. 7.6.2); the expected weight turns the weighted normal matrix into that one.
        """
        return self.psi_squared * self.mean_weight / self.slope**2


# Nodes of Gauss and Legendre between two kinks, and where the density (e^-72) ends: more of either changes no digit.
_NODES, _REACH = 60, 12.0


@lru_cache
def _moments(loss: Loss) -> tuple[float, float, float]:
    """Return the expected psi², u psi and weight of a standard normal u, by quadrature between the kinks."""
    node, share = np.polynomial.legendre.leggauss(_NODES)
    # Between the kinks at 0 and at the constant everything is smooth; at 6 sigma a panel ends, so that nodes are dense
    # where the density is.
    ends = np.array([-_REACH, -6.0, -loss.constant, 0.0, loss.constant, 6.0, _REACH])
    half, middle = 0.5 * np.diff(ends)[:, None], 0.5 * (ends[1:] + ends[:-1])[:, None]
    u = middle + half * node
    density = half * share * np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi)
    weight = loss.weight(u)
    return tuple(float((density * value).sum()) for value in ((weight * u) ** 2, weight * u**2, weight))  # type: ignore[return-value]


def _huber(u: Array, c: float) -> Array:
    return np.where(np.abs(u) <= c, u**2, 2.0 * c * np.abs(u) - c**2)


def _huber_weight(u: Array, c: float) -> Array:
    return np.asarray(c / np.maximum(np.abs(u), c))


def _cauchy(u: Array, c: float) -> Array:
    return np.asarray(c**2 * np.log1p((u / c) ** 2))


def _cauchy_weight(u: Array, c: float) -> Array:
    return np.asarray(1.0 / (1.0 + (u / c) ** 2))


def _truncated(u: Array, c: float) -> Array:
    return np.asarray(np.minimum(u**2, c**2))


def _truncated_weight(u: Array, c: float) -> Array:
    return np.asarray(1.0 * (np.abs(u) <= c))


def _late(u: Array, c: float) -> Array:
    return np.where(u > 0.0, _cauchy(u, c), u**2)


def _late_weight(u: Array, c: float) -> Array:
    return _cauchy_weight(np.maximum(u, 0.0), c)


# Late rows as a share of all with delays that are exponential: a loss for every share and mean delay.

LATE = frozenset(("range", "toa", "range_sum"))
"""Kinds that a blocked path makes too long: they grow with every path they hold. A difference may be off either way."""

# How a loss of late rows is spelled: the share of them, and the mean delay in sigma.
_SPELLED = re.compile(r"late\((?P<share>[0-9.eE+-]+),(?P<delay>[0-9.eE+-]+)\)")
# Where psi over u is its limit, and the step of the difference that is the limit: far above rounding of a logarithm.
_ZERO, _STEP = 1e-6, 1e-3


@lru_cache(maxsize=256)
def late_loss(share: float, delay: float) -> Loss:
    """Return the loss of rows of which a share is late, by delays that are exponential.

    The residual of a row in its sigma is normal, plus a delay with the probability `share`: its density is
    (1 - p) phi(u) + p g(u) with g that of an exponential and a normal variable together (Grushka 1972, equation 5), and
    the loss is twice its negative logarithm above its mode, which is some hundredths of sigma above zero. What is
    early costs its square.

    Parameters
    ----------
    share : float
        Probability of a row to be late, between 0 and 1.
    delay : float
        Mean delay of those, standard deviations.

    Raises
    ------
    InvalidProblem
        For a share that is none, or a delay that is not positive.
    """
    name = f"late({share:.4g},{delay:.4g})"
    if not 0.0 < share < 1.0 or not 0.0 < delay < np.inf:
        advice = "write the share of late rows and their mean delay in sigma, such as late(0.1,8)"
        raise InvalidProblem(f"there is no loss {name}", "method", advice)
    mode = _mode(share, delay)
    least = _late_density(np.array(mode), share, delay)[0]
    curvature = float(_late_density(np.array(mode + _STEP), share, delay)[1]) / _STEP

    def cost(u: Array, _: float) -> Array:
        here = _late_density(np.maximum(u, 0.0) + mode, share, delay)[0]
        return np.where(u > 0.0, np.maximum(2.0 * (least - here), 0.0), u**2)

    def importance(u: Array, _: float) -> Array:
        psi = _late_density(np.maximum(u, 0.0) + mode, share, delay)[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = np.where(u > _ZERO, psi / u, curvature)
        return np.where(u > 0.0, np.clip(weight, 0.0, 1.0), 1.0)

    summary = f"a share of {share:.2g} late by {delay:.2g} sigma on average"
    # Where a row is as likely late as not the loss leaves the square; quadratures need no more of it.
    grid = np.linspace(0.5, 8.0, 151)
    kink = float(grid[int(np.argmin(np.abs(importance(grid, 0.0) - 0.5)))])
    return Loss(name, kink, cost, importance, summary, one_sided=True)


def _late_density(u: Array, share: float, delay: float) -> tuple[Array, Array]:
    """Return the logarithm of the density of rows some of which are late, and the negative of its derivative."""
    from scipy.special import log_ndtr

    late = np.log(share / delay) + 0.5 / delay**2 - u / delay + log_ndtr(u - 1.0 / delay)
    prompt = np.log1p(-share) - 0.5 * u**2 - _LOG_ROOT
    density = np.logaddexp(late, prompt)
    chance = np.exp(late - density)
    # derivative of the logarithm of the normal distribution: its hazard
    hazard = np.exp(-0.5 * (u - 1.0 / delay) ** 2 - _LOG_ROOT - log_ndtr(u - 1.0 / delay))
    return density, (1.0 - chance) * u + chance * (1.0 / delay - hazard)


_LOG_ROOT = 0.5 * float(np.log(2.0 * np.pi))


def _mode(share: float, delay: float) -> float:
    """Return where the density of rows some of which are late is largest, by bisection."""
    low, high = 0.0, 1.0 + 2.0 * delay
    for _ in range(60):  # down to rounding
        middle = 0.5 * (low + high)
        rising = float(_late_density(np.array(middle), share, delay)[1]) < 0.0
        low, high = (middle, high) if rising else (low, middle)
    return 0.5 * (low + high)


class _Spelled(dict[str, Loss]):
    """Losses that are made of what their name says."""

    def __missing__(self, name: str) -> Loss:
        found = _SPELLED.fullmatch(name.replace(" ", ""))
        if found is None:
            raise KeyError(name)
        return late_loss(float(found["share"]), float(found["delay"]))


# Each constant is where `efficiency` says 95 %, for the truncated loss 99 %.
_OWN = (
    Loss("huber", 1.345, _huber, _huber_weight, "Huber's convex loss: gross errors pull no harder than 1.3 sigma"),
    Loss("cauchy", 2.385, _cauchy, _cauchy_weight, "Cauchy's loss: the larger an error the less it pulls"),
    Loss("truncated", 3.368, _truncated, _truncated_weight, "least squares without the rows 3.4 sigma off", flat=True),
    Loss(
        "late",
        2.328,
        _late,
        _late_weight,
        "doubts ranges and arrivals that are too long: blocked paths",
        one_sided=True,
    ),
)
LOSSES: Registry[Loss] = Registry(
    "optloc.losses", lambda value: isinstance(value, Loss), {loss.name: loss for loss in _OWN}, _Spelled
)
"""Losses by name, each a stage of a method: Huber 1964; Holland, Welsch 1977; Blake, Zisserman 1987; Cauchy one-sided.

``LOSSES["late(0.1,8)"]`` is that of `late_loss`. Add one with one entry, or from another package with an entry point of
``optloc.losses``.
"""

"""Noise that follows from signals: how well delays and gains can be measured at a signal-to-noise ratio.

A Gaussian signal with a flat spectrum from zero to W (rad/s) is recorded for T seconds at stations i with ratios rho_i
of its power to that of independent white noise in the band; P is the sum of the rho_i. With the covariance I + v v' of
the stations at each frequency, v_i = sqrt(rho_i) exp(-j w tau_i), the Fisher information of the delays is

    T W^3 / (3 pi (1 + P)) (P diag(rho) - rho rho'),

and that of the logarithms of the amplitudes, from which the delays' is separate,

    T W / (pi (1 + P)) (P diag(rho) + (1 - P) / (1 + P) rho rho').

What is common to all stations drops out of differences, and the errors of the differences are those of independent
errors of the stations, of variance 3 pi (1 + P) / (T W^3 P rho_i) and pi (1 + P) / (T W P rho_i). At equal ratios the
first is the paper's equation 31. The paper's equation 38 has less, as it takes the signal's level and the gain of the
reference for known.

Sources: W. R. Hahn, S. A. Tretter, "Optimum processing for delay-vector estimation in passive signal arrays", IEEE
Trans. Information Theory 19 (1973); K. C. Ho, M. Sun, "Passive source localization using time differences of arrival
and gain ratios of arrival", IEEE Trans. Signal Processing 56 (2008); P. Stoica, R. Moses, "Spectral Analysis of
Signals" (2005), appendix B (information of Gaussian data).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import SPEED_OF_LIGHT
from optloc.models import MODELS

# What a station's own error does to a row: of a gain ratio r_a / r_b, whose logarithm is that of A_b less that of A_a.
_RATIO = (-1, 1)


@dataclass(frozen=True)  # without slots: what follows from it is kept beside it
class Signal:
    """A signal as stations receive it, from which the noise of time differences and gain ratios follows.

    Parameters
    ----------
    snr : array (s,)
        Signal-to-noise ratio of power at each station, within the band; NaN for a station that does not take part.
    bandwidth : float
        Hertz, from zero up. Of a signal of bandwidth B about a carrier whose phase is not used it is half of B, and
        `duration` twice as long: both sidebands count.
    duration : float
        Seconds that are integrated for one measurement.
    reference : int, optional
        Station whose gain is known beside the level of the signal, as in the paper; None: neither is.
    speed : float
        Of propagation, metres per second.

    Raises
    ------
    InvalidProblem
        For numbers that are not positive, and fewer than two stations.
    """

    snr: Array
    bandwidth: float
    duration: float
    reference: int | None = None
    speed: float = SPEED_OF_LIGHT

    def __post_init__(self) -> None:
        snr = np.array(self.snr, dtype=float)
        if snr.ndim != 1 or np.isfinite(snr).sum() < 2:
            raise InvalidProblem(f"snr has shape {snr.shape}", "snr", "give one for each station, two or more")
        if (snr[np.isfinite(snr)] <= 0.0).any() or np.isinf(snr).any():
            raise InvalidProblem("a signal-to-noise ratio is not positive", "snr", "give ratios of power, not decibels")
        for name, value in (("bandwidth", self.bandwidth), ("duration", self.duration), ("speed", self.speed)):
            if not 0.0 < value < np.inf:
                raise InvalidProblem(f"it is {value}", name, "give a positive number")
        if self.reference is not None and not (0 <= self.reference < len(snr) and np.isfinite(snr[self.reference])):
            what = f"there is no station {self.reference} with a signal"
            raise InvalidProblem(what, "reference", "name one that has one")
        object.__setattr__(self, "snr", snr)

    @property
    def _factor(self) -> Array:
        """Return pi (1 + P) / (T W P rho) of each station, (s,)."""
        total = np.nansum(self.snr)
        return np.asarray(np.pi * (1.0 + total) / (self.duration * self._band * total * self.snr))

    @property
    def _band(self) -> float:
        return 2.0 * np.pi * self.bandwidth

    @property
    def arrival_sigma(self) -> Array:
        """Return the standard deviation of each station's arrival (s,), metres: differences have their errors."""
        return np.asarray(self.speed * np.sqrt(3.0 * self._factor) / self._band)

    @cached_property
    def _levels(self) -> Array:
        """Return the covariance (s, s) of the logarithms of the amplitudes, but for what is common to all."""
        levels = np.diag(self._factor)
        if self.reference is None:
            return levels
        # The inverse of the information without the reference, by Sherman and Morrison.
        total, own = np.nansum(self.snr), self.snr[self.reference]
        ratio = (1.0 - total) / (1.0 + total) / total
        levels -= np.pi * (1.0 + total) / (self.duration * self._band * total) * ratio / (1.0 + ratio * (total - own))
        levels[self.reference] = levels[:, self.reference] = 0.0
        return levels

    def covariance(self, kind: str, a: Array, b: Array) -> Array:
        """Return the covariance (g, r, r) of groups of rows of one epoch and target.

        Parameters
        ----------
        kind : str
            "tdoa", "toa" or "groa".
        a, b : int array (g, r)
            Stations of each row.

        Returns
        -------
        array (g, r, r)
            Square metres, or of ratios: their relative errors times the ratio of the amplitudes, as `snr` tells it.

        Raises
        ------
        InvalidProblem
            For another kind, and a row of a station without a signal.
        """
        model = MODELS[kind]
        ratio = kind == "groa"
        # what is common to all stations, the emission, must drop out of the rows
        if not ratio and not model.emission and model.ranges != (1, -1):
            raise InvalidProblem(f"{kind} is neither a time difference nor a gain ratio", "signal", "give sigma")
        own = self._levels if ratio else np.diag(self.arrival_sigma**2)
        signs = _RATIO if model.ranges is None else model.ranges
        ends = [(index, sign) for index, sign in zip((a, b), signs, strict=True) if sign]
        covariance = np.zeros((*a.shape, a.shape[-1]))
        for one, first in ends:
            for two, second in ends:
                covariance = covariance + first * second * own[one[..., :, None], two[..., None, :]]
        if ratio:
            size = np.sqrt(self.snr[b] / self.snr[a])
            covariance = covariance * size[..., :, None] * size[..., None, :]
        if not np.isfinite(covariance).all():
            raise InvalidProblem(f"a {kind} row names a station without a signal", "snr", "give its ratio")
        return covariance

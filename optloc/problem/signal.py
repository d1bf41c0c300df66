"""Noise from signals: the accuracy of measured delays and gains at a given signal-to-noise ratio.

A Gaussian signal with a flat spectrum from zero to W (rad/s) is recorded for T seconds at stations i. At each station
the noise in the band is independent and white. rho_i is the ratio of signal power to noise power, P the sum of the
rho_i, and tau_i the delay in seconds. At each frequency w the covariance of the stations is I + v v' with
v_i = sqrt(rho_i) exp(-j w tau_i), where j is the imaginary unit. The Fisher information of the delays is

    T W^3 / (3 pi (1 + P)) (P diag(rho) - rho rho').

The Fisher information of the logarithms of the amplitudes, which is independent of the delays, is

    T W / (pi (1 + P)) (P diag(rho) + (1 - P) / (1 + P) rho rho').

An error that all stations share cancels in differences. The errors of the differences are therefore equal to
differences of independent station errors. The variance of these errors is 3 pi (1 + P) / (T W^3 P rho_i) for delays and
pi (1 + P) / (T W P rho_i) for log-amplitudes. At equal ratios the first is equation 31 of "Error registration of
multiple moving observers by TDOA and GROA", Journal of Electronics & Information Technology 39 (2017). Equation 38 of
that paper is smaller, because it assumes that the level of the signal and the gain of the reference are known.

Sources: W. R. Hahn, S. A. Tretter, "Optimum processing for delay-vector estimation in passive signal arrays", IEEE
Trans. Information Theory 19 (1973); K. C. Ho, M. Sun, "Passive source localization using time differences of arrival
and gain ratios of arrival", IEEE Trans. Signal Processing 56 (2008); P. Stoica, R. Moses, "Spectral Analysis of
Signals" (2005), appendix B (information of Gaussian data).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.cached import cached_property
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import SPEED_OF_LIGHT
from optloc.models import MODELS

# Signs with which the log-amplitude errors of stations a and b enter a gain ratio r_a / r_b: log A_b - log A_a.
_RATIO = (-1, 1)


@dataclass(frozen=True)  # without slots, because a cached property needs `__dict__`
class Signal:
    """A signal as received by the stations. It determines the noise of time differences and gain ratios.

    Parameters
    ----------
    snr : array (s,)
        Signal-to-noise ratio (power) at each station within the band; NaN for a station that does not take part.
    bandwidth : float
        Width of the band from zero, Hertz. If the signal has bandwidth B around a carrier whose phase is not used, give
        B / 2, and double `duration`, because both sidebands count.
    duration : float
        Integration time of one measurement, seconds.
    reference : int, optional
        Station whose gain is known, together with the level of the signal. None: both are unknown.
    speed : float
        Propagation speed, metres per second.

    Raises
    ------
    InvalidProblem
        For numbers that are not positive, and for fewer than two stations.
    """

    snr: Array
    bandwidth: float
    duration: float
    reference: int | None = None
    speed: float = SPEED_OF_LIGHT

    def __post_init__(self) -> None:
        """Check all fields, and store the ratios as a float array."""
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
            raise InvalidProblem(what, "reference", "name a station with a signal")
        object.__setattr__(self, "snr", snr)

    @property
    def _factor(self) -> Array:
        """Return the variance of the log-amplitude of each station (s,), pi (1 + P) / (T W P rho), without a unit."""
        total = np.nansum(self.snr)
        return np.asarray(np.pi * (1.0 + total) / (self.duration * self._band * total * self.snr))

    @property
    def _band(self) -> float:
        """Return the bandwidth W, radians per second."""
        return 2.0 * np.pi * self.bandwidth

    @property
    def arrival_sigma(self) -> Array:
        """Return the standard deviation of the arrival at each station (s,), metres, for use in differences."""
        return np.asarray(self.speed * np.sqrt(3.0 * self._factor) / self._band)

    @cached_property
    def _levels(self) -> Array:
        """Return the covariance (s, s) of the log-amplitudes, without the error that all stations share.

        With a reference station, the row and the column of this station are zero.
        """
        levels = np.diag(self._factor)
        if self.reference is None:
            return levels
        # Inverse of the information without the reference station, by the Sherman-Morrison formula.
        total, snr_of_reference = np.nansum(self.snr), self.snr[self.reference]
        ratio = (1.0 - total) / (1.0 + total) / total
        levels -= (
            np.pi
            * (1.0 + total)
            / (self.duration * self._band * total)
            * ratio
            / (1.0 + ratio * (total - snr_of_reference))
        )
        levels[self.reference] = levels[:, self.reference] = 0.0
        return levels

    def covariance(self, kind: str, a: Array, b: Array) -> Array:
        """Return the covariance (g, r, r) of groups of rows. Each group is of one epoch and target.

        Parameters
        ----------
        kind : str
            "tdoa", "toa" or "groa".
        a, b : int array (g, r)
            Stations of each row.

        Returns
        -------
        array (g, r, r)
            In square metres for times. For gain ratios, relative errors times the amplitude ratio that `snr` implies.

        Raises
        ------
        InvalidProblem
            For another kind, and for a row of a station without a signal.
        """
        model = MODELS[kind]
        ratio = kind == "groa"
        # An error that all stations share must cancel: in the row, or in its unknown emission time.
        if not ratio and not model.emission and model.ranges != (1, -1):
            raise InvalidProblem(f"{kind} is neither a time difference nor a gain ratio", "signal", "give sigma")
        by_station = self._levels if ratio else np.diag(self.arrival_sigma**2)
        signs = _RATIO if model.ranges is None else model.ranges
        ends = [(index, sign) for index, sign in zip((a, b), signs, strict=True) if sign]
        covariance = np.zeros((*a.shape, a.shape[-1]))
        for one, first in ends:
            for two, second in ends:
                covariance = covariance + first * second * by_station[one[..., :, None], two[..., None, :]]
        if ratio:
            amplitude_ratio = np.sqrt(self.snr[b] / self.snr[a])
            covariance = covariance * amplitude_ratio[..., :, None] * amplitude_ratio[..., None, :]
        if not np.isfinite(covariance).all():
            raise InvalidProblem(f"a {kind} row names a station without a signal", "snr", "give its ratio")
        return covariance

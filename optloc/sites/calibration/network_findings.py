"""Findings of a self-calibrated network: status, condition and sentences, each with the next step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.engine import STRAIGHT
from optloc.problem import Array, Status
from optloc.sites.calibration.blocks import StationBlock
from optloc.sites.calibration.gauge import GaugeRank
from optloc.sites.calibration.multi_start import AGREEING, NetworkSearchResult
from optloc.sites.calibration.network import Network
from optloc.solvers import P_MISFIT, Finding

# Largest share of pulses with two possible positions. More of them have many combinations of sides, and the cheapest
# combination can give a wrong shape of the stations. At 3 cm noise, flat stations appear 0.1 to 0.3 m thick.
_TWOFOLD = 0.5
# For smaller cost gaps the sentence is "fits equally well": more zeros would not help a reader.
_ALIKE = 1e-3
# Standard deviations between the two sides of a suggested prior: the wrong side costs 25 more: it is not listed.
_SIDES = 5.0


def _open_words(net: Network, rank: GaugeRank) -> str:
    """Return a sentence about motions that the measurements do not determine, with the stations that move most."""
    m, d = net.stations, net.dimension
    share = np.sqrt((rank.open[: m * d] ** 2).sum(axis=1).reshape(m, d).sum(axis=1))
    if not net.synchronised:
        share = np.hypot(share, np.sqrt((rank.open[m * d :] ** 2).sum(axis=1)))
    largest = [net.names[i] for i in np.argsort(-share, kind="stable")[:3]]
    count = rank.open.shape[1]
    return (
        f"The measurements do not determine {count} motion{'s' if count > 1 else ''} of the network, mostly of "
        f"{', '.join(largest)}; add pulses outside their plane, distances between stations, or known positions."
    )


def gap_words(gap: float) -> str:
    """Return the words on a rival network whose cost is larger by `gap`: "fits equally well", or its cost."""
    return "fits equally well" if gap < _ALIKE else f"raises chi-square by {gap:.2g}"


def rival_words(what: str, gap: float) -> str:
    """Return the sentence on another network that fits the data; `what` is the difference, and `gap` its cost."""
    name = f"{what[0].upper()}{what[1:]}"
    return f"{name} {gap_words(gap)}, so the data do not decide between the networks; add pulses or known positions."


def mirror_words(net: Network, stations: Array, image: Array, gap: float) -> str:
    """Return the sentence on a mirror image that known positions do not exclude, with the line that excludes it.

    `stations` and `image` (M, d) are the positions in the network and in its mirror image, m; `gap` is the cost of the
    image. The line is for the station and the coordinate that differ most, among the unknown ones.
    """
    apart = np.abs(stations - image)
    unknown = ~np.isfinite(net.place_sigma)
    apart[~unknown] *= float(not unknown.any())
    i, c = np.unravel_index(int(apart.argmax()), apart.shape)
    here, there, axis, name = stations[i, c], image[i, c], "xyz"[c], net.names[i]
    line = f'{{ name = "{name}", {axis} = {here:.4g}, sigma = {apart[i, c] / _SIDES:.2g} }}'
    return (
        f"The mirror image {gap_words(gap)}; state in the file on which side {name} is: {line} as here, or "
        f"{axis} = {there:.4g} as in the mirror image."
    )


def _curved_words(far: float) -> str:
    """Return a sentence about a covariance that is not valid; `far` is the result of `departure`."""
    words = f"three standard deviations away, the rise of the cost is wrong by a factor of up to {np.exp(far):.2g}"
    return f"The covariance does not cover the error: {words}; add pulses."


@dataclass(frozen=True, slots=True)
class NetworkFacts:
    """The quantities that decide the status of a network.

    Parameters
    ----------
    net, found, motions : Network, NetworkSearchResult, GaugeRank
        The network, its search, and its determined and open motions.
    p : float
        Probability of residuals at least as large (chi-square).
    sides : tuple of str
        Sentences about stations, or pulses, in one plane.
    departure : float
        See `optloc.sites.calibration.gauge.departure`; NaN if a motion is open.
    blocks : tuple of StationBlock
        Stations and pulses with their proofs.
    elsewhere : tuple of (str, float)
        Difference and cost gap of networks with other stations that fit about equally well.
    twofold : bool array (N,)
        Pulses without a unique position.
    mirror : str
        Sentence on a mirror image that fits about equally well; empty without one.
    """

    net: Network
    found: NetworkSearchResult
    motions: GaugeRank
    p: float
    sides: tuple[str, ...]
    departure: float
    blocks: tuple[StationBlock, ...]
    elsewhere: tuple[tuple[str, float], ...]
    twofold: Array
    mirror: str = ""

    @property
    def refuted(self) -> list[str]:
        """Return the names of blocks that have a lower cost at another position."""
        return [block.name for block in self.blocks if block.refuted]

    @property
    def unproven(self) -> list[str]:
        """Return the names of blocks without a proof; for a pulse, another position may have the same cost."""
        return [block.name for block in self.blocks if not (block.proven if block.station else block.cheapest)]


NETWORK_FINDINGS = (
    Finding(Status.SINGULAR_GEOMETRY, lambda e: e.motions.open.shape[1], lambda e: [_open_words(e.net, e.motions)]),
    Finding(Status.AMBIGUOUS, lambda e: e.sides, lambda e: e.sides),
    Finding(Status.AMBIGUOUS, lambda e: e.mirror, lambda e: [e.mirror]),
    Finding(Status.CURVED, lambda e: e.departure > STRAIGHT, lambda e: [_curved_words(e.departure)]),
    Finding(
        Status.MISFIT,
        lambda e: e.p < P_MISFIT,
        lambda e: [f"The residuals exceed the stated noise: p = {e.p:.2g}; check sigma and unit, or try --robust."],
    ),
    Finding(
        Status.AMBIGUOUS,
        lambda e: e.elsewhere,
        lambda e: [rival_words(what, gap) for what, gap in e.elsewhere],
    ),
    Finding(
        Status.AMBIGUOUS,
        lambda e: e.twofold.mean() > _TWOFOLD,
        lambda e: [
            f"{e.twofold.sum()} of {len(e.twofold)} pulses have no unique position; add stations off their plane."
        ],
    ),
    Finding(
        Status.UNPROVEN,
        lambda e: e.refuted,
        lambda e: [
            f"With all others fixed, another position costs less: {shorten(e.refuted)}; change --seed, or add pulses."
        ],
    ),
    Finding(
        Status.UNPROVEN,
        lambda e: e.unproven and not e.refuted,
        lambda e: [f"No proof excludes another position of {shorten(e.unproven)}; check distances by hand."],
    ),
    Finding(
        Status.SEARCHED,
        lambda e: e.found.agreeing < AGREEING,
        lambda e: [
            f"Only {e.found.agreeing} of {e.found.made} starts reached this network; {AGREEING} must agree; add pulses."
        ],
    ),
)
"""Findings of a network: status, condition and sentences; the first that applies sets the status."""


def shorten(names: list[str]) -> str:
    """Return at most three names as text, then the number of others."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")

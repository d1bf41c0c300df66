"""Explanations of contradictory data: the suspects that were left out, and the fix of the remaining data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from optloc.base.types import Array

GroupKind = Literal["station", "row", "prior", "offset"]


@dataclass(frozen=True, slots=True)
class Suspect:
    """A station, row, prior or offset that was left out of a fix because it contradicts the other data.

    Parameters
    ----------
    name : str
        A phrase, for instance "station S3" or "prior of position[2]".
    group : "station", "row", "prior" or "offset"
        The part that was left out: all rows of a station, one measurement, a prior, or an offset that all ranges of a
        kind received.
    rows : tuple of int
        Global numbers of its rows; empty for a prior.
    error : array (q,)
        Estimated error: measured minus true value. If the rows combine arrivals, it is the error of the station's
        arrival time, times c (positive: late). Otherwise there is one error for each of `rows`, or for each coordinate
        of the prior mean. Metres, radians (clockwise for compass bearings) or ratios.
    sigma : array (q,)
        Standard deviations of `error`; infinite if no other data determine the error.
    p_with : float
        P-value of the fit that includes this suspect and leaves out the others; NaN without redundancy.
    p_without : float
        P-value of the fit without any of the suspects.
    """

    name: str
    group: GroupKind
    rows: tuple[int, ...]
    error: Array
    sigma: Array
    p_with: float
    p_without: float


@dataclass(frozen=True, slots=True)
class Explanation:
    """One way to explain contradictory data: the suspects to leave out, and the fit to the rest.

    Parameters
    ----------
    suspects : tuple of Suspect
        The suspects that were left out; empty if the complete data agree as well as the rest.
    x : array (size,)
        Parameter vector of the fit to the rest, in the order of the problem's layout.
    cost : float
        Weighted sum of squared residuals of this fit.
    dof : int
        Degrees of freedom of this fit.
    p_value : float
        Chi-square probability of this fit; NaN without redundancy.
    score : float
        The cost plus a penalty for each suspect, 16 for one row. The weight of an explanation is exp(-score / 2): a low
        score is a likely explanation.
    """

    suspects: tuple[Suspect, ...]
    x: Array
    cost: float
    dof: int
    p_value: float
    score: float = float("nan")

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the suspects."""
        return tuple(suspect.name for suspect in self.suspects)

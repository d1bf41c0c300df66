"""Explanations of data that contradict each other: what was left out, and what remains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from optloc.base.types import Array

GroupKind = Literal["station", "row", "prior", "offset"]


@dataclass(frozen=True, slots=True)
class Suspect:
    """Something that was left out of a fix because it contradicts the rest.

    Parameters
    ----------
    name : str
        In words, for instance "station S3" or "prior of position[2]".
    group : "station", "row", "prior" or "offset"
        What was left out: all rows of a station, one measurement, or a prior; or the offset that all lengths of a kind
        were given.
    rows : tuple of int
        Global numbers of the rows it takes part in; empty for a prior.
    error : array (q,)
        Estimated error, measured less true: of the station's arrival time times c (positive: late) where the rows
        combine arrivals, else of each of `rows`; of each coordinate of a prior's mean. Metres, radians (clockwise of
        compass bearings) or ratios.
    sigma : array (q,)
        Standard deviations of `error`; infinite where nothing else tells how large it is.
    p_with : float
        Chi-square probability of the fit that has this back in and leaves the other suspects out; NaN without
        redundancy.
    p_without : float
        The same of the fit that leaves all suspects out.
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
    """One way to explain data that contradict each other: who to leave out, and what remains.

    Parameters
    ----------
    suspects : tuple of Suspect
        What was left out; nobody, where all data agree as well as the rest does.
    x : array (size,)
        Parameter vector of the fix to the rest, in the order of the problem's layout.
    cost : float
        Its weighted sum of squared residuals.
    dof : int
        Its degrees of freedom.
    p_value : float
        Its chi-square probability; NaN without redundancy.
    score : float
        The cost and a price for each suspect, 16 for one row: explanations weigh as exp(-score / 2).
    """

    suspects: tuple[Suspect, ...]
    x: Array
    cost: float
    dof: int
    p_value: float
    score: float = float("nan")

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of its suspects."""
        return tuple(suspect.name for suspect in self.suspects)

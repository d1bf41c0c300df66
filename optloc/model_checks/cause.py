"""The value `Advice`: a possible cause of a status, and the change of the input that a user can make."""

from __future__ import annotations

from dataclasses import dataclass

CAUSES = (
    "offset",
    "sign-station",
    "scale",
    "drift",
    "swapped",
    "period",
    "outlier",
    "outliers",
    "noise",
    "unit",
    "coordinate-unit",
    "compass",
    "anticlockwise",
    "opposite",
    "sign",
    "speed",
    "late",
    "height",
    "declination",
    "reference",
    "lat-lon",
    "moved",
)
"""Causes of a misfit that compete in one score; see `optloc.advice`."""


@dataclass(frozen=True, slots=True)
class Advice:
    """A possible reason why a fix is not `ok`, and the remedy.

    Parameters
    ----------
    cause : str
        A keyword for programs: one of `CAUSES`; "step" or "burst", an error that starts within a run; "impossible",
        "constraint", "size", "slant" or "wrap", a value that no position has; or "plane", "line", "mirror" or
        "redundancy", a limit of the geometry.
    seen : str
        The observation, a sentence without its full stop.
    advice : str
        The remedy, a sentence without its full stop.
    toml : str
        Lines of a problem file for the remedy. Put them at the end of the file; put keys into `[[measurements]]`. Empty
        if the remedy needs no lines.
    option : str
        The option of the command line for the remedy. Empty if no option is enough.
    station : tuple of str
        Names of the stations with the error; empty for an error of all stations.
    members : tuple of int
        Numbers of the rows with the error, from zero; empty for an error of all rows of the stations.
    value : tuple of float
        Estimates of the parameters of the error, SI units and radians.
    cost : float
        Chi-square of the data after the remedy. NaN if the remedy was not tried.
    gap : float
        Difference of the scores of this cause and of the best other cause; negative if another cause is better.
        NaN without a score.
    p : float
        Probability of a larger chi-square after the remedy, if the cause is right. NaN if the remedy was not tried.
    """

    cause: str
    seen: str
    advice: str
    toml: str = ""
    option: str = ""
    station: tuple[str, ...] = ()
    members: tuple[int, ...] = ()
    value: tuple[float, ...] = ()
    cost: float = float("nan")
    gap: float = float("nan")
    p: float = float("nan")

"""What is known of false rows from how many there are in a channel."""

from __future__ import annotations

import numpy as np

from optloc.errors import InvalidProblem
from optloc.problem import Problem
from optloc.track.sets import Clutter
from optloc.types import Array, Rows


def evenly(problem: Problem, detection: float, false: float) -> Clutter:
    """Return the density of false rows that lie anywhere a true one can: as many in each channel, spread evenly.

    Parameters
    ----------
    problem : Problem
        Differences of ranges lie between plus and minus the stations' distance, azimuths in the full circle,
        elevations in half of it.
    detection : float
        Probability that an emitter is seen in a channel.
    false : float
        Mean number of false rows of a channel and epoch, above 0.

    Raises
    ------
    InvalidProblem
        For kinds without bounds, and numbers out of range.
    """
    if not 0.0 < false < np.inf:
        raise InvalidProblem(f"{false} false rows in a channel", "false", "give a mean number above 0")
    density = {block.kind: float(false / np.mean(_width(problem, block))) for block in problem.rows if block.count}
    return Clutter(detection, density)


def _width(problem: Problem, block: Rows) -> Array:
    """Return the length of the interval of possible values of each row."""
    if block.kind == "tdoa":
        place = problem.stations.position[..., 0, :, :]
        apart = place[..., block.a, :] - place[..., block.b, :]
        return np.asarray(2.0 * np.sqrt((apart**2).sum(-1)))
    if block.kind in ("azimuth", "elevation"):
        return np.asarray(2.0 * np.pi if block.kind == "azimuth" else np.pi)
    what = f"there is no end to possible values of {block.kind}"
    raise InvalidProblem(what, "false", "give the density of false rows, optloc.several.Clutter")

"""The clock of the emission times of a file: from metres of a problem to seconds on the clock of the arrivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from optloc.base.types import Array, Bias
from optloc.base.units import UNITS
from optloc.files.measurements import RowChunk
from optloc.files.row_epochs import Epochs
from optloc.models.phase_layers import S_TOA
from optloc.problem.forms import form_of

After = Literal["time", "date"]
"""Meaning of the column time of arrivals: values are seconds after it; a date is in seconds since 1970, UTC. With a
time scale, numbers are dates too."""


@dataclass(frozen=True, slots=True)
class EmissionClock:
    """The clock of the arrivals of a file.

    Parameters
    ----------
    speed : array (k,)
        Metres of an emission time in a problem for each second, at each epoch; NaN without arrivals.
    begin : array (k,)
        Seconds to add at each epoch.
    dated : bool
        Whether the sum is a date: seconds since 1970, UTC.
    """

    speed: Array
    begin: Array
    dated: bool

    def seconds(self, emission: Array, sigma: Array, epoch: Array) -> tuple[Array, Array]:
        """Return emission times (n,) and their standard deviations (n,), seconds, from metres at epochs (n,).

        The standard deviation contains the rounding of the time that is added, up to 0.2 microseconds for a date.
        """
        begin = self.begin[epoch]
        return begin + emission / self.speed[epoch], np.hypot(sigma / self.speed[epoch], np.spacing(begin))


def emission_clock(
    chunks: Sequence[RowChunk], index: Sequence[Array], numbers: Sequence[Array], biases: Sequence[Bias], epochs: Epochs
) -> EmissionClock | None:
    """Return the clock of the arrivals of a file; None if they are no times, or if no clock is common to an epoch.

    Parameters
    ----------
    chunks : sequence of RowChunk
        Rows of the file.
    index, numbers : sequence of int array (m,)
        Epoch and global number of the rows of each chunk.
    biases : sequence of Bias
        Biases of the problem. A scale of arrivals changes their clock, so the result is None.
    epochs : Epochs
        The k epochs of the file.
    """
    arrivals = [
        (c, i, n) for c, i, n in zip(chunks, index, numbers, strict=True) if c.kind in ("toa", S_TOA) and len(i)
    ]
    scaled = [bias.row for bias in biases if form_of(bias).enters == "scales"]
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *(number for _, _, number in arrivals)])
    if not arrivals or np.isin(rows, np.concatenate([np.zeros(0, dtype=np.int64), *scaled])).any():
        return None
    if any(chunk.written_unit not in UNITS["time"] for chunk, _, _ in arrivals):
        return None
    if len({chunk.after for chunk, _, _ in arrivals}) > 1:
        return None
    speed, begin = np.full(epochs.count, np.nan), np.zeros(epochs.count)
    for chunk, epoch, _ in arrivals:
        # Arrivals of S waves alone are divided by vp / vs, and so is their emission time.
        share = 1.0 if chunk.combination is None else chunk.combination.rows.factor[:, 0]
        own = np.broadcast_to(chunk.units.speed * share, epoch.shape)
        if (np.isfinite(speed[epoch]) & (np.abs(speed[epoch] / own - 1.0) > 1e-9)).any():
            return None
        speed[epoch] = own
        if chunk.after is not None and chunk.time is not None:
            begin[epoch] = chunk.time
    after = arrivals[0][0].after
    return EmissionClock(speed, begin, after == "date" or (after == "time" and epochs.dated))

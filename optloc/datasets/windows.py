"""What sets of rows that come one after another share: short windows, each one epoch of a free target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.types import Array
from optloc.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True)
class Window:
    """Rows of one short window.

    Parameters
    ----------
    a, b : int array (m,)
        Stations; b is None where a row has one only.
    z : array (m,)
        Measured values less known corrections, SI units.
    covariance : array (m, m)
        Of the rows.
    truth : array (d,)
        True position, metres.
    """

    a: Array
    b: Array | None
    z: Array
    covariance: Array
    truth: Array


@dataclass(frozen=True, slots=True)
class Windows:
    """The stations (s, d), windows, and the problem whose epochs they are."""

    name: str
    stations: Array
    windows: tuple[Window, ...]
    problem: Problem

    @property
    def truth(self) -> Array:
        """Return the true positions (k, d), metres."""
        return np.array([window.truth for window in self.windows])


def along(times: Array, truth: pd.DataFrame) -> Array:
    """Return the true positions (k, d) at some times, linear between those that are known."""
    columns = [c for c in ("x_m", "y_m", "z_m") if c in truth]
    return np.stack([np.interp(times, truth["t_s"], truth[c]) for c in columns], axis=-1)


def cut_windows(rows: pd.DataFrame, times: Array, width: float) -> pd.DataFrame:
    """Return the rows that fall into windows of a width in seconds centred at `times` (k,), with their `window`."""
    # the last window that has begun by then, unless it has ended as well
    window = np.searchsorted(times - width / 2, rows["t_s"].to_numpy(), side="right") - 1
    inside = (window >= 0) & (rows["t_s"].to_numpy() < times[np.maximum(window, 0)] + width / 2)
    return rows.assign(window=window)[inside]

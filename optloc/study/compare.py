"""Two studies side by side, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optloc.errors import InvalidProblem
from optloc.study.columns import VALUES
from optloc.study.table import read_frame

if TYPE_CHECKING:
    import pandas as pd

CELL = ("scenario", "sweep", "noise_label", "method")


@dataclass(frozen=True, slots=True)
class Side:
    """What one study has in a cell.

    Parameters
    ----------
    rows : int
        Number of trials.
    answered : float
        Share with an answer.
    rmse, bound : float
        Root mean square error of the answers and of the Cramer-Rao bound there, metres.
    seconds : float
        Median time of a fix.
    """

    rows: int
    answered: float
    rmse: float
    bound: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Difference:
    """A cell of two studies.

    Parameters
    ----------
    cell : tuple of str
        Scenario, swept values, noise level, method.
    one, two : Side
        The studies.
    same_data : bool
        Whether both solved the same measurements.
    identical : bool
        Whether their values are equal bit for bit.
    z : float
        Difference of the shares of answers in standard deviations; NaN where both are certain.
    """

    cell: tuple[str, ...]
    one: Side
    two: Side
    same_data: bool
    identical: bool
    z: float


def compared(one: Path, two: Path) -> list[Difference]:
    """Return the cells that two studies have in common, by their names.

    Raises
    ------
    InvalidProblem
        Where a folder holds no study, or they have no cell in common.
    """
    frames = [dict(iter(read_frame(folder).groupby(list(CELL), observed=True, sort=False))) for folder in (one, two)]
    common = [cell for cell in frames[0] if cell in frames[1]]
    if not common:
        advice = "compare studies with the same names of scenarios and methods, and the same noise levels"
        raise InvalidProblem("the studies have no cell in common", f"{one} and {two}", advice)
    return [_difference(tuple(map(str, cell)), frames[0][cell], frames[1][cell]) for cell in common]


def _difference(cell: tuple[str, ...], a: pd.DataFrame, b: pd.DataFrame) -> Difference:
    same_data = set(a["data"]) == set(b["data"])
    one, two = _side(a), _side(b)
    pooled = (one.answered * one.rows + two.answered * two.rows) / (one.rows + two.rows)
    spread = np.sqrt(pooled * (1.0 - pooled) * (1.0 / one.rows + 1.0 / two.rows))
    z = (two.answered - one.answered) / spread if spread > 0.0 else np.nan
    return Difference(cell, one, two, same_data, same_data and _identical(a, b), float(z))


def _identical(a: pd.DataFrame, b: pd.DataFrame) -> bool:
    if len(a) != len(b):
        return False
    names = list(VALUES)
    left, right = (f[names].sort_values("trial").reset_index(drop=True).astype(object) for f in (a, b))
    return bool(left.equals(right))


def _side(frame: pd.DataFrame) -> Side:
    answered = frame["answered"].to_numpy(dtype=bool)
    error, bound = (frame[name].to_numpy(dtype=float)[answered] for name in ("error", "crlb"))
    rmse, limit = (float(np.sqrt(np.mean(v**2))) if len(v) else np.nan for v in (error, bound[np.isfinite(bound)]))
    return Side(len(frame), float(answered.mean()), rmse, limit, float(frame["seconds"].median()))

"""What the readers of all sets share: the folder and its tables, checked, and rows cut into windows of one epoch."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.files import read_bytes
from optloc.problem import Array, InvalidProblem, Problem, nearest

if TYPE_CHECKING:
    import pandas as pd

# A variable and no default folder: optloc holds no data, and does not fetch any.
VARIABLE = "OPTLOC_DATA"
XYZ = ("x_m", "y_m", "z_m")


def root(folder: str | Path | None = None) -> Path:
    """Return the folder of all data sets; raise InvalidProblem where there is none."""
    given = os.environ.get(VARIABLE, "") if folder is None else folder
    if not str(given):
        advice = f"set the variable {VARIABLE} to the folder that holds the data sets, or name it by folder="
        raise InvalidProblem("no folder of data sets is known, and optloc holds no data itself", VARIABLE, advice)
    place = Path(given).expanduser()
    if not place.is_dir():
        raise InvalidProblem("there is no such folder", str(place), f"correct {VARIABLE}, or name it by folder=")
    return place


def check_files(folder: Path, sha256: Mapping[str, str]) -> None:
    """Raise InvalidProblem where a file is missing or has another SHA-256."""
    for name, expected in sha256.items():
        path = folder / name
        found = hashlib.sha256(read_bytes(path)).hexdigest()
        if found != expected:
            what = f"this is not the file that is meant: its SHA-256 begins {found[:12]}, not {expected[:12]}"
            raise InvalidProblem(what, str(path), "fetch it again, or read it nonetheless with verify=False")


def table(folder: Path, name: str) -> pd.DataFrame:
    """Return a table of a data set; raise InvalidProblem where it cannot be read."""
    import pandas as pd

    path = folder / f"{name}.csv"
    data = read_bytes(path, lines=True)
    try:
        return pd.read_csv(io.BytesIO(data))
    except ValueError as error:  # what pandas cannot parse is one
        what = f"the table cannot be read ({str(error).partition(chr(10))[0]})"
        raise InvalidProblem(what, str(path), "put the whole data set there") from None


def choose(value: Any, known: Iterable[Any], option: str) -> Any:
    """Return an option's value; raise InvalidProblem where it is none of the known ones."""
    names = list(known)
    if value not in names:
        raise InvalidProblem(f"{value!r} is unknown", option, nearest(str(value), map(str, names)))
    return value


def places(table: pd.DataFrame, columns: Iterable[str] = XYZ) -> Array:
    """Return coordinates (n, d) in metres, of the columns that the table has."""
    return table[[column for column in columns if column in table]].to_numpy(dtype=np.float64)


# Short windows of rows that come one after another, each one epoch of a free target.


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

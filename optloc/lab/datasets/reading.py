"""Common code of all readers: the folder and its checked tables, and the windows that divide rows into epochs."""

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

# The folder is given by an environment variable, and has no default: optloc contains no data and downloads none.
VARIABLE = "OPTLOC_DATA"
XYZ = ("x_m", "y_m", "z_m")


def root(folder: str | Path | None = None) -> Path:
    """Return the folder of all data sets; raise InvalidProblem if it is not set or does not exist."""
    given = os.environ.get(VARIABLE, "") if folder is None else folder
    if not str(given):
        advice = f"set the variable {VARIABLE} to the folder of the data sets, or give the folder as folder="
        raise InvalidProblem("no folder of data sets is set, and optloc contains no data", VARIABLE, advice)
    path = Path(given).expanduser()
    if not path.is_dir():
        raise InvalidProblem("there is no such folder", str(path), f"correct {VARIABLE}, or give the folder as folder=")
    return path


def check_files(folder: Path, sha256: Mapping[str, str]) -> None:
    """Raise InvalidProblem if a file is missing or has another SHA-256."""
    for name, expected in sha256.items():
        path = folder / name
        found = hashlib.sha256(read_bytes(path)).hexdigest()
        if found != expected:
            what = f"this is a different file: its SHA-256 begins with {found[:12]}, not {expected[:12]}"
            raise InvalidProblem(what, str(path), "download it again, or accept it with verify=False")


def table(folder: Path, name: str) -> pd.DataFrame:
    """Return the table `name`.csv of a data set; raise InvalidProblem if it cannot be read."""
    import pandas as pd

    path = folder / f"{name}.csv"
    data = read_bytes(path, lines=True)
    try:
        return pd.read_csv(io.BytesIO(data))
    except ValueError as error:  # pandas raises subclasses of ValueError for text that it cannot parse
        what = f"the table cannot be read ({str(error).partition(chr(10))[0]})"
        raise InvalidProblem(what, str(path), "copy the whole data set there") from None


def choose(value: Any, known: Iterable[Any], option: str) -> Any:
    """Return the value of an option; raise InvalidProblem if the value is not among the known ones."""
    names = list(known)
    if value not in names:
        raise InvalidProblem(f"{value!r} is unknown", option, nearest(str(value), map(str, names)))
    return value


def places(table: pd.DataFrame, columns: Iterable[str] = XYZ) -> Array:
    """Return coordinates (n, d) in metres from all `columns` that exist in the table."""
    return table[[column for column in columns if column in table]].to_numpy(dtype=np.float64)


# Short windows of consecutive rows; each window is an epoch of a free target.


@dataclass(frozen=True, slots=True)
class Window:
    """Rows of one short window.

    Parameters
    ----------
    a, b : int array (m,)
        Stations of each row; b is None if rows have one station only.
    z : array (m,)
        Measured values less known corrections, SI units.
    covariance : array (m, m)
        Covariance of the rows, squared SI units.
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
    """All windows of a set.

    `stations` (s, d) are in metres. `problem` is one problem with an epoch for each window; `windows` contains the same
    rows window by window.
    """

    name: str
    stations: Array
    windows: tuple[Window, ...]
    problem: Problem

    @property
    def truth(self) -> Array:
        """Return the true positions (k, d), metres."""
        return np.array([window.truth for window in self.windows])


def along(times: Array, truth: pd.DataFrame) -> Array:
    """Return the true positions (k, d) at `times` (k,), metres, interpolated linearly."""
    columns = [c for c in ("x_m", "y_m", "z_m") if c in truth]
    return np.stack([np.interp(times, truth["t_s"], truth[c]) for c in columns], axis=-1)


def cut_windows(rows: pd.DataFrame, times: Array, width: float) -> pd.DataFrame:
    """Return the rows inside windows of `width` seconds that are centred at `times` (k,), with a column `window`."""
    # The last window that begins before the row, if the window has not ended yet.
    window = np.searchsorted(times - width / 2, rows["t_s"].to_numpy(), side="right") - 1
    inside = (window >= 0) & (rows["t_s"].to_numpy() < times[np.maximum(window, 0)] + width / 2)
    return rows.assign(window=window)[inside]

"""What reading a problem file gives."""

from __future__ import annotations

from dataclasses import dataclass

from optloc.files.chunk import Chunk
from optloc.files.schema import ProblemFile
from optloc.files.table import Table
from optloc.problem import Problem
from optloc.quality.levels import NoiseLevels
from optloc.types import Array


@dataclass(frozen=True, slots=True)
class Loaded:
    """A problem and what its file calls things.

    Parameters
    ----------
    problem : Problem
        In SI units.
    source : str
        Name of the file.
    title : str
        What the file says it is, or its name.
    epochs : tuple of k str
        Labels of the epochs.
    times : array (k,)
        Seconds as the file gives them; NaN where it gives none.
    targets : tuple of str
        Name of each target; of the target of each epoch where `own_epochs`.
    own_epochs : bool
        Whether every epoch belongs to one target.
    levels : NoiseLevels, optional
        What the data say of the noise, where it is left to them.
    """

    problem: Problem
    source: str
    title: str
    epochs: tuple[str, ...]
    times: Array
    targets: tuple[str, ...]
    own_epochs: bool = False
    levels: NoiseLevels | None = None


@dataclass(frozen=True, slots=True)
class Draft:
    """A problem with everything that is needed to write its file again.

    Parameters
    ----------
    loaded : Loaded
        The problem.
    file : ProblemFile
        Settings.
    tables : tuple of Table
        Rows of each ``[[measurements]]``.
    chunks : tuple of Chunk
        The same in SI units, one for each kind of each table.
    numbers : tuple of int array (m,)
        Global row number of each row of each chunk.
    moving : bool
        Whether stations or known targets move.
    """

    loaded: Loaded
    file: ProblemFile
    tables: tuple[Table, ...]
    chunks: tuple[Chunk, ...]
    numbers: tuple[Array, ...]
    moving: bool

"""P and S waves of one source: their arrivals as arrival times, ranges and range differences, with one origin time.

An arrival is multiplied by the speed vp of P waves, metres. The arrival at the range r is ``r + e`` for P and
``k r + e`` for S. Here k = vp / vs is a ratio, and e is the unknown origin time. Linear combinations of the arrivals of
an event have the form of other rows:

- P alone: the arrival time ``r + e``.
- S minus P of one station: ``(k - 1) r``, a range.
- S minus S of two stations: ``k (r_a - r_b)``, a range difference.
- S, if no station has P: divided by k, the arrival time ``r + e / k``.

The combinations are linearly independent, and their number is the number of arrivals. Their covariance follows from the
errors of the arrivals. So every position has the same cost as with the arrivals. The proof and the closed forms for
these kinds apply. If an event has P and S, but no station has both, one S arrival stays unused.

Letters: n arrivals of all events, m rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.problem.build import Measured, measured
from optloc.problem.noise import Block, dense, group


@dataclass(frozen=True, slots=True)
class PhaseRows:
    """Rows of one kind, each a combination of at most two arrivals.

    Parameters
    ----------
    kind : "toa", "range" or "tdoa"
        Kind of the rows.
    a, b : int array (m,)
        Stations; b is -1 except for range differences.
    arrival : int array (m, 2)
        Numbers of the combined arrivals. The second is equal to the first if its factor is zero.
    factor : array (m, 2)
        Factors of the arrivals.
    """

    kind: str
    a: Array
    b: Array
    arrival: Array
    factor: Array

    def combine(self, values: Array) -> Array:
        """Return the rows (..., m) of values (..., n) that belong to the arrivals."""
        return np.asarray((values[..., self.arrival] * self.factor).sum(-1))


@dataclass(frozen=True, slots=True)
class Combination:
    """Rows of one kind that are combinations of arrivals.

    Parameters
    ----------
    rows : PhaseRows
        The rows.
    event : int array (n,)
        Number of the event of each arrival of the section.
    variance : array (n,)
        Variance of each arrival, square metres.
    unused : int array (u,)
        Stations of the S arrivals of the section that no row contains.
    """

    rows: PhaseRows
    event: Array
    variance: Array
    unused: Array


class _CombinedRow(NamedTuple):
    """One row: its kind, its stations, and the numbers and factors of its two arrivals."""

    kind: str
    a: int
    b: int
    arrival: tuple[int, int]
    factor: tuple[float, float]


def phase_rows(station: Array, is_s: Array, event: Array, ratio: float) -> tuple[tuple[PhaseRows, ...], Array]:
    """Return the rows of P and S arrivals, one set for each kind, and the numbers of the unused arrivals.

    Parameters
    ----------
    station : int array (n,)
        Station of each arrival.
    is_s : bool array (n,)
        Whether an arrival is an S wave.
    event : int array (n,)
        Event of each arrival. An event has one origin time.
    ratio : float
        Speed of P waves divided by the speed of S waves.

    Raises
    ------
    InvalidProblem
        For a ratio that is not greater than one.
    """
    if not 1.0 < ratio < np.inf:
        raise InvalidProblem(f"the ratio vp / vs is {ratio:g}, not above 1", "vs", "give a vs that is less than vp")
    order = np.argsort(event, kind="stable")
    starts = np.flatnonzero(np.diff(event[order], prepend=event[order[:1]] - 1 if len(order) else 0))
    rows: list[_CombinedRow] = []
    unused: list[int] = []
    for picks in np.split(order, starts[1:]) if len(order) else ():
        found, left = _rows_of_event(picks.tolist(), station, is_s, ratio)
        rows += found
        unused += left
    sets = []
    for kind in dict.fromkeys(row.kind for row in rows):
        same = [row for row in rows if row.kind == kind]
        a, b, arrival, factor = (np.array(column) for column in list(zip(*same, strict=True))[1:])
        sets.append(PhaseRows(kind, a, b, arrival, factor))
    return tuple(sets), np.array(unused, dtype=np.int64)


def _rows_of_event(
    picks: Sequence[int], station: Array, is_s: Array, ratio: float
) -> tuple[list[_CombinedRow], list[int]]:
    """Return the rows of the arrivals `picks` of one event, and the arrivals that no row contains.

    `station`, `is_s` and `ratio` are as for `phase_rows`.
    """
    first_p: dict[int, int] = {}
    rows = []
    for i in picks:
        if not is_s[i]:
            first_p.setdefault(int(station[i]), i)
            rows.append(_CombinedRow("toa", int(station[i]), -1, (i, i), (1.0, 0.0)))
    late = [i for i in picks if is_s[i]]
    if not first_p:
        return [_CombinedRow("toa", int(station[i]), -1, (i, i), (1.0 / ratio, 0.0)) for i in late], []
    paired = [i for i in late if int(station[i]) in first_p]
    share = 1.0 / (ratio - 1.0)
    rows += [_CombinedRow("range", int(station[i]), -1, (i, first_p[int(station[i])]), (share, -share)) for i in paired]
    alone = [i for i in late if int(station[i]) not in first_p]
    if not alone:
        return rows, []
    reference = (paired or alone)[0]
    others = [i for i in alone if station[i] != station[reference]]
    share = 1.0 / ratio
    rows += [
        _CombinedRow("tdoa", int(station[i]), int(station[reference]), (i, reference), (share, -share)) for i in others
    ]
    return rows, [i for i in alone if i not in others]


def phase_blocks(sets: Sequence[PhaseRows], numbers: Sequence[Array], event: Array, variance: Array) -> list[Block]:
    """Return the noise of rows of P and S arrivals: a covariance for each event.

    Parameters
    ----------
    sets : sequence of PhaseRows
        The rows of each kind.
    numbers : sequence of int array (m,)
        Global numbers of the rows of each set.
    event : int array (n,)
        Event of each arrival.
    variance : array (n,)
        Variance of each arrival, square metres at the speed of P waves.
    """
    arrival, factor = (np.concatenate([getattr(one, name) for one in sets]) for name in ("arrival", "factor"))
    number, of_row = np.concatenate(list(numbers)), event[arrival[:, 0]]
    order = np.argsort(of_row, kind="stable")
    blocks = []
    for rows in np.split(order, np.flatnonzero(np.diff(of_row[order])) + 1):
        picks, index = np.unique(arrival[rows], return_inverse=True)
        design = np.zeros((len(rows), len(picks)))
        index = index.reshape(-1, 2)
        np.add.at(design, (np.arange(len(rows))[:, None], index), factor[rows])
        blocks.append(Block(number[rows][None], ((design * variance[picks]) @ design.T)[None]))
    return list(group(blocks).blocks)


def phases(
    z: ArrayLike, *, a: ArrayLike, is_s: ArrayLike, ratio: float, sigma: ArrayLike, epoch: ArrayLike = 0
) -> tuple[tuple[Measured, ...], Array]:
    """Return rows and their joint covariance (m, m) for P and S arrivals, as input of `assemble`.

    Parameters
    ----------
    z : array (..., n)
        Arrival times multiplied by the speed of P waves, metres. In layers, this speed is their `unit_speed`.
    a : int array (n,)
        Station of each arrival.
    is_s : bool array (n,)
        Whether an arrival is an S wave.
    ratio : float
        Speed of P waves divided by the speed of S waves: the same in all layers.
    sigma : float or array (n,)
        Standard deviation of each arrival, metres at the speed of P waves.
    epoch : int or int array (n,)
        Event of each arrival. An event has one origin time.

    Raises
    ------
    InvalidProblem
        For a ratio that is not greater than one, and for arrays of unequal length.

    Examples
    --------
    >>> import numpy as np, optloc
    >>> from optloc.problem.phases import phases  # Rows and noise.
    >>> places = np.array([[0.0, 0.0], [9e3, 0.0], [0.0, 9e3], [9e3, 9e3]])  # Four stations.
    >>> r = np.linalg.norm(places - [4e3, 3e3], axis=1)
    >>> z = np.append(r, 1.75 * r[:2]) + 5e3  # Four P, two S.
    >>> is_s = np.arange(6) >= 4  # The last two.
    >>> rows, joint = phases(z, a=[0, 1, 2, 3, 0, 1], is_s=is_s, ratio=1.75, sigma=100.0)  # Two blocks.
    >>> fix = optloc.solve(optloc.assemble(places, *rows, covariance=joint))
    >>> fix.position.round(3).tolist()
    [4000.0, 3000.0]
    """
    values = np.atleast_1d(np.asarray(z, dtype=float))
    try:
        station, late, event, deviation = (
            np.broadcast_to(np.asarray(given, dtype=kind), values.shape[-1:])
            for given, kind in ((a, np.int64), (is_s, bool), (epoch, np.int64), (sigma, float))
        )
    except ValueError:
        what = f"there are {values.shape[-1]} arrivals, but another argument has another length"
        raise InvalidProblem(what, "phases", "give one value for each arrival") from None
    sets, _ = phase_rows(station, late, event, ratio)
    rows = tuple(
        measured(one.kind, one.combine(values), a=one.a, b=one.b, sigma=1.0, epoch=event[one.arrival[:, 0]])
        for one in sets
    )
    stops = np.cumsum([0, *(len(one.a) for one in sets)])
    numbers = [np.arange(start, stop) for start, stop in pairwise(stops.tolist())]
    blocks = phase_blocks(sets, numbers, event, deviation**2)
    return rows, dense(group(blocks), np.arange(stops[-1]))

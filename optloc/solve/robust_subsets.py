"""Which rows to start from: all but those of some stations, or all but one, of the rows that each problem has."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from optloc.problem import Problem
from optloc.solve.freedom import degrees_of_freedom
from optloc.solve.start import rows_of_stations
from optloc.types import Array

# Subsets of a problem at most; stations up to which three are left out, rows up to which single ones are.
_MOST, _THREE, _ROWS = 80, 8, 12


def subsets(problem: Problem) -> tuple[Array, Array]:
    """Return the subsets of all problems of a flat batch: problem of each (S,), and its rows (S, m).

    One station is left out, or one row where a problem has few, or two stations, or three of few.

    Parameters
    ----------
    problem : Problem
        N problems; what is left out of each are its own stations, those that it has rows of.
    """
    present = np.broadcast_to(problem.weight > 0.0, (problem.batch_shape[0], problem.count))
    touched, single = rows_of_stations(problem), np.eye(problem.count, dtype=bool)
    heard = np.asarray((present[:, None] & touched).any(-1))
    short = np.flatnonzero(present.sum(1) <= _ROWS)
    stations, rows = _combined(heard, touched, 3), _combined(present[short], single, 1)
    item = np.concatenate([stations[0], short[rows[0]]])
    kept = present[item] & ~np.concatenate([stations[1], rows[1]])
    _, first = np.unique(np.column_stack([item, kept]), axis=0, return_index=True)
    item, kept = item[first], kept[first]
    enough = degrees_of_freedom(problem.take(item).with_rows(weight=1.0 * kept)) >= 0
    return item[enough], kept[enough]


def _combined(own: Array, touched: Array, size: int) -> tuple[Array, Array]:
    """Return the unions (S, m) of the rows that up to `size` members touch (g, m), for each problem (S,) of its own."""
    count = own.sum(1)
    most = int(count.max(initial=0))
    local = np.argsort(~own, axis=1, kind="stable")[:, :most]
    sizes = range(1, 1 + (size if most <= _THREE else min(size, 2)))
    items, unions = [np.zeros(0, dtype=int)], [np.zeros((0, touched.shape[1]), dtype=bool)]
    for members in [chosen for q in sizes for chosen in combinations(range(most), q)][:_MOST]:
        item = np.flatnonzero(count > max(members))
        items.append(item)
        unions.append(np.asarray(touched[local[item][:, members]].any(1)))
    return np.concatenate(items), np.concatenate(unions)

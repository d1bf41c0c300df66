"""Explanations by a few rows or by the noise: one or two outliers, and noise levels of a kind or a station."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations

import numpy as np

from optloc.advice.change import Case, Change, Wording
from optloc.advice.suspects import Suspects
from optloc.advice.wording import row_name
from optloc.base.types import Array

# Epochs with the largest cost whose rows may be outliers, and the largest number of rows of which pairs are tried.
_EPOCHS, _PAIRED = 3, 8
# Factors of the noise that are tried; between two of them, the likelihood changes by less than one.
_LEVELS = tuple((1.5 * 1.5**i) for i in range(14))
# A station needs this number of rows for a noise level: fewer rows do not distinguish noise from outliers.
_FEW = 6


def outliers(case: Case, suspects: Suspects) -> Iterator[Change]:
    """Yield single rows without which the others may fit, and pairs of such rows."""
    rows = _worst_rows(case)
    for pair in [*((row,) for row in rows), *combinations(rows[:_PAIRED], 2)]:
        weight = np.ones(case.present.shape)
        for epoch, row in pair:
            weight[epoch, row] = 0.0
        a, b = case.ends
        ends = {int(i) for _, row in pair for i in (a[row], b[row]) if i >= 0}
        common = {int(i) for i in b[case.present.any(0)]}
        own = [i for i in ends if len(common) > 1 or i not in common] or list(ends)
        yield Change(
            "outlier" if len(pair) == 1 else "outliers",
            partial(_outlier_words, case, pair),
            tuple(case.names[i] for i in sorted(own)),
            tuple(int(case.number[epoch, row]) for epoch, row in pair),
            weight=weight,
            groups=len(pair),
            removed=len(pair),
        )


def _worst_rows(case: Case) -> list[tuple[int, int]]:
    """Return epoch and number of the rows of the epochs with the largest cost, the largest residuals first."""
    from optloc.linear.normal import linearise

    linear = linearise(case.base, case.x)
    size = np.zeros(case.present.shape)
    for whitener in linear.noise:
        white = whitener.apply(linear.residual[..., None])[..., 0]
        size[:, whitener.row.ravel()] = np.abs(white)
    size = np.where(np.isfinite(size), size, 0.0)
    epochs = np.argsort(-(size**2).sum(1), kind="stable")[:_EPOCHS]
    rows = [(int(k), int(i)) for k in epochs for i in np.flatnonzero(case.present[k])]
    return sorted(rows, key=lambda one: -size[one])[: 4 * _PAIRED]


def _outlier_words(case: Case, pair: tuple[tuple[int, int], ...], theta: Array, sigma: Array) -> Wording:
    names = " and ".join(row_name(case, *one) for one in pair)
    seen = f"the other rows fit without {names}"
    return Wording(seen, "check this reading, or leave it out" if len(pair) == 1 else "check them, or leave them out")


def levels(case: Case, suspects: Suspects) -> Iterator[Change]:
    """Yield larger noise of one kind of several, and of one station with many rows."""
    groups = [(f"the {kind} values", kind, (), case.rows_of(kind)) for kind in case.kinds if len(case.kinds) > 1]
    for station in case.stations:
        rows = case.rows_at(station)
        if int(case.present[:, rows].sum()) >= _FEW and not rows[case.present.any(0)].all():
            groups.append((f"station {case.names[station]}", "", (case.names[station],), rows))
    for what, kind, names, rows in groups:
        for level in _LEVELS:
            spread = np.where(rows, level, 1.0)
            words = partial(_level_words, what, kind, level)
            yield Change("noise", words, names, spread=spread, levels=True, alternatives=len(groups), kind=kind)


def _level_words(what: str, kind: str, level: float, theta: Array, sigma: Array) -> Wording:
    seen = f"the noise of {what} would explain the misfit if it were about {level:.2g} times as large as stated"
    lines = f"weight = {level**-2:.6g}\n" if kind else ""
    return Wording(seen, "state its noise", lines)

"""Stations ordered by the cost without their rows: the first filter of explanations by one station."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from optloc.advice.change import Change, ErrorColumn, MisfitCase
from optloc.advice.fits import Fits, fit
from optloc.advice.wording import station_words
from optloc.base.cached import cached_property
from optloc.base.types import Array


@dataclass(frozen=True)  # without slots, because the cached properties need `__dict__`
class Suspects:
    """Offsets of all channels, fitted in one batch. A channel is a station and a kind of its rows.

    Parameters
    ----------
    case : MisfitCase
        The problem.
    limit : float
        Cost from which an explanation is of no interest.
    """

    case: MisfitCase
    limit: float = np.inf

    @cached_property
    def _stated(self) -> tuple[Change, ...]:
        """Return the offsets of all channels, without starts."""
        case, out = self.case, []
        for station, kind in self.channels:
            own = case.coefficients("station", "offset", kind, case.names[station])
            column = ErrorColumn("adds", np.broadcast_to(own, case.present.shape))
            left = (case.present & (own == 0.0)).sum(1)
            # without these rows, the others determine no position: for instance without the reference station
            starts = ((0.0,),) if (left < case.present.sum(1) - case.dof).any() else ()
            words = partial(station_words, case, "offset", kind, case.names[station])
            out.append(
                Change(
                    "offset",
                    words,
                    (case.names[station],),
                    columns=(column,),
                    starts=starts,
                    alternatives=self.count,
                    kind=kind,
                )
            )
        return tuple(out)

    @cached_property
    def channels(self) -> tuple[tuple[int, str], ...]:
        """Return the station and the kind of each channel with present rows."""
        case, out = self.case, []
        for kind in case.kinds:
            rows = case.rows_of(kind)
            out += [(s, kind) for s in case.stations if (case.present[:, rows & case.rows_at(s)]).any()]
        return tuple(out)

    @property
    def count(self) -> int:
        """Return the number of channels."""
        return max(1, len(self.channels))

    @cached_property
    def without(self) -> Fits:
        """Return the fits without the rows of each channel."""
        changes = [
            change
            if change.starts
            else replace(change, weight=np.where(change.columns[0].coefficient != 0.0, 0.0, 1.0), columns=())
            for change in self._stated
        ]
        return fit(self.case, changes)

    @cached_property
    def least(self) -> Array:
        """Return the cost without the rows of each channel: an error of the channel alone has no smaller cost.

        It is zero for channels that the position needs. Epochs that the other rows do not determine count as zero.
        """
        stated = np.array([bool(change.starts) for change in self._stated], dtype=bool)
        cost = np.where(np.isfinite(self.without.cost), self.without.cost, 0.0)
        return np.where(stated, 0.0, cost.sum(-1))

    @cached_property
    def _possible(self) -> tuple[int, ...]:
        """Return the numbers of the channels whose error may be of interest, least cost without their rows first."""
        return tuple(i for i in self.order if self.least[i] < self.limit)

    @cached_property
    def offsets(self) -> tuple[Change, ...]:
        """Return the offsets of the channels that may be wrong, each with a start."""
        some, x = self._possible, self.without.x
        return tuple(replace(self._stated[i], x=x[i], least=float(self.least[i])) for i in some)

    @cached_property
    def fits(self) -> Fits | None:
        """Return the fits of these offsets; None without offsets."""
        return fit(self.case, self.offsets) if self.offsets else None

    @cached_property
    def order(self) -> tuple[int, ...]:
        """Return the numbers of the channels, least cost without their rows first."""
        if not self._stated:
            return ()
        return tuple(np.argsort(self.without.cost.sum(-1), kind="stable").tolist())

    def start(self, station: int, kind: str) -> Array:
        """Return the unknowns (K, size) without the rows of a channel."""
        return np.asarray(self.without.x[self.channels.index((station, kind))])

    def least_of(self, station: int) -> float:
        """Return the cost that an error of all rows of a station has at least."""
        own = [i for i, (each, _) in enumerate(self.channels) if each == station]
        return float(self.least[own[0]]) if len(own) == 1 else 0.0

    def first(self, count: int) -> list[tuple[int, str]]:
        """Return the first channels in this order."""
        return [self.channels[i] for i in self.order[:count]]

    def possible(self, count: int) -> Iterator[tuple[int, str, Array, float]]:
        """Yield the first channels that may be wrong: station, kind, unknowns without their rows, and least cost."""
        for i in self._possible[:count]:
            yield *self.channels[i], self.without.x[i], float(self.least[i])

    def estimates(self, count: int) -> Iterator[tuple[Change, float, float]]:
        """Yield the offsets of the first channels that may be wrong, with estimate and standard deviation."""
        if self.fits is None:
            return
        for i, change in enumerate(self.offsets[:count]):
            if np.isfinite(self.fits.cost[i].sum()):
                yield change, float(self.fits.theta[i, 0]), float(self.fits.sigma[i, 0])

"""A small change of a problem that may explain its misfit: other values, noise, weights, stations or unknown errors.

Letters: K epochs that are fixed separately, or K = 1 for a run with shared unknowns. Each epoch has m rows. There are s
stations, d coordinates, and q parameters of a change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from optloc.base.cached import cached_property
from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array, FormName
from optloc.models import MODELS
from optloc.problem.bias import Per, family
from optloc.problem.problem import Problem


@dataclass(frozen=True, slots=True)
class ErrorColumn:
    """One unknown parameter of a change, and its effect on the rows.

    Parameters
    ----------
    enters : "adds" or "scales"
        Whether the parameter, times the coefficient, is added to the predicted values or multiplies them.
    coefficient : array (K, m)
        Zero for rows without this error.
    """

    enters: Literal["adds", "scales"]
    coefficient: Array


@dataclass(frozen=True, slots=True)
class Wording:
    """Text about a change: the observation, the remedy, and how a user writes the remedy; see `Advice`."""

    seen: str
    advice: str
    toml: str = ""
    option: str = ""


# Arguments: estimates (q,) and standard deviations (q,) of the parameters.
Words = Callable[[Array, Array], Wording]


@dataclass(frozen=True, slots=True)
class Change:
    """One alternative of an explanation. The values become ``shift + factor * z``, and the noise ``|factor| * spread``.

    Parameters
    ----------
    cause : str
        Keyword of the explanation, as in `Advice`.
    words : callable
        Maps estimates (q,) and standard deviations (q,) of the parameters to the text.
    station : tuple of str
        Stations with the error.
    members : tuple of int
        Numbers of the rows with the error, in the problem as given.
    factor, shift, spread, weight : array (K, m), or numbers
        Factors and shift of the values, and factors of the standard deviations and of the weights.
    position : array (1, s, d), optional
        Positions of the stations instead of the stated ones.
    columns : tuple of ErrorColumn
        Unknown parameters.
    moved : int
        Number of a station whose position has an unknown error, d more parameters; -1 for none.
    starts : tuple of tuple of float
        Values of the parameters from which the fit starts. Empty: the fit starts without the affected rows.
    x : array (K, size), optional
        Unknowns from which the fit starts, instead of a search.
    alternatives : float
        Number of alternatives among which data choose this one.
    extra : int
        Number of unknowns that another structure adds.
    levels : bool
        Whether `spread` is an estimated noise level.
    kind : str
        Kind of the rows of an error of one station; empty for all kinds.
    base : Problem, optional
        Problems (K,) of another structure, to which the change applies instead.
    least : float
        Cost of the rows that the change does not affect, which no fit of the change can lower.
    admits : callable, optional
        Returns whether estimates (q,) are values that the cause can have. By default, all are.
    """

    cause: str
    words: Words
    station: tuple[str, ...] = ()
    members: tuple[int, ...] = ()
    factor: Array | float = 1.0
    shift: Array | float = 0.0
    spread: Array | float = 1.0
    weight: Array | float = 1.0
    position: Array | None = None
    columns: tuple[ErrorColumn, ...] = ()
    moved: int = -1
    starts: tuple[tuple[float, ...], ...] = ()
    x: Array | None = None
    alternatives: float = 1.0
    extra: int = 0
    levels: bool = False
    kind: str = ""
    base: Problem | None = None
    least: float = 0.0
    admits: Callable[[Array], bool] | None = None

    def in_epochs(self, items: Array) -> Change:
        """Return a change in some of the epochs."""
        arrays = {name: getattr(self, name) for name in ("factor", "shift", "spread", "weight")}
        columns = tuple(replace(column, coefficient=column.coefficient[items]) for column in self.columns)
        part = {name: each[items] for name, each in arrays.items() if np.ndim(each) == 2}
        return replace(self, columns=columns, **part)

    def size(self, dimension: int) -> int:
        """Return the number q of parameters."""
        return len(self.columns) + (dimension if self.moved >= 0 else 0)


@dataclass(frozen=True)  # without slots, because the cached properties need `__dict__`
class MisfitCase:
    """A problem whose misfit must be explained, as a flat batch of K separate epochs.

    Parameters
    ----------
    base : Problem
        Flat batch of K problems of one epoch, or of one run (K = 1).
    times : array (K,)
        Times of the separate epochs, s.
    number : int array (K, m)
        Number of each row in the problem as given; -1 for rows that an epoch lacks.
    x : array (K, size)
        Fixes; NaN for none.
    dof : int array (K,)
        Degrees of freedom.
    origin : float
        Time of zero drift, s.
    cost : array (K,), optional
        Costs of the epochs without a change, if they are known.
    """

    base: Problem
    times: Array
    number: Array
    x: Array
    dof: Array
    origin: float = 0.0
    cost: Array | None = None

    def in_epochs(self, items: Array) -> MisfitCase:
        """Return the case of some of the epochs."""
        arrays = {name: getattr(self, name)[items] for name in ("times", "number", "x", "dof")}
        return replace(self, base=self.base.take(items), cost=None if self.cost is None else self.cost[items], **arrays)

    @cached_property
    def present(self) -> Array:
        """Return flags (K, m) of rows with a weight above zero."""
        return np.broadcast_to(self.base.weight, (len(self.times), self.base.count)) > 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the stations."""
        return self.base.stations.names

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Return the kinds with present rows."""
        return tuple(rows.kind for i, rows in enumerate(self.base.rows) if self.present[:, self.part(i)].any())

    def part(self, block: int) -> slice:
        """Return the row numbers of a block of rows."""
        return slice(self.base.starts[block], self.base.starts[block] + self.base.rows[block].count)

    def rows_of(self, kind: str) -> Array:
        """Return flags (m,) of the rows of a kind."""
        out = np.zeros(self.base.count, dtype=bool)
        for i, rows in enumerate(self.base.rows):
            out[self.part(i)] |= rows.kind == kind
        return out

    def rows_where(self, quantity: str) -> Array:
        """Return flags (m,) of the rows of a quantity that depend on a station."""
        out = np.zeros(self.base.count, dtype=bool)
        for i, rows in enumerate(self.base.rows):
            model = MODELS[rows.kind]
            out[self.part(i)] |= model.quantity == quantity and model.stations > 0
        return out

    @cached_property
    def ends(self) -> tuple[Array, Array]:
        """Return the first and the second station (m,) of each row; -1 for none."""
        blocks = self.base.rows
        a = np.concatenate([np.where(MODELS[r.kind].stations > 0, r.a, -1) for r in blocks])
        return a, np.concatenate([np.where(MODELS[r.kind].stations > 1, r.b, -1) for r in blocks])

    def rows_at(self, station: int) -> Array:
        """Return flags (m,) of the rows of a station."""
        a, b = self.ends
        return np.asarray((a == station) | (b == station))

    @cached_property
    def stations(self) -> tuple[int, ...]:
        """Return the numbers of the stations with present rows."""
        used = self.present.any(0)
        a, b = self.ends
        return tuple(i for i in np.unique(np.concatenate([a[used], b[used]])).tolist() if i >= 0)

    @cached_property
    def when(self) -> Array:
        """Return the time (K, m) of each row after the origin, s; zero without times."""
        if self.base.epochs > 1:
            since = self.base.times[self.base.epoch][None] - self.origin
        else:
            since = np.broadcast_to(self.times[:, None] - self.origin, self.present.shape)
        return np.where(np.isfinite(since), since, 0.0)

    def coefficients(self, per: Per, form: FormName, kind: str, station: str | None = None) -> Array:
        """Return the coefficients (m,) with which an error of a kind or a station enters the rows.

        The signs are the signs of `[[biases]]` in a problem file.
        """
        members = None if station is None else (station,)
        bias = family(self.base.rows, self.names, "error", per=per, form=form, kind=kind, members=members)
        out = np.zeros(self.base.count)
        np.add.at(out, bias.row, bias.coefficient)
        return out

    @cached_property
    def extent(self) -> float:
        """Return the spread of the stations, m."""
        return float(np.max(centre_and_spread(self.base.stations.places)[1]))

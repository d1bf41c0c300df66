"""Forms of systematic errors: how an error enters rows, the unit of its values, and its change in time.

A family of biases has q members. It affects n pairs of a row and a member, each with a coefficient (n,). c values of a
member enter one row: one value, or the four coefficients of a spline that matter at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Bias
from optloc.base.units import SI_UNIT, Quantity
from optloc.models import Model
from optloc.problem import clocks

# Indices of the values that enter each pair of row and member, and their factors, each (n, c).
_Effects = tuple[Array, Array]


def _constant(bias: Bias, times: Array, origin: float, epoch: Array) -> _Effects:
    """Return the value indices and the factors, each (n, 1), of an error that is constant.

    Arguments of this and the next two functions as for `BiasForm.effects`.
    """
    return bias.member[:, None], (bias.coefficient * 1.0)[:, None]


def _in_proportion_to_time(bias: Bias, times: Array, origin: float, epoch: Array) -> _Effects:
    """Return the value indices and the factors, each (n, 1), of a drift: coefficient times seconds since `origin`."""
    return bias.member[:, None], (bias.coefficient * (times - origin)[epoch])[:, None]


def _in_pieces(bias: Bias, times: Array, origin: float, epoch: Array) -> _Effects:
    """Return the value indices and the factors, each (n, 4), of a spline."""
    assert bias.knots is not None
    entry, factor = clocks.spline_weights(bias.knots, times)
    first = bias.member[:, None] * clocks.coefficients(bias.knots)
    return first + entry[epoch], bias.coefficient[:, None] * factor[epoch]


@dataclass(frozen=True, slots=True)
class BiasForm:
    """A form of systematic error. `FORMS` lists all forms.

    Parameters
    ----------
    noun : str
        Name of the form with its article, for use in sentences.
    enters : "adds", "scales", "turns" or "moves"
        How a value acts: it is added to a measurement, multiplies the measured quantity, turns the axes of a station,
        or moves a station along its course (its track): the displacement is velocity times value, which is a time.
    quantity : Quantity, optional
        Physical quantity of the values; None: the quantity of the rows.
    rate : bool
        Whether the values are per second.
    effects : callable
        Arguments: a bias, the times of the epochs (k,), the time of zero drift, and the epochs (n,) of the n pairs of
        row and member. Returns, for each pair, the indices of the values that enter the row, and their factors, each
        (n, c). For a scale, the sum is multiplied by the measured quantity.
    values_at : callable, optional
        Maps a bias to the times (c,) of the values of a member; None: each member has one value.
    steps : callable, optional
        Maps a bias and the times of the epochs to the transitions and covariances of its steps, see
        `optloc.problem.clocks.process`. The values at each epoch are then unknowns. None: the values are unknowns of
        the run.
    needs : tuple of str
        Names of the arguments of `optloc.with_bias` that describe the change in time.
    complete : callable, optional
        Arguments: a bias, the times of the epochs, the location for messages, and the arguments in `needs`. Returns the
        bias with these arguments.
    check : callable, optional
        Arguments: a bias, the times of the epochs, the location for messages. Raises InvalidProblem.
    straight : callable, optional
        Maps a bias to offsets and drifts that replace it in the search for starts; None: nothing replaces it.
    beyond_proof : str
        Why the proof does not cover the form, as the end of a sentence about the bias; empty if the proof covers it.
    """

    noun: str
    enters: Literal["adds", "scales", "turns", "moves"] = "adds"
    quantity: Quantity | None = None
    rate: bool = False
    effects: Callable[[Bias, Array, float, Array], _Effects] = _constant
    values_at: Callable[[Bias], Array] | None = None
    steps: Callable[[Bias, Array], tuple[Array, Array]] | None = None
    needs: tuple[str, ...] = ()
    complete: Callable[..., Bias] | None = None
    check: Callable[[Bias, Array, str], None] | None = None
    straight: Callable[[Bias], tuple[Bias, ...]] | None = None
    beyond_proof: str = ""

    @property
    def changes(self) -> bool:
        """Return whether the error changes during the run."""
        return self.rate or self.values_at is not None or self.steps is not None

    @property
    def of_readings(self) -> bool:
        """Return whether values have the sign and the quantity of the measurements; False for the form "time"."""
        return self.enters != "moves"

    def touches(self, model: Model) -> bool:
        """Return whether an error of this form can change rows of the kind `model`."""
        return {"turns": model.axes, "moves": model.stations > 0}.get(self.enters, True)

    def signs(self, model: Model) -> tuple[int, int]:
        """Return the signs with which the errors of the first and the second station enter a row; 0 for no effect.

        They are the coefficients of a bias with one member for each station.
        """
        if self.enters == "turns" or model.stations == 1:
            return (1, 0)
        # A coefficient of 1 moves the first station of the row along its course, -1 the second.
        if self.enters == "moves":
            return (1, -1)
        # In kinds that are not sums of ranges, such as gains, the errors of two stations enter as a difference.
        return model.signs or (1, -1)

    def unit(self, rows: str) -> str:
        """Return the SI unit of the values for rows with unit `rows`; empty if the rows have several units."""
        if self.quantity is not None:
            return SI_UNIT[self.quantity]
        return per_second(rows) if self.rate else rows

    def shape(self, bias: Bias, dimension: int) -> tuple[int, ...]:
        """Return the shape of the values of a bias: (q,), or (q, number of angles or coefficients).

        `dimension` is 2 or 3. A rotation has three angles in space.
        """
        if self.values_at is not None:
            return (len(bias.members), len(self.values_at(bias)))
        return (len(bias.members), *((3,) if self.enters == "turns" and dimension == 3 else ()))

    def members(self, bias: Bias) -> tuple[str, ...]:
        """Return the names of the members, with the time of each value if a member has several values."""
        if self.values_at is None:
            return bias.members
        return tuple(f"{member} at {time:.6g} s" for member in bias.members for time in self.values_at(bias))


def per_second(unit: str) -> str:
    """Return the SI unit per second of a unit, for instance "m/s" for "m"; empty for an empty unit."""
    return {"": "", "m/s": "m/s^2"}.get(unit, f"{unit}/s")


def _straight_walk(bias: Bias) -> tuple[Bias, ...]:
    """Return an offset with the prior of the first value of a walk and, if the walk has a rate, a drift.

    The search for starts uses them instead of the walk, because they are linear in time.
    """
    offset, drift = _straight_spline(bias)
    known = replace(offset, sigma=bias.sigma, mean=bias.mean)
    return (known, drift)[: len(clocks.state_of(bias))]


def _straight_spline(bias: Bias) -> tuple[Bias, ...]:
    """Return an offset and a drift without priors, which replace a spline in the search for starts."""
    offset = replace(bias, form="offset", density=None, knots=None, sigma=None, mean=np.zeros(1))
    return offset, replace(offset, name=clocks.rate_name(bias.name), form="drift")


_ADDS = "and the proof covers added errors only"
_MULTIPLIES = f"multiplies the measured quantity, {_ADDS}"

FORMS: dict[str, BiasForm] = {
    "offset": BiasForm("an offset"),
    "scale": BiasForm("a scale error", "scales", "plain"),
    "drift": BiasForm("a drift", rate=True, effects=_in_proportion_to_time),
    "rotation": BiasForm("a turn of its axes", "turns", "angle", beyond_proof=_MULTIPLIES),
    "time": BiasForm("a time along its course", "moves", "time", beyond_proof=f"moves stations, {_ADDS}"),
    "walk": BiasForm(
        "a walk",
        steps=clocks.process,
        needs=("density", "rate_density"),
        complete=clocks.with_densities,
        check=clocks.check_walk,
        straight=_straight_walk,
        beyond_proof="has unknowns at each epoch, and the proof covers unknowns of the run only",
    ),
    "spline": BiasForm(
        "a spline",
        effects=_in_pieces,
        values_at=clocks.greville,
        needs=("knots",),
        complete=clocks.with_knots,
        check=clocks.check_spline,
        straight=_straight_spline,
    ),
}
"""All forms by the names in arguments and files, the simplest first."""


def form_of(bias: Bias) -> BiasForm:
    """Return the form of a bias; raise InvalidProblem for an unknown one."""
    if bias.form not in FORMS:
        raise InvalidProblem(f"unknown form {bias.form!r}", f"bias {bias.name!r}", f"use {', '.join(FORMS)}")
    return FORMS[bias.form]


def complete(bias: Bias, times: Array, where: str, **given: Any) -> Bias:
    """Return the bias with the arguments that its form needs; raise if another argument is not None.

    Parameters
    ----------
    bias : Bias
        A bias without these arguments.
    times : array (k,)
        Seconds of the epochs.
    where : str
        Location that error messages name.
    **given
        Arguments of `optloc.with_bias`, by name.
    """
    form = form_of(bias)
    for name, value in given.items():
        if value is not None and name not in form.needs:
            other = next(other for other in FORMS if name in FORMS[other].needs)
            what = f"the form {bias.form} has no {name}"
            raise InvalidProblem(what, where, f"leave it out, or use the form {other}")
    if form.complete is None:
        return bias
    return form.complete(bias, times, where, **{name: given.get(name) for name in form.needs})

"""Forms of systematic errors: how each enters rows, what its values are, and how they change in time."""

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

_Effects = tuple[Array, Array]


def _constant(bias: Bias, times: Array, origin: float, epoch: Array) -> _Effects:
    return bias.member[:, None], (bias.coefficient * 1.0)[:, None]


def _in_proportion_to_time(bias: Bias, times: Array, origin: float, epoch: Array) -> _Effects:
    return bias.member[:, None], (bias.coefficient * (times - origin)[epoch])[:, None]


def _in_pieces(bias: Bias, times: Array, origin: float, epoch: Array) -> _Effects:
    assert bias.knots is not None
    entry, factor = clocks.spline_weights(bias.knots, times)
    first = bias.member[:, None] * clocks.coefficients(bias.knots)
    return first + entry[epoch], bias.coefficient[:, None] * factor[epoch]


@dataclass(frozen=True, slots=True)
class BiasForm:
    """A form of systematic errors; `FORMS` holds all of them.

    Parameters
    ----------
    noun : str
        The form in sentences, with its article.
    enters : "adds", "scales", "turns" or "moves"
        The effect of a value: it adds to a measurement, multiplies the measured quantity, turns the axes of a station,
        or moves a station along its course.
    quantity : Quantity, optional
        What the values measure; None: what the rows measure.
    rate : bool
        Whether the values are per second.
    effects : callable
        Arguments: a bias, the times of the epochs (k,), the time of zero drift, and the epoch of each touch (n,).
        Returns the entries of the bias that each touch adds to its row, and their factors, each (n, c). A scale adds
        its entries times the measured quantity.
    values_at : callable, optional
        Maps a bias to the times (c,) of the values of a member; None: a member has one value.
    steps : callable, optional
        Maps a bias and the times of the epochs to the transitions and covariances of its steps, as
        `optloc.problem.clocks.process`. Each epoch then has its values as unknowns; None: they are unknowns of the run.
    needs : tuple of str
        Arguments of `optloc.with_bias` that describe the change in time.
    complete : callable, optional
        Arguments: a bias, the times of the epochs, a place to name, and those in `needs`. Returns the bias with them.
    check : callable, optional
        Arguments: a bias, the times of the epochs, a place to name. Raises InvalidProblem.
    straight : callable, optional
        Maps a bias to the offsets and drifts that replace it in the search for starts; None: nothing replaces it.
    beyond_proof : str
        The reason why the proof does not cover the form, as the end of a sentence about the bias; empty if it does.
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
        """Return whether the error changes with the seconds of the run."""
        return self.rate or self.values_at is not None or self.steps is not None

    @property
    def of_readings(self) -> bool:
        """Return whether values have the sense and the quantity of readings; a time along a course has neither."""
        return self.enters != "moves"

    def touches(self, model: Model) -> bool:
        """Return whether the error can change rows of a kind."""
        return {"turns": model.axes, "moves": model.stations > 0}.get(self.enters, True)

    def signs(self, model: Model) -> tuple[int, int]:
        """Return the signs with which the error of the first and of the second station of a row enters."""
        if self.enters == "turns" or model.stations == 1:
            return (1, 0)
        # Which of the two stations is further along its course.
        if self.enters == "moves":
            return (1, -1)
        # Two stations of a kind that is not a sum of ranges, such as gains, enter as a difference.
        return model.signs or (1, -1)

    def unit(self, rows: str) -> str:
        """Return the SI unit of the values on rows of a unit; empty for rows of several units."""
        if self.quantity is not None:
            return SI_UNIT[self.quantity]
        return per_second(rows) if self.rate else rows

    def shape(self, bias: Bias, dimension: int) -> tuple[int, ...]:
        """Return the shape of the values: (members,), or (members, angles or coefficients of each)."""
        if self.values_at is not None:
            return (len(bias.members), len(self.values_at(bias)))
        return (len(bias.members), *((3,) if self.enters == "turns" and dimension == 3 else ()))

    def members(self, bias: Bias) -> tuple[str, ...]:
        """Return the names of the members, with the time of each value where a member has several."""
        if self.values_at is None:
            return bias.members
        return tuple(f"{member} at {time:.6g} s" for member in bias.members for time in self.values_at(bias))


def per_second(unit: str) -> str:
    """Return the SI unit per second; empty for no unit."""
    return {"": "", "m/s": "m/s^2"}.get(unit, f"{unit}/s")


def _straight_walk(bias: Bias) -> tuple[Bias, ...]:
    """Return an offset with the prior of the first value of a walk, and a drift where the walk has a rate."""
    offset, drift = _straight_spline(bias)
    known = replace(offset, sigma=bias.sigma, mean=bias.mean)
    return (known, drift)[: len(clocks.state_of(bias))]


def _straight_spline(bias: Bias) -> tuple[Bias, ...]:
    """Return an offset and a drift without priors."""
    offset = replace(bias, form="offset", density=None, knots=None, sigma=None, mean=np.zeros(1))
    return offset, replace(offset, name=clocks.rate_name(bias.name), form="drift")


_ADDS = "and the proof takes what is added"
_MULTIPLIES = f"multiplies what it touches, {_ADDS}"

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
        beyond_proof="is another unknown at each epoch, and the proof takes those of the run",
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
"""The forms by the names that arguments and files use, the simplest first."""


def form_of(bias: Bias) -> BiasForm:
    """Return the form of a bias; raise InvalidProblem for an unknown one."""
    if bias.form not in FORMS:
        raise InvalidProblem(f"unknown form {bias.form!r}", f"bias {bias.name!r}", f"use {', '.join(FORMS)}")
    return FORMS[bias.form]


def complete(bias: Bias, times: Array, where: str, **given: Any) -> Bias:
    """Return a bias with the arguments that its form needs; refuse others that are not None.

    Parameters
    ----------
    bias : Bias
        Without them.
    times : array (k,)
        Seconds of the epochs.
    where : str
        Place to name.
    **given
        Arguments of `optloc.with_bias` by name.
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

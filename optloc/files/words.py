"""Words that a file may get wrong, and amounts such as "30 ns"."""

from __future__ import annotations

import math
from dataclasses import dataclass

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.units import SI_UNIT, SPEED_OF_LIGHT, AzimuthConvention, Conversion, Quantity, conversion
from optloc.models import MODELS, Model


def join(*places: str | None) -> str:
    """Return one place out of several, from the file inwards."""
    return ", ".join(place for place in places if place)


def kind_model(kind: str, where: str) -> Model:
    """Return the model of a kind; raise InvalidProblem for an unknown one, naming the nearest."""
    if kind not in MODELS:
        raise InvalidProblem(f"unknown kind {kind!r}", where, nearest(kind, sorted(MODELS)))
    return MODELS[kind]


@dataclass(frozen=True, slots=True)
class Units:
    """What a number measures and what its units depend on.

    Parameters
    ----------
    quantity : Quantity
        It decides which units make sense.
    speed : float
        Propagation speed, metres per second.
    carrier : float, optional
        Carrier frequency, hertz.
    convention : AzimuthConvention
        Of azimuths.
    """

    quantity: Quantity
    speed: float = SPEED_OF_LIGHT
    carrier: float | None = None
    convention: AzimuthConvention = "east-counterclockwise"

    def name(self, unit: str | None) -> str:
        """Return a unit; None is the SI unit."""
        return unit or SI_UNIT[self.quantity]

    def conversion(self, unit: str | None, where: str) -> Conversion:
        """Return how a unit becomes SI; None is the SI unit."""
        return conversion(
            self.name(unit),
            self.quantity,
            propagation_speed=self.speed,
            carrier=self.carrier,
            convention=self.convention,
            where=where,
        )

    def amount(self, value: float | str, default: Conversion | None, where: str) -> tuple[float, Conversion]:
        """Return the number of an amount and how its unit becomes SI.

        Parameters
        ----------
        value : float or str
            A number in the default unit, or a number and a unit: ``"30 ns"``.
        default : Conversion, optional
            Unit of a bare number; None: a bare number is refused.
        where : str
            Place to name.
        """
        # A number that TOML read is spelled again: one way for both.
        text, _, unit = str(value).strip().partition(" ")
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        # The example repeats the number that was written, so that it can be copied.
        example = f'"{text if math.isfinite(number) else 1.5} {SI_UNIT[self.quantity]}"'
        if not math.isfinite(number):
            raise InvalidProblem(f"{value!r} is no amount", where, f"write a number and a unit, such as {example}")
        if unit.strip():
            return number, self.conversion(unit.strip(), where)
        if default is None:
            raise InvalidProblem(f"{value!r} has no unit", where, f"write it with its unit, such as {example}")
        return number, default

    def plain(self, value: float | str, default: str | None, where: str) -> float:
        """Return an amount in SI units; `default` is the unit of a bare number, None refuses it."""
        number, unit = self.amount(value, None if default is None else self.conversion(default, where), where)
        return float(unit.to_si(number))

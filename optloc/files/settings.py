"""Base of the tables of problem files: closed models, units of their numbers, and places for messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from optloc.base.errors import InvalidProblem
from optloc.base.units import (
    SI_UNIT,
    SPEED_OF_LIGHT,
    AzimuthConvention,
    Conversion,
    Quantity,
    conversion,
    example_of,
    split_amount,
)


def join(*places: str | None) -> str:
    """Return several places as one text, from the file inwards, for messages."""
    return ", ".join(place for place in places if place)


@dataclass(frozen=True, slots=True)
class Units:
    """Quantity of a number, and the settings that its units depend on.

    Parameters
    ----------
    quantity : Quantity
        Determines the permitted units.
    speed : float
        Propagation speed, metres per second.
    carrier : float, optional
        Carrier frequency, hertz.
    convention : AzimuthConvention
        Convention of azimuths.
    """

    quantity: Quantity
    speed: float = SPEED_OF_LIGHT
    carrier: float | None = None
    convention: AzimuthConvention = "east-counterclockwise"

    @property
    def clockwise(self) -> bool:
        """Return whether numbers grow clockwise, as with a compass."""
        return self.convention == "north-clockwise"

    def name(self, unit: str | None) -> str:
        """Return the unit; None becomes the SI unit of the quantity."""
        return SI_UNIT[self.quantity] if unit is None else unit

    def conversion(self, unit: str | None, where: str) -> Conversion:
        """Return the conversion of a unit to SI; None is the SI unit. `where` is the place for messages."""
        return conversion(
            self.name(unit),
            self.quantity,
            propagation_speed=self.speed,
            carrier=self.carrier,
            convention=self.convention,
            where=where,
        )

    def amount(self, value: float | str, default: Conversion | None, where: str) -> tuple[float, Conversion]:
        """Return the number of an amount and the conversion of its unit to SI.

        Parameters
        ----------
        value : float or str
            A number in the default unit, or a number and a unit: ``"30 ns"``.
        default : Conversion, optional
            Unit of a plain number; None rejects a plain number.
        where : str
            Place for messages.
        """
        number, unit = split_amount(value, self.quantity, where)
        if unit:
            return number, self.conversion(unit, where)
        if default is None:
            example = example_of(number, str(value).strip(), self.quantity)
            raise InvalidProblem(f"{value!r} has no unit", where, f"write it with a unit, such as {example}")
        return number, default

    def plain(self, value: float | str, default: str | None, where: str) -> float:
        """Return an amount in SI units; `default` is the unit of a plain number, which None rejects."""
        number, unit = self.amount(value, None if default is None else self.conversion(default, where), where)
        return float(unit.to_si(number))


Bound = Annotated[float, Field(allow_inf_nan=True)]
"""One coordinate of a box; infinite without a bound."""


class FileTable(BaseModel):
    """A table of the file; unknown keys are rejected."""

    # Strict and closed: reject a number in quotes and a misspelt key.
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

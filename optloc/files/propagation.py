"""The propagation speed and the medium of a problem file."""

from __future__ import annotations

from collections.abc import Sequence

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Bias
from optloc.base.units import SPEED_OF_LIGHT, sound_in_air, sound_in_water
from optloc.files.schema import MediumTable, ProblemFile, SoundTable, SpeedTable
from optloc.files.settings import Units, join
from optloc.models.medium import Atmosphere, Layers, Medium
from optloc.problem.bias import SPEED, scale_of

# Keys of each kind of medium.
_MEDIA = {
    "layers": ("depths", "speeds", "between", "surface", "unit", "speed_unit"),
    "atmosphere": ("refractivity", "scale_height"),
}


def medium_in(file: ProblemFile, source: str) -> Medium | None:
    """Return the medium of a problem file; None if the propagation speed is one number."""
    return None if file.medium is None else _medium(file.medium, _stated_speed(file, source), source)


def speed_of(file: ProblemFile, source: str) -> float:
    """Return the speed that converts times to lengths, m/s; by default the speed of light."""
    medium, stated = medium_in(file, source), _stated_speed(file, source)
    if medium is not None:
        return medium.unit_speed
    return SPEED_OF_LIGHT if stated is None else stated


def _medium(table: MediumTable, reference: float | None, source: str) -> Medium:
    """Return the medium of a table; raise InvalidProblem for missing or superfluous keys.

    `reference` is the propagation speed of the file, m/s; None if it states none. It converts times to lengths in
    layers.
    """
    place = join(source, "[medium]")
    permitted_keys = _MEDIA[table.kind]
    given = {key for key in table.model_fields_set - {"kind"} if getattr(table, key) is not None}
    wrong, lacking = (
        sorted(given - set(permitted_keys)),
        [key for key in ("depths", "speeds") if key in permitted_keys and key not in given],
    )
    if wrong:
        raise InvalidProblem(
            f"the kind {table.kind!r} has no {wrong[0]!r}", place, f"use the keys {', '.join(permitted_keys)}"
        )
    if lacking:
        raise InvalidProblem(f"the kind {table.kind!r} needs {lacking[0]}", place, "give a list of numbers")
    if table.kind == "atmosphere" and reference is not None:
        what = "an atmosphere determines the speed: the speed of light over the refractive index"
        raise InvalidProblem(what, place, "remove propagation_speed")
    # functions that convert lengths and speeds from the units of the table to SI
    length, speed = (
        Units(quantity).conversion(unit, place).to_si  # type: ignore[arg-type]
        for quantity, unit in (("length", table.unit), ("speed", table.speed_unit))
    )
    try:
        if table.kind == "atmosphere":
            return Atmosphere(**{key: getattr(table, key) for key in given})
        surface = Units("length").plain(table.surface, table.unit, place)
        depth, speeds = (
            tuple(float(to_si(v)) for v in values or ())
            for to_si, values in ((length, table.depths), (speed, table.speeds))
        )
        return Layers(depth, speeds, table.between, surface, reference)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, place, error.advice) from None


def _stated_speed(file: ProblemFile, source: str) -> float | None:
    """Return the propagation speed that a file states, m/s; None if it states none."""
    given, place = file.propagation_speed, join(source, "key 'propagation_speed'")
    if isinstance(given, SoundTable):
        water = given.medium != "air"
        # Grams of salt in a kilogram of water: sea water has 35 by default, other water none.
        if not water and (given.salinity is not None or given.depth):
            raise InvalidProblem("air has no salinity and no depth", place, "remove them")
        usual = 35.0 if given.medium == "sea water" else 0.0
        salinity = usual if given.salinity is None else given.salinity
        return sound_in_water(given.celsius, salinity, given.depth) if water else sound_in_air(given.celsius)
    if given is None:
        return None
    if isinstance(given, SpeedTable):
        return positive_speed(given.value, "speed", place)
    return positive_speed(given, "speed", place)


def positive_speed(given: float | str, what: str, place: str) -> float:
    """Return a speed or its standard deviation, m/s; raise InvalidProblem for zero or negative values.

    `what` is the noun and `place` the place for the message.
    """
    speed = Units("speed").plain(given, "m/s", place)
    if not speed > 0.0:
        raise InvalidProblem(f"the {what} {given} is not positive", place, 'write it as 340.0 or "340 m/s"')
    return speed


# A speed with a standard deviation: one factor scales all times, so the error of the speed is a scale bias.


def is_time(units: Units, unit: str | None, place: str) -> bool:
    """Return whether values in `unit` are times for a quantity that is a length, so that they depend on the speed."""
    if units.quantity != "length":
        return False
    once, twice = (Units("length", speed=factor * units.speed).conversion(unit, place).factor for factor in (1.0, 2.0))
    return once != twice


def speed_bias(
    file: ProblemFile, written: Sequence[tuple[Array, Units, str]], biases: Sequence[Bias], source: str
) -> tuple[Bias, ...]:
    """Return the scale bias of a speed with a sigma; empty for a speed without a sigma.

    `written` has the global row numbers (m,), the quantity and the unit of each set of values. `biases` are the other
    biases of the file.
    """
    given, place = file.propagation_speed, join(source, "key 'propagation_speed'")
    if not isinstance(given, SpeedTable):
        return ()
    if file.medium is not None:
        raise InvalidProblem("the medium determines the speed", place, "remove the sigma")
    if any(bias.name == SPEED for bias in biases):
        raise InvalidProblem("the bias 'speed' is stated twice", place, "remove [[biases]] 'speed' or the sigma")
    speed, sigma = positive_speed(given.value, "speed", place), positive_speed(given.sigma, "sigma", place)
    rows = [numbers for numbers, units, unit in written if is_time(units, unit, place)]
    return (scale_of(speed, sigma, rows, place),)

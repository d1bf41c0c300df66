"""A table of pseudoranges: which satellite was received when, from where, and how far it seemed."""

from __future__ import annotations

import numpy as np

from optloc.convert.places import Places
from optloc.convert.roles import Roles, stem, unit_of
from optloc.convert.rows import Measured
from optloc.errors import InvalidProblem
from optloc.files.words import Units
from optloc.units import UNITS


def pseudoranges(roles: Roles, unit: str | None) -> tuple[Measured, Places]:
    """Return pseudoranges as arrivals with a clock of each epoch, and the satellites as stations that move, in ECEF."""
    epoch, satellite, z = roles.labels("epoch"), roles.labels("satellite"), roles.numbers("pseudorange")
    unit = unit or unit_of(roles.column("pseudorange"), UNITS["length"]) or "m"
    Units("length").conversion(unit, "--unit")
    length = unit_of(roles.column("x"), UNITS["length"]) or "m"
    place = np.stack([roles.numbers(axis) for axis in "xyz"], axis=-1)
    _far_enough(roles, place * UNITS["length"][length])
    seen: dict[tuple[str, str], int] = {}
    for row, key in enumerate(zip(epoch.tolist(), satellite.tolist(), strict=True)):
        if key in seen:
            what = f"satellite {key[1]!r} occurs again at epoch {key[0]!r}, first in row {seen[key] + 1}"
            raise InvalidProblem(what, roles.table.at(row), "leave one of them out")
        seen[key] = row
    columns = {"epoch": epoch, "a": satellite, "z": z}
    if stem(roles.column("epoch")) != "epoch" and "+" not in roles.column("epoch"):
        columns["time"] = roles.numbers("epoch")
    satellites = {"name": satellite, "epoch": epoch} | dict(zip("xyz", place.T, strict=True))
    return Measured(columns, unit, "the range and the receiver's clock"), Places(satellites, "ecef", length)


def _far_enough(roles: Roles, place: np.ndarray) -> None:
    """Raise InvalidProblem where a satellite is within the Earth: its unit or its columns are other ones."""
    near = np.flatnonzero(np.linalg.norm(place, axis=-1) < 6.4e6)
    if len(near):
        where = roles.table.where(roles.column("x"), int(near[0]))
        away = np.linalg.norm(place[near[0]]) / 1e3
        what = f"the satellite is {away:.4g} km from the centre of the Earth"
        raise InvalidProblem(what, where, "name the columns with --column x=NAME and so on; a unit is seen from x_km")

"""How a table was read: the role of each column, what was assumed, and a refusal where a measurement is left over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.readings import (
    CARTESIAN,
    COMPASS,
    COUNTER,
    Named,
    Readings,
    Told,
    quoted,
    sort_named,
    unused_measurement,
)
from optloc.files.roles import Places, Roles, check_told, place_roles

# Names of columns that one line repeats of a list.
_NAMED = 4
# What azimuths of each convention are.
_ORIENTED = {
    COMPASS: "bearings of a compass",
    CARTESIAN: "angles from the x axis",
    COUNTER: "angles from north, anticlockwise",
}


def uses_of(
    roles: Roles,
    told: Told,
    found: Sequence[Readings],
    epochs: Mapping[str, Array],
    sigmas: Sequence[str | None],
) -> dict[str, str]:
    """Return the role of each column that is used.

    Parameters
    ----------
    roles : Roles
        The table.
    told : Told
        What the user says of it.
    found : sequence of Readings
        The readings, one set for each sort.
    epochs : mapping of str to array (n,)
        Columns epoch, time and target of the rows.
    sigmas : sequence of str or None
        Standard deviation of each sort, None where a column of the table has it.
    """
    out = {cell: one.form.kind for one in found for cell in one.cells}
    long = len(out) == len(found)
    picks = any(one.form.value == "sp" for one in found)
    # Columns of P and S, one of their difference, or one of phases with one of times: see `shapes`.
    by_phase = picks and roles.find("sp") is None and not (roles.find("p") and roles.find("s"))
    wanted = ["phase"] if by_phase else ["sp"] if roles.find("sp") is not None else ["p", "s"]
    wanted = wanted if picks else []
    if long:
        wanted += ["station"]
        wanted += ["reference"] if told.reference is None and any(one.b is not None for one in found) else []
    wanted += ["target"] if "target" in epochs else []
    timed = "time" in epochs or (not told.still and roles.find("message") is None)
    wanted += ["message"] if "epoch" in epochs and told.window is None else []
    wanted += ["time"] if timed or by_phase else []
    if told.stations is None:
        wanted += ["name", *place_roles(roles)]
    for role in wanted:
        column = roles.find(role)
        for part in () if column is None else column.split("+"):
            out.setdefault(part, role)
    out |= {one.heading: "heading" for one in found if one.heading is not None}
    for one, sigma in zip(found, sigmas, strict=True):
        for column in one.errors if sigma is None else ():
            out.setdefault(column, f"sigma_{one.form.kind}")
    return out


def left_over(
    roles: Roles, uses: Mapping[str, str], named: Sequence[Named] = (), *, lengths: bool = False
) -> list[str]:
    """Return the columns that are not used; refuse those that could be measurements, and roles that are not used.

    Parameters
    ----------
    roles : Roles
        The table.
    uses : mapping of str to str
        Role of each column that is used.
    named : sequence of Named
        Columns that are called after stations.
    lengths : bool
        Whether measurements of this table are lengths and their rates: a satellite measures no angles.

    Raises
    ------
    InvalidProblem
        Naming the column, and the option that leaves it out.
    """
    check_told(roles, {role for role, name in roles.by_role.items() if set(name.split("+")) <= set(uses)})
    columns = [*roles.table.columns, *roles.table.others]
    rest = [name for name in columns if name not in uses]
    forms = {one.column: one.form for one in named if one.form is not None and not one.sigma}
    for name in rest:
        what = sort_named(forms[name]).text if name in forms else unused_measurement(name, lengths)
        if what is not None:
            advice = f"--ignore {quoted(name)} leaves it out, --column ROLE={quoted(name)} names its role"
            where = f"{roles.table.source}, column {name!r}"
            raise InvalidProblem(f"it may hold a measurement ({what}) and is not used", where, advice)
    return rest


def about(
    roles: Roles,
    told: Told,
    place: Places,
    found: Sequence[Readings],
    epochs: Mapping[str, Array],
    uses: Mapping[str, str],
) -> list[tuple[str, str]]:
    """Return how a table was read, for a person to check: a word, and what it means for this table."""
    out: list[tuple[str, str]] = []
    for one in found:
        cells = list(dict.fromkeys(one.cells))
        shown = ", ".join(cells[:_NAMED]) + (f" and {len(cells) - _NAMED} more columns" if len(cells) > _NAMED else "")
        unit = f" in {one.unit}" if one.unit != "1" else ""
        text = _ORIENTED.get(str(one.azimuth))
        text = text if one.heading is None else f"bearings from the bow, plus {one.heading}"
        ranges = one.form.kind == "toa" and one.unit not in UNITS["time"]
        text = text or ("pseudoranges, with a clock of each epoch" if ranges else one.form.text)
        out.append((one.form.kind, f"{len(one.values)} readings{unit} from {shown}: {text}"))
        if one.b is not None and one.form.kind != "range_sum":
            sign = "above 1" if one.form.quantity == "ratio" and one.unit == "1" else "positive"
            out.append(("sign", f"{sign} where the {farther(one)} is farther"))
    errors = {name: role.removeprefix("sigma_") for name, role in uses.items() if role.startswith("sigma_")}
    out += [("sigma", f"of {kind}, from column {name}") for name, kind in errors.items()]
    if "epoch" in epochs:
        names = [roles.find(role) for role in (("message", "time") if told.window is None else ("time",))]
        label = next(
            (f"column {name}" for name in names if name is not None and set(name.split("+")) <= set(uses)), "row"
        )
        out.append(("epochs", f"{len(set(epochs['epoch'].tolist()) - {''})} by {label}"))
    elif "time" in epochs:
        each = f"{told.window} each" if told.window else f"{len(np.unique(epochs['time']))}"
        out.append(("epochs", f"{each} by column {roles.find('time')}"))
    if "target" in epochs:
        out.append(("targets", f"{len(set(epochs['target'].tolist()))} by column {roles.find('target')}"))
    where = told.stations.name if told.stations is not None else "the table itself"
    axes = "latitude and longitude" if place.frame == "geodetic" else f"x and y, {place.frame}, in {place.unit}"
    out.append(("stations", f"{len(set(place.names))} of {where}, by {axes}"))
    return out


def farther(found: Readings) -> str:
    """Return which station is farther where a difference is positive, "first" or "second"."""
    # The level at the nearer station is higher, so a positive difference of levels has the farther station second.
    turned = (found.positive == "b-farther") != (found.form.quantity == "level")
    return "second" if turned else "first"

"""Unknowns of a problem file: motions, known targets, biases and priors.

In shapes, k is the number of epochs, and d the dimension. `where` is the place for messages.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import Frame
from optloc.base.time_scales import unix_seconds
from optloc.base.types import Array, Bias, Motion, Prior, Rows
from optloc.base.units import Conversion, Quantity
from optloc.files.row_epochs import Epochs
from optloc.files.schema import BiasTable, FrameTable, Origin, PriorTable, ProblemFile, StationsTable, TargetTable
from optloc.files.settings import Units, join
from optloc.files.stations import stations_over_epochs, survey
from optloc.files.table import Table, table_of
from optloc.problem.bias import family
from optloc.problem.clocks import clock_densities
from optloc.problem.forms import FORMS, BiasForm, complete, form_of

# Number of estimated derivatives of the position for each motion.
_ORDERS = {"static": 0, "free": 0, "free_velocity": 1, "constant_velocity": 1, "constant_acceleration": 2}
FREE = {"free", "free_velocity"}
"""Motions with a separate state at each epoch."""

# Quantity of each unknown and the unit of plain numbers; acceleration has no other units than SI.
_STATES: dict[str, tuple[Quantity, str]] = {
    "position": ("length", "m"),
    "velocity": ("speed", "m/s"),
    "acceleration": ("plain", "1"),
    "emission": ("length", "m"),
}


def motions_of(file: ProblemFile, epochs: Epochs, known: Mapping[str, Array], source: str) -> tuple[Motion, ...]:
    """Return the motion of each target; `known` has the states of known targets."""
    # Free targets in separate epochs share one motion: the target of an epoch is a label.
    names = ("target",) if epochs.own else epochs.targets
    unknown = [name for name in file.targets if name not in epochs.targets]
    if unknown:
        raise InvalidProblem(
            f"no row has the target {unknown[0]!r}",
            join(source, "[targets]"),
            nearest(unknown[0], sorted(set(epochs.targets))),
        )
    return tuple(_motion(file.targets.get(name, file.target), epochs, known.get(name)) for name in names)


def _motion(table: TargetTable, epochs: Epochs, known: Array | None) -> Motion:
    """Return the motion of a target; by default static for one epoch, else a free position at each epoch.

    `known` (k or 1, order + 1, d) are the states of a known target, or None.
    """
    count, reference = epochs.count, table.reference
    if known is not None:
        return Motion(known.shape[-2] - 1, "epoch" if count > 1 else "run", known)
    motion = table.motion or ("static" if count == 1 else "free")
    if reference is not None:
        reference = float(unix_seconds(np.asarray(reference), epochs.scale))
    return Motion(_ORDERS[motion], "epoch" if motion in FREE and count > 1 else "run", reference=reference)


def needs_clock(motions: Sequence[Motion], biases: Sequence[BiasTable]) -> str | None:
    """Return the reason for which the times of the epochs matter, or None."""
    if any(motion.order > 0 and motion.span == "run" and motion.known is None for motion in motions):
        return "a moving target"
    return next((form.noun for bias in biases if (form := FORMS[bias.form]).changes), None)


# Targets with known positions, for calibration: their tables are read like tables of stations.


def places_of(file: ProblemFile, folder: Path, source: str) -> dict[str | None, Table]:
    """Return the tables of known targets by name; None is the table ``[target]``."""
    sections: list[tuple[str | None, TargetTable]] = [(None, file.target), *file.targets.items()]
    found = {}
    for name, section in sections:
        where = join(source, "[target]" if name is None else f"[targets.{name}]")
        if section.moves == "known":
            found[name] = table_of(section, folder, where)
        elif section.file is not None or section.rows is not None:
            advice = 'write motion = "known", or remove the rows'
            raise InvalidProblem(f"the motion is {section.motion}, but positions are given", where, advice)
    return found


def known_of(
    file: ProblemFile, places: Mapping[str | None, Table], epochs: Epochs, frame: Frame, dimension: int
) -> dict[str, Array]:
    """Return the states (k or 1, order + 1, d) of known targets by name: position, and velocity with the order 1; SI.

    `places` are the tables from `places_of`, and `dimension` is d, the dimension of the stations.
    """
    states = {}
    for i, name in enumerate(epochs.targets):
        key = name if name in file.targets else None
        if key in places:
            section = file.target if key is None else file.targets[key]
            wanted = settle_frame(file.frame, frame, dimension)
            states[name] = _states(
                section, places[key], name, epochs, np.unique(epochs.index[epochs.target == i]), wanted
            )
    return states


def _states(
    section: TargetTable, table: Table, name: str, epochs: Epochs, needed_epochs: Array, wanted: FrameTable
) -> Array:
    """Return the states (k or 1, order + 1, d) of a known target from its table: position, and velocity if given.

    `needed_epochs` are the epochs with rows of the target. `wanted` is the frame of the stations. SI units.
    """
    dated = table.has("time") or table.has("epoch")
    if table.count > 1 and not dated:
        raise InvalidProblem(f"target {name!r} has several positions", table.source, "give a column 'time' or 'epoch'")
    names = {key: value for key, value in table.names.items() if key != "name"}
    # Read a known target like a station with its name.
    named = Table(table.source, {**table.columns, "name": np.full(table.count, name, dtype=object)}, table.count, names)
    units = StationsTable(unit=section.unit, speed_unit=section.speed_unit, time_unit=section.time_unit)
    found = replace(survey(units, named, wanted, table.source)[0], noun="target")
    position, velocity = found.position[:, None], None if found.velocity is None else found.velocity[:, None]
    if dated:
        used = np.stack([needed_epochs, np.zeros_like(needed_epochs)], axis=-1)
        position, velocity, _ = stations_over_epochs(found, units, epochs, used)
    return position if velocity is None else np.concatenate([position, velocity], axis=-2)


def settle_frame(wanted: FrameTable, frame: Frame, dimension: int) -> FrameTable:
    """Return the frame table with the origin and the dimension of the stations."""
    # A target must use the frame of the stations, not a separate origin.
    origin = None
    if frame.origin is not None:
        lat, lon = np.degrees(frame.origin[:2]).tolist()
        origin = Origin(lat_deg=lat, lon_deg=lon, height=frame.origin[2])
    return wanted.model_copy(update={"dimension": dimension, "origin": origin})


# Biases and priors.


def bias_of(
    table: BiasTable,
    rows: Sequence[Rows],
    stations: Sequence[str],
    epochs: Epochs,
    dimension: int,
    written: Sequence[tuple[Array, Units, str]],
    source: str,
) -> tuple[Bias, tuple[str, float]]:
    """Return a family of biases over the rows of a problem, and its display unit with the size of the unit in SI units.

    `written` has the global row numbers (m,), the quantity and the unit of each set of values. The display unit is the
    unit of the rows, per second for a drift; it is empty if the rows have several units.
    """
    where = join(source, f"[[biases]] {table.name!r}")
    if table.per == "target" and epochs.own:
        what = "free targets are fixed separately, so they share no bias"
        raise InvalidProblem(what, where, "give the targets a motion, or write one file for each")
    bias = family(
        rows,
        stations,
        table.name,
        per=table.per,
        form=table.form,
        kind=table.kind,
        members=table.members,
        targets=epochs.targets,
        where=where,
    )
    _check_sense(bias, rows, written, where)
    # Priors and estimates have the sign of the readings; the coefficients of the bias include it.
    spelled = {
        (replace(units, convention="east-counterclockwise"), name)
        for numbers, units, name in written
        if np.isin(bias.row, numbers).any()
    }
    # the constructor of the problem rejects epochs without times
    changes = _walk_parameters(table, [units for units, _ in spelled], where)
    if isinstance(table.knots, list):
        changes["knots"] = unix_seconds(np.array(table.knots), epochs.scale).tolist()
    bias = complete(bias, epochs.clock, where, **changes)
    form = form_of(bias)
    mean, sigma = _prior(table, form, [units for units, _ in spelled], form.shape(bias, dimension), where)
    return replace(bias, mean=mean, sigma=sigma), _unit_to_read(form, spelled, where)


def _check_sense(bias: Bias, rows: Sequence[Rows], written: Sequence[tuple[Array, Units, str]], where: str) -> None:
    """Raise InvalidProblem for a bias of clockwise and anticlockwise azimuths, and for a scale of azimuths from north.

    `rows` has a block of rows for each kind; global row numbers count through all blocks in this order. `written` is
    as in `bias_of`.
    """
    ends = np.cumsum([block.count for block in rows])
    touched = {int(i) for i in np.unique(np.searchsorted(ends, bias.row, side="right"))}
    senses = {rows[i].sense for i in touched if rows[i].kind == "azimuth"}
    if len(senses) > 1 and form_of(bias).of_readings:
        what = "the bias affects clockwise and anticlockwise azimuths"
        advice = "use one sense for all, or select stations of one sense with members"
        raise InvalidProblem(what, where, advice)
    north = any(units.convention != "east-counterclockwise" for n, units, _ in written if np.isin(bias.row, n).any())
    if form_of(bias).enters == "scales" and north:
        what = "a scale of bearings would refer to the x axis, not to north"
        raise InvalidProblem(what, where, 'use the form "offset", or azimuth = "east-counterclockwise"')


def _walk_parameters(table: BiasTable, rows: Sequence[Units], where: str) -> dict[str, Any]:
    """Return the parameters of the change of a bias in time by name, SI units: densities and knots.

    `rows` are the quantities and settings of the affected rows.
    """
    found: dict[str, Any] = {}
    # The power of the seconds in the unit: for lengths, a random walk has m^2/s, one of the rate m^2/s^3.
    for key, power in (("density", 1), ("rate_density", 3)):
        text = getattr(table, key)
        if text is not None:
            found[key] = _density(text, power, rows[0], join(where, f"key {key!r}"))
    if table.knots is not None:
        found["knots"] = table.knots
    if table.allan is None:
        return found
    place = join(where, "key 'allan'")
    if found:
        raise InvalidProblem("Allan deviations and densities are both given", place, "give one of them")
    if rows[0].quantity != "length":
        raise InvalidProblem("Allan deviations need rows that are times or lengths", place, "give a density")
    if any(len(pair) != 2 for pair in table.allan):
        raise InvalidProblem("an entry is not two numbers", place, "write [averaging time in s, Allan deviation]")
    tau, deviation = np.array(table.allan).reshape(-1, 2).T
    white, wander = clock_densities(tau, deviation, rows[0].speed)
    return {"density": white, **({"rate_density": wander} if wander > 0.0 else {})}


def _density(text: str, power: int, units: Units, where: str) -> float:
    """Return a spectral density such as "4 ns^2/s" in SI units.

    `power` is the power of the seconds: 1 for a walk, 3 for its rate. `units` is the quantity of the affected rows.
    """
    end = "^2/s" if power == 1 else f"^2/s^{power}"
    number, _, unit = text.strip().partition(" ")
    if not unit.endswith(end):
        example = f'"{number} {units.name(None)}{end}"'
        raise InvalidProblem(f"{text!r} is not a density", where, f"write the unit, such as {example}")
    value, size = units.amount(f"{number} {unit.removesuffix(end)}", None, where)
    return float(value) * size.factor**2


def _unit_to_read(form: BiasForm, spelled: Iterable[tuple[Units, str]], where: str) -> tuple[str, float]:
    """Return the common unit of the rows of an offset or drift, and its size in SI units; else an empty text and 1.

    `spelled` has the quantity and the unit of each set of affected rows.
    """
    sizes = {(name, units.conversion(name, where)) for units, name in spelled}
    (name, size), *more = sizes
    if more or form.quantity is not None or size.logarithmic or size.factor == 1.0:
        return "", 1.0
    return f"{name}/s" if form.rate else name, size.factor


def _prior(
    table: BiasTable, form: BiasForm, rows: Sequence[Units], shape: tuple[int, ...], where: str
) -> tuple[Array, Array | None]:
    """Return the mean and the standard deviation of the prior of a bias, arrays of `shape`, SI.

    The standard deviation is None without a prior. `rows` are the quantities of the affected rows.
    """
    # All rows of a bias have one quantity; carriers may differ between tables.
    carriers = {units.carrier for units in rows}
    units = replace(rows[0], quantity=form.quantity or rows[0].quantity)

    def si(value: float | str, key: str) -> tuple[float, Conversion]:
        """Return the number of an amount under `key`, and the conversion of its unit to SI."""
        place, text = join(where, f"key {key!r}"), value
        bare = "1" if units.quantity in {"plain", "ratio"} and not form.rate else None
        # A drift has the unit of its rows per second, or per second squared for a drift of a rate.
        if form.rate:
            number, _, unit = str(value).strip().partition(" ")
            amount, slash, _ = unit.replace("^2", "/s").rpartition("/s")
            if not slash:
                example = f'"{number} {units.name(None)}/s"'
                raise InvalidProblem(f"{value!r} is not a drift", place, f"write the unit, such as {example}")
            text = f"{number} {amount}"
        if len(carriers) > 1 and str(text).endswith("Hz"):
            raise InvalidProblem("the rows have several carriers", place, "give the value in m/s")
        return units.amount(text, None if bare is None else units.conversion(bare, place), place)

    centre, unit = (0.0, Conversion(1.0)) if table.mean is None else si(table.mean, "mean")
    mean = np.full(shape, float(unit.to_si(centre)))
    if table.sigma is None:
        return mean, None
    size, unit = si(table.sigma, "sigma")
    if size <= 0.0:
        raise InvalidProblem(
            "the standard deviation is not positive", join(where, "key 'sigma'"), "remove it if unknown"
        )
    # A frequency increases when a range rate decreases, so the factor may be negative.
    return mean, np.full(shape, abs(float(unit.to_si(size))))


def prior_of(table: PriorTable, dimension: int, source: str) -> Prior:
    """Return the prior of a state, SI; raise InvalidProblem for an unknown name or a wrong number of coordinates."""
    where = join(source, f"[[priors]] {table.name!r}")
    base = table.name.partition("[")[0]
    if base not in _STATES:
        raise InvalidProblem(
            "there is no such unknown", where, f"{nearest(base, list(_STATES))}; priors of biases belong to the bias"
        )
    quantity, default = _STATES[base]
    units, unit = Units(quantity), default if table.unit is None else table.unit
    size = 1 if base == "emission" else dimension
    if len(table.mean) != size:
        raise InvalidProblem(
            f"the mean has {len(table.mean)} coordinates, not {size}", where, "give one number for each coordinate"
        )
    # A list is in the unit of the mean; a single value may be text with another unit, and is converted to SI here.
    sigmas = table.sigma if isinstance(table.sigma, list) else [units.plain(table.sigma, unit, where)] * size
    sigma = np.array(sigmas) * (units.conversion(unit, where).factor if isinstance(table.sigma, list) else 1.0)
    if len(sigma) != size or (sigma <= 0.0).any():
        raise InvalidProblem(f"sigma is not {size} positive numbers", where, "give one number for each coordinate")
    return Prior(table.name, units.conversion(unit, where).factor * np.array(table.mean), np.diag(sigma**2))

"""Measurements of one table in SI units, with the labels of their epochs and targets.

A section of a problem file gives one `RowChunk` for each measurement kind. `reader` joins the chunks to a `Problem`. In
shapes, m is the number of rows of a chunk, s the number of stations, and r the number of rows of an epoch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np

from optloc.base.arrays import first_rows
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import Frame
from optloc.base.time_scales import TimeScale
from optloc.base.types import Array, Stations
from optloc.base.units import LARGEST, UNITS, Conversion
from optloc.files.declination import declination_of, declinations
from optloc.files.row_epochs import Epochs
from optloc.files.schema import MeasurementsTable, kind_model
from optloc.files.settings import Units, join
from optloc.files.stations import numbers_of
from optloc.files.table import Table
from optloc.files.words import distinct, numbered
from optloc.models import Model
from optloc.problem.phases import Combination
from optloc.problem.signal import Signal

ESTIMATE = "estimate"
"""Keyword instead of a standard deviation: estimate it from the data."""

# Start of the search for a noise level, in SI units; it only affects the relative weights of kinds in the first fixes.
_START_SIGMA = {"angle": 1e-2, "ratio": 1e-2, "speed": 0.1}
# Column with the index in the chunk, in the table of repeats; columns 1 to 7 are the values that make rows equal.
_PLACE = 8
# Asymmetry and negative eigenvalues below this share of a covariance are rounding of the file.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class RowChunk:
    """Rows of one kind.

    Parameters
    ----------
    kind : str
        Measurement kind.
    row : int array (m,)
        Row numbers in the table, from 0.
    z, a, b, weight, correction : array (m,)
        As in `optloc.base.types.Rows`; z is NaN if a value is to be simulated.
    unit : Conversion
        Unit of z.
    units : Units
        Quantity of z, and the settings that its units depend on.
    written_unit : str
        Unit of z in the file.
    slope : array (m,)
        SI units in one unit of the file, with sign.
    baseline : array (m,)
        Distance of the two stations that was added to z, metres.
    sigma : array (m,), optional
        Standard deviation of each row.
    arrival : array (s,), optional
        Standard deviation of the arrivals at each station.
    covariance : array (r, r), optional
        Covariance of the rows of one epoch, in the square of the unit of the file.
    signal : Signal, optional
        Signal that determines the noise.
    label, time, written, target : array (m,), optional
        Columns epoch, time (in seconds; as text) and target.
    excess : bool
        Whether the distance of the two stations must still be added to z.
    table : Table
        Source of the rows.
    declined_on : date, optional
        Date of the magnetic declination.
    declination : array, optional
        Declination at that date at the stations of the present rows, radians; included in the corrections.
    vp_vs : float, optional
        For arrivals with a phase: the speed of P waves divided by the speed of S waves, or "layers".
    combination : Combination, optional
        For combinations of such arrivals: the source of their noise.
    sigma_replaced : bool
        Whether a column of the table replaces the stated sigma of the section.
    after : "time" or "date", optional
        For arrivals: z is seconds after the column time, or after the date that it contains.
    dated : bool
        Whether the column time has dates.
    """

    kind: str
    row: Array
    z: Array
    a: Array
    b: Array
    weight: Array
    correction: Array
    unit: Conversion
    units: Units
    written_unit: str
    slope: Array
    baseline: Array
    sigma: Array | None
    arrival: Array | None
    covariance: Array | None
    signal: Signal | None
    label: Array | None
    time: Array | None
    written: Array | None
    target: Array | None
    excess: bool
    table: Table
    declined_on: date | None = None
    declination: Array | None = None
    vp_vs: float | str | None = None
    combination: Combination | None = None
    sigma_replaced: bool = False
    after: str | None = None
    dated: bool = False

    @property
    def depends_on_speed(self) -> bool:
        """Return whether the wave speed converts the values: they are times of a path, or frequencies."""
        times = self.units.quantity == "length" and self.written_unit in UNITS["time"]
        return times or (self.units.quantity == "speed" and self.written_unit == "Hz")


@dataclass(frozen=True, slots=True)
class Context:
    """Settings of a section and its rows.

    section: settings. table: rows. stations: names of all stations. where: place for messages. speed: propagation
    speed, m/s. values: whether measured values are needed; otherwise a missing column z is NaN. scale: scale of times.
    """

    section: MeasurementsTable
    table: Table
    stations: tuple[str, ...]
    where: str
    speed: float
    values: bool
    scale: TimeScale = "none"


def chunks_of(context: Context) -> list[RowChunk]:
    """Return the rows of one ``[[measurements]]`` table, one chunk for each of its kinds."""
    section, table, where = context.section, context.table, context.where

    def chunk(kind: str, pick: Array) -> RowChunk:
        """Return the rows `pick` of the table, which have the same kind, in SI units."""
        part = table if len(pick) == table.count else table.take(pick)
        return replace(_chunk(replace(context, table=part), kind), row=pick, table=table)

    if section.kind is not None:
        return [chunk(section.kind, np.arange(table.count))]
    if not table.has("kind"):
        raise InvalidProblem("the key 'kind' is missing", where, 'write kind = "tdoa", or give the rows a column kind')
    kinds, first, index = distinct(table.labels("kind"))
    made = []
    # Sort kinds by their first rows, so that a covariance across kinds keeps the order of the file.
    for i in np.argsort(first).tolist():
        kind_model(kinds[i], table.where("kind", int(first[i])))
        made.append(chunk(kinds[i], np.flatnonzero(index == i)))
    return made


def _chunk(c: Context, kind: str) -> RowChunk:
    """Return the rows of a section that has one kind, in SI units; `c` has its settings and its table."""
    section, table = c.section, c.table
    model = kind_model(kind, join(c.where, "key 'kind'"))
    convention = section.azimuth if kind == "azimuth" else "east-counterclockwise"
    there_and_back = kind == "range" and (section.two_way or section.turn_around is not None)
    speed = 0.5 * c.speed if there_and_back else c.speed
    units = Units(model.quantity, speed, section.carrier_hz, convention)  # type: ignore[arg-type]
    _check_options(c, kind, model)
    name = _unit(section, kind, c.where)
    unit = units.conversion(name, join(c.where, "key 'unit'"))
    if there_and_back:
        unit = without_turn_around(c, unit, units.name(name))
    weight = _numbers(c, "weight", 1.0 if section.weight is None else section.weight)
    _check_weight(c, weight)
    z = values_of(c, unit, weight)
    a, b = ends_of(c, kind, model.stations)
    # Reverse a difference by exchanging its stations, not by changing the value: noise and biases then stay valid.
    if section.positive == "b-farther" and _is_difference(model):
        a, b = b, a
    # At most one of the three is not None: standard deviations of rows, of arrivals, or a covariance.
    sigma, arrival, covariance = spread_of(c, model, units, unit, z)
    seconds = Units("time").conversion(section.time_unit, join(c.where, "key 'time_unit'")).factor
    east, day = _declination(c, units.name(name)) if kind == "azimuth" else (0.0, None)
    correction = _correction(c, units, unit)
    return RowChunk(
        kind, np.arange(table.count), z, a, b, weight, correction + east if east else correction, unit, units,
        units.name(name), np.broadcast_to(unit.slope(z), z.shape), np.broadcast_to(0.0, z.shape),
        sigma, arrival, covariance, signal_of(c),
        table.labels("epoch") if table.has("epoch") else None,
        table.times("time", seconds, c.scale) if table.has("time") else None,
        table.labels("time") if table.has("time") and not table.has("epoch") else None,
        table.labels("target") if table.has("target") else None,
        section.excess and _is_range_sum(model), table, day, vp_vs=section.vp_vs,
        sigma_replaced=table.has("sigma") and section.sigma is not None,
        after=section.after if kind == "toa" else None, dated=table.has("time") and table.has_dates("time"),
    )  # fmt: skip


def _check_options(c: Context, kind: str, model: Model) -> None:
    """Raise InvalidProblem for an option of a section that its kind does not use."""
    section = c.section
    if section.vp_vs is not None and (kind != "toa" or not c.table.has("phase")):
        advice = 'use the kind "toa" with a column phase, or remove the key'
        raise InvalidProblem("vp_vs is for arrivals with a phase", join(c.where, "key 'vp_vs'"), advice)
    if section.vp_vs is not None and section.sigma == ESTIMATE:
        raise InvalidProblem("P and S arrivals need a stated sigma", join(c.where, "key 'sigma'"), 'write "0.1 s"')
    if section.kind is None:
        return  # settings of a table of several kinds apply to the kinds that use them
    if section.excess and not _is_range_sum(model):
        raise InvalidProblem(
            f"{kind} has no excess path", join(c.where, "key 'excess'"), "remove it; it is for range_sum"
        )
    if section.positive == "b-farther" and not _is_difference(model):
        raise InvalidProblem(f"{kind} has no sign", join(c.where, "key 'positive'"), "remove the key")
    if section.after is not None and (kind != "toa" or not c.table.has("time")):
        advice = 'use the kind "toa" with a column time, or remove the key'
        raise InvalidProblem("after is for arrivals with a time", join(c.where, "key 'after'"), advice)
    if kind != "range" and (section.two_way or section.turn_around is not None):
        place = join(c.where, "key 'two_way'" if section.two_way else "key 'turn_around'")
        raise InvalidProblem(f"{kind} has no way back", place, "remove it; it is for range")
    if kind != "azimuth":
        north = section.azimuth not in {None, "east-counterclockwise"}
        key = "azimuth" if north else "declination" if section.declination is not None else None
        if key is not None:
            raise InvalidProblem(f"{kind} is not an azimuth", join(c.where, f"key {key!r}"), "remove the key")


def without_turn_around(c: Context, unit: Conversion, name: str) -> Conversion:
    """Return the conversion of two-way times to ranges: half of the time without the turn-around, times the speed.

    `unit` is the conversion of half of a time, and `name` the name of the unit. Raise InvalidProblem for a length, or
    for a turn-around time that is negative.
    """
    place = join(c.where, "key 'two_way'" if c.section.two_way else "key 'turn_around'")
    if name not in UNITS["time"]:
        advice = f"give times, or remove the setting; the ranges are in {name}"
        raise InvalidProblem("two-way ranges are times", place, advice)
    if c.section.turn_around is None:
        return unit
    seconds = Units("time").plain(c.section.turn_around, None, place)
    if seconds < 0.0:
        raise InvalidProblem("the turn-around time is negative", place, 'write it as "2 ms"')
    return replace(unit, offset=-0.5 * c.speed * seconds)


def _is_range_sum(model: Model) -> bool:
    """Return whether a row is a sum of two ranges; then a file may omit the distance between the stations."""
    return model.ranges is not None and sum(model.ranges) > 1


def _is_difference(model: Model) -> bool:
    """Return whether a row is a difference or ratio between two stations, so that its sign can be reversed."""
    return model.stations > 1 and not _is_range_sum(model)


def _unit(section: MeasurementsTable, kind: str, where: str) -> str | None:
    """Return the unit of a kind in a section; None if none is stated."""
    if not isinstance(section.unit, dict):
        return section.unit
    if section.kind is None or kind in section.unit:
        return section.unit.get(kind)
    raise InvalidProblem(
        f"the units do not name {kind}", join(where, "key 'unit'"), nearest(kind, sorted(section.unit))
    )


def _numbers(c: Context, key: str, default: float) -> Array:
    """Return a column of numbers (m,); `default` in each row if the table does not have the column."""
    return c.table.numbers(key) if c.table.has(key) else np.broadcast_to(default, (c.table.count,))


def _check_weight(c: Context, weight: Array) -> None:
    """Raise InvalidProblem for a weight (m,) outside 0 to 1."""
    bad = np.flatnonzero(~((weight >= 0.0) & (weight <= 1.0)))
    if len(bad):
        place = c.table.where("weight", int(bad[0]))
        raise InvalidProblem(
            f"the weight {weight[bad[0]]:g} is outside 0 to 1", place, "use 0 for absent, 1 for present"
        )


def values_of(c: Context, unit: Conversion, weight: Array) -> Array:
    """Return z (m,) in SI units: zero for absent rows (weight 0), NaN for values that are missing and not needed.

    Raise InvalidProblem for an empty cell, or a value that is too large.
    """
    if not (c.values or c.table.has("z") or "z" in c.table.names):
        return np.full(c.table.count, np.nan)
    raw = c.table.numbers("z", optional=bool((weight == 0.0).any()) or not c.values)
    empty = np.flatnonzero(np.isnan(raw) & (weight > 0.0))
    if len(empty) and c.values:
        # Read again as mandatory numbers: this raises with the empty cell.
        c.table.numbers("z")
        raise AssertionError
    # An absent row may have any value, or none: zero keeps sums finite.
    z = np.where(weight > 0.0, unit.to_si(raw), 0.0)
    large = np.flatnonzero(np.abs(z) > LARGEST)  # for example 5000 dB is a valid cell, but not a valid ratio
    if len(large):
        raise InvalidProblem(f"the value exceeds {LARGEST:g}", c.table.where("z", int(large[0])), "correct it")
    return z


def _stations(c: Context, key: str, needed: bool) -> Array:
    """Return the station numbers (m,) of the rows, from the column or the setting `key`, which is "a" or "b".

    The numbers are -1 if the kind does not need this station. Raise InvalidProblem for an unknown station.
    """
    if not needed:
        return np.broadcast_to(-1, (c.table.count,))
    single = getattr(c.section, key)
    column = c.table.has(key) or single is None
    names, index = numbered(c.table.labels(key)) if column else ([single], np.zeros(c.table.count, dtype=np.int64))

    def where(name: int) -> str:
        row = int(np.flatnonzero(index == name)[0])
        return c.table.where(key, row) if c.table.has(key) else join(c.where, f"key {key!r}")

    return numbers_of(names, c.stations, where)[index]


def ends_of(c: Context, kind: str, count: int) -> tuple[Array, Array]:
    """Return the station numbers a and b (m,) of rows with `count` stations; -1 for no station.

    Raise InvalidProblem if a row has the same station twice.
    """
    a, b = (_stations(c, key, count > i) for i, key in enumerate("ab"))
    same = np.flatnonzero(a == b)
    if count > 1 and len(same):
        what = f"{kind} names station {c.stations[a[same[0]]]!r} twice"
        raise InvalidProblem(what, c.table.at(int(same[0])), "name two stations")
    return a, b


def _correction(c: Context, units: Units, unit: Conversion) -> Array:
    """Return the corrections (m,), SI: offsets of rows from the model. Corrections of azimuths are clockwise.

    `unit` is the unit of a correction without a unit.
    """
    if c.table.has("correction"):
        return c.table.numbers("correction") * _correction_factor(unit, units, c)
    if c.section.correction is None:
        return np.broadcast_to(0.0, (c.table.count,))
    number, stated_unit = units.amount(c.section.correction, unit, join(c.where, "key 'correction'"))
    return np.full(c.table.count, number * _correction_factor(stated_unit, units, c))


def _correction_factor(unit: Conversion, units: Units, c: Context) -> float:
    """Return the SI amount of one unit of a correction; its sign is negative for azimuths, which are clockwise.

    Raise InvalidProblem for a correction in dB, which is not an additive amount.
    """
    if unit.logarithmic:
        raise InvalidProblem("a correction cannot be in dB", join(c.where, "key 'correction'"), "correct z itself")
    # A correction of 4 deg is added to a compass bearing: the reading is 4 deg anticlockwise of the true direction.
    return -unit.factor if units.clockwise else unit.factor


def _declination(c: Context, unit: str) -> tuple[float, date | None]:
    """Return the declination of a section, radians, and None; or zero and the date that determines it.

    The result is zero and None without a declination. `unit` is the unit of a plain number.
    """
    if c.section.declination is None:
        return 0.0, None
    place = join(c.where, "key 'declination'")
    advice = 'write azimuth = "north-clockwise" or "north-counterclockwise", or remove the declination'
    # Bearings from magnetic north are smaller than true bearings by the declination (east positive).
    return declination_of(c.section.declination, c.section.azimuth, unit, place, advice)


def with_declination(chunk: RowChunk, epoch: Array, stations: Stations, frame: Frame) -> RowChunk:
    """Return a chunk with the magnetic declination of its date added to the corrections.

    `epoch` (m,) is the epoch of each row. The declination depends on the positions of the stations at that epoch.
    """
    if chunk.declined_on is None:
        return chunk
    used = np.flatnonzero(chunk.weight > 0.0)
    moment = epoch[used] if len(stations.position) > 1 else np.zeros_like(used)
    east = np.zeros(len(epoch))
    where = join(chunk.table.source, "key 'declination'")
    east[used] = declinations(stations.position[moment, chunk.a[used]], frame, chunk.declined_on, where)
    return replace(chunk, correction=chunk.correction + east, declination=east[used])


def declination_text(chunks: Sequence[RowChunk]) -> str:
    """Return a text with the magnetic declination from a date; empty if no date is stated."""
    found = [chunk.declination for chunk in chunks if chunk.declination is not None and len(chunk.declination)]
    if not found:
        return ""
    low, high = (f"{end(np.degrees(np.concatenate(found))):+.2f}" for end in (np.min, np.max))
    return f"; magnetic declination {low if low == high else f'{low} to {high}'} deg, east positive"


# Noise of a table.


def spread_of(
    c: Context, model: Model, units: Units, unit: Conversion, z: Array
) -> tuple[Array | None, Array | None, Array | None]:
    """Return standard deviations (m,), arrival standard deviations (s,) and covariance (r, r); at most one is not None.

    All are None without noise, or if a signal determines the noise (`signal_of`). The covariance is in the square of
    the unit of the file, the others in SI units. `unit` is the unit of z and of plain numbers; `z` (m,) are the
    measured values in SI units.
    """
    section = c.section
    column = c.table.has("sigma")
    forms = (section.arrival_sigma, section.covariance, section.snr)
    if sum((column or section.sigma is not None, *(form is not None for form in forms))) > 1:
        advice = "give sigma, arrival_sigma, covariance or snr"
        raise InvalidProblem("the noise is given more than once", c.where, advice)
    # The search for the noise level starts from a typical value of the quantity, SI units.
    if section.sigma == ESTIMATE and not column:
        return np.full(z.shape, _START_SIGMA.get(model.quantity, 1.0)), None, None
    if (sigma := sigma_of(c, units, unit, z)) is not None:
        return sigma, None, None
    if section.arrival_sigma is not None:
        return None, _arrival_sigmas(c, model, units, unit, section.arrival_sigma), None
    # A matrix stays in the unit of the file until the slope of each row is known.
    covariance = None if section.covariance is None else square(section.covariance, join(c.where, "key 'covariance'"))
    return None, None, covariance


def sigma_of(c: Context, units: Units, unit: Conversion, z: Array) -> Array | None:
    """Return the standard deviations (m,), SI, from the column or the key sigma; None without either.

    `z` (m,) are the measured values in SI units: the standard deviation of a level in decibels depends on the value.
    `unit` is the unit of plain numbers.
    """
    if c.table.has("sigma"):
        return _positive(c, unit.sigma_to_si(c.table.numbers("sigma"), z), column=True)
    if c.section.sigma is None:
        return None
    number, stated_unit = units.amount(c.section.sigma, unit, join(c.where, "key 'sigma'"))
    return _positive(c, np.broadcast_to(stated_unit.sigma_to_si(number, z), z.shape), column=False)


def signal_of(c: Context) -> Signal | None:
    """Return the signal that determines the noise of rows, or None without a signal.

    The signal-to-noise ratio is NaN for a station without a value. Raise InvalidProblem if a part is missing.
    """
    section, parts = c.section, ("snr", "bandwidth", "duration")
    lacking = [name for name in parts if getattr(section, name) is None]
    if section.snr is None or section.bandwidth is None or section.duration is None:
        if len(lacking) < len(parts):
            raise InvalidProblem(f"the noise of a signal needs {' and '.join(lacking)}", c.where, "give all three")
        return None
    given = section.snr if isinstance(section.snr, Mapping) else dict.fromkeys(c.stations, section.snr)
    place, snr = join(c.where, "key 'snr'"), np.full(len(c.stations), np.nan)
    for i, value in zip(numbers_of([*given], c.stations, place), given.values(), strict=True):
        snr[i] = Units("power").plain(value, "1", place)
    bandwidth = Units("frequency").plain(section.bandwidth, "Hz", join(c.where, "key 'bandwidth'"))
    duration = Units("time").plain(section.duration, "s", join(c.where, "key 'duration'"))
    try:
        return Signal(snr, bandwidth, duration, speed=c.speed)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, join(c.where, f"key {error.where!r}"), error.advice) from None


def _positive(c: Context, sigma: Array, *, column: bool) -> Array:
    """Return standard deviations `sigma` (m,); raise InvalidProblem for values that are not positive, or too large.

    `column` is whether they are from a column, so that the message can name the row.
    """
    bad = np.flatnonzero(~((sigma > 0.0) & (sigma <= LARGEST)))
    if len(bad):
        place = c.table.where("sigma", int(bad[0])) if column else join(c.where, "key 'sigma'")
        why = f"larger than {LARGEST:g}" if sigma[bad[0]] > 0.0 else "not positive"
        raise InvalidProblem(f"the standard deviation is {why}", place, "give a positive number")
    return sigma


def _arrival_sigmas(
    c: Context, model: Model, units: Units, unit: Conversion, given: float | str | Mapping[str, float | str]
) -> Array:
    """Return the standard deviation (s,) of the arrivals at each station, SI.

    `given` is one value for all stations, or a mapping from stations to values. Stations without a value have zero.
    `unit` is the unit of a plain number.
    """
    place = join(c.where, "key 'arrival_sigma'")
    if model.signs is None:
        raise InvalidProblem("these rows are not sums or differences of arrivals", place, "give sigma or covariance")
    if not isinstance(given, Mapping):
        given = dict.fromkeys(c.stations, given)
    # A station without an entry measures exactly; rows without any noise are rejected later.
    sigma = np.zeros(len(c.stations))
    for i, value in zip(numbers_of([*given], c.stations, place), given.values(), strict=True):
        number, stated_unit = units.amount(value, unit, place)
        sigma[i] = stated_unit.sigma_to_si(number)
        if number <= 0.0:
            raise InvalidProblem("the standard deviation is not positive", place, "give a positive number")
    return sigma


def square(rows: list[list[float]], where: str) -> Array:
    """Return a covariance as an array (r, r); raise InvalidProblem if it is not a covariance matrix."""
    r = len(rows)
    if r == 0:
        raise InvalidProblem("the covariance is empty", where, "give a square matrix")
    for i, row in enumerate(rows):
        if len(row) != r:
            what = f"row {i + 1} of the covariance has {len(row)} numbers, not {r}"
            raise InvalidProblem(what, where, "give a square matrix")
    matrix = np.array(rows, dtype=float)
    i, j = divmod(int(np.argmax(np.abs(matrix - matrix.T))), r)
    if abs(matrix[i, j] - matrix[j, i]) > _ROUNDING * np.abs(matrix).max():
        entries = f"({i + 1}, {j + 1}) is {matrix[i, j]:g}, ({j + 1}, {i + 1}) is {matrix[j, i]:g}"
        raise InvalidProblem(f"the covariance is not symmetric: entry {entries}", where, "make both entries equal")
    diagonal = np.diagonal(matrix)
    if (diagonal <= 0.0).any():
        place = int(np.flatnonzero(diagonal <= 0.0)[0]) + 1
        raise InvalidProblem(
            f"the variance ({place}, {place}) is {diagonal[place - 1]:g}, not positive", where, "correct the matrix"
        )
    lowest = np.linalg.eigvalsh(matrix)[0]
    if lowest < -_ROUNDING * diagonal.max():
        raise InvalidProblem(f"the covariance has the negative eigenvalue {lowest:g}", where, "correct the matrix")
    return matrix


# Repeated rows, which occur when a file is joined from overlapping parts.


def check_repeats(
    chunks: Sequence[RowChunk], index: Sequence[Array], target: Sequence[Array], stations: Sequence[str], epochs: Epochs
) -> None:
    """Raise InvalidProblem for a row that repeats another row; the message names both.

    Two measurements of the same stations at the same epoch are valid if their noise is independent. The same value at
    the same stated time or epoch is a copy. With the noise of arrivals, both rows have the same noise, so only one can
    be right. `index` and `target` are the epoch and target (m,) of each row, for each chunk.
    """
    for kind in dict.fromkeys(chunk.kind for chunk in chunks):
        same = [i for i, chunk in enumerate(chunks) if chunk.kind == kind]
        # Add 1, since a missing station has the number -1.
        ends = [(chunks[i].a + 1, chunks[i].b + 1, index[i], target[i]) for i in same]
        keys_of_rows = [np.concatenate(each) for each in zip(*ends, strict=True)]
        if len(first_rows(*keys_of_rows)[0]) == len(keys_of_rows[0]):
            continue  # all rows have different stations or epochs
        # Sort by all values that make rows equal. Equal rows are then neighbours, in the order of the file.
        table = np.concatenate([_table(chunks[i], index[i], target[i], i) for i in same], axis=1)
        order = np.lexsort(table[_PLACE:0:-1])
        keys = table[1:_PLACE, order]
        twice = np.flatnonzero((keys[:, 1:] == keys[:, :-1]).all(0))
        if len(twice):
            # Report the copy that comes first in the file. Column 3 is the epoch, and column `_PLACE` the row.
            at = twice[np.argmin(order[twice + 1])]
            one, two = (table[[0, _PLACE], order[i]].astype(int) for i in (at, at + 1))
            epoch = epochs.labels[int(table[3, order[at]])]
            raise _repeated((chunks[two[0]], two[1]), (chunks[one[0]], one[1]), stations, epoch)


def _table(chunk: RowChunk, index: Array, target: Array, number: int) -> Array:
    """Return columns (9, m): chunk number, the values that make rows equal, and the index in the chunk.

    Only present rows that could be copies are included. Columns 1 to 7 are the stations a and b, epoch, target, whether
    the noise of rows is independent, value and time. Rows with equal columns 1 to 7 are copies. `index` and `target`
    (of each row) are the epoch and the target; `number` is the number of the chunk.
    """
    # With noise of arrivals, a second row of the same stations has the same noise. So it is a copy with any value.
    independent = chunk.arrival is None and chunk.signal is None
    time = np.zeros(len(index)) if chunk.time is None or not independent else chunk.time
    value = chunk.z if independent else np.zeros(len(index))
    same = (chunk.a, chunk.b, index, target, np.full(len(index), independent), value, time)
    table = np.array([np.full(len(index), number), *same, np.arange(len(index))], dtype=float)
    # Rows without time and label may be repeated measurements of a static target.
    dated = not independent or chunk.label is not None or chunk.time is not None
    return table[:, (chunk.weight > 0.0) & ~np.isnan(value) & dated]


def _repeated(
    again: tuple[RowChunk, int], first: tuple[RowChunk, int], stations: Sequence[str], epoch: str
) -> InvalidProblem:
    """Return the error for a row that repeats another row; it names both rows.

    `again` and `first` are the later and the earlier row: a chunk and the index of the row in it.
    """
    (chunk, i), (other, j) = again, first
    names = "-".join(stations[s] for s in (chunk.a[i], chunk.b[i]) if s >= 0)
    row = f"row {other.row[j] + 1}" + ("" if other.table is chunk.table else f" of {other.table.source}")
    what = " ".join(f"{chunk.kind} {names} of epoch {epoch!r} is already in {row}".split())
    advice = "remove one row, or give the rows different epochs"
    if chunk.arrival is not None or chunk.signal is not None:
        what += f"; with {'snr' if chunk.arrival is None else 'arrival_sigma'}, both have the same noise"
    return InvalidProblem(what, chunk.table.where("z", int(chunk.row[i])), advice)

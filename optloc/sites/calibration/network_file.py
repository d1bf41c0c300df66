"""Network files: stations with unknown coordinates, pulses and distances; output of a result as a problem file.

Letters: M stations, N pulses, R slots (columns of measurements), m rows of a section of the file, d
coordinates.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from optloc.files import (
    Context,
    DataTable,
    MeasurementsTable,
    ProblemFile,
    Table,
    Units,
    claim,
    distinct,
    ends_of,
    is_time,
    join,
    name_of,
    parse_toml,
    read_text,
    sigma_of,
    table_of,
    toml_text,
    validated,
    values_of,
    with_standard_columns,
    without_turn_around,
    write_text,
)
from optloc.models import MODELS, kind_named
from optloc.problem import Amount, Array, InvalidProblem, nearest
from optloc.sites.calibration.calibrated import Calibration
from optloc.sites.calibration.network import KINDS, Network, NetworkSlot, checked, network_speed
from optloc.sites.calibration.network_checks import refuse_negative, require_speed, suspicious_network

# Smallest standard deviation of stations in the output file, metres: as good as exact.
_EXACT = 1e-6

BETWEEN = "station_range"
"""Kind of the rows with a distance between two stations."""


class _NetworkTable(BaseModel):
    """A table of the network file; unknown keys are an error."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class NetworkStations(DataTable):
    """The stations. Columns: name; x, y, z (empty if unknown); sigma of known coordinates."""

    unit: str = "m"
    """Unit of x, y, z and sigma."""
    sigma: Amount | None = None
    """Standard deviation of known coordinates; None: exact."""
    synchronised: bool = True
    """Whether the stations share a clock; otherwise each station has an unknown offset."""
    dimension: Literal[2, 3] = 3
    """Number of dimensions."""


class NetworkRows(DataTable):
    """Measurements of one kind. Columns: epoch (the pulse), a, b (for pairs of stations), z, sigma."""

    kind: str
    """toa, tdoa or range; station_range is the distance between stations a and b and has no epoch."""
    unit: str = "m"
    """Unit of z: a length or a time."""
    sigma: Amount | None = None
    """Standard deviation of each row, if there is no column sigma."""
    two_way: bool = False
    """Whether ranges are times of the way there and back."""
    turn_around: Amount | None = None
    """Time from arrival to reply at the other end of two-way ranges: "2 ms"."""


class NetworkFile(_NetworkTable):
    """A network with unknown stations."""

    format: Literal[1, 2]
    """Version of the format; network files are the same in both versions."""
    title: str | None = None
    """Title of the network."""
    propagation_speed: Amount | None = None
    """Metres per second, or text such as "1480 m/s", "air:20C" or "water:8C,35,50m"; the speed of light by default."""
    stations: NetworkStations
    measurements: list[NetworkRows] = Field(min_length=1)


def read_network(
    path: Path, wave_speed: str | None = None, *, two_way: bool = False, turn_around: str | None = None
) -> Network:
    """Return the network of a file; see `load_network`."""
    return load_network(path, wave_speed, two_way=two_way, turn_around=turn_around).network


class LoadedNetwork(NamedTuple):
    """A network that was read from a file.

    - network: the network.
    - warnings: sentences about values that are physically suspicious.
    - wave: the wave speed with which times were converted, as text; empty if no value is a time.
    """

    network: Network
    warnings: tuple[str, ...]
    wave: str


def load_network(
    path: Path, wave_speed: str | None = None, *, two_way: bool = False, turn_around: str | None = None
) -> LoadedNetwork:
    """Return the network of a file, sentences about suspicious values, and the wave speed.

    Parameters
    ----------
    path : Path
        The file.
    wave_speed : str, optional
        Wave speed that replaces the speed of the file, such as "air:20C".
    two_way : bool
        Whether all ranges are times of the way there and back, whatever the file states.
    turn_around : str, optional
        Time between arrival and reply at the other end of two-way ranges, such as "2 ms".

    Raises
    ------
    InvalidProblem
        If the file is invalid; the message names file, row and column or key.
    """
    source, folder = name_of(path), path.parent
    data = parse_toml(read_text(path), source, formats=(1, 2))
    foreign = [key for key in ProblemFile.model_fields if key in data and key not in NetworkFile.model_fields]
    if foreign:
        what = f"the key {foreign[0]!r} belongs to a problem with known stations, not to a network"
        raise InvalidProblem(what, source, "use optloc fix, or see optloc new calibration")
    file = validated(NetworkFile, data, source)
    given, where = file.propagation_speed, join(source, "key 'propagation_speed'")
    stated = network_speed(*((given, where) if wave_speed is None else (wave_speed, "--wave-speed")))
    speed = stated.speed
    table = with_standard_columns(
        table_of(file.stations, folder, where := join(source, "[stations]")), file.stations.unit
    )
    names = tuple(str(name) for name in table.labels("name"))
    place, place_sigma = _prior_places(file.stations, table, where)
    if (two_way or turn_around is not None) and all(section.kind != "range" for section in file.measurements):
        option = "--two-way" if two_way else "--turn-around"
        raise InvalidProblem("the file has no ranges", option, "remove this option")
    read = [
        _section_rows(section, i, folder, source, names, speed, (two_way, turn_around))
        for i, section in enumerate(file.measurements)
    ]
    rows, apart = ([one for one in read if (one[0] == BETWEEN) is between] for between in (False, True))
    if not rows:
        raise InvalidProblem("the file has no pulses", source, 'add [[measurements]] of kind "toa", "tdoa" or "range"')
    labels, slots, table_z, table_sigma = _tables_by_pulse(rows)
    ends = np.array([[a, b] for one in apart for a, b in zip(one[2], one[3], strict=True)], dtype=np.int64)
    network = checked(
        Network(
            names,
            slots,
            table_z,
            table_sigma,
            place,
            place_sigma,
            file.stations.synchronised,
            ends.reshape(-1, 2),
            np.concatenate([np.zeros(0), *(one[4] for one in apart)]),
            np.concatenate([np.zeros(0), *(one[5] for one in apart)]),
            labels,
        )
    )
    factors = {one.kind: Units("length", speed).conversion(one.unit, source).factor for one in file.measurements}
    timed = any(is_time(Units("length"), section.unit, source) for section in file.measurements)
    if timed and given is None and wave_speed is None:
        require_speed(network, source, '--wave-speed air:20C or propagation_speed = "air:20C"')
    return LoadedNetwork(network, suspicious_network(network, factors, speed), stated.words if timed else "")


_Rows = tuple[str, Array, Array, Array, Array, Array]
"""Rows of a section: kind, pulses, stations a and b (-1 without), values and standard deviations, metres."""


def _section_rows(
    section: NetworkRows,
    number: int,
    folder: Path,
    source: str,
    names: tuple[str, ...],
    speed: float,
    options: tuple[bool, str | None],
) -> _Rows:
    """Return the rows of the section with this number; raise InvalidProblem for wrong rows, such as negative ranges.

    `options` are the options on two-way times: whether ranges are such times, and their turn-around time.
    """
    place_of = join(source, f"[[measurements]] {number + 1}")
    table = table_of(section, folder, place_of)
    between = section.kind == BETWEEN
    if not between and not table.has("epoch"):
        advice = "add a column epoch; for known stations, use optloc fix"
        raise InvalidProblem("the rows have no column epoch for the pulse", table.source, advice)
    kind = BETWEEN if between else kind_named(section.kind, place_of)
    if not between and kind not in KINDS:
        raise InvalidProblem(f"networks have no rows of kind {kind!r}", place_of, nearest(kind, [*KINDS, BETWEEN]))
    ways = _ways(section, kind, place_of, two_way=options[0], turn_around=options[1])
    settings = MeasurementsTable(sigma=section.sigma, two_way=ways[0], turn_around=ways[1])
    read = Context(settings, table, names, place_of, speed, values=True)
    z, sigma = _values_and_sigmas(read, section.unit)
    a, b = ends_of(read, kind, 2 if between else MODELS[kind].stations)
    if kind in ("range", BETWEEN):
        ends = [f"from {names[i]} to {names[j]}" if between else f"at {names[i]}" for i, j in zip(a, b, strict=True)]
        refuse_negative(z, sigma, ends.__getitem__, lambda i: table.where("z", i), "remove the row")
    return kind, table.labels("epoch") if not between else np.zeros(len(z), dtype=object), a, b, z, sigma


def _prior_places(section: NetworkStations, table: Table, where: str) -> tuple[Array, Array]:
    """Return prior station coordinates (M, d) and their standard deviations, metres.

    `section` is the table of stations in the file, and `table` are its rows. If a cell is empty, the coordinate
    is 0 and its standard deviation is infinite. `where` is the location of the section for messages.
    """
    unit = Units("length").conversion(section.unit, where)
    keys = ("x", "y", "z")[: section.dimension]
    if section.dimension == 2 and table.has("z"):
        raise InvalidProblem(
            "a network of dimension 2 has no column z", where, "remove the column, or write dimension = 3"
        )
    place = np.array([_optional_column(table, key) for key in keys]).T * unit.factor
    column = _optional_column(table, "sigma") * unit.factor
    common = 0.0 if section.sigma is None else Units("length").plain(section.sigma, section.unit, where)
    sigma = np.where(np.isnan(column), common, column)[:, None]
    if (sigma < 0.0).any():
        raise InvalidProblem("a standard deviation is negative", where, "give zero for an exact position")
    return np.where(np.isnan(place), 0.0, place), np.where(np.isnan(place), np.inf, sigma)


def _optional_column(table: Table, key: str) -> Array:
    """Return a column as numbers (q,), NaN where a cell or the column is missing."""
    return table.numbers(key, optional=True) if table.has(key) else np.full(table.count, np.nan)


def _ways(
    section: NetworkRows, kind: str, where: str, *, two_way: bool, turn_around: str | None
) -> tuple[bool, Amount | None]:
    """Return whether the rows of a section are two-way times, and their turn-around time.

    `two_way` and `turn_around` replace the keys of ranges. Raise InvalidProblem for these keys with other kinds.
    """
    stated = section.two_way or section.turn_around is not None
    if kind != "range":
        if stated:
            key = "two_way" if section.two_way else "turn_around"
            advice = "remove it; it is for range"
            raise InvalidProblem(f"{section.kind} has no way back", join(where, f"key {key!r}"), advice)
        return False, None
    pause = section.turn_around if turn_around is None else turn_around
    return stated or two_way or turn_around is not None, pause


def _values_and_sigmas(read: Context, name: str) -> tuple[Array, Array]:
    """Return values (m,) and standard deviations (m,) of the rows of one section, metres.

    `read` contains its table, and `name` is the unit in the file.
    """
    both_ways = read.section.two_way
    units = Units("length", 0.5 * read.speed if both_ways else read.speed)
    unit = units.conversion(name, join(read.where, "key 'unit'"))
    unit = without_turn_around(read, unit, units.name(name)) if both_ways else unit
    z = values_of(read, unit, np.ones(read.table.count))
    sigma = sigma_of(read, units, unit, z)
    if sigma is None:
        advice = 'write sigma = "5 cm", or a column sigma'
        raise InvalidProblem("the rows have no standard deviation", read.where, advice)
    return z, sigma


def _tables_by_pulse(
    rows: list[_Rows],
) -> tuple[tuple[str, ...], tuple[NetworkSlot, ...], Array, Array]:
    """Return labels (N) of pulses, slots (R), and tables (N, R) of values and standard deviations, metres.

    Each entry of `rows` is a section of the file: kind, pulses, stations a and b (-1 without), values and
    standard deviations. If the same stations measure a pulse several times, each repetition has its own slot.
    Cells without a measurement have an infinite standard deviation.
    """
    # `pulse` is the pulse of each row over all sections. `seen` counts the repetitions of a row in a pulse.
    labels, _, pulse = distinct(np.concatenate([one[1] for one in rows]))
    slots: dict[tuple[str, int, int, int], int] = {}
    cells: list[tuple[int, int, float, float]] = []
    seen: dict[tuple[int, str, int, int], int] = {}
    at = 0
    for kind, epochs, a, b, z, sigma in rows:
        for i in range(len(epochs)):
            j = int(pulse[at])
            at += 1
            key = (j, kind, int(a[i]), int(b[i]))
            seen[key] = seen.get(key, -1) + 1
            slot = slots.setdefault((kind, int(a[i]), int(b[i]), seen[key]), len(slots))
            cells.append((j, slot, float(z[i]), float(sigma[i])))
    table = np.zeros((len(labels), len(slots)))
    deviations = np.full(table.shape, np.inf)
    for j, slot, value, deviation in cells:
        table[j, slot], deviations[j, slot] = value, deviation
    return tuple(labels), tuple(NetworkSlot(kind, a, b) for kind, a, b, _ in slots), table, deviations


def check_name(out: Path) -> None:
    """Raise if the output file does not have the ending of a problem file, before the search starts."""
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("the output is a problem file, so its name must end in .toml", str(out), "change the name")


def write_calibrated(found: Calibration, title: str, out: Path, source: Path) -> None:
    """Write a problem file with the estimated stations, their standard deviations, and the rows of the pulses.

    `found` is the calibration, and `title` is the first part of the title of the new file. The clocks are
    subtracted from the rows. `source` is the network file, which must not be overwritten by `out`.

    Raises
    ------
    InvalidProblem
        If there is no finite network to write, or if the file name does not end in .toml.
    """
    check_name(out)
    if not np.isfinite(found.covariance).all():
        raise InvalidProblem(
            f"the network has the status {found.status.label} and cannot be written", str(out), "see its findings"
        )
    claim(out, inputs=[source])
    # A problem file has one sigma per station: the root mean square of its coordinates.
    net, sigma = found.network, np.sqrt(np.mean(found.sigma**2, axis=1))
    stations = []
    for name, place, deviation in zip(net.names, found.stations, sigma, strict=True):
        at = {key: float(v) for key, v in zip("xyz", place, strict=False)}
        stations.append({"name": name} | at | {"sigma": max(float(deviation), _EXACT)})
    measurements = []
    for kind in dict.fromkeys(slot.kind for slot in net.slots):
        rows = []
        for j, r in np.argwhere(net.given & [slot.kind == kind for slot in net.slots]):
            slot = net.slots[r]
            tick = found.clocks[slot.a] - (found.clocks[slot.b] if slot.b >= 0 else 0.0) if kind != "range" else 0.0
            row: dict[str, Any] = {"epoch": net.labels[j], "a": net.names[slot.a]}
            if slot.b >= 0:
                row["b"] = net.names[slot.b]
            rows.append(row | {"z": float(net.z[j, r] - tick), "sigma": float(net.sigma[j, r])})
        measurements.append({"kind": kind, "rows": rows})
    settings = {
        "format": 1,
        "title": f"{title}: stations found ({found.status.label}), frame of {found.gauge}",
        "stations": {"span": "noise", "rows": stations},
        "measurements": measurements,
        "target": {"motion": "free"},
    }
    write_text(out, toml_text(settings))

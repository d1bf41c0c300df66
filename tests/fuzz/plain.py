"""A problem file read again as plainly as can be: tomllib, csv, float(), a table of units; nothing of optloc.

What is not covered is said by `Uncovered`; any other exception means that the file holds what is no number or name.
"""

import csv
import io
import math
import tomllib
from dataclasses import dataclass, field

C = 299_792_458.0
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ps": 1e-12}
LENGTH = {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "yd": 0.9144, "mi": 1609.344, "nmi": 1852.0}
ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "arcmin": math.pi / 10800, "arcsec": math.pi / 648000}
SPEED = {"m/s": 1.0, "km/s": 1e3, "km/h": 1 / 3.6, "ft/s": 0.3048, "mph": 0.44704, "kn": 1852 / 3600}
LEVEL = {"dB": 1.0, "Np": 20 / math.log(10)}
CLOCK = TIME | {"min": 60.0, "h": 3600.0}
LENGTHS = {"tdoa": 2, "range": 1, "toa": 1, "range_sum": 2, "height": 0}
STATIONS = LENGTHS | {"azimuth": 1, "elevation": 1, "groa": 2, "range_rate": 1, "fdoa": 2, "rss_difference": 2}
SIGNS = {"tdoa": (1, -1), "range": (1, 0), "toa": (1, 0), "range_sum": (1, 1)}
SIGNS |= {"range_rate": (1, 0), "fdoa": (1, -1), "rss_difference": (1, -1)}


class Uncovered(Exception):  # noqa: N818  (no error: what this reading lacks)
    """Something that a file may say and that is not read here."""


@dataclass
class Row:
    """One measurement in SI; `sigma` None: not covered."""

    kind: str
    z: float
    a: str | None
    b: str | None
    sigma: float | None
    arrival: tuple | None
    weight: float
    correction: float
    label: str | None
    time: float | None


@dataclass
class Plain:
    """A file: places of stations by name and epoch, rows in the order of kinds, epochs of rows."""

    names: list
    place: list  # for each epoch (or once), for each station, coordinates; None where nobody knows
    rows: list
    epochs: list
    count: int
    frame: tuple
    velocity: list | None = None
    station_sigma: list | None = None
    beyond: list = field(default_factory=list)  # what the fix would need beside this


def read(path):
    """Return a problem file as plain numbers."""
    data = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    assert data["format"] in (1, 2)
    if data.get("medium") is not None:
        raise Uncovered("rays")
    compass = data["format"] == 2 and data.get("frame", {}).get("kind", "cartesian") != "cartesian"
    speed = data.get("propagation_speed", C)
    rows = []
    for written in data["measurements"]:
        section = {"azimuth": "north-clockwise"} | written if compass else written
        rows += measured(section, cells(section, path.parent), speed, len(data["measurements"]) > 1)
    order = list(dict.fromkeys(row.kind for row in rows))
    epochs, count, times = grouped(data, rows)
    numbered = sorted(zip(rows, epochs, strict=True), key=lambda pair: order.index(pair[0].kind))
    rows, epochs = [row for row, _ in numbered], [epoch for _, epoch in numbered]
    found = stations(data, cells(data["stations"], path.parent), rows, epochs, count, times)
    names, place, velocity, sigma, frame = found
    for i, (row, epoch) in enumerate(zip(rows, epochs, strict=True)):
        if row.kind == "range_sum" and data_excess(data, row):
            here = place[epoch if len(place) > 1 else 0]
            rows[i].z += math.dist(here[names.index(row.a)], here[names.index(row.b)]) * (row.weight > 0)
    own = Plain(names, place, rows, epochs, count, frame, velocity, sigma)
    own.beyond = [key for key in ("biases", "priors", "constraints", "covariance") if data.get(key)]
    target = data.get("target", {})
    own.beyond += [key for key in ("file", "rows", "reference") if target.get(key) is not None]
    own.beyond += (
        ["motion"] if target.get("motion", "free" if count > 1 else "static") not in ("free", "static") else []
    )
    own.beyond += ["motion"] if count > 1 and target.get("motion") == "static" else []
    own.beyond += ["targets"] if data.get("targets") else []
    own.beyond += ["station errors"] if sigma is not None else []
    own.beyond += ["noise"] if any(row.sigma is None and row.arrival is None for row in rows) else []
    return own


def data_excess(data, row):
    """Return whether path sums are given less the distance of their stations."""
    said = {section.get("excess", False) for section in data["measurements"]}
    if len(said) > 1:
        raise Uncovered("excess of some tables")
    return said.pop()


# Tables.


def cells(section, folder):
    """Return the rows of a table as dictionaries by the names that optloc asks for."""
    if section.get("rows") is not None:
        assert section.get("file") is None
        rows = [dict(row) for row in section["rows"]]
        # A column of numbers is written one way, one of words another: whole numbers in both are spelled alike.
    elif section["file"].lower().endswith((".parquet", ".pq")):
        rows = from_parquet(folder / section["file"])
    else:
        rows = from_csv(folder / section["file"], section.get("separator", ","))
    called = section.get("columns", {})
    for row in rows:
        values = {key: row[name] for key, name in called.items() if name in row}
        for key in [key for key, name in called.items() if key != name and key in row]:
            del row[key]
        row.update(values)
    return rows


def from_csv(path, separator):
    """Return rows of text."""
    text = path.read_bytes().decode("utf-8-sig")
    lines = [line for line in csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True) if line]
    head = [name.strip() for name in lines[0]]
    assert all(len(line) == len(head) for line in lines), "ragged"
    return [dict(zip(head, line, strict=True)) for line in lines[1:]]


def from_parquet(path):
    """Return rows of whatever the columns are."""
    from pyarrow import parquet

    rows = parquet.read_table(path, use_threads=False).to_pylist()
    if any(not isinstance(cell, str | int | float | None) for row in rows for cell in row.values()):
        raise Uncovered("Parquet columns of other types")
    return rows


def number(row, key):
    """Return a finite number of a row."""
    cell = row[key]
    assert not isinstance(cell, bool)
    assert "_" not in str(cell)
    value = float(cell)
    assert math.isfinite(value), (key, cell)
    return value


def label(cell):
    """Return a name as text."""
    assert cell is not None
    if isinstance(cell, bool):
        raise Uncovered("truth values as names")
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 2**53:
        cell = int(cell)
    text = str(cell).strip()
    assert text
    assert text != "nan" or isinstance(cell, str)
    return text


# Measurements.


def scale(kind, unit, section, speed):
    """Return z in SI as a function of the number that is written, and its slope."""
    if kind in LENGTHS:
        factor = (LENGTH | {name: size * speed for name, size in TIME.items()})[unit or "m"]
    elif kind in ("azimuth", "elevation"):
        factor = ANGLE[unit or "rad"]
        if kind == "azimuth" and section.get("azimuth") == "north-clockwise":
            return lambda v: math.pi / 2 - factor * v, lambda z: -factor
        if kind == "azimuth" and section.get("azimuth") == "north-counterclockwise":
            return lambda v: math.pi / 2 + factor * v, lambda z: factor
    elif kind == "groa":
        if unit == "dB":
            return lambda v: 10 ** (v / 20), lambda z: z * math.log(10) / 20
        factor = {"1": 1.0}[unit or "1"]
    elif kind in ("range_rate", "fdoa"):
        factor = -speed / section["carrier_hz"] if unit == "Hz" else SPEED[unit or "m/s"]
    else:
        factor = LEVEL[unit or "dB"]
    return lambda v: factor * v, lambda z: factor


def amount(value, kind, unit, section, speed):
    """Return the number and the unit of an amount such as "30 ns"."""
    text, _, own = str(value).strip().partition(" ")
    return float(text), scale(kind, own.strip() or unit, section, speed)


def measured(section, rows, speed, several):
    """Return the rows of a table of measurements."""
    assert rows
    if any("target" in row for row in rows):
        raise Uncovered("targets")
    out = []
    for cell in rows:
        kind = section.get("kind") or label(cell["kind"])
        if kind not in STATIONS:
            raise Uncovered(kind)
        unit = section.get("unit")
        unit = unit.get(kind) if isinstance(unit, dict) else unit
        si, slope = scale(kind, unit, section, speed)
        weight = number(cell, "weight") if "weight" in cell else section.get("weight", 1.0)
        given = cell.get("z")
        z = 0.0 if weight == 0.0 else si(number(cell, "z")) if given is not None else math.nan
        a, b = (
            label(cell[key] if key in cell else section[key]) if STATIONS[kind] > n else None
            for n, key in enumerate("ab")
        )
        sigma, arrival = spread(section, cell, kind, unit, speed, z, slope)
        # A correction turns an azimuth clockwise, however it is counted: it is added to a compass bearing.
        turn = -1.0 if kind == "azimuth" and section.get("azimuth") == "north-clockwise" else 1.0
        correction = 0.0
        if section.get("declination") is not None:
            raise Uncovered("declination")
        if "correction" in cell:
            correction = number(cell, "correction") * turn * slope(1.0)
        elif section.get("correction") is not None:
            value, (_, own) = amount(section["correction"], kind, unit, section, speed)
            correction = value * turn * own(1.0)
        if section.get("positive") == "b-farther" and kind in ("tdoa", "groa", "fdoa", "rss_difference"):
            a, b = b, a
        if arrival is not None:
            arrival = (arrival(a), arrival(b) if b is not None else 0.0)
        time = instant(cell["time"], section) if "time" in cell else None
        out.append(
            Row(
                kind,
                z,
                a,
                b,
                sigma,
                arrival,
                weight,
                correction,
                label(cell["epoch"]) if "epoch" in cell else None,
                time,
            )
        )
    # Optloc reads a table kind by kind, in the order of their first rows.
    kinds = list(dict.fromkeys(row.kind for row in out))
    return sorted(out, key=lambda row: kinds.index(row.kind))


def instant(cell, section):
    """Return seconds."""
    if isinstance(cell, str) and cell.count("-") >= 2:
        raise Uncovered("dates")
    return number({"time": cell}, "time") * CLOCK[section.get("time_unit", "s")]


def spread(section, cell, kind, unit, speed, z, slope):
    """Return the standard deviation of a row, or a function from a station to that of its arrival, or neither."""
    if "sigma" in cell:
        return abs(slope(z)) * number(cell, "sigma"), None
    if section.get("sigma") == "estimate" or section.get("covariance") is not None:
        return None, None
    if section.get("sigma") is not None:
        value, (_, own) = amount(section["sigma"], kind, unit, section, speed)
        return abs(own(z)) * value, None
    given = section.get("arrival_sigma")
    if given is None:
        return None, None

    def of_station(name):
        value = given.get(name, 0.0) if isinstance(given, dict) else given
        size, (_, own) = amount(value, kind, unit, section, speed)
        return abs(own(z)) * size

    return None, of_station


def grouped(data, rows):
    """Return the epoch of each row, their number, and the mean time of each."""
    labels, times = [row.label for row in rows], [row.time for row in rows]
    if all(name is None for name in labels) and all(time is None for time in times):
        return [0] * len(rows), 1, [None]
    if None in labels and any(name is not None for name in labels):
        raise ValueError("some rows have no epoch")
    window = data.get("epochs", {}).get("window")
    if labels[0] is not None:
        key = labels
        known = list(dict.fromkeys(labels))
        numbers = [_number_or_none(name) for name in known]
        if None not in numbers:
            known = [name for _, name in sorted(zip(numbers, known, strict=True))]
    elif window is not None:
        size, unit = window.split()
        width = float(size) * CLOCK[unit]
        if max(times) - min(times) > 2.0**53 * width:
            raise ValueError("windows that cannot be counted")
        key = [math.floor((time - min(times)) / width + 1e-9) for time in times]
        known = sorted(set(key))
    else:
        key = times
        known = sorted(set(key))
    mean = {}
    for one in known:
        own = [time for k, time in zip(key, times, strict=True) if k == one and time is not None]
        mean[one] = own[0] + math.fsum(t - own[0] for t in own) / len(own) if own else None
    if times[0] is not None:
        if None in mean.values():
            raise Uncovered("epochs without a time")
        known = sorted(known, key=lambda one: mean[one])
    return [known.index(one) for one in key], len(known), [mean[one] for one in known]


def _number_or_none(text):
    try:
        return float(text)
    except ValueError:
        return None


# Stations.


def stations(data, rows, used, epochs, count, times):
    """Return names, places by epoch, velocities, standard deviations and frame."""
    section, frame = data["stations"], data.get("frame", {})
    if any(key in row for row in rows for key in ("yaw_deg", "heading_deg", "qw", "qx", "qy", "qz")):
        raise Uncovered("turned axes")
    unit = (LENGTH | {name: size * C for name, size in TIME.items()})[section.get("unit", "m")]
    names = list(dict.fromkeys(label(row["name"]) for row in rows))
    place, system = positions(rows, frame, unit)
    d = len(place[0])
    velocity = None
    if any(key in rows[0] for key in ("vx", "vy", "vz")[:d]):
        if system[0] == "geodetic":
            raise Uncovered("velocities on Earth")
        factor = SPEED[section.get("speed_unit", "m/s")]
        velocity = [[factor * number(row, key) for key in ("vx", "vy", "vz")[:d]] for row in rows]
    sigma = None
    if "sigma" in rows[0]:
        sigma = [unit * number(row, "sigma") for row in rows]
    elif section.get("sigma") is not None:
        text, _, own = str(section["sigma"]).partition(" ")
        factor = (LENGTH | {name: size * C for name, size in TIME.items()})[own.strip()] if own.strip() else unit
        sigma = [float(text) * factor] * len(rows)
    index = [names.index(label(row["name"])) for row in rows]
    if not any("time" in row or "epoch" in row for row in rows):
        assert len(index) == len(set(index)), "station twice"
        return names, [place], None if velocity is None else [velocity], sigma, system
    if any("epoch" in row for row in rows):
        raise Uncovered("stations by epoch")
    factor = CLOCK[section.get("time_unit", "s")]
    if any(isinstance(row["time"], str) and row["time"].count("-") >= 2 for row in rows):
        raise Uncovered("dates")
    first = [index.index(s) for s in range(len(names))]

    def over_epochs(values):
        courses = [
            sorted(
                (number(row, "time") * factor, *at) for row, at, i in zip(rows, values, index, strict=True) if i == s
            )
            for s in range(len(names))
        ]
        return [[between(course, time) for course in courses] for time in times]

    moves = None if velocity is None else over_epochs(velocity)
    return names, over_epochs(place), moves, sigma and [sigma[i] for i in first], system


def between(course, time):
    """Return the place at a time on straight lines between rows, None beyond them."""
    for one, two in zip(course, [*course[1:], course[-1]], strict=True):
        if one[0] == time:
            return list(one[1:])
        if one[0] < time < two[0]:
            share = (time - one[0]) / (two[0] - one[0])
            return [(1 - share) * p + share * q for p, q in zip(one[1:], two[1:], strict=True)]
    return None


def positions(rows, frame, unit):
    """Return coordinates of each row, and the frame: its kind, and for ENU its origin in degrees and metres."""
    kind = frame.get("kind", "cartesian")
    if "lat_deg" not in rows[0] and "lon_deg" not in rows[0]:
        d = frame.get("dimension") or (3 if any("z" in row for row in rows) else 2)
        origin = frame.get("origin")
        system = (kind, (origin["lat_deg"], origin["lon_deg"], origin.get("height", 0.0)) if origin else None)
        return [[unit * number(row, axis) for axis in "xyz"[:d]] for row in rows], system
    height = any("height" in row for row in rows)
    ecef = [
        on_earth(number(row, "lat_deg"), number(row, "lon_deg"), unit * number(row, "height") if height else 0.0)
        for row in rows
    ]
    if kind != "enu":
        return ecef, (kind, None)
    if frame.get("origin") is None:
        raise Uncovered("an origin amid the stations")
    origin = (frame["origin"]["lat_deg"], frame["origin"]["lon_deg"], frame["origin"].get("height", 0.0))
    centre, axes = on_earth(*origin), east_north_up(*origin[:2])
    local = [[sum(e * (p - c) for e, p, c in zip(axis, point, centre, strict=True)) for axis in axes] for point in ecef]
    return [point[: frame.get("dimension", 3)] for point in local], (kind, origin)


def on_earth(lat, lon, height):
    """Return ECEF coordinates, WGS 84."""
    assert abs(lat) <= 90
    phi, lam = math.radians(lat), math.radians(lon)
    f = 1 / 298.257223563
    e2 = f * (2 - f)
    n = 6378137.0 / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    flat = (n + height) * math.cos(phi)
    return [flat * math.cos(lam), flat * math.sin(lam), (n * (1 - e2) + height) * math.sin(phi)]


def east_north_up(lat, lon):
    """Return the axes at a place on Earth."""
    phi, lam = math.radians(lat), math.radians(lon)
    return (
        (-math.sin(lam), math.cos(lam), 0.0),
        (-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)),
        (math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)),
    )

"""Foreign tables read by pandas on the rules of `docs/howto/convert.md` alone: nothing of optloc is used.

A column has one role: the one that the options name, or the one of its word if its unit fits. Cells stay text until
they are exact numbers. What no rule covers raises `KeyError`: then a table is not judged.
"""

import json
import math
import re
from fractions import Fraction

import pandas as pd
from fuzz.plain import ANGLE, LENGTH, SPEED, TIME, C, on_earth
from fuzz.tables import Row, turned

LENGTHS = LENGTH | {unit: size * C for unit, size in TIME.items()}
LEVEL = {"dB": 1.0}
# Kind: units, words.
KINDS = {
    "range": (LENGTHS, "range distance dist twr tof slantrange dme"),
    "tdoa": (LENGTHS, "tdoa timedifference rdoa dtoa rangedifference"),
    "toa": (LENGTHS, "toa arrival arrivaltime timeofarrival pseudorange pr prange rho"),
    "azimuth": (ANGLE, "bearing azimuth aoa doa brg"),
    "elevation": (ANGLE, "elevation elevationangle el altitude"),
    "range_rate": (SPEED, "rangerate doppler radialvelocity"),
    "rss_difference": (LEVEL, "rssdifference rssd drss"),
}
ROLES = {
    "station": (None, "station receiver rx sensor anchor node site name id a rx1 stationa"),
    "satellite": (None, "sat"),
    "reference": (None, "reference ref b rx2 stationb"),
    "message": (None, "message msg pulse frame event burst"),
    "time": (TIME, "time t timestamp stamp epoch tgps tow"),
    "target": (None, "target tag mobile icao mac"),
    "sigma": (LENGTHS | ANGLE | SPEED | LEVEL, "sigma std stddev sd uncertainty"),
    "x": (LENGTH, "x satx"), "y": (LENGTH, "y saty"), "z": (LENGTH, "z satz"), "depth": (LENGTH, "depth"),
    "lat": (ANGLE, "lat latitude"), "lon": (ANGLE, "lon longitude lng"),
    "height": (LENGTH, "height alt altitude elevation"),
}  # fmt: skip
ALL_UNITS = {unit.lower(): unit for unit in {*LENGTHS, *ANGLE, *SPEED, *LEVEL}}
ENDING = re.compile(
    rf"(.*?)\s*[_ \[(/]\s*({'|'.join(sorted(map(re.escape, ALL_UNITS), key=len, reverse=True))})[\])]?",
    re.IGNORECASE,
)


def frame_of(path):
    """Return a table of text, whatever its format: nested lists are rows, nested objects have longer names."""
    if path.suffix == ".parquet":
        return pd.read_parquet(path).map(lambda cell: None if pd.isna(cell) else str(cell))
    if path.suffix in (".csv", ".tsv"):
        found = pd.read_csv(path, sep=None, engine="python", dtype=str, keep_default_na=False)
        return found.map(lambda cell: cell or None)
    text = path.read_text()
    lines = text.splitlines() if path.suffix == ".jsonl" else [text]
    data = [json.loads(line, parse_float=str, parse_int=str) for line in lines]
    return pd.DataFrame(records(data if len(data) > 1 else data[0]), dtype=object)


def records(data):
    """Return rows: of a list all of its entries, of an object its values with the rows that are nested in it."""
    if isinstance(data, list):
        return [row for entry in data for row in records(entry)]
    rows = [{name: value for name, value in data.items() if not isinstance(value, list | dict)}]
    flat = {name: value for name, value in data.items() if isinstance(value, list) and not isinstance(value[0], dict)}
    if flat:
        rows = [rows[0] | dict(zip(flat, cells, strict=True)) for cells in zip(*flat.values(), strict=True)]
    for value in data.values():
        if isinstance(value, dict) or (isinstance(value, list) and isinstance(value[0], dict)):
            rows = [outer | inner for outer in rows for inner in records(value)]
    return rows


def parted(name):
    """Return the word of a column without signs and the unit behind it."""
    found = ENDING.fullmatch(name.strip())
    word, unit = (found[1], ALL_UNITS[found[2].lower()]) if found else (name, None)
    return re.sub(r"[^a-z0-9]", "", word.lower()), unit


def column(frame, role, told):
    """Return the column of a role: the one that is named, or the one whose word and unit fit."""
    units, words = KINDS[role] if role in KINDS else ROLES[role]
    if role in told:
        return told[role]
    fits = [name for name in frame if (unit := parted(name)[1]) is None or (units and unit in units)]
    found = [name for word in words.split() for name in fits if parted(name)[0] == word and name not in told.values()]
    return found[0] if found else None


def options(arguments):
    """Return the options of a command by their names, and the columns that it names."""
    pairs = list(zip(arguments[::2], arguments[1::2], strict=True))
    told = dict(value.split("=", 1) for name, value in pairs if name == "--column")
    return dict(pairs), told


def places(frame, told, names):
    """Return the place in SI of each row of a table by `names`."""

    def numbers(role, unit):
        name = column(frame, role, told)
        if name is None:
            return None
        size = 1.0 if unit == "deg" else LENGTH[parted(name)[1] or unit]
        return [float(cell) * size for cell in frame[name]]

    lat, deep = numbers("lat", "deg"), numbers("depth", "m")
    up = [-v for v in deep] if deep else numbers("height" if lat else "z", "m")
    if lat:
        found = zip(lat, numbers("lon", "deg"), up or [0.0] * len(frame), strict=True)
        return dict(zip(names, (tuple(on_earth(*spot)) for spot in found), strict=True))
    axes = [axis for axis in (numbers("x", "m"), numbers("y", "m"), up) if axis]
    return dict(zip(names, zip(*axes, strict=True), strict=True))


def stations_of(path):
    """Return the places of the stations of a file in SI by their names."""
    if path.suffix == ".geojson":
        points = json.loads(path.read_text())["features"]
        spots = {p["properties"]["name"]: p["geometry"]["coordinates"] for p in points}
        return {name: tuple(on_earth(lat, lon, height)) for name, (lon, lat, height) in spots.items()}
    if path.suffix == ".json":
        data = json.loads(path.read_text(), parse_float=str, parse_int=str)
        table = pd.DataFrame([{"name": name} | row for name, row in data.items()], dtype=object)
    else:
        table = frame_of(path)
    return places(table, {}, table[column(table, "station", {})])


def melted(frame, stations, given, told):
    """Return readings (kind, row, text, unit, stations, column): a column has one kind, or one kind of one station."""
    asked = {"arrivals": "toa"}.get(given.get("--as"), given.get("--as"))
    ends = [column(frame, role, told) for role in ("station", "reference")]
    out = []
    for kind in KINDS if asked is None else [asked]:
        name = column(frame, kind, told | ({"toa": told["time"]} if "time" in told and kind == "toa" else {}))
        if name is not None and (stations is None or ends[0] is not None):
            names = [frame[end] if end else [None] * len(frame) for end in ends]
            unit = parted(name)[1] or given["--unit"]
            out += [
                (kind, i, text, unit, a, b, name)
                for i, text, a, b in zip(frame.index, frame[name], *names, strict=True)
            ]
    if not out and stations is not None:
        short = {re.sub(r"[^a-z0-9]", "", name.lower()): name for name in stations}
        pairs = {a + b: (short[a], short.get(b, given.get("--reference"))) for a in short for b in ["", *short]}
        for name in frame:
            word, unit = parted(name)
            hits = {asked or "tdoa": pairs[word]} if word in pairs and (asked or "-" in name) else {}
            for kind, (_, words) in KINDS.items() if not hits else ():
                cut = [rest for w in words.split() for rest in (word.removeprefix(w), word.removesuffix(w))]
                named = [pairs[rest] for rest in cut if rest in pairs and rest != word and asked in (None, kind)]
                hits |= {kind: named[-1]} if named else {}
            for kind, ends in hits.items():
                own = unit or given.get("--unit")
                if own in KINDS[kind][0]:
                    out += [(kind, i, text, own, *ends, name) for i, text in zip(frame.index, frame[name], strict=True)]
    return [row for row in out if not pd.isna(row[2])]


def rows_of(folder, arguments):
    """Return the rows in SI that a command must read from its table."""
    given, told = options(arguments[1:])
    frame, inline = frame_of(folder / arguments[0]), "--stations" not in given
    stations = None if inline else stations_of(folder / given["--stations"])
    spots = places(frame, told, frame.index) if inline else stations
    readings = melted(frame, stations, given, told)
    rest = frame.drop(columns={row[-1] for row in readings})
    told = {role: name for role, name in told.items() if name in rest}
    when, label, target, spread = (column(rest, role, told) for role in ("time", "message", "target", "sigma"))
    epochs = epochs_of(frame, label, when, given, readings)
    out = []
    for kind, i, text, unit, a, b, _ in readings:
        units = KINDS[kind][0]
        exact = kind == "toa" and unit in TIME
        z = Fraction(text) * Fraction(repr(TIME[unit])) if exact else float(text) * units[unit]
        if kind == "azimuth" and given.get("--azimuth", "north-clockwise") == "north-clockwise":
            z = math.pi / 2 - z
        z = -z if given.get("--positive") == "b-farther" else z
        here, second = spots[i if inline else a], spots[b] if kind in ("tdoa", "rss_difference") else None
        if column(frame, "satellite", told):  # they are where they were when they sent
            here = tuple(turned(here, z / C))
        if "--sigma" in given:
            said = dict(part.split("=") for part in given["--sigma"].split(",")) if "=" in given["--sigma"] else {}
            amount, own = said.get(kind, given["--sigma"]).split()
            sigma = float(amount) * units[own]
        else:
            sigma = float(frame[spread][i]) * units[parted(spread)[1] or unit]
        out.append(Row(kind, z, here, second, sigma, epochs[i], None if target is None else frame[target][i]))
    return out


def epochs_of(frame, label, when, given, readings):
    """Return the epoch of each row of a table: its label, its seconds, or the place of its time among windows."""
    if label is not None:
        return dict(zip(frame.index, frame[label], strict=True))
    if "--window" in given:
        amount, unit = given["--window"].split()
        width = Fraction(amount) * Fraction(repr(TIME[unit]))
        own = {
            i: Fraction(text) * Fraction(repr(TIME.get(u, 1 / C))) for kind, i, text, u, *_ in readings if kind == "toa"
        }
        times = own or {i: Fraction(cell) * Fraction(repr(TIME[parted(when)[1]])) for i, cell in frame[when].items()}
        order = pd.Series(times).sort_values()
        group = (order.diff().fillna(0) > width).cumsum()
        return {i: str(group[i] + 1) if own else float(min(order[group == group[i]])) for i in times}
    if when is None:
        wide = len({row[1] for row in readings}) < len(readings) and len({row[0] for row in readings}) == 1
        return {i: str(i + 1) if wide else None for i in frame.index}
    unit = parted(when)[1]
    dated = str(frame[when].iloc[0]).count("-") > 1
    if dated:
        return {i: pd.Timestamp(cell).timestamp() for i, cell in frame[when].items()}
    return {i: float(cell) * TIME[unit] if unit else cell for i, cell in frame[when].items()}

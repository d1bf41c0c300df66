"""Tables of readings as people write them, of targets that are known: drawn of a seed and a number alone.

Shapes, names, units, orders and files are drawn, and so is what misleads: stations that are called like units, a column
that looks like another one, units that tell two roles of one word apart. The data are exact: whatever is read rightly
has its fix at the truth.
"""

import csv
import io
import json
import math
import random
import re
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from decimal import Decimal

import pandas as pd
from fuzz.plain import ANGLE, LENGTH, SPEED, TIME, C, east_north_up, on_earth

# Words of each kind that a column may be called by: a word of one kind is a word of no other.
WORDS = {
    "range": "range distance dist twr tof slant_range dme Range DISTANCE".split(),
    "tdoa": "tdoa time_difference rdoa dtoa range_difference TDOA".split(),
    "toa": "toa arrival arrival_time time_of_arrival TOA".split(),
    "azimuth": "bearing bearing brg bearing azimuth aoa doa".split(),
    "elevation": "elevation elevation_angle el".split(),
    "range_rate": "range_rate doppler radial_velocity".split(),
    "rss_difference": "rss_difference rssd drss".split(),
    "pseudorange": "pseudorange pr prange rho".split(),
}
UNITS = {
    "range": "m m cm mm km ft ns us".split(),
    "tdoa": "m ns ns us ps km".split(),
    "toa": "ns us s ps ns m".split(),
    "azimuth": "deg deg rad mrad arcmin".split(),
    "elevation": "deg deg rad mrad".split(),
    "range_rate": "m/s km/h kn".split(),
    "rss_difference": ["dB"],
}
SIZES = {**LENGTH, **{unit: size * C for unit, size in TIME.items()}, **ANGLE, **SPEED, "dB": 1.0}
STATION = "station receiver rx sensor anchor node site Station".split()
PAIRS = (("station", "reference"), ("a", "b"), ("anchor", "ref"), ("rx1", "rx2"), ("station_a", "station_b"))
MESSAGE, TARGET = "message msg pulse frame event burst".split(), "target tag mobile icao mac".split()
SIGMA = "sigma std stddev sd uncertainty".split()
NAMES = (
    "Lake Chapel Quarry Summit Mill Tower Ferry Ridge".split(), "A B C D E F G H".split(),
    "A1 A2 A3 A4 A5 A6 A7 A8".split(), "1 2 3 4 5 6 7 8".split(), "10 2 31 4 5 66 7 8".split(),
    "rx 1,rx 2,rx 10,rx 4,rx 5,rx 6,rx 7,rx 8".split(","),
    "north_1 north_2 east_1 east_2 west_1 west_2 south_1 south_2".split(),
)  # fmt: skip
# Called like kinds, units, roles and columns.
STRANGE = (
    "range m x t a b time sigma".split(), "ns s deg km toa y z name".split(),
    "tdoa station reference epoch lat lon h rx".split(),
)  # fmt: skip
# What a table has besides, and what no reading of these is.
BESIDES = {
    "squawk": lambda rng: rng.choice(["7000", "2000", "1200"]),
    "cn0": lambda rng: f"{rng.uniform(20, 50):.1f}",
    "rssi": lambda rng: f"{rng.uniform(-90, -40):.0f}",
    "comment": lambda rng: rng.choice(["", "ok", "late, weak", "5 m"]),
    "battery_pct": lambda rng: str(rng.randrange(5, 98)),
    "firmware": lambda rng: rng.choice(["1.2", "1.3"]),
    "temperature": lambda rng: f"{rng.uniform(-5, 30):.1f}",
}
# The same in a unit that a reading might have: whoever reads one of these has looked at units alone.
MISLEADING = {
    "error_m": lambda rng: f"{rng.uniform(0, 3):.2f}",
    "residual_ns": lambda rng: f"{rng.uniform(-3, 3):.2f}",
    "altitude_ft": lambda rng: str(rng.randrange(100, 30000, 25)),
    "speed_kn": lambda rng: f"{rng.uniform(1, 400):.1f}",
    "snr_dB": lambda rng: f"{rng.uniform(3, 30):.1f}",
    "roll_deg": lambda rng: f"{rng.uniform(-5, 5):.2f}",
    "interval_ms": lambda rng: f"{rng.uniform(90, 110):.3f}",
    "clock_s": lambda rng: f"{rng.uniform(0, 1e5):.3f}",
}
TURN = 7.2921151467e-5  # of the Earth, rad/s (IS-GPS-200)


@dataclass(frozen=True)
class Row:
    """A reading in SI, positive where `a` is farther, angles anticlockwise from east; `epoch` is a label or seconds."""

    kind: str
    z: float
    a: tuple
    b: tuple | None
    sigma: float
    epoch: str | float | None
    target: str | None


@dataclass
class Made:
    """A table: its files, the options of the command, what is in it, and where its targets are."""

    number: int
    files: dict
    arguments: tuple
    rows: list
    truth: dict
    about: tuple
    exact: bool = True

    @property
    def name(self):
        """Return what tells this table from others in a message."""
        return f"table {self.number}: {' '.join(map(repr, self.arguments))} ({', '.join(self.about)})"


@dataclass
class Scene:
    """Stations and targets: `place` of each station in SI, `shown` as a table writes it, `truth` of each target."""

    rng: random.Random
    what: str
    kinds: tuple
    earth: bool
    dimension: int
    inline: bool
    odd: bool
    names: list = field(default_factory=list)
    place: dict = field(default_factory=dict)
    shown: dict = field(default_factory=dict)
    epochs: list = field(default_factory=list)
    targets: list = field(default_factory=list)
    truth: dict = field(default_factory=dict)
    size: float = 0.0
    flat: bool = False
    window: bool = False


@dataclass
class Sheet:
    """A table that is being made: records of text by columns, options and remarks."""

    records: list = field(default_factory=list)
    options: list = field(default_factory=list)
    about: list = field(default_factory=list)


WHAT = (
    *["range"] * 4, *["tdoa"] * 3, *["toa"] * 3, *["azimuth"] * 2, "both", *["sight"] * 2, *["rss_difference"] * 2,
    "range_rate", *["pseudorange"] * 2, *["anchors"] * 2,
)  # fmt: skip
KINDS = {"both": ("range", "azimuth"), "sight": ("azimuth", "elevation"), "anchors": ("toa",)}


def made(seed, number):
    """Return a table."""
    rng = random.Random(f"table {seed} {number}")
    what = rng.choice(WHAT)
    if what == "pseudorange":
        return satellites(rng, number)
    scene = scene_of(rng, what)
    sheet = Sheet(about=[what, "odd" if scene.odd else "plain"])
    exact = rng.random() < 0.8
    readings = readings_of(scene, exact=exact)
    wide = (
        len(scene.kinds) == 1 and not scene.inline and what not in ("anchors", "rss_difference") and rng.random() < 0.4
    )
    files = {}
    if wide:
        wide_sheet(sheet, scene, readings)
    else:
        long_sheet(sheet, scene, readings)
    sheet.about.append("wide" if wide else "inline" if scene.inline else "long")
    if not scene.inline:
        name, data = station_file(sheet, scene)
        files[name] = data
        sheet.options += ["--stations", name]
    source, data = written(rng, sheet, wide=wide)
    return Made(
        number, {source: data} | files, (source, *sheet.options), readings, scene.truth, tuple(sheet.about), exact
    )


# Stations, targets and readings.


def scene_of(rng, what):
    """Return stations and targets."""
    kinds = KINDS.get(what, (what,))
    earth = rng.random() < 0.4 if what not in ("anchors", "range_rate") else False
    flat_only = kinds == ("azimuth",)
    dimension = 3 if earth or what == "sight" else 2 if flat_only else rng.choice([2, 3])
    inline = ("azimuth" in kinds and rng.random() < 0.6) or (kinds == ("range",) and rng.random() < 0.15)
    scene = Scene(rng, what, kinds, earth, dimension, inline, rng.random() < 0.4)
    count = rng.randint(5, 6) if dimension == 2 or flat_only else rng.randint(6, 8)
    scene.names = list(rng.choice(STRANGE if scene.odd and rng.random() < 0.5 else NAMES))[:count]
    scene.size = rng.choice([5e3, 3e4]) if earth else rng.choice([8.0, 300.0, 2e4])
    centre = (rng.uniform(-60, 60), rng.uniform(-179, 179))
    scene.flat = earth and scene.inline and rng.random() < 0.3
    for i, name in enumerate(scene.names):
        way, far = math.tau * (i + rng.uniform(-0.3, 0.3)) / count, scene.size * rng.uniform(0.6, 1.2)
        east, north = far * math.cos(way), far * math.sin(way)
        up = (i % 3) * 0.2 * scene.size * rng.uniform(0.5, 1.0)
        if earth:
            lat = round(centre[0] + math.degrees(north / 6.37e6), 6)
            lon = round(centre[1] + math.degrees(east / 6.37e6 / math.cos(math.radians(centre[0]))), 6)
            scene.shown[name] = (lat, lon, 0.0 if scene.flat else round(rng.uniform(0, 2500), 1))
            scene.place[name] = tuple(on_earth(*scene.shown[name]))
        else:
            spot = [round(east, 3), round(north, 3), round(up, 3)][:dimension]
            scene.shown[name] = scene.place[name] = tuple(spot)
    scene.epochs = epochs_of(rng, what)
    scene.targets = rng.sample(["t1", "t2", "3c6444", "7"], 2) if rng.random() < 0.15 else [None]
    if what == "toa" and rng.random() < 0.2:
        scene.epochs, scene.targets, scene.window = [str(k + 1) for k in range(rng.randint(1, 3))], [None], True
    scene.window |= isinstance(scene.epochs[0], float) and what != "anchors" and rng.random() < 0.2
    for epoch in scene.epochs:
        for target in scene.targets:
            scene.truth[epoch, target] = target_of(scene, centre)
    return scene


def epochs_of(rng, what):
    """Return labels or seconds of the epochs, or none of one that has neither."""
    count = rng.choice([1, 1, 2, 3])
    if count == 1 and rng.random() < 0.5:
        return [None]
    if what == "anchors" or (what != "toa" and rng.random() < 0.6):
        first, step = rng.choice([(0.0, 0.5), (1000.0, 1.0), (12.25, 10.0)])
        return [first + step * k for k in range(count)]
    return rng.choice([["1", "2", "3"], ["7", "12", "31"], ["m1", "m2", "m3"]])[:count]


def target_of(scene, centre):
    """Return where a target is, among the stations; that of bearings alone on Earth is as high as they are."""
    rng, size = scene.rng, scene.size
    east, north = (rng.uniform(-0.4, 0.4) * size for _ in range(2))
    up = rng.uniform(0.3, 0.7) * size
    if not scene.earth:
        return tuple([east, north, up][: scene.dimension])
    if scene.kinds == ("azimuth",):
        heights = [shown[2] for shown in scene.shown.values()]
        up = round(sum(heights) / len(heights), 3)
    lat = centre[0] + math.degrees(north / 6.37e6)
    lon = centre[1] + math.degrees(east / 6.37e6 / math.cos(math.radians(centre[0])))
    return tuple(on_earth(lat, lon, up))


def readings_of(scene, *, exact):
    """Return what the stations read: of some tables a few are missing, of others one is a wild value."""
    rng, found = scene.rng, []
    sparse = rng.random() < 0.3
    spread = sigma_of(scene)
    for k, epoch in enumerate(scene.epochs):
        for target in scene.targets:
            start = k + Decimal(rng.randrange(900_000)) / 10**6
            heard = [name for name in scene.names if not sparse or rng.random() < 0.8] or scene.names[:1]
            if sparse and rng.random() < 0.2:
                heard = heard[:1]
            for kind in scene.kinds:
                for a, b in ends_of(scene, kind, heard):
                    value = ideal(scene, kind, a, b, scene.truth[epoch, target])
                    if kind == "toa":
                        value = instant(scene, start, value)
                    found.append([kind, value, a, b, spread[kind], epoch, target])
    if not found:
        return readings_of(scene, exact=exact)
    if not exact:
        row = rng.choice(found)
        wild = 40.0 * row[4] * rng.choice([-1.0, 1.0])
        row[1] = instant_later(row[1], wild) if row[0] == "toa" else row[1] + wild
    return [Row(k, z, a, b, s, e, t) for k, z, a, b, s, e, t in found]


def sigma_of(scene):
    """Return the standard deviation of each kind in SI."""
    amounts = {"azimuth": math.radians(0.2), "elevation": math.radians(0.1), "rss_difference": 0.1, "range_rate": 0.05}
    return {kind: amounts.get(kind, 2e-3 * scene.size) * scene.rng.choice([0.5, 1.0, 2.0]) for kind in scene.kinds}


def ends_of(scene, kind, heard):
    """Return the stations of the readings of a kind."""
    if kind not in ("tdoa", "rss_difference"):
        return [(name, None) for name in heard]
    if scene.rng.random() < 0.6:
        reference = scene.names[0]
        return [(name, reference) for name in heard if name != reference]
    chain = list(zip(scene.names[1:], scene.names, strict=False))
    return [pair for pair in chain if pair[0] in heard]


def ideal(scene, kind, a, b, truth):
    """Return the value of a reading in SI, angles anticlockwise from east."""
    here = scene.place[a]
    if kind in ("azimuth", "elevation"):
        axes = east_north_up(*scene.shown[a][:2]) if scene.earth else ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        line = [t - p for t, p in zip(truth, here, strict=True)] + [0.0] * (3 - len(here))
        east, north, up = (sum(e * v for e, v in zip(axis, line, strict=True)) for axis in axes)
        return math.atan2(north, east) if kind == "azimuth" else math.atan2(up, math.hypot(east, north))
    far = math.dist(here, truth)
    if kind == "range_rate":
        return 3.0 * (truth[0] - here[0]) / far - 2.0 * (truth[1] - here[1]) / far
    if b is None:
        return far
    other = math.dist(scene.place[b], truth)
    return far - other if kind == "tdoa" else 20.0 * math.log10(other / far)


def instant(scene, start, far):
    """Return the arrival of a signal in seconds since 1970 or since the start of a run, to a femtosecond."""
    return (
        (Decimal(1_790_000_000) if scene.size > 300.0 else Decimal(12))
        + start
        + Decimal(repr(far / C)).quantize(Decimal("1e-15"))
    )


def instant_later(value, metres):
    """Return an arrival that is later by the flight of some metres."""
    return value + Decimal(repr(metres / C)).quantize(Decimal("1e-15"))


# How numbers are written.


def titled(rng, word, unit):
    """Return the name of a column with a unit."""
    return rng.choice([f"{word}_{unit}"] * 4 + [f"{word} [{unit}]", f"{word} ({unit})", f"{word} / {unit}"])


def written_value(row, unit, convention, positive):
    """Return a value as text in a unit."""
    if row.kind == "toa":
        # Metres since the last second: a float of all seconds of today would keep no metre.
        return f"{row.z / Decimal(repr(TIME[unit])):f}" if unit in TIME else repr(float(row.z % 1) * C)
    z = row.z
    if row.kind == "azimuth" and convention == "north-clockwise":
        z = (math.pi / 2 - z) % math.tau
    elif row.kind == "azimuth":
        z %= math.tau
    return repr((-z if positive == "b-farther" else z) / SIZES[unit])


def sigma_text(kind, si, unit):
    """Return a standard deviation as an option says it."""
    return f"{si / SIZES[unit]!r} {unit}"


def when_columns(rng, sheet, scene, message, *, wide=False):
    """Return a function from a row to the cells that tell its epoch and target."""
    makers = []
    first = next(iter(scene.epochs))
    window = scene.window and not wide
    if window:
        sheet.options += ["--window", "1 ms" if scene.what == "toa" else "0.2 s"]
        sheet.about.append("window")
    if isinstance(first, str):
        makers += [] if window else [(message, lambda row: row.epoch)]
    elif window:
        unit, count = rng.choice(["s", "ms", "us", "ns"]), iter(range(10**6))
        late = lambda row: Decimal(repr(row.epoch)) + Decimal(next(count) % 16) / 1000  # noqa: E731  (one after the other)
        makers.append(
            (
                titled(rng, rng.choice("time t timestamp stamp".split()), unit),
                lambda row: f"{(late(row) / Decimal(repr(TIME[unit]))).normalize():f}",
            )
        )
    elif first is not None:
        unit = rng.choice(["s", "s", "ms", "us"])
        form = rng.choice(["unit", "unit", "unit", "date"])
        word = rng.choice("time t timestamp".split())
        if form == "unit":
            name = titled(rng, word, unit)
            makers.append((name, lambda row: repr(round(row.epoch / TIME[unit], 3)).removesuffix(".0")))
        else:
            makers.append((word, lambda row: datetime.fromtimestamp(row.epoch, UTC).isoformat().replace("+00:00", "Z")))
    if scene.targets[0] is not None:
        makers.append((rng.choice(TARGET), lambda row: row.target))
    return makers


def long_sheet(sheet, scene, readings):
    """Write a reading a row, the stations beside them or in a table of their own."""
    rng = scene.rng
    paired = scene.kinds[0] in ("tdoa", "rss_difference")
    pair = rng.choice(PAIRS[:3] if scene.kinds[0] == "rss_difference" else PAIRS)
    ends = pair if paired else (rng.choice(STATION), None)
    makers = when_columns(rng, sheet, scene, rng.choice(MESSAGE))
    positive = None
    if paired and (pair in PAIRS[3:] or (scene.kinds[0] == "tdoa" and rng.random() < 0.2)):
        positive = rng.choice(["a-farther", "b-farther"])
        sheet.options += ["--positive", positive]
    named = not scene.inline or rng.random() < 0.7
    if named and scene.odd and not paired and rng.random() < 0.2:
        ends = (rng.choice(["who", "heard by", "unit_no"]), None)
        sheet.options += ["--column", f"station={ends[0]}"]
        sheet.about.append("told station")
    values, units, convention = value_columns(sheet, scene)
    own = rng.random() < 0.4 and len(scene.kinds) == 1
    spread = titled(rng, rng.choice(SIGMA), units[scene.kinds[0]]) if own else None
    if not own:
        tell_sigma(sheet, scene, readings, units)
    place = inline_columns(sheet, scene) if scene.inline else None
    records = {}
    for row in readings:
        cells = {name: text(row) for name, text in makers}
        if named:
            cells[ends[0]] = row.a
        if row.b is not None:
            cells[ends[1]] = row.b
        if place is not None:
            cells |= place(row.a)
        held = records.setdefault((row.a, row.b, row.epoch, row.target), cells)
        held[values[row.kind]] = written_value(row, units[row.kind], convention, positive)
        if f"raw {row.kind}" in values:
            raw = replace(row, z=instant_later(row.z, 900.0) if row.kind == "toa" else row.z + 5.0 * row.sigma)
            held[values[f"raw {row.kind}"]] = written_value(raw, units[row.kind], convention, positive)
        if spread is not None:
            held[spread] = repr(row.sigma / SIZES[units[row.kind]])
    sheet.records = list(records.values())
    besides(sheet, scene)
    if scene.odd and own and rng.random() < 0.3:
        add(sheet, "sigma_pct", lambda: "3")


def value_columns(sheet, scene):
    """Return the columns of the values, their units, and how azimuths are counted."""
    rng, values, units = scene.rng, {}, {}
    convention = "north-clockwise"
    for kind in scene.kinds:
        word = rng.choice(WORDS[kind])
        if scene.what == "anchors":
            word = rng.choice(["pseudorange", "pseudorange", "toa", "arrival"])
        unit = rng.choice(UNITS[kind]) if scene.what != "anchors" else "m"
        if kind == "azimuth" and (not scene.earth or rng.random() < 0.2):
            convention = rng.choice(["north-clockwise", "east-counterclockwise"])
            sheet.options += ["--azimuth", convention]
        name = titled(rng, word, unit)
        if len(scene.kinds) == 1 and rng.random() < 0.15:
            name = word
            sheet.options += ["--unit", unit]
        if scene.odd and rng.random() < 0.25:
            name, role = rng.choice(["Messwert", "v1", "corrected"]), kind
            if kind == "toa":
                role = rng.choice(["time", "toa"])
            name = f"{name}_{unit}"
            sheet.options += ["--column", f"{role}={name}"]
            if len(scene.kinds) == 1:
                sheet.options += ["--as", "arrivals" if kind == "toa" else kind]
            sheet.about.append("told value")
            if rng.random() < 0.5:
                values[f"raw {kind}"] = titled(rng, word, unit)
        values[kind], units[kind] = name, unit
    return values, units, convention


def tell_sigma(sheet, scene, readings, units):
    """Say the standard deviations in the option."""
    spread = {row.kind: row.sigma for row in readings}
    said = {kind: sigma_text(kind, spread.get(kind, 1.0), units[kind]) for kind in scene.kinds}
    text = next(iter(said.values())) if len(said) == 1 else ",".join(f"{kind}={one}" for kind, one in said.items())
    sheet.options += ["--sigma", text]


def inline_columns(sheet, scene):
    """Return a function from a station to the cells that say where it is."""
    rng = scene.rng
    if not scene.earth:
        unit = rng.choice(["m", "m", "cm", "km"])
        heads = [titled(rng, axis, unit) if unit != "m" or rng.random() < 0.5 else axis for axis in "xyz"]
        return lambda name: {head: repr(v / LENGTH[unit]) for head, v in zip(heads, scene.shown[name], strict=False)}
    lat, lon = rng.choice([("lat", "lon"), ("latitude", "longitude"), ("lat_deg", "lon_deg")])
    unit = rng.choice(["m", "m", "ft"])
    word = rng.choice(["alt", "height", "altitude", *(["elevation"] * 3 if scene.odd else [])])
    height = f"{word}_{unit}"

    def cells(name):
        shown = scene.shown[name]
        found = {lat: repr(shown[0]), lon: repr(shown[1])}
        return found if scene.flat else found | {height: repr(shown[2] / LENGTH[unit])}

    return cells


def wide_sheet(sheet, scene, readings):
    """Write a column for each station or pair, a row for each epoch and target."""
    rng, kind = scene.rng, scene.kinds[0]
    makers = when_columns(rng, sheet, scene, rng.choice(MESSAGE), wide=True)
    unit, word = rng.choice(UNITS[kind]), rng.choice(WORDS[kind])
    form = rng.choice(["word first", "word last", "name", "name"])
    convention = "north-clockwise"
    if kind == "azimuth":
        convention = rng.choice(["north-clockwise", "east-counterclockwise"])
        sheet.options += ["--azimuth", convention]
    pairs = {(row.a, row.b) for row in readings}
    single = kind == "tdoa" and len({b for _, b in pairs}) == 1 and rng.random() < 0.5
    positive = None
    if kind == "tdoa" and single:
        sheet.options += ["--reference", readings[0].b]
    elif kind == "tdoa" and form != "name":
        positive = rng.choice(["a-farther", "b-farther"])
        sheet.options += ["--positive", positive]
    style = rng.choice(["{}_{}", "{}_{}", "{} [{}]", "{} ({})"])

    def head(row):
        ends = row.a if row.b is None or single else f"{row.a}-{row.b}" if form == "name" else f"{row.a}_{row.b}"
        return style.format({"word first": f"{word}_{ends}", "word last": f"{ends} {word}"}.get(form, ends), unit)

    if form == "name" and (kind != "tdoa" or single):
        sheet.options += ["--as", "arrivals" if kind == "toa" else kind]
    tell_sigma(sheet, scene, readings, {kind: unit})
    records = {}
    for row in readings:
        cells = records.setdefault((row.epoch, row.target), {name: text(row) for name, text in makers})
        cells[head(row)] = written_value(row, unit, convention, positive)
    sheet.records = list(records.values())
    if scene.epochs == [None]:
        for i, row in enumerate(sheet.records):
            row["frame"] = str(i + 1)
    besides(sheet, scene)


def besides(sheet, scene):
    """Add columns that are no readings, and change the order of all."""
    rng = scene.rng
    for name in rng.sample(sorted(BESIDES), rng.choice([0, 0, 1, 2])):
        add(sheet, name, lambda name=name: BESIDES[name](rng))
    if scene.odd:
        # Beside the place of a station, an altitude is the one of the station.
        known = sorted({*MISLEADING} - ({"altitude_ft"} if scene.inline else set()))
        for name in rng.sample(known, rng.choice([0, 0, 1, 1, 2])):
            add(sheet, name, lambda name=name: MISLEADING[name](rng))
            sheet.about.append(f"with {name}")
    for_all = list(dict.fromkeys(name for row in sheet.records for name in row))
    if rng.random() < 0.5:
        rng.shuffle(for_all)
    if rng.random() < 0.5:
        rng.shuffle(sheet.records)
    sheet.records = [{name: row.get(name) for name in for_all} for row in sheet.records]


def add(sheet, name, cell):
    """Add a column, unless there is one of that name."""
    if not any(name in row for row in sheet.records):
        for row in sheet.records:
            row[name] = cell()


# Stations in a table of their own.


def station_file(sheet, scene):
    """Return the file of the stations."""
    rng = scene.rng
    head = rng.choice("name station anchor receiver site id".split())
    rows = []
    if scene.earth:
        lat, lon = rng.choice([("lat", "lon"), ("latitude", "longitude"), ("lat_deg", "lng")])
        unit = rng.choice(["m", "m", "ft", "km"])
        word = rng.choice(["alt", "height", "altitude", "elevation"])
        for name in scene.names:
            shown = scene.shown[name]
            rows.append(
                {head: name, lat: repr(shown[0]), lon: repr(shown[1]), f"{word}_{unit}": repr(shown[2] / LENGTH[unit])}
            )
    else:
        unit = rng.choice(["m", "m", "cm", "km", "ft"])
        bare = unit == "m" and rng.random() < 0.5
        heads = [axis if bare else titled(rng, axis, unit) for axis in "xyz"]
        deep = scene.dimension == 3 and rng.random() < 0.15
        for name in scene.names:
            spot = [v / LENGTH[unit] for v in scene.shown[name]]
            if deep:
                heads[2], spot[2] = f"depth_{unit}", -spot[2]
            rows.append({head: name} | {h: repr(v) for h, v in zip(heads, spot, strict=False)})
    if rng.random() < 0.3:
        rows = [row | {"comment": rng.choice(["roof", "mast", ""])} for row in rows]
    if scene.odd and rng.random() < 0.2:
        rows = [row | {"elevation_deg": repr(rng.uniform(1, 20))} for row in rows]
        sheet.about.append("elevation_deg of stations")
    rng.shuffle(rows)
    form = rng.choice(["csv", "csv", "csv", "json", "parquet", "geojson" if scene.earth else "csv"])
    if form == "geojson":
        points = [
            {
                "type": "Feature", "properties": {"name": name},
                "geometry": {"type": "Point", "coordinates": [shown[1], shown[0], shown[2]]},
            }
            for name, shown in scene.shown.items()
        ]  # fmt: skip
        return "sites.geojson", json.dumps({"type": "FeatureCollection", "features": points}).encode()
    if form == "json":
        # A list is GeoJSON to optloc; an object has the names for its keys.
        kept = {row[head]: {k: number(v) for k, v in row.items() if k != head} for row in rows}
        return "sites.json", json.dumps(kept).encode()
    if form == "parquet":
        return "sites.parquet", parquet_of(rows)
    return "sites.csv", csv_of(rows, rng.choice(",,;\t"))


# Files.


def written(rng, sheet, *, wide):
    """Return the name and the content of a table in one of its formats."""
    form = rng.choice(["csv"] * 5 + ["tsv", "json", "jsonl", "nested", "nested", "parquet"])
    rows = sheet.records
    sheet.about.append(form)
    if form == "csv":
        return "t.csv", csv_of(rows, rng.choice(",,,;\t"), rng.choice(["\n", "\n", "\r\n"]))
    if form == "tsv":
        return "t.tsv", csv_of(rows, "\t")
    if form == "parquet":
        return "t.parquet", parquet_of(rows)
    held = [
        {name: number(cell) for name, cell in row.items() if cell is not None or rng.random() < 0.5} for row in rows
    ]
    if form == "jsonl":
        return "t.jsonl", "\n".join(raw_json(row) for row in held).encode()
    if form == "nested":
        held = nested(rng, sheet, held, wide=wide)
    return "t.json", raw_json(held).encode()


def nested(rng, sheet, rows, *, wide):
    """Return records with what is nested: in objects, in lists of objects, or in lists side by side."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    told = {option.partition("=")[2] for option in sheet.options if "=" in option}
    how = rng.choice(["wrapped", "lists", "lists", "deep", "side by side"])
    if wide or told & set(columns):
        how = "wrapped"
    sheet.about.append(how)
    if how == "wrapped":
        return {"recorded": "2026-04-06", "campaign": "north", "data": rows}
    shared = {*MESSAGE, *TARGET, "time", "t", "timestamp", "stamp"}
    shared = [name for name in columns if re.sub(r"[ _(/\[]+(s|ms|us|ns)[\])]?$", "", name) in shared]
    groups = {}
    for row in rows:
        groups.setdefault(tuple(str(row.get(name)) for name in shared), []).append(row)
    out = []
    for held in groups.values():
        top = {name: held[0].get(name) for name in shared}
        inner = [{k: v for k, v in row.items() if k not in shared} for row in held]
        if how == "side by side":
            out.append(top | {k: [row.get(k) for row in inner] for k in columns if k not in shared})
        else:
            out.append(top | {"readings": inner})
    return {"log": {"scans": out}} if how == "deep" else out


class Literal(str):
    """A number as it is written."""

    __slots__ = ()


def number(cell):
    """Return a cell of text as JSON has it: numbers with all their digits."""
    if cell is None:
        return None
    try:
        float(cell)
    except ValueError:
        return cell
    return Literal(cell) if (cell.strip() == cell and not cell.lstrip("-").startswith("0")) or "." in cell else cell


def raw_json(value):
    """Return JSON whose numbers have all their digits."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)}: {raw_json(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(raw_json, value)) + "]"
    return str(value) if isinstance(value, Literal) else json.dumps(value)


def csv_of(rows, separator, ending="\n"):
    """Return rows as CSV."""
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]), delimiter=separator, lineterminator=ending)
    writer.writeheader()
    writer.writerows({k: "" if v is None else v for k, v in row.items()} for row in rows)
    return out.getvalue().encode()


def parquet_of(rows):
    """Return rows as Parquet: columns of numbers that a float holds are numbers."""
    frame = pd.DataFrame(rows, dtype=object)
    for name in frame:
        cells = [cell for cell in frame[name] if cell is not None]
        try:
            if all(repr(float(cell)) == cell for cell in cells):
                frame[name] = frame[name].astype(float)
        except ValueError:
            pass
    out = io.BytesIO()
    frame.to_parquet(out)
    return out.getvalue()


# Satellites.


def satellites(rng, which):
    """Return pseudoranges of satellites with their places when they sent, along the axes of that instant."""
    receiver = on_earth(rng.uniform(-60, 60), rng.uniform(-179, 179), rng.uniform(0, 1500))
    lat, lon = latitude_longitude(receiver)
    axes = east_north_up(lat, lon)
    count, unit = rng.randint(6, 9), rng.choice(["m", "m", "km"])
    word, sigma = rng.choice(WORDS["pseudorange"]), rng.choice([0.5, 2.0])
    epochs = [100.0 + 30.0 * k for k in range(rng.choice([1, 1, 2]))]
    dressed = rng.random() < 0.5
    x, y, z = (f"{'sat_' if dressed else ''}{axis}_{unit}" if unit != "m" or dressed else axis for axis in "xyz")
    when, own = rng.choice(["t_gps_s", "epoch", "tow_s", "time_s"]), rng.random() < 0.3
    rows, records = [], []
    for t in epochs:
        clock = rng.uniform(-1e5, 1e5)
        for i in range(count):
            way, rise = math.tau * (i + rng.random()) / count, math.radians(rng.uniform(15, 85))
            line = [math.sin(way) * math.cos(rise), math.cos(way) * math.cos(rise), math.sin(rise)]
            far = rng.uniform(2.0e7, 2.5e7)
            received = [
                p + far * sum(v * axis[d] for v, axis in zip(line, axes, strict=True)) for d, p in enumerate(receiver)
            ]
            sent = turned(received, -far / C)
            value = math.dist(receiver, received) + clock
            rows.append(Row("toa", value, tuple(received), None, sigma, t, None))
            record = {when: repr(t), "sat": f"G{i + 1:02d}", f"{word}_m": repr(value)}
            record |= {head: repr(v / LENGTH[unit]) for head, v in zip((x, y, z), sent, strict=True)}
            records.append(record | ({"sigma_m": repr(sigma)} if own else {}) | {"cn0": "40"})
    rng.shuffle(records)
    sheet = Sheet(records, [] if own else ["--sigma", f"{sigma} m"], ["pseudorange"])
    form = rng.choice(["csv", "csv", "parquet", "json"])
    data = {"csv": csv_of, "parquet": lambda rows, _: parquet_of(rows)}.get(
        form, lambda rows, _: raw_json([{k: number(v) for k, v in row.items()} for row in rows]).encode()
    )(records, ",")
    truth = {(t, None): tuple(receiver) for t in epochs}
    return Made(which, {f"t.{form}": data}, (f"t.{form}", *sheet.options), rows, truth, ("pseudorange", form))


def turned(place, seconds):
    """Return a place along the axes of the Earth as they are some seconds later."""
    c, s = math.cos(TURN * seconds), math.sin(TURN * seconds)
    return [c * place[0] + s * place[1], c * place[1] - s * place[0], place[2]]


def latitude_longitude(place):
    """Return latitude and longitude of a place, good enough for a sky above it."""
    return math.degrees(math.atan2(place[2], math.hypot(*place[:2]))), math.degrees(math.atan2(place[1], place[0]))

"""What is mutated: every starter, scenario, study and kind of table that convert reads, and files that use the rest."""

import io
import json
import tomllib
from functools import cache
from importlib.resources import files
from math import cos, sin

import pyarrow as pa
from fuzz.mutations import toml_text
from pyarrow import csv, parquet

# Tables of a problem file that no starter and no scenario has, to be grafted on them.
MORE = """
format = 1
propagation_speed = 343.0
covariance = [[4.0, 1.0], [1.0, 4.0]]
frame = { kind = "enu", dimension = 2, origin = { lat_deg = 47.8, lon_deg = 11.2, height = 600.0 } }
epochs = { window = "1.5 s" }
target = { motion = "constant_acceleration", reference = 2.0 }
targets = { target = { motion = "known", rows = [{ x = 1500.0, y = 900.0, z = 400.0 }] } }
biases = [
  { name = "delay", per = "kind", kind = "tdoa", sigma = "30 m" },
  { name = "gain", form = "scale", per = "station", mean = 0.01, sigma = 0.1 },
  { name = "drift", form = "drift", members = ["East", "B"], sigma = "1 m/s" },
  { name = "turn", form = "rotation", kind = "azimuth", sigma = "1 deg" },
  { name = "cable", per = "pair" },
  { name = "frequency", per = "target", kind = "range_rate", mean = "100 Hz", sigma = "5000 Hz" },
  { name = "oscillator", per = "kind", form = "drift", kind = "range_rate", sigma = "0.5 Hz/s" },
  { name = "system", members = { one = ["North", "B"], two = ["East", "C"] }, mean = "10 m", sigma = "200 m" },
]
priors = [
  { name = "position", mean = [1400.0, 1000.0], sigma = 500.0 },
  { name = "position", mean = [1.4, 1.0, 0.3], sigma = [0.5, 0.5, 0.5], unit = "km" },
  { name = "velocity", mean = [20.0, -12.0], sigma = "5 m/s" },
  { name = "emission", mean = [0.0], sigma = "1 us" },
]
constraints = [
  { kind = "box", min = [-inf, -inf, 0.0], max = [inf, inf, 3000.0] },
  { kind = "box", min = [0.0, 0.0], max = [2.0, 2.0], unit = "km" },
  { kind = "height", exactly = "2300 m" },
  { kind = "height", min = 0.0, max = "9000 ft" },
  { kind = "above-ground" },
  { kind = "polygon", corners = [[0.0, 0.0], [3e3, 0.0], [3e3, 3e3], [0.0, 2e3]] },
  { kind = "polygon", corners_deg = [[47.8, 11.1], [47.9, 11.2], [47.7, 11.3]] },
  { kind = "visible", stations = ["G04", "North"], elevation = "5 deg" },
  { kind = "speed", max = "100 km/h" },
]
[stations]
sigma = "1 m"
span = "run"
axes = "enu"
time_unit = "ms"
columns = { name = "station" }
rows = [
  { name = "A", x = 0.0, y = 0.0, z = 1.0, vx = 1.0, vy = 2.0, vz = 0.0, yaw_deg = 10.0, sigma = 2.0, time = 0.0 },
  { name = "B", x = 9.0, y = 5.0, z = 1.0, qw = 1.0, qx = 0.0, qy = 0.0, qz = 0.0, epoch = "0" },
  { name = "C", lat_deg = 47.0, lon_deg = 11.0, height = 500.0, heading_deg = 90.0 },
]
[[measurements]]
unit = { range = "km", azimuth = "deg" }
positive = "b-farther"
azimuth = "north-clockwise"
sigma = "estimate"
correction = "3 m"
weight = 0.5
time_unit = "ms"
carrier_hz = 2.4e9
excess = true
rows = [
  { kind = "range", a = "North", z = 3000.0, sigma = 3.0, weight = 1.0, correction = 1.0, target = "t1", epoch = 1 },
  { kind = "azimuth", a = "East", z = 0.5, sigma = 0.1, weight = 0, target = "t2", epoch = 2 },
  { kind = "toa", a = "East", z = 2e3, time = 1.5 },
  { kind = "range_rate", a = "East", z = 20.0, time = 2.5 },
]
[[measurements]]
kind = "tdoa"
arrival_sigma = { North = "3 ns", East = 2.0, B = 1.0 }
covariance = [[9.0, 0.0, 0.0], [0.0, 9.0, 1.0], [0.0, 1.0, 9.0]]
rows = [{ a = "East", b = "North", z = -1977.9 }]
"""

# Tables of a study file that no shipped one has.
MORE_STUDY = """
format = 1
name = "more"
seed = 7
trials = 3
[[scenario]]
name = "file"
problem = "demo"
truth = { kind = "area", lat_deg = [47.7, 47.9], lon_deg = [11.1, 11.3], height = "2 km" }
noise = [1.0, "10 m", { tdoa = "10 ns" }]
bias = { clock = ["10 m", "20 m", 3.0, 4.0] }
error = { offset = "5 m", outliers = { share = 0.1, size = { tdoa = "100 m" }, late = true } }
sweep = { "error.outliers.share" = [0.1, 0.2], "truth.height" = [0.0, 100.0] }
trials = 2
[[scenario]]
name = "fixed"
layout = { stations = 5, placement = "star", kinds = ["range", "azimuth"], pairs = "all", survey = "1 m" }
truth = { kind = "fixed", at = [100.0, "2 km"], speed = "3 m/s", velocity = [1.0, 2.0], at_deg = [47.0, 11.0, 3.0] }
[[scenario]]
name = "run"
problem = "registration"
truth = { kind = "box", centre = [0.0, 0.0, 0.0], box = ["1 km", "1 km", "1 km"], elevation_deg = [10.0, 80.0] }
[[method]]
name = "own"
method = "auto"
start = "truth"
width = "5 km"
batch = 2
chunk = 2
[[method]]
method = "sdp+lsr"
solver = "SCS"
settings = { max_iters = 100, eps_abs = 1e-6 }
"""
SITES = "station,lat,lon,height\nA,47.00,11.00,500\nB,47.02,11.10,620\nC,47.10,11.05,560\nD,47.08,10.95,900\n"
GRID = "Receiver,X_km,Y_km,Z_km\nA,0,0,0.5\nB,7.6,2.2,0.6\nC,3.8,11.1,0.5\nD,-3.8,8.9,0.9\n"
ARRIVALS = "message,station,toa_ns\n" + "".join(
    f"{m},{s},{1_790_000_000_000_000_000 + 10**9 * m + t}\n"
    for m, row in enumerate(((9000, 23100, 19800, 21500), (25100, 9800, 30300, 26000), (15020, 16030, 17040, 18050)))
    for s, t in zip("ABCD", row, strict=True)
)
PSEUDORANGES = "time,satellite,pseudorange,x,y,z\n" + "".join(
    f"{t},{s},{r + 700 * t:.1f},{x},{y},{z}\n"
    for t in (0, 30)
    for s, r, x, y, z in (
        ("G04", 20198673.1, 15600e3, 7540e3, 20140e3),
        ("G09", 21684380.1, 18760e3, -12750e3, 13610e3),
        ("G17", 22452111.2, 22760e3, 13400e3, 1950e3),
        ("G21", 21701849.5, 5090e3, 14610e3, 21610e3),
        ("G30", 21483155.7, 25610e3, -1400e3, 6660e3),
    )
)
ELEMENTS = """LEO 1
1 90001U 97020B   26097.00000000  .00000000  00000-0  00000-0 0  9992
2 90001  86.3900 196.0000 0002000  90.0000 270.0000 14.34216000 10006
LEO 2
1 90002U 97020C   26097.00000000  .00000000  00000-0  00000-0 0  9993
2 90002  63.4000  64.0000 0002000  90.0000 342.0000 14.34216000 10008
"""
MEAN_ELEMENTS = {
    "OBJECT_NAME": "LEO 1", "OBJECT_ID": "1997-020B", "EPOCH": "2026-04-07T00:00:00.000000", "MEAN_MOTION": 14.34216,
    "ECCENTRICITY": 0.0002, "INCLINATION": 86.39, "RA_OF_ASC_NODE": 196.0, "ARG_OF_PERICENTER": 90.0,
    "MEAN_ANOMALY": 270.0, "EPHEMERIS_TYPE": 0, "CLASSIFICATION_TYPE": "U", "NORAD_CAT_ID": 90001,
    "ELEMENT_SET_NO": 999, "REV_AT_EPOCH": 1000, "BSTAR": 0, "MEAN_MOTION_DOT": 0, "MEAN_MOTION_DDOT": 0,
}  # fmt: skip
PLACES = "#dP2026  4  7  0  0  0.00000000      12\n%c M  cc GPS ccc cccc cccc cccc cccc ccccc ccccc ccccc\n" + "".join(
    f"*  2026  4  7  0 {k:2d}  0.00000000\n"
    f"PL01{7158.0 * cos(0.0625 * k):14.6f}{0.0:14.6f}{7158.0 * sin(0.0625 * k):14.6f}{999999.999999:14.6f}\n"
    for k in range(20)
)
PASS = "time,satellite,z\n" + "".join(f"2026-04-07T00:{k}:30Z,{{}},{20.0 * k}\n" for k in range(11, 16))


def geojson():
    """Return the sites as GeoJSON, one with its height among the properties."""
    rows = [line.split(",") for line in SITES.splitlines()[1:]]
    points = [
        {
            "type": "Feature",
            "properties": {"name": name, "height": float(height)},
            "geometry": {"type": "Point", "coordinates": [float(lon), float(lat), float(height)]},
        }
        for name, lat, lon, height in rows
    ]
    del points[1]["geometry"]["coordinates"][2]
    road = {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}}
    return json.dumps({"type": "FeatureCollection", "features": [*points, road]}, indent=1)


def csv_of(fields):
    """Return one row as a CSV table."""
    return ",".join(fields) + "\n" + ",".join(map(str, fields.values())) + "\n"


def to_parquet(data):
    """Return a CSV table as Parquet."""
    out = io.BytesIO()
    parquet.write_table(csv.read_csv(pa.BufferReader(data), csv.ReadOptions(use_threads=False)), out)
    return out.getvalue()


@cache
def problems():
    """Return the files of each problem by name, the problem file first."""
    folder = files("optloc")
    found = {}
    for path in sorted((folder / "starters").iterdir(), key=lambda p: p.name):
        if path.name == "calibration.toml":  # no problem, but a network
            continue
        found[path.name] = {path.name: path.read_bytes()}
    tables = {path.name: path.read_bytes() for path in (folder / "scenarios").iterdir() if path.name.endswith(".csv")}
    for path in sorted((folder / "scenarios").iterdir(), key=lambda p: p.name):
        if path.name.endswith(".toml"):
            text = path.read_bytes()
            # A run of many epochs is cut: what is looked for does not hang on how many there are.
            own = {name: _head(data) for name, data in tables.items() if name.encode() in text}
            found[path.name] = {path.name: text, **own}
            if own:
                packed = {name.replace(".csv", ".parquet"): to_parquet(data) for name, data in own.items()}
                found[f"{path.name} of parquet"] = {path.name: text.replace(b".csv", b".parquet"), **packed}
    return found


def _head(data):
    lines = data.splitlines(keepends=True)
    return b"".join(lines[:41])


@cache
def studies():
    """Return the files of each study by name: of the shipped ones each scenario alone, once with every method."""
    shipped = sorted((files("optloc") / "studies").iterdir(), key=lambda p: p.name)
    found = {}
    for path in [path for path in shipped if path.name.endswith(".toml")]:
        study = tomllib.loads(path.read_text(encoding="utf-8"))
        for number, scenario in enumerate(study.get("scenario", ())):
            one = scenario | {"noise": scenario["noise"][:1]}
            one |= {"sweep": {key: values[:1] for key, values in scenario.get("sweep", {}).items()}}
            method = study["method"][number % len(study["method"])]
            method = {key: value[0] if isinstance(value, list) else value for key, value in method.items()}
            text = toml_text(study | {"scenario": [one], "method": [method]})
            found[f"{path.name} {number + 1}"] = {path.name: text.encode()}
    return found | {"more.toml": {"more.toml": MORE_STUDY.encode()}}


@cache
def conversions():
    """Return (files, further arguments of the command, what it may write) of each conversion by name."""
    to, site = ["--out", "site.toml"], ("site.toml", "site-rows.csv", "site-stations.csv")
    heard, sites = {"toa.csv": ARRIVALS.encode()}, {"sites.geojson": geojson().encode()}
    packed, gnss = {"toa.parquet": to_parquet(ARRIVALS.encode())}, {"gnss.csv": PSEUDORANGES.encode()}
    spread = ["--sigma", "20 ns", *to]
    leo, told = {"pass.csv": PASS.format(*5 * ["LEO 1"]).encode()}, ["--times", "pass.csv", "--out", "s.csv"]
    omm = csv_of(MEAN_ELEMENTS).encode()
    return {
        "elements": ({"leo.tle": ELEMENTS.encode()} | leo, told, ("s.csv",)),
        "mean elements": ({"leo.csv": omm} | leo, told, ("s.csv",)),
        "mean elements, json": ({"leo.json": json.dumps([MEAN_ELEMENTS]).encode()} | leo, told, ("s.csv",)),
        "places": (
            {"leo.sp3": PLACES.encode(), "l01.csv": PASS.format(*5 * ["L01"]).encode()} | sites,
            ["--times", "l01.csv", "--stations", "sites.geojson", "--out", "s.csv"],
            ("s.csv",),
        ),
        "arrivals, geojson": (heard | sites, ["--stations", "sites.geojson", *spread], site),
        "arrivals, table": (heard | {"rx.csv": GRID.encode()}, ["--stations", "rx.csv", *spread], site),
        "arrivals, parquet": (packed | {"rx.csv": SITES.encode()}, ["--stations", "rx.csv", *spread], site),
        "pseudoranges": (gnss, ["--sigma", "3 m", *to], site),
        "pseudoranges, parquet": (
            {"gnss.parquet": to_parquet(PSEUDORANGES.encode())},
            ["--sigma", "estimate", *to],
            site,
        ),
        "stations": (sites, ["--out", "stations.csv"], ("stations.csv",)),
        "stations of a table": ({"rx.csv": SITES.encode()}, ["--as", "stations", "--out", "s.csv"], ("s.csv",)),
    }


@cache
def grafts(family):
    """Return the data of all files of a family, of which parts may be grafted on others."""
    texts = [next(iter(held.values())) for held in (problems() if family == "problem" else studies()).values()]
    more = tomllib.loads(MORE if family == "problem" else MORE_STUDY)
    # Every other graft is of what the files lack.
    return [*(tomllib.loads(text.decode()) for text in texts), *[more] * len(texts)]

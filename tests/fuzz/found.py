"""What mutated files have found: arguments, files, the words of the one sentence; None where there is an answer."""

from fuzz.originals import problems, to_parquet

STATIONS = """[stations]
rows = [
  { name = "A", x = 0.0, y = 0.0 },
  { name = "B", x = 4000.0, y = 300.0 },
  { name = "C", x = 200.0, y = 5000.0 },
  { name = "D", x = 4100.0, y = 4700.0 },
]
"""
RANGES = """[[measurements]]
kind = "range"
sigma = 3.0
rows = [{ a = "A", z = 2800.0 }, { a = "B", z = 2700.0 }, { a = "C", z = 3500.0 }, { a = "D", z = 3400.0 }]
"""
TIMED = RANGES.replace("{ a", "{ time = 0.0, a", 2).replace("{ a", "{ time = 9.0, a")
GAINS = """[[measurements]]
kind = "groa"
unit = "dB"
sigma = 0.1
b = "D"
rows = [{ a = "A", z = 1.0 }, { a = "B", z = 1e9 }, { a = "C", z = 2.0 }]
"""
GOOD = f"format = 1\n{STATIONS}{RANGES}"
STUDY = """format = 1
name = "s"
trials = 2
[[scenario]]
name = "one"
layout = { stations = 5 }
truth = { kind = "shell", distance = ["20 km", "10 km"] }
noise = ["1 m"]
[[method]]
method = "gtrs+lsr"
"""
POLYGON = (
    '[[constraints]]\nkind = "polygon"\ncorners = [' + ", ".join(f"[{i}.0, {i * i}.0]" for i in range(2000)) + "]\n"
)
HEIGHT = """format = 1
frame = { kind = "ecef" }
[stations]
rows = [{ name = "A", x = 4177e3, y = 855e3, z = 4728e3 }]
[[measurements]]
kind = "height"
sigma = 5.0
rows = [{ z = 900.0 }]
"""
PRIOR = '[[priors]]\nname = "position"\nmean = [1.0, 2.0]\nsigma = "1 m"\n'
KNOWN = "[target]\nrows = [{ x = 1.0, y = 2.0 }]\n"
ROW = '{{ a = "{}", target = "{}", z = 3000.0 }}'
TARGETS = f"""[[measurements]]
kind = "range"
sigma = 1.0
rows = [{", ".join(ROW.format("ABCD"[i % 4], i // 4) for i in range(8000))}]
"""
POINT = (
    '{"features": [{"type": "Feature", "id": 1, "properties": %s, "geometry": {"type": "Point", "coordinates": %s}}]}'
)
ENU = '[frame]\nkind = "enu"\norigin = { lat_deg = 47.8, lon_deg = 11.2 }\n'


def problem(old="", new="", text=GOOD):
    """Return a good problem file with one thing changed."""
    assert old in text
    return {"p.toml": text.replace(old, new, 1)}


def study(old, new):
    """Return a study file with one thing changed."""
    assert old in STUDY
    return {"s.toml": STUDY.replace(old, new, 1)}


def table(name, content):
    """Return a problem file whose rows are in a table."""
    return {
        "p.toml": f'format = 1\n{STATIONS}[[measurements]]\nkind = "range"\nsigma = 1.0\nfile = "{name}"\n',
        name: content,
    }


FIX, CHECK, SIMULATE = ["fix", "p.toml", "--json"], ["check", "p.toml"], ["simulate", "p.toml", "--truth", "1,2"]
RUN = ["study", "run", "s.toml", "--out", "out", "-j", "1", "-q"]
SITES = ["convert", "s.geojson", "--out", "s.csv"]
FOUND = {
    "station at 1e300 m": (FIX, problem("4100.0", "1e300"), ["p.toml", "1e+300", "beyond 1e+30"]),
    "range of 1e31 km": (FIX, problem("2800.0", "1e308"), ["p.toml", "1e+308", "beyond 1e+30"]),
    "large in another unit": (
        FIX,
        problem('"range"\n', '"range"\nunit = "km"\n', GOOD.replace("2800.0", "1e29")),
        ["p.toml", "row 1, column 'z'", "exceeds 1e+30"],
    ),
    "number of 400 digits": (FIX, problem("2800.0", "9" * 400), ["p.toml", "beyond 1e+30", "99999..."]),
    "amount of 1e308": (FIX, problem("sigma = 3.0", 'sigma = "1e308 km"'), ["'sigma'", "beyond 1e+30"]),
    "sigma of 1e-50": (FIX, problem("sigma = 3.0", "sigma = 1e-50"), ["p.toml", "deviations below 1e-30"]),
    "decibels of 1e9": (FIX, {"p.toml": f"format = 1\n{STATIONS}{GAINS}"}, ["row 2, column 'z'", "exceeds 1e+30"]),
    "cell of 1e308": (
        FIX,
        table("r.csv", "a,z\nA,1.0\nB,1e308\n"),
        ["r.csv, row 2, column 'z'", "1e308 is larger than 1e+30"],
    ),
    "names that are no numbers": (
        FIX,
        table("r.parquet", to_parquet(b"a,z\n1.5,1.0\n,2.0\n")),
        ["r.parquet, row 2, column 'a'", "empty"],
    ),
    "header with a break": (
        FIX,
        table("r.csv", 'a,"z\rx,y\n'),
        ["r.csv, header", "this is not a CSV table: "],
    ),
    "the plane beside a place on Earth": (FIX, problem("[stations]", f"{ENU}[stations]"), None),
    "numbers and words in one column": (
        [*SIMULATE, "--out", "s.toml"],
        {"p.toml": GOOD.replace("{ a", "{ time = 0.0, a").replace("0.0, a", '"0.0", a', 1)},
        None,
    ),
    "a billion decimals": (
        ["convert", "toa.csv", "--stations", "rx.csv", "--sigma", "1 ns", "--out", "t.toml"],
        {"toa.csv": "message,station,toa_ns\n1,A,1e-999999999\n1,B,2\n", "rx.csv": "name,x,y\nA,0,0\nB,1,0\n"},
        ["toa.csv, row 1, column 'toa_ns'", "1e-999999999"],
    ),
    "a polygon of 2000 corners": (FIX, problem(text=f"{GOOD}{POLYGON}"), ["2000 corners", "1000 at most"]),
    "200 priors": (FIX, problem(text=GOOD + 200 * PRIOR), ["priors", "100"]),
    "2000 targets at once": (FIX, problem(text=f"format = 1\n{STATIONS}{TARGETS}"), ["4000 unknowns, 300 at most"]),
    "offsets of stations about a known target": (
        FIX,
        problem("[stations]", '[stations]\nsigma = "1 m"', f"{GOOD}{KNOWN}"),
        None,
    ),
    "a bound of emission times alone": (
        ["crlb", "p.toml"],
        problem('"range"', '"toa"', f"{GOOD}{KNOWN}"),
        ["p.toml", "no unknown is shared"],
    ),
    "an empty unit": (FIX, problem("sigma", 'unit = ""\nsigma'), ["unknown unit ''"]),
    "a bound of nothing": (["crlb", "p.toml"], problem(text=f"{GOOD}{KNOWN}"), ["no unknown is shared"]),
    "a track of what is known": (["track", "p.toml"], problem(text=f"{GOOD}{KNOWN}"), ["each target is known"]),
    "a date among numbers": (
        FIX,
        {"p.toml": GOOD.replace("{ a", "{ time = 3.0, a").replace("3.0, a", '"2024-05-01", a', 1)},
        ["row 2, column 'time'", "3.0 is not a date"],
    ),
    "a carrier of 1e-310 Hz": (
        FIX,
        problem('"groa"\nunit = "dB"', '"fdoa"\nunit = "Hz"\ncarrier_hz = 1e-310', f"format = 1\n{STATIONS}{GAINS}"),
        ["carrier", "positive"],
    ),
    "properties that are a list": (SITES, {"s.geojson": POINT % ("[1]", "[11.0, 47.0]")}, ["feature 1", "properties"]),
    "a name that is a table": (SITES, {"s.geojson": (POINT % ('{"name": {}}', "[1, 2]")).replace('"id": 1, ', "")},
                               ["feature 1", "no name"]),
    "a longitude of 400 digits": (SITES, {"s.geojson": POINT % ("{}", f"[{'9' * 400}, 47.0]")}, ["beyond 1e+30"]),
    "distances the other way round": (RUN, {"s.toml": STUDY}, ["scenario 'one'", "distance", "20000", "exchange them"]),
    "a height and nothing else": (["fix", "p.toml", "-q", "-m", "gtrs+lsr"], {"p.toml": HEIGHT}, None),
    "elevations beyond the zenith": (
        RUN,
        study('"20 km", "10 km"]', '"1 km", "2 km"], elevation_deg = [80.0, 100.0]'),
        ["elevation_deg", "90 degrees"],
    ),
    "an arrival a million times too late among frequencies": (
        ["fix", "fdoa.toml", "-m", "robust", "--json"],
        {"fdoa.toml": problems()["fdoa.toml"]["fdoa.toml"].replace(b"9779.0", b"9779000000.0")},
        None,
    ),
    "windows of the least double": (
        ["check", "p.toml"],
        problem(text=f"format = 1\n[epochs]\nwindow = '5e-324 s'\n{STATIONS}{TIMED}"),
        ["key 'window'", "too short to be counted"],
    ),
    "a difference of seven thousand decibels": (
        ["fix", "l.toml", "--json"],
        {"l.toml": problems()["rss_difference.toml"]["rss_difference.toml"].replace(b"z = -4.19", b"z = -7027.9")},
        None,
    ),
    "an empty kind": (FIX, problem('"range"', '""'), ["unknown kind ''"]),
}  # fmt: skip

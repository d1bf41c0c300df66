"""What is mutated beside problem files: foreign tables, recordings and checkpoints of streams, folders of studies.

Each original is a mapping of files, a list of commands with the files that they may write, and nothing else.
"""

import hashlib
import json
import math
import random
import tempfile
from functools import cache
from pathlib import Path

from fuzz.plain import C
from fuzz.tables import made

HERE = Path(__file__).parent
SITE_FILES = ("p.toml", "p-*.csv")
# Of a table and its options: the command before them, what stands behind them, what may be written.
OF_TABLES = (
    *[("fix", ("--json",), ())] * 4,
    ("fix", (), ()),
    ("fix", ("--out", "f.csv"), ("f.csv",)),
    ("fix", ("-m", "robust", "--json"), ()),
    ("fix", ("--height", "3 m", "--json"), ()),
    ("fix", ("--noise-from-data", "station", "--json"), ()),
    *[("convert", ("--out", "p.toml"), SITE_FILES)] * 3,
    ("convert", ("--json",), ()),
    ("check", (), ()),
    ("check", ("--json",), ()),
    ("check", ("--out", "h.parquet"), ("h.parquet",)),
    ("track", ("--json",), ()),
    ("track", (), ()),
    ("track", ("--out", "t.csv"), ("t.csv",)),
    ("track", ("--model", "csm", "--filter", "ekf", "--json"), ()),
)

# Tables of other programs, and sparse ones: the files, the first of them the table, and what must be told.

RX = "name,lat,lon,alt_m\nLake,47.812,11.183,612\nChapel,47.861,11.246,701\nQuarry,47.843,11.121,655\n"
RX += "Summit,47.764,11.262,1410\nMill,47.751,11.148,640\nTower,47.790,11.310,842\n"
HEARD = dict(
    zip("Lake Chapel Quarry Summit Mill Tower".split(), (14221, 14691, 25540, 30224, 37037, 30664), strict=True)
)
NET = "station,latitude,longitude,elevation_m\nAQU,42.354,13.405,710\nFIAM,42.268,13.117,1070\nTERO,42.623,13.604,673\n"
NET += "CAMP,42.536,13.409,1283\nFAGN,42.266,13.584,761\nINTR,42.011,13.904,924\n"
PICKS = "station,P,S\nAQU,2026-04-06T01:32:41.73Z,2026-04-06T01:32:42.99Z\n"
PICKS += "FIAM,2026-04-06T01:32:44.31Z,2026-04-06T01:32:47.48Z\n"
PICKS += "TERO,2026-04-06T01:32:46.31Z,2026-04-06T01:32:50.94Z\nCAMP,2026-04-06T01:32:44.03Z,2026-04-06T01:32:46.99Z\n"
PHASES = "event,station,phase,time\n" + "".join(
    f"{event},{row.split(',')[0]},{phase},{row.split(',')[1 + (phase == 'S')]}\n"
    for event in (1, 2)
    for row in PICKS.splitlines()[1:]
    for phase in "PS"
)
KRAKEN = "{}, {}, 5.2, -42.0, 148524000, UCA, 436, {}, {}, {}, {}, 0, GPS, R, R, R, R" + ", 1.2" * 360
ANCHORS = "anchor,x_m,y_m,z_m\nA1,0,0,2.5\nA2,6,0,0.3\nA3,6,8,2.6\n"


def sparse_arrivals(count, lone):
    """Return arrivals of some messages, of which some were heard by one station or by two."""
    rng = random.Random(1)
    rows = [
        f"{m},{name},{1_790_000_000_000_000_000 + m * 10**9 + t + round(rng.gauss(0, 20))}\n"
        for m in range(count)
        for name, t in HEARD.items()
        if m not in lone or name == "Tower" or (m % 2 and name == "Mill")
    ]
    return "message,station,toa_ns\n" + "".join(rows)


def mlat_dump():
    """Return what mlat-server writes of two messages."""
    spots = [[4150000.0 + 9e3 * math.cos(k), 840000.0 + 9e3 * math.sin(k), 4750000.0 + 500.0 * k] for k in range(5)]
    truth = [4152000.0, 841000.0, 4758000.0]
    lines = []
    for k in range(2):
        cluster = [[*spot, round(math.dist(spot, truth) / C * 1e6, 4), 0.0004] for spot in spots]
        lines.append(json.dumps({"icao": "3c6444", "time": 1.79e9 + k, "ecef": [0, 0, 0], "cluster": cluster}))
    return "\n".join(lines)


def nested_ranges():
    """Return ranges of two scans as a tree, some of them missing."""
    scans = []
    for k in range(3):
        heard = [
            {"anchor": {"id": f"A{i + 1}"}, "range_m": 3.1 + i + 0.1 * k, "rssi": -60}
            for i in range(3)
            if (i, k) != (1, 2)
        ]
        scans.append({"t_s": 0.5 * k, "pose": {"yaw": 0.1}, "readings": heard})
    return json.dumps({"robot": "r1", "log": {"scans": scans}})


def side_by_side():
    """Return a table whose cells hold lists."""
    rows = [f'{k},"[""A1"", ""A2"", ""A3""]","[3.1, 4.{k}, 5.2]"' for k in range(4)]
    return "t_s,anchor,range_m\n" + "\n".join(rows) + "\n"


def sparse_ranges():
    """Return ranges of a wide table with holes: epochs of one reading, of none, and a station that was heard once."""
    rows = ["0,385,517,655", "100,387,,652", "200,,,648", "300,,,", "400,390,,", "500,391,,641", "600,,,639"]
    return "t_ms,dist_A1_cm,dist_A2_cm,dist_A3_cm\n" + "\n".join(rows) + "\n"


def phone():
    """Return two epochs of the real RINEX file as Android's GnssLogger writes them."""
    from optloc.files.rinex import read_observations

    head = (
        "Raw,utcTimeMillis,TimeNanos,LeapSecond,FullBiasNanos,BiasNanos,Svid,TimeOffsetNanos,State,ReceivedSvTimeNanos,"
    )
    head += "ReceivedSvTimeUncertaintyNanos,CarrierFrequencyHz,ConstellationType,HardwareClockDiscontinuityCount"
    seen, week = read_observations(HERE.parent / "files" / "kamakura.rnx", "G"), 604_800 * 10**9
    noon = round(float(seen.time[0]))
    bias, lines = 5_000_000_000 - noon * 10**9, ["# ", f"# {head}", "# "]
    for time, satellite, way in zip(seen.time.tolist(), seen.satellite, seen.pseudorange.tolist(), strict=True):
        if time - seen.time[0] < 31.0:
            since = round((time - noon) * 1e9) + 5_000_000_000
            sent = (since - bias) % week - round(way / C * 1e9)
            lines.append(f"Raw,0,{since},18,{bias},0.0,{int(satellite[1:])},0.0,9,{sent},20,1575420030.0,1,0")
    return "\n".join(lines) + "\n"


@cache
def foreign():
    """Return the files and the options of each table by name."""
    gnss = HERE.parent / "files"
    nav = {"k.nav": (gnss / "kamakura.nav").read_bytes()}
    kraken = "\n".join(
        KRAKEN.format(1_700_000_000_000 + 1000 * k, 150 - 60 * k, name, 47.9 - 0.1 * k, 11.2 - 0.2 * k, 30)
        for k, name in enumerate(("north", "west", "south"))
    )
    ns, quake = ["--sigma", "20 ns"], ["--vp", "6 km/s", "--vs", "3.46 km/s", "--sigma", "0.05 s"]
    rx, net, anchors = {"rx.csv": RX}, {"net.csv": NET}, {"anchors.csv": ANCHORS}
    uwb = ["--stations", "anchors.csv", "--sigma", "10 cm"]
    found = {
        "sparse arrivals": ({"a.csv": sparse_arrivals(8, {3, 4})} | rx, ["--stations", "rx.csv", *ns]),
        "lone arrivals": ({"a.csv": sparse_arrivals(4, {0, 1, 2, 3})} | rx, ["--stations", "rx.csv", *ns]),
        "arrivals in windows": (
            {"a.csv": sparse_arrivals(5, {2}).replace("message,", "number,")} | rx,
            ["--stations", "rx.csv", "--window", "1 ms", *ns],
        ),
        "sparse ranges": ({"u.csv": sparse_ranges()} | anchors, [*uwb, "--missing", "none"]),
        "nested ranges": ({"n.json": nested_ranges()} | anchors, [*uwb, "--column", "station=anchor_id"]),
        "side by side": ({"s.csv": side_by_side()} | anchors, uwb),
        "picks": ({"p.csv": PICKS} | net, ["--stations", "net.csv", *quake]),
        "phases": ({"p.csv": PHASES} | net, ["--stations", "net.csv", *quake]),
        "mlat-server": ({"d.json": mlat_dump()}, []),
        "KrakenSDR": ({"k.csv": kraken}, ["--sigma", "2 deg", "--still"]),
        "RINEX": (
            {"k.rnx": (gnss / "kamakura.rnx").read_bytes()} | nav,
            ["--navigation", "k.nav", "--sigma", "1 m"],
        ),
        "Android": ({"log.txt": phone()} | nav, ["--navigation", "k.nav", "--sigma", "5 m"]),
    }
    return {name: (encoded(held), tuple(options)) for name, (held, options) in found.items()}


def encoded(held):
    """Return files as bytes."""
    return {name: text if isinstance(text, bytes) else text.encode() for name, text in held.items()}


def table_case(rng):
    """Return name, files, arguments and what may be written, of a table."""
    verb, more, asked = rng.choice(OF_TABLES)
    if rng.random() < 0.45:
        name = rng.choice(sorted(foreign()))
        held, options = foreign()[name]
        return name, held, (verb, next(iter(held)), *options, *more), asked
    table = made(0, rng.randrange(100_000))
    source, *options = table.arguments
    return f"table {table.number}", table.files, (verb, source, *options, *more), asked


# Streams: a site, recordings in three formats, a checkpoint.

SITE = """format = 1
title = "Six receivers"
[stations]
rows = [
  { name = "A", x = 0.0, y = 0.0, z = 0.0 },
  { name = "B", x = 4000.0, y = 200.0, z = 900.0 },
  { name = "C", x = 4300.0, y = 4100.0, z = 100.0 },
  { name = "D", x = -200.0, y = 3900.0, z = 1200.0 },
  { name = "E", x = 2100.0, y = -1500.0, z = 400.0 },
]
[[measurements]]
kind = "tdoa"
sigma = "5 m"
b = "A"
rows = [{ a = "B" }, { a = "C" }, { a = "D" }, { a = "E" }]
"""
PLACES = {"A": (0.0, 0.0, 0.0), "B": (4000.0, 200.0, 900.0), "C": (4300.0, 4100.0, 100.0)}
PLACES |= {"D": (-200.0, 3900.0, 1200.0), "E": (2100.0, -1500.0, 400.0)}


def far(k):
    """Return the distances of the stations from the target of an event."""
    return {name: math.dist(at, (2000.0 + 60.0 * k, 1500.0, 700.0)) for name, at in PLACES.items()}


def recording():
    """Return whole events, single rows and arrivals as lines."""
    lines = []
    for k in range(3):
        z = [far(k)[name] - far(k)["A"] for name in "BCDE"]
        lines.append({"event": f"e{k}", "z": z, "target": "t1", "time": 10.0 + k, "received": float(k)})
    lines += [
        {"event": "r", "kind": "tdoa", "a": a, "b": "A", "z": far(4)[a] - far(4)["A"], "received": 3.0} for a in "BCDE"
    ]
    start = 1_700_000_000_000_000_000
    lines += [
        {"event": "h", "station": n, "time_ns": start + round(v / C * 1e9), "received": 4.0} for n, v in far(5).items()
    ]
    lines += [{"event": "few", "station": "A", "time_ns": start}, {"event": "two", "z": [1.0, None, 2.0, None]}]
    return "\n".join(map(json.dumps, lines)) + "\n"


def uplinks():
    """Return uplinks of ChirpStack as lines."""
    lines = []
    for k in range(3):
        heard = [
            {"gatewayId": name, "rssi": -80, "fineTimeSinceGpsEpoch": f"1400000000.{round(1e6 + v / C * 1e9):09d}s"}
            for name, v in far(k).items()
        ]
        heard.append({"gatewayId": "roaming", "rssi": -110})
        lines.append({"deduplicationId": f"d{k}", "deviceInfo": {"devEui": "0101"}, "fCnt": k, "rxInfo": heard})
    return "\n".join(map(json.dumps, lines)) + "\n"


def messages():
    """Return messages of mlat-client as lines, around midnight."""
    lines = []
    for k in range(2):
        for name, v in far(k).items():
            at = (86_399_999_995_000 + k * 10**9 + round(v / C * 1e9)) % 86_400_000_000_000
            lines.append({"receiver": name, "mlat": {"t": at, "m": "8d4840d6202cc371c32ce0576098"}})
    lines.append({"receiver": "A", "sync": {"t": 1}})
    return "\n".join(map(json.dumps, lines)) + "\n"


def checkpoint():
    """Return the checkpoint of a stream with two open events."""
    rows = [["tdoa", a, "A", far(1)[a] - far(1)["A"], None] for a in "BCD"]
    about = {"target": "t1", "revision": 1, "conflict": False, "when": None, "track": False}
    other = {"event": "h", "rows": [], "times": [["A", "1700000000000000000000"], ["B", "1700000000000012345000"]]}
    found = {
        "format": "optloc live 1", "site": "site.toml",
        "open": [{"event": "r", "rows": rows, "times": []} | about, other | about | {"when": "1700000000000000000000"}],
        "closed": ["e0", "e7"], "counts": {"lines": 5, "rows": 3, "events": 2, "malformed": 0},
    }  # fmt: skip
    return json.dumps(found)


# Recording, what stands behind it, what may be written.
_STATE, _UPLINKS = ("site.state",), ("--adapter", "chirpstack")
OF_STREAMS = (
    *[("rec.ndjson", (), ())] * 3,
    ("rec.ndjson", ("--phases", "one"), ()),
    ("rec.ndjson", ("--phases", "fix", "--late", "revise"), ()),
    ("rec.ndjson", ("--track",), ()),
    ("rec.ndjson", ("--format", "geojson"), ()),
    ("rec.ndjson", ("--format", "nmea"), ()),
    ("rec.ndjson", ("--format", "cot"), ()),
    ("rec.ndjson", ("--format", "aircraft"), ()),
    ("rec.ndjson", ("--partition", "1/2"), ()),
    ("rec.ndjson", ("--record", "out.ndjson"), ("out.ndjson",)),
    *[("up.ndjson", _UPLINKS, ())] * 3,
    ("up.ndjson", (*_UPLINKS, "--track"), ()),
    *[("modes.ndjson", ("--adapter", "mode-s"), ())] * 3,
    *[("rec.ndjson", ("--state", "site.state"), _STATE)] * 5,
    ("up.ndjson", (*_UPLINKS, "--state", "site.state"), _STATE),
)


def stream_case(rng):
    """Return name, files, arguments and what may be written, of a stream that reads a recording."""
    source, more, asked = rng.choice(OF_STREAMS)
    text = {"rec.ndjson": recording, "up.ndjson": uplinks, "modes.ndjson": messages}[source]()
    held = {source: text, "site.toml": SITE} | ({"site.state": checkpoint()} if asked == ("site.state",) else {})
    # The checkpoint is what is mutated where there is one.
    held = dict(sorted(held.items(), key=lambda item: item[0] != "site.state"))
    return f"{source} of a stream", encoded(held), ("live", "site.toml", "--replay", source, *more), asked


# Folders of studies.

STUDY = """format = 1
name = "small"
seed = 5
trials = 6
[[scenario]]
name = "differences"
layout = { stations = 6 }
truth = { kind = "shell", distance = ["5 km", "20 km"] }
noise = ["1 m"]
[[method]]
method = "gtrs+lsr"
chunk = 3
[[method]]
method = "auto"
chunk = 3
"""
_RESUME = ("study", "run", "small.toml", "--out", "out", "-j", "1")
OF_STUDIES = (
    *[("study", "status", "out")] * 2,
    ("study", "status", "out", "--json"),
    *[("study", "report", "out")] * 2,
    ("study", "pairs", "out"),
    ("study", "profiles", "out", "--json"),
    ("study", "compare", "out", "out"),
    ("study", "histories", "out", "--trials", "2"),
    *[(*_RESUME, "-q")] * 2,
    (*_RESUME, "--trials", "9"),
)


@cache
def study_folder():
    """Return the files of a study that is done, by their names: computed once in a process."""
    from optloc.lab.study.design import design_of_text
    from optloc.lab.study.folder import begin, locked, store
    from optloc.lab.study.trial import compute

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "out"
        design = design_of_text(STUDY, "small.toml", Path())
        with locked(folder):
            begin(design, folder)
            for chunk in design.chunks:
                store(folder, compute(chunk))
        files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock"]
        return {str(path.relative_to(place)): path.read_bytes() for path in files}


def study_case(rng):
    """Return name, files, arguments and what may be written, of the folder of a study."""
    arguments = rng.choice(OF_STUDIES)
    held = dict(study_folder())
    if rng.random() < 0.3:  # a run that was stopped
        del held[rng.choice([name for name in held if name.endswith(".parquet")])]
    if rng.random() < 0.1:
        held[rng.choice(["out/parts/.optloc-x", "out/.optloc-manifest.json", "out/parts/note.parquet", "out/x"])] = b"x"
    return "folder of a study", held | {"small.toml": STUDY.encode()}, arguments, ("out", "out/*", "out/.*")


def renamed(name, data):
    """Return the name of a part file that holds some data: it tells damage."""
    key = name.split(".")[0]
    return f"{key}.{hashlib.blake2b(data, digest_size=8).hexdigest()}.parquet"

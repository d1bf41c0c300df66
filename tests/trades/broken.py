"""Tables and files of the trades of sound and waves, correct and with one mistake each, and the commands that run them.

A case has a name, its files, and the words of a command. All values are predicted from a known position, so only the
stated mistake is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

SOUND = 343.2
"""Speed of sound of the scenes in air, m/s."""
WATER = 1481.0
"""Speed of sound of the scenes in water, m/s."""


@dataclass(frozen=True)
class Case:
    """One input: the files by name, and the words of a command."""

    name: str
    files: Mapping[str, str]
    words: tuple[str, ...]

    def changed(self, name: str, old: str, new: str, *more: str, file: str = "t.csv") -> Case:
        """Return the case with a text replaced in one of its files, and with more words."""
        text = self.files[file]
        assert old in text, (name, old)
        return replace(self, name=name, files={**self.files, file: text.replace(old, new)}, words=(*self.words, *more))

    def called(self, name: str, *more: str, without: Sequence[str] = ()) -> Case:
        """Return the case with more words, and without options and their values."""
        words, skip = [], False
        for word in self.words:
            if skip or word in without:
                skip = not skip
                continue
            words.append(word)
        return replace(self, name=name, words=(*words, *more))


def table(head: str, rows: Sequence[Sequence[object]]) -> str:
    """Return a CSV text."""
    return "\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n"


MICS = {
    "Depot": (0, 0),
    "School": (62, 8),
    "Church": (18, 54),
    "Bridge": (76, 69),
    "Park": (-31, 38),
    "Mill": (35, -29),
}
HALL = {"A": (0, 0, 3), "B": (24, 1, 2.5), "C": (25, 16, 3.2), "D": (-1, 15, 2.2), "E": (12, 8, 5)}
NET = {
    "AQU": (42.354, 13.405, 710),
    "FIAM": (42.268, 13.117, 1070),
    "TERO": (42.623, 13.604, 673),
    "CAMP": (42.536, 13.409, 1283),
    "FAGN": (42.266, 13.584, 761),
    "INTR": (42.011, 13.904, 924),
}


def far(places: Mapping[str, Sequence[float]], target: Sequence[float]) -> np.ndarray:
    """Return the distances of a target from all stations, m."""
    return np.linalg.norm(np.array(list(places.values()), dtype=float) - np.asarray(target, dtype=float), axis=1)


def shot() -> Case:
    """Return arrivals of a shot at six microphones, in milliseconds."""
    heard = 100.0 + 1e3 * far(MICS, (31, 26)) / SOUND
    files = {
        "t.csv": table("station,toa_ms", [(name, f"{t:.2f}") for name, t in zip(MICS, heard, strict=True)]),
        "s.csv": table("name,x_m,y_m", [(name, *at) for name, at in MICS.items()]),
    }
    words = ("fix", "t.csv", "--stations", "s.csv", "--sigma", "0.1 ms", "--wave-speed", "air:20C")
    return Case("shot", files, words)


def hall() -> Case:
    """Return ranges of a tag to five anchors of a hall."""
    ranges = far(HALL, (7, 5, 1.2))
    files = {
        "t.csv": table("anchor,range_m", [(name, f"{r:.3f}") for name, r in zip(HALL, ranges, strict=True)]),
        "s.csv": table("name,x_m,y_m,z_m", [(name, *at) for name, at in HALL.items()]),
    }
    return Case("hall", files, ("fix", "t.csv", "--stations", "s.csv", "--sigma", "5 cm"))


def floor() -> Case:
    """Return ranges of a tag to five anchors that are given in a plane."""
    made = hall()
    flat = {name: at[:2] for name, at in HALL.items()}
    ranges = table("anchor,range_m", [(n, f"{r:.3f}") for n, r in zip(flat, far(flat, (7, 5)), strict=True)])
    files = {"t.csv": ranges, "s.csv": table("name,x_m,y_m", [(name, *at) for name, at in flat.items()])}
    return replace(made, name="floor", files=files)


def tag() -> Case:
    """Return ranges of a moving tag to the anchors of a hall, every half second."""
    rows = []
    for k in range(12):
        ranges = far(HALL, (3 + 0.5 * k, 4 + 0.3 * k, 1.2))
        rows += [(0.5 * k, name, f"{r:.3f}") for name, r in zip(HALL, ranges, strict=True)]
    files = {"t.csv": table("time_s,anchor,range_m", rows), "s.csv": hall().files["s.csv"]}
    return Case("tag", files, ("track", "t.csv", "--stations", "s.csv", "--sigma", "5 cm"))


def vehicle() -> Case:
    """Return two-way times of a vehicle and five transponders, in milliseconds."""
    places = {
        "T1": (0, 0, -61),
        "T2": (420, 30, -64),
        "T3": (390, 350, -58),
        "T4": (-40, 380, -60),
        "T5": (180, 170, -52),
    }
    there = 2e3 * far(places, (120, 140, -25)) / WATER + 15.0
    files = {
        "t.csv": table("station,tof_ms", [(name, f"{t:.3f}") for name, t in zip(places, there, strict=True)]),
        "s.csv": table("name,x_m,y_m,depth_m", [(name, at[0], at[1], -at[2]) for name, at in places.items()]),
    }
    words = ("fix", "t.csv", "--stations", "s.csv", "--as", "range", "--sigma", "0.2 ms")
    return Case("vehicle", files, (*words, "--wave-speed", "1481 m/s", "--two-way", "--turn-around", "15 ms"))


def quake() -> Case:
    """Return P and S picks of an earthquake, P at all stations and S at some."""
    lat, lon, depth = 42.332, 13.36, 8600.0
    rows = []
    for i, (name, (a, b, height)) in enumerate(NET.items()):
        north, east = 111.2e3 * (a - lat), 111.2e3 * np.cos(np.radians(lat)) * (b - lon)
        way = float(np.sqrt(north**2 + east**2 + (depth + height) ** 2))
        rows.append((name, "P", f"2026-04-06T01:32:{38.2 + way / 5600.0:06.3f}Z"))
        if i % 2 == 0:
            rows.append((name, "S", f"2026-04-06T01:32:{38.2 + way / 3200.0:06.3f}Z"))
    files = {
        "t.csv": table("station,phase,time", rows),
        "s.csv": table("station,latitude,longitude,elevation_m", [(name, *at) for name, at in NET.items()]),
    }
    words = ("fix", "t.csv", "--stations", "s.csv", "--vp", "5.6 km/s", "--vs", "3.2 km/s", "--sigma", "0.1 s")
    return Case("quake", files, words)


def crack() -> Case:
    """Return arrivals of a crack at six sensors on a plate, a column for each sensor, in microseconds."""
    places = {"S1": (20, 130), "S2": (470, 40), "S3": (460, 370), "S4": (40, 360), "S5": (220, 20), "S6": (240, 390)}
    hits = 1000.0 + far(places, (120, 150)) / 5.15
    files = {
        "t.csv": table("event," + ",".join(f"{name}_us" for name in places), [("one", *(f"{t:.1f}" for t in hits))]),
        "s.csv": table("name,x_mm,y_mm", [(name, *at) for name, at in places.items()]),
    }
    words = ("fix", "t.csv", "--stations", "s.csv", "--as", "arrivals", "--sigma", "0.4 us")
    return Case("crack", files, (*words, "--wave-speed", "5150 m/s"))


def bird() -> Case:
    """Return range differences of a bird at six recorders to the first recorder, in milliseconds."""
    delays = 1e3 * far(MICS, (20, 30)) / SOUND
    names = list(MICS)
    rows = [(name, names[0], f"{t - delays[0]:.3f}") for name, t in zip(names[1:], delays[1:], strict=True)]
    files = {"t.csv": table("station,reference,tdoa_ms", rows), "s.csv": shot().files["s.csv"]}
    words = ("fix", "t.csv", "--stations", "s.csv", "--positive", "a-farther", "--sigma", "0.2 ms")
    return Case("bird", files, (*words, "--wave-speed", "air:20C"))


NETWORK = """format = 2
propagation_speed = "343 m/s"
[stations]
dimension = 2
rows = [{ name = "A1" }, { name = "A2" }, { name = "A3" }, { name = "A4" }, { name = "A5" }, { name = "A6" },
  { name = "A7" }]
[[measurements]]
kind = "toa"
unit = "ms"
sigma = "0.1 ms"
file = "pulses.csv"
[[measurements]]
kind = "station_range"
sigma = "2 cm"
rows = [{ a = "A1", b = "A2", z = 40.0 }, { a = "A1", b = "A3", z = 38.4 }]
"""


def network(kind: str = "toa") -> Case:
    """Return a network of seven recorders at unknown positions that record twelve pulses."""
    rng = np.random.default_rng(5)
    stations = np.array([(0, 0), (40, 0), (12, 36.5), (45, 40), (20, 18), (-8, 25), (30, -12)], dtype=float)
    rows = []
    for k, at in enumerate(rng.uniform([-10, -15], [50, 45], (12, 2))):
        way = np.linalg.norm(stations - at, axis=1)
        for i, r in enumerate(way):
            rows.append((f"p{k}", f"A{i + 1}", f"{1e3 * r / 343.0 + 50.0 * (kind == 'toa') + rng.normal(0, 0.1):.3f}"))
    files = {"t.toml": NETWORK.replace('"toa"', f'"{kind}"'), "pulses.csv": table("epoch,a,z", rows)}
    return Case(f"network of {kind}", files, ("calibrate", "t.toml"))


GOOD: tuple[Callable[[], Case], ...] = (shot, hall, floor, tag, vehicle, quake, crack, bird, network)


def _scaled(case: Case, name: str, factor: float, file: str = "t.csv", column: int = -1) -> Case:
    """Return a case with the values of a column multiplied."""
    head, *rows = case.files[file].splitlines()
    cells = [row.split(",") for row in rows]
    for row in cells:
        row[column] = f"{factor * float(row[column]):.6g}"
    return replace(case, name=name, files={**case.files, file: table(head, cells)})


def _with_sigmas(text: str) -> str:
    """Return a table with a column sigma_m."""
    head, *rows = text.splitlines()
    return "\n".join([f"{head},sigma_m", *(f"{row},0.1" for row in rows)]) + "\n"


def _slant() -> str:
    """Return the ranges of a tag on the floor to anchors under a ceiling of 3 m."""
    ranges = far({name: (*at[:2], 3.0) for name, at in HALL.items()}, (7, 5, 0))
    return table("anchor,range_m", [(name, f"{r:.3f}") for name, r in zip(HALL, ranges, strict=True)])


def broken() -> list[Case]:
    """Return all cases with a mistake."""
    s, h, f, t, v, q, c, b, n = (make() for make in GOOD)
    out = [
        # microphones
        s.called("shot without a speed", without=["--wave-speed"]),
        s.called("shot without sigma", without=["--sigma"]),
        s.called("shot at the speed of water", "--wave-speed", "water:8C,35", without=["--wave-speed"]),
        s.called("water without salinity", "--wave-speed", "water:8C", without=["--wave-speed"]),
        s.called("air in kelvin", "--wave-speed", "air:293K", without=["--wave-speed"]),
        s.called("air too hot", "--wave-speed", "air:300C", without=["--wave-speed"]),
        s.called("humid frost", "--wave-speed", "air:-5C,50%", without=["--wave-speed"]),
        s.called("unknown medium", "--wave-speed", "steel:20C", without=["--wave-speed"]),
        s.called("speed without a number", "--wave-speed", "fast", without=["--wave-speed"]),
        s.called("negative speed", "--wave-speed=-343", without=["--wave-speed"]),
        s.called("speed of a wrong unit", "--wave-speed", "343 m", without=["--wave-speed"]),
        s.called("two deviations", "--wave-speed", "343+-5+-2", without=["--wave-speed"]),
        s.called("missing profile", "--wave-speed", "none.csv", without=["--wave-speed"]),
        s.called("wind without a direction", "--wind", "5 m/s"),
        s.called("wind faster than sound", "--wind", "500,0"),
        s.called("two-way arrivals", "--two-way"),
        s.called("vp for a shot", "--vp", "5 km/s"),
        s.called("seconds for milliseconds", "--unit", "s"),
        s.called("degrees for milliseconds", "--unit", "deg"),
        s.called("missing stations", "--stations", "x.csv", without=["--stations"]),
        s.called("no stations", without=["--stations"]),
        s.called("unknown column", "--column", "station=microphone"),
        s.called("column without a role", "--column", "microphone"),
        s.called("sigma in kilograms", "--sigma", "1 kg", without=["--sigma"]),
        s.called("negative sigma", "--sigma=-1 ms", without=["--sigma"]),
        s.called("height without heights", "--height", "3 m"),
        s.called("height of a wrong unit", "--height", "3 kg"),
        s.changed("unknown microphone", "Depot", "Depo"),
        s.changed("microphone without a value", "\nDepot,", "\nDepot,none\nX,"),
        s.changed("microphone twice", "School", "Depot"),
        s.changed("text for a time", "Depot,", "Depot,about "),
        s.changed("decimal comma", "toa_ms", "toa_ms,toa_s"),
        s.changed("missing coordinate", "Depot,0,0", "Depot,,0", file="s.csv"),
        s.changed("stations without coordinates", "x_m,y_m", "east,west", file="s.csv"),
        s.changed("feet read as metres", "x_m,y_m", "x_ft,y_ft", file="s.csv"),
        s.changed("one arrival late", "Mill,", "Mill,9"),
        _scaled(s, "times that count down", -1.0),
        _scaled(s, "times in microseconds", 1e3),
        # a hall
        _scaled(h, "ranges in centimetres", 100.0),
        _scaled(h, "ranges in kilometres", 1e-3),
        _scaled(h, "negative ranges", -1.0),
        h.changed("one negative range", "A,", "A,-"),
        h.changed("no reading as -1", "A,", "A,-1\nF,"),
        h.changed("header of millimetres", "range_m", "range_mm"),
        h.changed("header of seconds", "range_m", "range_s"),
        h.called("unit against the header", "--unit", "cm"),
        h.changed("missing height", "A,0,0,3", "A,0,0,", file="s.csv"),
        h.called("floors of text", "--height", "ground"),
        h.called("height too low", "--height=-40 m"),
        h.called("box of two numbers", "--box", "0,0"),
        h.called("two-way metres", "--two-way"),
        h.called("speed without times", "--wave-speed", "air:20C"),
        replace(h, name="sigma column beside sigma", files={**h.files, "t.csv": _with_sigmas(h.files["t.csv"])}),
        # slant ranges in a plane
        replace(f, name="slant ranges", files={**f.files, "t.csv": _slant()}),
        _scaled(f, "ranges of a plane in millimetres", 1e3),
        f.changed("anchors on a line", "24,1", "24,0", file="s.csv").changed("two anchors", "C,", "A,", file="s.csv"),
        # a track
        t.called("track without sigma", without=["--sigma"]),
        t.called("track of an unknown model", "--model", "bus"),
        _scaled(t, "track in centimetres", 100.0),
        t.changed("track with a negative range", "\n0.5,A,", "\n0.5,A,-"),
        t.changed("clock starts again", "\n4.0,", "\n0.0,").changed("clock starts again", "\n4.5,", "\n0.5,"),
        t.changed("track of an unknown anchor", "\n1.0,B,", "\n1.0,Q,"),
        t.called("track of arrivals", "--as", "arrivals"),
        # under water
        v.called("vehicle without a speed", without=["--wave-speed"]),
        v.called("vehicle one way", without=["--turn-around"]).called("vehicle one way"),
        v.called("turn-around too long", "--turn-around", "900 ms", without=["--turn-around"]),
        v.called("turn-around in metres", "--turn-around", "15 m", without=["--turn-around"]),
        v.called("fast water", "--wave-speed", "1600 m/s", without=["--wave-speed"]),
        v.changed("heights as depths", "depth_m", "z_m", file="s.csv"),
        # an earthquake
        q.called("quake without speeds", without=["--vp", "--vs"]),
        q.called("quake without vs", without=["--vs"]),
        q.called("vs above vp", "--vs", "9 km/s", without=["--vs"]),
        q.called("vp in metres", "--vp", "5.6 m", without=["--vp"]),
        q.called("wave speed of a quake", "--wave-speed", "5 km/s"),
        q.called("quake as S minus P", "--as", "sp"),
        q.changed("unknown phase", "AQU,P", "AQU,X"),
        q.changed("phase of another station", "FIAM,P", "ROMA,P"),
        q.changed("P alone", ",S,", ",P,"),
        q.changed("S before P", "AQU,P,2026-04-06T01:32", "AQU,P,2026-04-06T01:33"),
        q.changed("elevation in kilometres", "elevation_m", "elevation_km", file="s.csv"),
        q.changed("latitude beyond the pole", "42.354", "142.354", file="s.csv"),
        q.changed("no zone", "Z\n", "\n"),
        # a plate
        c.called("crack without a speed", without=["--wave-speed"]),
        c.called("crack in air", "--wave-speed", "air:20C", without=["--wave-speed"]),
        c.changed("column of an unknown sensor", "S6_us", "S9_us"),
        c.changed("units of two sensors", "S6_us", "S6_ms"),
        c.changed("plate in metres", "x_mm,y_mm", "x_m,y_m", file="s.csv"),
        # delays
        b.called("delays without a sign", without=["--positive"]),
        b.called("delays with the wrong sign", "--positive", "b-farther", without=["--positive"]),
        b.called("delays without a speed", without=["--wave-speed"]),
        b.called("unknown reference", "--reference", "Tower"),
        _scaled(b, "delays in samples", 44.1),
        b.changed("delay to itself", "School,Depot", "Depot,Depot"),
        # networks
        n.called("gauge of an unknown station", "--gauge", "A1,A2,A9"),
        n.called("network at the speed of light", "--wave-speed", "light"),
        n.called("network with an uncertain speed", "--wave-speed", "343+-5 m/s"),
        n.changed("network in microseconds", 'unit = "ms"', 'unit = "us"', file="t.toml"),
        n.changed("network in seconds", 'unit = "ms"', 'unit = "s"', file="t.toml"),
        n.changed("network without a speed", 'propagation_speed = "343 m/s"\n', "", file="t.toml"),
        n.changed("network without sigma", 'sigma = "0.1 ms"\n', "", file="t.toml"),
        n.changed("network of bearings", '"toa"', '"azimuth"', file="t.toml"),
        n.changed("pulse of an unknown recorder", "p3,A4", "p3,A44", file="pulses.csv"),
        n.changed("pulses without a column", "epoch,a,z", "pulse,a,z", file="pulses.csv"),
        replace(network("range"), name="negative ranges of a network").changed(
            "negative ranges of a network", "p3,A4,", "p3,A4,-", file="pulses.csv"
        ),
    ]
    # the other commands read the same tables
    out += [
        replace(one, name=f"{verb}: {one.name}", words=(verb, *one.words[1:]))
        for verb in ("convert", "check")
        for one in out
        if one.words[0] == "fix" and not {"--height", "--box"} & {*one.words}
    ][::3]
    return out

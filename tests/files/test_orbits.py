"""Satellites as stations: places and velocities from elements and SP3 files, and what broken files are told."""

import json
import random
import re
from importlib.util import module_from_spec, spec_from_file_location

import numpy as np
import pandas as pd
import pytest
from doc_pages import DOCS
from typer.testing import CliRunner

import optloc
from optloc import InvalidProblem
from optloc.base.frames import ECEF
from optloc.cli import app
from optloc.files import orbits, read
from optloc.files.convert import convert
from optloc.files.orbits import satellites

pytest.importorskip("skyfield", reason="satellites are an extra")

RUN = CliRunner()
ROTATION = 7.2921151467e-5


def line(text):
    """Return a line of elements with its check digit."""
    digits = sum(int(sign) if sign.isdigit() else sign == "-" for sign in text[:68])
    return f"{text[:68]}{digits % 10}"


def elements(name="LEO 1", number=90001, epoch="04097.00000000", inclination=86.39, motion=14.34216, eccentricity=2000):
    one = line(f"1 {number}U 97020B   {epoch}  .00000000  00000-0  00000-0 0  999")
    two = line(f"2 {number}  {inclination:7.4f} 100.0000 {eccentricity:07d}  90.0000 270.0000 {motion:11.8f} 1000")
    return f"{name}\n{one}\n{two}\n"


LEO, GNSS = elements(), elements("GNSS 7", 90002, inclination=55.0, motion=2.00563, eccentricity=10000)
DAY = np.datetime64("2004-04-06T07:51:28.386009", "ns")


def seconds(*values):
    return DAY + (1e9 * np.array(values)).astype("timedelta64[ns]")


@pytest.fixture
def tle(tmp_path):
    path = tmp_path / "two.tle"
    path.write_text(LEO + GNSS)
    return path


def omm(**changes):
    fields = {"OBJECT_NAME": "LEO 1", "OBJECT_ID": "1997-020B", "EPOCH": "2004-04-06T00:00:00", "MEAN_MOTION": 14.34216}
    fields |= {"ECCENTRICITY": 0.0002, "INCLINATION": 86.39, "RA_OF_ASC_NODE": 100.0, "ARG_OF_PERICENTER": 90.0}
    fields |= {"MEAN_ANOMALY": 270.0, "EPHEMERIS_TYPE": 0, "CLASSIFICATION_TYPE": "U", "NORAD_CAT_ID": 90001}
    fields |= {"ELEMENT_SET_NO": 999, "REV_AT_EPOCH": 1000, "BSTAR": 0, "MEAN_MOTION_DOT": 0, "MEAN_MOTION_DDOT": 0}
    return fields | changes


def sp3(tle, path, step, hours=8, clock="GPS", names=("LEO 1", "GNSS 7")):
    """Write the satellites of elements as an SP3 file, in the reading of its clock."""
    ahead = {"GPS": 13, "UTC": 0, "TAI": 32}[clock]  # of 2004
    utc = DAY.astype("datetime64[h]") + np.arange(0, 3600 * hours, step).astype("timedelta64[s]")
    places = satellites(tle, utc, names).position / 1e3
    text = ["#dP2004  4  6  7  0  0.00000000", f"%c M  cc {clock} ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc"]
    for k, date in enumerate((utc + np.timedelta64(ahead, "s")).tolist()):
        text += [f"*  {date.year} {date.month:2d} {date.day:2d} {date.hour:2d} {date.minute:2d} {date.second:11.8f}"]
        for name, place in zip(names, places[k], strict=True):
            text += [f"P{name[0]}0{name[-1]}" + "".join(f"{value:14.6f}" for value in place) + f"{999999.999999:14.6f}"]
    path.write_text("\n".join([*text, "EOF", ""]))
    return path


# Places and velocities against numbers from elsewhere.


def turned(position, velocity, ut1):
    """Return a state of TEME in the Earth's frame (without polar motion): Vallado et al. (2006), appendix C."""
    t = (ut1 - 2451545.0) / 36525.0
    sidereal = 67310.54841 + (876600.0 * 3600.0 + 8640184.812866) * t + 0.093104 * t**2 - 6.2e-6 * t**3
    angle = np.radians(sidereal % 86400.0 / 240.0)
    turn = np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    place = turn @ position
    return place, turn @ velocity - np.cross([0.0, 0.0, ROTATION], place)


def test_a_place_and_a_velocity_are_those_of_the_published_rotation(tle):
    from sgp4.api import Satrec

    # Vallado, Fundamentals of Astrodynamics, example 3-15: TEME and the Earth's frame before polar motion.
    ut1 = 2453101.5 + (7 * 3600 + 51 * 60 + 28.386009 - 0.4399619) / 86400.0
    teme = np.array([5094.18016210, 6127.64465950, 6380.34453270]), np.array([-4.746131487, 0.785818041, 5.531931288])
    place, rate = turned(*teme, ut1)
    np.testing.assert_allclose(place, [-1033.4750313, 7901.3055856, 6380.3445327], atol=2e-4)
    np.testing.assert_allclose(rate, [-3.225632747, -2.872442511, 5.531931288], atol=2e-7)
    found = satellites(tle, seconds(0.0), ["90001"])
    model = Satrec.twoline2rv(*LEO.splitlines()[1:])
    _, place, rate = model.sgp4(2453101.5, ut1 - 2453101.5 + 0.4399619 / 86400.0)
    place, rate = turned(1e3 * np.array(place), 1e3 * np.array(rate), ut1)
    # Polar motion, 0.36 seconds of arc that day, is 12 m at this radius; the Earth's own clock is 200 m off UTC.
    assert np.linalg.norm(found.position[0, 0] - place) < 20.0
    assert np.linalg.norm(found.velocity[0, 0] - rate) < 0.03


def test_velocities_are_rates_of_the_places(tle):
    found = satellites(tle, seconds(*np.arange(-2.0, 3.0)))
    assert found.names == ("LEO 1", "GNSS 7")
    p = found.position
    # the theory's velocities are not quite the derivatives of its places: 0.03 m/s
    np.testing.assert_allclose((p[0] - 8 * p[1] + 8 * p[3] - p[4]) / 12.0, found.velocity[2], atol=0.05)
    assert 6.9e6 < np.linalg.norm(p[2, 0]) < 7.3e6


def test_elements_mean_the_same_in_every_form(tle, tmp_path):
    forms = {"one.json": json.dumps(omm()), "many.json": json.dumps([omm(OBJECT_NAME="X", NORAD_CAT_ID=5), omm()])}
    forms["table.csv"] = pd.DataFrame([omm()]).to_csv(index=False)
    forms["bare.txt"] = LEO.partition("\n")[2]
    forms["zero.txt"] = "0 " + LEO.replace("\n", "\r\n")
    want = satellites(tle, seconds(0.0, 60.0), ["LEO 1"])
    for name, text in forms.items():
        (tmp_path / name).write_text(text)
        found = satellites(tmp_path / name, seconds(0.0, 60.0), ["90001"])
        # two lines state the epoch to 1e-8 days
        np.testing.assert_allclose(found.position, want.position, atol=10.0)
        np.testing.assert_allclose(found.velocity, want.velocity, atol=0.02)


def test_each_time_takes_the_elements_of_its_day(tle, tmp_path):
    later = LEO.replace("04097.0", "04099.0").splitlines()
    path = tmp_path / "days.tle"
    path.write_text(LEO + "\n".join([later[0], *(line(text) for text in later[1:])]) + "\n")
    assert read_names(path) == ["LEO 1"]
    near, far = satellites(path, seconds(0.0, 1.6 * 86400.0)).position
    np.testing.assert_allclose(near, satellites(tle, seconds(0.0), ["LEO 1"]).position[0], atol=1e-6)
    assert np.linalg.norm(far - satellites(tle, seconds(1.6 * 86400.0), ["LEO 1"]).position[0]) > 1e5


def read_names(path):
    return [*orbits.read_orbits(path).courses]


def test_pieces_that_share_a_name_have_their_numbers(tmp_path):
    path = tmp_path / "launch.tle"
    path.write_text(elements("OBJECT A") + elements("OBJECT A", 90003))
    assert read_names(path) == ["90001", "90003"]


def test_long_runs_are_turned_in_parts(tle, monkeypatch):
    whole = satellites(tle, seconds(*range(10)))
    monkeypatch.setattr(orbits, "_AT_ONCE", 3)
    np.testing.assert_allclose(satellites(tle, seconds(*range(10))).position, whole.position, atol=1e-6)


# SP3 files.


@pytest.mark.parametrize("clock", ["GPS", "UTC", "TAI"])
def test_places_between_those_of_an_sp3_file(clock, tle, tmp_path):
    path = sp3(tle, tmp_path / "igs.sp3", 900, clock=clock)
    times = seconds(*np.linspace(-3000.0, 20000.0, 40))
    found, want = satellites(path, times, ["G07"]), satellites(tle, times, ["GNSS 7"])
    assert np.abs(found.position - want.position).max() < 0.02
    assert np.abs(found.velocity - want.velocity).max() < 0.05


def test_places_of_a_low_satellite_need_small_steps(tle, tmp_path):
    times = seconds(0.0, 31.0, 100.0)
    found = satellites(sp3(tle, tmp_path / "fine.sp3", 60, hours=2), times, ["L01"])
    assert np.abs(found.position - satellites(tle, times, ["LEO 1"]).position).max() < 0.02
    with pytest.raises(
        InvalidProblem, match=r"coarse\.sp3, satellite L01: the positions are 900 s apart.*smaller steps"
    ):
        satellites(sp3(tle, tmp_path / "coarse.sp3", 900), times, ["L01"])


def test_gaps_and_ends_of_an_sp3_file_are_not_bridged(tle, tmp_path):
    path = sp3(tle, tmp_path / "igs.sp3", 900)
    with pytest.raises(InvalidProblem, match="before the first or after the last position; use the file of that day"):
        satellites(path, seconds(40000.0))
    lines = path.read_text().splitlines()
    hole = next(i for i, text in enumerate(lines) if text.startswith("*  2004  4  6 10")) + 2
    path.write_text("\n".join([*lines[:hole], re.sub(r"[1-9]", "0", lines[hole][:46]), *lines[hole + 1 :]]))
    with pytest.raises(InvalidProblem, match=r"positions are missing around 2004-04-06T\d\d"):
        satellites(path, seconds(8000.0), ["G07"])


# What is wrong is one sentence.

ONE, TWO = LEO.splitlines()[1:]
BROKEN = {
    "nothing": ("", "the file has no orbits"),
    "words": ("these are\nno elements\n", "the file has no orbits"),
    "check digit": (LEO.replace("100.0000", "101.0000"), r"b\.tle, line 2: the check digit at the end of a line"),
    "letters": (
        f"A\n{ONE}\n{line(TWO.replace('86.3900', 'xx.3900'))}",
        r"b\.tle, line 2: these are not valid elements",
    ),
    "cut": (f"A\n{ONE[:40]}\n{TWO}", r"b\.tle, line 2: these are not valid elements"),
    "two satellites": (f"A\n{ONE}\n{GNSS.splitlines()[2]}", r"b\.tle, line 2: these are not valid elements"),
    "a line is missing": (f"A\n{ONE}\nB\n", r"b\.tle, line 2: a first line of elements has no second line"),
    "the first is missing": (f"A\n{TWO}\n", r"b\.tle, line 2: a second line of elements has no first line"),
    "no motion": (elements(motion=0.0), r"b\.tle, line 2: these are not valid elements|cannot be computed"),
    "in the ground": (elements(motion=18.5), r"b\.tle, line 2: .*(not valid elements|cannot be computed)"),
    "other years": (elements(epoch="05097.00000000"), "are 36[456] days from 2004-04-06"),
    "bell": (LEO.replace("LEO 1", "LE\x07"), "control characters"),
    "xml": ("<?xml version='1.0'?><ndm/>", "elements in XML are not supported; save them as JSON"),
    "half a json": ('{"OBJECT_NAME": "A"', "line 1: this is not JSON"),
    "a list of numbers": ("[1, 2]", "message 1: this is not an orbit mean-elements message"),
    "a message without a number": ("[{}]", "message 1: the element NORAD_CAT_ID is missing"),
    "a message without motion": (
        json.dumps({"NORAD_CAT_ID": 3, "EPOCH": "2004-04-06T00:00:00"}),
        "element .* is missing",
    ),
    "a message of words": (json.dumps(omm(INCLINATION="steep")), "message 1: these are not valid elements"),
    "nested": (json.dumps(omm(INCLINATION=[1.0])), "message 1: these are not valid elements"),
    "another frame": (
        json.dumps(omm(REF_FRAME="ICRF")),
        "REF_FRAME is 'ICRF'; only elements with REF_FRAME = TEME are supported",
    ),
    "not an instant": (json.dumps(omm(EPOCH="yesterday")), "message 1: these are not valid elements"),
    "an old format": ("#x\n", r"line 1: this is not an SP3 file of version a to d"),
    "sp3 without places": ("#d\n*  2004 4 6 0 0 0.0\nEOF", "the file has no positions"),
    "sp3 with words": (
        "#d\n*  2004 4 6 0 0 0.0\nPG01" + 3 * "        a lot " + "\n",
        "line 3: 'a lot' is not a number",
    ),
    "sp3 without a date": ("#d\n*  2004 13 6 0 0 0.0\n", "line 2: this is not a date"),
    "sp3 at minute -5": ("#d\n*  2004 4 6 0 -5 0.0\n", "line 2: this is not a date"),
    "sp3 with few": ("#d\n*  2004 4 6 0 0 0.0\nPG01" + 3 * "  12345.000000" + "\n", "there are 1 positions"),
    "sp3 backwards": (2 * ("#d\n*  2004 4 6 0 0 0.0\nPG01" + 3 * "  12345.000000" + "\n"), "do not increase"),
}


@pytest.mark.parametrize(("text", "words"), BROKEN.values(), ids=BROKEN)
def test_a_broken_file_is_one_sentence(text, words, tmp_path):
    path = tmp_path / "b.tle"
    path.write_text(text)
    with pytest.raises(InvalidProblem, match=words) as found:
        satellites(path, seconds(0.0))
    assert "\n" not in str(found.value)


def test_files_with_a_few_other_signs_are_read_or_refused(tle, tmp_path):
    rng = random.Random(20)
    texts = [LEO, json.dumps([omm()]), pd.DataFrame([omm()]).to_csv(index=False)]
    texts.append(sp3(tle, tmp_path / "i.sp3", 900, hours=3, names=("GNSS 7",)).read_text())
    other, refused = ["", "9", "-", "e", "\n", "\x00", "1e999", " ", "_", "ä"], 0
    for i in range(400):
        signs = list(texts[i % 4])
        for _ in range(rng.randint(1, 4)):
            place = rng.randrange(len(signs))
            signs[place : place + rng.randint(0, 3)] = rng.choice(other)
        path = tmp_path / "m.tle"
        path.write_text("".join(signs))
        try:
            found = satellites(path, seconds(0.0, 600.0))
            assert np.isfinite(found.position).all()
        except InvalidProblem:
            refused += 1
    assert 100 < refused < 400


def test_names_and_times_that_do_not_fit(tle, tmp_path):
    with pytest.raises(InvalidProblem, match=r"two\.tle: there is no satellite 'LEO 2'; did you mean 'LEO 1'"):
        satellites(tle, seconds(0.0), ["LEO 2"])
    with pytest.raises(InvalidProblem, match="the elements of 'LEO 1' are 12514 days from 1970-01-01"):
        satellites(tle, [0.0, 1.0], ["LEO 1"])
    with pytest.raises(InvalidProblem, match="bytes of text"):
        satellites(tle, seconds(0.0), budget=optloc.files.Budget(text=10))


# The table of stations that a problem file names.

PASS = """time,a,z
2004-04-06T07:51:28.386009Z,LEO 1,1
2004-04-06T07:51:38.386009Z,LEO 1,2
2004-04-06T07:51:38.386009Z,GNSS 7,3
"""


def test_convert_writes_satellites_at_the_times_of_a_table(tle, tmp_path):
    (tmp_path / "pass.csv").write_text(PASS)
    (tmp_path / "ground.csv").write_text("name,lat,lon,height\nRoof,47.0,11.0,600\n")
    out = tmp_path / "stations.csv"
    more = ["--times", tmp_path / "pass.csv", "--column", "satellite=a", "--stations", tmp_path / "ground.csv"]
    told = RUN.invoke(app, [str(word) for word in ["convert", tle, *more, "--out", out]])
    assert told.exit_code == 0, told.output
    assert 'kind = "ecef"' in " ".join(told.output.split())
    table = pd.read_csv(out)
    assert table["name"].tolist() == ["GNSS 7", "LEO 1", "LEO 1", "Roof", "Roof"]
    (tmp_path / "p.toml").write_text(
        'format = 1\n[frame]\nkind = "ecef"\n[stations]\nfile = "stations.csv"\n[target]\nmotion = "static"\n'
        '[[measurements]]\nkind = "range"\nfile = "pass.csv"\nsigma = 1.0\n'
    )
    problem = read(tmp_path / "p.toml").problem
    names, want = problem.stations.names, satellites(tle, seconds(0.0, 10.0))
    leo, gnss, roof = (names.index(name) for name in ("LEO 1", "GNSS 7", "Roof"))
    np.testing.assert_allclose(problem.stations.position[:, leo], want.position[:, 0], atol=1e-6)
    np.testing.assert_allclose(problem.stations.velocity[1, gnss], want.velocity[1, 1], atol=1e-9)
    np.testing.assert_allclose(problem.stations.position[0, roof], ECEF.from_geodetic(*np.radians([47, 11]), 600.0))
    assert not problem.stations.velocity[:, roof].any()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"times": None}, "the times of the satellite positions are unknown; give the table"),
        ({"out": "p.toml"}, "satellites are moving stations, which are written as a CSV table"),
        ({"columns": {"satellite": "b"}}, "there is no column 'b' for the satellite"),
        ({"columns": {"satellite": "z"}}, "there is no satellite '1'"),
        ({"columns": {"time": "z"}}, "days from 1970-01-01"),
        ({"stations": "flat.csv"}, "stations have no z, which satellites need"),
    ],
)
def test_convert_of_satellites_says_what_it_lacks(options, words, tle, tmp_path):
    (tmp_path / "pass.csv").write_text(PASS)
    (tmp_path / "flat.csv").write_text("name,x,y\nRoof,47.0,11.0\n")
    given = {"times": "pass.csv", "out": "s.csv"} | options
    paths = {key: tmp_path / given.pop(key) for key in ("times", "out", "stations") if given.get(key)}
    given.pop("times", None)
    with pytest.raises(InvalidProblem, match=words):
        convert(tle, paths.pop("out"), **paths, **given)


def test_stations_that_move_without_velocities_are_no_stations_of_a_rate():
    place = np.array([[[0.0, 0.0], [5e3, 0.0]], [[100.0, 0.0], [5e3, 0.0]]])
    rows = optloc.measured("fdoa", np.zeros(2), a=0, b=1, epoch=[0, 1], sigma=1.0)
    options = {"times": [0.0, 1.0], "motions": [optloc.Motion()]}
    with pytest.raises(InvalidProblem, match=r"station 'S0' moves, but has no velocity for fdoa; give velocities"):
        optloc.assemble(place, rows, **options)
    optloc.assemble(place[:1], rows, **options | {"motions": [optloc.Motion(1)]})
    with pytest.raises(InvalidProblem, match="fdoa of a fixed target needs stations that move"):
        optloc.assemble(place[:1], rows, **options)
    optloc.assemble(optloc.station_array(place, velocity=np.zeros((2, 2, 2))), rows, **options)


def test_without_the_library_the_extra_is_named(tle, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "skyfield.api", None)
    orbits._library.cache_clear()
    with pytest.raises(InvalidProblem, match=r"need the library skyfield; pip install 'optloc\[satellites\]'"):
        satellites(tle, seconds(0.0))
    orbits._library.cache_clear()


# What the page says is left of physics.


def test_the_effects_of_the_page_have_the_sizes_of_their_formulas():
    spec = spec_from_file_location("generated", DOCS / "generated.py")
    generated = module_from_spec(spec)
    spec.loader.exec_module(generated)
    scene, effects = generated.Pass(), generated.effects()
    t, c, speed = scene.times, 299792458.0, np.sqrt(3.986004418e14 / 7158e3)
    place = generated.turned(scene.satellite(t), -ROTATION * t)
    # Sagnac: what the turning Earth carries the emitter while the signal is on its way
    twice = place[:, 1] * scene.emitter[0] - place[:, 0] * scene.emitter[1]
    up = effects["light time, from the ground up (Sagnac)"]
    np.testing.assert_allclose(up[1], ROTATION / c * twice, rtol=1e-3)
    # down: r r' / c, a rate of v^2 / c at all times on a straight course, and Sagnac's with the other sign
    down = effects["light time, from the satellite down"]
    half = scene.range(t + 0.5) ** 2 - scene.range(t - 0.5) ** 2
    np.testing.assert_allclose(down[1], -half / 2.0 / c - up[1], atol=2e-3)
    assert np.ptp(down[2]) < 0.1 * np.abs(down[2]).max()
    clock = effects["v²/2c² and gravity (clocks)"][2]
    assert (0.0 < clock).all()
    assert (clock < speed**2 / 2.0 / c).all()
    assert scene.moves(clock, known=False) < 1e-6
    # along the track the fix goes with the satellite, by as much less as the ground is lower
    along = effects["position of the satellite along its track, 1 km"]
    assert abs(scene.moves(along[2], known=False) - 1e3 * 6367.0 / 7158.0) < 20.0
    table = generated.doppler().splitlines()
    assert len(table) == 2 + len(effects)
    assert {line.count("|") for line in table} == {8}

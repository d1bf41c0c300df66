"""RINEX and Android: orbits against SciPy, real files against the truth and another program, and each other."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

from optloc.base.errors import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT as C
from optloc.cli.app import app
from optloc.files.broadcast import EARTH_RATE, Ephemeris, ionosphere, orbit, troposphere, turned
from optloc.files.pseudoranges import read_log, received
from optloc.files.rinex import WEEK, read_navigation, read_observations

HERE = Path(__file__).parent
OBSERVED, BROADCAST = HERE / "kamakura.rnx", HERE / "kamakura.nav"
# Of the same source: ECEF, metres; and at 12:00:00 GPS time of 2021-03-19 what its own program says of satellites:
# where they were, turned with the Earth, and the pseudorange free of clocks and atmosphere.
TRUTH = np.array([-3962108.673, 3381309.574, 3668678.638])
NOON = 1300190400.0
BY_ANOTHER = {
    "E01": ([12402245.937, 16340296.698, 21337964.980], 27210191.876),
    "E03": ([-19780722.030, -7520769.298, 20692588.456], 25530858.761),
    "E08": ([-28001699.125, 7649018.453, 5768389.467], 24367455.446),
}
RUN = CliRunner()


def run(*words, code=0):
    told = RUN.invoke(app, [str(word) for word in words])
    assert told.exit_code == code, told.output
    return told


def elements(**given):
    held = dict.fromkeys(Ephemeris._fields, np.zeros(1))
    return Ephemeris(**held | {name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in given.items()})


@pytest.mark.parametrize(("system", "gm"), [("G", 3.986005e14), ("E", 3.986004418e14)])
def test_an_orbit_without_perturbations_is_that_of_newton(system, gm):
    week, toe, e, a, i, node, arg = 2149 * WEEK, 2149 * WEEK + 7200.0, 0.08, 2.66e7, 0.96, 1.1, -2.0
    one = elements(
        m0=0.0, e=e, root_a=np.sqrt(a), i0=i, omega=arg, toe=toe, week=week, toc=toe,
        # nodes are counted in the Earth's axes of the beginning of the week
        omega0=node,
    )  # fmt: skip
    # perigee, in axes that do not turn
    turn = np.array([[np.cos(node), -np.sin(node), 0], [np.sin(node), np.cos(node), 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, np.cos(i), -np.sin(i)], [0, np.sin(i), np.cos(i)]])
    within = np.array([[np.cos(arg), -np.sin(arg)], [np.sin(arg), np.cos(arg)], [0, 0]])
    place = turn @ tilt @ within @ [a * (1 - e), 0.0]
    speed = turn @ tilt @ within @ [0.0, np.sqrt(gm / a * (1 + e) / (1 - e))]

    def newton(_, state):
        return np.concatenate([state[3:], -gm * state[:3] / np.linalg.norm(state[:3]) ** 3])

    for since in (600.0, 7200.0, -7200.0):
        done = solve_ivp(newton, (0.0, since), [*place, *speed], method="DOP853", rtol=1e-13, atol=1e-6)
        angle = EARTH_RATE * (toe + since - week)
        x, y, z = done.y[:3, -1]
        expected = [x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle), z]
        found, clock = orbit(one, system, np.array([toe + since]))
        assert found[0] == pytest.approx(expected, abs=1e-3)
        # relativity: - 2 r.v / c^2
        assert clock[0] == pytest.approx(-2.0 * done.y[:3, -1] @ done.y[3:, -1] / C**2, abs=1e-15)


def test_turning_with_the_earth_keeps_the_distance_to_its_axis_and_goes_west():
    place = np.array([[2.6e7, 0.0, 1e6]])
    later = turned(place, np.array([0.07]))
    assert later[0, 1] == pytest.approx(-2.6e7 * EARTH_RATE * 0.07, rel=1e-9)
    assert np.linalg.norm(later) == pytest.approx(np.linalg.norm(place), rel=1e-15)


def test_the_atmosphere_is_as_others_have_it():
    flat, high = np.array([0.7]), np.array([np.pi / 2])
    assert troposphere(flat, np.array([0.0]), high) == pytest.approx(2.4, abs=0.1)  # textbook: 2.3 m dry, 0.1 m wet
    low = troposphere(flat, np.array([0.0]), np.radians([10.0]))
    assert low == pytest.approx(troposphere(flat, np.array([0.0]), high) / np.sin(np.radians(10.0)))
    coefficients = np.array([3.82e-8, 1.49e-8, -1.79e-7, 0.0, 1.43e5, 0.0, -3.28e5, 1.13e5])
    # A. Farah, "Comparison of GPS ...", and the example that goes with many programs: 40 N, 100 W, 20 deg high, 210 deg
    found = ionosphere(
        coefficients, (np.radians([40.0]), np.radians([-100.0])), np.radians([210.0]), np.radians([20.0]),
        np.array([593100.0]),
    )  # fmt: skip
    assert found == pytest.approx(23.784, abs=0.01)
    night = ionosphere(coefficients, (flat, flat), flat, high, np.array([0.0]))
    assert night == pytest.approx(5e-9 * C, rel=0.02)


def test_satellites_of_a_real_file_are_where_another_program_has_them():
    found = received(OBSERVED, BROADCAST, "1 m", system="E", mask="0 deg")
    for name, (place, z) in BY_ANOTHER.items():
        k = int(np.flatnonzero((found.satellite == name) & (found.time == NOON))[0])
        assert found.place[k] == pytest.approx(place, abs=5e-3)
        assert found.z[k] == pytest.approx(z, abs=0.1)  # the atmosphere of another place, a metre aside


@pytest.mark.skipif("OPTLOC_DATA" not in os.environ, reason="without the data sets")
@pytest.mark.parametrize("system", ["G", "E", "J"])
def test_all_satellites_of_a_real_file_are_where_another_program_has_them(system):
    import pandas as pd

    rows = pd.read_csv(Path(os.environ["OPTLOC_DATA"]) / "gnss_static" / "measurements.csv")
    rows = rows[(rows.session == "K078") & rows.sat.str.startswith(system)].set_index(["t_gps_s", "sat"])
    found = received(OBSERVED, BROADCAST, "1 m", system=system, mask="0 deg")
    keys = [key for key in zip(found.time, found.satellite, strict=True) if key in rows.index]
    at = [k for k, key in enumerate(zip(found.time, found.satellite, strict=True)) if key in rows.index]
    other = rows.loc[keys]
    assert len(other) > 9
    assert np.abs(found.place[at] - other[["sat_x_m", "sat_y_m", "sat_z_m"]].to_numpy()).max() < 5e-3
    assert np.abs(found.z[at] - other.prc_l1_m.to_numpy()).max() < 0.1


def test_a_real_file_is_converted_and_fixed(tmp_path):
    words = (OBSERVED, "--navigation", BROADCAST, "--sigma", "1 m")
    fixes = json.loads(run("fix", *words, "--json").stdout)["fixes"]
    assert len(fixes) == 3
    for fix in fixes:
        assert fix["status"] == "ok"
        assert np.linalg.norm([fix["x"], fix["y"], fix["z"]] - TRUTH) < 5.0
    out = tmp_path / "gnss.toml"
    told = run("convert", *words, "--out", out)
    assert "of GPS, C1C" in told.output
    assert "without a healthy ephemeris" in " ".join(told.output.split())
    assert "below 25 deg" in " ".join(run("convert", *words, "--mask", "25 deg").output.split())
    again = json.loads(run("fix", out, "--json").stdout)["fixes"]
    assert [again[0][axis] for axis in "xyz"] == pytest.approx([fixes[0][axis] for axis in "xyz"], abs=1e-6)
    assert json.loads(run("check", *words, "--json").stdout)["epochs"] == 3


# The same in other formats.


def in_version_2(folder):
    """Return the real files of GPS in RINEX 2, whose lines are shorter and whose years have two digits."""
    seen, lines = read_observations(OBSERVED, "G"), []
    lines += [f"{'     2.11           OBSERVATION DATA    G (GPS)':<60}RINEX VERSION / TYPE"]
    lines += [f"{'     6    L1    C1    S1    P2    L2    S2':<60}# / TYPES OF OBSERV"]
    lines += [f"{'  2021     3    19    12     0    0.0000000     GPS':<60}TIME OF FIRST OBS", f"{'':60}END OF HEADER"]
    for time in np.unique(seen.time):
        rows = np.flatnonzero(seen.time == time)
        minute, names = int(time - NOON) // 60, "".join(seen.satellite[rows])
        lines += [f" 21  3 19 12 {minute:2d}  0.0000000  0 {len(rows):2d}{names[:36]}"]
        lines += [f"{'':32}{names[k : k + 36]}" for k in range(36, len(names), 36)]
        for row in rows:  # five on the first line: the second of them is C1
            lines += [f"{1.0:14.3f}  {seen.pseudorange[row]:14.3f} 7{1.0:14.3f}  {'':16}{2.0:14.3f}", f"{3.0:14.3f}"]
    (folder / "site0781.21o").write_text("\n".join(lines) + "\n")
    text = BROADCAST.read_text().splitlines()
    end = next(i for i, line in enumerate(text) if "END OF HEADER" in line)
    parts = {line[:4]: line for line in text[:end] if "IONOSPHERIC" in line}
    lines = [f"{'     2.11           N: GPS NAV DATA':<60}RINEX VERSION / TYPE"]
    for key, label in (("GPSA", "ION ALPHA"), ("GPSB", "ION BETA")):
        lines += [f"{'  ' + parts[key][5:53]:<60}{label}"]
    lines += [f"{'':60}END OF HEADER"]
    for i in range(end + 1, len(text), 8):
        if text[i][0] == "G":
            number, numbers = text[i][1:3], text[i][23:80]
            year, *rest = text[i][4:23].split()
            stamp = f"{int(year) % 100:02d} " + " ".join(f"{int(v):2d}" for v in rest[:4]) + f"{float(rest[4]):5.1f}"
            lines += [f"{int(number):2d} {stamp}{numbers}", *(line[1:] for line in text[i + 1 : i + 8])]
    (folder / "site0781.21n").write_text("\n".join(lines) + "\n")
    return folder / "site0781.21o", folder / "site0781.21n"


def test_version_2_says_the_same(tmp_path):
    observed, broadcast = in_version_2(tmp_path)
    old, new = (received(*pair, "1 m") for pair in ((observed, broadcast), (OBSERVED, BROADCAST)))
    assert old.satellite.tolist() == new.satellite.tolist()
    assert np.array_equal(old.time, new.time)
    assert np.allclose(old.place, new.place, atol=1e-6)
    assert np.allclose(old.z, new.z, atol=1e-6)
    found = json.loads(run("fix", observed, "--navigation", broadcast, "--sigma", "1 m", "--json").stdout)
    assert [fix["status"] for fix in found["fixes"]] == ["ok"] * 3


HEAD = (
    "Raw,utcTimeMillis,TimeNanos,LeapSecond,FullBiasNanos,BiasNanos,Svid,TimeOffsetNanos,State,ReceivedSvTimeNanos,"
    "ReceivedSvTimeUncertaintyNanos,CarrierFrequencyHz,ConstellationType,HardwareClockDiscontinuityCount"
)


def log(folder, name="log.txt", **changed):
    """Return the real pseudoranges of GPS as a phone writes them, by a clock that is 0.2 ms late."""
    seen, lines = read_observations(OBSERVED, "G"), ["# ", "# Header Description:", f"# {HEAD}", "# "]
    for time, satellite, way in zip(seen.time, seen.satellite, seen.pseudorange, strict=True):
        since = round((time - NOON) * 1e9) + 5_000_000_000
        bias = -(round(NOON) * 10**9 - 5_000_000_000)
        sent = (since - bias) % round(WEEK * 1e9) - round(way / C * 1e9)
        row = {
            "utc": 0, "TimeNanos": since, "LeapSecond": 18, "FullBiasNanos": bias, "BiasNanos": 0.0,
            "Svid": int(satellite[1:]), "TimeOffsetNanos": 0.0, "State": 9, "ReceivedSvTimeNanos": sent,
            "Uncertainty": 20, "CarrierFrequencyHz": 1575420030.0, "ConstellationType": 1, "Count": 0,
        } | changed  # fmt: skip
        lines.append("Raw," + ",".join(str(cell) for cell in row.values()))
    # signals of another frequency and system, and one whose time is not known
    lines += [lines[-1].replace("1575420030.0", "1176450000.0"), lines[-1].replace(",9,", ",1,")]
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


def test_raw_times_of_a_phone_say_the_same(tmp_path):
    path, seen = log(tmp_path), read_observations(OBSERVED, "G")
    found = read_log(path, "G")
    assert found.satellite.tolist() == seen.satellite.tolist()
    assert np.abs(found.pseudorange - seen.pseudorange).max() < 0.2  # half a nanosecond
    fixes = json.loads(run("fix", path, "--navigation", BROADCAST, "--sigma", "2 m", "--json").stdout)["fixes"]
    assert [fix["status"] for fix in fixes] == ["ok"] * 3
    assert all(np.linalg.norm([fix[axis] for axis in "xyz"] - TRUTH) < 6.0 for fix in fixes)


# What is wrong is one sentence.


def broken(folder):
    text, nav = OBSERVED.read_text(), BROADCAST.read_text()

    def file(name, content):
        (folder / name).write_text(content)
        return folder / name

    good = ("--navigation", BROADCAST, "--sigma", "1 m")
    squeezed = f"{'1.0 COMPACT RINEX FORMAT':<60}CRINEX VERS / RINEX VERSION"
    stateless = log(folder, "x.txt").read_text().replace("State", "Stat")
    lines = text.splitlines()
    row = next(i for i, line in enumerate(lines) if line.startswith("G0"))
    wrong = "\n".join([*lines[:row], lines[row][:6] + "x" + lines[row][7:], *lines[row + 1 :]])
    short = nav.replace("END OF HEADER", "XXX OF HEADER")
    return {
        "no navigation": ((OBSERVED, "--sigma", "1 m"), "--navigation"),
        "no sigma": ((OBSERVED, "--navigation", BROADCAST), "--sigma"),
        "no such navigation": ((OBSERVED, "--navigation", folder / "none.nav", "--sigma", "1 m"), "none.nav"),
        "swapped": ((OBSERVED, "--navigation", OBSERVED, "--sigma", "1 m"), "holds no ephemerides"),
        "navigation first": ((file("nav.rnx", nav), *good), "holds no ranges"),
        "no header": ((OBSERVED, "--navigation", file("a.nav", short), "--sigma", "1 m"), "no end"),
        "cut short": ((OBSERVED, "--navigation", file("b.nav", nav[:-900]), "--sigma", "1 m"), "b.nav"),
        "a letter": ((file("c.rnx", wrong), *good), f"line {row + 1}"),
        "an epoch cut short": ((file("d.rnx", text[:-300]), *good), "ends within a record"),
        "version 4": ((file("e.rnx", text.replace("3.04", "4.00", 1)), *good), "RINEX 4"),
        "compressed": ((file("f.rnx", squeezed), *good), "crx2rnx"),
        "GLONASS time": ((file("g.rnx", text.replace("     GPS     ", "     GLO     ")), *good), "GLO"),
        "a system that is none": ((OBSERVED, *good, "--system", "Q"), "--system"),
        "a mask that is none": ((OBSERVED, *good, "--mask", "high"), "--mask"),
        "too high a mask": ((OBSERVED, *good, "--mask", "89 deg"), "--mask"),
        "another day": ((file("h.rnx", text.replace("> 2021 03 19", "> 2021 04 19")), *good), "of that day"),
        "a log without rows": ((file("log.txt", f"# \n# Header Description:\n# {HEAD}\n"), *good), "begin with Raw"),
        "a log without a column": ((file("log2.txt", stateless), *good), "no GPS signal"),
        "a log with a word": ((log(folder, "log3.txt", ReceivedSvTimeNanos="soon"), *good), "ReceivedSvTimeNanos"),
        "a log of another day": ((log(folder, "log4.txt", FullBiasNanos=-(10**18)), *good), "log4.txt"),
    }  # fmt: skip


def test_what_is_wrong_is_one_short_sentence(tmp_path):
    for name, (words, expected) in broken(tmp_path).items():
        told = run("fix", *words, code=2).stderr
        assert expected in told, (name, told)
        assert "Traceback" not in told
        assert len(told) < 260, (name, told)


def test_the_reader_names_what_a_file_lacks():
    with pytest.raises(InvalidProblem, match="holds no ephemerides"):
        read_navigation(OBSERVED)
    known = read_navigation(BROADCAST)
    assert known.ionosphere.tolist()[0] == pytest.approx(1.118e-8)
    assert len(known.ephemerides) > 20

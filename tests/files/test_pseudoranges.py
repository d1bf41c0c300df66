"""RINEX and Android: real files against the truth and another program, and each other."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc.base.units import SPEED_OF_LIGHT as C
from optloc.cli.application import app
from optloc.files.pseudoranges import read_log, received
from optloc.files.rinex import WEEK, read_observations

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
        "swapped": ((OBSERVED, "--navigation", OBSERVED, "--sigma", "1 m"), "has no ephemerides"),
        "navigation first": ((file("nav.rnx", nav), *good), "has no ranges"),
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

"""Tables of readings of known targets: the rows that optloc reads, and where it places the targets.

`fuzz.tables` draws the tables, `fuzz.reading` reads them a second time with pandas, and `fuzz.tried` compares both with
what the commands make of them. A refusal in one sentence is no fault; a wrong number is.
"""

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from fuzz import reading, tried
from fuzz.surfaces import foreign
from fuzz.tables import Row, made
from fuzz.test_fuzz import parts

import optloc
from optloc.files import read

HERE = Path(__file__).parent
# Of a seed, of which there are ten in full: 2 000 tables in parts of some minutes.
PARTS, PART = 2, 100
# In every run: a table a shape. Rows of more tables are compared without optloc, which takes 5 ms a table.
NUMBERS, READ = (1, 7, 17), 40


@pytest.mark.parametrize("number", NUMBERS)
def test_a_table_is_read_with_its_numbers_and_fixed_at_its_targets(number, seed, tmp_path):
    table = made(seed, number)
    said = tried.tried(table, tmp_path)
    assert said.partition(":")[0] in ("same", "same fix", "refused"), f"{table.name}: {said}"


def written(table, folder):
    """Write the files of a table and return the rows that pandas reads."""
    folder.mkdir(exist_ok=True)
    for name, data in table.files.items():
        (folder / name).write_bytes(data)
    return reading.rows_of(folder, table.arguments)


def values(rows):
    """Return the values of each kind in order, azimuths as cosines; arrivals have no common origin and are left out."""
    found = {kind: [] for kind in {row.kind for row in rows}}
    for row in rows:
        found[row.kind] += [] if row.kind == "toa" else [math.cos(row.z) if row.kind == "azimuth" else row.z]
    return {kind: sorted(z) for kind, z in found.items()}


def test_the_second_reading_finds_what_was_written(seed, tmp_path):
    """The oracle is right: rows of pandas are the rows that the tables were drawn with."""
    for number in range(READ):
        table = made(seed, number)
        own = written(table, tmp_path / str(number))
        assert len(own) == len(table.rows), table.name
        expected, found = values(table.rows), values(own)
        assert expected.keys() == found.keys(), table.name
        for kind, z in expected.items():
            assert found[kind] == pytest.approx(z, rel=1e-9, abs=1e-9), f"{kind} of {table.name}"
        sigma = sorted(row.sigma for row in own)
        assert sigma == pytest.approx(sorted(row.sigma for row in table.rows), rel=1e-12), table.name


@cache
def plain_ranges():
    """Return a table of ranges that nothing misleads about, with rows enough to change one."""
    tables = (made(0, number) for number in range(500))
    return next(one for one in tables if one.about[:2] == ("range", "plain") and len(one.rows) > 8)


@pytest.mark.parametrize("change", ["value", "sigma", "place", "fewer", "kind", "epoch"])
def test_the_oracle_sees_what_is_wrong(change, tmp_path):
    table = plain_ranges()
    own = written(table, tmp_path)
    assert tried.ran("convert", *inside(table, tmp_path), "--out", str(tmp_path / "p.toml"))[0] == 0
    loaded = read(tmp_path / "p.toml")
    assert not tried.differences(own, loaded)
    first = own[3]
    other = {
        "value": [replace(first, z=first.z * (1.0 + 1e-11))],
        "sigma": [replace(first, sigma=first.sigma * 1.001)],
        "place": [replace(first, a=tuple(v + 1e-3 for v in first.a))],
        "fewer": [],
        "kind": [replace(first, kind="toa")],
        "epoch": [replace(first, epoch="none")],
    }[change]
    assert tried.differences([*own[:3], *other, *own[4:]], loaded)


def inside(table, folder):
    """Return the arguments of a table whose files are in a folder."""
    return [str(folder / word) if word in table.files else word for word in table.arguments]


def test_the_oracle_sees_a_fix_that_is_elsewhere():
    """A fix with status ok that is off by more than five standard deviations is wrong, whatever its rows are."""
    table = made(0, 1)
    rows = [Row("range", 1.0, (0.0, 0.0), None, 1.0, None, None)]
    table = replace(table, rows=rows, truth={(None, None): (1.0, 2.0)}, exact=True)
    fix = {
        "status": "ok",
        "x": 1.0,
        "y": 2.0,
        "sigma_x": 0.1,
        "sigma_y": 0.1,
        "epoch": "1",
        "time": None,
        "target": "t",
    }
    assert tried.of_fixes(table, {"fixes": [fix]}) == "same fix"
    assert tried.of_fixes(table, {"fixes": [fix | {"y": 2.6}]}).startswith("wrong")
    assert tried.of_fixes(table, {"fixes": [fix | {"y": 2.6, "status": "ambiguous"}]}) == "same"


def test_a_table_is_the_same_each_time():
    assert made(3, 14) == made(3, 14)


# Words with two meanings: the unit, the options or the cells decide; what they leave open is refused.

ANCHORS = "name,x_m,y_m\n" + "".join(
    f"{n},{x},{y}\n" for n, x, y in (("A", 0, 0), ("B", 9, 1), ("C", 8, 7), ("D", 1, 8))
)
SKY = {"N": (47.90, 11.20, 310.5), "W": (47.80, 11.05, 120.0), "S": (47.72, 11.25, 620.25)}


def sight(height, angle):
    """Return angles from three places on Earth; `height` and `angle` are the names of two columns."""
    rows = [(n, *at, 180.0 + 20.0 * i, 1.5 + 0.25 * i) for i, (n, at) in enumerate(SKY.items())]
    lines = [f"{n},{lat},{lon},{h},{way},{up}" for n, lat, lon, h, way, up in rows]
    return f"observer,lat,lon,{height},bearing_deg,{angle}\n" + "\n".join(lines) + "\n"


NAMED = {
    "angle and height of one word": (sight("elevation_m", "elevation_deg"), ["--sigma", "0.1 deg"]),
    "altitudes of both sorts": (sight("altitude_m", "altitude_deg"), ["--sigma", "0.1 deg"]),
    "a time beside pseudoranges": (
        "time_s,anchor,pseudorange_m\n" + "".join(f"100.0,{n},{5000.5 + i}\n" for i, n in enumerate("ABCD")),
        ["--stations", "anchors.csv", "--sigma", "10 cm"],
    ),
    "a time beside levels": (
        "time_s,station,reference,rss_difference_dB\n"
        + "".join(f"7.5,{n},A,{0.5 * i}\n" for i, n in enumerate("BCD", 1)),
        ["--stations", "anchors.csv", "--sigma", "1 dB"],
    ),
    "stations called like the columns": (
        "a,b,tdoa_ns\nB,A,3.5\nC,A,4.25\nD,A,-2.5\n",
        ["--stations", "anchors.csv", "--sigma", "0.3 ns", "--positive", "a-farther"],
    ),
    "an arrival that the user names": (
        "anchor,first_m\nA,105.5\nB,103.25\nC,101.0\nD,104.5\n",
        ["--stations", "anchors.csv", "--sigma", "10 cm", "--as", "arrivals", "--column", "toa=first_m"],
    ),
    "a deviation of each row": (
        "time_s,anchor,range_m,std_cm\n" + "".join(f"3.0,{n},{5.5 + i},{10 + i}\n" for i, n in enumerate("ABCD")),
        ["--stations", "anchors.csv"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMED)
def test_words_of_two_meanings_are_read_by_unit_or_refused(name, tmp_path, monkeypatch):
    text, options = NAMED[name]
    (tmp_path / "anchors.csv").write_text(ANCHORS)
    (tmp_path / "t.csv").write_text(text.replace("observer", "station"))
    monkeypatch.chdir(tmp_path)
    code, _, err, fault = tried.ran("convert", "t.csv", *options, "--out", "p.toml")
    assert not fault
    own = reading.rows_of(tmp_path, ("t.csv", *options))
    assert len(own) == len({row.kind for row in own}) * (text.count("\n") - 1)
    if code == 2:
        assert err.count("\n") == 1
    else:
        assert not tried.differences(own, read(tmp_path / "p.toml"))


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["fix", "check", "track"])
def test_sparse_tables_and_tables_of_other_programs_end_in_an_answer(verb, tmp_path, monkeypatch):
    """No table of them is damaged, so none ends in a traceback or a warning, whichever epochs lack readings."""
    monkeypatch.chdir(tmp_path)
    for name, (held, options) in foreign().items():
        for file, data in held.items():
            Path(file).write_bytes(data)
        _, _, _, fault = tried.ran(verb, next(iter(held)), *options, "--json")
        assert not fault, f"{verb} {name}: {fault}"


@pytest.mark.full
@pytest.mark.parametrize("part", range(PARTS))
def test_tables_in_full(part, seed, pytestconfig):
    """No number is wrong; at least half of the tables are read. Parts are stored as those of mutated files are."""
    known, store = parts(pytestconfig, seed, f"tables {part}")
    if known is None:
        given = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(Path(optloc.__file__).parents[1])])}
        given |= {"OPENBLAS_NUM_THREADS": "1", "NO_COLOR": "1"}
        command = [sys.executable, "-m", "fuzz.tried", str(seed), str(part * PART), str(PART)]
        known = json.loads(subprocess.run(command, env=given, capture_output=True, text=True, check=True).stdout)
    store(known)
    assert not known["faults"], "\n".join(known["faults"])
    counts = known["counts"]
    assert counts.get("same", 0) + counts.get("same fix", 0) >= PART / 2, counts

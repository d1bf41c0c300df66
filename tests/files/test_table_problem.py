"""A table as a problem: the files that it writes hold the problem that it reads."""

from pathlib import Path

import numpy as np

from optloc.files import read
from optloc.files.roles import ColumnPlaces
from optloc.files.table_problem import Section, TableProblem, no_sigma

PLACES = {
    "name": np.array(["A", "B", "C"], dtype=object),
    "x": np.array([0.0, 9.0, 0.0]),
    "y": np.array([0.0, 0.0, 9.0]),
}
ROWS = {"a": np.array(["A", "B", "C"], dtype=object), "z": np.array([5.0, 6.0, 7.0])}


def made(source):
    section = Section("range", ROWS, "km", "10 m", "ranges")
    return TableProblem(
        source, (section,), ColumnPlaces(PLACES, "cartesian", "km"), (("range", "3 readings"),), ("a note",)
    )


def test_what_is_written_is_what_is_read(tmp_path):
    problem = made(Path('a "quoted" name.csv'))
    files = problem.write(tmp_path / "out.toml")
    assert [path.name for path in files] == ["out.toml", "out-stations.csv", "out-rows.csv"]
    direct, written = problem.read(), read(files[0])
    assert direct.title == written.title == 'a "quoted" name'
    for loaded in (direct, written):
        assert loaded.problem.z.tolist() == [5000.0, 6000.0, 7000.0]
        assert np.array_equal(loaded.problem.stations.position[0], 1000.0 * np.stack([PLACES["x"], PLACES["y"]], -1))
    assert direct.table == {
        "understood": [["range", "3 readings"]],
        "notes": ["a note"],
        "columns": {},
        "unit": "km",
    }


def test_a_table_without_sigma_is_told_how_to_say_it():
    error = no_sigma("2 deg", "azimuth")
    assert "azimuth" in error.what
    assert "--sigma '2 deg'" in error.advice


def test_errors_name_an_option_or_the_table_and_no_file_that_is_not_written():
    problem = made(Path("t.csv"))
    names = ["t-stations.csv", "t-rows.csv"]
    places = {
        "t.toml, [[measurements]] 1, key 'sigma'": "--sigma",
        "t.toml, key 'wind'": "--wind",
        "t.toml, [[measurements]] 1": "t.csv",
        "t-rows.csv, row 3": "t.csv",
        "t-stations.csv, row 1": "stations of t.csv, row 1",
        "--height, key 'exactly'": "--height, key 'exactly'",
    }
    assert {place: problem._place(place, "t.toml", names) for place in places} == places

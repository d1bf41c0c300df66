"""Columns of station names and reference stations that are found as the only choice, and questions for several.

The recorders and delays are rebuilt from a public problem, with numbers only: opensoundscape (kitzeslab/opensoundscape,
tests/csvs/LOCA_2021_aru_coords.csv and tests/test_localization.py).
"""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.files.convert import convert, interpret_table
from optloc.files.lone_columns import names_stations, text_columns, without_difference
from optloc.files.table import of_rows
from optloc.files.table_import import ColumnHints
from optloc.files.wave_speed import WaveOptions

FILES = [f"LOCA_2021_09_24_652_{number}.wav" for number in range(3, 9)]
POLES, HEIGHTS = ("17.129,8.878", "0.0,0.0", "0.771,19.147"), ((14.392, 2.9), (15.092, 3.6), (14.392, 2.9))
PLACES = [f"{pole},{z}" for pole, heights in zip(POLES, HEIGHTS, strict=True) for z in heights]
DELAYS = [0.0325, -0.002, 0.0316, -0.0086, 0.024]


def text_of(head, rows):
    """Return a CSV text."""
    return "\n".join([head, *rows]) + "\n"


RECORDERS = text_of("file,x,y,z", [f"{name},{place}" for name, place in zip(FILES, PLACES, strict=True)])
TIMES = text_of("file,tdoa_s", [f"{name},{delay}" for name, delay in zip(FILES[1:], DELAYS, strict=True)])
STATED = {"columns": {"name": "file", "station": "file"}, "reference": FILES[0]}


def table_of(folder, stations, rows, **options):
    """Return the problem of two tables of text."""
    (folder / "s.csv").write_text(stations)
    (folder / "rows.csv").write_text(rows)
    options = {"wave": WaveOptions("air:20C"), "sigma": "2 ms", **options}
    return interpret_table(folder / "rows.csv", ColumnHints(stations=folder / "s.csv", **options))


def with_column(text, name, cells):
    """Return a CSV text with one more column."""
    lines = text.splitlines()
    return text_of(f"{lines[0]},{name}", [f"{line},{cell}" for line, cell in zip(lines[1:], cells, strict=True)])


def test_recorders_and_delays_need_no_column_and_no_reference(tmp_path):
    found = table_of(tmp_path, RECORDERS, TIMES)
    stated = table_of(tmp_path, RECORDERS, TIMES, **STATED)
    problem, same = found.read().problem, stated.read().problem
    assert problem.stations.names == same.stations.names == tuple(FILES)
    assert problem.z.tolist() == same.z.tolist()
    assert [*found.sections[0].columns["b"]] == [FILES[0]] * 5
    assert found.notes[:3] == (
        "the column 'file' has the station of each row; --column station=NAME states another",
        "the column 'file' of s.csv has the station names; --column name=NAME states another",
        f"the reference is {FILES[0]}, the only station without a difference; --reference states another",
    )
    assert not any("column" in note or "reference" in note for note in stated.notes)


def test_the_names_of_stations_are_noted_beside_the_assumed_heights(tmp_path):
    flat = text_of("file,lat,lon", [f"{name},47.{i},8.{i * i}" for i, name in enumerate(FILES)])
    notes = " ".join(table_of(tmp_path, flat, TIMES).notes)
    assert "no heights are given" in notes
    assert "column 'file' of s.csv" in notes


QUESTIONS = {
    "two columns of names": (with_column(RECORDERS, "pole", "abcdef"), TIMES, {}, "no column looks like the name"),
    "two columns of stations": (
        RECORDERS,
        with_column(TIMES, "heard", FILES[1:]),
        {},
        "no column looks like the station",
    ),
    "two stations without a difference": (
        RECORDERS,
        text_of("file,tdoa_s", TIMES.splitlines()[1:-1]),
        {},
        "no column looks like the second station",
    ),
    "a zero and a missing station": (
        RECORDERS,
        text_of("file,tdoa_s", [f"{FILES[0]},0", *TIMES.splitlines()[1:-1]]),
        {},
        "no column looks like the second station",
    ),
    "no station without a difference": (
        RECORDERS,
        TIMES + f"{FILES[0]},0.01\n",
        {},
        "no column looks like the second station",
    ),
    "numbers as names": (
        RECORDERS.replace("file", "name").replace("LOCA_2021_09_24_652_", "").replace(".wav", ""),
        TIMES.replace("LOCA_2021_09_24_652_", "").replace(".wav", ""),
        {},
        "no column looks like the station",
    ),
    "a stated reference is used": (RECORDERS, TIMES, {"reference": FILES[1]}, "names station"),
    "a zero ratio": (
        RECORDERS,
        text_of("file,rss_difference_db", [f"{FILES[0]},0", *TIMES.splitlines()[1:]]),
        {"sigma": "2 dB", "wave": WaveOptions()},
        "no column looks like the second station",
    ),
}


@pytest.mark.parametrize("case", QUESTIONS)
def test_several_choices_are_a_question(case, tmp_path):
    stations, rows, options, words = QUESTIONS[case]
    with pytest.raises(InvalidProblem, match=words):
        table_of(tmp_path, stations, rows, **options)


def test_zeros_of_the_reference_itself_show_that_it_is_the_reference(tmp_path):
    problem = table_of(tmp_path, RECORDERS, TIMES + f"{FILES[0]},0\n").read().problem
    assert problem.z.tolist() == table_of(tmp_path, RECORDERS, TIMES).read().problem.z.tolist()


def test_a_known_word_precedes_the_cells(tmp_path):
    stations = with_column(RECORDERS, "station", "ABCDEF")
    rows = with_column(TIMES, "station", "BCDEF")
    assert table_of(tmp_path, stations, rows).read().problem.stations.names == tuple("ABCDEF")


def test_options_decide_between_two_columns(tmp_path):
    stations, rows = with_column(RECORDERS, "pole", "abcdef"), with_column(TIMES, "heard", FILES[1:])
    found = table_of(tmp_path, stations, rows, columns=STATED["columns"])
    assert found.read().problem.z.tolist() == table_of(tmp_path, RECORDERS, TIMES).read().problem.z.tolist()


def test_a_table_of_stations_alone_has_its_names_by_their_cells(tmp_path):
    (tmp_path / "s.csv").write_text(RECORDERS)
    found = convert(tmp_path / "s.csv", tmp_path / "out.csv", ColumnHints(what="stations"))
    assert FILES[0] in (tmp_path / "out.csv").read_text()
    assert "column 'file'" in found.notes[0]


def test_text_is_neither_a_number_nor_a_date_nor_empty():
    cells = {"text": "a", "number": "1e3", "date": "2021-09-24T06:52:00Z", "empty": " ", "float": 1.5, "list": [1]}
    rows = [cells, {**cells, "text": "b"}]
    table = of_rows(rows, "t.csv", {})
    assert text_columns(table, ()) == ["text"]
    assert names_stations(table, ()) == "text"
    assert names_stations(table, ("text",)) is None
    assert names_stations(of_rows(rows[:1], "t.csv", {}), ()) is None


def test_the_only_station_without_a_difference():
    a = np.array(["B", "C", "A"], dtype=object)
    assert without_difference("ABC", a, np.array([True, True, False])) == "A"
    assert without_difference("ABC", a, np.array([True, False, False])) is None
    assert without_difference("ABC", a, np.ones(3, bool)) is None

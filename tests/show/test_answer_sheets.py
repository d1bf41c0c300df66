"""Tables of an answer: the names of the user, first and last rows, counts, and alternatives on Earth."""

import numpy as np
import pytest
from show.answers import batch, singles, states
from show.ranging import ranged

from optloc.base.records import join
from optloc.show.answer_sheets import (
    MOST_ROWS,
    alternative_sheet,
    bias_sheet,
    count_sheet,
    state_sheet,
    status_words,
    suspect_sheet,
)
from optloc.show.columns import fix_columns
from optloc.show.describe_fix import answer_of


def test_a_long_table_has_the_labels_of_its_first_and_last_rows():
    sheet = state_sheet(fix_columns(batch()), "Fixes")
    assert sheet.head == ("fix", "latitude", "longitude", "height, m", "sigma east, north, m", "status")
    names = [row[0] for row in sheet.rows]
    half = MOST_ROWS // 2
    assert names == [
        *(f"event {i}" for i in range(half)),
        "... 5 more",
        *(f"event {i}" for i in range(25 - half, 25)),
    ]
    assert sheet.rows[0][1:] == ("-", "-", "-", "-", "unbounded")
    _, fix = ranged()
    single = {label: text for name in ("where", "how sure") for label, text in answer_of(fix).section(name).rows}
    assert f"{sheet.rows[1][1]} deg" == single["latitude"]
    assert f"{sheet.rows[1][4]} m" == single["sigma east, north"]
    assert sheet.rows[1][-1] == "ok"


def test_a_table_of_any_length_is_whole_if_it_is_short_enough():
    assert len(state_sheet(fix_columns(batch()), "", 25).rows) == 25


def test_targets_and_plain_coordinates_are_named():
    assert state_sheet(fix_columns(states()), "").head[0] == "target"
    plain = fix_columns(join([singles()["ok in a plain frame"].flat()] * 2, 2))
    sheet = state_sheet(plain, "")
    assert sheet.head == ("fix", "x, m", "y, m", "status")
    assert [row[0] for row in sheet.rows] == ["0", "1"]
    single = dict(answer_of(singles()["ok in a plain frame"]).section("where").rows)
    assert [f"{cell} m" for cell in sheet.rows[0][1:3]] == [single["x"], single["y"]]


def test_a_table_that_is_too_wide_has_the_sigmas_in_one_column(monkeypatch):
    monkeypatch.setattr("optloc.show.answer_sheets._WIDEST", 20)
    fix = singles()["ok in a plain frame"]
    sheet = state_sheet(fix_columns(fix), "")
    assert sheet.head == ("x, m", "y, m", "sigma x, y, m", "status")
    single = {label: text for name in ("where", "how sure") for label, text in answer_of(fix).section(name).rows}
    assert single["x"].startswith(f"{sheet.rows[0][0]} ± ")
    assert f"{sheet.rows[0][2]} m" == single["sigma x, y"]


def test_many_fixes_are_counted_by_status():
    _, fix = ranged()
    columns = fix_columns(join([fix.flat()] * 3, 3))
    sheet = count_sheet(columns)
    assert [row[:2] for row in sheet.rows] == [("ok", "3")]
    # Three equal fixes: the median is each of them.
    assert sheet.rows[0][2] == f"{np.sqrt(np.trace(fix.covariance())):.3g}"
    assert status_words(columns, ["a note"]) == "3 fixes: all ok; a note"
    assert status_words(fix_columns(batch()), []) == "25 fixes: 20 ok, 5 unbounded"


@pytest.mark.parametrize(
    ("name", "head"),
    [("on Earth", "latitude, longitude, height in m"), ("in a plain frame", "position, m")],
)
def test_alternatives_have_the_coordinates_of_the_frame(name, head):
    sheet = alternative_sheet(singles()[f"ambiguous {name}"])
    assert sheet is not None
    assert sheet.head[1] == head
    assert alternative_sheet(singles()[f"ok {name}"]) is None


def test_a_fix_without_biases_and_suspects_has_no_tables_of_them():
    _, fix = ranged()
    assert bias_sheet(fix) is None
    assert suspect_sheet(fix) is None

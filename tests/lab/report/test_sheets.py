"""Tables of reports: short numbers, LaTeX, and counts of rows that were made by hand."""

import numpy as np
import pytest
from lab.study.rows import hand_made

from optloc.lab.report.sheets import best_first, certificates, duration, latex, number, percent, sheets, statuses
from optloc.lab.study.summary import cells
from optloc.show.sheet import TextTable


@pytest.fixture(scope="module")
def frame():
    return hand_made()


def test_numbers_are_short_and_honest():
    assert [number(v) for v in (1.0, 0.123456, 1234.5, 2.5e-7, 123456.0, 0.0, np.nan)] == [
        "1.00", "0.123", "1234", "2.50·10⁻⁷", "1.23·10⁵", "0", "–"
    ]  # fmt: skip
    assert [duration(v) for v in (2.0, 1.5e-3, 3e-6, 4e-10, np.nan)] == [
        "2.00 s",
        "1.50 ms",
        "3.00 µs",
        "0.400 ns",
        "–",
    ]
    assert [percent(v) for v in (1.0, 0.99999, 0.5, 0.0001, 0.0)] == ["100", "> 99.9", "50.0", "< 0.1", "0"]


def test_latex_escapes_and_has_all_columns():
    table = TextTable("t", "A & B", ("method", "time"), (("a_b <c>", "2·10⁻⁷ s"), ("50 %", "3 µs")), "≤ 5 %")
    text = latex(table)
    assert r"a\_b \ensuremath{<}c\ensuremath{>} & 2\ensuremath{\cdot}10\ensuremath{^{-7}} s \\" in text
    assert r"50 \% & 3 \ensuremath{\mu}s \\" in text
    assert r"\begin{longtable}{lr}" in text
    assert text.count(r"\begin") == text.count(r"\end{longtable}") == 1
    text.encode("ascii")


def test_the_ranking_counts_right_and_wrong_answers(frame):
    table = best_first(frame, ["a", "b"]).frame.set_index("method")
    assert table.loc["a", ["trials", "answered", "right", "wrong", "false"]].tolist() == [4, 3, 2, 1, 1]
    assert table.loc["b", ["trials", "answered", "right", "wrong", "false"]].tolist() == [4, 4, 2, 1, 1]
    assert (table["right_low"] < 0.5).all()
    assert (table["right_high"] > 0.5).all()


def test_statuses_and_certificates_count_what_was_claimed(frame):
    counts = statuses(frame).frame.set_index(["method", "status"])
    assert counts["trials"].loc["b"].to_dict() == {"ok": 3, "ambiguous": 1}
    proofs = certificates(frame, ["a", "b"]).frame.set_index("method")
    assert proofs["proven_global"].tolist() == [2, 1]
    assert proofs["false"].tolist() == [1, 1]


def test_every_table_has_as_many_cells_as_columns(frame):
    found = list(sheets(frame, frame, cells(frame), ["a", "b"], None))
    names = "ranking success statuses accuracy certificates timing machine"
    assert [sheet.shown.name for sheet in found] == names.split()
    for sheet in found:
        assert {len(row) for row in sheet.shown.rows} == {len(sheet.shown.header)}

"""The description of an answer: its order, its tables, and whether to use a fix of each status."""

import pytest

from optloc.base.types import Status
from optloc.model_checks.cause import Advice
from optloc.show.fix_answer import SECTIONS, AnswerSection, FixAnswer, FixSheet, advice_lines, verdict_of

SHEET = FixSheet("Fixes", ("fix", "status"), [("a", "ok")])


def test_the_order_of_the_sections():
    assert SECTIONS == ("use", "where", "how sure", "why not", "details")


def test_rows_of_sections_are_one_table_until_a_section_has_tables():
    sections = (
        AnswerSection("use", (("status", "ok"), ("", "Use it."))),
        AnswerSection("where", (("x", "1 m"),), (SHEET,)),
        AnswerSection("why not", (("reason", "none"),)),
        AnswerSection("details", (("stages", "lsr"),), (SHEET,)),
    )
    answer = FixAnswer("title", "good", sections)
    first, table, last = answer.main
    assert (first.title, first.ends, first.rows[0]) == ("title", (1, 2), ("status", "ok"))
    assert table is SHEET
    assert (last.title, list(last.rows)) == ("", [("reason", "none")])
    assert [sheet.title for sheet in answer.details] == ["Details", "Fixes"]
    assert answer.labels == ("status", "x", "reason", "stages")
    assert answer.section("how sure").rows == ()


@pytest.mark.parametrize(
    ("status", "verdict"),
    [
        (Status.OK, "good"),
        (Status.CURVED, "care"),
        (Status.AMBIGUOUS, "care"),
        (Status.MISFIT, "bad"),
        (Status.TOO_FEW_ROWS, "bad"),
    ],
)
def test_a_verdict_says_what_the_sentence_of_the_status_says(status, verdict):
    assert verdict_of(status) == verdict


def test_advice_has_its_lines_to_copy():
    lines = advice_lines([Advice("cause", "a row is far off", "leave it out", "[rows]\nx = 1")])
    assert lines == ["Advice", "  A row is far off.", "  Leave it out:", "      [rows]", "      x = 1"]
    assert advice_lines([]) == []

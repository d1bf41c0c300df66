"""Tables of pages: cells by name, numbers in them, and the same as Markdown."""

import math

from optloc.show.sheet import ABSENT, TextTable

TABLE = TextTable("t", "T", ("case", "method", "rms"), (("a", "gtrs", "1.5e-3 ± 2"), ("b", "gtrs", ABSENT)), "A note.")


def test_a_cell_is_named_by_its_row_and_column():
    assert TABLE.cell("a", "gtrs", "rms") == "1.5e-3 ± 2"
    assert TABLE.cell("a", "lsr", "rms") == ABSENT
    assert TABLE.cell("a", "gtrs", "mean") == ABSENT


def test_numbers_of_a_cell_are_read_in_order():
    assert (TABLE.value("a", "rms"), TABLE.value("a", "rms", part=1)) == (1.5e-3, 2.0)
    assert math.isnan(TABLE.value("b", "rms"))


def test_markdown_has_a_line_for_each_row_and_the_note():
    lines = TABLE.markdown().splitlines()
    assert lines[:2] == ["| case | method | rms |", "| --- | ---: | ---: |"]
    assert len(lines) == 6
    assert lines[-1] == "A note."

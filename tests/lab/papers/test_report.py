"""The pages of the papers: filled from their tables alone, and the committed ones are what their tables give.

``OPTLOC_WRITE_DOCS=1 pytest tests/lab/papers/test_report.py`` writes the committed pages from the tables beside them.
"""

import csv
import os
from importlib import import_module
from math import nan
from pathlib import Path

import pytest

from optloc.lab.papers import PAPERS
from optloc.lab.papers.report import digits, render, typeset
from optloc.show.sheet import ABSENT, TextTable

DOCS = Path(__file__).parents[3] / "docs" / "papers"
# The size in which the committed page of each paper was drawn.
SIZE = {"angles": "quick", "bistatic": "quick", "kinematic": "quick", "registration": "full", "satellites": "quick"}


def committed(name):
    found = {}
    for path in sorted((DOCS / name).glob("*.csv")):
        with path.open(encoding="utf-8", newline="") as file:
            header, *rows = (tuple(row) for row in csv.reader(file))
        found[path.stem] = TextTable(path.stem, "", header, tuple(rows))
    return found


def sample_of(name):
    return import_module(f"optloc.lab.papers.{PAPERS[name].module}").STUDY.sizes[SIZE[name]]


@pytest.mark.parametrize("name", PAPERS)
def test_a_committed_page_is_its_tables_and_every_cell_that_it_names_is_there(name, monkeypatch):
    page, cell, missing = DOCS / name / "README.md", TextTable.cell, []

    def watch(self, *place):
        found = cell(self, *place)
        if found == ABSENT:
            missing.append((self.name, *place))
        return found

    monkeypatch.setattr(TextTable, "cell", watch)
    made = page.read_text(encoding="utf-8").splitlines()[2].split(", seed")[0]
    fresh = render(name, committed(name), made=made, seed=1, sample=sample_of(name))
    assert missing == []
    if os.environ.get("OPTLOC_WRITE_DOCS"):
        page.write_text(fresh, encoding="utf-8")
    assert page.read_text(encoding="utf-8") == fresh


@pytest.mark.parametrize("name", PAPERS)
def test_a_page_shows_each_table_and_each_picture_once(name):
    page = (DOCS / name / "README.md").read_text(encoding="utf-8")
    for table in committed(name).values():
        assert page.count(table.markdown()) == 1
    for path in (DOCS / name).glob("*.png"):
        assert page.count(f"({path.name})") == 1


def test_prose_follows_the_tables():
    tables = committed("bistatic")
    slow = tables["slow"]
    rows = tuple((*row[:2], "0.300", *row[3:]) if row[0] == "line fit" else row for row in slow.rows)
    changed = {**tables, "slow": TextTable("slow", "", slow.header, rows)}
    page = render("bistatic", changed, made="", seed=1, sample=sample_of("bistatic"))
    assert "the line fit is 4.0 times better than the recursion, 0.300 km" in " ".join(page.split())


def test_titles_and_notes_are_those_of_the_page():
    report = typeset("bistatic", sample_of("bistatic"), 7, tuple(committed("bistatic").values()), {"slow": None})
    claims = next(table for table in report.tables if table.name == "claims")
    assert claims.title == "Claims for 10 epochs"
    assert claims.note.endswith("1 degree over the root of 10 is 0.0055 rad.")
    assert [(picture.name, picture.title) for picture in report.pictures] == [("slow", "Slow target")]
    assert "seed 7, 1000 trials" in report.markdown()


def test_cells_are_named_by_their_row_and_column():
    table = TextTable("t", "", ("a", "b", "c"), (("1", "x", "< 2.5 m"), ("1", "y", "3e-05 (4.1)")))
    assert table.cell("1", "x", "c") == "< 2.5 m"
    assert table.value("1", "x", "c") == 2.5
    assert (table.value("1", "y", "c"), table.value("1", "y", "c", part=1)) == (3e-5, 4.1)
    assert (table.cell("2", "c"), table.cell("1", "d")) == (ABSENT, ABSENT)
    assert digits(table.value("2", "c")) == ABSENT


@pytest.mark.parametrize(
    ("number", "count", "text"),
    [(40.2826, 3, "40.3"), (20.98, 1, "20"), (0.0, 3, "0"), (0.00123, 2, "0.0012"), (9.96, 2, "10"), (nan, 3, "–")],
)
def test_significant_digits(number, count, text):
    assert digits(number, count) == text

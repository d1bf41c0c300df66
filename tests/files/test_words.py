"""Columns of text as words and numbers: the same as lists of cells, however they are made."""

import subprocess
import sys
from importlib.resources import files as package_files

import numpy as np

from optloc.files import words
from optloc.files.words import Words, distinct, equal_rows, numbered, objects, words_of

CELLS = ["b", "a", "b", "c", "a", "b"]


def test_words_are_the_column_that_they_were_made_of():
    found = words_of(objects(CELLS))
    assert found.tolist() == list(found) == np.asarray(found).tolist() == CELLS
    assert isinstance(found[3], str)
    assert (found[3], found[1:3].tolist()) == ("c", ["a", "b"])
    assert (found == objects(CELLS)).all()


def test_renamed_cells_that_are_equal_are_joined():
    found = words_of(objects(CELLS)).renamed(["x", "y", "x"])
    assert found.tolist() == [{"b": "x", "a": "y", "c": "x"}[cell] for cell in CELLS]
    assert found.cells.tolist() == ["x", "y"]


def test_numbers_follow_the_appearance_and_distinct_the_alphabet():
    names, index = numbered(objects(CELLS))
    assert (names, [names[i] for i in index]) == (["b", "a", "c"], CELLS)
    expected = np.unique(CELLS, return_index=True, return_inverse=True)
    for found, wanted in zip(distinct(objects(CELLS)), expected, strict=True):
        assert list(found) == wanted.tolist()


def test_long_columns_and_other_cells_are_numbered_alike(monkeypatch):
    few = numbered(objects(CELLS))
    monkeypatch.setattr(words, "_FEW", 0)
    many = numbered(objects(CELLS))
    assert few[0] == many[0]
    assert few[1].tolist() == many[1].tolist()
    assert numbered(objects(["a", None, "a"]))[0] == ["a", None]


def test_short_tables_of_a_file_need_no_table_library():
    code = (
        "import sys; from optloc.files import load; load(sys.argv[1]); print({'pandas', 'pyarrow'} & set(sys.modules))"
    )
    demo = package_files("optloc") / "scenarios" / "demo.toml"
    done = subprocess.run([sys.executable, "-c", code, str(demo)], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_rows_are_equal_where_all_their_columns_are():
    numbers = np.array([1.0, 1.0, 1.0, 2.0, 1.0, 2.0])
    first, index = equal_rows([words_of(objects(CELLS)), numbers], len(CELLS))
    groups = [(CELLS[i], numbers[i]) for i in first]
    assert len(set(groups)) == len(groups) == 4
    assert [groups[i] for i in index] == list(zip(CELLS, numbers, strict=True))
    assert isinstance(words_of(objects(CELLS)), Words)

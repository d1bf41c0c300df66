"""Columns of text as words and numbers: the same as lists of cells, however they are made."""

import numpy as np

from optloc.files.words import Words, distinct, equal_rows, numbered, objects, words_of

CELLS = ["b", "a", "b", "c", "a", "b"]


def test_words_are_the_column_that_they_were_made_of():
    words = words_of(objects(CELLS))
    assert words.tolist() == list(words) == np.asarray(words).tolist() == CELLS
    assert isinstance(words[3], str)
    assert (words[3], words[1:3].tolist()) == ("c", ["a", "b"])
    assert (words == objects(CELLS)).all()


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


def test_rows_are_equal_where_all_their_columns_are():
    numbers = np.array([1.0, 1.0, 1.0, 2.0, 1.0, 2.0])
    first, index = equal_rows([words_of(objects(CELLS)), numbers], len(CELLS))
    groups = [(CELLS[i], numbers[i]) for i in first]
    assert len(set(groups)) == len(groups) == 4
    assert [groups[i] for i in index] == list(zip(CELLS, numbers, strict=True))
    assert isinstance(words_of(objects(CELLS)), Words)

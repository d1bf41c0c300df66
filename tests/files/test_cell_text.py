"""Columns of numbers with all their digits, against Python's decimals; columns of words, against lists."""

from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from optloc.files.cell_text import Decimals, date_texts, numbers
from optloc.files.table import Table
from optloc.files.words import Words, distinct, equal_rows, numbered, words_of

TEXTS = st.decimals(allow_nan=False, allow_infinity=False, min_value=-(10**14), max_value=10**14, places=9)


@settings(max_examples=40)
@given(st.lists(st.one_of(TEXTS.map(str), st.sampled_from([" 7 ", "1.50", "-.5", "5.", "2.5E+9", "1e-7"])), min_size=1))
def test_numbers_keep_their_digits(texts):
    column = np.array(texts, dtype=object)
    held = numbers(Table("t", {"z": column}, len(column)), "z")
    wanted = [Decimal(text.strip()) for text in texts]
    assert held.values.tolist() == wanted
    assert [value.as_tuple().exponent for value in held.values.tolist()] == [v.as_tuple().exponent for v in wanted]
    assert held.values.floats().tolist() == [float(value) for value in wanted]
    first = np.zeros(1, dtype=int)
    since = held.values.since(first, np.zeros(len(texts), dtype=int))
    assert since.tolist() == [value - wanted[0] for value in wanted]


def test_numbers_of_many_digits_and_empty_cells():
    texts = ["1716500000.123456789012345678", "", "NaN", "1716500000.5", None]
    held = numbers(Table("t", {"z": np.array(texts, dtype=object)}, 5), "z")
    assert held.row.tolist() == [0, 3]
    assert held.values.texts() == [texts[0], texts[3]]
    assert float(held.values.since(np.array([1]), np.zeros(2, dtype=int))[0]) == -0.376543210987654322


def test_decimals_of_several_columns():
    both = Decimals.join([Decimals.of([Decimal("1.5")]), Decimals.of([Decimal("2.25"), Decimal("1E+3")])])
    assert both.texts() == ["1.5", "2.25", "1000"]
    assert both.number(Decimal("0.125")) is None


@settings(max_examples=40)
@given(st.lists(st.sampled_from(["b", "a", "c", None]), min_size=1), st.data())
def test_words_are_lists_of_few_words(cells, data):
    words = words_of(np.array(cells, dtype=object))
    assert words.tolist() == list(words) == np.asarray(words).tolist() == cells
    pick = np.array(data.draw(st.lists(st.integers(0, len(cells) - 1), min_size=1)))
    part = words[pick]
    assert isinstance(part, Words)
    assert numbered(part)[0] == list(dict.fromkeys(part.tolist()))
    first, group = equal_rows([part, words_of(np.array([str(c) for c in part], dtype=object))], len(pick))
    assert first.tolist() == sorted(first.tolist())
    assert part[first][group].tolist() == part.tolist()
    assert words.renamed(["x"] * len(words.cells)).cells.tolist() == ["x"]


def test_distinct_is_unique():
    labels = np.array(["b", "a", "b", "c"], dtype=object)
    names, first, index = distinct(words_of(labels))
    wanted = np.unique(labels.astype(str), return_index=True, return_inverse=True)
    assert (names, first.tolist(), index.tolist()) == tuple(part.tolist() for part in wanted)


@pytest.mark.parametrize(
    ("seconds", "texts"),
    [
        ([0.0, 1772366400.0], ["1970-01-01T00:00:00Z", "2026-03-01T12:00:00Z"]),
        ([1772366400.25, 1772366401.0], ["2026-03-01T12:00:00.250Z", "2026-03-01T12:00:01.000Z"]),
        ([-0.000001], ["1969-12-31T23:59:59.999999Z"]),
    ],
)
def test_times_become_dates_with_the_fewest_decimals(seconds, texts):
    assert date_texts(np.array(seconds)).tolist() == texts


def test_whole_numbers_keep_their_digits_and_their_limits():
    values = [1790000000000014221, 0, -5, 2**63 - 1]
    found = numbers(Table("t", {"z": np.array(values)}, len(values)), "z")
    assert [int(value) for value in found.values.tolist()] == values
    assert found.row.tolist() == [0, 1, 2, 3]
    assert not found.values.written.any()

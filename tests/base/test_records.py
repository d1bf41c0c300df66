"""Records of arrays: entries are taken, replaced and joined in all arrays at once."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from optloc.base.records import Axes, change, join, overwrite, present, take
from optloc.base.types import Array


@dataclass(frozen=True, slots=True)
class Part:
    cost: Annotated[Array, Axes(0)]


@dataclass(frozen=True, slots=True)
class Whole:
    x: Annotated[Array, Axes(1)]
    rivals: Annotated[Array | None, Axes(2, slots=True)] = None
    code: Annotated[Array | None, Axes(0, empty=-1)] = None
    part: Part | None = None
    name: str = ""


def whole(first, count, slots, name="", **more):
    x = np.arange(first, first + count)[:, None] + np.array([0.0, 0.5])
    return Whole(x, np.repeat(x[:, None], slots, axis=1), name=name, **more)


def test_entries_are_taken_of_all_arrays_and_of_the_records_within():
    found = take(whole(0, 3, 2, part=Part(np.array([7.0, 8.0, 9.0]))), np.array([2, 0]))
    assert found.x.tolist() == [[2.0, 2.5], [0.0, 0.5]]
    assert found.rivals[:, 1].tolist() == found.x.tolist()
    assert found.part.cost.tolist() == [9.0, 7.0]
    assert found.code is None


def test_a_change_knows_how_many_axes_follow_the_batch():
    found = change(whole(0, 6, 2), lambda array, core: array.reshape(2, 3, *array.shape[array.ndim - core :]))
    assert found.x.shape == (2, 3, 2)
    assert found.rivals.shape == (2, 3, 2, 2)


def test_joined_records_have_as_many_slots_as_the_widest_and_empty_entries_elsewhere():
    parts = [whole(0, 2, 1, "first"), whole(2, 1, 3, "second", code=np.array([4]), part=Part(np.array([1.5])))]
    found = join(parts, 3)
    assert found.x[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert np.isfinite(found.rivals[..., 0]).tolist() == [[True, False, False]] * 2 + [[True] * 3]
    assert found.code.tolist() == [-1, -1, 4]
    assert np.array_equal(found.part.cost, [np.nan, np.nan, 1.5], equal_nan=True)
    assert found.name == "first"


def test_an_array_that_all_entries_share_stays_one_row():
    shared, other = np.broadcast_to(np.array([1.0, 2.0]), (3, 2)), np.array([[1.0, 3.0]])
    assert join([Whole(shared), Whole(shared)], 6).x.strides[0] == 0
    mixed = join([Whole(shared), Whole(other)], 4).x
    assert mixed.tolist() == [[1.0, 2.0]] * 3 + [[1.0, 3.0]]


def test_entries_are_replaced_and_the_record_itself_stays_as_it_was():
    record = whole(0, 3, 2, code=np.array([1, 2, 3]))
    found = overwrite(record, np.array([1]), whole(9, 1, 3))
    assert found.x[:, 0].tolist() == [0.0, 9.0, 2.0]
    assert np.isnan(found.rivals[0, 2]).all()
    assert found.rivals[1, 2].tolist() == [9.0, 9.5]
    assert found.code.tolist() == [1, -1, 3]
    assert record.x[1, 0] == 1.0


def test_present_entries_are_those_that_are_not_none():
    assert present(np.array([None, 0, "", None], dtype=object)).tolist() == [False, True, True, False]

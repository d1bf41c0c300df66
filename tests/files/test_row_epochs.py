"""Epochs of rows: labels, exact times and windows."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.files.row_epochs import Keys, epochs_of, need_clock


def keys(label=None, time=None, target=None):
    text = [None if given is None else np.array(given, dtype=object) for given in (label, target)]
    time = None if time is None else np.array(time)
    return Keys(text[0], time, None if time is None else time.astype(str).astype(object), text[1])


def test_labels_that_are_numbers_go_by_size_and_others_as_they_appear():
    assert epochs_of(keys(["10", "2", "10"]), 3, None, None).labels == ("2", "10")
    assert epochs_of(keys(["b", "a"]), 2, None, None).labels == ("b", "a")


def test_a_window_joins_rows_by_time():
    found = epochs_of(keys(time=[0.0, 0.4, 1.2, 2.9]), 4, 1.0, None)
    assert found.index.tolist() == [0, 0, 1, 2]
    assert found.times == pytest.approx([0.2, 1.2, 2.9])
    assert found.clock is found.times


def test_free_targets_have_epochs_of_their_own():
    both = keys(["1", "1", "2"], target=["a", "b", "a"])
    free, bound = epochs_of(both, 3, None, True), epochs_of(both, 3, None, False)
    assert (free.count, free.targets, free.own) == (3, ("a", "b", "a"), True)
    assert (bound.count, bound.targets, bound.target.tolist()) == (2, ("a", "b"), [0, 1, 0])


def test_a_clock_needs_times_that_increase():
    assert need_clock(epochs_of(keys(time=[3.0, 5.0]), 2, None, None), "motion", "x").tolist() == [3.0, 5.0]
    with pytest.raises(InvalidProblem, match="needs the time"):
        need_clock(epochs_of(keys(["a", "b"]), 2, None, None), "motion", "x")

"""Options and names of `optloc separate`: numbers of emitters, regions, and rows in words."""

import numpy as np
import pytest

from optloc import InvalidProblem, assemble, measured
from optloc.cli.options import shipped_problems
from optloc.cli.separate import _count, _names, _region
from optloc.files import read


def test_a_number_of_emitters_is_at_most_that_of_rows():
    assert _count("auto", 5) is None
    assert _count("5", 5) == 5
    for text in ("6", "-1", "two", "1.0", "9" * 20, "\u0663"):
        with pytest.raises(InvalidProblem, match="not a number of emitters"):
            _count(text, 5)


def test_a_region_is_two_corners():
    problem = assemble(np.eye(2) * 100.0, measured("range", a=[0, 1], sigma=1.0))
    assert _region(problem, None) is None
    lower, upper = _region(problem, "0,1:2,3")
    assert (lower.tolist(), upper.tolist()) == ([0.0, 1.0], [2.0, 3.0])
    for text, words in (("0,1", "not a region"), ("0,1,2:3,4,5", "3 coordinates do not fit 2")):
        with pytest.raises(InvalidProblem, match=words):
            _region(problem, text)


def test_rows_are_named_by_kind_stations_and_number():
    loaded = read(shipped_problems()["demo"])
    block, names = loaded.problem.rows[0], loaded.problem.stations.names
    (text,) = _names(loaded, [1])
    assert text == f"{block.kind} {names[block.a[1]]} - {names[block.b[1]]} (row 1)"

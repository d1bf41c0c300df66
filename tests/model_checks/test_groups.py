"""What may be wrong together: names, rows and prices."""

import numpy as np
import pytest
from model_checks.small import SQUARE

from optloc import InvalidProblem, assemble, measured
from optloc.model_checks.groups import ROW_PRICE, check_kinds, groups_of, leave_out, mark_rows

ALL = np.arange(5)


@pytest.fixture
def problem():
    azimuth = measured("azimuth", np.zeros(5), a=ALL, sigma=0.01)
    return assemble(SQUARE, azimuth, measured("range", np.ones(5), a=ALL, sigma=1.0)).flat()


def test_rows_of_a_station_are_one_group_and_each_row_is_one(problem):
    groups = groups_of(problem, np.ones(10, dtype=bool), ("station", "row"))
    first = problem.stations.names[0]
    assert (groups[0].name, groups[0].rows) == (f"station {first}", (0, 5))
    assert [one.rows for one in groups[5:]] == [(i,) for i in range(10)]
    assert groups[5].name == f"azimuth of {first}"
    assert groups[5].price == ROW_PRICE
    assert groups[0].price > ROW_PRICE


def test_ranges_may_have_a_common_offset_and_angles_have_none(problem):
    groups = groups_of(problem, np.ones(10, dtype=bool), ("offset",))
    assert [one.name for one in groups] == ["common offset of range"]


def test_what_is_left_out_has_no_weight(problem):
    group = groups_of(problem, np.ones(10, dtype=bool), ("station",))[3]
    left = mark_rows([group], 10)
    assert np.flatnonzero(left).tolist() == [3, 8]
    assert np.flatnonzero(leave_out(problem, left[None]).weight[0] == 0.0).tolist() == [3, 8]


def test_an_unknown_kind_of_group_is_refused_with_the_nearest():
    with pytest.raises(InvalidProblem, match="station"):
        check_kinds("statoin")
    assert check_kinds(("row", "station")) == ("station", "row")

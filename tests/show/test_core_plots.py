"""Every class of the core with a method `plot` has its drawing function."""

from optloc.problem import Fix, Problem
from optloc.show.core_plots import PLOTS
from optloc.tracking import Track


def test_the_table_has_the_classes_with_a_method():
    assert {one.__name__ for one in (Fix, Problem, Track) if hasattr(one, "plot")} == set(PLOTS)

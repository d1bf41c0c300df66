"""Constraints of tables and arguments: one for each target, merged bands, finished constraints."""

import numpy as np

from optloc import Motion, station_array
from optloc.base.frames import CARTESIAN
from optloc.base.types import Band
from optloc.files.constraint_reader import constraints_of, demands_of
from optloc.files.constraint_table import ConstraintTable


def test_a_constraint_without_a_target_holds_for_each_that_is_estimated():
    stations, motions = station_array([[0.0, 0.0, 0.0]]), [Motion(0, "run")] * 2
    table = ConstraintTable(kind="box", min=[0.0, 0.0, -1.0], max=[1.0, 2.0, float("inf")], unit="km")
    found, kept = constraints_of(demands_of({"here": table}), stations, CARTESIAN, motions, ["a", "b"], np.zeros(1))
    assert kept == tuple(motions)
    assert all(isinstance(one, Band) for one in found)
    assert {one.target for one in found} == {0, 1}
    assert {name for name in ("a", "b") if any(one.name.endswith(f" of {name}") for one in found)} == {"a", "b"}

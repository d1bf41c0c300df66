"""Fixes of separate epochs: in the order of the epochs, and counted while they are computed."""

import numpy as np
from partitions.scenes import SIGMA, STATIONS, arrivals

from optloc.files.convert import interpret_table
from optloc.files.stations import station_table
from optloc.files.table import of_frame
from optloc.files.table_import import ColumnHints
from optloc.partitions.epoch_fixes import fix_columns, fix_epochs
from optloc.solvers import solve


def test_epochs_of_several_structures_come_in_order(tmp_path):
    table, _ = arrivals(0, 9)
    lacking = (table["message"] % 3 == 1) & (table["station"] == "R2")
    found = of_frame(table[~lacking].sort_values("toa_ns", ascending=False), "readings", {})
    hints = ColumnHints(stations=station_table(STATIONS, "stations"), sigma=SIGMA)
    loaded = interpret_table(tmp_path / "readings", hints, found).read()
    told = []
    fix, reweighted = fix_epochs(loaded, "gtrs+lsr", told.append)
    columns = fix_columns(loaded, fix, 0)
    assert columns["epoch"].tolist() == [str(i) for i in range(9)]
    assert (sum(told), len(fix), reweighted) == (9, 9, False)
    assert columns["dof"].tolist() == [3, 2, 3] * 3
    together = solve(loaded.problem, "gtrs+lsr")
    assert np.allclose(np.column_stack([columns["x"], columns["y"]]), together.position)

"""The stored benchmark of kinds has every row, and its answers are those of today's code where a fix is quick."""

import pytest
from benchmarks.kinds import KINDS
from benchmarks.kinds_table import HEADER, cells, changes, measure, read_table
from monte_carlo.tables import FOLDER

from optloc.kernels.jit import enabled
from optloc.tracking.updates import UPDATES

OTHERS = ("registration, 200 x 5", "calibration, 6 x 24", "CSV to CSV, an event")
QUICK = {"tdoa", "tdoa, independent errors", "toa", "range", "range_sum", "range + tdoa"}


@pytest.fixture(scope="module")
def stored():
    return read_table(FOLDER / "kinds.md")


def test_the_table_has_every_row(stored):
    scans = [f"scan of a tracker, {name}" for name in UPDATES]
    assert list(stored) == [*(kind.name for kind in KINDS), *scans, *OTHERS]


def test_no_answer_costs_more_than_that_of_the_opponent(stored):
    assert not [name for name, row in stored.items() if "higher" in row["same cost, solve"] + row["same cost, auto"]]


@pytest.mark.skipif(not enabled(), reason="batches take long without machine code")
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.name in QUICK], ids=lambda kind: kind.name)
def test_answers_of_quick_kinds_are_those_of_the_table(stored, kind):
    case = kind.case()
    row = dict(zip(HEADER, cells(measure(case, case.ways["opponent"], rounds=0)), strict=True))
    assert changes(row, stored[kind.name]) == []

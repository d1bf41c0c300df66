"""The condition of a track: windows of innovations, scans that are refused in a row, and when the state is given up."""

from types import SimpleNamespace

import numpy as np
import pytest

from optloc import Status
from optloc.tracking.condition import Condition, Recent
from optloc.tracking.entry import Entry, Rules
from optloc.tracking.track import State
from optloc.tracking.updates import Updated

RULES = Rules(gate=5.0, patience=2)  # a window of eight scans


def entry(count=1, code=Status.OK, time=1.0):
    updated = Updated(np.zeros(2), np.eye(2), np.float64(1.0), np.float64(0.0), np.int64(count))
    return Entry(time, updated, code)


def recent(squares, count=1):
    found = Recent(RULES)
    for square in squares:
        found.add((square, count))
    return found


def test_the_share_is_the_mean_squared_innovation_over_the_squared_gate():
    assert recent([5.0] * 7).share == 0.0  # the window is not full
    assert recent([5.0] * 8).share == pytest.approx(5.0 / 25.0)
    assert recent([1000.0] * 8).share == 1.0  # a row counts as one at the gate
    assert recent([1000.0] * 4 + [5.0] * 8).share == pytest.approx(5.0 / 25.0)  # old scans leave the window


@pytest.mark.parametrize(
    ("square", "lost", "code"), [(5.0, False, Status.OK), (8.0, False, Status.MISFIT), (13.0, True, Status.MISFIT)]
)
def test_a_quarter_of_the_gate_is_a_misfit_and_half_of_it_a_loss(square, lost, code):
    found = recent([square] * 8)
    assert found.lost is lost
    assert found.judge(entry()).code == code
    assert found.judge(entry(code=Status.REJECTED)).code == Status.REJECTED


def test_a_clean_start_forgets_what_did_not_fit():
    found = recent([25.0] * 8)
    found.begin(SimpleNamespace(code=Status.OK, fit=(1.0, 1)))
    assert (len(found.scans), found.share, found.lost) == (1, 0.0, False)


def condition():
    return Condition.of(State(0.0, np.zeros(2), np.eye(2)), 0.0, RULES)


def test_scans_that_the_gate_refuses_in_a_row_end_a_track():
    found = condition()
    found.take(entry(count=1, time=1.0), (1.0, 1), gated=3)
    found.take(entry(count=0, time=2.0), (0.0, 0), gated=0)  # a scan without rows leaves the count as it was
    assert (found.missed, found.last_row, found.state.time) == (1, 1.0, 2.0)
    found.judge("")
    assert found.state is not None
    found.take(entry(count=1, time=3.0), (1.0, 1), gated=3)
    found.judge("")
    assert found.state is None
    assert "2 scans did not fit" in found.why


def test_a_vague_position_is_given_up_with_its_reason():
    found = condition()
    found.judge("the position is uncertain")
    assert (found.state, found.why) == (None, "the position is uncertain")
    assert condition().judged(entry(), np.eye(2), "the position is uncertain").code == Status.UNBOUNDED

"""Rules and scans of a track: the most that a row counts, and what a scan is called."""

from types import SimpleNamespace

import pytest

from optloc import Status
from optloc.tracking.entry import Entry, Rules, scan_sentence


@pytest.mark.parametrize(("gate", "most"), [(3.0, 9.0), (5.0, 25.0), (float("inf"), 25.0)])
def test_a_row_counts_as_one_at_the_gate_or_at_the_usual_one(gate, most):
    assert Rules(gate=gate).most == most


@pytest.mark.parametrize(
    ("event", "code", "label"),
    [
        ("started", Status.OK, "started"),
        ("started", Status.AMBIGUOUS, Status.AMBIGUOUS.label),
        ("", Status.OK, Status.OK.label),
        ("restarted", Status.REJECTED, Status.REJECTED.label),
    ],
)
def test_a_clean_scan_is_called_by_its_event_and_another_by_its_status(event, code, label):
    assert Entry(0.0, SimpleNamespace(), code, event=event).label == label


def test_each_label_of_a_scan_has_one_sentence():
    labels = {one.label for one in Status} | {"starting", "started", "restarted", "lost"}
    sentences = {label: scan_sentence(label) for label in labels}
    assert len(set(sentences.values())) == len(labels)
    # A scan without rows still has a predicted state, unlike a fix with too few rows.
    assert scan_sentence("too few rows") != Status.TOO_FEW_ROWS.sentence
    assert scan_sentence("infeasible") == Status.INFEASIBLE.sentence

"""The answer of tracks: counts, last states, sentences of scans and reasons."""

import numpy as np
from show.ranging import ENU

from optloc.show.describe_track import CLEAN, answer_of_scans
from optloc.show.row_answer import row_answer, state_table
from optloc.tracking.entry import scan_sentence


def scans(statuses, targets=None, reasons=None):
    """Return the table of scans of states of 2 m; a starting scan has no state."""
    count = len(statuses)
    place = np.stack([np.arange(count) * 10.0, np.full(count, 5.0)], axis=-1)
    place[[status == "starting" for status in statuses]] = np.nan
    texts = {"status": statuses, "reason": reasons or [""] * count, "target": targets or ["target"] * count}
    texts["epoch"] = [f"e{i}" for i in range(count)]
    found = state_table(ENU, place, np.tile(4.0 * np.eye(2), (count, 1, 1)), **texts)
    return found | {"time": np.arange(float(count)), "nis": np.full(count, 8.0), "rows": np.full(count, 4)}


def test_a_good_track_has_its_last_state_and_one_sentence():
    columns = scans(["starting", "started", "ok", "ok"])
    answer = answer_of_scans(columns, "run")
    assert (answer.title, answer.verdict) == ("run", "good")
    assert answer.section("use").rows == (
        ("status", "4 scans: 2 ok, 1 starting, 1 started"),
        ("", scan_sentence("ok")),
    )
    last = row_answer(columns, 3)
    assert answer.section("where").rows == (("last state", "e3: ok"), *last.section("where").rows)
    assert answer.section("how sure").rows == last.section("how sure").rows
    assert answer.section("why not").rows == ()


def test_a_bad_scan_has_its_sentence_and_reason():
    answer = answer_of_scans(scans(["ok", "rejected"], reasons=["", "4 of 4 rows failed the gate"]))
    assert answer.verdict == "care"
    assert answer.section("why not").rows == (
        ("rejected", scan_sentence("rejected")),
        ("scan e1", "rejected: 4 of 4 rows failed the gate"),
    )


def test_several_targets_have_a_table_of_last_states_and_counts():
    answer = answer_of_scans(scans(["ok", "ok", "started", "ok"], ["a", "b", "a", "b"]))
    (last,) = answer.section("where").sheets
    assert [row[:2] for row in last.rows] == [("e2", "a"), ("e3", "b")]
    assert [row[-1] for row in last.rows] == ["started", "ok"]
    (counts,) = answer.section("details").sheets
    assert counts.rows == [
        ("a", "ok", "1", "2.83", "2.00"),
        ("b", "ok", "2", "2.83", "2.00"),
        ("a", "started", "1", "2.83", "2.00"),
    ]


def test_a_track_without_a_state_is_bad_and_many_reasons_are_counted():
    answer = answer_of_scans(scans(["starting"] * 12, reasons=[f"reason {i}" for i in range(12)]))
    assert answer.verdict == "bad"
    assert answer.section("where").rows == (("position", "none"),)
    assert answer.section("why not").rows[-1] == ("...", "2 more reasons; write all of them to a file")
    assert "starting" in CLEAN

"""The answer of a fix of each status, and of a batch with the names of the user."""

from dataclasses import replace

import numpy as np
import pytest
from show.answers import batch, singles, states
from show.ranging import ranged

from optloc.base.records import join
from optloc.base.types import NOTES, Status
from optloc.show.describe_fix import answer_of


@pytest.mark.parametrize("status", [one for one in Status if one not in NOTES])
def test_each_status_begins_with_its_sentence(status):
    _, fix = ranged()
    answer = answer_of(replace(fix, code=np.asarray(int(status)), marks=None))
    sentence = replace(fix, code=np.asarray(int(status))).sentence
    assert answer.section("use").rows == (("status", status.label), ("", sentence))
    assert status is Status.UNPROVEN or sentence == status.sentence


def test_what_each_section_has():
    answer = answer_of(ranged()[1])
    assert [label for label, _ in answer.section("where").rows] == ["latitude", "longitude", "height"]
    assert [label for label, _ in answer.section("how sure").rows] == ["sigma east, north", "95 % radius"]
    assert answer.section("why not").rows == ()
    labels = [label for label, _ in answer.section("details").rows]
    assert labels == ["chi-square", "certificate", "95 % ellipse", "CEP50, CEP95", "x", "y", "stages"]


def test_a_direction_takes_the_place_of_a_position():
    for name in ("unbounded on Earth", "one bearing on Earth", "one bearing in a plain frame"):
        answer = answer_of(singles()[name])
        assert answer.section("where").rows == (("position", "not determined"),)
        assert [label for label, _ in answer.section("how sure").rows][:2] == ["95 % direction", "95 % range"]
        assert answer.section("why not").rows[0][0] == "reason"


def test_a_batch_counts_its_statuses_and_names_its_failures():
    answer = answer_of(batch())
    assert answer.section("use").rows == (("status", "25 fixes: 20 ok, 5 unbounded"),)
    fixes, counts = answer.section("where").sheets
    assert fixes.rows[0][0] == "event 0"
    assert [row[:2] for row in counts.rows] == [("ok", "20"), ("unbounded", "5")]
    why = answer.section("why not").rows
    assert why[0] == ("unbounded", Status.UNBOUNDED.sentence)
    (name, reason) = why[1]
    assert name == "fix event 0"
    assert reason.endswith("; the same for 4 more")
    assert len(why) == 2
    assert answer.verdict == "care"


def test_more_reasons_than_fit_are_counted():
    many = join([singles()["unbounded on Earth"].flat()] * 12, 12)
    own = replace(many, reason=np.array([f"reason {i}" for i in range(12)], dtype=object))
    assert answer_of(own).section("why not").rows[-1] == ("...", "2 more reasons; write all of them to a file")
    assert answer_of(many[:0]).labels == ("status",)


def test_a_fix_of_a_batch_keeps_its_name():
    assert answer_of(batch()[3]).title == "fix event 3"
    assert answer_of(batch()[3], title="mine").title == "mine"


def test_several_targets_share_one_status():
    answer = answer_of(states())
    (table,) = answer.section("where").sheets
    assert "status" not in table.head
    assert len(table.rows) == 2
    assert answer.verdict == "care"

"""The answer of separated emitters: status, a row for each emitter, ghosts and costs."""

from dataclasses import replace
from functools import cache

import numpy as np
from multi_target.scenes import drawn

from optloc.base.types import Status
from optloc.multi_target import separate
from optloc.multi_target.answer import Ghost
from optloc.show.answer_texts import with_sigma
from optloc.show.describe_emitters import answer_of_emitters


@cache
def emitters():
    """Return two emitters of a scene."""
    scene = drawn(1, 2, false=0)
    return separate(scene.problem, scene.clutter)[0]


def test_each_emitter_is_a_row_with_its_sigmas():
    found = emitters()
    answer = answer_of_emitters(found, "scene")
    assert answer.section("use").rows[0][1].startswith(f"{found.status.label}: {found.count} emitters")
    assert answer.section("use").rows[1] == ("", found.status.sentence)
    (table,) = answer.section("where").sheets
    assert table.head == ("emitter", "x, m", "y, m", "rows", "chi-square", "status")
    for i, (row, fix) in enumerate(zip(table.rows, found.fixes, strict=True)):
        numbers = [with_sigma(*pair, "").strip() for pair in zip(fix.position, fix.sigma(), strict=True)]
        assert row == (str(i + 1), *numbers, str(len(found.rows(i))), f"{float(fix.cost):.1f}", fix.status.label)


def test_ghosts_have_a_table_and_emitters_without_a_position_none():
    ghost = Ghost(np.array([1.0, 2.0]), np.array([0, 1, 2]), 3.0)
    (table,) = answer_of_emitters(replace(emitters(), ghosts=(ghost,))).section("why not").sheets
    assert table.rows == [("1.0, 2.0", "3", "3.0")]
    none = replace(emitters(), fixes=(), status=Status.INFEASIBLE, reason="no assignment", assignment=np.array([-1]))
    answer = answer_of_emitters(none)
    assert answer.section("where").rows == (("position", "none"),)
    assert answer.verdict == "bad"
    assert answer.section("why not").rows == (("reason", "no assignment"),)

"""The sections of one row of a table: the same as of a single fix, and with the sentence of a scan."""

import numpy as np
import pytest
from show.answers import batch, singles
from show.ranging import ENU

from optloc.base.types import Status
from optloc.problem import CARTESIAN
from optloc.show.columns import fix_columns
from optloc.show.describe_fix import answer_of
from optloc.show.render import line_of_answer
from optloc.show.row_answer import RowSource, row_answer, row_verdict, state_table, use_rows, why_rows


@pytest.mark.parametrize("name", singles())
def test_a_row_has_the_main_sections_of_its_fix(name):
    fix = singles()[name]
    whole = answer_of(fix)
    part = row_answer(fix_columns(fix), 0, fix)
    assert part.sections == tuple(one for one in whole.sections if one.name != "details")
    assert part.verdict == whole.verdict == row_verdict(fix_columns(fix), 0)


def test_a_row_of_a_batch_is_the_answer_of_its_fix():
    fixes = batch()
    columns = fix_columns(fixes)
    for i in (0, 1):
        assert RowSource(columns, i, fixes=fixes, item=i).answer.sections == row_answer(columns, i, fixes[i]).sections


def test_a_line_has_the_sections_in_order():
    text = line_of_answer(row_answer(fix_columns(singles()["misfit on Earth"]), 0))
    places = [text.index(part) for part in ("misfit. ", Status.MISFIT.sentence, "latitude: ", "sigma east, north: ")]
    assert places == sorted(places)
    assert "reason: " in text
    assert text.endswith(".")


def test_a_state_without_a_fix_has_position_rates_and_sigmas():
    mean, cov = np.array([[10.0, 20.0]]), np.diag([4.0, 9.0, 0.25, 0.25])[None]
    columns = state_table(CARTESIAN, mean, cov, np.array([[1.0, -2.0]]), status=["ok"], reason=[""])
    rows = dict(row_answer(columns, 0, sentence="A sentence.").section("where").rows)
    assert rows == {
        "x": "10.0 ± 2.0 m",
        "y": "20.0 ± 3.0 m",
        "velocity x": "1.00 ± 0.50 m/s",
        "velocity y": "-2.00 ± 0.50 m/s",
    }
    assert use_rows(columns, 0, "A sentence.")[1] == ("", "A sentence.")
    assert why_rows(columns, 0) == ()


def test_a_state_without_a_position_says_so():
    columns = state_table(ENU, np.full((1, 2), np.nan), np.full((1, 2, 2), np.nan), status=["starting"])
    answer = row_answer(columns, 0)
    assert answer.section("where").rows == (("position", "none"),)
    assert answer.section("how sure").rows == ()


def test_a_row_without_redundancy_needs_care():
    columns = state_table(
        CARTESIAN, np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)), status=["ok"] * 2, unchecked=[True, False]
    )
    assert [row_verdict(columns, i) for i in range(2)] == ["care", "good"]
    assert "no redundancy" in use_rows(columns, 0)[0][1]

"""All fixes of a file: the fixes of its epochs one by one, in order, as a table and as JSON."""

import json

import numpy as np
import pytest

from optloc import Status, solve
from optloc.cli.file_fixes import answer_of_file, fix_file, fixes_json, results_of
from optloc.cli.options import shipped_problems
from optloc.cli.output import dumps
from optloc.files import read
from optloc.problem import by_epoch


@pytest.fixture(scope="module")
def found():
    return fix_file(read(shipped_problems()["run"]), "auto", quiet=True)


def test_epochs_are_fixed_as_they_are_one_by_one(found):
    problem = found.loaded.problem
    alone = solve(by_epoch(problem) if found.apart else problem)
    assert found.fix.position == pytest.approx(alone.position, abs=1e-6)
    assert found.passes() == bool((np.asarray(alone.code) == Status.OK).all())
    assert len(list(found.singles)) == np.size(alone.code)


def test_json_holds_the_rows_of_the_table(found):
    told = json.loads(dumps(fixes_json(found)))
    assert [row["x"] for row in told["fixes"]] == pytest.approx(found.columns["x"].tolist())
    assert told["title"] == found.loaded.title
    assert results_of(found).columns is found.columns


EVENTS = """format = 2
[stations]
rows = [{ name = "A", x = 0, y = 0 }, { name = "B", x = 900, y = 0 }, { name = "C", x = 0, y = 900 }]
[[measurements]]
kind = "range"
sigma = "1 m"
rows = [
  { epoch = "morning", time = 0, a = "A", z = 500 }, { epoch = "morning", time = 0, a = "B", z = 721.11 },
  { epoch = "morning", time = 0, a = "C", z = 583.1 }, { epoch = "evening", time = 9, a = "A", z = 500 },
  { epoch = "evening", time = 9, a = "B", z = 721.11 }, { epoch = "evening", time = 9, a = "C", z = 583.1 },
]
"""


def test_the_answer_of_a_file_has_the_names_of_its_events(tmp_path, found):
    assert answer_of_file(found).title == found.loaded.title
    (tmp_path / "events.toml").write_text(EVENTS)
    events = fix_file(read(tmp_path / "events.toml"), "auto", quiet=True)
    table = answer_of_file(events).section("where").sheets[0]
    assert table.head == ("epoch", "x, m", "y, m", "status")
    assert [row[0] for row in table.rows] == ["morning", "evening"]
    assert answer_of_file(events).section("use").rows[0] == ("status", "2 fixes: all ok")

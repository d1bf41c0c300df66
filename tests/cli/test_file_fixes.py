"""All fixes of a file: the fixes of its epochs one by one, in order, as a table and as JSON."""

import json

import numpy as np
import pytest

from optloc import Status, solve
from optloc.cli.file_fixes import fix_file, fixes_json, results_of
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

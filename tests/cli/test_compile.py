"""What is compiled: every kernel in one part, and a process that imports this very package."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import optloc
from optloc.cli.compile import environment, parts, problem_of
from optloc.kernels.jit import named


def test_every_kernel_is_compiled_by_one_part_only():
    entries = [name for part in parts().values() for name in part.entries]
    assert len(entries) > 10
    assert max(Counter(entries).values()) == 1
    assert all(named(name).name == name for name in entries)


@pytest.mark.parametrize("kind", ["range", "tdoa", "azimuth"])
def test_a_problem_of_a_kind_has_five_rows_at_five_stations(kind):
    problem = problem_of(kind)
    assert [(rows.kind, rows.count) for rows in problem.rows] == [(kind, 5)]
    assert np.array_equal(problem.rows[0].a, np.arange(1, 6))


def test_a_process_imports_the_package_that_began_it(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    found = environment(MORE="1")
    assert found["PYTHONPATH"].split(":") == [str(Path(optloc.__file__).parents[1]), "elsewhere"]
    assert found["MORE"] == "1"

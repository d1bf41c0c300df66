"""A case has the sampled epochs of a run, their fixes and the numbers of their rows."""

import shutil
from importlib.resources import files

import numpy as np
from advice.cases import range_case

import optloc
from optloc.advice.cases import _ROWS, _UNKNOWNS, case_of


def test_the_epochs_of_a_run_are_a_batch_with_the_numbers_of_their_rows():
    case, problem = range_case(epochs=4)
    assert case.x.shape == (4, 2)
    assert case.number.tolist() == np.arange(28).reshape(4, 7).tolist()
    np.testing.assert_array_equal(case.base.z, problem.z.reshape(4, 7))
    assert case.dof.tolist() == [5] * 4


def test_a_problem_without_redundancy_has_no_case():
    _, problem = range_case()
    few = problem.flat().with_rows(weight=(np.arange(7) < 2) * np.ones((1, 7)))
    assert case_of(few, np.full((1, 2), np.nan)) is None


def test_a_run_with_unknowns_at_each_epoch_is_sampled(tmp_path):
    """Its normal matrices are dense: whole runs of thousands of unknowns would not fit in memory."""
    shipped = files("optloc") / "scenarios"
    for name in ("registration-rows.csv", "registration-stations.csv"):
        shutil.copy(str(shipped / name), tmp_path)
    text = (shipped / "registration.toml").read_text(encoding="utf-8").replace('"noise"', '"epoch"')
    (tmp_path / "run.toml").write_text(text, encoding="utf-8")
    problem = optloc.load(tmp_path / "run.toml").flat()
    assert problem.layout.size > 1000
    part = case_of(problem, np.zeros((1, problem.layout.size))).base
    assert part.layout.size <= _UNKNOWNS
    assert part.count <= _ROWS
    assert part.epochs > 1

"""Back ends that work here: their trial, and the sentence for those that do not."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.solvers import back_ends
from optloc.solvers.back_ends import Backend, backend_kind, kind_of, try_in_process, version_of

HERE = {
    "CLARABEL": Backend("conic", "1", ""),
    "BROKEN": Backend("conic", "1", ""),
    "OSQP": Backend("quadratic", "1", "linear and quadratic programs only: operator splitting"),
    "ipopt": Backend("nonlinear", "1", ""),
    "scipy": Backend("least squares", "1", ""),
}


@pytest.fixture
def here(monkeypatch):
    monkeypatch.setattr(back_ends, "installed", lambda: HERE)
    monkeypatch.setattr(back_ends, "backends", lambda: {name: HERE[name] for name in HERE if name != "BROKEN"})
    monkeypatch.setattr(back_ends, "faults_of", lambda kinds: {"BROKEN": "it never ends"})


def test_versions_are_those_of_installed_packages():
    assert version_of("numpy") == np.__version__
    assert version_of("no-such-package-of-anybody") == "?"


def test_a_back_end_has_the_kind_of_its_library(here):
    assert backend_kind("CLARABEL", "solver") == kind_of("CLARABEL") == "conic"
    assert backend_kind("ipopt", "solver") == kind_of("ipopt") == "nonlinear"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("BROKEN", "does not work here: it never ends"),
        ("snopt", "is not installed"),
        ("ipop", "unknown solver"),
        ("OSQP", "solves linear and quadratic programs only, and the methods of optloc need cones"),
    ],
)
def test_what_cannot_be_used_is_refused_with_the_reason(here, name, words):
    with pytest.raises(InvalidProblem, match=words):
        backend_kind(name, "solver")


def test_the_list_has_what_each_installed_solver_solves():
    listed = back_ends.installed()
    assert listed["CLARABEL"].kind == "conic"
    for name in {"CLARABEL", "SCS"} & set(listed):
        assert "second-order cone, semidefinite" in listed[name].summary
    for name in {"OSQP", "HIGHS", "PIQP"} & set(listed):
        assert listed[name].kind == "quadratic"
        assert listed[name].summary.startswith("linear and quadratic programs only")
    assert listed["SCIPY"].summary == "linear programs only"
    assert "?" not in {entry.version for entry in listed.values()}


def test_every_solver_of_linear_and_quadratic_programs_works_and_one_that_prints_does_not():
    names = {name: entry.kind for name, entry in back_ends.installed().items() if entry.kind == "quadratic"}
    assert try_in_process(names) == dict.fromkeys(names, "")
    if "blocksqp" in back_ends.installed():
        words = "it prints messages that no setting suppresses"
        assert try_in_process({"blocksqp": "nonlinear", "ipopt": "nonlinear"}) == {"blocksqp": words, "ipopt": ""}


def test_the_trial_goes_on_behind_a_solver_that_ends_its_process(monkeypatch):
    tried = []

    def one_process(kinds):
        tried.append(list(kinds))
        return {"a": "", "b": "it ends the process"} if "a" in kinds else {"c": ""}

    monkeypatch.setattr(back_ends, "_one_process", one_process)
    assert try_in_process(dict.fromkeys("abc", "conic")) == {"a": "", "b": "it ends the process", "c": ""}
    assert tried == [["a", "b", "c"], ["c"]]
    monkeypatch.setattr(back_ends, "_one_process", lambda kinds: {})
    assert try_in_process({"a": "conic"}) == {"a": "the trial did not run"}

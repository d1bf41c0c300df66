"""Back ends that work here: their trial, and the sentence for those that do not."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.solvers import back_ends
from optloc.solvers.back_ends import Backend, backend_kind, kind_of, try_in_process, version_of

HERE = {
    "CLARABEL": Backend("conic", "1", ""),
    "BROKEN": Backend("conic", "1", ""),
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
    [("BROKEN", "does not work here: it never ends"), ("snopt", "is not installed"), ("ipop", "unknown solver")],
)
def test_what_cannot_be_used_is_refused_with_the_reason(here, name, words):
    with pytest.raises(InvalidProblem, match=words):
        backend_kind(name, "solver")


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

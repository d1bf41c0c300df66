"""`optloc doctor`: what is there, what is missing, and what brings it; never a failure itself."""

import json
from importlib.metadata import PackageNotFoundError, version

import pytest
from typer.testing import CliRunner

from optloc.cli import app
from optloc.cli.doctor import Package, advice, packages

RUN = CliRunner()
CORE = {"numpy", "scipy", "cvxpy", "clarabel", "casadi", "numba"}


def told(*more):
    done = RUN.invoke(app, ["doctor", *more])
    assert done.exit_code == 0, done.output
    return done.output


def test_it_tells_versions_machine_and_caches():
    found = json.loads(told("--json"))
    named = {one["name"]: one for one in found["packages"]}
    assert named.keys() >= CORE | {"matplotlib", "stonesoup", "skyfield"}
    assert not named.keys() & {"pytest", "ruff", "sphinx"}
    for name in CORE:
        assert named[name] == {
            "name": name,
            "version": version(name),
            "least": named[name]["least"],
            "extra": "",
            "state": "ok",
        }
    assert found["machine"]["usable"] >= 1
    assert set(found["machine_code"]) == {"folder", "made_for", "installed", "parts"}
    text = told()
    for word in ("Python", "numpy", "cvxpy", "processors", found["optloc"]["folder"]):
        assert word in text


def test_what_is_missing_has_its_command(monkeypatch):
    def absent(name):
        if name in ("matplotlib", "clarabel"):
            raise PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr("optloc.cli.doctor.version", absent)
    commands = [one["command"] for one in json.loads(told("--json"))["advice"]]
    assert commands[0].startswith("pip install 'clarabel>=")
    assert "pip install 'optloc[plot]'" in commands
    assert "clarabel" in told()


@pytest.mark.parametrize(
    ("found", "least", "state"),
    [("1.10.2", "1.9", "ok"), ("1.9", "1.9", "ok"), ("1.8.9rc1", "1.9", "too old"), (None, "1", "missing")],
)
def test_versions_are_compared_as_numbers(found, least, state):
    assert Package("a", found, least, "").state == state


def test_machine_code_that_is_missing_is_made_by_a_command():
    code = {"parts": {"proofs": False, "fixes": True}}
    assert [one.command for one in advice([Package("a", "2", "1", "")], code)] == ["optloc compile"]
    assert advice([Package("a", "2", "1", "")], {"parts": {"proofs": True}}) == []


def test_an_optloc_that_was_not_installed_is_told(monkeypatch):
    def absent(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr("optloc.cli.doctor.requires", absent)
    assert packages() == []
    assert "pip install ." in told()

"""Values of options: lists of numbers, statuses, constraints, and names of shipped problems."""

from math import inf
from pathlib import Path

import pytest
from typer.models import ArgumentInfo, OptionInfo
from typer.testing import CliRunner

from optloc import InvalidProblem, Status
from optloc.cli.application import app
from optloc.cli.options import (
    allowed,
    constraints,
    coordinates,
    example,
    find_problem,
    name_in,
    shipped_problems,
)


def test_coordinates_are_finite_numbers_unless_they_are_bounds():
    assert coordinates("1,-2.5,3e2", "--at") == [1.0, -2.5, 300.0]
    assert coordinates("0,-inf", "--box", bounds=True) == [0.0, -inf]
    for text in ("1,x", "1,,2", "inf", "nan", ""):
        with pytest.raises(InvalidProblem, match="not a list of numbers"):
            coordinates(text, "--at")


def test_statuses_are_named_as_they_are_printed():
    assert allowed("unproven,ambiguous") == (Status.UNPROVEN, Status.AMBIGUOUS)
    assert allowed(None) == ()
    with pytest.raises(InvalidProblem, match="did you mean"):
        allowed("unprovn")


def test_options_are_constraints_of_a_file():
    found = constraints("12 km", True, "0,0,-inf:5,6,7")
    assert list(found) == ["--height", "--above-ground", "--box"]
    assert found["--height"].exactly == "12 km"
    assert (found["--box"].min, found["--box"].max) == ([0.0, 0.0, -inf], [5.0, 6.0, 7.0])
    assert constraints(None, False, None) == {}
    with pytest.raises(InvalidProblem, match="one corner"):
        constraints(None, False, "0,0")


def test_a_bare_word_is_a_shipped_problem_and_a_path_never_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_problem(Path("demo")) == shipped_problems()["demo"]
    assert find_problem(Path("demo.toml")) == Path("demo.toml")
    (tmp_path / "demo").touch()
    assert find_problem(Path("demo")) == Path("demo")
    with pytest.raises(InvalidProblem, match="did you mean 'ambiguous'"):
        find_problem(Path("ambigous"))


def test_names_are_options_with_flags_and_arguments_without():
    assert isinstance(name_in("motions", "Model", "--model"), OptionInfo)
    assert isinstance(name_in("motions", "Model"), ArgumentInfo)


def test_help_shows_examples():
    assert example("optloc demo").count("optloc demo") == 1


@pytest.mark.parametrize("words", [[], ["study"]])
def test_a_group_without_arguments_prints_its_help(words):
    found = CliRunner().invoke(app, words)
    assert (found.exit_code, found.stderr) == (0, "")
    assert "Commands" in found.output or "Answers" in found.output

"""Completion of option values: tables, choices, stages after stages and statuses after statuses."""

import os

import pytest
from typer.testing import CliRunner

from optloc.base.types import Status
from optloc.cli.application import app
from optloc.cli.completion import choices, complete, stages, statuses
from optloc.solvers import METHODS


def offered(line):
    """Return what a shell offers for a command line that ends in an unfinished word."""
    environment = os.environ | {
        "_OPTLOC_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split()) - 1),
    }
    return CliRunner().invoke(app, [], prog_name="optloc", env=environment).stdout.split()


def test_a_table_and_the_choices_of_an_option_are_completions():
    assert "cv" in complete("motions")("")
    assert choices("rms|volume|axis")("v") == ["rms", "volume", "axis"]


def test_a_method_continues_stage_by_stage():
    assert set(METHODS) <= set(stages("a"))
    assert "gtrs+lsr" in stages("gtrs+l")
    # a stage that is typed already is not offered again, and a method does not continue a list
    assert not {"gtrs+gtrs", "gtrs+auto"} & set(stages("gtrs+"))


def test_statuses_continue_after_each_comma():
    assert len(statuses("")) == len(Status)
    assert "curved,unproven" in statuses("curved,un")
    assert "too-few-rows" in statuses("too")


@pytest.mark.parametrize(
    ("line", "value"),
    [
        ("optloc fix a.toml --allow curved,unp", "curved,unproven"),
        ("optloc fix a.toml --method gtrs+ls", "gtrs+lsr"),
        ("optloc fix a.csv --frame ec", "ecef"),
        ("optloc fix a.toml --noise-from-data st", "station"),
        ("optloc place a.toml --criterion vol", "volume"),
        ("optloc list fo", "formulations"),
    ],
)
def test_the_shell_offers_values_of_options(line, value):
    assert value in offered(line)


@pytest.mark.parametrize(("line", "value"), [("optloc ca", "calibrate"), ("optloc study re", "report")])
def test_the_shell_offers_commands(line, value):
    assert value in offered(line)
    assert "Usage:" not in offered(line)

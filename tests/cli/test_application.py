"""The application: what it lists, what it prints without work, and that `main` ends with the code of the command."""

import json
import sys

import pytest
from typer.testing import CliRunner

import optloc
from optloc.cli import app as application
from optloc.cli.application import app, main
from optloc.files.schema import schema

RUN = CliRunner()


def test_the_package_of_commands_holds_this_application():
    assert application is app


def test_the_schema_is_printed_as_json():
    assert json.loads(RUN.invoke(app, ["schema"]).stdout) == schema()


def test_the_version_is_that_of_the_package():
    assert optloc.__version__ in RUN.invoke(app, ["--version"]).stdout


@pytest.mark.parametrize(("words", "code"), [(["list", "kinds", "--json"], 0), (["list", "kindz"], 2), (["fxi"], 2)])
def test_commands_end_with_their_code(words, code):
    assert RUN.invoke(app, words).exit_code == code


def test_main_runs_the_application_as_a_process(monkeypatch):
    ended = []
    # The package has the application under the name of its module.
    monkeypatch.setattr(sys.modules["optloc.cli.application"], "run_process", ended.append)
    main()
    assert ended == [app]

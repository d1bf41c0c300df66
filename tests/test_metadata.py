"""One version and one licence, wherever they are said."""

import tomllib
from pathlib import Path

import yaml

import optloc

ROOT = Path(__file__).parents[1]


def test_project_package_and_citation_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    # What version 1.2.0 of the Citation File Format requires, and an author that is an entity.
    assert citation["cff-version"] == "1.2.0"
    assert citation["message"]
    assert all(author["name"] for author in citation["authors"])
    assert citation["type"] == "software"
    assert citation["title"] == project["name"]
    assert citation["license"] == project["license"] == "MIT"
    assert citation["version"] == project["version"] == optloc.__version__
    assert "MIT License" in (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert f"## [{project['version']}] - " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_lowest_python_is_that_of_the_linter():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    lowest = settings["project"]["requires-python"].removeprefix(">=")
    assert settings["tool"]["ruff"]["target-version"] == "py" + lowest.replace(".", "")

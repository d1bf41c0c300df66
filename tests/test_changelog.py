"""The changelog and the fragments of the next section: short entries, and types that towncrier knows."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["towncrier"]
FRAGMENTS = [path for path in sorted((ROOT / SETTINGS["directory"]).iterdir()) if path.name != "README.md"]
TYPES = {kind["directory"]: kind["name"] for kind in SETTINGS["type"]}
# Words of an entry: two short sentences.
MOST = 30


def entries(text):
    """Return the bullets of a page, each without its line breaks."""
    return [" ".join(found.split()) for found in re.findall(r"^- (.*(?:\n  .*)*)", text, re.MULTILINE)]


def too_long(texts):
    """Return the texts of more words than an entry may have."""
    return [text for text in texts if len(text.split()) > MOST]


def test_entries_are_found_with_all_their_lines():
    assert entries("## [1]\n\n- one\n  two\n- three\n\nNo entry.\n") == ["one two", "three"]
    assert too_long(["word " * MOST, "word " * MOST + "more"]) == ["word " * MOST + "more"]


def test_every_entry_is_short():
    found = entries(CHANGELOG)
    assert len(found) == len(re.findall(r"^\s*[-*] ", CHANGELOG, re.MULTILINE)) > 80
    assert too_long(found) == []
    assert len(set(found)) == len(found)


def test_sections_have_the_titles_and_types_that_towncrier_writes():
    title = re.escape(SETTINGS["title_format"]).replace(r"\{version\}", r"\d+\.\d+\.\d+")
    title = title.replace(r"\{project_date\}", r"(?:\d{4}-\d\d-\d\d|Unreleased)")
    assert [line for line in re.findall(r"^## .*", CHANGELOG, re.MULTILINE) if not re.fullmatch(title, line)] == []
    assert set(re.findall(r"^### (.*)", CHANGELOG, re.MULTILINE)) <= set(TYPES.values())
    assert CHANGELOG.count("<!-- towncrier release notes start -->\n") == 1  # new sections are written behind it


@pytest.mark.parametrize("path", FRAGMENTS, ids=lambda path: path.name)
def test_every_fragment_is_one_short_entry_of_a_known_type(path):
    name, kind, ending = path.name.split(".")
    assert re.fullmatch(r"[a-z0-9-]+", name)
    assert kind in TYPES
    assert ending == "md"
    text = path.read_text(encoding="utf-8")
    assert text.strip()
    assert len(text.strip().splitlines()) == 1  # towncrier adds the bullet, and breaks the line
    assert too_long([text]) == []

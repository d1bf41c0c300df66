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


def mistakes(path):
    """Return what is wrong with the name or the text of a fragment."""
    parts = path.name.split(".")
    lines = path.read_text(encoding="utf-8").strip().splitlines()
    found = {
        "name": len(parts) != 3 or not re.fullmatch(r"[a-z0-9-]+", parts[0]) or parts[-1] != "md",
        "type": parts[1] not in TYPES,
        "lines": len(lines) != 1,  # towncrier adds the bullet, and breaks the line
        "words": bool(too_long(lines)),
    }
    return [what for what, wrong in found.items() if wrong]


def test_every_fragment_is_one_short_entry_of_a_known_type():
    assert {path.name: mistakes(path) for path in FRAGMENTS if mistakes(path)} == {}


@pytest.mark.parametrize(
    ("name", "text", "wrong"),
    [
        ("tracks.added.md", "`optloc track` reads tables.\n", []),
        ("tracks.added.txt", "`optloc track` reads tables.\n", ["name"]),
        ("tracks.feature.md", "`optloc track` reads tables.\n", ["type"]),
        ("tracks.fixed.md", "", ["lines"]),
        ("tracks.fixed.md", "- one\n- two\n", ["lines"]),
        ("tracks.changed.md", "word " * 31, ["words"]),
    ],
)
def test_mistakes_in_fragments_are_found(tmp_path, name, text, wrong):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert mistakes(path) == wrong

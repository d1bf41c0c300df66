"""The README shows what was measured, and its code does what it says."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def table(name):
    lines = (ROOT / "docs" / "measured" / f"{name}.md").read_text(encoding="utf-8").splitlines()
    return "\n".join(line for line in lines if line.startswith("|"))


def test_its_table_is_the_generated_one():
    assert table("peers").count("\n") > 5
    assert table("peers") in README


def test_the_table_of_initiators_is_the_generated_one():
    page = (ROOT / "docs" / "howto" / "stone-soup.md").read_text(encoding="utf-8")
    assert table("stonesoup") in page or "measured/stonesoup.md" in page or "generated: rows stonesoup" in page


def test_its_python_runs(capsys):
    (block,) = re.findall(r"^```python\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    exec(compile(block, "README.md", "exec"), {})
    said = capsys.readouterr().out
    (shown,) = re.findall(r"^```text\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    assert said == shown
    assert "ok" in said.splitlines()[0]


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)#]+)\)", README))
def test_its_links_lead_somewhere(target):
    assert (ROOT / target).exists()

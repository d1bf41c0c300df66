"""The README shows what was measured, and nothing else."""

from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_its_table_is_the_generated_one():
    measured = (ROOT / "docs" / "measured" / "stonesoup.md").read_text(encoding="utf-8")
    table = [line for line in measured.splitlines() if line.startswith("|")]
    assert len(table) == 11
    assert "\n".join(table) in (ROOT / "README.md").read_text(encoding="utf-8")

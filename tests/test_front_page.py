"""The front page: eight cards of six lines, code that fits a narrow column, and numbers that its tables have."""

import re

import pytest
from doc_pages import DOCS, blocks

PAGE = DOCS / "index.md"
TEXT = PAGE.read_text(encoding="utf-8")
CARDS = TEXT.split(":::{grid-item-card}")[1:]


def test_eight_cards_have_a_picture_six_lines_and_a_recipe():
    assert len(CARDS) == 8
    pictures, recipes = re.findall(r":img-top: (\S+)\n:img-alt: \w", TEXT), re.findall(r"\[Recipe\]\((\S+)\)", TEXT)
    assert [name.removesuffix(".png") for name in pictures] == [name.removesuffix(".md") for name in recipes]
    assert len(set(pictures)) == 8
    assert [name for name in [*pictures, *recipes] if not (DOCS / name).exists()] == []
    code = [re.search(r"```python\n(.*?)```\n\n```text\nok ", card, re.DOTALL)[1] for card in CARDS]
    assert [text.count("\n") for text in code] == [6] * 8


def test_code_fits_a_phone():
    found = blocks(PAGE)
    assert len(found) > 8
    assert [line for block in found for line in (block.text + (block.shown or "")).split("\n") if len(line) > 42] == []


@pytest.mark.parametrize("name", sorted(set(re.findall(r"\(measured/(\w+)\.md\)", TEXT))))
def test_each_number_is_in_the_table_that_it_names(name):
    table = (DOCS / "measured" / f"{name}.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in TEXT.splitlines() if line.startswith("|") and f"(measured/{name}.md)" in line]
    numbers = [cell.strip() for row in rows for cell in row[2:-2] if cell.strip()]
    for sentence in re.findall(rf"[^.]*(?:\.\d[^.]*)*\(\[[\w ]+\]\(measured/{name}\.md\)", TEXT):
        numbers += re.findall(r"\d{3,}", sentence)
    assert [number for number in numbers if not re.search(rf"(?<![\d.]){re.escape(number)}(?![\d.]*\d)", table)] == []

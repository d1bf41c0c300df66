"""Habits of private language in docstrings, comments, messages and pages, counted for each folder.

`python tests/habits.py` writes the counts to `habits.json`; it refuses a count that is higher than the stored one.
"""

import ast
import io
import json
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path

from sources import nodes

ROOT = Path(__file__).resolve().parents[1]
STORED = Path(__file__).with_name("habits.json")
# A sentence of more words needs a second reading.
WORDS = 25
# Shorter strings are keys and names, not sentences.
SPACES = 3
HABITS = {
    "a clause as the subject of a sentence": r"(?:^|[.;:] )(?:What|Whatever|Whoever|Who|That which) (?!follows)\w+",
    "return a clause": r"\bReturn (?:what|where|which|how|who|whose|why|whatever)\b",
    "a person who is nobody": r"\b(?:nobody|somebody|everybody|anybody|whoever)\b",
    "software that speaks or feels": r"\b(?:said|tells?|told|asks|hears?|heard|believes?|doubts?|accuses?|forgives?)\b",
    "that of, those of": r"\b(?:that|those) of\b",
    "data that stands or lies": r"\b(?:stands?|stood|lies|lay)\b",
    "is none": r"\b(?:is|are|was|were|be) none\b",
    "nothing but": r"\b(?:nothing|none|all|anything) but\b",
    "one as a noun": r"\b(?:the|another|each|that|such an?|no|first|last) ones?\b",
    "its own": r"\bof (?:its|their) own\b",
    "beside": r"\bbeside\b",
    "old words": r"\b(?:nought|lest|whence|wherein|thereof|amid|anew|hence|thus)\b",
    "so many": r"\b(?:so|as) (?:many|much)\b",
}


def texts(path: Path) -> list[str]:
    """Return the docstrings, comments and longer strings of a module, or the paragraphs of a page or notebook."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = json.loads(source)["cells"]
        source = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    if path.suffix in (".md", ".ipynb"):
        prose = re.sub(r"```.*?```|^\|.*$", "", source, flags=re.DOTALL | re.MULTILINE)  # without code and tables
        return prose.split("\n\n")
    constants = [node for node in nodes(path) if isinstance(node, ast.Constant)]
    found = [node.value for node in constants if isinstance(node.value, str) and node.value.count(" ") >= SPACES]
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return found + [token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT]


def folder_of(path: Path) -> str:
    """Return the folder of a file that its habits count for: the first two levels."""
    parts = path.relative_to(ROOT).parts[:-1]
    return "/".join(parts[:2]) or "top"


def pages_and_modules() -> list[Path]:
    """Return the paths of all modules and pages, without pages that tools generate."""
    paths = [*ROOT.glob("optloc/**/*.py"), *ROOT.glob("formulations/**/*.py"), *ROOT.glob("docs/**/*.md")]
    paths += ROOT.glob("docs/notebooks/*.ipynb")
    return [path for path in [*paths, ROOT / "README.md"] if not {"_build", "gallery"} & set(path.parts)]


def counts() -> dict[str, dict[str, int]]:
    """Return the number of places of each habit in each folder."""
    found: dict[str, Counter[str]] = {}
    for path in pages_and_modules():
        here = found.setdefault(folder_of(path), Counter())
        for text in texts(path):
            here.update({habit: len(re.findall(pattern, text)) for habit, pattern in HABITS.items()})
            sentences = re.split(r"(?<=[.;:!?])\s", " ".join(text.split()))
            here["long sentences"] += sum(len(sentence.split()) > WORDS for sentence in sentences)
    return {folder: dict(sorted((+number).items())) for folder, number in sorted(found.items())}


def risen(now: dict[str, dict[str, int]], before: dict[str, dict[str, int]]) -> list[str]:
    """Return the habits that more places have than before."""
    return [
        f"{folder}: {habit}: {number}, was {before.get(folder, {}).get(habit, 0)}"
        for folder, habits in now.items()
        for habit, number in habits.items()
        if number > before.get(folder, {}).get(habit, 0)
    ]


if __name__ == "__main__":
    found = counts()
    more = risen(found, json.loads(STORED.read_text())) if STORED.exists() and "--accept" not in sys.argv else []
    if more:
        sys.exit("\n".join(more))
    STORED.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")

"""What the tool says: every sentence is short enough to be read once, whoever's names stand in it."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from habits import HABITS, STORED, counts, risen
from sources import nodes, walked

from optloc.base.types import Status

ROOT = Path(__file__).resolve().parents[1] / "optloc"
# Characters of a sentence without the names, numbers and lists that are put into it.
MOST = 200
# Whose arguments are read by people: errors (three parts, one sentence), advice (two sentences), lines on the screen.
JOINED, APART = {"InvalidProblem"}, {"Advice", "say"}


def text(node: ast.AST | None, known: dict[str, list[ast.expr]], depth: int = 0) -> str:
    """Return the longest text that an expression is known to be; what is put into it is left out."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(text(part, known, depth) for part in node.values)
    if isinstance(node, ast.FormattedValue):
        return text(node.value, known, depth) if isinstance(node.value, ast.IfExp | ast.Name) else ""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text(node.left, known, depth) + text(node.right, known, depth)
    if isinstance(node, ast.IfExp):
        return max(text(node.body, known, depth), text(node.orelse, known, depth), key=len)
    if isinstance(node, ast.Name) and depth < 3:
        return max((text(one, known, depth + 1) for one in known.get(node.id, [])), key=len, default="")
    return ""


def sentences(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of all that a module says."""
    for scope in nodes(path):
        if not isinstance(scope, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        known: dict[str, list[ast.expr]] = {}
        own = walked(scope)
        for node in own:
            if isinstance(node, ast.Assign):
                for target in node.targets:
                    pairs = [(target, node.value)]
                    if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                        pairs = list(zip(target.elts, node.value.elts, strict=False))
                    for one, value in pairs:
                        if isinstance(one, ast.Name):
                            known.setdefault(one.id, []).append(value)
                        elif isinstance(one, ast.Subscript) and getattr(one.value, "id", "") == "reason":
                            yield node.lineno, text(value, known)
        for node in own:
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                parts = [text(part, known) for part in (*node.args, *(word.value for word in node.keywords))]
                if node.func.id in JOINED:
                    yield node.lineno, "; ".join(part for part in parts if part)
                elif node.func.id in APART:
                    yield from ((node.lineno, part) for part in parts if "\n" not in part)


def all_sentences() -> list[tuple[str, str]]:
    paths = sorted(ROOT.rglob("*.py"))
    return [(f"{path.relative_to(ROOT)}:{line}", said) for path in paths for line, said in sentences(path) if said]


@pytest.mark.slow
def test_every_sentence_is_short():
    found = all_sentences()
    assert len(found) > 500  # the collection finds what it is for
    assert [place for place, said in found if len(said) >= MOST] == []


def test_every_status_is_short():
    assert [status.label for status in Status if len(status.sentence) >= MOST] == []


@pytest.mark.slow
def test_every_error_names_a_place_and_a_step():
    """Lines of a stream have no names: who reads them says which line it was, and the key that is wrong."""
    lacking, count = [], 0
    for path in sorted(ROOT.rglob("*.py")):
        for node in nodes(path):
            if not isinstance(node, ast.Call) or getattr(node.func, "id", "") != "InvalidProblem":
                continue
            count += 1
            told = {word.arg: word.value for word in node.keywords}
            told |= dict(zip(("what", "where", "advice"), node.args, strict=False))
            needed = ("advice",) if path.parent.name == "service" else ("where", "advice")
            parts = [told.get(part, ast.Constant(None)) for part in needed]
            if any(isinstance(part, ast.Constant) and not part.value for part in parts):
                lacking.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert count > 500
    assert lacking == []


# Habits of private language: their number in a folder can fall, never rise.


@pytest.mark.slow
def test_no_folder_gains_a_habit_of_private_language():
    assert risen(counts(), json.loads(STORED.read_text(encoding="utf-8"))) == []


def test_a_habit_more_is_found():
    before = {"optloc/files": {"is none": 2, "beside": 1}}
    assert risen({"optloc/files": {"is none": 2}}, before) == []
    assert risen({"optloc/files": {"is none": 3}, "docs": {"beside": 1}}, before) == [
        "optloc/files: is none: 3, was 2",
        "docs: beside: 1, was 0",
    ]


@pytest.mark.parametrize(
    ("habit", "text"),
    [
        ("a clause as the subject of a sentence", "What has a prior brings a row."),
        ("return a clause", "Return where a refinement ends."),
        ("software that speaks or feels", "The user is told at least every two seconds."),
        ("that of, those of", "that of its value at the first epoch"),
        ("is none", "an answer that is none"),
    ],
)
def test_habits_are_recognised(habit, text):
    assert re.search(HABITS[habit], text)
    assert not any(
        re.search(pattern, "Return the covariance of the position (N, d, d).") for pattern in HABITS.values()
    )

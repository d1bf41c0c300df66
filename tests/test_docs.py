"""The documentation: every block of code runs, and nothing that the code has is missing from it.

``OPTLOC_WRITE_DOCS=1 pytest tests/test_docs.py`` writes the outputs of the blocks into the pages.
"""

import ast
import dataclasses
import importlib
import inspect
import os
import re
import shutil
import warnings
from pathlib import Path

import pytest
from conftest import DATA_DEFAULT
from doc_pages import DOCS, MARKS, blocks, run_page
from typer.main import get_command

import optloc
from optloc.base.errors import OptlocError
from optloc.cli import app
from optloc.kernels.jit import enabled

# Generated pages hold no code; the recipes of contributors have a test of their own.
ELSEWHERE = ("measured", "papers", "examples", "gallery", "_build")
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page.relative_to(DOCS).parts[0] not in ELSEWHERE]
# Pages that take seconds.
LONG = (
    *("recipes", "tutorials", "studies.md", "details/studies.md", "placement.md", "details/placement.md", "maps.md"),
    *("details/constraints.md", "howto/layers.md", "howto/scale.md", "optimisation.md"),
)
RUN = [
    pytest.param(page, marks=pytest.mark.slow) if page.relative_to(DOCS).as_posix().startswith(LONG) else page
    for page in PAGES
    if any(block.kind in ("python", "console", "sh") for block in blocks(page))
]
THEORY = DOCS / "theory"
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")


def text_of(name):
    return " ".join((DOCS / name).read_text(encoding="utf-8").split())


@pytest.mark.parametrize("page", RUN, ids=lambda page: str(page.relative_to(DOCS)))
def test_every_block_runs_and_prints_what_is_shown(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("NO_COLOR", "1")
    if DATA_DEFAULT.is_dir() and not os.environ.get("OPTLOC_DATA"):
        monkeypatch.setenv("OPTLOC_DATA", str(DATA_DEFAULT))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        warnings.simplefilter("error", RuntimeWarning)
        wrong, fresh = run_page(page)
    pictures = [name for name in PICTURE.findall(page.read_text(encoding="utf-8")) if "/" not in name]
    if os.environ.get("OPTLOC_WRITE_DOCS"):
        page.write_text(fresh, encoding="utf-8")
        for name in pictures:
            shutil.copy(name, page.parent)
    if not enabled():  # what is shown was proven by machine code
        wrong = [each for each in wrong if ": shown" not in each]
    assert wrong == [], "\n".join(wrong)
    # a picture beside a page is one that its commands draw
    assert [name for name in pictures if not (Path(name).exists() and (page.parent / name).exists())] == []


def test_each_task_of_optimisation_has_at_most_three_steps():
    page = (DOCS / "optimisation.md").read_text(encoding="utf-8")
    tasks = page.split("## Five tasks")[1].split("\n## ")[0].split("\n### ")[1:]
    assert len(tasks) == 5
    for task in tasks:
        first = ast.parse(re.search(r"```python\n(.*?)```", task, re.DOTALL)[1])
        calls = [ast.unparse(call.func) for call in ast.walk(first) if isinstance(call, ast.Call)]
        # the task on objectives has one problem for each of two objectives
        count = calls.count("optloc.pose")
        steps = [name for name in calls if name == "optloc.pose" or name.startswith("posed.")]
        assert len([name for name in steps if name != "posed.solve"]) <= 2 * count, task
        assert 1 <= calls.count("posed.solve") <= 2 * count, task


def test_marks_are_known_and_few_blocks_are_not_run():
    found = [block for page in PAGES for block in blocks(page)]
    assert [block.mark for block in found if block.mark and not block.mark.startswith(MARKS)] == []
    code = [block for block in found if block.kind in ("python", "console", "sh")]
    left = [block for block in code if block.mark.startswith("not run: ")]
    assert sum(block.kind == "python" for block in left) <= 1  # the one of a library that is no dependency
    assert len(left) <= len(code) / 5


@pytest.mark.parametrize("name", sorted({key.split(":")[0] for key in optloc.solvers.FORMULATIONS}))
def test_every_formulation_has_a_page_with_all_its_arguments(name):
    page = THEORY / f"{name}.md"
    assert page.exists()
    text = page.read_text(encoding="utf-8")
    assert f"<!-- generated: formulation {name} -->" in text
    table = text.split("## Symbols and arguments")[1].split("\n## ")[0]
    documented = {word for line in table.splitlines() if line.startswith("|") for word in re.findall(r"`(\w+)`", line)}
    module = importlib.import_module(f"formulations.{name}")
    own = {
        key: value
        for key, value in vars(module).items()
        if not key.startswith("_") and getattr(value, "__module__", None) == module.__name__ and callable(value)
    }
    asked = " ".join(str(p.annotation) for f in own.values() for p in signature(f))
    missing, functions = set(), 0
    for key, value in own.items():
        answer = dataclasses.is_dataclass(value) and key not in asked  # it comes out and is no argument
        if not answer:
            functions += 1
            calls = [value, *([value.solve] if hasattr(value, "solve") else [])]
            missing |= {p.name for call in calls for p in signature(call) if p.name != "self"} - documented
        assert re.search(rf"auto(?:function|class):: {key}\b", text), f"{key} has no entry"
    assert functions > 0
    assert missing == set()


def signature(call):
    return inspect.signature(call).parameters.values()


def printed():
    """Return the names of the reference, by the paths that it prints."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in sorted((DOCS / "reference").glob("*.md")))
    whole = re.findall(r"automodule:: (\S+)\n   :members: ([^\n]+)", text)
    members = [f"{module}.{name.strip()}" for module, names in whole for name in names.split(",")]
    return [*re.findall(r"auto(?:function|class|data|exception):: (\S+)", text), *members]


def test_every_public_name_is_in_the_reference():
    modules = {"constraints", "datasets", "units"}  # their names are there
    assert set(optloc.__all__) - {name.rpartition(".")[2] for name in printed()} - modules == set()


@pytest.mark.parametrize("path", printed())
def test_a_name_of_the_reference_imports_by_its_printed_path(path):
    module, _, name = path.rpartition(".")
    assert hasattr(importlib.import_module(module), name)


def test_every_status_is_explained():
    text = text_of("errors.md")
    for status in optloc.Status:
        assert f"### {status.label} {status.sentence}" in text, f"{status.name}: {status.sentence}"


def test_every_exception_and_exit_code_is_explained():
    text = text_of("errors.md")

    def below(kind):
        yield kind
        for inner in kind.__subclasses__():
            yield from below(inner)

    names = {kind.__name__ for kind in below(OptlocError) if kind.__module__.startswith("optloc")}
    assert {"InvalidProblem", "NoSolution"} <= names
    assert [name for name in names if f"`{name}`" not in text] == []
    codes = {int(code) for code in re.findall(r"^\| (\d+) \|", (DOCS / "errors.md").read_text("utf-8"), re.MULTILINE)}
    assert codes >= exit_codes()


def exit_codes():
    """Return the exit codes that the source of the command line names."""
    found = set()
    for path in (DOCS.parent / "optloc" / "cli").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "Exit" and node.args:
                found |= {leaf.value for leaf in ast.walk(node.args[0]) if isinstance(leaf, ast.Constant)}
            if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "STOPPED":
                found.add(node.value.value)
    return {code for code in found if isinstance(code, int)}


def test_every_kind_and_every_method_is_in_the_page_on_choosing():
    text = text_of("how-to-choose.md")
    assert [name for name in [*optloc.models.MODELS, *optloc.solvers.METHODS] if f"`{name}`" not in text] == []
    stages = [name for name, entry in optloc.solvers.SOLVERS.items() if entry.role == "start"]
    assert [name for name in stages if not re.search(rf"`{name}\b|\b{name}\+", text)] == []


def test_every_command_is_generated_into_its_page():
    from importlib.util import module_from_spec, spec_from_file_location

    spec = spec_from_file_location("generated", DOCS / "generated.py")
    generated = module_from_spec(spec)
    spec.loader.exec_module(generated)
    page = generated.filled((DOCS / "command-line.md").read_text(encoding="utf-8"))
    for name, command in get_command(app).commands.items():
        inner = [f"{name} {word}" for word in getattr(command, "commands", {})] or [name]
        assert [words for words in inner if f"## `optloc {words}`" not in page] == []


def test_links_of_the_readme_lead_somewhere():
    root = DOCS.parent
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", (root / "README.md").read_text(encoding="utf-8"))
    assert [link for link in links if not link.startswith("http") and not (root / link).exists()] == []

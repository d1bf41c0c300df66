"""Imports go down only; lazy ones and those for type checking count."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FLOORS = {
    0: "types errors units frames status noise linalg ellipse arrays threads entries",
    1: "models",
    2: "layout problem linear normal fix tables kernels states build check check_constraints check_unknowns arguments "
    "epochs constraints tangent symbolic plan evaluate weigh windows equations blocks priors learnt bias gauss_newton "
    "loss suspects",
    3: "solve proof bounds maps simulate observe quality",
    4: "track several",
    5: "study papers scenario files datasets convert",
    6: "cli plot scene report maps plugins demo __main__",
}
FLOOR = {name: floor for floor, names in FLOORS.items() for name in names.split()}
TOP = max(FLOORS)
# clarabel: the back end of cvxpy, whose data a warm solve updates directly
GROUND = {"numpy", "scipy", "cvxpy", "casadi", "clarabel", "formulations"} | sys.stdlib_module_names


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def dotted(path: Path) -> list[str]:
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    return parts[:-1] if parts[-1] == "__init__" else parts


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and dotted name of everything imported anywhere in a file."""
    package = list(path.relative_to(ROOT).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)


def room(module: list[str]) -> str:
    """Return the room of a dotted name, empty for names that `optloc` itself offers."""
    if len(module) < 2:
        return ""
    home = ROOT / "optloc" / module[1]
    return module[1] if home.is_dir() or home.with_suffix(".py").is_file() else ""


def violations(path: Path) -> Iterator[str]:
    here = room(dotted(path))
    for line, name in imports(path):
        parts = name.split(".")
        there = room(parts)
        if parts[0] == "optloc" and FLOOR.get(there, TOP) > FLOOR.get(here, TOP):
            yield f"{path.relative_to(ROOT)}:{line} ({here}) imports {name}"
        if parts[0] == "formulations" and here != "solve":
            yield f"{path.relative_to(ROOT)}:{line} ({here}) imports {name}: only optloc/solve does"


def test_every_module_has_a_floor():
    rooms = {room(dotted(path)) for path in files("optloc")} - {""}
    assert rooms <= FLOOR.keys(), f"place {sorted(rooms - FLOOR.keys())} in FLOORS"


@pytest.mark.parametrize("path", files("optloc"), ids=lambda path: ".".join(dotted(path)))
def test_imports_go_down(path):
    if path != ROOT / "optloc" / "__init__.py":
        assert not list(violations(path))


def test_formulations_know_nothing_of_optloc():
    foreign = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in files("formulations")
        for line, name in imports(path)
        if name.split(".")[0] not in GROUND
    ]
    assert not foreign


def test_the_test_sees_lazy_and_relative_imports(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    for name in ("types.py", "cli.py", "solve/nlp.py"):
        file = tmp_path / "optloc" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("")
    bad = tmp_path / "optloc" / "types.py"
    bad.write_text("def f():\n    from .solve import nlp\n    from optloc import cli\n    from optloc import fix\n")
    assert [text.split(" imports ")[1] for text in violations(bad)] == ["optloc.solve.nlp", "optloc.cli", "optloc.fix"]
    bad.write_text("import formulations.nls\n")
    assert list(violations(bad))
    good = tmp_path / "optloc" / "solve" / "nlp.py"
    good.write_text("import formulations.nls\nfrom ..types import Rows\nfrom . import nlp\n")
    assert not list(violations(good))

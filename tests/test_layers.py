"""The layers of the house: imports go down only; lazy ones and those for type checking count."""

import ast
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest
from sources import nodes

ROOT = Path(__file__).resolve().parents[1]

# From the ground up; docs/layout.md draws the same picture. A folder imports folders of lower layers alone.
LAYERS = (
    "base",
    "models",
    "problem",
    "linear",
    "kernels",
    "engine",
    "proof bounds model_checks",
    "solvers uncertainty",
    "tracking station_health",
    "files multi_target",
    "show advice",
    "partitions",
    "cli",
    # neighbours, which import the faces of the core only
    "sites plugins",
    "service lab",
)
NEIGHBOURS = {"sites", "plugins", "service", "lab"}
LAYER = {room: floor for floor, rooms in enumerate(LAYERS) for room in rooms.split()}
USERS_OF_FORMULATIONS = {"solvers", "sites"}
BASELINES = {"optloc.lab.study.baselines"}
# clarabel: the back end of cvxpy, whose data a warm solve updates directly; cvxopt, highspy: optional back ends, whose
# adapters call them because cvxpy drops the report of one and cannot silence the other
GROUND = {
    "numpy",
    "scipy",
    "cvxpy",
    "casadi",
    "clarabel",
    "cvxopt",
    "highspy",
    "formulations",
} | sys.stdlib_module_names


def modules(root: Path) -> dict[str, Path]:
    """Return the files of both packages by dotted name."""
    out = {}
    for path in sorted([*(root / "optloc").rglob("*.py"), *(root / "formulations").rglob("*.py")]):
        parts = path.relative_to(root).with_suffix("").parts
        out[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return out


def imports(name: str, path: Path, known: Mapping[str, Path]) -> Iterator[tuple[int, str]]:
    """Yield line and module of everything imported anywhere in a file; a name of a module counts for the module."""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                yield node.lineno, inner if inner in known else source


@cache
def arrows(root: Path) -> list[tuple[str, int, str]]:
    """Return importing module, line and imported module of all imports."""
    known = modules(root)
    return [(name, *found) for name, path in known.items() for found in imports(name, path, known)]


def room(module: str) -> str:
    """Return the folder of a module of optloc, empty for optloc itself, its entry point and all others."""
    parts = module.split(".")
    return parts[1] if parts[0] == "optloc" and len(parts) > 1 and parts[1] != "__main__" else ""


def wrong_arrows(root: Path) -> list[str]:
    """Return a sentence for each import that does not go down."""
    out = []
    for name, line, target in arrows(root):
        here, there = room(name), room(target)
        if not here or here == there:
            continue
        if target.split(".")[0] == "formulations" and here not in USERS_OF_FORMULATIONS and name not in BASELINES:
            out.append(f"{name}:{line} imports {target}: only solvers, placement, calibration and the baselines do")
        if target == "optloc" or (there and LAYER[there] >= LAYER[here]):
            out.append(f"{name}:{line} imports {target}")
    return out


def past_faces(root: Path) -> list[str]:
    """Return a sentence for each import of a neighbour that enters a package of the core past its face."""
    out = []
    for name, path in modules(root).items():
        if room(name) in NEIGHBOURS:
            for node in nodes(path):
                sources = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                sources += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                inner = [source for source in sources if source.startswith("optloc.") and source.count(".") > 1]
                out += [f"{name}:{node.lineno} imports {source}" for source in inner if room(source) not in NEIGHBOURS]
    return out


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Return a circle of a graph, empty if there is none."""
    done: set[str] = set()
    for start in graph:
        trail: list[tuple[str, Iterator[str]]] = [(start, iter(graph[start]))] if start not in done else []
        while trail:
            following = next(trail[-1][1], None)
            if following is None:
                done.add(trail.pop()[0])
            elif following in (open_ := [name for name, _ in trail]):
                return [*open_[open_.index(following) :], following]
            elif following not in done:
                trail.append((following, iter(graph[following])))
    return []


def graph_of(root: Path) -> dict[str, set[str]]:
    known = modules(root)
    out: dict[str, set[str]] = {name: set() for name in known}
    for name, _, target in arrows(root):
        if target in known and target != name:
            out[name].add(target)
    return out


def test_every_folder_has_a_layer():
    assert {room(name) for name in modules(ROOT)} - {""} <= LAYER.keys()


def test_imports_go_down_and_in_no_circle():
    assert not wrong_arrows(ROOT)
    assert not circle(graph_of(ROOT))


def test_neighbours_import_the_faces_of_the_core_only():
    assert not past_faces(ROOT)


def test_an_import_past_a_face_is_seen(tmp_path):
    lines = "from optloc.problem import Fix\nfrom optloc.lab.study import trial\n"
    root = house(
        tmp_path,
        {"optloc/lab/a.py": f"{lines}def f():\n    from optloc.problem.fix import Fix\n    import optloc.base.types\n"},
    )
    assert past_faces(root) == ["optloc.lab.a:4 imports optloc.problem.fix", "optloc.lab.a:5 imports optloc.base.types"]


def test_no_loose_module_except_the_entry_point_of_the_command_line():
    assert [path.name for path in sorted((ROOT / "optloc").glob("*.py"))] == ["__init__.py", "__main__.py"]
    assert {target for name, _, target in arrows(ROOT) if name == "optloc.__main__"} == {"optloc.cli.application"}


# Limits of the contributing guide. A commit that adds a file raises the number of modules, so that each is a decision.
MODULES, LINES, BODY, RECURRING = 623, 600, 60, 20


def test_files_and_functions_are_of_a_size_to_be_read():
    known = modules(ROOT)
    assert len(known) <= MODULES
    assert not [name for name, path in known.items() if path.read_text(encoding="utf-8").count("\n") > LINES]
    long = []
    for name, path in known.items():
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                words = ast.get_docstring(node, clean=False)
                body = node.end_lineno - node.lineno + 1 - (words.count("\n") + 1 if words else 0)
                long += [f"{name}.{node.name}"] if body > BODY else []
    assert not long


def test_a_module_name_stands_for_one_thing():
    """A name recurs only where the folder says what is done with it, as in `cli/track` and `plot/track`."""
    names = Counter(path.stem for path in modules(ROOT).values() if not path.stem.startswith("__"))
    assert len([name for name, count in names.items() if count > 1]) <= RECURRING


def test_no_two_classes_have_one_name():
    found = Counter(
        node.name for path in modules(ROOT).values() for node in nodes(path) if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in found.items() if count > 1] == []


def test_a_module_with_functions_has_its_test_in_the_mirrored_folder():
    """A package that defines functions has the test of its name: `models/__init__.py` has `models/test_models.py`."""
    missing = []
    for name, path in modules(ROOT).items():
        inside = path.relative_to(ROOT).parts
        tree = nodes(path)
        exports = path.name == "__init__.py" and all(
            f.name.startswith("__") for f in tree if isinstance(f, ast.FunctionDef)
        )
        if (
            inside[0] != "optloc"
            or exports
            or not any(isinstance(f, ast.FunctionDef | ast.AsyncFunctionDef) for f in tree)
        ):
            continue
        stem = inside[-2] if path.name == "__init__.py" else path.stem
        if not ROOT.joinpath("tests", *inside[1:-1], f"test_{stem}.py").exists():
            missing.append(name)
    assert missing == []


# Words with one meaning, and the module that may define them: the plan of the engine, and the function that returns a
# problem of optimisation.
RESERVED = {"Plan": "optloc.engine", "pose": "optloc.solvers.posing"}


def test_reserved_words_are_defined_in_one_place():
    kinds = (ast.ClassDef, ast.FunctionDef)
    found = [
        (module, node.name)
        for module, path in modules(ROOT).items()
        for node in nodes(path)
        if isinstance(node, kinds) and node.name in RESERVED
    ]
    wrong = [(module, name) for module, name in found if not module.startswith(RESERVED[name])]
    assert not wrong


def test_formulations_know_nothing_of_optloc():
    foreign = [arrow for arrow in arrows(ROOT) if arrow[0].split(".")[0] == "formulations"]
    assert not [arrow for arrow in foreign if arrow[2].split(".")[0] not in GROUND]


def house(folder: Path, files: Mapping[str, str]) -> Path:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def test_the_test_sees_lazy_relative_and_sideways_imports(tmp_path):
    lazy = "def f():\n    from ..solvers import ipopt\n    from optloc.problem import fix\n    from optloc import cli\n"
    root = house(
        tmp_path,
        {
            "optloc/base/types.py": lazy,
            "optloc/problem/fix.py": "from ..base.types import Array\nfrom . import loss\n",
            "optloc/problem/loss.py": "",
            "optloc/solvers/ipopt.py": "import formulations.nls\nimport optloc\n",
            "optloc/bounds/cramer_rao.py": "import formulations.nls\nfrom optloc.proof.box import Box\n",
            "optloc/cli/__init__.py": "",
            "formulations/nls.py": "",
        },
    )
    assert [text.split(":")[0] + text.split("imports")[1] for text in wrong_arrows(root)] == [
        "optloc.base.types optloc.solvers.ipopt",
        "optloc.base.types optloc.problem.fix",
        "optloc.base.types optloc.cli",
        "optloc.bounds.cramer_rao formulations.nls: only solvers, placement, calibration and the baselines do",
        "optloc.bounds.cramer_rao optloc.proof.box",
        "optloc.solvers.ipopt optloc",
    ]


@pytest.mark.parametrize(
    ("graph", "found"),
    [
        ({"a": {"b"}, "b": {"c"}, "c": set()}, []),
        ({"a": {"b"}, "b": {"c"}, "c": {"b"}}, ["b", "c", "b"]),
        ({"a": {"b", "c"}, "b": {"d"}, "c": {"d"}, "d": set()}, []),
    ],
)
def test_circles_are_seen(graph, found):
    assert circle(graph) == found

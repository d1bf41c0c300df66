"""`import optloc` is quick: heavy libraries load where they are used."""

import ast
import subprocess
import sys
from pathlib import Path

HEAVY = "cvxpy casadi numba pandas matplotlib scipy.stats pymap3d pydantic typer".split()


def test_import_loads_no_heavy_library():
    code = f"import optloc, sys; print(*sorted(set({HEAVY}) & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert loaded == []


def test_import_loads_no_solver():
    code = "import optloc, sys; print(*(name for name in sys.modules if name.startswith(('optloc.solvers', 'scipy'))))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == []


def test_what_loads_late_is_what_types_are_checked_by():
    import optloc

    tree = ast.parse(Path(optloc.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    told = {name.asname for node in block.body if isinstance(node, ast.ImportFrom) for name in node.names}
    assert told == set(optloc.__all__)
    assert all(getattr(optloc, name) is not None for name in optloc.__all__)


def test_the_help_waits_for_no_schema():
    heavy = {"pydantic", "optloc.files.schema", "matplotlib", "pandas"}
    code = f"import optloc.cli.application, sys; print(*sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""

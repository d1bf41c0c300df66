"""`import optloc` is quick: heavy libraries load where they are used."""

import subprocess
import sys

HEAVY = "cvxpy casadi numba pandas matplotlib scipy.stats pymap3d pydantic typer".split()


def test_import_loads_no_heavy_library():
    code = f"import optloc, sys; print(*sorted(set({HEAVY}) & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert loaded == []

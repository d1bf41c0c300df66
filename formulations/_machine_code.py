"""Functions of a nonlinear program as machine code, made by the C compiler of the system where there is one.

Source: J. A. E. Andersson et al., "CasADi", Math. Program. Comput. 11 (2019), section 5 (code generation).
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

_COMPILERS = ("cc", "gcc", "clang")
_PATIENCE = 600.0  # seconds; large programs are long source


def library_solver(name: str, solver: Any, options: dict[str, Any]) -> Any:
    """Build a nonlinear solver again with its functions compiled.

    Parameters
    ----------
    name : str
        CasADi's name of the solver, for instance ``"ipopt"``.
    solver : casadi.Function
        The solver with interpreted functions.
    options : dict
        Its options.

    Returns
    -------
    casadi.Function or None
        The same solver on machine code; None where there is no compiler or it fails.
    """
    import casadi as ca

    compiler = next((found for found in map(shutil.which, _COMPILERS) if found), None)
    if compiler is None:
        return None
    generator = ca.CodeGenerator("program.c")
    generator.add(solver.oracle())
    for part in solver.get_function():
        generator.add(solver.get_function(part))
    with tempfile.TemporaryDirectory(prefix="casadi", ignore_cleanup_errors=True) as folder:
        source, library = Path(folder) / "program.c", Path(folder) / "program.so"
        source.write_text(generator.dump(), encoding="utf-8")
        command = [compiler, "-O1", "-shared", "-fPIC", str(source), "-o", str(library), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_PATIENCE)  # noqa: S603  (no shell)
            # what is loaded stays when its file is gone
            return ca.nlpsol("nls", name, str(library), options)
        except (subprocess.SubprocessError, OSError, RuntimeError):
            return None

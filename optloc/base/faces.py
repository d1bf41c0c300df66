"""Lazy public names of a package: each name loads at its first use.

The ``__init__`` of a package lists its public names once, as imports for type checkers. `exported` reads this list.
Therefore ``import optloc`` loads neither solvers nor tables.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

Exported = tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]


def exported(package: str, file: str) -> Exported:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    Parameters
    ----------
    package, file : str
        ``__name__`` and ``__file__`` of the package. All imports under ``if TYPE_CHECKING:`` of the file are exported.
    """
    origin_of = dict(_imports(ast.parse(Path(file).read_text(encoding="utf-8"))))
    names = sorted(origin_of)

    def find(name: str) -> Any:
        """Return the public object of this name and store it in the package; Python calls it for missing attributes."""
        if name not in origin_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, original = origin_of[name]
        if module == package:
            return import_module(f"{package}.{original}")
        try:
            value = getattr(import_module(module), original)
        except AttributeError:
            value = import_module(f"{module}.{original}")
        setattr(sys.modules[package], name, value)
        return value

    return find, lambda: names, names


def _imports(tree: ast.Module) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield the public name, the module and the original name of each import for type checkers."""
    for block in tree.body:
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            for line in block.body:
                if isinstance(line, ast.ImportFrom) and line.module:
                    for alias in line.names:
                        yield alias.asname or alias.name, (line.module, alias.name)

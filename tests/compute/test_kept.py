"""Machine code on disk is that of the sources that are there: also where only what a kernel calls was edited."""

import ast
import importlib
import os
import subprocess
import sys
import types
from functools import cache
from pathlib import Path

import pytest

from optloc.compute import kept, manifest
from optloc.compute.jit import _KERNELS, enabled

pytestmark = pytest.mark.skipif(not enabled(), reason="without numba there is no machine code")

CALLER = """
from callee import level

from optloc.compute.jit import compiled


@compiled
def answer(x):
    return level(x) + 1
"""
CALLEE = """
from optloc.compute.jit import compiled


@compiled
def level(x):
    return x + {step}
"""
ASK = """
import caller
from numba.core import event

with event.install_recorder("numba:compile") as made:
    said = caller.answer(0)
print(said, len(made.buffer) // 2, caller.answer.machine._cache.cache_path)
"""


def asked(folder: Path, **environment: str) -> tuple[int, int, Path]:
    """Return the answer of a small package, how many functions were compiled for it, and where they are kept."""
    # Without bytecode: a file that is written twice in a second would be taken for what was read before.
    path = {"PYTHONPATH": f"{folder}{os.pathsep}{Path(kept.__file__).parents[2]}", "PYTHONDONTWRITEBYTECODE": "1"}
    everything = {**os.environ, **path, **environment}
    done = subprocess.run([sys.executable, "-c", ASK], env=everything, capture_output=True, text=True, check=True)
    said, count, place = done.stdout.split()
    return int(said), int(count), Path(place)


def test_an_edited_callee_renews_its_callers_and_damage_is_made_good(tmp_path):
    (tmp_path / "caller.py").write_text(CALLER)
    cache = str(tmp_path / "cache")
    place = Path(cache, manifest.of_this_process().name)
    for step, damaged, compiled in ((1, False, 2), (1, False, 0), (1, True, 1), (2, False, 2)):
        (tmp_path / "callee.py").write_text(CALLEE.format(step=step))
        for file in place.glob("caller.answer-*.nbc") if damaged else ():
            file.write_bytes(file.read_bytes()[:100])
        assert asked(tmp_path, NUMBA_CACHE_DIR=cache) == (step + 1, compiled, place)


def test_every_source_counts(tmp_path, monkeypatch):
    for name in manifest.SOURCES:
        source, copy = manifest.PACKAGE / name, tmp_path / name
        for file in [source] if source.is_file() else source.rglob("*.py"):
            target = copy if source.is_file() else copy / file.relative_to(source)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    monkeypatch.setattr(manifest, "PACKAGE", tmp_path)
    made = manifest.sources_digest.__wrapped__
    seen = {manifest.sources_digest(), made()}
    assert len(seen) == 1  # the same sources at another place
    for file in sorted(tmp_path.rglob("*.py")):
        file.write_bytes(file.read_bytes() + b"#")
        seen.add(made())
    assert len(seen) == 1 + len(list(tmp_path.rglob("*.py"))) > 30


@cache
def imported(module: str) -> dict[str, str]:
    """Return the module that each name of a module was imported from."""
    tree = ast.parse(Path(sys.modules[module].__file__).read_text(encoding="utf-8"))
    found = [(node, alias) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names]
    return {alias.asname or alias.name: node.module for node, alias in found}


def test_what_kernels_name_stands_in_the_sources():
    """A constant from elsewhere would be part of machine code that does not change with it."""
    for module in ("compute.refine", "compute.range_fixes", "proof.best_first", "proof.batch", "placement.completions"):
        importlib.import_module(f"optloc.{module}")
    inside = tuple("optloc." + name.replace("/", ".").removesuffix(".py") for name in manifest.SOURCES)
    libraries = ("math", "numpy", "heapq", "typing")
    origins = {}
    for kernel in _KERNELS:
        module = kernel.function.__module__
        if not module.startswith("optloc."):
            continue
        assert module.startswith(inside), module
        origin = origins.setdefault(module, imported(module))
        for name in names(kernel.function.__code__):
            assert origin.get(name, module).startswith((*inside, *libraries)), (module, name)
    assert len(origins) > 15


def names(code: types.CodeType) -> set[str]:
    """Return all global names of a function, and of those inside."""
    inner = [names(part) for part in code.co_consts if isinstance(part, types.CodeType)]
    return set(code.co_names).union(*inner)


def test_old_folders_leave_but_for_the_last_used(tmp_path):
    for age in range(8):
        folder = tmp_path / f"optloc-{age}"
        folder.mkdir()
        os.utime(folder, (1e9 - age, 1e9 - age))
    (tmp_path / "other").mkdir()
    kept._clear(tmp_path / "optloc-7")
    assert sorted(path.name for path in tmp_path.iterdir()) == [*(f"optloc-{age}" for age in (0, 1, 2, 3, 7)), "other"]

"""Machine code on disk is that of the sources that are there: also where only what a kernel calls was edited."""

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from optloc.kernels import code_cache, manifest
from optloc.kernels.jit import enabled

pytestmark = pytest.mark.skipif(not enabled(), reason="without numba there is no machine code")

CALLER = """
from callee import level

from optloc.kernels.jit import compiled


@compiled
def answer(x):
    return level(x) + 1
"""
CALLEE = """
from optloc.kernels.jit import compiled


@compiled
def level(x):
    return x + {step}
"""
# Each answer comes from a fork, which has imported neither file: what takes seconds, numba, is begun once for all.
ASK = """
import os
import sys

import numba
from numba.core import event

import optloc.kernels.jit

numba.njit(lambda x: x + 1)(0)
for line in sys.stdin:
    child = os.fork()
    if not child:
        try:
            import caller

            with event.install_recorder("numba:compile") as made:
                said = caller.answer(0)
            print(said, len(made.buffer) // 2, caller.answer.machine._cache.cache_path, flush=True)
        finally:
            os._exit(0)
    os.waitpid(child, 0)
"""
forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")


@contextmanager
def asking(folder: Path, **environment: str) -> Iterator[Callable[[], tuple[int, int, Path]]]:
    """Yield a function with the answer of a small package, how much was compiled for it, and where it is kept."""
    # Without bytecode: a file that is written twice in a second would be taken for what was read before.
    path = {"PYTHONPATH": f"{folder}{os.pathsep}{Path(code_cache.__file__).parents[2]}", "PYTHONDONTWRITEBYTECODE": "1"}
    everything, pipe = {**os.environ, **path, **environment}, subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", ASK], env=everything, stdin=pipe, stdout=pipe, text=True) as process:

        def asked() -> tuple[int, int, Path]:
            process.stdin.write("\n")
            process.stdin.flush()
            said, count, place = process.stdout.readline().split()
            return int(said), int(count), Path(place)

        try:
            yield asked
        finally:
            process.kill()


@forks
def test_an_edited_callee_renews_its_callers_and_damage_is_made_good(tmp_path):
    (tmp_path / "caller.py").write_text(CALLER)
    cache, callees = tmp_path / "cache", tmp_path / "callees"
    place = cache / manifest.of_this_process().name
    with asking(tmp_path, NUMBA_CACHE_DIR=str(cache), OPTLOC_CALLEES=str(callees)) as asked:
        for text, damaged, answer, compiled in (
            (CALLEE.format(step=1), False, 2, 2),
            (CALLEE.format(step=1), False, 2, 0),
            (CALLEE.format(step=1), True, 2, 1),  # the callee is kept, too
            (f"# A comment moves all lines.\n{CALLEE.format(step=1)}\n\ndef unused():\n    return 1\n", False, 2, 0),
            (CALLEE.format(step=2), False, 3, 2),
            (CALLEE.format(step=1), False, 2, 0),  # the version before is kept
        ):
            (tmp_path / "callee.py").write_text(text)
            for file in place.glob("caller.answer-*.nbc") if damaged else ():
                file.write_bytes(file.read_bytes()[:100])
            assert asked() == (answer, compiled, place)
    assert len(list(callees.glob("callee.level-*.nbi"))) == 2
    assert not list(place.glob("*level*"))


@forks
def test_a_damaged_index_is_made_again(tmp_path):
    """As one that names a class under the name of a module that it no longer has."""
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "callee.py").write_text(CALLEE.format(step=1))
    more = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "OPTLOC_CALLEES": str(tmp_path / "callees")}
    with asking(tmp_path, **more) as asked:
        _, _, place = asked()
        index = next(place.glob("caller.answer-*.nbi"))
        version = pickle.dumps(pickle.load(index.open("rb")))
        index.write_bytes(version + b"cno_such_module\nNoSuchClass\n.")
        assert asked()[:2] == (2, 1)
        assert asked()[:2] == (2, 0)


@forks
def test_users_keep_no_callees(tmp_path):
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "callee.py").write_text(CALLEE.format(step=1))
    with asking(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"), OPTLOC_CALLEES="") as asked:
        _, _, place = asked()
    assert bool(list(place.rglob("callee.*.nbi"))) == code_cache.is_checkout()
    assert list(place.glob("caller.answer-*.nbi"))


def test_old_versions_of_a_function_leave_but_for_the_newest(tmp_path):
    for name in ("f.g", "f.gg"):
        for age in range(8):
            for ending in (".nbi", ".1.nbc", ".2.nbc"):
                file = tmp_path / f"{code_cache.file_prefix_of(name, f'{age:016}')}{ending}"
                file.touch()
                os.utime(file, (1e9 - age, 1e9 - age))
    code_cache._leave_last(tmp_path, "f.g", code_cache.file_prefix_of("f.g", f"{7:016}"))
    left = sorted(path.stem for path in tmp_path.glob("f.g-*.nbi"))
    assert left == [code_cache.file_prefix_of("f.g", f"{age:016}") for age in (0, 1, 2, 7)]
    assert len(list(tmp_path.glob("f.g-*.nbc"))) == 2 * len(left)
    assert len(list(tmp_path.glob("f.gg-*.nbi"))) == 8


def test_old_folders_leave_but_for_the_last_used(tmp_path):
    for age in range(8):
        folder = tmp_path / f"optloc-{age}"
        folder.mkdir()
        os.utime(folder, (1e9 - age, 1e9 - age))
    (tmp_path / "other").mkdir()
    code_cache._clear(tmp_path / "optloc-7")
    assert sorted(path.name for path in tmp_path.iterdir()) == [*(f"optloc-{age}" for age in (0, 1, 2, 3, 7)), "other"]

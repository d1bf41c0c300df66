"""What ``optloc compile --wheel`` does: pack the machine code of all kernels for other computers of this platform."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from platform import machine
from shutil import copyfile
from sysconfig import get_platform
from tempfile import TemporaryDirectory

import typer

from optloc.base.errors import InvalidProblem
from optloc.cli.compile import environment, make
from optloc.cli.output import dumps, meter
from optloc.kernels.code_cache import files_of, folder
from optloc.kernels.jit import enabled, named, names_in
from optloc.kernels.manifest import FILE, INSTALLED, is_chosen, of_this_process

# What wheels are made for: processors of the last ten years. The same bits come out on all of them, since no kernel has
# its sums put in another order for the sake of wide registers.
_COMMON = {
    "x86_64": (
        "x86-64-v3",
        "avx avx2 bmi bmi2 cx16 f16c fma fxsr lzcnt mmx movbe popcnt sahf sse sse2 sse3 sse4.1 sse4.2 ssse3 xsave",
    )
}
# Where a wheel was installed and used: elsewhere it may work as well.
_VERIFIED = ("linux-x86_64",)


def run_wheel(out: Path, *, quiet: bool = False) -> int:
    """Compile all kernels for processors of a sort, pack them as a wheel and print its name; return the exit code."""
    if not enabled():
        raise InvalidProblem("numba is not installed, or switched off", "--wheel", "there is no machine code to pack")
    chosen = _COMMON.get(machine())
    if not is_chosen() and chosen is not None:
        # numba takes its processor when it is imported
        with TemporaryDirectory() as cache:
            features = ",".join("+" + word for word in chosen[1].split())
            more = environment(NUMBA_CPU_NAME=chosen[0], NUMBA_CPU_FEATURES=features, NUMBA_CACHE_DIR=cache)
            words = [sys.executable, "-P", "-m", "optloc.cli", "compile", "--wheel", str(out)]
            return subprocess.run(words + ["-q"] * quiet, env=more, check=False).returncode  # noqa: S603
    place = folder()
    if place is None:
        raise InvalidProblem("no folder can be written", "NUMBA_CACHE_DIR", "name one")
    with meter("making machine code", quiet) as tell:
        left = make(tell)
    if left:
        raise InvalidProblem(f"{len(left)} kernels could not be compiled", "--wheel", "see what stands above")
    made = pack(place, out)
    typer.echo(str(made))
    if get_platform() not in _VERIFIED:
        typer.echo(f"not verified on {get_platform()}: try it before you hand it on", err=True)
    return 0


def pack(place: Path, out: Path) -> Path:
    """Pack machine code as a wheel of the distribution ``optloc-kernels``.

    Parameters
    ----------
    place : Path
        The folder that holds it, of this process' sources and processor.
    out : Path
        Folder of the wheel, made where it is not there.

    Returns
    -------
    Path
        The wheel: for this version of Python and this platform, with optloc, numba and llvmlite of these versions.

    Raises
    ------
    InvalidProblem
        Where the library `wheel` is missing, or the folder cannot be written.
    """
    if find_spec("wheel") is None:
        raise InvalidProblem("wheels are packed by the library wheel", "--wheel", "pip install 'optloc[wheel]'")
    number, tag = version("optloc"), f"cp{sys.version_info[0]}{sys.version_info[1]}"
    manifest = of_this_process()
    about = [
        "Metadata-Version: 2.1",
        "Name: optloc-kernels",
        f"Version: {number}",
        f"Summary: Machine code of optloc for {manifest.processor}",
        f"Requires-Dist: optloc=={number}",
        f"Requires-Dist: numba=={manifest.numba}",
        f"Requires-Dist: llvmlite=={manifest.llvmlite}",
    ]
    platform = get_platform().replace("-", "_").replace(".", "_")
    told = ["Wheel-Version: 1.0", "Generator: optloc", "Root-Is-Purelib: false", f"Tag: {tag}-{tag}-{platform}"]
    with TemporaryDirectory() as folder_:
        root = Path(folder_)
        inside, info = root / INSTALLED, root / f"optloc_kernels-{number}.dist-info"
        inside.mkdir()
        info.mkdir()
        for file in (file for name in names_in("optloc") for file in files_of(named(name), place)):
            copyfile(file, inside / file.name)
        (inside / FILE).write_text(dumps(manifest._asdict()), encoding="utf-8")
        (info / "METADATA").write_text("\n".join(about) + "\n", encoding="utf-8")
        (info / "WHEEL").write_text("\n".join(told) + "\n", encoding="utf-8")
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidProblem(f"the folder cannot be made ({error.strerror})", str(out), "name another") from None
        words = [sys.executable, "-P", "-m", "wheel", "pack", str(root), "--dest-dir", str(out)]
        done = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise InvalidProblem(f"the wheel could not be packed ({done.stderr.strip()[-200:]})", str(out), "name another")
    return out / f"optloc_kernels-{number}-{tag}-{tag}-{platform}.whl"

"""The option ``optloc compile --wheel``: pack the machine code of all kernels for other computers of this platform."""

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

# Target processor of wheels: processors of the last ten years. All of them compute the same bits, since no kernel
# reorders its sums for wider registers.
_COMMON = {
    "x86_64": (
        "x86-64-v3",
        "avx avx2 bmi bmi2 cx16 f16c fma fxsr lzcnt mmx movbe popcnt sahf sse sse2 sse3 sse4.1 sse4.2 ssse3 xsave",
    )
}
# Platforms on which a wheel was installed and used; it may work on others as well.
_VERIFIED = ("linux-x86_64",)


def run_wheel(out: Path, *, quiet: bool = False) -> int:
    """Compile all kernels for a common processor, pack them as a wheel and print its path; return the exit code."""
    if not enabled():
        raise InvalidProblem("numba is not installed, or disabled", "--wheel", "install or enable numba")
    # If no processor is chosen yet, run this command again in a new process for the common processor.
    chosen = _COMMON.get(machine())
    if not is_chosen() and chosen is not None:
        # numba reads the processor at import, so a new process is needed
        with TemporaryDirectory() as cache:
            features = ",".join("+" + word for word in chosen[1].split())
            more = environment(NUMBA_CPU_NAME=chosen[0], NUMBA_CPU_FEATURES=features, NUMBA_CACHE_DIR=cache)
            words = [sys.executable, "-P", "-m", "optloc.cli", "compile", "--wheel", str(out)]
            return subprocess.run(words + ["-q"] * quiet, env=more, check=False).returncode  # noqa: S603
    place = folder()
    if place is None:
        raise InvalidProblem("no folder is writable", "NUMBA_CACHE_DIR", "set it to a writable folder")
    with meter("making machine code", quiet) as tell:
        failed = make(tell)
    if failed:
        raise InvalidProblem(f"{len(failed)} kernels could not be compiled", "--wheel", "see the errors above")
    made = pack(place, out)
    typer.echo(str(made))
    if get_platform() not in _VERIFIED:
        typer.echo(f"not verified on {get_platform()}: test the wheel before you distribute it", err=True)
    return 0


def pack(place: Path, out: Path) -> Path:
    """Pack machine code as a wheel of the distribution ``optloc-kernels`` and return its path.

    `place` is the folder of the machine code of these sources and this processor. `out` is the folder of the wheel; it
    is created if missing. The wheel requires this version of Python, this platform, and these versions of optloc, numba
    and llvmlite. Raise InvalidProblem if the library `wheel` is missing or the folder is not writable.
    """
    if find_spec("wheel") is None:
        raise InvalidProblem("packing needs the library wheel", "--wheel", "pip install 'optloc[wheel]'")
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
    wheel_lines = ["Wheel-Version: 1.0", "Generator: optloc", "Root-Is-Purelib: false", f"Tag: {tag}-{tag}-{platform}"]
    with TemporaryDirectory() as folder_:
        root = Path(folder_)
        inside, info = root / INSTALLED, root / f"optloc_kernels-{number}.dist-info"
        inside.mkdir()
        info.mkdir()
        for file in (file for name in names_in("optloc") for file in files_of(named(name), place)):
            copyfile(file, inside / file.name)
        (inside / FILE).write_text(dumps(manifest._asdict()), encoding="utf-8")
        (info / "METADATA").write_text("\n".join(about) + "\n", encoding="utf-8")
        (info / "WHEEL").write_text("\n".join(wheel_lines) + "\n", encoding="utf-8")
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidProblem(
                f"the folder cannot be created ({error.strerror})", str(out), "use another folder"
            ) from None
        words = [sys.executable, "-P", "-m", "wheel", "pack", str(root), "--dest-dir", str(out)]
        done = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise InvalidProblem(
            f"the wheel could not be packed ({done.stderr.strip()[-200:]})", str(out), "use another folder"
        )
    return out / f"optloc_kernels-{number}-{tag}-{tag}-{platform}.whl"

"""What machine code is made by and made for: compilers and a processor; and such code that was installed."""

from __future__ import annotations

import json
import logging
import sys
from functools import cache
from hashlib import sha256
from importlib.metadata import distribution, version
from pathlib import Path
from typing import Any, NamedTuple, cast

PACKAGE = Path(__file__).resolve().parents[1]
"""The folder of optloc."""

# How kernels are compiled. Their own code is known by digests of each (`optloc.kernels.digests`).
COMPILERS = ("kernels/no_refcount_pass.py", "kernels/compilation.py")

PREFIX = "optloc-"
"""How the names of folders of machine code begin."""

INSTALLED, FILE = "optloc_kernels", "manifest.json"
"""The folder that the distribution ``optloc-kernels`` installs, and the file in it that says what for."""

_LOG = logging.getLogger("optloc")


@cache
def compiler_digest() -> str:
    """Return the digest of the files that say how kernels are compiled."""
    return sha256(b"".join((PACKAGE / name).read_bytes() for name in COMPILERS)).hexdigest()


class Manifest(NamedTuple):
    """The compilers of machine code, and its processor.

    Parameters
    ----------
    compiler : str
        Digest of the options and of the pipeline for numba.
    python, numba, llvmlite : str
        Versions; of Python the first two numbers.
    triple, processor, features : str
        As numba tells them, features with a sign before each and a comma between two.
    """

    compiler: str
    python: str
    numba: str
    llvmlite: str
    triple: str
    processor: str
    features: str

    @property
    def name(self) -> str:
        """Return what such code is kept under."""
        made = (self.compiler, self.numba, self.llvmlite, self.triple, self.processor, self.features)
        return PREFIX + sha256("\n".join(made).encode()).hexdigest()[:16]

    @property
    def needed(self) -> set[str]:
        """Return the features that a processor must have."""
        return {word[1:] for word in self.features.split(",") if word.startswith("+")}

    def misfit(self, here: Manifest) -> str:
        """Return what of this process the code was not made for; empty where it fits."""
        for key in ("compiler", "python", "numba", "llvmlite", "triple"):
            if getattr(self, key) != getattr(here, key):
                return f"{key} {getattr(self, key)}"
        lacking = sorted(self.needed - here.needed)
        return f"a processor with {', '.join(lacking)}" if lacking else ""


@cache
def of_this_process() -> Manifest:
    """Return what numba makes machine code of and for in this process."""
    from llvmlite import binding
    from numba.core import codegen, config

    llvm, made, settings = cast("tuple[Any, Any, Any]", (binding, codegen, config))  # without types
    name, features = settings.CPU_NAME, settings.CPU_FEATURES
    return Manifest(
        compiler_digest(),
        f"{sys.version_info[0]}.{sys.version_info[1]}",
        version("numba"),
        version("llvmlite"),
        llvm.get_process_triple(),
        llvm.get_host_cpu_name() if name is None else name,
        made.get_host_cpu_features() if features is None else features,
    )


def is_chosen() -> bool:
    """Return whether somebody has chosen what processor code is made for, by NUMBA_CPU_NAME."""
    from numba.core import config

    settings: Any = config  # without types
    return settings.CPU_NAME is not None


@cache
def installed() -> tuple[Path, Manifest] | None:
    """Return the folder and the manifest of machine code that was installed, if it fits this process.

    It lies beside numba: entries are pickles, which nobody may read from where others could write.
    """
    try:
        place = Path(str(distribution("numba").locate_file(INSTALLED)))
        found = Manifest(**json.loads((place / FILE).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        _LOG.warning("the manifest of optloc-kernels cannot be read (%r); machine code is made here", error)
        return None
    why = "another one, which NUMBA_CPU_NAME names" if is_chosen() else found.misfit(of_this_process())
    if why:
        _LOG.info("optloc-kernels was made for %s; machine code is made here", why)
        return None
    return place, found

"""The compilers and the processor that machine code depends on, and machine code that was installed."""

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
"""The folder of the package optloc."""

# Files that define how kernels are compiled. The code of kernels has separate digests (`optloc.kernels.digests`).
COMPILERS = ("kernels/no_refcount_pass.py", "kernels/compilation.py")

PREFIX = "optloc-"
"""Start of the names of folders with machine code."""

INSTALLED, FILE = "optloc_kernels", "manifest.json"
"""The folder that the distribution ``optloc-kernels`` installs, and the file with its `Manifest`."""

_LOG = logging.getLogger("optloc")


@cache
def compiler_digest() -> str:
    """Return the digest of the files that define how kernels are compiled."""
    return sha256(b"".join((PACKAGE / name).read_bytes() for name in COMPILERS)).hexdigest()


class Manifest(NamedTuple):
    """The compilers and the processor of machine code.

    Parameters
    ----------
    compiler : str
        Digest of the options and of the pipeline for numba.
    python, numba, llvmlite : str
        Versions; of Python only the first two numbers.
    triple, processor, features : str
        Target triple, processor name and features, as in numba: each feature with a sign, separated by commas.
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
        """Return the name of the folder for this machine code."""
        made = (self.compiler, self.numba, self.llvmlite, self.triple, self.processor, self.features)
        return PREFIX + sha256("\n".join(made).encode()).hexdigest()[:16]

    @property
    def needed(self) -> set[str]:
        """Return the features that a processor must have."""
        return {word[1:] for word in self.features.split(",") if word.startswith("+")}

    def misfit(self, here: Manifest) -> str:
        """Return the first property in which this machine code does not fit the process `here`; "" if it fits.

        The result is a part of a log message, such as "python 3.12".
        """
        for key in ("compiler", "python", "numba", "llvmlite", "triple"):
            if getattr(self, key) != getattr(here, key):
                return f"{key} {getattr(self, key)}"
        lacking = sorted(self.needed - here.needed)
        return f"a processor with {', '.join(lacking)}" if lacking else ""


@cache
def of_this_process() -> Manifest:
    """Return the compilers and the processor for which numba compiles in this process."""
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
    """Return whether NUMBA_CPU_NAME selects the processor to compile for."""
    from numba.core import config

    settings: Any = config  # without types
    return settings.CPU_NAME is not None


@cache
def installed() -> tuple[Path, Manifest] | None:
    """Return the folder and the manifest of installed machine code, if it fits this process; else None.

    The folder is next to numba. Its entries are pickles, which must not be read from a folder that others can write.
    """
    try:
        place = Path(str(distribution("numba").locate_file(INSTALLED)))
        found = Manifest(**json.loads((place / FILE).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        _LOG.warning("cannot read the manifest of optloc-kernels (%r); machine code is compiled here", error)
        return None
    why = "another processor than the one in NUMBA_CPU_NAME" if is_chosen() else found.misfit(of_this_process())
    if why:
        _LOG.info("optloc-kernels was built for %s; machine code is compiled here", why)
        return None
    return place, found

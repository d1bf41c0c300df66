"""Extensions of the command line by neighbour packages: commands, lists, pictures, kernels and facts of the machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import typer

Rows = list[dict[str, str]]

NEIGHBOURS = ("optloc.sites", "optloc.service", "optloc.lab")
"""Packages outside the core. Each has a module ``extension`` with an `Extension`; a missing package adds nothing."""


@dataclass(frozen=True, slots=True)
class PictureRequest:
    """A request to draw a problem or a study.

    Parameters
    ----------
    file : Path
        Problem file, or folder of a study.
    out : Path
        Picture file to write.
    method : str
        Method of the fix.
    epoch : str, optional
        Label of the epoch, or the case of a study.
    """

    file: Path
    out: Path
    method: str
    epoch: str | None


@dataclass(frozen=True, slots=True)
class KernelPart:
    """A group of kernels that one process compiles.

    summary: title. package: package of the kernels. works: calls that compile them. entries: names of the kernels that
    Python calls.
    """

    summary: str
    package: str
    works: tuple[Callable[[], None], ...]
    entries: tuple[str, ...]

    def missing(self) -> list[str]:
        """Return the kernels without machine code on disk."""
        from optloc.kernels.code_cache import is_cached
        from optloc.kernels.jit import named

        return [name for name in self.entries if not is_cached(named(name))]


@dataclass(frozen=True, slots=True)
class Extension:
    """The additions of one neighbour.

    Parameters
    ----------
    commands : callable
        Adds commands to the application. It must not import heavy libraries.
    lists : mapping
        Rows of ``optloc list NAME``.
    pictures : mapping
        Drawings of ``optloc plot NAME``.
    kernels : callable
        Returns kernels for ``optloc compile``.
    facts : mapping
        Facts of this machine for ``optloc doctor``, by name.
    """

    commands: Callable[[typer.Typer], None]
    lists: Mapping[str, Callable[[], Rows]] = field(default_factory=dict)
    pictures: Mapping[str, Callable[[PictureRequest], None]] = field(default_factory=dict)
    kernels: Callable[[], Mapping[str, KernelPart]] = dict
    facts: Mapping[str, Callable[[], dict[str, Any]]] = field(default_factory=dict)


@cache
def extensions() -> tuple[Extension, ...]:
    """Return the extensions of the installed neighbours."""
    return tuple(_found())


def _found() -> Iterator[Extension]:
    """Yield the extension of each neighbour that is installed."""
    for name in NEIGHBOURS:
        if find_spec(name) is not None:
            yield import_module(f"{name}.extension").EXTENSION

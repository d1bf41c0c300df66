"""Tables that others extend by entry points: a package names its group and what it adds, and nothing here changes."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

from optloc.base.errors import InvalidProblem

T = TypeVar("T")


class Registry(MutableMapping[str, T]):
    """A table by name, of what optloc has and of what installed packages add.

    The entry points are read when a name is asked for that optloc does not have, or when all names are: that costs some
    ten milliseconds. An entry point that cannot be used is left out with a warning that names its package.

    Parameters
    ----------
    group : str
        Group of the entry points, for instance "optloc.models".
    fits : callable
        Whether an object may stand in the table.
    own : dict
        What optloc has. No package replaces it.
    derived : callable, optional
        Returns entries that follow from other tables, for names that stand nowhere else.
    """

    __slots__ = ("_derived", "_fits", "_found", "_group", "_own")

    def __init__(
        self,
        group: str,
        fits: Callable[[Any], bool],
        own: dict[str, T],
        derived: Callable[[], Mapping[str, T]] | None = None,
    ) -> None:
        self._group, self._fits, self._own, self._derived = group, fits, own, derived or dict
        self._found: dict[str, T] | None = None

    # What optloc has is found without looking for entry points, which takes some ten milliseconds.
    def __getitem__(self, name: str) -> T:
        if name in self._own:
            return self._own[name]
        return self._added[name] if name in self._added else self._derived()[name]

    def __setitem__(self, name: str, value: T) -> None:
        self._own[name] = value

    def __delitem__(self, name: str) -> None:
        del self._own[name]

    def __iter__(self) -> Iterator[str]:
        yield from {**self._own, **self._added, **self._derived()}

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._group!r}: {', '.join(self)})"

    def forget(self) -> None:
        """Look for entry points anew at the next use: for a package that was installed meanwhile."""
        self._found = None

    @property
    def _added(self) -> dict[str, T]:
        if self._found is None:
            self._found = {}  # a package may look at the table while it is loaded
            for entry in entry_points(group=self._group):
                self._take(entry, self._found)
        return self._found

    def _take(self, entry: EntryPoint, found: dict[str, T]) -> None:
        """Put what an entry point names among what was found, or say why not."""
        # No package replaces what optloc has, nor what another package added first.
        if entry.name in self._own or entry.name in found:
            self._refuse(entry, f"the name {entry.name!r} is taken")
            return
        try:
            value = entry.load()
        except Exception as error:  # noqa: BLE001  # whatever it is that a foreign package raises
            self._refuse(entry, f"{entry.value} does not load: {type(error).__name__}: {error}")
            return
        if self._fits(value):
            found[entry.name] = cast("T", value)
        else:
            self._refuse(entry, f"{entry.value} is {type(value).__name__}, which does not belong there")

    def _refuse(self, entry: EntryPoint, why: str) -> None:
        package = "an unnamed package" if entry.dist is None else f"the package {entry.dist.name!r}"
        what = f"{package} adds nothing to {self._group} as {entry.name!r}: {why}"
        warnings.warn(what, RuntimeWarning, stacklevel=2)


# Plugins that somebody names on a command line: with entry points the only ways in which foreign code comes in.

_PLUGINS: list[str] = []


def plugins() -> tuple[str, ...]:
    """Return the plugins that were loaded by name: what another process needs to know the same."""
    return tuple(_PLUGINS)


def load_plugin(name: str) -> None:
    """Run a Python file or module that adds to the tables, such as ``optloc.models.MODELS["mine"] = ...``, once.

    Parameters
    ----------
    name : str
        Path of a file that ends in .py, or name of an installed module. It may do whatever Python can: it must come
        from the user, never from a file that is read.

    Raises
    ------
    InvalidProblem
        Where there is none, or it fails; with what it says.
    """
    path, known = Path(name), _known(name)
    if known in _PLUGINS:
        return
    try:
        if path.suffix == ".py":
            _run_file(path.resolve())
        else:
            importlib.import_module(name)
    except Exception as error:
        what = f"the plugin cannot be loaded ({type(error).__name__}: {error})"
        raise InvalidProblem(what, name, "give a file that ends in .py, or the name of an installed module") from error
    _PLUGINS.append(known)


def plugin_module(name: str) -> ModuleType | None:
    """Return a plugin that was loaded, by the name that it was loaded by; None where there is none."""
    known = _known(name)
    if known not in _PLUGINS:
        return None
    return sys.modules.get(_key(Path(known)) if known.endswith(".py") else known)


def _known(name: str) -> str:
    return str(Path(name).resolve()) if name.endswith(".py") else name


def _key(path: Path) -> str:
    return f"optloc plugin {path}"


def _run_file(path: Path) -> None:
    # By its path: two plugins may have one file name, and neither hides a module of that name.
    key = _key(path)
    found = importlib.util.spec_from_file_location(key, path)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[key] = module  # what it defines can then be pickled by name
    try:
        found.loader.exec_module(module)
    except BaseException:
        del sys.modules[key]
        raise

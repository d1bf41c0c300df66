"""Tables that other packages can extend through entry points, without a change in optloc."""

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
    """A table by name: the entries of optloc and of installed packages.

    Entry points are read at the first request for a name that optloc does not have, or for all names. This takes about
    ten milliseconds. An entry point that cannot be used is ignored, with a warning that names its package.

    Parameters
    ----------
    group : str
        Group of the entry points, for instance "optloc.models".
    fits : callable
        Function that returns whether an object is a valid entry.
    own : dict
        Entries of optloc. Other packages cannot replace them.
    derived : callable, optional
        Function that returns further entries, computed from other tables, for names that are in neither table.
    """

    __slots__ = ("_derived", "_fits", "_found", "_group", "_own")

    def __init__(
        self,
        group: str,
        fits: Callable[[Any], bool],
        own: dict[str, T],
        derived: Callable[[], Mapping[str, T]] | None = None,
    ) -> None:
        """Store the entries of optloc. Entry points are not read yet."""
        self._group, self._fits, self._own, self._derived = group, fits, own, derived or dict
        self._found: dict[str, T] | None = None

    # Entries of optloc are found without reading entry points, which takes about ten milliseconds.
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
        """Read entry points again at the next use, for instance after a package was installed."""
        self._found = None

    @property
    def _added(self) -> dict[str, T]:
        """Return the entries of installed packages; entry points are read at the first use."""
        if self._found is None:
            self._found = {}  # set first, because a package may use the table while it loads
            for entry in entry_points(group=self._group):
                self._take(entry, self._found)
        return self._found

    def _take(self, entry: EntryPoint, found: dict[str, T]) -> None:
        """Add the object of an entry point to `found`, or warn why it is not added.

        `found` are the valid entries of the packages that were read earlier.
        """
        # A package cannot replace an entry of optloc, or of a package that was read earlier.
        if entry.name in self._own or entry.name in found:
            self._refuse(entry, f"the name {entry.name!r} is taken")
            return
        try:
            value = entry.load()
        except Exception as error:  # noqa: BLE001  # an external package can raise anything
            self._refuse(entry, f"{entry.value} does not load: {type(error).__name__}: {error}")
            return
        if self._fits(value):
            found[entry.name] = cast("T", value)
        else:
            self._refuse(entry, f"{entry.value} is {type(value).__name__}, which is not valid there")

    def _refuse(self, entry: EntryPoint, why: str) -> None:
        """Warn that an entry point is ignored; `why` is the reason."""
        package = "an unnamed package" if entry.dist is None else f"the package {entry.dist.name!r}"
        what = f"{package} adds nothing to {self._group} as {entry.name!r}: {why}"
        warnings.warn(what, RuntimeWarning, stacklevel=2)


# Plugins named on a command line. They and entry points are the only ways to load external code.

_PLUGINS: list[str] = []


def plugins() -> tuple[str, ...]:
    """Return the names of the loaded plugins, which another process needs to load too."""
    return tuple(_PLUGINS)


def load_plugin(name: str) -> None:
    """Run once a Python file or module that adds entries to tables, such as ``optloc.models.MODELS["mine"] = ...``.

    Parameters
    ----------
    name : str
        Path of a file that ends in .py, or name of an installed module. The code can do anything, so the name must come
        from the user, never from an input file.

    Raises
    ------
    InvalidProblem
        If it does not exist, or if it raises an error; the message contains this error.
    """
    path, listed = Path(name), _plugin_name(name)
    if listed in _PLUGINS:
        return
    try:
        if path.suffix == ".py":
            _run_file(path.resolve())
        else:
            importlib.import_module(name)
    except Exception as error:
        what = f"the plugin cannot be loaded ({type(error).__name__}: {error})"
        raise InvalidProblem(what, name, "give a file that ends in .py, or the name of an installed module") from error
    _PLUGINS.append(listed)


def plugin_module(name: str) -> ModuleType | None:
    """Return the module of a loaded plugin; None if it was not loaded. `name` is as for `load_plugin`."""
    listed = _plugin_name(name)
    if listed not in _PLUGINS:
        return None
    return sys.modules.get(_module_key(Path(listed)) if listed.endswith(".py") else listed)


def _plugin_name(name: str) -> str:
    """Return the name under which a plugin is listed: the absolute path of a file, or the name of a module."""
    return str(Path(name).resolve()) if name.endswith(".py") else name


def _module_key(path: Path) -> str:
    """Return the key in `sys.modules` of a plugin that is a file."""
    return f"optloc plugin {path}"


def _run_file(path: Path) -> None:
    """Run a Python file as a module, which stays in `sys.modules`; remove it if the file raises an error."""
    # The key contains the path: two plugins can have the same file name, and neither hides a module with this name.
    key = _module_key(path)
    spec = importlib.util.spec_from_file_location(key, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[key] = module  # so that its classes can be pickled by name
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[key]
        raise

"""Tables that others extend by entry points: a package names its group and what it adds, and nothing here changes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar, cast

T = TypeVar("T")


class Table(MutableMapping[str, T]):
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

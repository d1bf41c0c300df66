"""The decorator `cached_property` without a lock: in Python 3.11 it has one, which a forked child may wait for."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

__all__ = ["cached_property"]

if TYPE_CHECKING or sys.version_info >= (3, 12):
    from functools import cached_property
else:

    class cached_property:  # noqa: N801  (the name of the standard library)
        """A property that is computed at its first use and stored in the object, as `functools.cached_property`.

        Two threads may compute the value at the same time; both results are equal.
        """

        def __init__(self, function: Callable[[Any], Any]) -> None:
            self.function, self.__doc__ = function, function.__doc__

        def __set_name__(self, owner: type, name: str) -> None:
            """Store the name of the attribute."""
            self.name = name

        def __get__(self, instance: Any, owner: type | None = None) -> Any:
            """Return the value, and store it in the object, so that the next access does not come here."""
            if instance is None:
                return self
            # Not setattr, which frozen dataclasses refuse.
            return instance.__dict__.setdefault(self.name, self.function(instance))

"""Short forms of values for `print` and notebooks: what a value is, its main numbers, its status and the next call.

A class takes part by inheriting `HasShortForm`. Tables of functions, one for each type, describe the values; they
belong to higher layers, and the package `optloc` registers them here once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class ShortForm:
    """A description of a value in a few lines.

    Parameters
    ----------
    title : str
        What the value is, and its size.
    rows : tuple of (str, str)
        Labels with their texts: the main numbers and the status.
    following : str
        What to call next.
    """

    title: str
    rows: tuple[tuple[str, str], ...]
    following: str = ""


# Returns the module with the table `FORMS` of a folder of optloc.
_LOADER: list[Callable[[str], Any]] = []


def set_short_forms(loader: Callable[[str], Any]) -> None:
    """Register the loader of the modules that describe values.

    `loader` takes the name of a folder of optloc, such as "tracking", and returns a module with the table `FORMS`: for
    each name of a class, a function from a value to its `ShortForm`. The module of "show" renders short forms. The
    loader is called at the first use, because the modules belong to higher layers.
    """
    _LOADER[:] = [loader]


def short_form_of(value: object) -> ShortForm | None:
    """Return the short form of a value, from the table of its class or of a parent class; None without one."""
    for kind in type(value).__mro__:
        package, _, inner = kind.__module__.partition(".")
        if package == "optloc" and _LOADER:
            make = _LOADER[0](inner.partition(".")[0]).FORMS.get(kind.__name__)
            if make is not None:
                form: ShortForm = make(value)
                return form
    return None


class HasShortForm:
    """A value that prints as its short form, as text and in notebooks."""

    __slots__ = ()

    def __repr__(self) -> str:
        """Return the short form as text."""
        form = _form_or_none(self)
        return object.__repr__(self) if form is None else str(_LOADER[0]("show").text_of_form(form))

    def _repr_html_(self) -> str | None:
        """Return the short form as HTML, for notebooks; None without one."""
        form = _form_or_none(self)
        return None if form is None else str(_LOADER[0]("show").html_of_form(form))


def _form_or_none(value: object) -> ShortForm | None:
    """Return the short form of a value; None if a part of the value has no numbers to read.

    Arrays of other libraries, such as traced arrays of JAX, have no numbers. A debugger must print them anyway.
    """
    try:
        return short_form_of(value)
    except Exception:  # noqa: BLE001  (a `repr` that raises hides the error that a user wants to see)
        return None

"""Pictures of values: a class of a lower layer is drawn by a function of a higher layer."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# The package `optloc` registers the loader here once, because the functions belong to higher layers.
_LOADER: list[Callable[[str], Any]] = []


def set_plots(loader: Callable[[str], Any]) -> None:
    """Register the loader of the modules that draw values.

    Parameters
    ----------
    loader : callable of str
        Returns, for the name of a folder of the package, a module with the table `PLOTS`. This table has a drawing
        function for the name of each class. The loader is called at the first use.
    """
    _LOADER[:] = [loader]


def plot_of(value: object, **options: Any) -> Axes:
    """Return axes of matplotlib with a picture of a value.

    Parameters
    ----------
    value : object
        A value whose class is in a table `PLOTS`.
    **options : object
        Options of its drawing function.
    """
    kind = type(value)
    draw = _LOADER[0](kind.__module__.split(".")[1]).PLOTS[kind.__name__]
    return cast("Axes", draw(value, **options))

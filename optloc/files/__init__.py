"""Problem files: stations and measurements in TOML, CSV and Parquet, in the units of their writers."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from optloc.files.reader import Loaded, from_table, load, read

__all__ = ["Loaded", "from_table", "load", "read"]


def __getattr__(name: str) -> Any:
    # The schema takes a quarter of a second: who only writes a table, or shows the help, does not wait for it.
    from importlib import import_module

    if name in __all__:
        return getattr(import_module("optloc.files.reader"), name)
    raise AttributeError(f"module 'optloc.files' has no attribute {name!r}")

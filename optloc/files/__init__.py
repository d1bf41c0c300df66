"""Problem files: stations and measurements in TOML, CSV and Parquet, in the units of their writers."""

from optloc.files.reader import Loaded, from_table, load, read
from optloc.files.schema import schema

__all__ = ["Loaded", "from_table", "load", "read", "schema"]

"""Problem files: stations and measurements in TOML, CSV and Parquet, in the units of their writers."""

from optloc.files.reader import Loaded, load, read
from optloc.files.schema import schema
from optloc.files.tables import from_table

__all__ = ["Loaded", "from_table", "load", "read", "schema"]

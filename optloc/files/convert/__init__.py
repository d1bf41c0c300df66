"""Common inputs as problem files: tables of arrival times, pseudoranges, stations as GeoJSON."""

from optloc.files.convert.convert import Converted, convert

__all__ = ["Converted", "convert"]

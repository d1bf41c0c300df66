"""The back end that holds for a stretch of code, for floors above: see `formulations.backend`."""

from formulations.backend import Choice, Kind, counting, using

__all__ = ["Choice", "Kind", "counting", "using"]

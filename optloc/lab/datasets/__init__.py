"""Real measurements with true positions, read from a local folder; optloc ships none of the data."""

from optloc.lab.datasets.catalogue import NAMES, Dataset, available, load

__all__ = ["NAMES", "Dataset", "available", "load"]

"""Real measurements with true positions, read from a local folder; none of the data are part of optloc."""

from optloc.lab.datasets.catalogue import NAMES, Dataset, available, load

__all__ = ["NAMES", "Dataset", "available", "load"]

"""Studies of methods, reproduced papers and measured data sets."""

from typing import TYPE_CHECKING

from optloc.problem import exported

if TYPE_CHECKING:
    from optloc.lab import datasets as datasets, papers as papers, report as report, study as study

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)

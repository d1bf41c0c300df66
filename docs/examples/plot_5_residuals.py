"""
Residuals by station
====================

Thirty fixes of a drive past five beacons, with the residual of every range and bearing at its fix.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_residuals

run = optloc.problem.by_epoch(optloc.load(files("optloc") / "scenarios" / "run.toml"))
figure = plot_residuals(run, optloc.solve(run), "A drive past five beacons")

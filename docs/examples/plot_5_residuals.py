"""
Residuals by station
====================

Thirty fixes of a drive past five beacons: what every range and bearing says against the fix it took part in.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_residuals

run = optloc.problem.by_epoch(optloc.load(files("optloc") / "scenarios" / "run.toml"))
figure = plot_residuals(run, optloc.solve(run), "A drive past five beacons")

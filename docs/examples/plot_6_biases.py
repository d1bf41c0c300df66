"""
Clock errors estimated in a run
===============================

Four clocks are estimated together with the position of the emitter. The bands are 95 % intervals. Dotted lines are
the true errors.
"""

from importlib.resources import files

import numpy as np

import optloc
from optloc import units
from optloc.show.pictures import plot_biases
from optloc.solvers.running import growing

problem = optloc.load(files("optloc") / "scenarios" / "registration.toml")
metres = units.SPEED_OF_LIGHT * 1e-9
found = growing(problem, optloc.solve(problem), np.unique(np.geomspace(4, 200, 30).astype(int)))
truth = {"clock": metres * np.array([100.0, -133.0, 167.0, -100.0])}
figure = plot_biases(
    found, "Five aircraft, one emitter, four clock errors", truth=truth, units={"clock": ("ns", metres)}
)

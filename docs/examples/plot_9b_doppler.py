"""
A pass of a satellite
=====================

The rows are frequencies of one emitter in one pass. Each row alone fits everywhere on its isodoppler curve. The
curves cross at the fix, and again at the mirror image on the other side of the track.
"""

from importlib.resources import files

import numpy as np

import optloc
from optloc.show.pictures import plot_fixes

problem = optloc.load(files("optloc") / "starters" / "range_rate.toml")
fix = optloc.solve(problem)
figure = plot_fixes(problem, fix, "One pass, thirteen frequencies")
print(np.degrees(fix.geodetic[:2]).round(4))

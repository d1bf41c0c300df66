"""
A fix and its ellipse
=====================

Six receivers receive one pulse. The fix needs no first guess. The ellipse contains the target with a probability of
95 %.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_fixes

problem = optloc.load(files("optloc") / "scenarios" / "demo.toml")
fix = optloc.solve(problem)
figure = plot_fixes(problem, fix, "Six receivers, one pulse")
print(fix.status.label, fix.position.round(1), fix.sigma().round(1))

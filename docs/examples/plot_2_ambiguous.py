"""
Two positions that fit
======================

Three receivers in the plane give two differences. Two positions explain them exactly. The fix lists both, each with
its additional cost.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_fixes

problem = optloc.load(files("optloc") / "scenarios" / "ambiguous.toml")
fix = optloc.solve(problem)
figure = plot_fixes(problem, fix, "Three receivers, two possible places")
print(fix.status.sentence)

"""
Two places that fit
===================

Three receivers in the plane give two differences, which two places explain exactly. Both are listed, each with the
cost by which it is worse.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_fixes

problem = optloc.load(files("optloc") / "scenarios" / "ambiguous.toml")
fix = optloc.solve(problem)
figure = plot_fixes(problem, fix, "Three receivers, two possible places")
print(fix.status.sentence)

"""
The cost over the position of the target
========================================

The cost has a narrow valley with two minima. So an iteration from a guess may end at either minimum. Around the fix
the 95 % contour of the cost is curved. The ellipse is the contour of the linearised model.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_landscape

problem = optloc.load(files("optloc") / "scenarios" / "ambiguous.toml")
figure = plot_landscape(problem, optloc.solve(problem), "Three receivers, two possible places")

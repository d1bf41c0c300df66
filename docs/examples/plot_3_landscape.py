"""
The cost over the place of the target
=====================================

The cost has a narrow valley with two minima, which is why an iteration from a guess may end at either. Around the fix
the line that holds 95 % by the cost is bent; the ellipse is what remains of it when the model is linearised.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_landscape

problem = optloc.load(files("optloc") / "scenarios" / "ambiguous.toml")
figure = plot_landscape(problem, optloc.solve(problem), "Three receivers, two possible places")

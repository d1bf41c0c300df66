"""
Where iterations from a guess end
=================================

Every place of the map is a start. The plain Taylor iteration of Foy (1976) reaches the best fit from few of them,
damped least squares from more; the fix without a start is proven to be the best.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_convergence

problem = optloc.load(files("optloc") / "scenarios" / "demo.toml")
figure = plot_convergence(problem, optloc.solve(problem), "Six receivers, one pulse")

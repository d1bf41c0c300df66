"""
End points of iterations from a guess
=====================================

Every position of the map is a start. The plain Taylor iteration of Foy (1976) reaches the best fit from few starts.
Damped least squares reaches it from more starts. The fix without a start is proven to be the best.
"""

from importlib.resources import files

import optloc
from optloc.show.pictures import plot_convergence

problem = optloc.load(files("optloc") / "scenarios" / "demo.toml")
figure = plot_convergence(problem, optloc.solve(problem), "Six receivers, one pulse")

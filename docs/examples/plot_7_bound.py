"""
Map of the Cramér-Rao bound
===========================

The Cramér-Rao bound over the position of the target is the best possible accuracy of a fix there. It uses the noise
and the stations of the file.
"""

from importlib.resources import files

import numpy as np

import optloc
from optloc.bounds.over_area import bound_map
from optloc.show.pictures import plot_bound_map

problem = optloc.load(files("optloc") / "scenarios" / "demo.toml")
lon, lat = np.linspace(10.95, 11.5, 96), np.linspace(47.65, 47.95, 96)
figure = plot_bound_map(bound_map(problem, optloc.solve(problem).x, lon, lat, height=2000.0), "Target at 2000 m")

"""
Outside an island
=================

Six ranges locate a ship near an island. The keep-out polygon excludes the land, so the 95 % region ends at the coast.
The fix lists a second position, on the north coast, with its additional cost.
"""

import numpy as np

import optloc
from optloc import constraints
from optloc.show.pictures import plot_fixes

rng = np.random.default_rng(5)
anchors = rng.uniform(-50.0, 50.0, (6, 2))
ranges = np.linalg.norm(anchors - [13.0, 3.0], axis=1) + 3.0 * rng.standard_normal(6)
rows = optloc.measured("range", ranges, a=np.arange(6), sigma=3.0)
coast = [(-6.0, -8.0), (10.0, -4.0), (12.5, 8.0), (4.0, 6.0), (-3.0, 14.0)]
island = constraints.keep_out_polygon(coast, name="island")
problem = optloc.assemble(optloc.station_array(anchors), rows, constraints=island)
fix = optloc.solve(problem)
figure = plot_fixes(problem, fix, "A ship outside an island")
print(fix.status.sentence)

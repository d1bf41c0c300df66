"""
On the ground of a map
======================

Masts on almost one level determine the height badly: without the map, the height has an error of about 90 m. A grid of
heights adds the missing information.
"""

import numpy as np

import optloc
from optloc import constraints
from optloc.show.pictures import plot_fixes

rng = np.random.default_rng(3)
masts = np.column_stack([rng.uniform(-50.0, 50.0, (6, 2)), [1.0, 2.0, 0.5, 1.5, 0.0, 1.0]])
x = y = np.linspace(-60.0, 60.0, 13)
height = 12.0 * np.exp(-((x[:, None] - 10.0) ** 2 + y**2) / 800.0)
rows = optloc.measured("range", a=np.arange(6), sigma=3.0)
ground = constraints.terrain(x, y, height, exactly=0.0, name="ground")
template = optloc.assemble(optloc.station_array(masts), rows, constraints=ground)
problem = optloc.simulate(template, [8.0, 5.0, 11.6], seed=3)
fix = optloc.solve(problem)
figure = plot_fixes(problem, fix, "A target on a hill")
print(fix.position.round(1), fix.sigma().round(1))

"""
On a road
=========

Three receivers on a line measure the distance to a car. Two positions fit, one on each side of the line. Only one of
them is on the road, so the road decides.
"""

import optloc
from optloc import constraints
from optloc.show.pictures import plot_fixes

receivers = optloc.station_array([[-30.0, 30.0], [0.0, -2.5], [30.0, -35.0]])
rows = optloc.measured("range", [57.1, 22.4, 40.2], a=[0, 1, 2], sigma=2.0)
road = constraints.polyline([(-40, -25), (-10, -12), (12, 4), (45, 10)], tolerance=4.0, name="road")
problem = optloc.assemble(receivers, rows, constraints=road)
fix = optloc.solve(problem)
figure = plot_fixes(problem, fix, "A car on a road")
print(fix.status.sentence)

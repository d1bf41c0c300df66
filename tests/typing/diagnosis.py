"""Why a fix is not ok."""

import numpy as np

import optloc
from optloc.station_health import noise_levels

stations = 1e3 * np.array([[0.0, 0], [10, 0], [0, 10]])
problem = optloc.assemble(stations, optloc.measured("range", np.array([5e3, 7e3, 9e3]), a=np.arange(3), sigma=1.0))
fix = optloc.solve(problem)
found = optloc.diagnose(problem, fix)
for one in found.advice:
    print(one.cause, one.seen, one.advice)
print(noise_levels.__name__, [finding.label for finding in fix.findings])

"""A problem from arrays, solved and certified."""

import numpy as np

import optloc
from optloc.problem import ECEF

stations = 1e3 * np.array([[0.0, 0, 0], [10, 0, 1], [0, 10, 2], [-9, 1, 0.5], [1, -8, 3]])
rows = optloc.measured("tdoa", a=np.arange(1, 5), b=0, arrival_sigma="20 ns")
problem = optloc.simulate(optloc.assemble(stations, rows), np.array([2e3, 3e3, 4e3]), seed=1)
fix: optloc.Fix = optloc.certify(problem, optloc.solve(problem, "gtrs+lsr"))
print(fix.sigma(), fix.require(("unproven",)).covariance().shape, ECEF.geodetic)

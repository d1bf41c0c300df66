"""Clocks of stations as unknowns."""

import numpy as np

import optloc

stations = optloc.station_array(1e3 * np.array([[0.0, 0], [10, 0], [0, 10], [9, 9], [5, 12]]), list("ABCDE"))
rows = optloc.measured("toa", np.full(5, 7e3), a=np.arange(5), sigma=3.0)
problem = optloc.with_bias(optloc.assemble(stations, rows), "clock", members=["D", "E"], sigma="10 ns")
fix = optloc.solve(problem)
print(dict(fix.bias), fix.members("clock"))

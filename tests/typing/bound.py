"""The bound of a geometry, and what a constraint changes."""

import numpy as np

import optloc

frame = optloc.Frame.enu(lat_deg=47.0, lon_deg=8.0, height="400 m")
stations = optloc.station_array(
    1e3 * np.array([[0.0, 0, 0], [10, 0, 1], [0, 10, 2], [-9, 1, 0.5]]), ["A", "B", "C", "D"]
)
rows = optloc.measured("toa", a=[0, 1, 2, 3], sigma="30 ns")
problem = optloc.assemble(stations, rows, frame=frame, constraints=optloc.constraints.height(exactly="1640 ft"))
covariance = optloc.crlb(problem, np.array([2e3, 3e3, 100.0, 0.0]))
print(np.sqrt(np.diagonal(covariance)))

"""Gives no stations, and measurements without a noise."""

import optloc

fix = optloc.locate(ranges={"A": 5.0, "B": 5.0, "C": 5.0}, sigma=0.1)
rows = optloc.measured("range", [5.0, 5.0, 5.0], a=[0, 1, 2])
print(fix, rows)

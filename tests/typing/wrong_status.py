"""Compares a status with a text: it is never equal."""

import optloc

fix = optloc.locate({"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0)}, ranges=[5.0, 5.0, 5.0], sigma=0.1)
if fix.status == "ok":
    print(fix.position)

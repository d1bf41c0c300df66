"""A tag by ranges, in one call."""

import optloc

anchors = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0), "D": (8.0, 6.0)}
fix = optloc.locate(anchors, ranges={"A": 5.01, "B": 5.02, "C": 4.98, "D": 5.01}, sigma="5 cm")
status: optloc.Status = fix.status
x, y = fix.position.tolist()
print(status.label, round(x + y, 3), fix.certificate.proof)

"""Rows of a study made by hand, for the tests of tables, figures and pairs."""

import numpy as np
import pandas as pd

from optloc.base.types import ANSWERED
from optloc.lab.study.summary import judged

COMMON = {
    "noise": 10.0, "noise_unit": "m", "noise_label": "10 m", "rows": 5, "dimension": 3, "crlb": 2.0, "deviation": 1.0,
    "nees": 3.0, "dof": 2, "bound": np.nan, "iterations": 4.0, "build": 0.1, "certificate": "none",
    "kinds": "tdoa", "machine": "m", "versions": "v",
}  # fmt: skip


def row(method, trial, cost, **more):
    made = {"method": method, "trial": trial, "cost": cost, "status": "ok", "proof": "local", "seconds": 1e-3}
    made |= {"scenario": "s", "sweep": '{"layout.stations": 8}', "data": "d", "cost_truth": 9.0, "error": 2.0}
    made |= COMMON | more
    made["answered"] = made["status"] in {one.label for one in ANSWERED}
    made["located"] = np.isfinite(made["cost"])
    return made


def hand_made():
    """Return the judged rows of two methods on four trials, as `optloc.lab.study.summary` would have them."""
    rows = [
        row("a", 0, 3.0, proof="global"),  # best
        row("b", 0, 3.0, seconds=2e-3),  # as good
        row("a", 1, 5.0),  # best
        row("b", 1, 7.0, proof="global", seconds=2e-3),  # wrong, falsely proven
        row("a", 2, 9.5, proof="global"),  # the truth costs less
        row("b", 2, 9.5, status="ambiguous", seconds=2e-3),  # not best, but it says so
        row("a", 3, np.nan, status="singular geometry"),
        row("b", 3, 4.0, seconds=2e-3),
    ]
    made = pd.DataFrame(rows)
    best = made.groupby(["data", "trial"])["cost"].transform("min")
    return judged(made.assign(gap=made["cost"] - best))

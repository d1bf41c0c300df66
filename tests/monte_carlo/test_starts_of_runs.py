"""The starts of a run compared: closed form, semidefinite relaxation, IPOPT. Writes docs/measured/starts.md."""

from time import perf_counter

import numpy as np
import pytest
from monte_carlo.tables import write
from runs import drawn, run, truth

import optloc
from optloc.solvers.starts.block_averages import average_blocks
from optloc.solvers.starts.registration import closed_form
from optloc.solvers.starts.registration_windows import relax_run

SEED, TRIALS = 41, 12
CASES = {
    "600 epochs, 3 m": run(600),
    "600 epochs, 12 m": run(600, sigma=12.0),
    "100 epochs, 3 m, biases known to 200 m": run(100, prior=200.0),
    "600 epochs, 3 m, moving target": run(600, order=1),
}
METHODS = {
    "closed form": (closed_form, "roots+lsr"),
    "relaxation": (relax_run, "sdp+lsr"),
    "IPOPT": (None, "roots+nlp+lsr"),
}


def start_error(problem, begin, x):
    """Return the median and largest distance of the nearest start from the truth, or from its mirror image, metres."""
    if begin is None:
        return "", ""
    starts = begin(average_blocks(problem, 30))
    apart = np.linalg.norm(starts[..., :3] - x[:3], axis=-1)
    nearest = np.nanmin(apart, axis=1)
    return f"{np.median(nearest):.0f}", f"{nearest.max():.0f}"


@pytest.mark.full
def test_every_start_leads_to_the_same_minimum():
    lines = []
    for case, template in CASES.items():
        problem, x = drawn(template, SEED, TRIALS), truth(template)
        best = optloc.solve(problem, "lsr", start=x).cost
        for name, (begin, method) in METHODS.items():
            began = perf_counter()
            fix = optloc.solve(problem, method)
            seconds = (perf_counter() - began) / TRIALS
            reached = int((fix.cost <= best + 1e-3).sum())
            errors = start_error(problem, begin, x)
            lines.append((case, name, f"`{method}`", *errors, f"{reached} / {TRIALS}", f"{1e3 * seconds:.0f}"))
            assert reached == TRIALS, f"{case}, {name}: {TRIALS - reached} of {TRIALS} missed"
    write(
        "starts",
        ("case", "start", "method", "start error, m: median", "largest", "at the minimum", "ms a run"),
        lines,
        f"seed {SEED}, {TRIALS} trials a case",
    )

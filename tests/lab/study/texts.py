"""Study files of the tests, and what compares their tables."""

from pathlib import Path

import numpy as np

from optloc.lab.study.design import design_of_text
from optloc.lab.study.folder import begin, locked, read_arrow, store
from optloc.lab.study.trial import VALUES, compute

SMALL = """
format = 1
name = "small"
seed = 5
trials = 60

[[scenario]]
name = "differences"
layout = { stations = 6 }
truth = { kind = "shell", distance = ["5 km", "20 km"] }
noise = ["1 m", "30 ns"]

[[scenario]]
name = "arrivals"
layout = { stations = 6, kinds = ["toa"] }
truth = { kind = "hull" }
noise = ["3 m"]

[[method]]
method = "gtrs+lsr"
chunk = 10

[[method]]
method = "socp+lsr"
chunk = 20
"""

# Without the relaxation: processes need less time to begin.
QUICK = SMALL[: SMALL.rindex("[[method]]")]


def design(text=SMALL, folder=Path(), **options):
    return design_of_text(text, "small.toml", folder, **options)


def values(folder):
    """Return the value columns of a study as plain lists; NaN equals NaN."""
    table = read_arrow(folder, VALUES)
    return {name: table[name].combine_chunks().to_pylist() for name in table.column_names}


def assert_identical(one, two):
    a, b = values(one), values(two)
    assert a.keys() == b.keys()
    for name, column in a.items():
        numbers = column and isinstance(column[0], float)
        # Bit for bit: no tolerance.
        same = np.array_equal(column, b[name], equal_nan=True) if numbers else column == b[name]
        assert same, name


def run_here(made, folder):
    """Compute a study in this process, without anybody who watches: what executors must give, and quicker."""
    with locked(folder):
        begin(made, folder)
        for chunk in made.chunks:
            store(folder, compute(chunk))
    return folder

"""How much of the house a simple question walks through: the modules that `optloc fix` of the shipped demo enters."""

import subprocess
import sys

import pytest

# A module is entered where a function of it runs; what runs while modules are imported does not count.
COUNT = """
import sys, threading
from optloc.cli import app

entered, importing = set(), [0]

def look(frame, event, _):
    code = frame.f_code
    if code.co_name == "<module>":
        importing[0] += {"call": 1, "return": -1}.get(event, 0)
    elif event == "call" and not importing[0]:
        name = frame.f_globals.get("__name__", "")
        if name.partition(".")[0] in ("optloc", "formulations"):
            entered.add(name)

threading.setprofile(look)
sys.setprofile(look)
try:
    app(["fix", "demo", "--quiet"])
finally:
    sys.setprofile(None)
    print(*sorted(entered))
"""
# Five of them since an `ok` keeps its promise: the chart, the shape of the likelihood, the findings, and of the proof
# its curvature and the costs over the position; two since every file is read through one door and written through
# another; four since machine code has a folder that is looked into and a manifest of what it is made for, and what a
# proof covers is a file of its own; one since `solve` asks for the short way of few fixes first;
# two for the digest of a kernel and the options of its compilation; three for plans, which positions they admit, and
# parameter vectors; three for tables of tapes, for how plans are drawn, and for the one refinement of the long way;
# one for columns of words in tables; one for the lines of sight that the Earth may block; two for mirror images in the
# plane of the stations, and whether both sides of it are alike; two for laws that bounds cut off; six for constraints,
# fences and their checks, once one module; six for waves, their speeds, phases and physical checks of tables; one for
# the horizon, once a part of the inequalities; one for the time of emission; four for properties and locks that survive
# a fork, the fixes of epochs that data sets share, and the answer of a row; one for epochs of rows, once in tables.
MOST = 105


@pytest.mark.slow
def test_a_simple_fix_enters_few_modules():
    run = subprocess.run([sys.executable, "-c", COUNT], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    entered = run.stdout.split()
    assert len(entered) <= MOST, "\n".join(entered)
    assert {"optloc.cli.fix", "optloc.files.reader", "optloc.solvers.solution"} <= set(entered)

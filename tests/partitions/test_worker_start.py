"""The start of a worker: few collections of garbage, and none at its end."""

import subprocess
import sys

CODE = """
import gc
from optloc.partitions.worker_start import dask_setup
dask_setup(None)
class Loop:
    def __del__(self):
        print("collected")
loop = Loop()
loop.itself = loop
print(gc.get_threshold()[0])
del loop
"""


def test_a_worker_collects_rarely_and_not_at_its_end():
    found = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["50000"]
    whole = CODE.replace("dask_setup(None)", "")
    assert (
        "collected" in subprocess.run([sys.executable, "-c", whole], capture_output=True, text=True, check=True).stdout
    )

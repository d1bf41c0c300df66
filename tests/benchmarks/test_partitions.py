"""Five million readings in Parquet: the speed of Dask for each core, equal tables, and a killed worker.

The speed of a core is readings per second of processor time: user and system time of `optloc fix` and of all its
processes, from start to end. So the start of a cluster counts, and other programs on the machine do not.
"""

import os
import resource
import subprocess
import sys
from hashlib import blake2b
from pathlib import Path
from time import sleep

import pytest
from monte_carlo.tables import write
from partitions.scenes import SIGMA, STATIONS, write as write_readings

import optloc
from optloc.kernels.jit import enabled
from optloc.partitions.journal import JOURNAL

# Fewer partitions for a first look; the table is written with all.
ALL = 100
PARTS = int(os.environ.get("OPTLOC_PARTITIONS", ALL))
EVENTS = 8334
SHARE = 0.8
pytestmark = [pytest.mark.full, pytest.mark.skipif(not enabled(), reason="times of machine code")]


def begun(readings, sites, out, *options):
    """Start `optloc fix` for a data set on one thread, or by the options of an executor."""
    # As in an installed package, the bytecode of modules is stored.
    known = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    known |= {"PYTHONPATH": str(Path(optloc.__file__).parents[1]), "PYTHONPYCACHEPREFIX": str(out.parent / "bytecode")}
    known |= {"OPTLOC_THREADS": "1", "OPTLOC_COMPILE": "wait"}
    command = [sys.executable, "-P", "-m", "optloc.cli", "fix", readings, "--out", out, "--stations", sites, "--json"]
    allow = "ambiguous,curved,unproven"
    return subprocess.Popen(
        [*map(str, command), "--sigma", SIGMA, "--allow", allow, *options], env=known, stdout=subprocess.DEVNULL
    )


def spent(readings, sites, out, *options, kill=False):
    """Return the processor time of `optloc fix` and its processes, s; with `kill`, a worker is killed in the middle."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = begun(readings, sites, out, *options)
    if kill:
        kill_a_worker(command, out / JOURNAL, PARTS // 3)
    assert command.wait() == 0
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def kill_a_worker(command, journal, count):
    """Kill a worker of a command as soon as its journal has a number of partitions."""
    psutil = pytest.importorskip("psutil")
    while command.poll() is None and not (journal.exists() and len(journal.read_bytes().splitlines()) > count):
        sleep(0.2)
    children = psutil.Process(command.pid).children(recursive=True)
    workers = [one for one in children if "spawn_main" in " ".join(one.cmdline())]
    assert len(workers) == 2
    workers[-1].kill()


def checksums(folder):
    """Return the checksums of the tables of fixes by name."""
    return {path.name: blake2b(path.read_bytes()).hexdigest() for path in folder.glob("*.parquet")}


def test_two_workers_have_the_speed_of_one_process_and_a_killed_one_changes_nothing(tmp_path):
    pytest.importorskip("distributed")
    spent(*write_readings(tmp_path / "few", 2, 20), tmp_path / "first")  # stores the bytecode of modules
    readings, sites = write_readings(tmp_path / "readings", PARTS, EVENTS)
    count, dask = PARTS * EVENTS * len(STATIONS), ("--executor", "dask", "--jobs", "2")
    here = spent(readings, sites, tmp_path / "one")
    there = spent(readings, sites, tmp_path / "two", *dask)
    expected = checksums(tmp_path / "one")
    assert len(expected) == PARTS
    assert checksums(tmp_path / "two") == expected
    killed = spent(readings, sites, tmp_path / "killed", *dask, kill=True)
    assert checksums(tmp_path / "killed") == expected
    names = ("one process, one thread", "Dask, two workers", "Dask, two workers, one killed in the middle")
    rows = [
        [name, f"{seconds:.1f}", f"{count / seconds:.0f}", f"{here / seconds:.2f}"]
        for name, seconds in zip(names, (here, there, killed), strict=True)
    ]
    print(*rows, sep="\n")  # noqa: T201  (the purpose of a benchmark)
    if PARTS == ALL:
        header = ["executor", "processor time, s", "readings a second and core", "share of one process"]
        assert write("partitions", header, rows, f"{count} readings in {PARTS} partitions").is_file()
    assert here / there > SHARE

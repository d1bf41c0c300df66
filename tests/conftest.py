"""What all tests share: where the real data is, reproducible property tests, and seeds that a run may choose."""

import gc
import os
from functools import cache
from pathlib import Path

import hypothesis
import pytest
import typer.testing

ROOT = Path(__file__).resolve().parents[1]
DATA_DEFAULT = ROOT.parent / "shared" / "data"

# Seeded: a property that fails, fails again; compiled functions make first calls slow.
hypothesis.settings.register_profile("optloc", derandomize=True, deadline=None)
hypothesis.settings.load_profile("optloc")

# Machine code is waited for, in this process and in those that tests begin: answers must not depend on what is on disk.
os.environ.setdefault("OPTLOC_COMPILE", "wait")
# Of several processes each has a processor: where the library of numpy, or a batch, starts as many threads as there are
# in each of them, these wait for each other, and products of small matrices take ten times as long.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OPTLOC_THREADS", "1")
# What tests begin is the optloc that they test, not a checkout in the current folder, which has no machine code.
os.environ["PYTHONSAFEPATH"] = "1"

# Searches for garbage among a million objects of collected tests, which live until the end, take half of collection.
gc.disable()

# The command line is put together once, not for each of a thousand commands.
typer.testing._get_command = cache(typer.testing._get_command)

# Seeds of a test in full: data that nobody had seen broke a proof once, where ten seeds had been one.
FULL_SEEDS = 10


def pytest_addoption(parser):
    """Let a run choose the data of the tests that take the fixture `seed`."""
    group = parser.getgroup("optloc")
    group.addoption("--seed", type=int, default=0, help="first seed of the drawn scenes (0: those of every run)")
    group.addoption("--seeds", type=int, help=f"how many seeds, one after the other (1; {FULL_SEEDS} of full tests)")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session):
    """Have machine code made before several processes begin that would need it at once; one makes what it needs."""
    option = session.config.option
    if hasattr(session.config, "workerinput") or not getattr(option, "numprocesses", None) or option.collectonly:
        return
    from optloc.cli.compile import make, missing
    from optloc.cli.output import meter
    from optloc.kernels.jit import enabled

    if enabled() and missing():
        with meter("making machine code", quiet=False) as tell:
            make(tell)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Let no later search for garbage look at what was collected: it lives until the end."""
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_generate_tests(metafunc):
    """Give a test with the fixture `seed` one seed, or as many as the run asks for."""
    own = [mark.args[0] for mark in metafunc.definition.iter_markers("parametrize")]
    # A test whose table has a column of that name keeps it.
    if "seed" not in metafunc.fixturenames or any("seed" in (n.split(",") if isinstance(n, str) else n) for n in own):
        return
    first, count = metafunc.config.getoption("seed"), metafunc.config.getoption("seeds")
    if count is None:
        count = FULL_SEEDS if metafunc.definition.get_closest_marker("full") else 1
    seeds = range(first, first + count)
    metafunc.parametrize("seed", seeds, ids=[f"seed {number}" for number in seeds], indirect=True, scope="session")


@pytest.fixture(scope="session")
def seed(request) -> int:
    """Return the seed of the drawn scenes of a test: 0 unless ``--seed`` or ``--seeds`` says otherwise."""
    return request.param


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of the real data sets."""
    folder = Path(os.environ.get("OPTLOC_DATA", DATA_DEFAULT))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set OPTLOC_DATA to its folder")
    return folder


@pytest.fixture(scope="module", autouse=True)
def one_form_of_machine_code():
    """Whatever Python hands to machine code is of the types for which `optloc compile` made it: nobody waits twice."""
    yield
    from optloc.cli.compile import parts
    from optloc.kernels import jit

    if not jit.enabled():
        return
    entries = {name for part in parts().values() for name in part.entries}
    twice = {k.name: k.machine.signatures for k in jit._KERNELS if k.name in entries and len(k.machine.signatures) > 1}
    assert not twice, "\n".join(f"{name}: {each}" for name, both in twice.items() for each in both)

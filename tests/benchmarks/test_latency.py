"""One fix at once: prepared, of a known and of a new structure; ratios to SciPy in one run."""

import gc
import os
from functools import cache
from itertools import permutations
from time import thread_time

import numpy as np
import pytest
from benchmarks.scenes import Scene
from benchmarks.with_general import scipy_from_the_truth
from monte_carlo.tables import write

from optloc import assemble, locate, measured, prepare, solve
from optloc.engine.fixes import fix_one_by_ranges
from optloc.engine.memory import Answer
from optloc.engine.plan import LIMIT, TOLERANCE
from optloc.kernels.jit import enabled
from optloc.proof.batch import prove_here

pytestmark = pytest.mark.skipif(not enabled(), reason="times of machine code")
SIGMA, COUNT, WARM = 5.0, 400, 20
STATIONS = 1e3 * np.array([[0, 0, 0], [8, 0, 0.2], [0, 8, -0.15], [-7, 1, 0.4], [1, -8, 0.1], [5, 5, 0.9]])
FIRST = np.zeros(5, dtype=int)
PLACES = ("inside", "10 to 30 km")


@cache
def scene(place):
    """Differences to the first of six stations of emitters inside the network or outside."""
    rng = np.random.default_rng(PLACES.index(place))
    turn, height = rng.uniform(0.0, 2.0 * np.pi, COUNT), rng.uniform(500.0, 6e3, COUNT)
    r = rng.uniform(0.0, 5e3, COUNT) if place == PLACES[0] else rng.uniform(1e4, 3e4, COUNT)
    truth = np.stack([r * np.cos(turn), r * np.sin(turn), height], axis=1)
    arrival = np.linalg.norm(truth[:, None] - STATIONS, axis=-1)
    arrival += SIGMA * rng.standard_normal(arrival.shape)
    z = arrival[:, 1:] - arrival[:, :1]
    return Scene(np.broadcast_to(STATIONS, (COUNT, 6, 3)), z, truth, SIGMA**2 * (np.eye(5) + 1.0))


def problem_of(z, order=(1, 2, 3, 4, 5)):
    return assemble(STATIONS, measured("tdoa", z, a=np.array(order), b=FIRST, arrival_sigma=SIGMA))


def timed(work, count=COUNT, warm=WARM):
    """Return median and 99th percentile, microseconds of processor time, of calls with the numbers of measurements."""
    for i in range(warm):
        work(i)
    times = np.empty(count - warm)
    gc.collect()
    gc.disable()
    try:
        for i in range(warm, count):
            began = thread_time()
            work(i)
            times[i - warm] = thread_time() - began
    finally:
        gc.enable()
    return 1e6 * np.median(times), 1e6 * np.percentile(times, 99)


def general(place):
    """SciPy from the truth, of one problem at a time."""
    whole = scene(place)
    parts = [
        Scene(whole.stations[i : i + 1], whole.z[i : i + 1], whole.truth[i : i + 1], whole.covariance)
        for i in range(COUNT)
    ]
    made = [scipy_from_the_truth(part) for part in parts]
    return timed(lambda i: made[i]())


def kernels(place):
    """The machine code of fix and proof alone, on arrays that are ready."""
    ready, z = prepare(problem_of(scene(place).z[0]), "auto"), scene(place).z
    ready(z[0])
    short = ready.short
    room = short._workspace(())
    x, covariance = np.empty((1, 3)), np.empty((1, 3, 3))
    answer = Answer(x, covariance, *room.found)

    def work(i):
        room.z[0] = z[i]
        fix_one_by_ranges(short.load.model, short.load.rows, room.z, short.load.place, TOLERANCE, LIMIT, False, answer)
        short.map.write(z[i], room.costs, 0)
        room.asked.x[0] = x[0]
        prove_here(room.costs, room.asked, room.answered)

    return timed(work)


def prepared(method, place):
    ready, z = prepare(problem_of(scene(place).z[0]), method), scene(place).z
    return timed(lambda i: ready(z[i]))


def fresh(place):
    """Problems of a structure that was seen before, each made for itself."""
    made = [problem_of(z) for z in scene(place).z]
    return timed(lambda i: solve(made[i]))


def few(count):
    """Sets of measurements of one scene, so many in one call."""
    z = scene(PLACES[0]).z
    made = [problem_of(z[i : i + count]) for i in range(COUNT - count)]
    return timed(lambda i: solve(made[i]), len(made))


def new():
    """Structures that nobody has seen: the stations in another order each time."""
    orders = list(permutations(range(1, 6)))[1:101]
    made = [problem_of(z[np.array(order) - 1], order) for z, order in zip(scene(PLACES[0]).z, orders, strict=False)]
    return timed(lambda i: solve(made[i]), len(made), 0)


def assembled():
    z = scene(PLACES[0]).z
    return timed(lambda i: problem_of(z[i]))


def located():
    """One call from time differences to a fix, with names, units and stations that were read before."""
    names, light = tuple("ABCDEF"), 299_792_458.0
    places = dict(zip(names, map(tuple, STATIONS.tolist()), strict=True))
    z = [dict(zip(names[1:], times, strict=True)) for times in (scene(PLACES[0]).z / light).tolist()]
    return timed(lambda i: locate(places, tdoa=z[i], sigma=SIGMA * np.sqrt(2.0) / light))


def printed():
    """The text of a fix."""
    fixes = [solve(problem_of(z)) for z in scene(PLACES[0]).z]
    return timed(lambda i: str(fixes[i]))


def figures():
    """Return name, median and 99th percentile, and the place whose SciPy each is compared with."""
    for place in PLACES:
        yield f"{place}: SciPy `least_squares` from the truth", *general(place), place
        yield f"{place}: machine code of fix and proof alone", *kernels(place), place
        for method in ("auto", "gtrs+lsr"):
            yield f"{place}: prepared, {method}", *prepared(method, place), place
        yield f"{place}: `solve`, auto, of a known structure", *fresh(place), place
    for count in (4, 16):
        yield f"inside: `solve`, auto, of {count} sets of measurements at once", *few(count), PLACES[0]
    yield "`solve`, auto, of a new structure", *new(), PLACES[0]
    yield "`assemble`", *assembled(), PLACES[0]
    yield "`locate`", *located(), PLACES[0]
    yield "`print` of a fix", *printed(), PLACES[0]


@pytest.mark.parametrize(("place", "proven"), zip(PLACES, (0.7, 1.5), strict=True))
def test_one_fix_takes_as_long_as_scipy_from_the_truth(place, proven):
    """Less than that inside the stations; far from them the proof looks at some dozens of boxes, of 3 us each."""
    theirs = general(place)[0]
    assert prepared("gtrs+lsr", place)[0] < 0.5 * theirs
    assert prepared("auto", place)[0] < proven * theirs
    assert fresh(place)[0] < 1.5 * proven * theirs


@pytest.mark.parametrize(("work", "most"), [(assembled, 0.8), (located, 2.0), (printed, 5.0)])
def test_what_surrounds_a_fix_takes_little(work, most):
    """In solutions of SciPy: to put a known structure together, one call to a fix, and its text."""
    assert work()[0] < most * general(PLACES[0])[0]


@pytest.mark.full
def test_write_the_table():
    rows, theirs = [], {}
    for name, median, late, place in figures():
        theirs.setdefault(place, median)
        rows.append([name, f"{median:.0f}", f"{late:.0f}", f"{median / theirs[place]:.2f}"])
    facts = f"five TDOA of six stations, {SIGMA:g} m an arrival; processor time of one core of {os.cpu_count()}"
    header = ["one fix at once", "median, us", "99 of 100, us", "SciPy from the truth"]
    assert write("latency", header, rows, facts).is_file()

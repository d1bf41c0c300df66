"""Starts by squared ranges: exact without noise, and rows that vanish at the truth."""

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, plain_predict
from engine.blocks import block_of

from optloc.engine import ranges, tapes
from optloc.engine.memory import BLUR, CENTRE, GOOD, ORIGIN, SCALE, SPREAD, X
from optloc.engine.start import begin, square_ranges

pytestmark = pytest.mark.usefixtures("in_python")


def exact(name):
    """Return a problem without errors of its measurements, and the truth."""
    problem, truth = CASES[name].problem, CASES[name].truth
    return problem.with_rows(z=plain_predict(problem, truth)), truth


@pytest.mark.parametrize(
    ("name", "module"),
    [("range-2d", ranges), ("tdoa-3d", ranges), ("toa-2d", ranges), ("groa-2d", tapes), ("range+azimuth-2d", tapes)],
)
def test_the_start_of_exact_measurements_is_the_truth(name, module):
    problem, truth = exact(name)
    block = block_of(problem, module)
    block.run(begin, block.model, block.rows, block.room)
    assert block.room.scalar[GOOD, 0] == 1.0
    found = block.room.vector[X, : problem.dimension, 0] + block.room.vector[ORIGIN, : problem.dimension, 0]
    np.testing.assert_allclose(found, truth[: problem.dimension], atol=1e-3)


def test_stations_count_from_their_mean_or_from_the_reference():
    places = STATIONS[2]
    free, determined = (block_of(exact(name)[0], ranges).room for name in ("tdoa-2d", "range-2d"))
    np.testing.assert_allclose(determined.vector[ORIGIN, :, 0], places.mean(0))
    np.testing.assert_allclose(determined.vector[CENTRE, :, 0], 0.0, atol=1e-9)
    assert free.vector[ORIGIN, :, 0].tolist() in places.tolist()
    for room in (free, determined):
        np.testing.assert_allclose((room.vector[ORIGIN] + room.vector[CENTRE])[:, 0], places.mean(0))
        assert room.scalar[SPREAD, 0] == pytest.approx(np.linalg.norm(places - places.mean(0), axis=1).max())


def test_squared_rows_vanish_at_the_truth():
    for name in ("tdoa-2d", "range-2d"):
        block = block_of(exact(name)[0], ranges)
        room, s = block.room, len(STATIONS[2])
        station, reference = block.model.station, block.model.reference
        scalar, spare = room.scalar, room.scalar[0]
        sizes = room.place, scalar[SPREAD], scalar[SCALE]
        block.run(square_ranges, room.value[:s], station, reference, *sizes, room.squared, spare)
        x = (TARGET[2] - room.vector[ORIGIN, :, 0]) / scalar[SCALE, 0]
        last = np.linalg.norm(x) if reference >= 0 else x @ x
        rows = room.squared[:, :, 0]
        np.testing.assert_allclose(rows[:, :3] @ np.append(x, last), rows[:, 3], atol=1e-12)


def test_measurements_are_read_less_corrections_and_absent_rows_as_zero():
    problem = CASES["range-2d"].problem
    weight = np.ones(6)
    weight[2] = 0.0
    z = problem.z.copy()
    z[2] = np.nan
    own = problem.with_rows(z=z, weight=weight)
    block = block_of(own, ranges)
    seen = block.room.seen[:, 0]
    assert seen[2] == 0.0
    np.testing.assert_allclose(np.delete(seen, 2), np.delete(problem.observed, 2))
    assert block.room.scalar[GOOD, 0] == 1.0
    norm = np.linalg.norm(np.delete(problem.observed, 2) / 5.0)
    assert block.room.scalar[BLUR, 0] == pytest.approx(4.0 * np.finfo(float).eps * norm)
    z[0] = np.inf
    assert block_of(problem.with_rows(z=z, weight=weight), ranges).room.scalar[GOOD, 0] == 0.0

"""Equalities of states that last, and of a state of every epoch."""

import numpy as np
import pytest

from optloc import Motion, assemble, measured
from optloc.kernels.jit import plain
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import box
from optloc.linear.equalities import Equalities, spare_rows

PLACES = np.array([[0.0, 0.0], [9.0, 1.0], [10.0, 9.0], [1.0, 10.0]])
LINE = box([-np.inf, 5.0], [np.inf, 5.0])  # y = 5
EPOCHS = 3


@pytest.fixture(params=["run", "epoch"])
def problem(request):
    a, epoch = np.tile(np.arange(4), EPOCHS), np.repeat(np.arange(EPOCHS), 4)
    z = 5.0 + 0.01 * np.arange(4 * EPOCHS)
    rows = measured("range", z[None], a=a, epoch=epoch, sigma=0.5)
    return assemble(PLACES, rows, motions=(Motion(0, span=request.param),), constraints=(LINE,))


def y_of(problem, x):
    return x.reshape(len(x), -1, 2)[..., 1]


def test_vectors_are_moved_onto_the_equality_along_the_shortest_way(problem):
    x = np.linspace(3.0, 4.0, problem.layout.size)[None]
    found = Equalities.of(problem).restore(x)
    assert (y_of(problem, found) == 5.0).all()
    assert (found.reshape(-1, 2)[:, 0] == x.reshape(-1, 2)[:, 0]).all()


def test_a_step_along_the_equality_is_the_best_of_all_that_keep_it(problem):
    held = Equalities.of(problem)
    x = held.restore(np.linspace(3.0, 4.0, problem.layout.size)[None])
    with plain():
        equations = equations_at(problem, x)
        move, ok = held.step(equations, np.zeros(1), x)
    assert ok.all()
    assert abs(y_of(problem, move)).max() < 1e-12
    # by hand: information and vector of each first coordinate alone
    if problem.layout.n_local:
        expected = equations.local_vector[0, :, 0] / equations.local[0, :, 0, 0]
    else:
        expected = equations.shared_vector[:, 0] / equations.shared[:, 0, 0]
    np.testing.assert_allclose(move.reshape(-1, 2)[:, 0], expected)


def test_an_equality_of_every_epoch_adds_a_degree_of_freedom_in_each(problem):
    unknowns = 2 * EPOCHS if problem.layout.n_local else 2
    equalities = EPOCHS if problem.layout.n_local else 1
    assert spare_rows(problem).tolist() == [4 * EPOCHS - unknowns + equalities]

"""The numbers of problems as plain arrays, and runs folded to batches of their epochs."""

import numpy as np
from cases import CASES
from runs import run

from optloc import Motion, assemble, measured
from optloc.kernels.pack import Divided, coarseness, fold, folding, observed, pack, pack_runs, sources
from optloc.linear.normal import whitener_at
from optloc.models.primitives import WGS84_A
from optloc.problem.noise import variances

PLACES = np.array([[0.0, 0.0], [9.0, 1.0], [10.0, 9.0], [1.0, 10.0]])
Z = np.arange(12.0).reshape(3, 4)


def ranges(**more):
    return assemble(PLACES, measured("range", Z, a=np.arange(4), sigma=2.0, correction=0.5, **more))


def test_numbers_that_all_share_are_kept_once_and_others_for_each_problem():
    found = Divided.of([np.array([[1.0, 2.0]]), np.array([[3.0], [4.0]]), np.array([[5.0]]), np.array([[6.0], [7.0]])])
    assert found.common.tolist() == [1.0, 2.0, 5.0]
    assert found.own.tolist() == [[3.0, 6.0], [4.0, 7.0]]
    assert found.place[:, 0].tolist() == [0, -1, 2, -2]
    assert (found.size(False), found.size(True)) == (3, 2)


def test_packed_numbers_are_those_of_the_problem():
    problem = ranges(weight=np.array([1.0, 1.0, 0.0, 1.0]))
    found = pack(problem, whitener_at(problem, np.zeros((3, 2)))).numbers
    assert found.observed.tolist() == (Z - 0.5).tolist() == observed(problem).tolist()
    assert found.present.tolist() == [[1.0, 1.0, 0.0, 1.0]]
    assert (found.sigma**2).tolist() == np.atleast_2d(variances(problem.noise, 4)).tolist()
    assert found.common[:9].tolist() == [0.0, *PLACES.ravel()] == sources(problem).common.tolist()
    assert found.source.shape == (1, 0)
    assert pack(ranges(), whitener_at(ranges(), np.zeros((3, 2)))).numbers.present.shape == (1, 0)


def test_heights_are_as_coarse_as_the_radius_of_the_earth():
    assert set(coarseness(CASES["tdoa+height-3d"].problem)) == {0.0, WGS84_A}


def test_a_run_of_equal_epochs_folds_to_a_batch_of_its_epochs():
    problem = run(5, station=1.0, span="epoch", biased=False).flat()
    found = folding(problem)
    assert found.epochs == 5
    batch = fold(problem, found)
    assert batch.batch_shape == (5,)
    assert (batch.epochs, batch.count) == (1, 4)
    assert batch.stations.position[:, 0].tolist() == problem.stations.position.tolist()
    packed = pack_runs(problem, whitener_at(problem, np.zeros((1, problem.layout.size))))
    assert packed.epochs == 5
    assert len(packed.packed.numbers.source) == 5


def test_epochs_of_other_rows_and_moving_targets_do_not_fold():
    def epochs(epoch, **more):
        return assemble(PLACES, measured("range", a=[0, 1, 2, 0, 1, 3], epoch=epoch, sigma=1.0), **more)

    assert folding(epochs([0, 0, 0, 1, 1, 1])) is None  # stations 2 and 3
    equal = assemble(PLACES, measured("range", a=[0, 1, 0, 1], epoch=[0, 0, 1, 1], sigma=1.0), motions=(Motion(1),))
    assert folding(equal) is None
